"""Echoes on the cable against transmission-line arithmetic and a filter written another way."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from pixmetry.cable.termination import SOURCE, Termination, echoes, near, tail
from pixmetry.core.signal import Kind
from source_signals import signal
from video_signals import PIXEL_HZ, bump, centre, row_of, sampled, seen, video


def line(row: np.ndarray, params: Termination) -> np.ndarray:
    return seen(SOURCE, params, row_of(row))[0, 0]


def moved(params: Termination) -> float:
    """Shift of a target on the line, behind a filter that makes it smooth."""
    before = video(row_of(bump()), smooth=True)
    return float(centre(sampled(SOURCE.forward(params, before, None), 16))[0, 0] / 16 - centre(sampled(before, 16))[0, 0] / 16)


def test_published_reflection_and_delay_of_five_metres_of_50_ohm_cable() -> None:
    """Γ = (75 − 50)/(75 + 50) at both ends; 10.1 ns per metre there and back at 0.66 c: 0.72 px at 14.1875 MHz."""
    params = Termination(length_m=5.0, line_ohm=50.0)
    assert params.ghost == pytest.approx(0.04)
    assert params.delay_s == pytest.approx(5 * 10.108e-9, rel=1e-3)
    assert params.delay_s * PIXEL_HZ == pytest.approx(0.72, abs=0.005)


@pytest.mark.parametrize(
    ("params", "shift_px"),
    [
        (SOURCE.typical, 0.030),
        (Termination(length_m=2.0, line_ohm=50.0), 0.012),
        (Termination(length_m=5.0, line_ohm=50.0, load_ohm=1000.0), 0.16),
        (SOURCE.bound, 0.634),
    ],
    ids=["5 m", "2 m", "5 m open", "20 m open"],
)
def test_published_shifts_are_first_moments_of_the_echoes(params: Termination, shift_px: float) -> None:
    """Δx = ρτ/(1 − ρ), on the continuous line."""
    expected = params.ghost * params.delay_s * PIXEL_HZ / (1 - params.ghost)
    assert expected == pytest.approx(shift_px, rel=0.03)
    assert moved(params) == pytest.approx(expected, rel=1e-3)
    assert line(bump(), params).sum() == pytest.approx(bump().sum(), rel=1e-5)


def test_a_delay_of_whole_pixels_is_a_recursive_filter() -> None:
    """(1 − ρ)/(1 − ρ z^−3) by SciPy."""
    params = Termination(length_m=3.0 / (Termination(length_m=1.0).delay_s * PIXEL_HZ) * (1 - 1e-9), line_ohm=50.0, load_ohm=1000.0)
    row = np.zeros(120)
    row[20:30] = 100.0
    rho = params.ghost
    np.testing.assert_allclose(line(row, params), lfilter([1 - rho], [1, 0, 0, -rho], row), atol=2e-3)


def test_the_correction_gives_the_pixels_back() -> None:
    target = np.random.default_rng(1).uniform(0, 200, 200).astype(np.float32)
    for params in (SOURCE.typical, SOURCE.bound):
        ghosted = signal(row_of(line(target, params)), Kind.DN, frame_shape=(1, 200))
        np.testing.assert_allclose(SOURCE.correct(params, ghosted, {}).data[0, 0], target, atol=2e-4)


def test_what_comes_from_beyond_the_margin_is_as_small_as_stated() -> None:
    params = SOURCE.bound
    left = near(params)[2]
    row = np.zeros(left + 400)
    row[0:20] = 1.0  # light that lies farther to the left than the margin
    reached = line(row, params)[left + 20 :]
    assert 0 < reached.max() <= tail(params)
    assert len(echoes(params)[0]) > 5
