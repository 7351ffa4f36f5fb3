"""Random streams against the published vectors, a NumPy twin, SciPy's quantiles and the laws that they claim.

Statistical tests draw a fresh seed at every run. Each fails by chance with a probability of 1e-6, and says what it would catch.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special, stats

from pixmetry.core import _random_kernels as kernels
from pixmetry.core.errors import ParameterError
from pixmetry.core.random import Grid, Stream, Streams

FALSE_FAILURE = 1e-6
Z = stats.norm.isf(FALSE_FAILURE / 2)
WORD = np.uint64(0xFFFFFFFF)


@pytest.fixture
def stream(rng: np.random.Generator) -> Stream:
    seed = int(rng.integers(2**62))
    return Streams(seed, seed + 1).of("sensor.shot_noise")


def window(frame: int, row: int, col: int, shape: tuple[int, int]) -> Grid:
    return Grid(np.array([frame]), np.array([row]), np.array([col]), shape)


def twin_philox(counter: list, key: list) -> list[np.ndarray]:
    """Philox4x32-10 with arrays, written from the paper."""
    c0, c1, c2, c3 = (np.asarray(c, np.uint64) for c in counter)
    k0, k1 = (int(k) for k in key)
    for _ in range(10):
        a, b = np.uint64(0xD2511F53) * c0, np.uint64(0xCD9E8D57) * c2
        c0, c1, c2, c3 = (b >> np.uint64(32)) ^ c1 ^ np.uint64(k0), b & WORD, (a >> np.uint64(32)) ^ c3 ^ np.uint64(k1), a & WORD
        k0, k1 = (k0 + 0x9E3779B9) % 2**32, (k1 + 0xBB67AE85) % 2**32
    return [c0, c1, c2, c3]


def twin_words(
    key: np.uint64, frame: int, row0: int, col0: int, shape: tuple[int, int], shared: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the words of the block of every pixel, and the pixel's place in its block; `shared` pixels share one."""
    rows, cols = np.meshgrid(np.arange(row0, row0 + shape[0]), np.arange(col0, col0 + shape[1]), indexing="ij")
    counter = [(cols // shared) % 2**32, rows % 2**32, np.full(shape, frame % 2**32), np.full(shape, (frame >> 32) % 2**32)]
    return twin_philox(counter, [int(key) % 2**32, int(key) >> 32]), cols % shared


def twin_normal(key: np.uint64, frame: int, row0: int, col0: int, shape: tuple[int, int]) -> np.ndarray:
    words, place = twin_words(key, frame, row0, col0, shape, 4)
    u = np.where(place < 2, words[0], words[2]) * 2.0**-32 + 2.0**-33
    v = np.where(place < 2, words[1], words[3]).astype(np.int64)
    angle = (v & 0x3FFFFFFF) * (np.pi / 2 * 2.0**-30)
    size = np.sqrt(-2 * np.log(u)) * np.where(place % 2 == 0, np.cos(angle), np.sin(angle))
    return size * (1 - 2 * ((v >> np.where(place % 2 == 0, 31, 30)) & 1))


def twin_numerator(key: np.uint64, frame: int, row0: int, col0: int, shape: tuple[int, int]) -> np.ndarray:
    words, place = twin_words(key, frame, row0, col0, shape, 2)
    high, low = np.where(place == 0, words[0], words[2]), np.where(place == 0, words[1], words[3])
    return 2 * ((high.astype(np.int64) << 20) | (low.astype(np.int64) >> 12)) + 1


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [
        ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
    ],
)
def test_published_philox_vectors(counter: str, key: str, expected: str) -> None:
    """Known answers of the Random123 library, kat_vectors, philox4x32 with 10 rounds."""
    words = [np.uint64(int(text, 16)) for text in (counter + " " + key).split()]
    wanted = [int(text, 16) for text in expected.split()]
    assert [int(word) for word in kernels.philox4x32(*words)] == wanted
    assert [int(word) for word in twin_philox(words[:4], words[4:])] == wanted


@pytest.mark.parametrize("place", [(0, 0, 0), (7, -5, -11), (2**40 + 3, 4000, 2**31 - 9), (-1, -(2**31), 3)])
def test_normal_and_poisson_equal_the_twin(stream: Stream, place: tuple[int, int, int]) -> None:
    """Catches any word, sign or counter in the wrong place, and an error of a normal number above 2e-6."""
    shape = (33, 47)
    twin = twin_normal(stream._key("exposure", "normal", 3), *place, shape)
    np.testing.assert_allclose(stream.normal(window(*place, shape), 3)[0], twin, rtol=0, atol=2e-6)
    u = twin_numerator(stream._key("exposure", "poisson", 3), *place, shape) * 2.0**-53
    mean = np.geomspace(0.01, 1e5, u.size).astype(np.float32).reshape(shape)
    np.testing.assert_array_equal(stream.poisson(mean, window(*place, shape), 3)[0], stats.poisson.ppf(u, mean.astype(float)))


def test_stat_normal_moments_and_law(stream: Stream) -> None:
    """1e7 numbers: catches a mean off by 0.0016, a scale off by 0.11 %, a distribution function off by 0.0009."""
    z = stream.normal(Grid.whole(range(10), (1000, 1000))).ravel().astype(float)
    # standard errors of the sample moments of the normal law: var(z^k) = E z^2k - (E z^k)^2
    for power, moment, error in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96), (6, 15, 10170)):
        assert abs(np.mean(z**power) - moment) < Z * np.sqrt(error / z.size), power
    z.sort()
    distance = np.abs(special.ndtr(z) - (np.arange(z.size) + 0.5) / z.size).max() + 0.5 / z.size
    assert distance < np.sqrt(-np.log(FALSE_FAILURE / 2) / 2 / z.size)
    expected = z.size * special.ndtr(-4.0)
    assert stats.poisson.sf(np.sum(z > 4) - 1, expected) > FALSE_FAILURE / 2 < stats.poisson.cdf(np.sum(z > 4), expected)
    assert np.abs(z).max() < 6.8


