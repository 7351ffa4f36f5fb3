"""Reductions of frames against plain NumPy, and against noise of known size.

Statistical tests fail by chance once in a million runs (``ALPHA``), for any seed.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from observe.reductions import reduced
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.observe.histogram import HistogramAccumulator, code_errors
from pixmetry.observe.moments import LevelAccumulator, level_moments
from pixmetry.observe.spectra import SpectraAccumulator
from pixmetry.observe.stack import StackAccumulator, new_group

ALPHA = 1e-6


def plain_mean_squares(frames: np.ndarray) -> dict[str, float]:
    """The analysis of variance, written down term by term."""
    y = frames.astype(float)
    f, m, n = y.shape
    d = y - y.mean(axis=0)
    frame = d.mean(axis=(1, 2), keepdims=True)
    row = d.mean(axis=2, keepdims=True) - frame
    col = d.mean(axis=1, keepdims=True) - frame
    rest = d - frame - row - col
    return {
        "pixel": (rest**2).sum() / ((f - 1) * (m - 1) * (n - 1)),
        "row": (row**2).sum() / ((f - 1) * (m - 1)),
        "col": (col**2).sum() / ((f - 1) * (n - 1)),
        "frame": (frame**2).sum() / (f - 1),
        "total": ((d - frame) ** 2).sum() / ((f - 1) * m * n),
    }


def random_frames(rng: np.random.Generator, shape: tuple[int, int, int], dtype: type = np.uint16, top: int = 4096) -> np.ndarray:
    return rng.integers(0, top, shape).astype(dtype)


@settings(deadline=None, max_examples=30)
@given(
    f=st.integers(2, 5),
    m=st.integers(2, 9),
    n=st.integers(2, 11),
    seed=st.integers(0, 2**32 - 1),
    bits=st.sampled_from([1, 8, 12, 16]),
    low=st.booleans(),
)
def test_moments_equal_their_numpy_twin(f, m, n, seed, bits, low):
    rng = np.random.default_rng(seed)
    top = 2**bits
    frames = rng.integers(0 if low else top - 1, top, (f, m, n)).astype(np.uint8 if bits <= 8 else np.uint16)
    accumulator = LevelAccumulator(bits)
    for frame in frames:
        accumulator.add(frame)
    got, want = accumulator.mean_squares(), plain_mean_squares(frames)
    for part, value in want.items():
        assert getattr(got, f"{part}_dn2") == pytest.approx(value, rel=1e-9, abs=1e-12 * 4**bits)
    assert np.array_equal(accumulator.counts, np.bincount(frames.ravel(), minlength=top))
    np.testing.assert_allclose(accumulator.mean_map_dn(), frames.mean(axis=0), rtol=1e-15)
    np.testing.assert_allclose(
        accumulator.deviation_map_dn2() / (f - 1), frames.astype(float).var(axis=0, ddof=1), rtol=1e-9, atol=1e-12 * 4**bits
    )
    y = frames.astype(float)
    pairs = [(y[i] * y[j]).mean() - y[i].mean() * y[j].mean() for i in range(f) for j in range(f) if i != j]
    assert accumulator.spatial_covariance_dn2() == pytest.approx(np.mean(pairs), rel=1e-9, abs=1e-12 * 4**bits)


def test_pair_reduces_to_the_standard(rng: np.random.Generator):
    """EMVA 1288 R4.0 eq. 18 and 32, and the kurtosis of SciPy, on one pair."""
    frames = random_frames(rng, (2, 31, 45))
    y0, y1 = frames.astype(float)
    level = level_moments([reduced(frames, bits=12, kind="level").moments.summary()], [0.01], [123.0], code_max=4000)
    d = y1 - y0
    assert level.var_total_dn2[0] == pytest.approx(0.5 * (d**2).mean() - 0.5 * d.mean() ** 2, rel=1e-12)
    assert level.spatial_cov_dn2[0] == pytest.approx((y0 * y1).mean() - y0.mean() * y1.mean(), rel=1e-9)
    assert level.kurtosis_excess[0] == pytest.approx(stats.kurtosis(d.ravel()), rel=1e-10)
    assert level.mean_dn[0] == pytest.approx(frames.mean(), rel=1e-14)
    assert level.fraction_min[0] == (frames == 0).mean()
    assert level.fraction_max[0] == (frames == 4000).mean()
    assert level.photons[0] == 123.0 and level.n_frames[0] == 2


@pytest.mark.parametrize("kind", ["level", "stack"])
def test_same_bits_for_any_order(kind, rng: np.random.Generator):
    frames = random_frames(rng, (9, 24, 37))
    whole = reduced(frames, bits=12, kind=kind, spectra_pairs=4)
    shuffled = new_group(12, kind, 4)
    for index in rng.permutation(9):
        shuffled.add(frames[index], int(index))
    one, other = whole.moments, shuffled.moments
    assert one.mean_squares() == other.mean_squares()
    assert np.array_equal(one.counts, other.counts)
    assert np.array_equal(one.frame_means_dn(), other.frame_means_dn())
    assert np.array_equal(one.deviation_map_dn2(), other.deviation_map_dn2())
    if kind == "level":
        assert one.kurtosis_excess() == other.kurtosis_excess()
    else:
        mean_map = one.mean_map_dn()
        a, b = whole.spectra.result(mean_map), shuffled.spectra.result(mean_map)
        assert a.n_pairs == b.n_pairs == 4
        assert np.array_equal(a.temporal_h_dn2, b.temporal_h_dn2) and np.array_equal(a.temporal_power_dn2, b.temporal_power_dn2)


def test_analysis_of_variance_is_unbiased_for_known_noise(rng: np.random.Generator):
    """ν MS/E[MS] is χ²_ν for each stratum, two-sided at ALPHA each.

    Smallest error caught with power 0.99 (7.2 relative standard errors √(2/ν)): white 1.0 %, row 14 %, column 12 %; frame 3 ×.
    """
    f, m, n = 40, 150, 200
    white, row, col, frame = 40.0, 12.0, 9.0, 5.0
    mean = rng.normal(2000, 300, (m, n))
    accumulator = StackAccumulator(16)
    for _ in range(f):
        y = mean + rng.normal(0, white, (m, n)) + rng.normal(0, row, (m, 1)) + rng.normal(0, col, (1, n)) + rng.normal(0, frame)
        accumulator.add(np.rint(y).astype(np.uint16))
    got = accumulator.mean_squares()
    w = white**2 + 1 / 12
    for value, expected, dof in (
        (got.pixel_dn2, w, (f - 1) * (m - 1) * (n - 1)),
        (got.row_dn2, row**2 + w / n, (f - 1) * (m - 1)),
        (got.col_dn2, col**2 + w / m, (f - 1) * (n - 1)),
        (got.frame_dn2, frame**2 + row**2 / m + col**2 / n + w / (m * n), f - 1),
    ):
        low, high = stats.chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], dof)
        assert low < dof * value / expected < high
    result = accumulator.result(0.02)
    # row and column noise correlate the pixels: σ²_stack scatters by little more than its white part
    assert result.var_stack_dn2 == pytest.approx(w + row**2 + col**2 + frame**2, rel=0.05)


def test_kurtosis_is_that_of_known_distributions(rng: np.random.Generator):
    """Gaussian 0, uniform −1.2/2 for a difference of two. SE = √(24/n) = 0.0098 at 50 000 pixels; errors above 0.07 are caught."""
    for draw, expected in ((lambda: rng.normal(2000, 50, (200, 250)), 0.0), (lambda: rng.uniform(1000, 3000, (200, 250)), -0.6)):
        accumulator = LevelAccumulator(12)
        for _ in range(2):
            accumulator.add(np.rint(draw()).astype(np.uint16))
        assert abs(accumulator.kurtosis_excess() - expected) < stats.norm.isf(ALPHA / 2) * math.sqrt(24 / 50000)


def test_spectra_are_those_of_the_definition(rng: np.random.Generator):
    """EMVA 1288 R4.0 §8.4, row by row with NumPy's one-dimensional transform."""
    for rows, cols in ((16, 22), (15, 21)):
        frames = random_frames(rng, (4, rows, cols)).astype(float)
        accumulator = SpectraAccumulator(2)
        for frame in frames:
            accumulator.add(frame.astype(np.uint16))
        mean_map = frames.mean(axis=0)
        got = accumulator.result(mean_map)
        centred = mean_map - mean_map.mean()
        np.testing.assert_allclose(got.fixed_h_dn2, (np.abs(np.fft.rfft(centred, axis=1)) ** 2 / cols).mean(axis=0), rtol=1e-9)
        np.testing.assert_allclose(got.fixed_v_dn2, (np.abs(np.fft.rfft(centred, axis=0)) ** 2 / rows).mean(axis=1), rtol=1e-9)
        d = (frames[1::2] - frames[0::2]) / math.sqrt(2)
        d -= d.mean(axis=(1, 2), keepdims=True)
        np.testing.assert_allclose(got.temporal_h_dn2, (np.abs(np.fft.rfft(d, axis=2)) ** 2 / cols).mean(axis=(0, 1)), rtol=1e-4, atol=0.1)
        np.testing.assert_allclose(got.temporal_v_dn2, (np.abs(np.fft.rfft(d, axis=1)) ** 2 / rows).mean(axis=(0, 2)), rtol=1e-4, atol=0.1)
        np.testing.assert_allclose(got.frequency_h, np.fft.rfftfreq(cols), atol=1e-12)


