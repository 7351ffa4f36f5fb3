"""All values of a release together: which there are, what stands for those that cannot be had, and what their uncertainties hold."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from emva.cameras import Camera
from emva.scoring import measured
from emva.truths import truths
from pixmetry import Frames, campaign_of_arrays, emva1288
from pixmetry.camera.observations import LevelMoments
from pixmetry.core.errors import InputError
from pixmetry.emva.evaluate import bootstrap_u, evaluate, standard_values
from pixmetry.emva.files.keys import KEYS, NONLINEAR, OVER_TEMPERATURES, key_of
from pixmetry.emva.general.general import general_notes
from pixmetry.emva.general.general_model import make_plan
from pixmetry.emva.linear_model import departure_bounds, linear_model
from pixmetry.emva.records import RELEASES, Measurement, Results
from pixmetry.emva.series import series_of
from pixmetry.emva.spatial.frame_products import frame_products
from pixmetry.observe.moments import LevelAccumulator
from pixmetry.observe.moments import level_moments as moments_of

ONLY_4_0 = {"LE", "PTC_linearity"} | {key for key in KEYS if key.startswith("general_")}
DRAWS = 1000
# rows of the dark frames are noisy, no pixel has a pattern of its own: before 4.0 the pixels' variance comes out negative
ROWS = Camera(seed=11, row_noise_e=6.0, dsnu_e=(0.0, 0.0, 0.0), prnu_rel=(0.005, 0.0, 0.0), shape=(64, 96), stack_frames=24)


@pytest.fixture(scope="module")
def camera() -> Measurement:
    return measured(ROWS)


@pytest.fixture(scope="module")
def sheets(camera: Measurement) -> dict[str, Results]:
    return {release: evaluate(camera, release, draws=DRAWS) for release in RELEASES}


def only(levels: LevelMoments, at: slice | list[int]) -> LevelMoments:
    return replace(levels, **{k: v[at] for k, v in vars(levels).items() if v is not None})


@pytest.mark.parametrize("release", RELEASES)
def test_every_key_is_there_with_a_value_and_u_or_a_reason(sheets: dict[str, Results], release: str) -> None:
    results = sheets[release]
    own = {key for key in results.values if not key.endswith(NONLINEAR)}
    assert own == set(KEYS) - set(OVER_TEMPERATURES) - (set() if release == "4.0" else ONLY_4_0)
    for key, value in results.values.items():
        assert value.unit == key_of(key).unit, key
        assert value.method, key
        assert value.reason or not value.is_upper_limit, key
        if math.isnan(value.value):
            assert value.reason, key
        else:
            assert math.isfinite(value.u) and value.u >= 0 and value.dof > 0, key


@pytest.mark.parametrize("release", RELEASES)
def test_values_agree_with_the_truth_within_u(sheets: dict[str, Results], release: str) -> None:
    """5.5 u of Student's t with 30 degrees of freedom have a false-failure rate of 1e-6 a value, of 1e-4 for all; limits have 5 %."""
    true = truths(ROWS, release)
    for key in ("R", "K", "QE", "sigma_d", "u_p_min", "s_2_y_pixel", "s_2_y_row_dark", "s_2_y_pixel_dark", "PRNU1288", "PRNU1288_pixel"):
        value = sheets[release].values[key]
        assert abs(value.value - true[key]) < 5.5 * value.u, key


@pytest.mark.parametrize("release", ["3.1", "reference"])
def test_a_negative_variance_is_a_limit_that_names_the_row_noise(sheets: dict[str, Results], release: str) -> None:
    values = sheets[release].values
    assert values["s_2_y_pixel_dark"].value < 0 and not values["s_2_y_pixel_dark"].is_upper_limit
    limit = values["DSNU1288_pixel"]
    assert limit.is_upper_limit and "row" in limit.reason
    row_dn2 = (ROWS.gain_dn_per_e * ROWS.row_noise_e) ** 2
    assert float(limit.reason.split("row (")[1].split()[0]) == pytest.approx(row_dn2, rel=0.15)
    # with the row noise put back what is left is the noise of 24 frames, 4 e⁻ each, in 6144 pixels
    assert 0 < limit.value < 4 / np.sqrt(24)


