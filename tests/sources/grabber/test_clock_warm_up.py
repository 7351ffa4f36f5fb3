"""Warm-up of the sampling clock against a clock simulated tick by tick, and the published sizes."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.sources.grabber.clock_warm_up import SOURCE, ClockWarmUp, truth
from source_signals import stream
from video_signals import PIXEL_HZ, bump, centre, row_of, sampled, video

COLUMNS = np.array([112.0, 288.0, 464.0, 640.0])  # a grid of four columns of targets over 752 pixels


def shifts(params: ClockWarmUp, time_s: float = 0.0) -> np.ndarray:
    """What targets in four columns move by."""
    out = []
    for c in COLUMNS:
        before = video(row_of(bump(c, 752, 4.0)), smooth=True, time_s=time_s)
        out.append((centre(sampled(SOURCE.forward(params, before, None), 8)) - centre(sampled(before, 8)))[0, 0] / 8)
    return np.array(out)


def test_a_clock_that_is_locked_at_the_line_start_and_ticks_too_fast() -> None:
    """Tick by tick: sample n of a clock of f (1 + δ) that starts c0 before the first pixel, numbered so that a good one fits."""
    params = ClockWarmUp(scale_error_rel=0.0071)
    ticks = (np.arange(2000) + 0.5) / (PIXEL_HZ * 1.0071)  # since the lock
    at_px = (ticks - 10.5e-6) * PIXEL_HZ  # where on the line
    number = np.arange(2000) + 0.5 - 10.5e-6 * PIXEL_HZ
    expected = np.interp(COLUMNS + 0.5, at_px, number) - (COLUMNS + 0.5)
    late = 2 * 0.87 / (2 * np.pi * 4e6) * PIXEL_HZ  # the smoothing filter is stretched too
    np.testing.assert_allclose(shifts(params), expected + 0.0071 * late, atol=2e-3)


def test_published_four_pixels() -> None:
    """δ0 = 0.71 % locked 149 px before the first pixel, or a pure delay of 282 ns: 4 px RMS on a grid of four columns."""
    assert pytest.approx(149, abs=0.1) == 10.5e-6 * PIXEL_HZ
    for params in (ClockWarmUp(scale_error_rel=0.0071), ClockWarmUp(delay_ns=282.0)):
        assert np.sqrt((shifts(params) ** 2).mean()) == pytest.approx(4.0, abs=0.03)


def test_published_times_to_stability() -> None:
    """τ = 13.7 min: 0.05 px after 60 minutes and 0.006 px after 90."""
    params = ClockWarmUp(scale_error_rel=0.0071, scale_tau_s=13.7 * 60)
    assert np.sqrt((shifts(params, 3600.0) ** 2).mean()) == pytest.approx(0.05, abs=0.002)
    assert np.sqrt((shifts(params, 5400.0) ** 2).mean()) == pytest.approx(0.006, abs=0.001)
    later = params.model_copy(update={"on_for_s": 3600.0})
    np.testing.assert_allclose(shifts(later), shifts(params, 3600.0))


def test_the_truth_is_what_targets_do(rng: np.random.Generator) -> None:
    params = ClockWarmUp(scale_error_rel=0.005, delay_ns=-80.0)
    told = truth(params, video(np.zeros((1, 3, 752)), time_s=100.0), stream(rng))
    # told at the column of a sample, not of the target, and the smoothing filter is stretched too: 0.005 of 3.5 px
    np.testing.assert_allclose(told["col_shift_px"][0, COLUMNS.astype(int)], shifts(params, 100.0), atol=0.018)
    assert told["row_shift_px"].shape == (1, 3)
    assert told["row_shift_px"][0, 0] == pytest.approx(told["col_shift_px"].mean(), rel=1e-6)
