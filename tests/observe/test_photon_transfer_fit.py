"""The joint photon-transfer fit against cameras simulated without it (``simulated_camera``: exact cumulants, drawn records, frames)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from observe.simulated_camera import Camera, drawn_levels, drawn_record, framed_record, random_camera, reference_u, truth
from pixmetry.camera.observations import LevelMoments, PhotonTransfer, StackMoments
from pixmetry.core.errors import MeasureError
from pixmetry.emva.evaluate import standard_values
from pixmetry.emva.records import Measurement
from pixmetry.observe import photon_transfer_model as model
from pixmetry.observe.photon_transfer_fit import fit_photon_transfer

KS_PARAMETERS = (
    "gain_dn_per_e",
    "dark_noise_e",
    "row_noise_e",
    "offset_dn",
    "nonlinearity_a1",
    "nonlinearity_a2",
    "nonlinearity_a3",
    "responsivity_dn_per_s",
    "full_well_e",
)


def z_of(estimate, true: float) -> float:
    """Deviation in standard uncertainties, as a normal quantile of equal tail probability."""
    p = stats.t.sf(abs(estimate.value - true) / estimate.u, min(estimate.dof, 1e9))
    return float(np.sign(estimate.value - true) * stats.norm.isf(p))


def test_recovers_gain_and_dark_noise_of_a_non_linear_camera_without_bias(rng: np.random.Generator):
    """200 cameras, 640 × 480, 50 × 2 exposures, y(1 − 0.02 w³): within 0.1 % in the mean, where the standard's line is 2 % off."""
    camera = Camera(gain=0.1, dark_noise_e=30.0, a=(0.0, 0.0, -0.02), row_noise_e=5.0)
    records = [drawn_record(camera, rng) for _ in range(200)]
    fits = [fit_photon_transfer(r) for r in records]
    for name in ("gain_dn_per_e", "dark_noise_e"):
        true = truth(camera)[name]
        values = np.array([f[name].value for f in fits])
        z = np.array([z_of(f[name], true) for f in fits])
        assert abs(values.mean() / true - 1) < 1e-3
        assert abs(z.mean()) * np.sqrt(200) < 4.9
        assert abs(z.std() - 1) < 4.9 / np.sqrt(2 * 200)
    linear = np.mean([standard_values(Measurement(r), "3.1", draws=100).values["K"].value for r in records[:5]])
    assert abs(linear / 0.1 - 1) > 0.005


def test_stat_probability_transform_is_uniform_over_random_cameras(rng: np.random.Generator):
    """Kolmogorov-Smirnov over 300 cameras at 1e-7 for each parameter; a u wrong by a factor of 1.8 or a bias of 0.5 u is caught."""
    p = {name: [] for name in KS_PARAMETERS}
    for _ in range(300):
        camera = random_camera(rng)
        e = fit_photon_transfer(drawn_record(camera, rng))
        for name in KS_PARAMETERS:
            if e[name].kind != "upper_limit":
                p[name].append(stats.norm.cdf(z_of(e[name], truth(camera)[name])))
    for name, values in p.items():
        assert stats.kstest(values, "uniform").pvalue > 1e-7, name


@pytest.mark.parametrize("lamp", [0.0, 0.001])
def test_u_is_close_to_the_cramer_rao_bound(lamp, rng: np.random.Generator):
    """Root mean square of u over 30 records at most 1.15 × the bound with all weights known, from finite differences of exact moments."""
    camera = Camera(a=(-0.02, 0.01, -0.01), levels=30, lamp=lamp, wander_dn=0.01)
    bound = reference_u(camera)
    fits = [fit_photon_transfer(drawn_record(camera, rng)) for _ in range(30)]
    for name in ("gain_dn_per_e", "dark_noise_e", "nonlinearity_a1", "nonlinearity_a3", "responsivity_dn_per_s"):
        ratio = np.sqrt(np.mean([f[name].u ** 2 for f in fits])) / bound[name]
        assert 0.85 < ratio < 1.15, (name, ratio)


