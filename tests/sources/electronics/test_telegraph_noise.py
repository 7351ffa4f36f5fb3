"""Random telegraph noise: occupancy, kurtosis and correlation in closed form, the levels, and the map of the unit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from pixmetry.camera.signal import Kind, Signal
from pixmetry.core.random import Grid, Streams
from pixmetry.sources.electronics.telegraph_noise import TelegraphNoise, forward, level_variance, propagate, truth
from source_signals import ALPHA, K_DN_PER_E, Z, spot_probe, stream

SHAPE = (300, 400)


def frames(params: TelegraphNoise, numbers, unit) -> np.ndarray:
    """Levels in steps of every pixel that has a trap, shape (frames, pixels)."""
    n = len(numbers)
    grid = Grid.whole(list(numbers), SHAPE)
    still = np.zeros(n)
    dark = Signal(np.zeros((n, *SHAPE), np.float32), Kind.ELECTRONS, grid, SHAPE, still + 0.01, 0.04 * np.array(numbers), still + 20)
    told = truth(params, dark, unit)
    noise = forward(params, dark, unit).data.astype(float)
    assert not noise[:, ~told["telegraph_pixels"]].any()
    return noise[:, told["telegraph_pixels"]] / told["telegraph_step_e"][told["telegraph_pixels"]]


def test_two_levels_with_the_occupancy_and_its_kurtosis(rng: np.random.Generator):
    """A trap filled in a share p: kurtosis (1 − 3 p (1 − p))/(p (1 − p)). 480 000 states: p is known to 0.004 at 1e-6."""
    p = 0.3
    level = frames(TelegraphNoise(share=0.5, occupancy=p), range(8), stream(rng))
    assert np.allclose(level, np.where(level > 0, 1 - p, -p), atol=1e-5)
    share = np.mean(level > 0)
    slack = Z * math.sqrt(p * (1 - p) / level.size)
    assert share == pytest.approx(p, abs=slack)
    kurtosis = np.mean(level**4) / np.mean(level**2) ** 2
    v = p * (1 - p)
    steepness = abs((1 - 2 * p) / v**2)  # of (1 − 3v)/v against p
    assert kurtosis == pytest.approx((1 - 3 * v) / v, abs=2 * steepness * slack)


@pytest.mark.parametrize("memory", [0.7, 3.0, 20.0])
def test_correlation_falls_exponentially_with_the_frames_and_needs_no_frame_between(memory, rng: np.random.Generator):
    """60 000 pixels give a correlation to 0.02 at 1e-6: a memory that is off by a tenth would be caught."""
    p, n = 0.4, SHAPE[0] * SHAPE[1] // 2
    params = TelegraphNoise(share=0.5, occupancy=p, memory_frames=memory)
    numbers = [100_000, 100_001, 100_003, 100_010]
    level = frames(params, numbers, stream(rng))
    for i in range(4):
        for j in range(i + 1, 4):
            rho = math.exp(-(numbers[j] - numbers[i]) / memory)
            product = level[i] * level[j] / (p * (1 - p))
            assert product.mean() == pytest.approx(rho, abs=1.1 * Z * product.std() / math.sqrt(n))
    assert level.mean() == pytest.approx(0.0, abs=Z * 2 * math.sqrt(p * (1 - p) / n))


def test_dwell_times_are_geometric(rng: np.random.Generator):
    """Of all times in the upper state, a share r^k (1 − r) lasts k frames more, r = 1 − (1 − e^(−1/τ)) (1 − p). Chi-square at 1e-6."""
    p, memory = 0.5, 4.0
    level = frames(TelegraphNoise(share=0.5, occupancy=p, memory_frames=memory), range(25), stream(rng)) > 0
    starts = ~level[:9] & level[1:10]
    stay = 1 - (1 - math.exp(-1 / memory)) * (1 - p)
    length = np.array([np.argmin(np.append(level[t + 1 :, i], False)) for t, i in zip(*np.nonzero(starts), strict=True)])
    bins = np.bincount(np.minimum(length, 12), minlength=13)[1:]
    chance = np.append(stay ** np.arange(11) * (1 - stay), stay**11)
    assert bins.size == chance.size
    assert stats.chisquare(bins, chance * bins.sum()).pvalue > ALPHA


def test_double_sampling_gives_three_levels(rng: np.random.Generator):
    """Difference of two states of correlation ρ: ±1 with (1 − ρ) p (1 − p) each; kurtosis 1/(2 (1 − ρ) p (1 − p))."""
    p, rho = 0.4, 0.3
    level = frames(
        TelegraphNoise(share=0.5, occupancy=p, levels="cds", cds_correlation=rho, memory_frames=2.0), [5, 500, 5000], stream(rng)
    )
    assert np.allclose(level, np.rint(level), atol=1e-5) and set(np.unique(np.rint(level))) == {-1.0, 0.0, 1.0}
    each = (1 - rho) * p * (1 - p)
    for side in (-1, 1):
        assert np.mean(np.rint(level) == side) == pytest.approx(each, abs=Z * math.sqrt(each / level.size))
    assert np.mean(level**4) / np.mean(level**2) ** 2 == pytest.approx(1 / (2 * each), rel=Z / math.sqrt(2 * each * level.size))


@pytest.mark.parametrize("levels", ["two", "three", "cds"])
def test_stated_variance_of_a_level_is_that_of_many_pixels(levels: str, rng: np.random.Generator):
    """Mean square over independent pixels, whose own scatter is measured: 1e-6 by chance, finds 3 %."""
    params = TelegraphNoise(share=0.5, occupancy=0.4, levels=levels, cds_correlation=0.3)
    square = frames(params, [5], stream(rng)) ** 2
    assert square.mean() == pytest.approx(level_variance(params), abs=Z * square.std() / math.sqrt(square.size))


def test_two_traps_are_binomial(rng: np.random.Generator):
    p = 0.3
    level = frames(TelegraphNoise(share=0.5, occupancy=p, levels="three"), range(6), stream(rng))
    count = np.bincount(np.rint(level + 2 * p).astype(int).ravel(), minlength=3)
    assert stats.chisquare(count, level.size * stats.binom.pmf([0, 1, 2], 2, p)).pvalue > ALPHA


def test_the_map_belongs_to_the_unit_with_its_share_and_exponential_steps(rng: np.random.Generator):
    params = TelegraphNoise(share=0.2, amplitude_e=15.0)
    grid = Grid.whole([3], SHAPE)
    dark = Signal(np.zeros((1, *SHAPE), np.float32), Kind.ELECTRONS, grid, SHAPE, *(np.zeros(1),) * 3)
    seed = int(rng.integers(2**60))
    told = truth(params, dark, Streams(seed, 1).of("a"))
    again = truth(params, dark, Streams(seed, 2).of("a"))
    assert np.array_equal(told["telegraph_step_e"], again["telegraph_step_e"])
    steps = told["telegraph_step_e"][told["telegraph_pixels"]]
    n = SHAPE[0] * SHAPE[1]
    assert steps.size == pytest.approx(0.2 * n, abs=Z * math.sqrt(0.16 * n))
    assert stats.kstest(steps, stats.expon(scale=15).cdf).pvalue > ALPHA


def test_the_quiet_frame_has_none_and_the_shift_is_that_of_the_mean_variance():
    """E[a²] = 2 amplitude² of the exponential law; the variance of a level is p (1 − p)."""
    params = TelegraphNoise(share=0.1, amplitude_e=20.0, occupancy=0.2)
    probe = spot_probe()
    sigma = K_DN_PER_E * math.sqrt(0.1 * 2 * 400 * 0.16)
    assert propagate(params, probe).u_x_px == pytest.approx(probe.white(sigma)[0], rel=1e-9)
