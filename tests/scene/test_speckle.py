"""Speckle against its known statistics: contrast, grain, and the scatter of the centre of a spot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j0
from scipy.stats import chi2

from pixmetry.camera.light import Light, Points
from pixmetry.core.random import Grid
from pixmetry.scene.picture import Picture
from pixmetry.scene.speckle import Speckle, _weights
from pixmetry.scene.uniform import Uniform

SHAPE = (48, 48)
FINEST = 0.67 * 16 / 8.6  # px: f/16, 0.67 µm, pixels of 8.6 µm
Z = 4.9  # two-sided rate of false failures 1e-6


def exposed(spot: Speckle, numbers) -> np.ndarray:
    n = len(numbers)
    return Picture((spot,)).photons(Grid.whole(numbers, SHAPE), SHAPE, np.full(n, 0.01), np.zeros(n)).astype(float)


def scatter(seed: int, profile: str, radius: float, count: int) -> float:
    """Root mean square of the centre over x and y, as a part of Dorsch's λN/π."""
    y, x = np.indices(SHAPE)
    spot = Speckle(23.5, 23.5, radius, 1000.0, FINEST, profile, seed=seed)
    images = exposed(spot, range(count))
    total = images.sum(axis=(1, 2))
    found = [(images * v).sum(axis=(1, 2)) / total for v in (x, y)]
    return float(np.sqrt(np.mean([np.var(v, ddof=1) for v in found])) / (FINEST / np.pi))


@pytest.mark.parametrize(("profile", "radius", "law"), [("gaussian", 8.0, 2**-0.5), ("uniform", 8.0, 1.0)])
def test_the_centre_scatters_as_the_law_of_speckle_says(profile: str, radius: float, law: float, seed: int) -> None:
    """Var = (4/π)(λN)² ∫x²I² / (∫I)² for a spot of many grains: λN/(√2 π) Gaussian, λN/π uniform.

    Spots of a few grains scatter up to a tenth less. 250 realisations with two axes tell the deviation to 3.2 %: at a rate of 1e-6, an
    error of a third is found.
    """
    u = 1 / np.sqrt(2 * 2 * 249)
    found = scatter(seed, profile, radius, 250)
    assert law * 0.88 * (1 - Z * u) < found < law * 1.02 * (1 + Z * u)


