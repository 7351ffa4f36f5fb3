"""Gain of the taps: where the borders lie, the shift of a disc on one in closed form, the slope and the way back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pixmetry.camera.signal import Kind
from pixmetry.sources.electronics.tap_gain import TapGain, correct, forward, propagate, truth
from source_signals import centroid, centroid_probe, signal, spots, stream


def row(rng: np.random.Generator, params: TapGain, values, col0: int = 0, cols: int | None = None) -> np.ndarray:
    data = np.reshape(np.asarray(values, float), (1, 1, -1))
    return forward(params, signal(data, Kind.DN, col0=col0, frame_shape=(1, cols or data.shape[2])), stream(rng)).data[0, 0].astype(float)


def test_three_taps_over_ten_columns_and_stripes_by_hand(rng: np.random.Generator):
    got = row(rng, TapGain(taps=3, step_rel=0.02, odd_even_rel=0.004), [100] * 10)
    tap = [99, 99, 99, 99, 101, 101, 101, 99, 99, 99]
    assert got == pytest.approx([t + (0.2 if c % 2 else -0.2) for c, t in enumerate(tap)], abs=1e-4)


def test_the_place_in_the_frame_decides_not_that_in_the_window(rng: np.random.Generator):
    params = TapGain(taps=2, step_rel=0.02, odd_even_rel=0.01)
    assert np.array_equal(row(rng, params, [100] * 5, col0=7, cols=20), row(rng, params, [100] * 20)[7:12])


def test_border_through_the_middle_of_a_disc(rng: np.random.Generator):
    """Half the disc has its centre 2D/(3π) away: Δ = Δg D/(3π) = 0.743 px · Δg for 7 px; 0.0074 px for 1 %.

    The centroid puts a pixel's light at its middle: on a raster of 1/16 px that adds nothing visible, on whole pixels 2 %.
    """
    fine = (np.arange(16 * 16) + 0.5) / 16 - 8
    disc = 150.0 * (np.hypot(fine, fine[:, None]) <= 3.5)
    image = forward(TapGain(taps=2, step_rel=0.01), signal(disc[None], Kind.DN), stream(rng)).data.astype(float)
    dx, dy = ((v[0] - 127.5) / 16 for v in centroid(image))
    assert dx == pytest.approx(0.01 * 7 / (3 * math.pi), rel=0.01)
    assert dx == pytest.approx(0.0074, abs=1e-4)
    assert dy == pytest.approx(0.0, abs=1e-6)


def test_the_gain_grows_to_the_reference_and_no_further_on_both_sides_of_black(rng: np.random.Generator):
    params = TapGain(taps=1, slope_rel=0.02, reference_dn=1000.0)
    got = row(rng, params, [0, 500, 1000, 2000, -500, -2000])
    assert got == pytest.approx([0, 505, 1020, 2040, -495, -1960], rel=1e-6)


def test_it_is_undone(rng: np.random.Generator):
    params = TapGain(taps=4, step_rel=0.03, odd_even_rel=-0.01, slope_rel=0.05, reference_dn=1000.0)
    x = signal(rng.uniform(-3000, 3000, (2, 20, 50)), Kind.DN)
    assert correct(params, forward(params, x, stream(rng)), {}).data == pytest.approx(x.data, abs=2e-3)


def test_truth_names_tap_and_gain_of_every_column(rng: np.random.Generator):
    params = TapGain(taps=2, step_rel=0.02)
    told = truth(params, signal(np.zeros((1, 2, 6)), Kind.DN), stream(rng))
    assert told["tap"].tolist() == [0, 0, 0, 1, 1, 1]
    assert 100 * told["gain"] == pytest.approx(row(rng, params, [100] * 6))


def test_predicted_scatter_is_the_mean_over_all_places_of_the_border():
    """Brute force: the spot stays, the frame of 101 columns with its one border is moved past it, pixel by pixel."""
    x = np.array([12.3])
    image = spots(x, np.array([12.0]))
    params = TapGain(taps=2, step_rel=0.02)
    shifts = np.zeros(101)
    for border in range(1, 25):
        gain = np.where(np.arange(25) >= border, 1.01, 0.99)
        shifts[border] = centroid(image * gain)[0][0] - centroid(image)[0][0]
    got = propagate(params, centroid_probe(image, x, np.array([12.0]), frame_shape=(80, 101)))
    assert got.bias_x_px == pytest.approx(shifts.mean(), rel=0.01)
    assert got.u_x_px == pytest.approx(shifts.std(), rel=0.01)
    assert got.kurtosis == pytest.approx((shifts**4).mean() / (shifts**2).mean() ** 2, rel=0.02)  # of few targets: far from 3