class Spoilt(Camera):
    """Frames with something added to the charge of every pixel."""

    extra_e: np.ndarray

    def frames(self, number, exposure_s, photons, stream):
        for frame in super().frames(number, exposure_s, photons, stream):
            yield np.clip(np.rint(frame + self.gain_dn_per_e * self.extra_e), 0, self.top).astype(np.uint16)


def spoilt(extra_e: np.ndarray) -> Measurement:
    camera = Spoilt(seed=5, shape=extra_e.shape, levels=12, stack_frames=16, prnu_rel=(0.011, 0.0, 0.0), dsnu_e=(1.0, 0.0, 0.0))
    object.__setattr__(camera, "extra_e", extra_e)
    return measured(camera)


@pytest.mark.parametrize("release", RELEASES)
def test_hot_pixels_that_clip_in_the_light_leave_no_limit_of_the_prnu(release: str, rng: np.random.Generator) -> None:
    """1 % of the pixels have 9000 e⁻ more: full in the light. s²_y − s²_y.dark is then thousands of u below zero, PRNU is 1.1 %."""
    values = standard_values(spoilt(9000.0 * (rng.random((64, 96)) < 0.01)), release, draws=300).values
    for key in ("PRNU1288", "PRNU1288_pixel"):
        assert math.isnan(values[key].value) and not values[key].is_upper_limit
        assert "hot in the dark" in values[key].reason and "highest code" in values[key].reason


def test_hot_pixels_that_clip_leave_no_limit_of_the_prnu_where_there_are_only_stacks() -> None:
    """Pixels 2500 DN above the others in the dark and 1095 in the light, at the top code: the difference of the variances has no root."""
    rng = np.random.default_rng(1)
    hot = rng.random((48, 60)) < 0.01
    groups = [
        Frames(kind, 0.01, np.clip(rng.normal(mean, 8, (16, 48, 60)), 0, 4095).astype(np.uint16))
        for kind, mean in (("dark", np.where(hot, 2600, 100)), ("bright", np.where(hot, 4500, 3000)))
    ]
    values = emva1288(campaign_of_arrays(groups, bits=12)).results[0].values
    for key in ("PRNU1288", "PRNU1288_pixel"):
        assert math.isnan(values[key].value) and not values[key].is_upper_limit and "far below zero" in values[key].reason
    assert values["DSNU1288_DN"].value > 200


@pytest.mark.parametrize("release", RELEASES)
def test_a_wave_across_the_frame_leaves_no_limit_of_rows_and_columns(release: str) -> None:
    """60 e⁻ of a fixed wave: rows and columns come out at −½ 60²/n e⁻², far below zero, where no variance can be; the pixels stand."""
    y, x = np.mgrid[:64, :96]
    values = standard_values(spoilt(60 * np.sin(2 * np.pi * (0.11 * x + 0.17 * y))), release, draws=300).values
    for line in ("row", "col"):
        value = values[f"DSNU1288_{line}"]
        assert math.isnan(value.value) and not value.is_upper_limit and "wave" in value.reason and "no pattern" not in value.reason
    assert values["DSNU1288_pixel"].value == pytest.approx(math.hypot(60 / math.sqrt(2), 1.0), rel=0.02)


def test_no_wave_is_seen_in_pixels_that_are_independent(rng: np.random.Generator) -> None:
    """Strong patterns of pixels alone, 25 sensors: by chance rows come out at −5 u and less, for u is that of measuring this sensor again.

    Four chances of 3e-7 a sensor.
    """
    for seed in rng.integers(2**31, size=25):
        quick = {"shape": (48, 64), "levels": 8, "stack_frames": 16, "dsnu_e": (40.0, 0.0, 0.0), "prnu_rel": (0.02, 0.0, 0.0)}
        values = standard_values(measured(Camera(seed=int(seed), **quick)), "3.1", draws=200).values
        assert all(math.isfinite(values[f"{base}1288_{part}"].value) for base in ("DSNU", "PRNU") for part in ("row", "col")), seed