def test_white_noise_has_its_variance_as_power(rng: np.random.Generator):
    """Mean of the temporal power over frequencies off zero: relative SE √(2/(pairs·M·N)) = 0.36 %; errors above 2.6 % are caught."""
    rows, cols, sigma = 100, 200, 7.0
    group = reduced((np.rint(rng.normal(500, sigma, (rows, cols))).astype(np.uint16) for _ in range(16)), bits=12)
    got = group.spectra.result(group.moments.mean_map_dn())
    power = got.temporal_power_dn2[1:, 1:-1].mean()
    assert abs(power / (sigma**2 + 1 / 12) - 1) < stats.norm.isf(ALPHA / 2) * math.sqrt(2 / (8 * rows * (cols - 2)))


def sweep(thresholds: np.ndarray, levels: np.ndarray, pixels: int, rng: np.random.Generator) -> HistogramAccumulator:
    """Histogram of Gaussian light levels behind a converter with the given thresholds (code k below threshold k)."""
    accumulator = HistogramAccumulator(8)
    for mean in levels:
        codes = np.searchsorted(thresholds, rng.normal(mean, 4.0, pixels))
        accumulator.add(codes.astype(np.uint8).reshape(-1, 100), level=float(mean))
    return accumulator


def test_ideal_converter_shows_no_code_errors(rng: np.random.Generator):
    """z of each DNL is N(0, 1): χ² of all, at ALPHA; a systematic misfit of half its u over all codes is caught."""
    result = code_errors(sweep(np.arange(255) + 0.5, np.arange(25.0, 231.0, 5.0), 40000, rng).result())
    z = result.dnl_lsb / result.u_dnl_lsb
    assert result.codes.size > 180
    low, high = stats.chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], z.size * 0.75)  # neighbours share windows: fewer independent ones
    assert low < (z**2).sum() * 0.75 < high
    assert result.missing_codes.size == 0
    assert result.fit["dnl_rms_lsb"].value < 0.02


