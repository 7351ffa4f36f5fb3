"""The colour mosaic: where its colours lie, whatever the window, and that balancing restores grey light."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.signal import Kind
from pixmetry.sources.sensor.bayer_mosaic import BayerMosaic, correct, forward, propagate, truth
from source_signals import centroid_probe, flat, signal, spots, stream

SHARES = {"red": 0.5, "green": 0.8, "blue": 0.2}


@pytest.mark.parametrize(
    ("pattern", "want"),
    [
        ("RGGB", [[0.5, 0.8], [0.8, 0.2]]),
        ("GRBG", [[0.8, 0.5], [0.2, 0.8]]),
        ("GBRG", [[0.8, 0.2], [0.5, 0.8]]),
        ("BGGR", [[0.2, 0.8], [0.8, 0.5]]),
    ],
)
def test_colours_lie_as_the_name_says_in_every_window(pattern, want, rng: np.random.Generator):
    params = BayerMosaic(pattern=pattern, **SHARES)
    whole = forward(params, flat(1000.0, (6, 8), kind=Kind.PHOTONS), stream(rng)).data[0]
    assert whole == pytest.approx(1000 * np.tile(want, (3, 4)), rel=1e-6)
    part = forward(params, flat(1000.0, (3, 4), kind=Kind.PHOTONS, row0=3, col0=1, frame_shape=(6, 8)), stream(rng)).data[0]
    assert np.array_equal(part, whole[3:6, 1:5])


def test_the_two_greens_differ_about_their_mean(rng: np.random.Generator):
    """Rows of red 1 − 5 %, rows of blue 1 + 5 %."""
    got = forward(BayerMosaic(pattern="GRBG", green_split_rel=0.1), flat(100.0, (2, 2), kind=Kind.PHOTONS), stream(rng)).data[0]
    assert got == pytest.approx(np.array([[95, 100], [100, 105]]))


def test_balancing_restores_grey_light_and_leaves_a_blind_colour_alone(rng: np.random.Generator):
    params = BayerMosaic(**SHARES)
    x = signal(rng.uniform(0, 1e4, (2, 9, 7)), Kind.PHOTONS, row0=1, frame_shape=(20, 7))
    assert correct(params, forward(params, x, stream(rng)), {}).data == pytest.approx(x.data, rel=1e-6)
    blind = BayerMosaic(blue=0.0)
    out = correct(blind, forward(blind, flat(50.0, (4, 4), kind=Kind.PHOTONS), stream(rng)), {}).data[0]
    assert np.isfinite(out).all() and (out[1::2, 1::2] == 0).all()


def test_truth_maps_the_colours(rng: np.random.Generator):
    told = truth(BayerMosaic(pattern="BGGR", **SHARES), flat(0.0, (4, 6), kind=Kind.PHOTONS), stream(rng))
    assert told["colour"].tolist() == [[2, 1, 2, 1, 2, 1], [1, 0, 1, 0, 1, 0]] * 2
    assert told["mosaic_share"][1, 1] == 0.5


def test_a_sharp_target_on_an_unbalanced_mosaic_shifts_by_its_checkered_part():
    """Spots of 0.5 px: Σ x I m/Σ I m written out for each of the four places of the pattern."""
    x, y = np.array([12.2, 11.7]), np.array([12.4, 12.0])
    image = spots(x, y, sigma=0.5)
    cell = np.array([[0.5, 0.8], [0.8, 0.2]])
    shifts = []
    for dr in (0, 1):
        for dc in (0, 1):
            row, col = np.indices(image.shape[1:])
            seen = image * cell[(row + dr) % 2, (col + dc) % 2] / 0.65
            plain = (image * col).sum(axis=(1, 2)) / image.sum(axis=(1, 2))
            shifts.append(((seen - image) * (col - plain[:, None, None])).sum(axis=(1, 2)) / image.sum(axis=(1, 2)))
    got = propagate(BayerMosaic(**SHARES), centroid_probe(image, x, y))
    assert got.u_x_px == pytest.approx(np.std(shifts), rel=1e-6)
    assert got.bias_x_px == pytest.approx(np.mean(shifts), abs=1e-9)
