"""Sensitivity, linearity and dark current against closed forms and against other implementations of the same rules."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline

from pixmetry.camera.observations import LevelMoments, PhotonTransfer
from pixmetry.core.errors import MeasureError
from pixmetry.emva.general.response import slope_matrix
from pixmetry.emva.records import Measurement, Series
from pixmetry.emva.series import count_exposures, light_of, pairing, series_of, without_dark
from pixmetry.emva.temporal import dark_line, linearity_line, saturation_index, temporal_values

GAIN, EFFICIENCY, DARK_VAR, DARK_DN, DARK_SLOPE = 0.25, 0.5, 4.0, 30.0, 50.0
AREA_UM2 = 20.0
PER_LEVEL = ("mean_dn", "var_dn2", "spatial_var_dn2", "dark_mean_dn", "dark_var_dn2", "own_dark_mean_dn", "own_dark_var_dn2")


def ideal_series(levels: int = 40, bend: float = 0.0) -> Series:
    """A camera without noise of its statistics: y = Kηp, σ² = σ²_dark + K y (1 + bend y); the last two levels clip at the top code."""
    exposure = np.arange(1, levels + 1) * 1e-3
    photons = 1000.0 * np.arange(1, levels + 1)
    signal = GAIN * EFFICIENCY * photons
    dark_mean, dark_var = DARK_DN + DARK_SLOPE * exposure, DARK_VAR + GAIN * DARK_SLOPE * exposure
    top = np.where(np.arange(levels) < levels - 2, 0.0, 0.5)
    return Series(
        exposure_s=exposure,
        photons=photons,
        mean_dn=signal + dark_mean,
        var_dn2=dark_var + GAIN * signal * (1 + bend * signal),
        spatial_var_dn2=np.zeros(levels),
        dark_mean_dn=dark_mean,
        dark_var_dn2=dark_var,
        dark_spatial_var_dn2=np.zeros(levels),
        fraction_min=np.zeros(levels),
        fraction_max=top,
        dark_exposure_s=exposure,
        own_dark_mean_dn=dark_mean,
        own_dark_var_dn2=dark_var,
    )


@pytest.mark.parametrize(
    ("release", "sat", "e_min"),
    [("4.0", 37, np.sqrt(DARK_VAR / GAIN**2 + 0.25) + 0.5), ("3.1", 39, DARK_VAR**0.5 / GAIN + 0.5), ("reference", 39, 8.5)],
)
def test_an_ideal_camera_gives_back_its_parameters(release: str, sat: int, e_min: float) -> None:
    values = temporal_values(ideal_series(), release, AREA_UM2)
    p_sat = 1000.0 * (sat + 1)
    expected = {
        "index_u_ysat": sat,
        "index_sensitivity_max": int(0.7 * (sat + 1)) - 1,
        "index_linearity_min": int(np.ceil(0.05 * (sat + 1))) - 1,
        "index_linearity_max": int(0.95 * (sat + 1)) - 1,
        "R": GAIN * EFFICIENCY,
        "K": GAIN,
        "inverse_K": 4.0,
        "QE": 50.0,
        "sigma_y_dark": 2.0,
        "sigma_d": np.sqrt(4 - 1 / 12) / GAIN,
        "u_e_min": e_min,
        "u_p_min": 2 * e_min,
        "u_p_min_area": 2 * e_min / AREA_UM2,
        "u_p_sat": p_sat,
        "u_e_sat": p_sat / 2,
        "u_e_sat_area": p_sat / 2 / AREA_UM2,
        "SNR_max": np.sqrt(p_sat / 2),
        "SNR_max_dB": 10 * np.log10(p_sat / 2),
        "SNR_max_bit": 0.5 * np.log2(p_sat / 2),
        "inverse_SNR_max": 100 / np.sqrt(p_sat / 2),
        "DR": p_sat / 2 / e_min,
        "DR_dB": 20 * np.log10(p_sat / 2 / e_min),
        "DR_bit": np.log2(p_sat / 2 / e_min),
        "u_I_mean_DN": DARK_SLOPE,
        "u_I_mean": DARK_SLOPE / GAIN,
        "u_I_var": DARK_SLOPE / GAIN,
        "u_I_var_DN": DARK_SLOPE,
    }
    for key, value in expected.items():
        assert values[key] == pytest.approx(value, rel=1e-10), key
    for key in ("LE_min", "LE_max"):
        assert abs(values[key]) < 1e-9


def test_without_photons_the_electrons_stay() -> None:
    series = replace(ideal_series(), photons=None)
    values, known = temporal_values(series, "4.0", AREA_UM2), temporal_values(ideal_series(), "4.0", AREA_UM2)
    assert values["R"] == pytest.approx(GAIN * EFFICIENCY * 1e6)  # DN/s
    for key in ("K", "sigma_d", "u_e_min", "u_e_sat", "SNR_max", "DR", "LE", "u_I_mean"):
        assert values[key] == pytest.approx(float(known[key]), rel=1e-9, abs=1e-9), key
    assert all(np.isnan(values[key]) for key in ("QE", "u_p_min", "u_p_sat", "u_p_min_area"))


def test_light_swept_at_one_exposure_without_photons() -> None:
    whole = ideal_series()
    one = {"dark_exposure_s": np.array([0.02]), "own_dark_mean_dn": np.array([31.0]), "own_dark_var_dn2": np.array([DARK_VAR])}
    series = replace(whole, exposure_s=np.full(40, 0.02), photons=None, **one)
    values = temporal_values(series, "4.0")
    assert values["K"] == pytest.approx(GAIN, rel=1e-10)
    assert values["u_e_sat"] == pytest.approx(19000.0, rel=1e-10)  # of the signal itself
    assert values["sigma_y_dark"] == pytest.approx(2.0)
    assert all(np.isnan(values[key]) for key in ("R", "QE", "LE", "u_I_mean", "u_I_var_DN"))


def test_dark_noise_under_the_quantisation_is_held_at_its_bound() -> None:
    series = ideal_series()
    values = temporal_values(replace(series, own_dark_var_dn2=np.full(40, 0.1)), "3.1")
    assert values["sigma_y_dark"] == pytest.approx(np.sqrt(0.24))
    assert values["sigma_d"] == pytest.approx(np.sqrt(0.24 - 1 / 12) / GAIN)


def test_refuses_a_series_without_levels_to_fit() -> None:
    series = ideal_series(3)
    with pytest.raises(MeasureError, match="70 %"):
        temporal_values(replace(series, fraction_max=np.array([0.0, 0.0, 1.0]), mean_dn=np.array([1000.0, 1100.0, 1200.0])), "4.0")


def test_draws_are_the_same_as_one_after_the_other() -> None:
    rng, series = np.random.default_rng(5), ideal_series()
    many = replace(series, **{k: getattr(series, k) * rng.normal(1, 0.01, (7, 40)) for k in PER_LEVEL})
    many = replace(many, photons=series.photons * rng.normal(1, 0.01, (7, 1)), fraction_max=rng.uniform(0, 0.004, (7, 40)))
    for release in ("4.0", "3.1", "reference"):
        together = temporal_values(many, release, AREA_UM2)
        for i in range(7):
            one = replace(many, **{k: getattr(many, k)[i] for k in (*PER_LEVEL, "photons", "fraction_max")})
            for key, value in temporal_values(one, release, AREA_UM2).items():
                if key != "PTC_linearity":  # smoothed at the mean of the draws
                    np.testing.assert_allclose(together[key][i], value, rtol=1e-12, err_msg=f"{release} {key}")


def walk(var: list[float]) -> int:
    """The public implementation's search for saturation, level by level."""
    kept, index = 0.0, 0
    for i in reversed(range(len(var))):
        before = var[i - 1] if i else var[1]
        if var[i] < kept and before < kept:
            break
        kept, index = var[i], i
    return index


