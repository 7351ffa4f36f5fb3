"""The map of the background: against what was put in, closed forms of the cut-off normal distribution, and finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import norm, truncnorm

from pixmetry.locate.detect.background import Background, background, before_clipping

SIDE = 512
Y, X = np.mgrid[:SIDE, :SIDE].astype(float)


def stored(rng: np.random.Generator, light: np.ndarray, noise: float, dtype: type = np.uint8) -> np.ndarray:
    values = light + noise * rng.normal(size=light.shape)
    if np.dtype(dtype).kind == "u":
        values = np.clip(np.rint(values), 0, np.iinfo(dtype).max)
    return values.astype(dtype)


def squares(contrast: float) -> np.ndarray:
    """Targets on a quarter of the frame: squares of 12 px side, 24 px apart."""
    return contrast * ((X % 24 < 12) & (Y % 24 < 12))


SURFACES = {
    "flat": 100 + 0 * X,
    "sloped": 400 + 0.25 * X - 0.2 * Y,
    "vignetted": 1500 * np.cos(np.arctan(np.hypot(X - 256, Y - 256) / 900)) ** 4,
    "lamp": 300 + 100 * np.exp(-((X - 150) ** 2 + (Y - 300) ** 2) / (2 * 200**2)),
}


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("contrast", [0.0, 150.0, -90.0])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_follows_the_surface_whatever_stands_on_it(name: str, contrast: float, dtype: type, rng: np.random.Generator) -> None:
    """Everywhere within a standard deviation, on average within a tenth, and what straight lines between tiles leave of a curve.

    A mean over all pixels would be off by 37 DN.
    """
    light = SURFACES[name]
    left = 32**2 / 8 * np.abs(sum(np.gradient(np.gradient(light, axis=k), axis=k) for k in (0, 1))).max()
    found = background(stored(rng, light + squares(contrast), 3.0, dtype))
    error = found.image() - light
    assert abs(error.mean()) < 0.3 + left
    assert np.abs(error).max() < 3.0 + 2 * left


@pytest.mark.parametrize("noise", [0.5, 1.5, 8.0])
def test_noise_holds_the_rounding(noise: float, rng: np.random.Generator) -> None:
    """Per tile some 190 pixels, 256 tiles: the median of their standard deviations is good to 0.4 %.

    Clipping at three of them is 5 % off for rounded values of 0.5 DN, and the edges of targets add 2 %: 8 % is what is allowed.
    """
    found = background(stored(rng, 100.3 + 0 * X + squares(80), noise))
    assert np.median(found.sigma_dn) == pytest.approx(math.sqrt(noise**2 + 1 / 12), rel=0.08)


def test_noise_is_the_whole_of_correlated_noise(rng: np.random.Generator) -> None:
    """Differences of neighbours would give 0.28 of it."""
    from scipy.ndimage import gaussian_filter

    grain = gaussian_filter(rng.normal(size=X.shape), 2.0)
    found = background((100 + 5 * grain / grain.std()).astype(np.float32))
    assert np.median(found.sigma_dn) == pytest.approx(5.0, rel=0.1)


def test_noise_follows_the_frame(rng: np.random.Generator) -> None:
    """Standard deviation from 2 to 4 from left to right."""
    noise = 2 + 2 * X / SIDE
    found = background(stored(rng, 1000 + noise * rng.normal(size=X.shape), 0.0, np.uint16))
    left, right = found.sigma(np.array([20.0, 490.0]), np.array([256.0, 256.0]))
    assert left == pytest.approx(2.08, rel=0.1)
    assert right == pytest.approx(3.9, rel=0.1)


@pytest.mark.parametrize("level", [0, 10, 255])
def test_without_noise_rounding_is_left(level: int) -> None:
    found = background(np.full((100, 130), level, np.uint8))
    assert np.allclose(found.level_dn, level, atol=0.15)
    assert np.allclose(found.sigma_dn, math.sqrt(1 / 12))


@pytest.mark.parametrize("level", [-3.0, -1.0, 0.0, 0.5])
@pytest.mark.parametrize("upside_down", [False, True])
def test_sees_past_the_end_of_the_scale(level: float, upside_down: bool, rng: np.random.Generator) -> None:
    """Noise 2: at −3 DN one pixel in 25 is stored above 0. Median and spread of the stored values are 0 there."""
    frame = stored(rng, level + 0 * X + squares(150) * (np.hypot(X - 256, Y - 256) < 200), 2.0)
    found = background(255 - frame if upside_down else frame)
    sign, end = (-1, 255) if upside_down else (1, 0)
    assert np.median(found.sigma_dn) == pytest.approx(math.sqrt(4 + 1 / 12), rel=0.15)
    assert sign * (np.median(found.level_dn) - end) == pytest.approx(level, abs=0.6)


@pytest.mark.parametrize("level, sigma, least", [(-2.0, 1.5, 0.5), (0.0, 3.0, 0.0), (-20.0, 14.0, 0.5), (1.0, 2.0, 0.5)])
def test_before_clipping_inverts_the_cut_off_normal_distribution(level: float, sigma: float, least: float) -> None:
    share = norm.sf(least, level, sigma)
    mean = truncnorm.mean((least - level) / sigma, np.inf, level, sigma)
    lone = np.full(40, 1000.0)
    assert before_clipping(lone, lone * share, lone * share * mean, least) == pytest.approx((level, sigma), rel=1e-6)


def test_defects_on_black_are_not_noise(rng: np.random.Generator) -> None:
    """One pixel in 3000 at 200 would be a standard deviation of 40."""
    frame = np.zeros((SIDE, SIDE), np.uint8)
    frame[rng.random(frame.shape) < 1 / 3000] = 200
    assert np.allclose(background(frame).sigma_dn, math.sqrt(1 / 12))


@pytest.mark.parametrize("contrast", [20.0, 150.0, -60.0])
def test_does_not_climb_a_target_that_fills_tiles(contrast: float, rng: np.random.Generator) -> None:
    """Radius 100: a dozen tiles lie inside. Light falls off beneath it."""
    light = 90 + 0.05 * X
    found = background(stored(rng, light + contrast * (np.hypot(X - 260, Y - 240) < 100), 1.5))
    assert np.abs(found.image() - light).max() < 1.5


def test_slopes_are_those_of_the_values(rng: np.random.Generator) -> None:
    ground = Background(rng.normal(100, 10, (5, 7)), np.ones((5, 7)), (160, 224))
    x, y = rng.uniform(-10, 240, 300), rng.uniform(-10, 170, 300)
    inside = (np.abs((x + 0.5) % 32 - 16) > 1e-3) & (np.abs((y + 0.5) % 32 - 16) > 1e-3)  # away from the kinks
    value, slope_x, slope_y = ground.at(x, y)
    h = 1e-4
    assert np.allclose((ground.at(x + h, y)[0] - ground.at(x - h, y)[0])[inside] / (2 * h), slope_x[inside], atol=1e-6)
    assert np.allclose((ground.at(x, y + h)[0] - ground.at(x, y - h)[0])[inside] / (2 * h), slope_y[inside], atol=1e-6)
    middle = ground.at(np.array([32 * 3 + 15.5]), np.array([32 * 2 + 15.5]))[0]
    assert middle == pytest.approx(ground.level_dn[2, 3])


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (300, 1), (7, 5), (47, 49)])
def test_takes_any_shape(shape: tuple[int, int]) -> None:
    found = background(np.full(shape, 42, np.uint16))
    assert np.allclose(found.image(), 42, atol=0.15)


def test_does_not_depend_on_the_number_of_threads(rng: np.random.Generator) -> None:
    frame = stored(rng, SURFACES["lamp"] + squares(100), 2.0, np.uint16)
    one, three = background(frame, threads=1), background(frame, threads=3)
    assert np.array_equal(one.level_dn, three.level_dn)
    assert np.array_equal(one.sigma_dn, three.sigma_dn)
