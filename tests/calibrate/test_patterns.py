"""Patterns are found with their size where they are, and not where they are not. Statistical tests fail once in a million runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from calibrate.adjusted import NOISE_PX, adjusted, measured_again, shifted
from calibrate.networks import SENSOR, Simulated, predicted, simulate
from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.bundle.network import SCALE
from pixmetry.calibrate.bundle.solve import calibrate_network
from pixmetry.calibrate.checks.added_terms import AddedTerms, Normals, derivatives
from pixmetry.calibrate.checks.causes import causes_of, chosen_among
from pixmetry.calibrate.checks.patterns import MEANING, pattern_findings, residual_patterns
from pixmetry.calibrate.records import Pattern
from pixmetry.camera.catalogue import sources

RATE = 1e-6
WAVES = ("wave_xx", "wave_xy", "wave_yy")


def network_of(rng, **options) -> tuple[Simulated, np.ndarray]:
    simulated = simulate(rng, **({"images": 12, "points": 70} | options))
    return simulated, predicted(simulated.network, simulated.truth)


def by_name(found, **options) -> dict[str, dict]:
    return {record.name: record for record in residual_patterns(found, **options)}


@pytest.mark.parametrize("known", ["free", "fixed", "bars to a nanometre"])
def test_added_term_is_what_an_adjustment_with_it_finds(rng, known):
    """b1, held at 0 in one adjustment and estimated in another: value, uncertainty and F agree to first order."""
    bars = "bars" in known
    simulated, _ = network_of(rng, **({"bars": 3} if bars else {"known": known}), interior={"b1": 2e-5})
    if bars:
        given, xyz = simulated.network.bars, simulated.truth.xyz
        exact = replace(given, length=np.linalg.norm(xyz[given.end] - xyz[given.start], axis=1), u=np.full(3, 1e-6))
        simulated = replace(simulated, network=replace(simulated.network, bars=exact))
    camera = simulated.network.cameras[0]
    fewer = replace(camera, free=camera.free & (np.array(NAMES) != "b1"))
    held = replace(simulated.truth, interior=simulated.truth.interior * (np.array(NAMES) != "b1"))
    without = adjusted(replace(simulated.network, cameras=(fewer,)), replace(simulated, truth=held))
    terms = AddedTerms(without)
    slopes = derivatives(without.network, without.state).by_interior[terms.rows, :, NAMES.index("b1")]
    term = terms.test(slopes[:, :, None])
    full = adjusted(simulated.network, simulated)
    names, covariance = full.interior_covariance()
    u = np.sqrt(covariance[names.index("b1"), names.index("b1")])
    squares = [part.sigma0**2 * part.dof for part in (without, full)]
    assert term.values[0] == pytest.approx(full.camera()["b1"], abs=0.03 * u)
    assert np.sqrt(term.covariance[0, 0]) == pytest.approx(u, rel=0.01)
    assert term.f == pytest.approx((squares[0] - squares[1]) / full.sigma0**2, rel=0.02, abs=0.02)
    assert term.p == pytest.approx(stats.f.sf(term.f, 1, full.dof), rel=1e-6)


def test_added_x_scale_by_image_is_what_an_adjustment_with_it_finds(rng):
    simulated, _ = network_of(rng, per_image=("x_scale",), x_scale_u=3e-5)
    still = replace(simulated.truth, x_scale=np.zeros(12))
    without = adjusted(replace(simulated.network, per_image=()), replace(simulated, truth=still))
    full = adjusted(simulated.network, simulated)
    record = by_name(without)["x_scale_by_image"]
    squares = [part.sigma0**2 * part.dof for part in (without, full)]
    dof = without.dof - full.dof
    f = (squares[0] - squares[1]) / dof / full.sigma0**2
    assert dof == 11 and record.p == pytest.approx(stats.f.sf(f, dof, full.dof), rel=0.1, abs=1e-12)
    assert np.abs(record.by_image.values - full.state.x_scale).max() < 0.1 * record.by_image.u.max()
    rows = [full.free_columns.index(f"{name}:x_scale") for name in record.by_image.images]
    np.testing.assert_allclose(record.by_image.u, np.sqrt(np.diag(full.covariance)[rows]), rtol=0.05)


def test_derivatives_by_image_and_point_are_slopes(rng):
    """Against difference quotients of the other projection."""
    simulated, exact = network_of(rng, images=4, points=15, per_image=("x_scale", "x_shift"))
    network, truth = simulated.network, simulated.truth
    d = derivatives(network, truth)
    np.testing.assert_allclose(d.computed, exact, atol=1e-7)
    for place, h in ((3, 1e-3), (4, 1e-3), (5, 1e-3), (SCALE, 1e-6)):
        ends = []
        for sign in (1, -1):
            step = np.zeros((4, 3))
            if place < SCALE:
                step[:, place - 3] = sign * h
            scale = truth.x_scale + sign * h * (place == SCALE)
            ends.append(predicted(network, replace(truth, position=truth.position + step, x_scale=scale)))
        np.testing.assert_allclose(d.by_image[:, :, place], (ends[0] - ends[1]) / (2 * h), rtol=1e-4, atol=1e-5)
    for axis in range(3):
        ends = [predicted(network, replace(truth, xyz=truth.xyz + sign * 1e-3 * np.eye(3)[axis])) for sign in (1, -1)]
        np.testing.assert_allclose(d.by_point[:, :, axis], (ends[0] - ends[1]) / 2e-3, rtol=1e-4, atol=1e-5)


def test_stat_p_is_uniform_where_there_is_no_pattern(rng):
    """40 measurements of one network: Fisher's sum of logarithms of p, two-sided. A variance wrong by 30 % shows in tests of many terms."""
    simulated, exact = network_of(rng, images=8, points=50)
    p: dict[str, list[float]] = {}
    for _ in range(40):
        for record in residual_patterns(adjusted(measured_again(rng, simulated, exact), simulated)):
            p.setdefault(record.name, []).append(record.p)
    assert set(p) == set(MEANING)
    for name, values in p.items():
        total = -2 * np.log(values).sum()
        assert total < stats.chi2.isf(RATE / 40, 80), name
        if name not in (*WAVES, "image_rms"):  # those are conservative
            assert total > stats.chi2.ppf(RATE / 40, 80), name