def test_saturation_of_the_reference_is_a_walk_from_the_end() -> None:
    rng = np.random.default_rng(1)
    rise = np.concatenate([np.linspace(1, 30, 25), np.linspace(30, 0, 15) ** 2 / 30])
    var = np.abs(rise * rng.normal(1, rng.choice([0.003, 0.03, 0.3], (500, 1)), (500, 40)))
    series = replace(ideal_series(), var_dn2=var)
    np.testing.assert_array_equal(saturation_index(series, "reference"), [walk(list(v)) for v in var])


def test_saturation_of_the_releases() -> None:
    series = ideal_series()
    fraction = np.zeros(40)
    fraction[30:] = [0.0019, 0.0021, 0.3, 0.9, 1, 1, 1, 1, 1, 1]
    assert saturation_index(replace(series, fraction_max=fraction), "4.0") == 30
    # a full well below the top code: the variance falls before any pixel gets there
    var = series.var_dn2.copy()
    var[33:] = 0.5 * var[32]
    below = replace(series, fraction_max=np.zeros(40), var_dn2=var)
    assert saturation_index(below, "4.0") == saturation_index(below, "3.1") == 32
    # noise on the last levels is no full well
    var = series.var_dn2.copy()
    var[39] = 0.97 * var[38]
    assert saturation_index(replace(series, fraction_max=np.zeros(40), var_dn2=var), "4.0") == 39


