"""Modes of a progressive sensor: whole frames, woven fields, single fields."""

from __future__ import annotations

import numpy as np
import pytest

from catalogue.support import NAME, Texture, camera_with
from pixmetry.sources.sensor.read_out import SOURCE, ReadOut, forward, place, truth
from source_signals import flat, signal, stream


def spots_y(y: np.ndarray, sigma: float = 0.8, rows: int = 40, fine: int = 64) -> np.ndarray:
    """Gaussian spots at rows y, integrated over full pixels along y; shape (n, rows, 1)."""
    at = (np.arange(rows * fine) + 0.5) / fine - 0.5
    image = np.exp(-0.5 * ((at - y[:, None]) / sigma) ** 2).reshape(len(y), rows, fine).mean(axis=2)
    return 10_000 * image[:, :, None]


@pytest.mark.parametrize(
    ("params", "amplitude"),
    [
        (ReadOut(mode="field", field="even"), 0.126),
        (ReadOut(mode="field", field="even", lines="summed"), 0.0271),
        (ReadOut(mode="field", field="odd", lines="summed"), 0.0271),
        (ReadOut(), 0.0),
    ],
)
def test_periodic_error_of_a_small_spot(params: ReadOut, amplitude: float, rng: np.random.Generator) -> None:
    """s = 0.8 px: a₁ = |H'(ν)|/(π H(0)) in pixels of the frame, at one cycle per line; H the transform of spot and aperture.

    Alternate lines: H = exp(−2π²s²ν²) sinc ν at ν = 1/2, 0.126 px (0.13); summed: sinc 2ν, 0.0271 px (0.027); the frame: below 1e-4 px.
    """
    y = 19 + np.linspace(0, 2, 64, endpoint=False)
    out = forward(params, signal(spots_y(y)), stream(rng)).data[:, :, 0].astype(float)
    found = (out * np.arange(out.shape[1])).sum(axis=1) / out.sum(axis=1)
    pitch = 40 // out.shape[1]
    error = pitch * (found - place(params, 0 * y, y, (40, 1), 0)[1])
    spectrum = 2 * np.abs(np.fft.rfft(error)) / len(y)
    assert abs(error.mean()) < 1e-3
    assert spectrum[1] == pytest.approx(amplitude, abs=3e-4 if amplitude else 1e-4)


def test_fields_of_alternate_lines_woven_again_are_the_frame(rng: np.random.Generator) -> None:
    data = rng.uniform(0, 100, (1, 9, 4)).astype(np.float32)
    even, odd = (forward(ReadOut(mode="field", field=f), signal(data), stream(rng)) for f in ("even", "odd"))
    assert even.data.shape == odd.data.shape == (1, 4, 4) and even.frame_shape == (4, 4)
    woven = np.stack([even.data, odd.data], axis=2).reshape(1, 8, 4)
    assert np.array_equal(woven, data[:, :8])
    both = forward(ReadOut(mode="field", lines="summed"), signal(np.repeat(data, 2, axis=0)), stream(rng)).data
    assert np.allclose(both[0], data[0, 0:8:2] + data[0, 1:9:2])
    assert np.allclose(both[1], data[0, 1:9:2] + data[0, 2:9:2])


def test_a_wrong_field_order_swaps_rows_and_turns_the_gradient_between_them(rng: np.random.Generator) -> None:
    ramp = np.broadcast_to(np.arange(9.0)[:, None], (1, 9, 3))
    params = ReadOut(mode="woven", swapped=True)
    out = forward(params, signal(ramp), stream(rng))
    assert np.array_equal(out.data[0, :, 0], [1, 0, 3, 2, 5, 4, 7, 6, 8])
    assert np.array_equal(truth(params, flat(0, (9, 3)), stream(rng))["sensor_row"][0], [1, 0, 3, 2, 5, 4, 7, 6, 8])
    assert np.array_equal(forward(params, out, stream(rng)).data, signal(ramp).data)


@pytest.mark.parametrize("lines", ["alternate", "summed"])
@pytest.mark.parametrize("shape", [(48, 20), (37, 20), (2, 5)])
def test_a_window_of_a_field_equals_the_crop(lines: str, shape: tuple[int, int]) -> None:
    camera = camera_with(SOURCE, ReadOut(mode="field", lines=lines), shape=shape)
    rows = shape[0] // 2
    assert camera.output_shape == (rows, shape[1])
    whole = camera.expose(Texture(), 2).data
    assert whole.shape == (2, rows, shape[1])
    for r, h in ((0, rows), (rows - 1, 1), (rows // 2, rows - rows // 2), (0, 1), (rows // 3, max(1, rows // 3))):
        assert np.array_equal(camera.expose(Texture(), 2, window=(r, 1, h, 3)).data, whole[:, r : r + h, 1:4])
    full = camera.switched(off=[NAME]).expose(Texture(), 2).data
    told = [camera.truth(frame=f)[NAME]["sensor_row"].reshape(rows) for f in (0, 1)]
    if lines == "alternate":
        assert all(np.array_equal(whole[f], full[f][told[f]]) for f in (0, 1))