def test_recovers_from_real_frames(rng: np.random.Generator):
    """Frames with PRNU, shading, row noise and flicker between the frames: 42 values of six cameras within their u, 1e-6 for all."""
    for _ in range(6):
        camera = Camera(
            gain=10 ** rng.uniform(-1.3, 0), dark_noise_e=15.0, row_noise_e=6.0, a=tuple(rng.normal(0, 0.015, 3)), bits=10,
            offset_dn=100.0, shape=(96, 128), levels=14, lamp=0.001, prnu=0.01, dsnu_dn=0.7, dark_current_e_per_s=0.0,
        )  # fmt: skip
        e = fit_photon_transfer(framed_record(camera, rng, shading=0.1))
        for name in ("gain_dn_per_e", "dark_noise_e", "row_noise_e", "offset_dn", "nonlinearity_a1", "nonlinearity_a2", "nonlinearity_a3"):
            assert abs(z_of(e[name], truth(camera)[name])) < stats.norm.isf(1e-6 / 84), (name, e[name], camera)


def test_clamped_black_level_gives_dark_current_from_the_variance(rng: np.random.Generator):
    camera = Camera(dark_current_e_per_s=20000.0, clamped=True)
    e = fit_photon_transfer(drawn_record(camera, rng))
    assert "variance" in e["dark_current_e_per_s"].reason
    assert abs(z_of(e["dark_current_e_per_s"], 20000.0)) < 4.9
    assert abs(z_of(e["gain_dn_per_e"], camera.gain)) < 4.9


def test_limits_where_nothing_is_significant(rng: np.random.Generator):
    e = fit_photon_transfer(drawn_record(Camera(row_noise_e=0.0, dark_current_e_per_s=0.0), rng))
    assert {"column_noise_e"} <= e.limits
    for name in e.limits:
        assert "95 %" in e.reasons[name] and e[name].value > 0


def test_dark_noise_below_quantisation_is_a_bound(rng: np.random.Generator):
    camera = Camera(gain=0.01, dark_noise_e=5.0, row_noise_e=0.0, shape=(120, 160))
    e = fit_photon_transfer(drawn_record(camera, rng))
    assert e["dark_noise_e"].kind == "upper_limit"
    assert e["dark_noise_e"].value == pytest.approx(0.40 / e["gain_dn_per_e"].value)


def test_clipped_black_takes_the_dark_noise_from_the_bright_levels(rng: np.random.Generator):
    """With the dark frames clipped at zero their mean and variance are wrong; gain and noise must still be within u."""
    camera = Camera(row_noise_e=0.0, dark_current_e_per_s=0.0)
    pt = drawn_record(camera, rng)
    clipped = replace(pt.dark, fraction_min=np.full(50, 0.2), mean_dn=pt.dark.mean_dn + 0.7, ms_pixel_dn2=pt.dark.ms_pixel_dn2 * 0.6)
    e = fit_photon_transfer(replace(pt, dark=clipped))
    assert "clipped" in e["dark_noise_e"].reason
    assert abs(z_of(e["gain_dn_per_e"], camera.gain)) < 4.9
    if e["dark_noise_e"].kind == "value":
        assert abs(z_of(e["dark_noise_e"], camera.dark_noise_e)) < 4.9
    else:
        assert e["dark_noise_e"].value > 0.8 * camera.dark_noise_e


def test_full_well_below_the_top_code(rng: np.random.Generator):
    camera = Camera(over=1.5, row_noise_e=0.0, dark_current_e_per_s=0.0)
    pt = drawn_record(replace(camera, bits=14, over=0.3), rng)  # a 14-bit converter that the pixels cannot fill
    full_dn = 3000.0
    full = pt.bright.mean_dn > full_dn
    bright = replace(
        pt.bright, mean_dn=np.where(full, full_dn, pt.bright.mean_dn), ms_pixel_dn2=np.where(full, 9.0, pt.bright.ms_pixel_dn2)
    )
    e = fit_photon_transfer(replace(pt, bright=bright))
    assert e["saturation_dn"].value == pytest.approx(full_dn)
    assert abs(e["full_well_e"].value - (full_dn - camera.offset_dn) / camera.gain) < 4.9 * e["full_well_e"].u
    assert "below the top code" in e["full_well_e"].reason


