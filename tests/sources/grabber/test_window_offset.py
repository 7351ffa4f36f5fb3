"""The grabber's window against plain slicing and padding, in whole frames and in windows of them."""

from __future__ import annotations

import numpy as np
import pytest

from catalogue.support import Texture, camera_with
from pixmetry.camera.camera import load_camera
from pixmetry.core.errors import InputError
from pixmetry.core.random import Grid
from pixmetry.sources.grabber.window_offset import SOURCE, WindowOffset

SHAPE = (48, 64)
CASES = [
    WindowOffset(row_offset=8, col_offset=5),
    WindowOffset(row_offset=-6, col_offset=-9, rows=70, cols=90),
    WindowOffset(row_offset=10, rows=20, cols=30, col_offset=30),
    WindowOffset(row_offset=4, row_increment=4, inactive_rows=3),
    WindowOffset(row_offset=-8, row_increment=4, col_offset=-4, col_increment=2, cols=40),
]


def expected(params: WindowOffset, image: np.ndarray) -> np.ndarray:
    row, col = params.row_offset, params.col_offset
    wide = np.pad(image, ((0, 0), (200, 200), (200, 200)))
    rows, cols = params.rows or image.shape[1], params.cols or image.shape[2]
    out = wide[:, 200 + row : 200 + row + rows, 200 + col : 200 + col + cols].copy()
    out[:, : params.inactive_rows] = 0
    return out


@pytest.mark.parametrize("params", CASES)
def test_it_stores_a_part_of_the_image_and_black_around_it(params: WindowOffset) -> None:
    camera = camera_with(SOURCE, params)
    image = camera_with(SOURCE, WindowOffset()).expose(Texture(), 2, seed=1).data
    stored = camera.expose(Texture(), 2, seed=1)
    assert np.array_equal(stored.data, expected(params, image))
    assert stored.frame_shape == camera.output_shape == stored.data.shape[1:]


@pytest.mark.parametrize("params", CASES)
def test_any_window_of_it_is_the_crop(params: WindowOffset) -> None:
    camera = camera_with(SOURCE, params)
    whole = camera.expose(Texture(), 1, seed=1).data
    rows, cols = camera.output_shape
    rng = np.random.default_rng(4)
    row0, col0 = rng.integers(0, rows - 7, 40), rng.integers(0, cols - 5, 40)
    batch = camera.expose_windows(Texture(), Grid(np.zeros(40), row0, col0, (7, 5)), seed=1)
    for got, r, c in zip(batch, row0, col0, strict=True):
        assert np.array_equal(got, whole[0, r : r + 7, c : c + 5])


def test_targets_follow() -> None:
    camera = camera_with(SOURCE, WindowOffset(row_offset=4, row_increment=4, col_offset=-3))
    x, y = camera.true_positions([20.25], [30.5])
    assert (x[0], y[0]) == (23.25, 26.5)


def test_an_offset_between_the_steps_is_refused_with_those_beside_it() -> None:
    with pytest.raises(InputError, match=r"row_offset.*33.*32 or 36"):
        load_camera("pulnix_tm6cn_epix_512").with_parameters("grabber.window_offset", row_offset=33)
    with pytest.raises(InputError, match=r"col_offset.*-3.*-4 or -2"):
        SOURCE.make({"col_offset": -3, "col_increment": 2})
    _, y = load_camera("pulnix_tm6cn_epix_512").layout([100.0], [132.0])
    assert y[0] == 100.0