def test_limits_lie_above_the_truth_in_95_of_100_cameras(rng: np.random.Generator) -> None:
    """100 cameras whose pixels have a pattern of half of what the row noise takes off: covered 80 times or so but for one in 1e6.

    Without the row noise put back none would be covered, without the addition for u a half.
    """
    covered = []
    for seed in rng.integers(2**31, size=100):
        small = {"dark_e_per_s": 0.0, "shape": (32, 48), "levels": 8, "stack_frames": 16, "longest_s": 0.001}
        camera = Camera(seed=int(seed), row_noise_e=6.0, dsnu_e=(1.0, 0.0, 0.0), **small)
        limit = evaluate(measured(camera), "3.1", draws=300).values["DSNU1288_pixel"]
        if limit.is_upper_limit:
            mean = camera.expected(camera.longest_s, 0.0)[0]
            parts = mean - mean.mean(axis=0) - mean.mean(axis=1)[:, None] + mean.mean()
            covered.append(limit.value > parts.std() / camera.gain_dn_per_e)
    assert len(covered) > 80
    assert sum(covered) > stats.binom.ppf(1e-6, len(covered), 0.95)


def test_4_0_takes_the_row_noise_off_the_rows(sheets: dict[str, Results]) -> None:
    row_left = (ROWS.gain_dn_per_e * ROWS.row_noise_e) ** 2 / 24
    assert sheets["3.1"].values["s_2_y_row_dark"].value == pytest.approx(row_left, abs=5 * sheets["3.1"].values["s_2_y_row_dark"].u)
    split = sheets["4.0"].values["s_2_y_row_dark"]
    assert abs(split.value) < 3 * split.u < row_left


@pytest.mark.parametrize("release", RELEASES)
def test_the_standard_alone_says_the_same(camera: Measurement, sheets: dict[str, Results], release: str) -> None:
    alone = standard_values(camera, release, draws=DRAWS)
    assert not alone.curves
    assert set(alone.values) == {key for key in sheets[release].values if not key.endswith(NONLINEAR)}
    for key, value in alone.values.items():
        assert repr(value) == repr(sheets[release].values[key]), key  # NaN is NaN
    assert set(alone.notes) <= set(sheets[release].notes)


def test_the_same_measurement_gives_the_same_bits(camera: Measurement) -> None:
    one, other = (evaluate(camera, "4.0", draws=200).values for _ in range(2))
    assert {k: (v.u, v.dof) for k, v in one.items() if v.u == v.u} == {k: (v.u, v.dof) for k, v in other.items() if v.u == v.u}


def test_the_scale_of_the_photons_reaches_what_is_in_photons_alone(camera: Measurement, sheets: dict[str, Results]) -> None:
    values, without = evaluate(replace(camera, photons_u_rel=0.03), "4.0", draws=DRAWS).values, sheets["4.0"].values
    for key in ("R", "QE", "u_p_sat", "u_p_min", "general_u_p_min"):
        assert values[key].u == pytest.approx(np.hypot(0.03 * values[key].value, without[key].u), rel=0.1), key
    for key in ("K", "u_e_sat", "u_e_min", "SNR_max", "PRNU1288"):
        assert values[key].u == pytest.approx(without[key].u, rel=0.1), key


def test_without_stacks_or_photons_the_rest_stays(camera: Measurement, sheets: dict[str, Results]) -> None:
    dim = replace(camera.transfer, bright=replace(camera.transfer.bright, photons=None))
    values = evaluate(replace(camera, transfer=dim, dark_stack=None, pixel_area_um2=None), "4.0", draws=200).values
    assert values["K"].value == sheets["4.0"].values["K"].value
    assert (values["R"].unit, values["DSNU1288"].value) == ("DN/s", pytest.approx(np.nan, nan_ok=True))
    for key, word in (("DSNU1288", "no dark stack"), ("QE", "photons"), ("u_p_sat", "photons"), ("u_e_min_area", "area")):
        assert math.isnan(values[key].value) and word in values[key].reason, key


def test_light_swept_at_one_exposure_has_no_dark_current_but_everything_else() -> None:
    values = evaluate(measured(Camera(seed=3, light_swept=True, shape=(48, 64), levels=20, stack_frames=16)), "4.0", draws=200).values
    assert {k for k, v in values.items() if math.isnan(v.value)} == {"u_I_mean", "u_I_mean_DN", "u_I_var", "u_I_var_DN"}
    assert "exposures" in values["u_I_mean"].reason
    assert abs(values["K"].value - 0.3) < 5.5 * values["K"].u


