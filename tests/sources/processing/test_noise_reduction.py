"""Spatial noise reduction against SciPy's filters and a bilateral filter written pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, median_filter

from pixmetry.sources.processing.noise_reduction import NoiseReduction, forward
from source_signals import stream
from sources.processing.code_frames import codes, disc, soft_centroid


def reduced(rng: np.random.Generator, image: np.ndarray, **kw) -> np.ndarray:
    return forward(NoiseReduction(**kw), codes(image), stream(rng)).data[0].astype(float)


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_median_is_scipys(radius, rng: np.random.Generator):
    image = rng.integers(0, 65536, (23, 19))
    want = median_filter(image, size=2 * radius + 1, mode="mirror")
    assert np.array_equal(reduced(rng, image, method="median", radius_px=radius, bits=16), want)


@pytest.mark.parametrize(("radius", "sigma"), [(1, 0.6), (3, 1.0), (5, 2.5)])
def test_gaussian_is_scipys(radius, sigma, rng: np.random.Generator):
    image = rng.integers(0, 60_000, (23, 19)).astype(float)
    want = gaussian_filter(image, sigma, radius=radius, mode="mirror")
    assert np.abs(reduced(rng, image, method="gaussian", radius_px=radius, sigma_px=sigma, bits=16) - want).max() <= 0.5 + 1e-6


def test_bilateral_pixel_by_pixel(rng: np.random.Generator):
    image = rng.integers(80, 160, (12, 11)).astype(float)
    m, sigma, likeness = 2, 1.3, 25.0
    padded = np.pad(image, m, mode="reflect")
    want = np.empty_like(image)
    for r in range(12):
        for c in range(11):
            total = weight = 0.0
            for dr in range(-m, m + 1):
                for dc in range(-m, m + 1):
                    v = padded[r + m + dr, c + m + dc]
                    w = np.exp(-(dr**2 + dc**2) / (2 * sigma**2) - (v - image[r, c]) ** 2 / (2 * likeness**2))
                    total, weight = total + w * v, weight + w
            want[r, c] = total / weight
    got = reduced(rng, image, method="bilateral", radius_px=m, sigma_px=sigma, range_dn=likeness)
    assert np.abs(got - want).max() <= 0.5 + 1e-6


def test_an_edge_stays_sharp_under_the_bilateral_filter_alone(rng: np.random.Generator):
    image = np.where(np.arange(20) < 10, 50, 200) * np.ones((9, 1))
    assert np.array_equal(reduced(rng, image, method="bilateral", radius_px=2, range_dn=8.0), image)
    assert np.abs(reduced(rng, image, method="gaussian", radius_px=2) - image).max() > 30


def test_a_point_vanishes_under_the_median_and_a_small_target_shifts(rng: np.random.Generator):
    point = np.zeros((15, 15))
    point[7, 7] = 200
    assert not reduced(rng, point, method="median").any()
    errors = []
    for x, y in rng.uniform(-0.5, 0.5, (200, 2)):
        image = np.rint(disc(x, y, 3.0, blur=0.5))
        errors.append(soft_centroid(reduced(rng, image, method="median"), 8.0)[0] - soft_centroid(image, 8.0)[0])
    assert 0.01 < np.std(errors) < 0.1