def test_stat_uniform_law(stream: Stream) -> None:
    """1e6 numbers: catches a distribution function off by 0.0027."""
    u = np.sort(stream.uniform(Grid.whole([5], (1000, 1000))).ravel().astype(float))
    assert u[0] > 0 and u[-1] < 1
    assert np.abs(u - (np.arange(u.size) + 0.5) / u.size).max() < np.sqrt(-np.log(FALSE_FAILURE / 2) / 2 / u.size)


@pytest.mark.parametrize("mean", [0.1, 1.0, 5.0, 29.9, 100.0, 1e4])
def test_stat_poisson_law(stream: Stream, mean: float) -> None:
    """Chi-square over cells of at least 50 expected of 2e6: catches a mean off by 0.005 standard deviations."""
    mean = float(np.float32(mean))
    counts = stream.poisson(mean, Grid.whole([1, 2], (1000, 1000))).ravel()
    edges = np.unique(stats.poisson.ppf(np.linspace(0, 1, 400)[1:-1], mean))
    expected = np.diff(np.concatenate([[0], stats.poisson.cdf(edges, mean), [1]])) * counts.size
    found = np.bincount(np.searchsorted(edges, counts), minlength=len(expected))
    while expected[-1] < 50:
        expected[-2] += expected[-1]
        found[-2] += found[-1]
        expected, found = expected[:-1], found[:-1]
    statistic = np.sum((found - expected) ** 2 / expected)
    assert stats.chi2.sf(statistic, len(expected) - 1) > FALSE_FAILURE
    assert abs(counts.mean(dtype=float) - mean) < Z * np.sqrt(mean / counts.size)


def brackets(count: np.ndarray, mean: np.ndarray, numerator: np.ndarray, slack: float) -> np.ndarray:
    """Tell whether P(N <= count - 1) < u <= P(N <= count), from the smaller tail, up to a relative `slack`."""
    upper = numerator > 2**52
    p = np.where(upper, 2**53 - numerator, numerator) * 2.0**-53
    tail = np.where(upper, special.gammainc(count + 1, mean), special.gammaincc(count + 1, mean))
    before = np.where(upper, special.gammainc(np.maximum(count, 1), mean), special.gammaincc(np.maximum(count, 1), mean))
    reached = np.where(upper, tail <= p * (1 + slack), tail >= p * (1 - slack))
    needed = np.where(upper, before > p * (1 - slack), before < p * (1 + slack))
    return reached & (needed | (count == 0))