def test_levels_that_fall_back_after_saturation_are_left_out_but_by_the_reference() -> None:
    series = ideal_series()
    mean = series.mean_dn.copy()
    mean[39] = series.dark_mean_dn[39] + 100.0  # solarised
    values = temporal_values(replace(series, mean_dn=mean), "4.0")
    assert (values["index_sensitivity_max"], values["index_linearity_max"]) == (25, 35)
    assert values["K"] == pytest.approx(GAIN, rel=1e-10)
    assert (
        temporal_values(replace(series, mean_dn=mean, var_dn2=np.append(series.var_dn2[:39], 0.0)), "reference")["index_sensitivity_max"]
        == 39
    )


def test_linearity_is_the_weighted_line_of_numpy() -> None:
    rng = np.random.default_rng(2)
    light = np.sort(rng.uniform(0, 1e4, 30))
    signal = 3 + 0.2 * light * (1 + 1e-6 * light)
    used = (signal >= 0.05 * signal[29]) & (signal <= 0.95 * signal[29])
    line = linearity_line(light, signal, np.array(29), np.flatnonzero(used).max())
    slope, offset = np.polyfit(light[used], signal[used], 1, w=1 / signal[used])
    assert (line["fit_slope"], line["fit_offset"]) == (pytest.approx(slope, rel=1e-9), pytest.approx(offset, rel=1e-7))
    deviation = 100 * (signal / (offset + slope * light) - 1)[used]
    assert line["LE"] == pytest.approx(np.abs(deviation).mean(), rel=1e-6)
    assert (line["LE_min"], line["LE_max"]) == (pytest.approx(deviation.min(), rel=1e-6), pytest.approx(deviation.max(), rel=1e-6))


@pytest.mark.parametrize("stiffness", [1e-4, 1e-2, 1.0])
def test_local_slope_is_that_of_scipys_smoothing_spline(stiffness: float) -> None:
    rng = np.random.default_rng(3)
    x, weights = np.sort(rng.uniform(0, 1, 25)), rng.uniform(0.5, 2, 25)
    y = np.sin(6 * x)
    spline = make_smoothing_spline(x, y, weights, stiffness)
    trace = sum(make_smoothing_spline(x, row, weights, stiffness)(x[i]) for i, row in enumerate(np.eye(25)))
    np.testing.assert_allclose(slope_matrix(x, weights, float(trace)) @ y, spline.derivative()(x), atol=1e-6)


def test_ptc_linearity_sees_a_bent_photon_transfer() -> None:
    """A variance K y (1 + b y) has the slope K (1 + 2 b y); the largest departure from the fitted K is at one of the ends."""
    assert temporal_values(ideal_series(), "4.0")["PTC_linearity"] < 1e-6
    values = temporal_values(ideal_series(bend=1e-5), "4.0")
    fitted, y = float(values["K"]), GAIN * EFFICIENCY * 1000 * np.arange(1, 27)
    ends = 100 * np.abs(GAIN * (1 + 2e-5 * y[[0, -1]]) / fitted - 1)
    # the spline is straight at its ends and follows a parabola there by six tenths
    assert values["PTC_linearity"] == pytest.approx(0.6 * ends.max(), rel=0.05)


def test_pairing_takes_the_same_exposure_then_the_line_between() -> None:
    dark = np.array([0.01, 0.02, 0.02, 0.04])
    weights = pairing(np.array([0.02, 0.010005, 0.03]), dark)
    np.testing.assert_allclose(weights, [[0, 0.5, 0.5, 0], [1, 0, 0, 0], [0, 0, 0.5, 0.5]])


def test_pairing_goes_on_along_the_dark_line_or_stops_at_the_nearest_level() -> None:
    dark, values, far = np.array([0.01, 0.02, 0.02, 0.04]), np.array([5.0, 6.0, 7.0, 9.0]), np.array([0.001, 0.05])
    line = np.polynomial.Polynomial.fit(dark, values, 1)
    np.testing.assert_allclose(pairing(far, dark) @ values, line(far), rtol=1e-12)
    assert not without_dark(far, dark).any()
    two = np.array([0.01, 0.01000005, 0.04])  # the first two are one exposure
    np.testing.assert_allclose(pairing(far, two), [[0.5, 0.5, 0], [0, 0, 1]])
    np.testing.assert_array_equal(without_dark(np.array([0.001, 0.01, 0.02, 0.05]), two), [True, False, False, True])


