"""Left-out images: their poses against SciPy's optimiser, their residuals against leaving one out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats
from scipy.spatial.transform import Rotation

from calibrate.adjusted import NOISE_PX, adjusted, measured_again, shifted
from calibrate.networks import image_of, predicted, simulate
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.checks import hold_out
from pixmetry.calibrate.checks.findings import hold_out_findings
from pixmetry.calibrate.checks.hold_out import LeftOut, expected_median_px, hold_out_record, left_out, resect, subset
from pixmetry.calibrate.records import HeldRms, HoldOut
from pixmetry.core.errors import InputError

RATE = 1e-6


def posed_by_scipy(network, state, i, used):
    """Residuals of one image after its pose alone was fitted, by SciPy and the other projection."""
    rows = np.flatnonzero(used & (network.image == i))
    measured = np.stack([network.x_px[rows], network.y_px[rows]], axis=1)
    size = np.linalg.norm(state.position[i])

    def residual(step):
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ state.rotation[i]
        x, y, _ = image_of(
            network.cameras[0], state.interior[0], rotation, state.position[i] + step[3:] * size, state.xyz[network.point[rows]]
        )
        return (measured - np.stack([x, y], axis=1)).ravel()

    return rows, optimize.least_squares(residual, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac").fun.reshape(-1, 2)


def test_pose_is_that_of_scipy(rng, monkeypatch):
    """Least squares: robust weights are off."""
    monkeypatch.setattr(hold_out, "TUNING", np.inf)
    simulated = simulate(rng, images=5, points=40, known="fixed")
    network = measured_again(rng, simulated)
    start = replace(simulated.truth, position=simulated.truth.position * 1.01)
    used = np.ones(len(network), bool)
    found, residual = resect(network, start, used)
    for i in range(5):
        rows, expected = posed_by_scipy(network, simulated.truth, i, used)
        np.testing.assert_allclose(residual[rows], expected, atol=1e-6)
    assert np.abs(found.position - simulated.truth.position).max() < 1.0
    np.testing.assert_allclose(predicted(network, found) + residual, np.stack([network.x_px, network.y_px], axis=1), atol=1e-7)


def test_gross_error_does_not_move_the_pose(rng):
    """Without noise, one point off by 20 px: the pose is exact and the error stays whole."""
    simulated = simulate(rng, images=4, points=30, known="fixed")
    exact = predicted(simulated.network, simulated.truth)
    wrong = np.zeros(len(exact))
    wrong[7] = 20.0
    network = shifted(measured_again(rng, simulated, exact, 0.0), wrong)
    _, residual = resect(network, simulated.truth, np.ones(len(network), bool))
    assert residual[7, 0] == pytest.approx(20.0, abs=1e-3)
    assert np.abs(np.delete(residual, 7, axis=0)).max() < 1e-3


def test_own_x_scale_is_fitted_too(rng):
    simulated = simulate(rng, images=4, points=40, known="fixed", per_image=("x_scale", "x_shift"))
    network = measured_again(rng, simulated, noise_px=0.0)
    start = replace(simulated.truth, x_scale=np.zeros(4), x_shift_px=np.zeros(4))
    found, residual = resect(network, start, np.ones(len(network), bool))
    np.testing.assert_allclose(found.x_scale, simulated.truth.x_scale, atol=1e-9)
    assert np.abs(residual).max() < 1e-6


def test_left_out_is_leaving_one_out_by_hand(rng, monkeypatch):
    """As many folds as images, points fixed, least squares: residuals as from an adjustment of the others and SciPy's pose."""
    monkeypatch.setattr(hold_out, "TUNING", np.inf)
    simulated = simulate(rng, images=6, points=50, known="fixed")
    network = measured_again(rng, simulated)
    used = rng.random(len(network)) > 0.05
    whole = adjusted(network, simulated, used=used)
    found = left_out(whole, folds=20)
    assert found.folds == 6 and np.array_equal(np.isfinite(found.residual_px).all(axis=1), used)
    np.testing.assert_array_equal(found.fit_px[used], whole.residual_px[used])
    rest = np.arange(6) != 3
    part, start, kept = subset(network, simulated.truth, rest)
    without = adjust(part, start, used=used[kept])
    state = replace(simulated.truth, interior=without.state.interior)
    rows, expected = posed_by_scipy(network, state, 3, used)
    # each of the two adjustments stops 1e-3 standard deviations from its minimum, and u of a prediction is not above the noise
    np.testing.assert_allclose(found.residual_px[rows], expected, rtol=0, atol=2e-3 * NOISE_PX)
    assert np.abs(found.fit_px[rows] - expected).max() > 0.02 * NOISE_PX


def test_subset_keeps_names_and_coordinates(rng):
    simulated = simulate(rng, images=6, points=20, cameras=2)
    network = replace(simulated.network, time_s=np.arange(6.0))
    keep = np.array([True, False, True, True, False, True])
    part, state, kept = subset(network, simulated.truth, keep)
    assert part.images == tuple(np.array(network.images)[keep])
    assert list(part.time_s) == [0, 2, 3, 5] and list(part.camera_of) == [0, 0, 1, 1]
    np.testing.assert_allclose(predicted(part, state), predicted(network, simulated.truth)[kept])
    assert [part.images[i] for i in part.image] == [network.images[i] for i in network.image[kept]]


