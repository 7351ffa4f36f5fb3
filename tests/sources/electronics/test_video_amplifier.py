"""Overshoot, ringing and delay of a second-order stage against their closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.sources.electronics.video_amplifier import SOURCE, VideoAmplifier
from video_signals import PIXEL_HZ, bump, centre, row_of, sampled, video


def step(params: VideoAmplifier, fine: int = 32) -> np.ndarray:
    """Response to an edge of height 1 at pixel 0, ``fine`` samples a pixel."""
    return sampled(SOURCE.forward(params, video(row_of(np.ones(60))), None), fine)[0, 0]


def test_the_step_response_is_the_damped_oscillation() -> None:
    params = VideoAmplifier(natural_mhz=5.0, damping=0.25)
    t = (np.arange(60 * 32) + 0.5) / 32 / PIXEL_HZ
    w, z = 2e6 * np.pi * params.natural_mhz, params.damping
    wd = w * np.sqrt(1 - z**2)
    expected = 1 - np.exp(-z * w * t) * (np.cos(wd * t) + z / np.sqrt(1 - z**2) * np.sin(wd * t))
    np.testing.assert_allclose(step(params), expected, atol=1e-6)


@pytest.mark.parametrize("damping", [0.2, 0.25, 0.3, 0.7])
def test_it_overshoots_by_the_textbook_share(damping: float) -> None:
    params = VideoAmplifier(natural_mhz=5.0, damping=damping)
    assert step(params).max() - 1 == pytest.approx(params.overshoot, abs=1e-3)
    assert params.overshoot == pytest.approx(np.exp(-np.pi * damping / np.sqrt(1 - damping**2)))


@pytest.mark.parametrize("damping", [1.0, 3.0])
def test_critical_and_strong_damping_do_not_overshoot(damping: float) -> None:
    rise = step(VideoAmplifier(natural_mhz=5.0, damping=damping))
    assert (np.diff(rise) > -1e-6).all() and rise[-1] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(("damping", "shift_px"), [(0.2, 0.18), (0.3, 0.27)])
def test_published_shift_without_clipping(damping: float, shift_px: float) -> None:
    """2ζ/ω0 at f0 = 5 MHz and 14.1875 MHz."""
    params = VideoAmplifier(natural_mhz=5.0, damping=damping)
    before = video(row_of(bump()))
    shift = (centre(sampled(SOURCE.forward(params, before, None), 64)) - centre(sampled(before, 64)))[0, 0] / 64
    assert shift == pytest.approx(2 * damping / (2 * np.pi * 5e6) * PIXEL_HZ, rel=2e-3)
    assert shift == pytest.approx(shift_px, abs=0.005)