def planted(name: str, rng, simulated: Simulated, exact: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """What a pattern adds to x and y, and its amplitude as it is to be reported (NaN where that is an rms)."""
    network = simulated.network
    x, y = exact.T
    middle_x, middle_y = SENSOR.centre
    time = network.image / (len(network.images) - 1)
    zero = np.zeros(len(x))
    if name == "phase_x":
        return 0.03 * np.sin(2 * np.pi * x + 1), zero, 0.03
    if name == "phase_y":
        return zero, 0.03 * np.cos(2 * np.pi * y), 0.03
    if name == "wave_xx":
        return 0.03 * np.sin(2 * np.pi * x / 9.3), zero, 0.03
    if name == "wave_xy":  # even and odd rows apart
        return 0.03 * np.cos(np.pi * y), zero, 0.03
    if name == "wave_yy":
        return zero, 0.03 * np.cos(2 * np.pi * y / 61), 0.03
    if name == "x_scale_trend":
        return 3e-4 * time * x, zero, 3e-4 * (SENSOR.cols - 1)
    if name == "x_scale_by_image":
        return 2e-4 * rng.choice([-1, 1], len(network.images))[network.image] * x, zero, np.nan
    if name == "x_shift_by_image":
        return 3.0 * rng.choice([-1, 1], len(network.images))[network.image] + zero, zero, np.nan
    if name == "principal_point_trend":
        return zero, 3.0 * time, 3.0
    if name == "principal_distance_trend":
        corner = np.hypot(SENSOR.cols, SENSOR.rows) / 2
        return 3e-3 * time * (x - middle_x), 3e-3 * time * (y - middle_y), 3e-3 * corner
    if name == "rows_x":
        return 0.3 * np.exp(-y / 150), zero, np.nan
    if name == "columns_x":
        return 0.08 * np.sin(2 * np.pi * x / 1500) ** 3, zero, np.nan
    if name == "unflatness":
        bow = ((x - middle_x) / middle_x) ** 2 - ((y - middle_y) / middle_y) ** 2
        return 4e-4 * bow * (x - middle_x), 4e-4 * bow * (y - middle_y), np.nan
    if name == "field":
        step = 0.06 * np.where((x > 700) ^ (y > 900), 1, -1)
        return step, -step, np.nan
    if name == "seams":
        step = 0.06 * np.where(x > (SENSOR.cols - 1) / 2, 1, -1)
        return zero, step, np.nan
    if name == "radius":
        r = np.hypot(x - middle_x, y - middle_y)
        ring = 0.15 * np.sin(2 * np.pi * r / 500) / np.maximum(r, 1)
        return ring * (x - middle_x), ring * (y - middle_y), np.nan
    raise ValueError(name)


@pytest.mark.parametrize("name", [name for name in MEANING if name != "image_rms"])
def test_planted_pattern_is_found_and_sized(rng, name):
    """Each makes its own test fail beyond doubt, and amplitudes lie within 6 u (and 5 %: terms are linear)."""
    simulated, exact = network_of(rng, images=24, points=80)
    dx, dy, amplitude = planted(name, rng, simulated, exact)
    record = by_name(adjusted(shifted(measured_again(rng, simulated, exact), dx, dy), simulated))[name]
    assert record.significant and record.p < 1e-6, record
    assert record.text.startswith(MEANING[name][0]) and record.level == pytest.approx(0.01 / len(MEANING))
    if np.isfinite(amplitude):
        assert abs(record.amplitude_px - amplitude) < 6 * record.u_px + 0.05 * amplitude, record
    else:
        assert record.amplitude_px > 0.1 * NOISE_PX
    if name.startswith("wave"):
        assert record.period_px == pytest.approx({"wave_xx": 9.3, "wave_xy": 2.0, "wave_yy": 61}[name], rel=0.02)


def test_one_bad_image_is_found(rng):
    """One image of twelve with three times the noise."""
    simulated, exact = network_of(rng)
    network = measured_again(rng, simulated, exact)
    worse = (network.image == 5)[:, None] * np.sqrt(8) * NOISE_PX * rng.standard_normal(exact.shape)
    record = by_name(adjusted(shifted(network, *worse.T), simulated))["image_rms"]
    assert record.significant and record.p < 1e-6 and 1.5 * NOISE_PX < record.amplitude_px < 5 * NOISE_PX


def test_the_sentence_about_a_bad_image_tells_what_its_figure_shows(rng):
    """Four times the noise in one image, and gross errors in it: the page draws the rms in x and in y of what was not rejected."""
    simulated, exact = network_of(rng)
    network = measured_again(rng, simulated, exact)
    mine = np.flatnonzero(network.image == 5)
    error = np.zeros(exact.shape)
    error[mine] = 4 * NOISE_PX * rng.standard_normal((len(mine), 2))
    error[mine[:5]] = 30.0
    calibration = calibrate_network(shifted(network, *error.T), progress=None)
    (finding,) = [f for f in calibration.findings if f.kind == "bad_images"]
    images = calibration.tests.images
    shown = next(i for i in images if i.image == network.images[5])
    assert shown.rejected >= 5
    size = f"rms {shown.rms_x_px:.2g} px in x and {shown.rms_y_px:.2g} px in y, but {shown.rejected} rejected"
    assert f"{shown.image} ({size}; with them" in finding.text
    (record,) = [r for r in calibration.tests.patterns if r.name == "image_rms"]
    assert record.amplitude_px == pytest.approx(max(max(i.rms_x_px, i.rms_y_px) for i in images), rel=1e-9)


def test_drift_of_the_clock_is_named_and_gone_when_estimated(rng):
    """Scale errors of a warming clock: the finding names the source; with an x-scale for each image nothing of it is left."""
    simulated, exact = network_of(rng, images=16, points=60)
    time_s = np.arange(16) * 120.0
    stretch = 3e-3 * np.exp(-time_s / 820)
    simulated = replace(simulated, network=replace(simulated.network, time_s=time_s))
    network = shifted(measured_again(rng, simulated, exact), stretch[simulated.network.image] * exact[:, 0])
    found = adjusted(network, simulated)
    findings = pattern_findings(residual_patterns(found))
    drift = [finding for finding in findings if finding.kind == "x_scale_drift"]
    assert len(drift) == 2 and all("grabber.clock_warm_up" in finding.text and finding.level == "warning" for finding in drift)
    assert found.sigma0 > 1.3
    settled = adjusted(replace(network, per_image=("x_scale",)), simulated)
    left = by_name(settled)
    assert "x_scale_trend" not in left and "x_scale_by_image" not in left
    assert stats.chi2.ppf(RATE, settled.dof) < settled.sigma0**2 * settled.dof < stats.chi2.isf(RATE, settled.dof)


def test_images_that_are_sheared_as_much_as_they_are_stretched_show_no_clock(rng):
    """A board that moves or bends deforms its images in all ways: the scale of x then is one of them, and no frame grabber is named."""
    simulated, exact = network_of(rng, images=16, points=60)
    stretch, shear = 1e-3 * rng.standard_normal((2, 16))
    off = exact - np.array(SENSOR.centre)
    image = simulated.network.image
    network = shifted(measured_again(rng, simulated, exact), stretch[image] * off[:, 0] + shear[image] * off[:, 1])
    patterns = residual_patterns(adjusted(network, simulated))
    record = next(one for one in patterns if one.name == "x_scale_by_image")
    assert record.significant and record.p_alike > 1e-6  # the fifteen of each are drawn alike: F is as of 15 and 15 degrees of freedom
    if record.p_alike > 0.01:
        assert not any(cause.endswith("grabber.clock_warm_up") for cause in record.causes)
        assert "x_scale_drift" not in {finding.kind for finding in pattern_findings([record])}


def test_findings_come_with_a_source_of_the_catalogue():
    known = set(sources())
    assert {source for _, source, _ in MEANING.values() if source} <= known
    made = [
        Pattern(
            name,
            "a",
            0.01,
            None,
            p,
            significant=p < 1e-3,
            text=name,
            source=MEANING[name][1],
            advice="do this",
            causes=tuple(cause.text for cause in causes_of(name, MEANING[name][1], None)),
        )  # fmt: skip
        for name, p in (("phase_x", 1e-5), ("field", 0.3), ("radius", 1e-9))
    ]
    findings = pattern_findings(made)
    assert [f.kind for f in findings] == ["radius", "phase_x"]
    assert findings[0].text.startswith("radius (possible cause: lens distortion") and "optics.distortion" in findings[0].text
    assert findings[0].advice == "Do this." and {f.level for f in findings} == {"warning"}


def test_no_pattern_is_seen_beside_scales_of_images_that_were_estimated(rng):
    """6 networks, all p above 1e-7 / 14; without the condition on the sum of the scales every third network showed p below 1e-10."""
    for _ in range(6):
        simulated = simulate(rng, images=14, points=40, per_image=("x_scale",))
        adjustment = adjusted(simulated.network, simulated)
        assert min(record.p for record in residual_patterns(adjustment)) > 1e-8


def test_what_no_chosen_pattern_explains_is_told():
    """60 terms that explain 200 of 1000 squares are too many to be chosen, but no wave along x explains them."""
    right = np.concatenate([np.full(60, np.sqrt(200 / 60)), np.full(2, np.sqrt(60.0))])
    parts = {"field": np.arange(60), "wave_yy": np.arange(60, 62)}
    places = chosen_among(Normals(np.eye(62), np.eye(62), right), parts, {"field": 1, "wave_yy": 1}, 1000.0, 1000.0)
    assert not places["wave_yy"].behind and places["field"].behind == "wave_yy"
    f = (200 / 60) / ((1000 - 200 - 120) / (1000 - 62))
    assert places["field"].p_left == pytest.approx(stats.f.sf(f, 60, 938), rel=1e-6)
    wave, field = (Pattern(n, "a", 0.01, None, 1e-9, significant=True, text=MEANING[n][0], advice="look") for n in ("wave_yy", "field"))
    (said,) = pattern_findings([wave, replace(field, behind="wave_yy")])
    assert said.text.endswith("It also explains that residuals depend on the position in the frame")
    (said,) = pattern_findings([wave, replace(field, behind="wave_yy", left=True)])
    assert "does not explain all" in said.text and "also explains" not in said.text