def quantiles(mean: np.ndarray, numerator: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the exact quantiles and the fast ones, which are NaN where undecided."""
    pairs = list(zip(mean, numerator.astype(np.uint64), strict=True))
    exact = np.array([kernels.poisson_exact(np.float64(m), n) for m, n in pairs])
    folded = [kernels.fold(n) for _, n in pairs]
    fast = [kernels.poisson_small(m, f[1]) if m < 4 else kernels.poisson_fast(m, *f) for m, f in zip(mean, folded, strict=True)]
    return exact, np.array(fast)


def test_poisson_quantile_far_into_both_tails(rng: np.random.Generator) -> None:
    """Means from 1e-4 to 1e5, out to 8 standard deviations, checked against the incomplete gamma function."""
    mean = np.exp(rng.uniform(np.log(1e-4), np.log(1e5), 8000)).astype(np.float32)
    z = rng.uniform(-8, 8, mean.size)
    tail = (special.ndtr(-np.abs(z)) * 2**53).astype(np.int64) | 1
    numerator = np.where(z > 0, 2**53 - tail, tail)
    exact, fast = quantiles(mean, numerator)
    assert brackets(exact, mean.astype(float), numerator, 1e-11).all()
    decided = ~np.isnan(fast)
    np.testing.assert_array_equal(fast[decided], exact[decided])


def test_poisson_quantile_at_the_steps(rng: np.random.Generator) -> None:
    """Numbers within 1e-9 of a step of the distribution, where a rounded expansion would miss; below 5 standard deviations."""
    mean = np.exp(rng.uniform(np.log(0.1), np.log(1e6), 8000)).astype(np.float32)
    count = np.maximum(np.rint(mean + rng.uniform(-4, 4, mean.size) * np.sqrt(mean)), 0)
    step = special.gammaincc(count + 1, mean.astype(float)) * (1 + rng.choice([-1e-9, 1e-9], mean.size))
    numerator = np.clip((np.minimum(step, 1 - 2.0**-50) * 2**53).astype(np.int64) | 1, 1, 2**53 - 1)
    exact, fast = quantiles(mean, numerator)
    assert brackets(exact, mean.astype(float), numerator, 1e-11).all()
    decided = ~np.isnan(fast)
    np.testing.assert_array_equal(fast[decided], exact[decided])
    assert np.mean(~decided) > 0.5  # the steps are where the fast path must hand over


def test_monotone_poisson_in_the_mean(stream: Stream) -> None:
    grid = window(1, 0, 0, (64, 64))
    means = np.sort(np.concatenate([np.geomspace(1e-3, 9e6, 300), [3.999, 4.0, 4.001, 29.99, 30.0, 30.01]]))
    counts = np.stack([stream.poisson(mean, grid)[0] for mean in means])
    assert (np.diff(counts, axis=0) >= 0).all()


def test_limit_poisson_of_nothing_and_of_very_much(stream: Stream) -> None:
    grid = window(0, 0, 0, (500, 500))
    assert not stream.poisson(0, grid).any()
    z = (stream.poisson(4e7, grid).astype(float) - 4e7) / np.sqrt(4e7)
    assert abs(z.mean()) < Z / np.sqrt(z.size) and abs(z.var() - 1) < Z * np.sqrt(2 / z.size)


@pytest.mark.parametrize("mean", [-1.0, np.nan, np.inf])
def test_poisson_refuses_what_is_no_mean(stream: Stream, mean: float) -> None:
    means = np.full((1, 8, 8), 5.0)
    means[0, 3, 4] = mean
    with pytest.raises(ParameterError, match="1 pixels"):
        stream.poisson(means, window(0, 0, 0, (8, 8)))


def test_stat_independent_draws(rng: np.random.Generator) -> None:
    """Correlations of numbers and of their squares over 2.5e5 pixels: catches a coefficient of 0.016."""
    seed = int(rng.integers(2**60))
    one, other = Streams(seed, seed).of("a"), Streams(seed + 1, seed + 1).of("a")
    named = Streams(seed, seed).of("b")
    grid = window(0, 0, 0, (500, 500))
    base = one.normal(window(0, 0, 0, (501, 505)))[0]
    fields = [base[:500, :500], base[1:, :500]] + [base[:500, shift : shift + 500] for shift in (1, 2, 3, 4, 5)]
    fields += [one.normal(window(f, 0, 0, (500, 500)))[0] for f in (1, 2, 2**32, -1)]
    fields += [s.normal(grid, d)[0] for s, d in ((one, 1), (named, 0), (other, 0))]
    fields += [one.normal_fixed(grid)[0], other.normal_fixed(grid)[0], one.uniform(grid)[0], one.uniform_fixed(grid)[0]]
    fields += [one.poisson(50, grid)[0], one.poisson(50, grid, 1)[0]]
    table = np.stack([(f - f.mean(dtype=float)).ravel() / f.std(dtype=float) for f in fields])
    for data in (table, table**2 - 1):
        data = data / data.std(axis=1, keepdims=True)
        r = data @ data.T / data.shape[1]
        pairs = list(combinations(range(len(r)), 2))
        # The last factor: products of squares have heavier tails than the normal law.
        limit = stats.norm.isf(FALSE_FAILURE / 4 / len(pairs)) / np.sqrt(data.shape[1]) * 1.3
        assert max(abs(r[i, j]) for i, j in pairs) < limit


METHODS = {
    "normal": lambda s, g: s.normal(g, 2),
    "normal_fixed": lambda s, g: s.normal_fixed(g, 2),
    "uniform": lambda s, g: s.uniform(g),
    "uniform_fixed": lambda s, g: s.uniform_fixed(g),
    "poisson": lambda s, g: s.poisson(6.5, g),
    "add_normal": lambda s, g: s.add_normal(1.5, g, 3.0),
    "normal_rows": lambda s, g: np.repeat(s.normal_rows(g)[:, :, None], g.shape[1], 2),
    "normal_rows_fixed": lambda s, g: np.repeat(s.normal_rows_fixed(g)[:, :, None], g.shape[1], 2),
    "normal_cols": lambda s, g: np.repeat(s.normal_cols(g)[:, None], g.shape[0], 1),
    "normal_cols_fixed": lambda s, g: np.repeat(s.normal_cols_fixed(g)[:, None], g.shape[0], 1),
}


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=40, deadline=None)
@given(row=st.integers(0, 30), col=st.integers(0, 2200), rows=st.integers(1, 10), cols=st.integers(1, 90), frame=st.integers(0, 1))
def test_identity_window_equals_crop(method: str, row: int, col: int, rows: int, cols: int, frame: int) -> None:
    draw, s = METHODS[method], Streams(3, 4).of("source")
    whole = draw(s, Grid(np.array([8, 9]), np.full(2, -17), np.full(2, -1030), (40, 2300)))
    part = draw(s, Grid(np.array([5, 8 + frame]), np.array([0, row - 17]), np.array([3, col - 1030]), (rows, cols)))
    np.testing.assert_array_equal(part[1], whole[frame, row : row + rows, col : col + cols])


def test_identity_over_threads(stream: Stream) -> None:
    grids = [window(f, 16 * r, 0, (16, 100)) for f in range(6) for r in range(4)]
    with ThreadPoolExecutor(4) as pool:
        tiles = list(pool.map(lambda grid: stream.poisson(40, grid)[0], grids))
    whole = stream.poisson(40, Grid.whole(range(6), (64, 100)))
    np.testing.assert_array_equal(np.concatenate(tiles).reshape(6, 64, 100), whole)


def test_what_hangs_on_which_seed() -> None:
    grid = Grid.whole([1, 2], (8, 8))
    a, unit, exposure = (Streams(*seeds).of("x") for seeds in ((1, 1), (2, 1), (1, 2)))
    for name in ("normal_fixed", "uniform_fixed", "normal_rows_fixed", "normal_cols_fixed"):
        first = getattr(a, name)(grid)
        np.testing.assert_array_equal(first[0], first[1])
        np.testing.assert_array_equal(first, getattr(exposure, name)(grid))
        assert not np.array_equal(first, getattr(unit, name)(grid))
    for name in ("normal", "uniform", "normal_rows", "normal_cols", "normal_frames", "uniform_frames"):
        first = getattr(a, name)(grid)
        assert not np.array_equal(first[0], first[1])
        np.testing.assert_array_equal(first, getattr(unit, name)(grid))
        assert not np.array_equal(first, getattr(exposure, name)(grid))


def test_unit_scalars_extend() -> None:
    s = Streams(1, 1).of("x")
    np.testing.assert_array_equal(s.normal_unit(50)[:7], s.normal_unit(7))
    np.testing.assert_array_equal(s.uniform_unit(50)[:7], s.uniform_unit(7))
    assert not np.array_equal(s.normal_unit(7), s.normal_unit(7, draw=1))


def test_identity_add_normal(stream: Stream) -> None:
    grid = Grid.whole([3, 4], (17, 23))
    data = np.arange(2 * 17 * 23, dtype=np.float32).reshape(grid.size)
    data.flags.writeable = False
    z = stream.normal(grid)
    np.testing.assert_array_equal(stream.add_normal(data, grid, 2.5), data + np.float32(2.5) * z)
    np.testing.assert_array_equal(stream.add_normal(data, grid, data[:1]), data + data[:1] * z)
    np.testing.assert_array_equal(stream.add_normal_fixed(data, grid, data), data + data * stream.normal_fixed(grid))


def test_grid_refuses_unequal_lengths() -> None:
    with pytest.raises(ValueError, match="differ in length"):
        Grid(np.arange(3), np.arange(2), np.arange(3), (4, 4))


def test_empty_grids(stream: Stream) -> None:
    for grid in (Grid.whole([], (4, 4)), Grid.whole([1], (0, 4)), Grid.whole([1], (4, 0))):
        assert stream.normal(grid).shape == stream.poisson(3, grid).shape == stream.add_normal(0, grid, 1).shape == grid.size