def test_dark_noise_below_the_quantisation_is_a_limit_except_in_the_reference() -> None:
    m = measured(Camera(seed=4, read_e=0.3, dark_e_per_s=0.0, dsnu_e=(0.0, 0.0, 0.0), shape=(32, 48), levels=16, stack_frames=16))
    for release in RELEASES:
        values = evaluate(m, release, draws=200).values
        limit = release != "reference"
        assert values["sigma_d"].is_upper_limit == values["u_p_min"].is_upper_limit == limit
        bound = 0.40 if limit else math.sqrt(0.24 - 1 / 12)
        assert values["sigma_d"].value == pytest.approx(bound / values["K"].value)
        assert not values["DR"].is_upper_limit and "0.24 DN²" in values["DR"].reason


def test_a_limit_of_extrapolated_dark_noise_lies_above_the_truth(rng: np.random.Generator) -> None:
    """40 cameras whose dark current outshines a read noise of 5 e⁻ = 1 DN²: the variance at zero exposure comes out below 0.24 DN² often.

    The limits, or the values, must lie above the truth in 95 of 100 cases but for one in 1e6; 0.40/K would lie below it in each.
    """
    strong = {
        "gain_dn_per_e": 0.2,
        "read_e": 5.0,
        "dark_e_per_s": 2e4,
        "longest_s": 0.5,
        "shape": (24, 32),
        "levels": 12,
        "stack_frames": 2,
    }
    limits = []
    for seed in rng.integers(2**31, size=40):
        values = standard_values(measured(Camera(seed=int(seed), **strong)), "3.1", draws=300).values
        if values["sigma_d"].is_upper_limit:
            assert values["u_e_min"].is_upper_limit and "is not significant" in values["DR"].reason
            assert values["u_e_min"].value > values["sigma_d"].value
            limits.append(values["sigma_d"].value > 5.0)
    assert limits
    assert sum(limits) >= stats.binom.ppf(1e-6, len(limits), 0.95)


def test_a_dark_pattern_under_the_quantisation_is_a_limit_above_the_truth() -> None:
    """Noise and pattern of 0.1 DN each, at 12 places of black within a code: the pattern shows as zero, or twice as large."""
    for place in np.arange(12) / 12:
        low = {"gain_dn_per_e": 0.02, "read_e": 5.0, "dark_e_per_s": 0.0, "bits": 8, "dsnu_e": (5.0, 0.0, 0.0), "stack_frames": 16}
        camera = Camera(seed=5, offset_dn=8.0 + place, shape=(32, 48), levels=12, **low)
        values = standard_values(measured(camera), "4.0", draws=200).values
        for key, truth in (("DSNU1288", 5.0), ("DSNU1288_pixel", 5.0), ("general_DSNU", 10.0)):
            assert values[key].is_upper_limit and values[key].value > truth, (place, key)
        for key in ("K", "QE", "u_e_sat", "PRNU1288"):
            assert "quantisation" in values[key].reason or "lowest code" in values[key].reason, key


def test_black_that_is_cut_off_has_no_noise_and_no_pattern() -> None:
    m = measured(Camera(seed=6, offset_dn=-20.0, gain_dn_per_e=0.1, read_e=2.0, shape=(32, 48), levels=20, stack_frames=16))
    values = standard_values(m, "4.0", draws=200).values
    for key in ("DSNU1288", "DSNU1288_pixel", "sigma_d", "u_p_min", "DR", "u_I_mean", "general_DSNU", "general_u_p_min"):
        assert math.isnan(values[key].value) and "lowest code" in values[key].reason, key
    for key in ("K", "QE", "u_e_sat", "PRNU1288"):
        assert math.isfinite(values[key].value) and "lowest code" in values[key].reason, key
    assert math.isfinite(standard_values(m, "reference", draws=200).values["DR"].value)


def test_stuck_pixels_do_not_end_the_series(camera: Measurement, sheets: dict[str, Results]) -> None:
    """0.5 % of the pixels at the top code in every frame: 4.0 finds the saturation that it finds without them."""

    def with_stuck(levels: LevelMoments) -> LevelMoments:
        return replace(levels, fraction_max=0.005 + 0.995 * levels.fraction_max)

    stuck = replace(camera.transfer, bright=with_stuck(camera.transfer.bright), dark=with_stuck(camera.transfer.dark))
    values = standard_values(replace(camera, transfer=stuck), "4.0", draws=DRAWS).values
    for key in ("index_u_ysat", "u_p_sat", "K", "general_u_p_sat", "general_SNR_max"):
        assert values[key].value == pytest.approx(sheets["4.0"].values[key].value, rel=1e-9), key


