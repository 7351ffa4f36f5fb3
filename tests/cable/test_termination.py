"""Echoes on the cable against transmission-line arithmetic and a filter written another way."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from pixmetry.cable.termination import SOURCE, Termination, echoes, near, tail
from pixmetry.core.signal import Kind
from source_signals import signal, stream


def line(row: np.ndarray, params: Termination) -> np.ndarray:
    data = np.repeat(row[None, None, :], 2, axis=1).astype(np.float32)
    return SOURCE.forward(params, signal(data, Kind.DN, frame_shape=data.shape[1:]), stream()).data[0, 0].astype(float)


def test_published_reflection_and_delay_of_five_metres_of_50_ohm_cable() -> None:
    """Γ = (75 − 50)/(75 + 50) at both ends; 10.1 ns per metre there and back at 0.66 c, at 14.1875 MHz."""
    params = Termination(length_m=5.0, line_ohm=50.0)
    assert params.ghost == pytest.approx(0.04)
    assert params.delay_px == pytest.approx(5 * 10.108e-9 * 14.1875e6, rel=1e-3)


@pytest.mark.parametrize(
    "params", [SOURCE.typical, SOURCE.bound, Termination(length_m=2.0, line_ohm=50.0)], ids=["5 m", "20 m open", "2 m"]
)
def test_a_target_moves_by_the_first_moment_of_its_echoes(params: Termination) -> None:
    """Δx = ρτ/(1 − ρ): 0.030 px for 5 m of 50 Ω between 75 Ω ends."""
    x = np.arange(400)
    target = 150 * np.exp(-0.5 * ((x - 100) / 2.0) ** 2)
    seen = line(target, params)
    expected = params.ghost * params.delay_px / (1 - params.ghost)
    assert (seen * x).sum() / seen.sum() - 100 == pytest.approx(expected, rel=2e-4, abs=2e-5)
    assert seen.sum() == pytest.approx(target.sum(), rel=1e-5)


def test_a_delay_of_whole_pixels_is_a_recursive_filter() -> None:
    """(1 − ρ)/(1 − ρ z^−3) by SciPy."""
    delay_of_1_m = Termination(length_m=1.0).delay_px
    params = Termination(length_m=3.0 / delay_of_1_m, line_ohm=50.0, load_ohm=1000.0)
    assert params.delay_px == pytest.approx(3.0, abs=1e-9)
    row = np.zeros(120)
    row[20:30] = 100.0
    rho = params.ghost
    np.testing.assert_allclose(line(row, params), lfilter([1 - rho], [1, 0, 0, -rho], row), atol=2e-3)


def test_the_correction_takes_the_echoes_out() -> None:
    x = np.arange(200)
    target = 150 * np.exp(-0.5 * ((x - 80) / 2.0) ** 2)
    for params in (SOURCE.typical, SOURCE.bound):
        ghosted = signal(line(target, params)[None, None, :].astype(np.float32), Kind.DN, frame_shape=(1, 200))
        back = SOURCE.correct(params, ghosted, {}).data[0, 0]
        assert np.abs(back - target).max() < 0.02 * np.abs(line(target, params) - target).max()


def test_what_comes_from_beyond_the_margin_is_as_small_as_stated() -> None:
    params = SOURCE.bound
    left = near(params)[2]
    row = np.zeros(left + 400)
    row[0:20] = 1.0  # light that lies farther to the left than the margin
    reached = line(row, params)[left + 20 :]
    assert reached.max() <= tail(params)
    assert echoes(params) > 5
