"""The search for defect pixels: false alarms as many as stated, also where a converter is coarse for the noise before it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pixmetry.camera.observations import StackMoments
from pixmetry.observe.defects import find_defects, rounding_error_dn
from pixmetry.observe.stack import StackAccumulator

ALPHA = 1e-6  # false-failure rate, for any seed


def stack(rng: np.random.Generator, mean: np.ndarray, noise: float, frames: int = 16) -> StackMoments:
    """Moments of 8-bit frames."""
    accumulator = StackAccumulator(8)
    for _ in range(frames):
        accumulator.add(np.rint(mean + rng.normal(0, noise, mean.shape)).clip(0, 255).astype(np.uint16))
    return accumulator.result(0.01)


@pytest.mark.parametrize("noise", [0.02, 0.125, 0.3])
@pytest.mark.parametrize("offset", [5.0, 5.3, 5.47])
def test_a_coarse_converter_makes_no_defects(noise: float, offset: float, rng: np.random.Generator):
    """Poisson, ALPHA, with 0.01 expected a frame: no more than 3 in 6 frames; planted pixels above the stated limit are found."""
    shape, count = (120, 160), 0
    for dsnu in (0.02, 0.1, 0.25, 0.25, 0.4, 0.6):
        dark = offset + rng.normal(0, dsnu, shape) + rng.normal(0, 0.05, (1, shape[1]))
        bright = dark + 120 * (1 + rng.normal(0, 0.01, shape))
        dark[10, 20] += 12
        found = find_defects(stack(rng, dark, noise), stack(rng, bright, np.hypot(noise, 1.1)))
        places = set(zip(found.row.tolist(), found.col.tolist(), strict=True))
        assert found.dark_limit_dn < 6.5 and (10, 20) in places
        count += len(places) - 1
    assert count <= stats.poisson.isf(ALPHA, 6 * 0.01)


@pytest.mark.parametrize("shape", [(24, 200), (60, 90), (160, 160)])
def test_false_alarms_do_not_depend_on_the_frame(shape: tuple[int, int], rng: np.random.Generator):
    """Gaussian pixels, 4 expected a frame, 25 frames: Poisson, ALPHA, about a rate 0.8 to 1.2 times as stated."""
    count = 0
    for _ in range(25):
        dark = 30 + rng.normal(0, 2, shape) + rng.normal(0, 0.5, (shape[0], 1)) + rng.normal(0, 0.5, (1, shape[1]))
        bright = dark + 150 * (1 + rng.normal(0, 0.02, shape))
        count += len(find_defects(stack(rng, dark, 1.0), stack(rng, bright, 2.0), expected_false=4.0, surface_degree=2))
    assert stats.poisson.ppf(ALPHA / 2, 80) <= count <= stats.poisson.isf(ALPHA / 2, 120), count


@pytest.mark.parametrize("noise", [0.1, 0.2, 0.3, 0.45])
def test_rounding_error_is_bounded(noise: float, rng: np.random.Generator):
    """The largest |E round(x + n) − x| over the phase, from the normal distribution function; the bound is from the variance.

    That of the codes, σ² + 1/12, is known from 20 000 pixels of 15 degrees of freedom each; the bound goes as exp(−2π²σ²).
    """
    x = np.linspace(0, 1, 201)
    codes = np.arange(-4, 6)
    mean = stats.norm.sf((codes[None, :] - 0.5 - x[:, None]) / noise).sum(axis=1) + codes[0] - 1
    worst = np.abs(mean - x).max()
    bound = rounding_error_dn(stack(rng, 5 + np.tile(np.linspace(0, 1, 200), (100, 1)), noise))
    chance = 2 * np.pi**2 * (noise**2 + 1 / 12) * np.sqrt(2 / (20_000 * 15))
    assert worst <= bound * (1.005 + stats.norm.isf(ALPHA / 4) * chance) and bound <= 0.5


def test_hot_pixels_that_clip_in_the_light_are_hot_and_not_dead(rng: np.random.Generator):
    """40 pixels with 180 DN of dark charge under 120 DN of uneven light end at the top code; 20 dead ones and 5 that are both stay dead."""
    shape = (120, 160)
    places = rng.choice(shape[0] * shape[1], 65, replace=False)
    extra, response = np.zeros(shape[0] * shape[1]), np.ones(shape[0] * shape[1])
    extra[places[:40]], response[places[40:]], extra[places[60:]] = 180.0, 0.1, 40.0
    fall = 1 - 0.4 * (np.mgrid[-1:1:120j, -1:1:160j] ** 2).sum(axis=0) / 2
    dark = 10 + rng.normal(0, 1, shape) + extra.reshape(shape)
    bright = dark + 120 * fall * response.reshape(shape) * (1 + rng.normal(0, 0.01, shape))
    found = find_defects(stack(rng, dark, 1.0), stack(rng, bright, 2.0))
    kinds = dict(zip((found.row * shape[1] + found.col).tolist(), found.kind, strict=True))
    assert [kinds.get(int(p)) for p in places] == ["hot"] * 40 + ["dead"] * 25
    gain = dict(zip((found.row * shape[1] + found.col).tolist(), found.gain_rel.tolist(), strict=True))
    assert all(np.isnan(gain[int(p)]) for p in places[:40])