def test_clocks_that_are_read_back_with_noise_make_no_exposure_sweep(rng: np.random.Generator) -> None:
    """Light swept at 0.02 s, exposures read back to 1e-4: the same series as with exact ones, whether photons are known or not."""
    n = 20
    mean = np.linspace(50.0, 900.0, n)
    for photons in (None, 10 * mean):
        found = []
        for noise in (0.0, 1e-4):
            steps = rng.permutation(np.linspace(-1, 1, n + 6))  # no two alike: equal exposures would belong to each other
            exposure, dark_s = 0.02 * (1 + noise * steps[:n]), 0.02 * (1 + noise * steps[n:])
            shuffled = rng.permutation(n)
            lit = None if photons is None else list(photons[shuffled])
            bright = level_moments(list(exposure), lit, list(mean[shuffled]))
            found.append(series_of(Measurement(PhotonTransfer(bright, level_moments(list(dark_s), None, [30.0] * 6), (4, 4), 10))))
        exact, noisy = found
        np.testing.assert_array_equal(noisy.mean_dn, exact.mean_dn)
        np.testing.assert_array_equal(noisy.mean_dn, mean)
        np.testing.assert_allclose(noisy.dark_mean_dn, 30.0)
        assert (light_of(noisy) is None) == (light_of(exact) is None) == (photons is None)
        slopes = dark_line(noisy)
        assert np.isnan(slopes[1]) and np.isnan(slopes[3]) and slopes[0] == pytest.approx(30.0)
        # all six dark levels beside each bright one, not the one that is nearest by chance
        assert pairing(noisy.exposure_s, noisy.dark_exposure_s).max() < 0.2


def test_exposures_are_counted_as_equal_within_one_per_cent() -> None:
    assert count_exposures(np.array([0.02, 0.020001, 0.0201])) == 1
    assert count_exposures(np.array([0.0, 0.01, 0.010001, 0.02, 0.0200001])) == 3


def test_pixels_that_are_at_the_top_code_in_the_dark_are_no_saturation() -> None:
    """0.5 % of the pixels are stuck at the top: saturation is where it is without them."""
    clean = level_moments([0.01, 0.02, 0.03, 0.04], [1, 2, 3, 4], [30.0, 60.0, 90.0, 100.0])
    clean = replace(clean, fraction_max=np.array([0.0, 0.0, 0.001, 1.0]))
    dark = replace(level_moments([0.01, 0.02, 0.03, 0.04], None, [1.0] * 4), fraction_max=np.zeros(4))
    stuck = [replace(part, fraction_max=0.005 + 0.995 * part.fraction_max) for part in (clean, dark)]
    one, other = (series_of(Measurement(PhotonTransfer(*both, (4, 4), 8))) for both in ((clean, dark), stuck))
    np.testing.assert_allclose(other.fraction_max, one.fraction_max, atol=1e-12)
    assert saturation_index(other, "4.0") == saturation_index(one, "4.0") == 2


def level_moments(exposure: list[float], photons: list[float] | None, mean: list[float]) -> LevelMoments:
    ones = np.ones(len(exposure))
    lit = None if photons is None else np.array(photons)
    return LevelMoments(np.array(exposure), lit, 2 * ones, np.array(mean), *[ones] * 5, 0 * ones, 0 * ones, 0 * ones, ones)


def test_series_sorts_by_light_and_sets_each_level_beside_its_dark_one() -> None:
    bright = level_moments([0.03, 0.01, 0.02], [300, 100, 200], [33.0, 11.0, 22.0])
    dark = level_moments([0.02, 0.03, 0.01], None, [2.0, 3.0, 1.0])
    series = series_of(Measurement(PhotonTransfer(bright, dark, (4, 4), 8)))
    np.testing.assert_array_equal(series.mean_dn, [11, 22, 33])
    np.testing.assert_array_equal(series.dark_mean_dn, [1, 2, 3])
    np.testing.assert_array_equal(series.own_dark_mean_dn, [1, 2, 3])
    with pytest.raises(MeasureError, match="no dark level"):
        series_of(Measurement(PhotonTransfer(bright, level_moments([], None, []), (4, 4), 8)))
    with pytest.raises(MeasureError, match="too few bright levels"):
        series_of(Measurement(PhotonTransfer(level_moments([0.1], [1], [1]), dark, (4, 4), 8)))
