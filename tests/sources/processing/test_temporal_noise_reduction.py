"""Temporal noise reduction: SciPy's recursive filter, the lag of a moving spot and the noise in closed form, sequences and windows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from pixmetry.sources.processing.temporal_noise_reduction import TemporalNoiseReduction, forward, start
from source_signals import Z, centroid, spots, stream
from sources.processing.code_frames import codes


def filtered(rng: np.random.Generator, frames: np.ndarray, alpha: float, bits: int = 16) -> np.ndarray:
    params = TemporalNoiseReduction(alpha=alpha, bits=bits)
    return forward(params, codes(frames), stream(rng), start(params))[0].data.astype(float)


def test_it_is_a_recursive_filter_of_first_order_that_starts_with_the_first_frame(rng: np.random.Generator):
    frames = rng.integers(0, 60_000, (30, 4, 5)).astype(float)
    want = lfilter([0.3], [1, -0.7], frames, axis=0, zi=0.7 * frames[:1])[0]
    assert np.abs(filtered(rng, frames, 0.7) - want).max() <= 0.5 + 1e-6


@pytest.mark.parametrize("alpha", [0.3, 0.5, 0.8])
def test_a_moving_spot_lags_by_its_velocity_times_alpha_over_one_less_alpha(alpha, rng: np.random.Generator):
    """Δ = v α/(1 − α) T_f: the mean age of the light; 0.4 px a frame."""
    v, n = 0.4, 90
    x = 12 + v * np.arange(n)
    frames = np.rint(spots(x, np.full(n, 30.0), size=61, sigma=2.0, peak=30_000.0))
    out = filtered(rng, frames, alpha)
    last = centroid(out[-1:])[0][0]
    assert x[-1] - last == pytest.approx(v * alpha / (1 - alpha), abs=2e-3)


def test_noise_falls_and_frames_become_alike(rng: np.random.Generator):
    """Variance (1 − α)/(1 + α), correlation of neighbours α; 20 independent stretches of 40 000 pixels: 3 % at 1e-6."""
    alpha = 0.6
    frames = np.rint(rng.normal(30_000, 500, (40, 100, 100)))
    out = filtered(rng, frames, alpha)[20:] - 30_000
    one = np.sqrt(2 / 10_000) * Z
    assert out[-1].var() / 500**2 == pytest.approx((1 - alpha) / (1 + alpha), rel=1.05 * one)
    assert np.mean(out[-1] * out[-2]) / out[-1].var() == pytest.approx(alpha, abs=one)


def test_a_sequence_may_be_cut_anywhere(rng: np.random.Generator):
    frames = rng.integers(0, 4000, (9, 6, 7))
    params = TemporalNoiseReduction(alpha=0.5, bits=12)
    first, state = forward(params, codes(frames[:4]), stream(rng), start(params))
    second, _ = forward(params, codes(frames[4:]), stream(rng), state)
    assert np.array_equal(np.concatenate([first.data, second.data]), filtered(rng, frames, 0.5, 12))


def test_windows_on_a_settled_frame_are_mixed_with_their_part_of_it(rng: np.random.Generator):
    params = TemporalNoiseReduction(alpha=0.75)
    settled = np.arange(20 * 30, dtype=float).reshape(20, 30) / 3
    window = np.full((1, 4, 5), 100)
    got, _ = forward(params, codes(window, row0=6, col0=11, frame_shape=(20, 30)), stream(rng), settled)
    assert np.array_equal(got.data[0], np.floor(0.75 * settled[6:10, 11:16] + 25 + 0.5))


def test_without_a_share_there_is_no_memory():
    assert start(TemporalNoiseReduction()) is None