@pytest.mark.parametrize("known", ["fixed", "free"])
def test_stat_left_out_is_a_little_worse_than_the_noise(rng, known):
    """Of a right model: left-out mean square above the fit's and below 1.7 times the noise's; the fit's as its redundancy says."""
    simulated = simulate(rng, images=16, points=60, known=known)
    whole = adjusted(measured_again(rng, simulated), simulated)
    found = left_out(whole)
    record = hold_out_record(found) if known == "fixed" else hold_out_record(None, found)
    rms = record.parts[known]
    assert rms.fit_rms_px < rms.left_out_rms_px < 1.3 * NOISE_PX
    low, high = NOISE_PX**2 * stats.chi2.ppf([RATE / 2, 1 - RATE / 2], whole.dof)
    assert low < rms.fit_rms_px**2 * 2 * len(whole.network) < high
    assert record.p is None and record.folds == 5 and f"{rms.left_out_rms_px:.4f} px in images left out" in record.text


def test_record_compares_on_common_points_and_by_image(rng):
    """50 images whose residuals fall by a fifth: p as of SciPy's paired test; a point that only one of the two has does not count."""
    image = np.repeat(np.arange(50), 10)
    first = rng.standard_normal((500, 2))
    second = 0.8 * first * rng.uniform(0.9, 1.1, (500, 2))
    second[0] = np.nan
    record = hold_out_record(LeftOut(first, first, image, 5), LeftOut(second, second, image, 5))
    assert record.fixed.left_out_rms_px == pytest.approx(np.sqrt(np.mean(first[1:] ** 2)))
    a, b = (np.array([np.sum(v[1:][image[1:] == i] ** 2) for i in range(50)]) for v in (first, second))
    assert record.p == pytest.approx(stats.ttest_rel(np.log(b), np.log(a), alternative="less").pvalue)
    with pytest.raises(ValueError, match="neither"):
        hold_out_record(None)


def test_too_few_images(rng):
    simulated = simulate(rng, images=4, points=60, cameras=2, known="fixed")
    found = adjusted(simulated.network, simulated)
    with pytest.raises(InputError, match="2 images"):
        left_out(found)


KINDS = {"few rays": (0.82, 1.24), "many rays": (0.9, 1.16), "weights": (0.9, 1.16), "bars": (0.9, 1.16)}


@pytest.mark.parametrize("kind", KINDS)
def test_stat_what_noise_alone_would_show(rng, kind):
    """What is expected of images left out is what comes out, be the points seen by few images or by many, weighted, or held by bars.

    The a priori standard deviation is half the noise. The ratio is 1.03 ± 0.02, of few rays 1.03 ± 0.07 (60 seeds each), and the limits are
    5.5 standard deviations off, but for few rays, which are averaged over 4 networks; noise that is 16 % off would be seen.
    """
    ratios = []
    for _ in range(4 if kind == "few rays" else 1):
        found = _held(rng, kind)
        left = left_out(found)
        ratios.append(np.nanmedian(np.abs(left.residual_px)) / expected_median_px(found, 5))
    low, high = KINDS[kind]
    assert low < np.mean(ratios) < high


def _held(rng, kind):
    """An adjustment with the camera held, of noise twice as large as its a priori standard deviation says."""
    simulated = simulate(rng, images=30, points=300 if kind == "few rays" else 40, bars=20 if kind == "bars" else 2)
    network = measured_again(rng, simulated, noise_px=2 * NOISE_PX)
    truth, bars = simulated.truth.xyz, network.bars
    if kind == "weights":  # so tight that they count, and so loose that images left out show it
        network = replace(network, xyz=truth + 0.05 * rng.standard_normal(truth.shape), u_xyz=np.full(truth.shape, 0.05))
    if kind == "bars":
        network = replace(network, bars=replace(bars, u=np.full(len(bars), 0.002)))
    cameras = tuple(replace(camera, free=np.zeros_like(camera.free)) for camera in network.cameras)
    rays = 4 if kind == "few rays" else 30
    used = (network.image * 7 + network.point) % 30 < rays
    return adjust(replace(network, cameras=cameras), simulated.truth, used=used)


def test_what_noise_explains_is_no_finding():
    record = HoldOut(None, HeldRms(0.1, 0.5, 0.3), 5, None, "", expected_median_px=0.21)
    assert hold_out_findings(record, free=True) == []
    record = replace(record, free=HeldRms(0.1, 0.5, 0.33))
    (finding,) = hold_out_findings(record, free=True)
    assert "0.21 px" in finding.text and finding.level == "warning"
    assert hold_out_findings(record, free=False) == [] == hold_out_findings(replace(record, expected_median_px=None), free=True)


def test_a_point_beyond_the_lens_of_a_left_out_image_has_no_part(rng):
    """One point of an image is put where its lens sees nothing: the image is posed by the others, as if the point were not there."""
    simulated = simulate(rng, images=6, points=30, interior={"k1": -4e-3, "k2": 0.0, "k3": 0.0})
    network, state = simulated.network, simulated.truth
    row = int(np.flatnonzero(network.image == 2)[0])
    state = replace(state, xyz=state.xyz.copy())
    state.xyz[network.point[row]] = state.position[2] + state.rotation[2].T @ [3000.0, 0.0, 1000.0]
    others = (network.image == 2) & (np.arange(len(network)) != row)
    found, residual = resect(network, state, others | (np.arange(len(network)) == row))
    without, _ = resect(network, state, others)
    assert np.isnan(residual[row]).all()
    np.testing.assert_allclose(found.position[2], without.position[2], atol=1e-6)
