"""Echoes on the cable against transmission-line arithmetic and a filter written another way."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.special import erfc

from pixmetry.sources.cable.termination import SOURCE, Termination, echoes, near, tail
from video_signals import PIXEL_HZ, bump, centre, row_of, sampled, seen, video


def line(rng: np.random.Generator, row: np.ndarray, params: Termination, pixel_hz: float = PIXEL_HZ) -> np.ndarray:
    return seen(rng, SOURCE, params, row_of(row), pixel_hz=pixel_hz)[0, 0]


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
def test_published_shifts_are_first_moments_of_the_echoes(params: Termination, shift_px: float, rng: np.random.Generator) -> None:
    """Δx = ρτ/(1 − ρ), on the continuous line."""
    expected = params.ghost * params.delay_s * PIXEL_HZ / (1 - params.ghost)
    assert expected == pytest.approx(shift_px, rel=0.03)
    assert moved(params) == pytest.approx(expected, rel=1e-3)
    assert line(rng, bump(), params).sum() == pytest.approx(bump().sum(), rel=1e-5)


def test_a_delay_of_whole_pixels_is_a_recursive_filter(rng: np.random.Generator) -> None:
    """(1 − ρ)/(1 − ρ z^−3) by SciPy."""
    params = Termination(length_m=3.0 / (Termination(length_m=1.0).delay_s * PIXEL_HZ) * (1 - 1e-9), line_ohm=50.0, load_ohm=1000.0)
    row = np.zeros(120)
    row[20:30] = 100.0
    rho = params.ghost
    np.testing.assert_allclose(line(rng, row, params), lfilter([1 - rho], [1, 0, 0, -rho], row), atol=2e-3)


@pytest.mark.parametrize("pixel_hz", [10e6, PIXEL_HZ, 28.4e6])
def test_what_comes_from_beyond_the_margin_is_as_small_as_stated(pixel_hz: float, rng: np.random.Generator) -> None:
    params = SOURCE.bound
    left = near(params, pixel_hz, 0)[2]
    row = np.zeros(left + 400)
    row[0:20] = 1.0  # light that lies farther to the left than the margin
    reached = line(rng, row, params, pixel_hz)[left + 20 :]
    assert 0 < reached.max() <= tail(params, pixel_hz, 0)
    assert len(echoes(params)[0]) > 5


@pytest.mark.parametrize(("skin_db", "error"), [(0.1, 5e-4), (1.0, 1.5e-3), (3.0, 4e-3)])
def test_a_step_through_the_skin_effect_is_the_complementary_error_function(skin_db: float, error: float) -> None:
    """e^(−√(sT)) answers a step by erfc(½ √(T/t)), with 8.686 √(πfT) dB at f = 5 MHz; read 0.02 to 25 µs after the step."""
    params = Termination(line_ohm=75.0, skin_db=skin_db)
    step = np.zeros(420)
    step[20:] = 1.0
    got = sampled(SOURCE.forward(params, video(row_of(step)), None), 4)[0, 0]
    t = (np.arange(len(got)) + 0.5) / (4 * PIXEL_HZ) - 20 / PIXEL_HZ
    scale = (skin_db / 8.685889638) ** 2 / (np.pi * 5e6)
    here = (t > 2e-8) & (t < 25e-6)
    np.testing.assert_allclose(got[here], erfc(0.5 * np.sqrt(scale / t[here])), atol=error)
    assert np.abs(got[t < 0]).max() < 1e-6
    assert got[here].min() < 1 - 0.03 * skin_db  # it is seen


def test_the_loss_grows_as_the_root_of_the_frequency() -> None:
    """100 m of a coaxial cable with 2.4 dB at 5 MHz lose 1.07 dB at 1 MHz and 3.4 dB at 10 MHz; a level keeps its height."""
    on_line = SOURCE.forward(Termination(line_ohm=75.0, skin_db=2.4), video(row_of(np.ones(8))), None).line
    lost = -20 * np.log10(on_line.gain(np.array([1e-3, 1e6, 5e6, 10e6])))
    assert lost == pytest.approx([0.0, 2.4 / np.sqrt(5), 2.4, 2.4 * np.sqrt(2)], abs=0.04)


def test_the_skin_effect_reaches_no_farther_than_stated(rng: np.random.Generator) -> None:
    params = Termination(length_m=5.0, line_ohm=50.0, skin_db=1.0)
    left = near(params, PIXEL_HZ, 0)[2]
    row = np.zeros(left + 400)
    row[0:20] = 1.0
    assert 0 < line(rng, row, params)[left + 20 :].max() <= tail(params, PIXEL_HZ, 0) < 0.1


@pytest.mark.parametrize("loss_db", [0.0, 0.5, 3.0])
def test_an_echo_loses_voltage_on_both_ways(loss_db: float) -> None:
    """An echo goes there and back: twice the loss in dB, 20 lg of the voltage; reflections of 50 Ω between 75 Ω are ρ = 0.2 each."""
    params = Termination(length_m=5.0, line_ohm=50.0, source_ohm=75.0, load_ohm=75.0, loss_db=loss_db)
    assert -20 * np.log10(params.ghost / 0.2**2) == pytest.approx(2 * loss_db, abs=1e-9)