def test_dark_levels_far_from_the_bright_ones_are_extrapolated_or_named() -> None:
    camera = Camera(seed=9, dark_e_per_s=5e4, light_swept=True, shape=(48, 64), levels=20, stack_frames=4)
    m = measured(camera)
    streams, exposures = iter(range(5000, 6000)), np.array([0.03, 0.04, 0.05, 0.06])
    groups = []
    for t in exposures:
        group = LevelAccumulator(camera.bits)
        for frame in camera.frames(2, t, 0.0, next(streams)):
            group.add(frame)
        groups.append(group.summary())
    dark = moments_of(groups, exposures)
    true = standard_values(m, "3.1", draws=200).values["u_e_sat"]
    beyond = replace(m, transfer=replace(m.transfer, dark=dark))
    found = standard_values(beyond, "3.1", draws=200).values
    assert abs(found["u_e_sat"].value - true.value) < 5.5 * np.hypot(found["u_e_sat"].u, true.u)
    assert "is used unchanged" not in found["K"].reason
    alone = replace(m, transfer=replace(m.transfer, dark=only(dark, [0])))
    values = standard_values(alone, "3.1", draws=200).values
    for key in ("K", "QE", "u_e_sat", "LE_max"):
        assert "0.03 s beside 0.02 s" in values[key].reason, key


def test_degrees_of_freedom_of_saturation_do_not_come_from_the_dark(camera: Measurement) -> None:
    """The level of saturation scatters by the count of its pixels, which is known: dark levels have no part in it."""
    few = replace(camera.transfer, dark=only(camera.transfer.dark, [0, 20, 49]))
    one, other = (standard_values(replace(camera, transfer=t), "4.0", draws=DRAWS).values["u_p_sat"] for t in (camera.transfer, few))
    assert other.dof >= 0.5 * min(one.dof, 1e6)


def test_scatter_between_levels_limits_the_degrees_of_freedom() -> None:
    steady, wild = (measured(Camera(seed=8, setting_rel=s, shape=(48, 64), levels=24, stack_frames=16)) for s in (0.0, 0.01))
    assert evaluate(wild, "3.1", draws=DRAWS).values["R"].dof < 40
    assert evaluate(wild, "3.1", draws=DRAWS).values["R"].u > 10 * evaluate(steady, "3.1", draws=DRAWS).values["R"].u


def test_bounds_of_the_departure_of_a_camera_just_at_the_limit() -> None:
    """One level of normal noise: quantiles of 3 % ± 1.645 σ. More levels can only raise the largest."""
    rng = np.random.default_rng(0)
    low, high = departure_bounds(1.0 + 0.4 * rng.standard_normal((200_000, 1)))
    assert (low, high) == (pytest.approx(3 - 1.645 * 0.4, rel=0.005), pytest.approx(3 + 1.645 * 0.4, rel=0.005))
    lower, higher = departure_bounds(np.array([1.0, -0.9, 0.2]) + 0.4 * rng.standard_normal((50_000, 3)))
    assert lower > low and higher > high
    assert all(np.isnan(departure_bounds(np.empty((10, 0)))))


def test_small_frames_of_a_straight_camera_are_not_said_to_fail(rng: np.random.Generator) -> None:
    """40 cameras of 20 x 24 pixels, whose noisy slopes depart by 8 %: one in 20 may be said to fail, but for one in 1e6."""
    small = {"shape": (20, 24), "levels": 30, "stack_frames": 2, "dark_e_per_s": 0.0, "longest_s": 0.001}
    said, largest = 0, []
    for seed in rng.integers(2**31, size=40):
        results = standard_values(measured(Camera(seed=int(seed), **small)), "4.0", draws=400)
        said += any("does not hold" in note for note in results.notes)
        largest.append(results.values["PTC_linearity"].value)
    assert np.median(largest) > 4
    assert said <= stats.binom.isf(1e-6, 40, 0.05)


