"""Shot noise as a camera draws it, against Poisson's law itself: ten million electrons counts a level, and what must not be correlated.

Seeds are fresh at every run. Each test fails by chance with a probability of 1e-6 (all its parts together), and says what it would catch
with 99 %.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import get_source
from pixmetry.core.random import Grid
from pixmetry.core.threads import map_tiles
from pixmetry.scene.uniform import Uniform

ALPHA = 1e-6
SHAPE = (1000, 1000)
FRAMES = 10  # of 1e6 pixels: 1e7 samples a level
LEVELS_E = (0.1, 5.0, 100.0, 1e4)


def camera(unit_seed: int = 0, **values: float) -> Camera:
    """Photons to electrons one to one; fixed response and dark current as told."""
    chain = [
        ("sensor.quantum_efficiency", {"quantum_efficiency": 1.0}),
        ("sensor.prnu", {"pixel_std_rel": values.get("prnu_rel", 0.0)}),
        ("sensor.dark_current", {"rate_e_per_s": values.get("dark_e", 0.0)}),
        ("sensor.shot_noise", {}),
    ]
    elements = tuple(Element(name, get_source(name), get_source(name).make(params)) for name, params in chain)
    return Camera("counting", SHAPE, elements, exposure_s=1.0, unit_seed=unit_seed)


def histogram(level_e: float, seed: int) -> np.ndarray:
    """How often each count occurs in `FRAMES` frames."""
    counting, scene = camera(), Uniform(level_e)

    def counts(frame: int) -> np.ndarray:
        data = counting.expose(scene, [frame], seed, threads=1).data
        assert (data == np.floor(data)).all()
        return np.bincount(data.ravel().astype(np.int64))

    parts = map_tiles(counts, range(FRAMES))
    total = np.zeros(max(len(p) for p in parts), np.int64)
    for part in parts:
        total[: len(part)] += part
    return total


def cells(found: np.ndarray, law: stats.rv_discrete, samples: int, least: float = 10.0) -> tuple[np.ndarray, np.ndarray]:
    """Neighbouring counts gathered until `least` are expected in a cell: what was found and what is expected, both tails included."""
    top = max(len(found), int(law.isf(1e-12)) + 2)
    expected = samples * law.pmf(np.arange(top))
    expected[-1] += samples * law.sf(top - 1)
    seen = np.concatenate([found, np.zeros(top - len(found))])
    middle = int(law.median())
    cell = np.zeros(top, int)
    for order, step in ((range(middle - 1, -1, -1), -1), (range(middle, top), 1)):
        edge, gathered = 0 if step > 0 else -1, 0.0
        rest = float(expected[list(order)].sum())
        for k in order:
            if gathered >= least and rest >= least:
                edge, gathered = edge + step, 0.0
            cell[k] = edge
            gathered += expected[k]
            rest -= expected[k]
    _, cell = np.unique(cell, return_inverse=True)
    return np.bincount(cell, seen), np.bincount(cell, expected)


@pytest.mark.parametrize("level_e", LEVELS_E)
def test_stat_ten_million_counts_follow_poissons_law(level_e: float, rng: np.random.Generator) -> None:
    """χ², the largest distance of the distribution functions, and the mean of the mid-p values; 1e7 counts.

    Catches a mean off by 0.0024 σ, a variance off by 0.35 % (0.8 % at 0.1 e), a distribution function off by 0.0013. The distance is
    bounded by Massart's inequality (1990), which holds for discrete laws too. With U = F(N) − p(N)/2 (mid-p), E U = 1/2 and
    Var U = (1 − Σp³)/12 exactly.
    """
    samples, share = FRAMES * SHAPE[0] * SHAPE[1], ALPHA / 5
    law = stats.poisson(float(np.float32(level_e)))
    found = histogram(level_e, int(rng.integers(2**60)))
    assert found.sum() == samples

    seen, expected = cells(found, law, samples)
    assert expected.min() >= 10 or len(expected) == 1
    statistic = float(np.sum((seen - expected) ** 2 / expected))
    assert stats.chi2.sf(statistic, len(expected) - 1) > share, (statistic, len(expected))

    k = np.arange(len(found))
    distance = np.abs(np.cumsum(found) / samples - law.cdf(k)).max()
    assert distance < np.sqrt(np.log(2 / share) / (2 * samples))

    z = stats.norm.isf(share / 2)
    mid_p = law.cdf(k) - 0.5 * law.pmf(k)
    assert abs(found @ mid_p / samples - 0.5) < z * np.sqrt((1 - np.sum(law.pmf(np.arange(2 * len(found))) ** 3)) / 12 / samples)

    mean = found @ k / samples
    assert abs(mean - law.mean()) < z * np.sqrt(law.mean() / samples)
    variance = found @ (k - law.mean()) ** 2 / samples
    assert abs(variance - law.var()) < z * np.sqrt((law.mean() + 2 * law.mean() ** 2) / samples)  # µ₄ − σ⁴ = µ + 2µ²


def standard(data: np.ndarray) -> np.ndarray:
    values = data.reshape(-1).astype(float)
    return (values - values.mean()) / values.std()


@pytest.mark.parametrize("level_e", [5.0, 1e4])
def test_stat_frames_sources_and_units_are_not_correlated(level_e: float, rng: np.random.Generator) -> None:
    """Every pair of frames, exposure seeds, sources and units over 1e6 pixels: catches a correlation of 0.009."""
    seed = int(rng.integers(2**60))
    scene = Uniform(level_e)
    frames = camera().expose(scene, [0, 1, 2, 2**31], seed).data
    unit, other = camera(seed, prnu_rel=0.05), camera(seed + 1, prnu_rel=0.05)
    named = camera().streams(seed)
    grid = Grid.whole([0], SHAPE)
    fields = [*frames, camera().expose(scene, [0], seed + 1).data]
    fields += [unit.expose(scene, [0], seed, quiet=True).data, other.expose(scene, [0], seed, quiet=True).data]
    fields += [named.of("sensor.shot_noise:second").poisson(level_e, grid), named.of("electronics.amplifier_noise").normal(grid)]
    fields += [named.of("sensor.dsnu").normal_fixed(grid), named.of("sensor.prnu").normal(grid)]
    table = np.stack([standard(field) for field in fields])
    r = (table @ table.T / table.shape[1])[np.triu_indices(len(table), 1)]
    assert np.abs(r).max() < stats.norm.isf(ALPHA / 2 / len(r)) / np.sqrt(table.shape[1])


@pytest.mark.parametrize("level_e", [5.0, 1e4])
def test_stat_pixels_are_not_correlated(level_e: float, rng: np.random.Generator) -> None:
    """All shifts up to 40 px down and to both sides within a frame of 1e6 pixels: catches a correlation of 0.009."""
    noise = standard(camera().expose(Uniform(level_e), 1, int(rng.integers(2**60))).data).reshape(SHAPE)
    reach = 40
    padded = [n + reach for n in SHAPE]  # so that no shift wraps around
    spectrum = np.abs(np.fft.rfft2(noise, padded)) ** 2
    r = np.fft.irfft2(spectrum, padded) / noise.size
    near = np.concatenate([r[1 : reach + 1, : reach + 1].ravel(), r[: reach + 1, -reach:].ravel(), r[0, 1 : reach + 1]])
    assert r[0, 0] == pytest.approx(1.0)
    assert np.abs(near).max() < stats.norm.isf(ALPHA / 2 / len(near)) / np.sqrt(noise.size)


def difference_moments(low: float, high: float) -> tuple[float, float, float]:
    """Exact E D, E D², E D⁴ of D = Q_high(U) − Q_low(U): the two counts that one uniform number U gives by inversion.

    The distribution functions cut (0, 1) into pieces on each of which both counts stand still.
    """
    laws = stats.poisson(low), stats.poisson(high)
    k = np.arange(int(laws[1].isf(1e-15)) + 2)
    cuts = np.unique(np.concatenate([[0.0], *(law.cdf(k) for law in laws)]))
    middle, width = 0.5 * (cuts[1:] + cuts[:-1]), np.diff(cuts)
    d = np.searchsorted(laws[1].cdf(k), middle) - np.searchsorted(laws[0].cdf(k), middle)
    return tuple(float(np.sum(width * d**power)) for power in (1, 2, 4))


@pytest.mark.parametrize(("level_e", "dark_e"), [(5.0, 0.25), (100.0, 1.0), (1e4, 30.0)])
def test_stat_with_and_without_a_source_are_paired(level_e: float, dark_e: float, rng: np.random.Generator) -> None:
    """With and without dark current: the difference has the moments of one shared uniform number, far below independent draws.

    1e6 pixels: catches a mean difference off by 0.7 % of its standard deviation, and 0.1 % of pixels that lost their partner. Independent
    draws would differ with a variance of 2 µ + d: 55 times as much at 5 e, 5000 at 100 e, 170 000 at 1e4 e.
    """
    level_e, seed = float(np.float32(level_e)), int(rng.integers(2**60))
    without, with_dark = (camera(dark_e=d).expose(Uniform(level_e), 1, seed).data.astype(float) for d in (0.0, dark_e))
    difference = with_dark - without
    assert difference.min() >= 0  # more electrons never give a smaller count
    first, second, fourth = difference_moments(level_e, float(np.float32(level_e) + np.float32(dark_e)))
    n, z = difference.size, stats.norm.isf(ALPHA / 4)
    assert abs(difference.mean() - first) < z * np.sqrt((second - first**2) / n)
    assert abs((difference**2).mean() - second) < z * np.sqrt((fourth - second**2) / n)
    assert second - first**2 < (2 * level_e + dark_e) / 50