@pytest.mark.parametrize("contrast", [1.0, 0.6])
def test_contrast_and_grain_of_the_field(contrast: float, seed: int) -> None:
    """Standard deviation over mean; grain ∫|µ|² = 4/π (λN)² (Goodman).

    The scatter between realisations gives the tolerances, at 1e-6 each. A contrast wrong by a tenth is found, and a grain by a factor 1.9:
    that is told by the variance of the mean over a square, C² grain / area, up to a tenth for the grains on its sides.
    """
    count = 150
    spot = Speckle(23.5, 23.5, 14.0, 1.0, FINEST, "uniform", contrast, seed=seed)
    half = int(7.0 / spot.step_px)
    part = slice(spot.side // 2 - half, spot.side // 2 + half)
    fields = np.stack([spot.intensity(k)[part, part] for k in range(count)])
    expected = replace(spot, contrast=0.0).intensity(0)[part, part]  # diffraction takes 2 % out of the spot
    assert expected.mean() == pytest.approx(0.981, abs=0.004)
    mean, square = fields.mean(axis=(1, 2)), (fields**2).mean(axis=(1, 2)) / (expected**2).mean()
    assert mean.mean() == pytest.approx(expected.mean(), abs=Z * mean.std(ddof=1) / np.sqrt(count) + 1e-3)
    excess = square - 1.0
    u = excess.std(ddof=1) / np.sqrt(count)
    assert u < 0.04 * contrast**2 + 0.01 * contrast
    assert excess.mean() == pytest.approx(contrast**2, abs=Z * u + 0.01)
    grain = mean.var(ddof=1) * (2 * half * spot.step_px) ** 2 / contrast**2 / (4 / np.pi * FINEST**2)
    low, high = chi2.ppf([5e-7, 1 - 5e-7], count - 1) / (count - 1)
    assert 0.85 * low < grain < 1.02 * high, grain


@pytest.mark.parametrize("contrast", [1.0, 0.9, 0.7, 0.5, 0.3, 0.1])
def test_patterns_are_weighed_to_the_contrast(contrast: float) -> None:
    weights = _weights(contrast)
    assert (weights > 0).all()
    assert weights.sum() == pytest.approx(1.0)
    assert (weights**2).sum() == pytest.approx(contrast**2)


def test_without_coherence_the_spot_is_smooth_and_stands_still() -> None:
    """The Gaussian spot through the transfer function of a round pupil, 2/π (acos ρ − ρ √(1 − ρ²)) at ρ = f λN: a Hankel integral."""
    spot = Speckle(23.2, 23.9, 8.0, 1000.0, FINEST, contrast=0.0)
    assert not spot.moving
    r = np.array([0.0, 2.0, 4.0, 6.0, 9.0])
    f = (np.arange(4000) + 0.5) / 4000 / FINEST
    rho = f * FINEST
    transfer = 2 / np.pi * (np.arccos(rho) - rho * np.sqrt(1 - rho**2)) * 32 * np.pi * np.exp(-((np.pi * f * 8.0) ** 2) / 2)
    truth = 1000 * 2 * np.pi * (transfer * f * j0(2 * np.pi * f * r[:, None])).sum(axis=1) * (f[1] - f[0])
    x, y = 23.2 + r * np.cos(0.4), 23.9 + r * np.sin(0.4)
    seen = Picture((spot,)).radiance(Points(x, y, 0 * r, 0 * r + 0.01, np.zeros(5, int), 0.0, SHAPE))
    np.testing.assert_allclose(seen, truth, atol=1.5)  # the pupil on a raster


def test_frames_see_new_speckle_when_they_should(seed: int) -> None:
    a, b, c = exposed(Speckle(23.5, 23.5, 8.0, 1000.0, FINEST, frames_each=2, seed=seed), [0, 1, 2])
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 100
    other = exposed(Speckle(23.5, 23.5, 8.0, 1000.0, FINEST, frames_each=2, seed=seed + 1), [0])[0]
    assert np.abs(a - other).max() > 100
    for same in exposed(Speckle(23.5, 23.5, 8.0, 1000.0, FINEST, frames_each=0, seed=seed), [0, 7]):
        np.testing.assert_array_equal(same, a)


def test_windows_equal_the_frame_and_pixels_are_averages_of_points(seed: int) -> None:
    scene = Picture((Speckle(23.2, 24.1, 7.0, 1000.0, FINEST, seed=seed),), Uniform(20.0))
    zero, exposure = np.zeros(1), np.full(1, 0.01)
    whole = scene.photons(Grid.whole([3], SHAPE), SHAPE, exposure, zero)[0]
    window = scene.photons(Grid([3], [18], [15], (9, 14)), SHAPE, exposure, zero)[0]
    np.testing.assert_array_equal(window, whole[18:27, 15:29])
    nodes, weights = np.polynomial.legendre.leggauss(9)
    for r, c in ((24, 23), (20, 27), (28, 18)):
        x, y = np.broadcast_arrays(c + nodes / 2, r + nodes[:, None] / 2)
        at = Points(x, y, 0 * x, 0 * x + 0.01, np.full(x.shape, 3), 0.0, SHAPE)
        mean = (scene.radiance(at) * np.outer(weights, weights)).sum() / 4
        assert mean == pytest.approx(whole[r, c], abs=0.2)  # 1e-4 of the brightest grains


def test_through_a_map_that_shifts_by_a_pixel_the_spot_is_a_pixel_further(seed: int) -> None:
    scene = Picture((Speckle(23.2, 24.1, 7.0, 1000.0, FINEST, seed=seed),))
    light = Light(scene, Grid.whole([3], SHAPE), SHAPE, np.full(1, 0.01), np.zeros(1))
    plain, moved = light.photons()[0], light.moved(lambda x, y: (x - 1.0, y)).photons()[0]
    np.testing.assert_allclose(moved[:, 1:], plain[:, :-1], atol=0.2)
