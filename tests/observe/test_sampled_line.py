"""Gain and noise behind a video line: frames made by NumPy and SciPy, the line on a grid of 12 points a pixel.

The chance that a sound estimator fails is 1e-6 a test (5 u of a normal distribution). A clock that is left out changes the gain by 29 %,
which is 15 u and more.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage, signal

from pixmetry.camera.noise_covariance import LINEAR, NoiseFilter
from pixmetry.camera.stated import StatedFacts
from pixmetry.observe.observe import Group, observe
from pixmetry.observe.sampled_line import folded_share, sampled

ROWS, COLS, GAIN, NOISE_E, ROW_E, OFFSET, POINTS, EVERY = 120, 200, 0.5, 8.0, 4.0, 60.0, 12, 17
Z = 5.0


def frame(rng: np.random.Generator, mean_e: float, every: int) -> np.ndarray:
    """Pixels that are held, two RC stages of 0.3 px, and a sample of every so many points."""
    electrons = rng.poisson(mean_e, (ROWS, COLS)) + rng.normal(0, NOISE_E, (ROWS, COLS)) + rng.normal(0, ROW_E, (ROWS, 1))
    line = np.repeat(electrons, POINTS, axis=1)
    keep = np.exp(-1 / (0.3 * POINTS))
    for _ in range(2):
        line = signal.lfilter([1 - keep], [1, -keep], line, axis=1)
    return np.rint(OFFSET + GAIN * line[:, 20 * POINTS :: every]).astype(np.uint16)


@pytest.mark.parametrize("every", [EVERY, POINTS])
def test_gain_and_noise_of_samples_that_are_not_one_to_a_pixel(rng, every):
    def groups():
        for k in range(1, 9):
            for kind, light in (("dark", 0.0), ("bright", 800.0 * k)):
                yield Group(kind, "level", 0.001 * k, None, [frame(rng, light, every) for _ in range(2)])

    stated = StatedFacts("analogue", pixel_clock_mhz=EVERY, sampling_clock_mhz=EVERY * POINTS / every)
    seen = observe(groups(), 12, stated=stated)
    fit = seen.photon_transfer_fit
    assert seen.noise_filter is not None and seen.noise_filter.along_row
    for name, truth, most in (("gain_dn_per_e", GAIN, 0.04), ("dark_noise_e", NOISE_E, 0.04), ("row_noise_e", ROW_E, 0.12)):
        assert abs(fit[name].value - truth) < Z * fit[name].u
        assert fit[name].u < most * truth


def test_share_that_is_folded_back_is_that_of_the_pole():
    """A pole at 0.4 cycles a pixel, its response on a fine grid by SciPy; the autocovariance of every 17th of 12 points a pixel."""
    points = 24 * POINTS
    keep = np.exp(-2 * np.pi * 0.4 / points)
    response = np.convolve(np.full(points, 1 / points), signal.lfilter([1 - keep], [1, -keep], np.eye(1, 8 * points)[0]))
    held = np.correlate(response, response, "full") * points
    lags = held[(held.size - 1) // 2 % (24 * EVERY) :: 24 * EVERY]
    sign = (-1.0) ** (np.arange(lags.size) - int(np.argmax(lags)))
    share = folded_share(float((lags * sign).sum() / lags.sum()), POINTS / EVERY)
    assert 1 + share == pytest.approx(lags.sum() * EVERY / POINTS, abs=2e-4)


def test_noise_without_correlation_does_not_tell_an_unfiltered_line_from_a_sharp_low_pass():
    found = sampled(NoiseFilter(), 0.7)
    assert found.kind == LINEAR and found.factor == pytest.approx(1 / (0.7 * (1 + folded_share(1.0, 0.7) / 3)))
    assert found.factor - 2.5 * found.u_factor < 1.0 < found.factor


@pytest.mark.parametrize("narrow", [-0.2, 0.2])
def test_noise_in_the_dark_behind_a_line_allows_for_codes_of_unequal_width(rng, narrow):
    """One threshold beside black is displaced by a fifth of a code: the noise changes by up to a tenth, and 13 levels do not show it."""
    thresholds = np.arange(255) + 0.5
    thresholds[5] += narrow

    def digitised(mean_e: float) -> np.ndarray:
        electrons = rng.poisson(mean_e, (ROWS, COLS)) + rng.normal(0, 40.0, (ROWS, COLS)) + rng.normal(0, 10.0, (ROWS, 1))
        line = 5.5 + 0.02 * ndimage.convolve1d(electrons, [0.15, 0.7, 0.15], axis=1, mode="nearest")
        return np.searchsorted(thresholds, line).astype(np.uint8)

    def groups():
        for k in range(1, 14):
            for kind, light in (("dark", 0.0), ("bright", 800.0 * k)):
                yield Group(kind, "level", 0.001 * k, None, [digitised(light) for _ in range(2)])

    fit = observe(groups(), 8, stated=StatedFacts("analogue", pixel_clock_mhz=14.0)).photon_transfer_fit
    for name, truth in (("dark_noise_e", 40.0), ("row_noise_e", 10.0)):
        assert "codes of unequal width" in fit[name].reason
        assert abs(fit[name].value - truth) < Z * fit[name].u and fit[name].u < 0.15 * truth