def test_recovers_differential_non_linearity_and_missing_codes(rng: np.random.Generator):
    edges = np.arange(256) + 0.5 + rng.normal(0, 0.15 / math.sqrt(2), 256)  # upper edge of each code
    for missing in (100, 150):
        edges[missing - 1 : missing + 1] = edges[missing - 1 : missing + 1].mean()
    truth = np.diff(edges, prepend=-0.5) - 1.0
    result = code_errors(sweep(edges[:-1], np.arange(25.0, 226.0, 4.0), 40000, rng).result())
    assert result.missing_codes.tolist() == [100, 150]
    assert (result.missing_probability < 1e-6).all()
    others = ~np.isin(result.codes, [100, 150])
    assert np.corrcoef(result.dnl_lsb[others], truth[result.codes[others]])[0, 1] > 0.75
    rms = result.fit["dnl_rms_lsb"]
    want = math.sqrt((truth[result.codes] ** 2).mean())
    assert rms.kind == "value" and abs(rms.value - want) < 0.2 * want


def test_histogram_counts_dark_frames_and_levels(rng: np.random.Generator):
    frames = random_frames(rng, (4, 11, 13), np.uint8, 200)
    frames[0] //= 2  # levels are in order of their means, which of like frames can be the same
    histogram = HistogramAccumulator(8)
    histogram.add(frames[0], dark=True, level="a")
    histogram.add(frames[1], level="b")
    histogram.add(frames[2], level="b")
    histogram.add(frames[3])
    got = histogram.result()
    assert np.array_equal(got.counts, np.bincount(frames.ravel(), minlength=256))
    assert np.array_equal(got.dark_counts, np.bincount(frames[0].ravel(), minlength=256))
    want = sorted([(frames[0].mean(), frames[0].var()), (frames[1:3].mean(), frames[1:3].var())])
    np.testing.assert_allclose(np.c_[got.level_means_dn, got.level_vars_dn2], want, rtol=1e-12)


def test_refuses_what_it_cannot_reduce():
    group = StackAccumulator(12)
    group.add(np.zeros((4, 5), np.uint16), 3)
    for frame, index in (
        (np.zeros((4, 6), np.uint16), None),
        (np.zeros((4, 5)), None),
        (np.full((4, 5), 4096, np.uint16), None),
        (np.zeros((4, 5), np.uint16), 3),
        (np.zeros((2, 4, 5), np.uint16), None),
    ):
        with pytest.raises(InputError):
            group.add(frame, index)
    assert group.n_frames == 1
    with pytest.raises(MeasureError):
        group.mean_squares()
    with pytest.raises(InputError):
        StackAccumulator(17)
    with pytest.raises(InputError):
        new_group(12, "movie")


def test_read_only_and_strided_frames_are_read_like_others(rng: np.random.Generator):
    frames = random_frames(rng, (3, 20, 30))
    strided = np.asfortranarray(frames[1])
    read_only = frames[2].copy()
    read_only.flags.writeable = False
    a, b = StackAccumulator(12), StackAccumulator(12)
    for frame in frames:
        a.add(frame)
    for frame in (frames[0][:, :], strided, read_only):
        b.add(frame)
    assert a.mean_squares() == b.mean_squares()