def test_photons_at_constant_exposure(rng: np.random.Generator):
    """Light set by the lamp, one dark level: no dark current, efficiency from the photons."""
    camera = Camera(dark_current_e_per_s=0.0)
    t = camera.times
    bright = drawn_levels(camera, t, camera.rate_dn_per_s, rng)
    dark = drawn_levels(camera, t[:1], 0.0, rng)
    efficiency = 0.6
    photons = camera.rate_dn_per_s * t / camera.gain / efficiency
    same_time = np.full(t.size, t[0])
    e = fit_photon_transfer(PhotonTransfer(replace(bright, photons=photons, exposure_s=same_time), dark, camera.shape, camera.bits))
    assert "dark_current_e_per_s" not in e and "responsivity_dn_per_s" not in e
    assert abs(z_of(e["quantum_efficiency"], efficiency)) < 4.9
    assert "dark signal" in e["offset_dn"].reason


def test_scales_with_the_units_of_time(rng: np.random.Generator):
    """Exposure in other units changes rates and nothing else."""
    pt = drawn_record(Camera(levels=15), rng)
    bright, dark = (replace(m, exposure_s=m.exposure_s * 1e6) for m in (pt.bright, pt.dark))
    slow = replace(pt, bright=bright, dark=dark)
    a, b = fit_photon_transfer(pt), fit_photon_transfer(slow)
    assert b["gain_dn_per_e"].value == pytest.approx(a["gain_dn_per_e"].value, rel=1e-6)
    assert b["responsivity_dn_per_s"].value == pytest.approx(a["responsivity_dn_per_s"].value * 1e-6, rel=1e-6)


def stack_of(level: LevelMoments, shape: tuple[int, int]) -> StackMoments:
    """A stack with the moments of one drawn level and no fixed pattern."""
    v = {name: float(getattr(level, name)[0]) for name in LevelMoments.__dataclass_fields__ if name != "photons"}
    mean_map, var_map = np.full(shape, v["mean_dn"]), np.full(shape, v["ms_pixel_dn2"], np.float32)
    ms = [v[f"ms_{kind}_dn2"] for kind in ("pixel", "pixel", "row", "col", "frame")]
    return StackMoments(int(v["n_frames"]), v["exposure_s"], mean_map, var_map, v["mean_dn"], np.full(100, v["mean_dn"]), *ms, 0.0, 0.0)


def test_stacks_add_information(rng: np.random.Generator):
    """100 more dark frames leave a third of u of the row noise; a bright stack must not disturb."""
    camera = Camera(levels=12, shape=(120, 160), row_noise_e=10.0)
    pt = drawn_record(camera, rng)
    dark = stack_of(drawn_levels(camera, camera.times[:1], 0.0, rng, frames=100), camera.shape)
    bright = stack_of(drawn_levels(camera, camera.times[5:6], camera.rate_dn_per_s, rng, frames=100), camera.shape)
    plain, more = fit_photon_transfer(pt), fit_photon_transfer(pt, dark, bright)
    assert more["row_noise_e"].u < 0.6 * plain["row_noise_e"].u
    for name in ("gain_dn_per_e", "dark_noise_e", "row_noise_e", "offset_dn"):
        assert abs(z_of(more[name], truth(camera)[name])) < 4.9


