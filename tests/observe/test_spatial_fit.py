"""Non-uniformity, defects and patterns, against simulated sensors whose truth is known.

Statistical tests fail by chance once in a million runs (``ALPHA``), for any seed.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from observe.reductions import reduced
from pixmetry.camera.observations import DefectList, PatternList, StackMoments
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.emva.spatial.spatial import spatial_variances
from pixmetry.emva.spatial.spatial_inputs import SpatialInputs
from pixmetry.observe.defects import find_defects
from pixmetry.observe.patterns import find_phase_patterns
from pixmetry.observe.spatial_fit import fit_spatial
from pixmetry.observe.stack import StackAccumulator
from pixmetry.observe.surface import fit_surface

ALPHA = 1e-6
SHAPE = (48, 64)


def lines(rng: np.random.Generator, shape: tuple[int, int], pixel: float, row: float, col: float) -> np.ndarray:
    return rng.normal(0, pixel, shape) + rng.normal(0, row, (shape[0], 1)) + rng.normal(0, col, (1, shape[1]))


def stack(
    rng: np.random.Generator, mean: np.ndarray, n_frames: int, white: float = 2.0, row: float = 0.0, col: float = 0.0
) -> StackMoments:
    """Moments of simulated frames: a mean map with Gaussian noise, rounded."""
    accumulator = StackAccumulator(16)
    for _ in range(n_frames):
        accumulator.add(np.rint(mean + lines(rng, mean.shape, white, row, col)).astype(np.uint16))
    return accumulator.result(0.01)


def no_defects(shape: tuple[int, int]) -> DefectList:
    none = np.zeros(0, dtype=int)
    return DefectList(none, none, (), none.astype(float), none.astype(float), 0.0, shape)


def check_z(z: np.ndarray, name: str) -> None:
    """N(0, 1) by Kolmogorov–Smirnov and by the sum of squares, ALPHA each.

    With 250 values the first catches a bias of 0.35 u, the second an u that is wrong by 30 %, with power 0.9.
    """
    assert stats.kstest(z, "norm").pvalue > ALPHA, name
    low, high = stats.chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], z.size)
    assert 0.97 * low < (z**2).sum() < 1.03 * high, name  # 3 % for what is not linear


def test_uncertainties_are_calibrated(rng: np.random.Generator):
    """Blind recovery of all parts from small stacks with every temporal and fixed part present.

    Standard deviations of some 50 rows or columns are skewed, and their u goes with them; their logarithms are nearly normal.
    """
    truth = {
        "dsnu_pixel_dn": 1.5, "dsnu_row_dn": 0.9, "dsnu_col_dn": 0.8,
        "prnu_pixel_rel": 0.01, "prnu_row_rel": 0.004, "prnu_col_rel": 0.004,
    }  # fmt: skip
    truth["dsnu_total_dn"] = math.hypot(1.5, 0.9, 0.8)
    truth["prnu_total_rel"] = math.hypot(0.01, 0.004, 0.004)
    z = {name: [] for name in truth}
    none = no_defects(SHAPE)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    light = 1000 * (1 + 1e-3 * (x - 31.5) - 5e-4 * (y - 23.5) - 2e-5 * (x - 20) ** 2)
    light *= 1000 / light.mean()
    gradient = np.array([1e-3 - 2e-5 * 2 * 11.5, -5e-4]) / (1 - 2e-5 * ((x - 20.0) ** 2).mean())
    z_shading = {"shading_x_per_px": [], "shading_y_per_px": []}
    for _ in range(250):
        dark = 100 + lines(rng, SHAPE, 1.5, 0.9, 0.8)
        bright = dark + light * (1 + lines(rng, SHAPE, 0.01, 0.004, 0.004))
        got = fit_spatial(stack(rng, dark, 6, 2.0, 0.7, 0.5), stack(rng, bright, 6, 12.0, 0.7, 0.5), none)
        for name, value in truth.items():
            z[name].append(math.log(got[name].value / value) * got[name].value / got[name].u)
            assert got[name].kind == "value"
        for name, value in zip(z_shading, gradient, strict=True):
            z_shading[name].append((got[name].value - value) / got[name].u)
    for name, values in (z | z_shading).items():
        check_z(np.array(values), name)


def test_split_without_temporal_noise_is_the_textbook_one(rng: np.random.Generator):
    """Variance components of the random two-way layout from NumPy's sample variances of the row and column means."""
    rows, cols = 21, 34
    image = 100 + lines(rng, (rows, cols), 3.0, 1.5, 1.5)
    flat = lines(rng, (rows, cols), 0.01, 0.008, 0.008)
    flat -= fit_surface(flat, 2).values
    quiet = StackMoments(4, 0.01, image, np.zeros((rows, cols), np.float32), 0.0, np.zeros(4), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    got = fit_spatial(quiet, replace(quiet, mean_map_dn=image + 1000 * (1 + flat)), no_defects((rows, cols)), surface_degree=2)
    for name, unit, x, lost in (("dsnu", "dn", image, (0, 0, 0)), ("prnu", "rel", flat, (1, 2, 2))):
        row, col = x.mean(axis=1), x.mean(axis=0)
        rest = x - row[:, None] - col[None, :] + x.mean()
        pixel = (rest**2).sum() / ((rows - 1) * (cols - 1) - lost[0])
        row_part = row.var() * rows / (rows - 1 - lost[1]) - pixel / cols
        col_part = col.var() * cols / (cols - 1 - lost[2]) - pixel / rows
        wanted = {"pixel": pixel, "row": row_part, "col": col_part, "total": pixel + row_part + col_part}
        for part, value in wanted.items():
            assert got[f"{name}_{part}_{unit}"].value == pytest.approx(math.sqrt(value), rel=1e-6)


def test_temporal_row_noise_is_not_taken_for_fixed_pattern(rng: np.random.Generator):
    """The trap of the standard's split: row noise alone drives its pixel part below zero and gives it a row part."""
    dark, bright = np.full((96, 128), 100.0), np.full((96, 128), 1100.0)
    stacks = stack(rng, dark, 10, 2.0, 2.0), stack(rng, bright, 10, 10.0, 2.0)
    ours, inputs = fit_spatial(*stacks), SpatialInputs.of(stacks[0], high_pass=False)
    standard = spatial_variances(inputs, inputs.vector, "3.1")
    # σ²_row,t/L = 0.4 with a scatter of 5 % in the temporal variance, of 15 % in the row means
    assert -0.55 < standard["s_2_y_pixel"] < -0.25
    assert 0.1 < standard["s_2_y_row"] < 0.8
    # 0.4 = σ²_row,t/L; what is left is its scatter, a few times 0.4 √(2/95)
    assert ours["dsnu_row_dn"].value ** 2 < 0.5
    assert ours["dsnu_pixel_dn"].value ** 2 < 0.03  # ± 0.0054, and where it is not found the limit 1.645 of these above


def test_a_wave_leaves_neither_value_nor_limit_of_rows_and_columns(rng: np.random.Generator):
    """2 % of a fixed wave in the response: −½ 0.02²/n for rows and columns, a hundred u below zero. The pixels' part is the wave's."""
    y, x = np.mgrid[:96, :128]
    wave = 0.02 * np.sin(2 * np.pi * (0.11 * x + 0.17 * y))
    dark = np.full((96, 128), 100.0)
    got = fit_spatial(stack(rng, dark, 8), stack(rng, dark + 1000 * (1 + wave), 8, 10.0), no_defects((96, 128)))
    for name in ("prnu_row_rel", "prnu_col_rel"):
        assert name not in got and "wave" in got.reasons[name]
    assert got["prnu_pixel_rel"].value == pytest.approx(0.02 / math.sqrt(2), rel=0.03)
    assert got["dsnu_row_dn"].kind == "upper_limit" or got["dsnu_row_dn"].value < 0.2


def test_a_moving_wave_is_not_taken_for_rows(rng: np.random.Generator):
    """Twelve frames under a wave of random phase: the mean of their phasors scatters exponentially, and with it pixels, rows and columns.

    No row and column part is there: each is a limit, or within 6 u of zero, and u of the pixels' part holds that scatter. Without it
    a row part of 17 u was seen in one camera of two.
    """
    y, x = np.mgrid[:96, :128]
    for _ in range(6):
        accumulator = StackAccumulator(16)
        for _ in range(12):
            wave = 8 * np.sin(2 * np.pi * (0.11 * x + 0.17 * y + rng.random()))
            accumulator.add(np.rint(100 + wave + rng.normal(0, 2, (96, 128))).astype(np.uint16))
        dark = accumulator.result(0.01)
        moving = PatternList(np.ones(1, bool), *(np.zeros(1),) * 4, np.array([8.0]), np.zeros(1), 0.01, 1, 0.1, 0.1)
        got = fit_spatial(dark, stack(rng, np.full((96, 128), 1100.0), 12, 10.0), no_defects((96, 128)), patterns=moving)
        for name in ("dsnu_row_dn", "dsnu_col_dn"):
            assert name not in got or got[name].kind == "upper_limit" or got[name].value < 6 * got[name].u, name
        assert "dsnu_pixel_dn" in got and got["dsnu_pixel_dn"].value + 6 * got["dsnu_pixel_dn"].u > 0.2


def test_u_of_the_pixels_holds_what_moving_waves_leave_in_a_mean(rng: np.random.Generator):
    """The mean of L waves of amplitude A and any phase has the power A²/2L on average, with the variance (A²/2L)² (1 − 1/L).

    That of L phasors: ⟨|Σ e^(iφ)|⁴⟩ − L² = L² − L. The law of many frames, which is taken, is 4 % more for twelve.
    """
    shape, frames, amplitude = (96, 128), 12, 8.0
    dark, bright = stack(rng, 200 + rng.normal(0, 12, shape), frames), stack(rng, np.full(shape, 1100.0), frames, 10.0)
    moving = PatternList(np.ones(1, bool), *(np.zeros(1),) * 4, np.array([amplitude]), np.zeros(1), 0.01, 1, 0.1, 0.1)
    found, calm = (fit_spatial(dark, bright, no_defects(shape), patterns=some)["dsnu_pixel_dn"] for some in (moving, None))
    added = 2 * found.value * math.sqrt(found.u**2 - calm.u**2)  # of the variance
    assert found.value == calm.value
    assert added == pytest.approx(amplitude**2 / (2 * frames) * math.sqrt(1 - 1 / frames), rel=0.06)


def test_upper_limits_cover_and_significance_is_rare(rng: np.random.Generator):
    """Without any fixed pattern 5 % of the results may be called significant: binomial, ALPHA; a rate above 14 % is caught."""
    runs, none = 150, no_defects(SHAPE)
    significant = {name: 0 for name in ("dsnu_pixel_dn", "dsnu_row_dn", "dsnu_col_dn", "prnu_pixel_rel", "prnu_row_rel", "prnu_col_rel")}
    for _ in range(runs):
        got = fit_spatial(stack(rng, np.full(SHAPE, 100.0), 4), stack(rng, np.full(SHAPE, 1100.0), 4, 10.0), none)
        for name in significant:
            significant[name] += got[name].kind == "value"
            assert got[name].value > 0 and (got[name].kind == "value" or got[name].reason)
    most = stats.binom.isf(ALPHA, runs, 0.05)
    assert all(count <= most for count in significant.values()), significant


def test_limit_covers_a_small_truth(rng: np.random.Generator):
    """A row part that is rarely found is below the stated limit or value + 1.645 u in 95 % of the cases."""
    runs, none, row = 150, no_defects(SHAPE), 0.08
    covered = 0
    for _ in range(runs):
        dark = 100 + lines(rng, SHAPE, 0, row, 0)
        got = fit_spatial(stack(rng, dark, 4), stack(rng, np.full(SHAPE, 1100.0), 4, 10.0), none)["dsnu_row_dn"]
        covered += row <= (got.value if got.kind == "upper_limit" else got.value + 1.645 * got.u)
    assert covered >= stats.binom.ppf(ALPHA, runs, 0.95)


def test_defects_are_found_and_do_not_swamp_the_rest(rng: np.random.Generator):
    shape = (80, 100)
    dark = 100 + lines(rng, shape, 1.0, 0.5, 0.5)
    response = 1 + rng.normal(0, 0.005, shape)
    planted = {"hot": (10, 20), "cold": (70, 90), "dead": (30, 40), "gain": (50, 60), "stuck": (5, 95), "noisy": (60, 10)}
    dark[planted["hot"]] += 80
    dark[planted["cold"]] -= 60
    response[planted["dead"]], response[planted["gain"]] = 0.1, 0.8
    stacks = []
    for mean, white in ((dark, 2.0), (dark + 1000 * response, 10.0)):
        accumulator = StackAccumulator(12)
        for _ in range(20):
            frame = np.rint(mean + rng.normal(0, white, shape))
            frame[planted["noisy"]] += rng.normal(0, 60)
            frame[planted["stuck"]] = 100
            accumulator.add(frame.clip(0).astype(np.uint16))
        stacks.append(accumulator.result(0.01))
    found = find_defects(*stacks)
    listed = {(int(r), int(c)): kind for r, c, kind in zip(found.row, found.col, found.kind, strict=True)}
    assert {place: listed.get(place) for place in planted.values()} == {place: kind for kind, place in planted.items()}
    assert len(found) <= len(planted) + 3
    assert found.mask().sum() == len(found)
    at = {kind: i for i, kind in enumerate(found.kind)}
    assert found.dark_excess_dn[at["hot"]] == pytest.approx(80, abs=6) and found.gain_rel[at["dead"]] == pytest.approx(0.1, abs=0.02)
    got = fit_spatial(*stacks, found)
    for name, value in (("dsnu_pixel_dn", 1.0), ("prnu_pixel_rel", 0.005)):
        assert abs(got[name].value - value) < stats.norm.isf(ALPHA / 2) * got[name].u


def test_false_alarms_are_as_many_as_stated(rng: np.random.Generator):
    """Poisson, ALPHA, for Gaussian pixels: expected 90 in 30 sensors; a rate 1.9 × too high or half of it is caught."""
    count = 0
    for _ in range(30):
        dark = 100 + lines(rng, (60, 90), 2.0, 0.5, 0.5)
        bright = dark + 1000 * (1 + rng.normal(0, 0.01, dark.shape))
        count += len(find_defects(stack(rng, dark, 12), stack(rng, bright, 12, 10.0), expected_false=3.0))
    assert stats.poisson.ppf(ALPHA / 2, 0.7 * 90) <= count <= stats.poisson.isf(ALPHA / 2, 1.3 * 90)


def test_surface_takes_its_own_kind_and_leaves_noise(rng: np.random.Generator):
    y, x = np.mgrid[:40, :60]
    want = 3 + 0.1 * x - 0.02 * y + 1e-3 * x * y - 2e-4 * x**2 * y + 1e-5 * y**4
    np.testing.assert_allclose(fit_surface(want, 4).values, want, rtol=1e-9)
    noise = rng.normal(0, 1, (40, 60))
    fit = fit_surface(noise, 4)
    # 15 terms: the sum of squares that they take is χ² with 15 degrees of freedom
    assert (fit.values**2).sum() < stats.chi2.isf(ALPHA, 15)
    assert 1 + 2 * fit.degree + fit.n_mixed == 15


def test_recovers_fixed_and_moving_patterns(rng: np.random.Generator):
    """Frequencies and amplitudes against the truth; a fixed one within 6 u, a moving one within its ordinate and 1 u.

    The moving one has a quarter of a turn between the frames of a pair, whose differences then have its power: of arbitrary phases they
    scatter so unevenly that one run in a thousand is 6 u low. What is left is noise, a tenth of u.
    """
    shape, n_frames = (120, 160), 16
    y, x = np.mgrid[: shape[0], : shape[1]]
    fixed = 0.4 * np.sin(2 * np.pi * (0.0813 * x + 0.211 * y) + 1.0) + 0.2 * np.sin(2 * np.pi * (0.3 * x - 0.15 * y))

    def frames():
        first = rng.uniform(0, 2 * np.pi, n_frames // 2)
        for phase in np.ravel(np.column_stack([first, first + rng.choice([-np.pi / 2, np.pi / 2], n_frames // 2)])):
            moving = 0.6 * np.sin(2 * np.pi * (0.183 * x - 0.0703 * y) + phase)
            yield np.rint(100 + fixed + moving + lines(rng, shape, 2.0, 0.5, 0.5)).astype(np.uint16)

    group = reduced(frames(), bits=12)
    moments = group.moments.result(0.01)
    found = find_phase_patterns(moments, group.spectra.result(moments.mean_map_dn))
    assert sorted(found.moving.tolist()) == [False, False, True]
    tones = {False: [(0.0813, 0.211, 0.4), (0.3, -0.15, 0.2)], True: [(0.183, -0.0703, 0.6)]}
    for kind, wanted in tones.items():
        for i, (fx, fy, amplitude) in zip(np.flatnonzero(found.moving == kind), wanted, strict=True):
            assert abs(found.frequency_x[i] - fx) < (1 / shape[1] if kind else 6 * found.u_frequency_x[i])
            assert abs(found.frequency_y[i] - fy) < (1 / shape[0] if kind else 6 * found.u_frequency_y[i])
            assert abs(found.amplitude_dn[i] - amplitude) < (1 if kind else 6) * found.u_amplitude_dn[i]


def test_pattern_search_keeps_its_false_alarm_rate(rng: np.random.Generator):
    """At a rate of 0.2 a search, 60 searches: binomial, ALPHA; a rate above 0.62 is caught."""
    hits = 0
    for _ in range(60):
        group = reduced((np.rint(rng.normal(100, 3, (64, 80))).astype(np.uint16) for _ in range(4)), bits=12, spectra_pairs=2)
        moments = group.moments.result(0.01)
        hits += len(find_phase_patterns(moments, group.spectra.result(moments.mean_map_dn), false_alarm_rate=0.2)) > 0
    assert hits <= stats.binom.isf(ALPHA, 60, 0.2)


def test_refuses_stacks_that_do_not_fit(rng: np.random.Generator):
    dark, bright = stack(rng, np.full(SHAPE, 100.0), 3), stack(rng, np.full(SHAPE, 500.0), 3)
    with pytest.raises(InputError):
        fit_spatial(dark, stack(rng, np.full((40, 64), 500.0), 3))
    with pytest.raises((InputError, MeasureError)):
        fit_spatial(bright, dark)
    with pytest.raises(MeasureError):
        fit_spatial(dark, bright, surface_degree=30)