def test_the_judgement_is_that_of_the_curve(sheets: dict[str, Results]) -> None:
    results = sheets["4.0"]
    value, curve = results.values["PTC_linearity"], results.curves["PTC"]

    def judged(percent: float) -> str:
        return linear_model(replace(results, values={**results.values, "PTC_linearity": replace(value, value=percent)}))

    low, high = float(curve["departure_low"][0]), float(curve["departure_high"][0])
    assert low < 3 < high
    assert (judged(0.99 * low), judged(3.0), judged(1.01 * high)) == ("holds", "open", "fails")
    assert linear_model(sheets["3.1"]) == "unknown"


def test_notes_of_the_general_model_are_passed_on(sheets: dict[str, Results]) -> None:
    assert set(general_notes(make_plan(series_of(measured(ROWS))))) <= set(sheets["4.0"].notes)


def test_a_bent_photon_transfer_is_noted_and_a_straight_one_is_not(camera: Measurement, sheets: dict[str, Results]) -> None:
    assert not any("Linear model" in note for note in sheets["4.0"].notes)
    bright = camera.transfer.bright
    bent = 1 + 0.5 * bright.mean_dn / bright.mean_dn.max()
    names = ("var_total_dn2", "ms_pixel_dn2", "ms_row_dn2", "ms_col_dn2")
    bright = replace(bright, **{k: getattr(bright, k) * bent for k in names})
    notes = evaluate(replace(camera, transfer=replace(camera.transfer, bright=bright)), "4.0", draws=200).notes
    assert any("Linear model does not hold" in note for note in notes)


def test_notes_tell_what_the_series_lacks(camera: Measurement) -> None:
    short = replace(camera.transfer, bright=only(camera.transfer.bright, slice(0, 20)), dark=only(camera.transfer.dark, [0, 10, 20]))
    notes = " ".join(evaluate(replace(camera, transfer=short), "3.1", draws=200).notes)
    for words in ("ends before saturation", "20 bright levels", "fewer than 6 exposures", "not every bright level has a dark level"):
        assert words in notes


def test_curves_have_the_lengths_of_their_levels(sheets: dict[str, Results]) -> None:
    curves = sheets["4.0"].curves
    for name in ("sensitivity", "PTC", "SNR", "linearity"):
        assert {v.shape for v in curves[name].values()} <= {(50,), (1,)}, name
    used = curves["sensitivity"]["used"]
    assert used[0] and not used[-1]
    # the model goes through what was measured: shot noise and dark noise alone
    snr, model = (curves["SNR"][k][5:40] for k in ("snr", "model"))
    np.testing.assert_allclose(snr, model, rtol=0.1)
    assert (curves["SNR"]["total"] <= curves["SNR"]["model"]).all()
    np.testing.assert_allclose(curves["dark_signal"]["fit_dn"], curves["dark_signal"]["mean_dn"], rtol=0.02)
    assert "general" in curves and "general" not in sheets["3.1"].curves


def test_bootstrap_over_frames_and_analytic_u_agree(camera: Measurement) -> None:
    """24 frames tell their own scatter to 15 %, 50 levels to 10 %: within 60 % an error of a factor of two is caught."""
    with pytest.raises(InputError, match="products"):
        bootstrap_u(camera, "3.1", 100)
    exposure, photons = (v[ROWS.stack_level] for v in ROWS.settings)
    # frames of the same statistics as those of the stacks; the bootstrap takes only their scatter from them
    dark, bright = (frame_products(ROWS.frames(24, exposure, p, stream), ROWS.bits) for p, stream in ((0.0, 900), (photons, 901)))
    found = bootstrap_u(replace(camera, dark_products=dark, bright_products=bright), "3.1", 2000)
    values = evaluate(camera, "3.1", draws=DRAWS).values
    spatial = ("s_2_y_measured", "s_2_y_row_dark", "s_2_y_pixel", "sigma_2_y_stack_dark", "PRNU1288")
    for key in ("R", "K", "sigma_d", "u_I_mean", "LE_max", *spatial):
        assert found[key] == pytest.approx(values[key].u, rel=0.6), key


def test_refuses_what_it_does_not_know(camera: Measurement) -> None:
    with pytest.raises(InputError, match="no such release"):
        evaluate(camera, "5.0")
    two = replace(camera.transfer, bright=only(camera.transfer.bright, slice(0, 2)))
    values = evaluate(replace(camera, transfer=two), "4.0").values
    assert np.isnan(values["K"].value) and "too few bright levels" in values["K"].reason