@pytest.mark.parametrize("case", ["no dark", "three levels", "all saturated", "all black", "no light known"])
def test_refuses_with_a_remedy(case, rng: np.random.Generator):
    camera = Camera(levels=3 if case == "three levels" else 12, shape=(48, 64))
    pt = drawn_record(camera, rng)
    if case == "no dark":
        nothing = {k: None if getattr(pt.dark, k) is None else getattr(pt.dark, k)[:0] for k in LevelMoments.__dataclass_fields__}
        pt = replace(pt, dark=LevelMoments(**nothing))
    elif case == "all saturated":
        pt = replace(pt, bright=replace(pt.bright, fraction_max=np.ones(12), mean_dn=np.full(12, 4095.0), ms_pixel_dn2=np.zeros(12)))
    elif case == "all black":
        pt = replace(pt, bright=replace(pt.dark, exposure_s=pt.bright.exposure_s))
    elif case == "no light known":
        pt = replace(pt, bright=replace(pt.bright, exposure_s=np.full(12, 0.01)))
    with pytest.raises(MeasureError) as error:
        fit_photon_transfer(pt)
    assert error.value.remedy


def test_few_levels_stay_solvable(rng: np.random.Generator):
    """Five levels leave the non-linearity to its prior: values are wide, never wrong by more than their u at 1e-6."""
    camera = Camera(levels=5, over=0.9, shape=(120, 160))
    e = fit_photon_transfer(drawn_record(camera, rng))
    for name in ("gain_dn_per_e", "dark_noise_e", "offset_dn"):
        assert abs(z_of(e[name], truth(camera)[name])) < 4.9


def test_excess_scatter_of_the_variances_widens_u(rng: np.random.Generator):
    """Variances that scatter by 1 % beyond their sampling law (interference, real cameras) are noticed and widen u."""
    camera = Camera(levels=30)
    pt = drawn_record(camera, rng)
    plain = fit_photon_transfer(pt)
    shaken = pt.bright.ms_pixel_dn2 * (1 + 0.02 * rng.standard_normal(30))
    e = fit_photon_transfer(replace(pt, bright=replace(pt.bright, ms_pixel_dn2=shaken)))
    assert "scatter" in e["gain_dn_per_e"].reason
    assert e["gain_dn_per_e"].u > 2 * plain["gain_dn_per_e"].u
    assert abs(z_of(e["gain_dn_per_e"], camera.gain)) < 5.3


def test_mean_and_mean_square_of_a_level_vary_together_as_stated(rng):
    """Pairs of tiny frames of few electrons, where both go together: 20 000 draws against the stated 2 × 2 covariance.

    A correlation of n pairs is good to 1/√n: 4.9/√20000 = 0.035 at 1e-6, and its sign differs by 0.25. Variances: 4.9 √(3/n) = 6 %.
    """
    n, pixels = 20_000, 40
    gain, read2, light = 3.0, 18.0, 6.0  # DN/e-, DN², DN: two electrons
    pairs = gain * rng.poisson(light / gain, (n, 2, pixels)) + rng.normal(0, read2**0.5, (n, 2, pixels))
    half = (pairs[:, 1] - pairs[:, 0]) / 2**0.5
    one, zero = np.ones(n), np.zeros(n)
    levels = model.Levels(
        bright=one.astype(bool), light=one, time=zero, mean=pairs.mean(axis=(1, 2)), ms=half.var(axis=1, ddof=1) + 1 / 12, spatial=zero,
        row_col_var=zero, n_frames=2 * one, ms_dof=(pixels - 1) * one, kurtosis=np.nan * one, leak=zero, dither=100.0 * one, dnl_lsb=0.0,
        coherence=0.0, pixels=pixels, x_ref=4095.0,
    )  # fmt: skip
    p = np.zeros(len(model.PARAMETERS))
    p[[model.SLOPE, model.GAIN, model.DARK_VAR]] = light, gain, read2
    got = model.linearise(p, levels)
    seen = np.cov(got.residual[:n], got.residual[n:])
    assert seen[0, 0] == pytest.approx(got.v_mean.mean(), rel=0.06)
    assert seen[1, 1] == pytest.approx(got.v_ms.mean(), rel=0.08)
    stated = got.v_cross.mean() / np.sqrt(got.v_mean.mean() * got.v_ms.mean())
    assert abs(stated) > 0.1
    assert np.corrcoef(got.residual[:n], got.residual[n:])[0, 1] == pytest.approx(stated, abs=0.035)
