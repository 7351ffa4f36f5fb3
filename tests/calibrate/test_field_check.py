"""A board that is not flat is found, with its shape, and a flat one is let stand. Statistical tests fail once in a million runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from calibrate.adjusted import adjusted, measured_again
from calibrate.networks import simulate
from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.checks.field_check import check_field
from pixmetry.calibrate.start.resection import similarity
from pixmetry.core.errors import InputError

RATE = 1e-6


def bent(rng, off, turn=None, **options):
    """A plane board of 1000 mm by 800 mm, known as flat, that lies off by ``off(x, y)``, shape (n, 3); all of it turned."""
    simulated = simulate(rng, **({"images": 16, "points": 80, "field": "plane", "known": "fixed", "bars": 0} | options))
    flat, turn = simulated.truth.xyz, np.eye(3) if turn is None else turn
    real = flat + off(*flat[:, :2].T)
    truth = replace(
        simulated.truth, xyz=real @ turn.T, rotation=simulated.truth.rotation @ turn.T, position=simulated.truth.position @ turn.T
    )
    simulated = replace(simulated, truth=truth, network=replace(simulated.network, xyz=flat @ turn.T))
    return replace(simulated, network=measured_again(rng, simulated)), real - flat


def bow(x, y):
    return np.column_stack([0 * x, 0 * x, 0.4 * ((x / 500) ** 2 - (y / 400) ** 2)])


def start_flat(simulated):
    return replace(simulated, truth=replace(simulated.truth, xyz=simulated.network.xyz))


@pytest.mark.parametrize("turned", [False, True])
def test_stat_bent_board_is_found_with_its_shape(rng, turned):
    """Deviations off the plane within their uncertainties (χ² of 80 points: wrong by 45 % would be caught), whatever way the board lies."""
    turn = Rotation.random(rng=rng).as_matrix() if turned else None
    simulated, truth = bent(rng, bow, turn)
    fixed = adjusted(simulated.network, start_flat(simulated))
    check = check_field(fixed)
    field, compared = check.field.compared.deviations, check.field.compared
    points = field.points
    assert check.verdict == check.field.verdict == "free" and check.adjustment is check.free and field.shape == "plane"
    assert compared.p < 1e-6 and field.p_flat < 1e-6 and check.hold_out.p < 0.01
    assert check.hold_out.free.left_out_rms_px < check.hold_out.fixed.left_out_rms_px
    plane = np.column_stack([np.ones(80), (points.xyz - points.xyz.mean(axis=0)) @ points.axes[:2].T])
    height = truth[:, 2] * (points.axes[2] @ (turn[:, 2] if turned else np.eye(3)[2]))
    height = height - plane @ np.linalg.lstsq(plane, height, rcond=None)[0]
    z2 = np.sum(((points.dz - height) / points.u_dz) ** 2)
    assert stats.chi2.ppf(RATE / 2, 70) < z2 < stats.chi2.isf(RATE / 2, 80)
    u = points.u_dz.max()
    assert field.peak == pytest.approx(np.abs(height).max(), abs=6 * u)
    assert field.rms == pytest.approx(np.sqrt(np.mean(height**2)), abs=6 * u) and field.rms_in_plane < 6 * np.hypot(u, u)
    finding = check.findings[0]
    assert finding.kind == "flatness" and finding.level == "warning" and "not flat" in finding.text and "principal point" in finding.text
    for name in ("c", "xp", "yp"):
        per_px = 0.00345 if name == "c" else 1.0
        moved, u_formal = compared.first.by_name[name]
        assert moved == pytest.approx((check.free.camera()[name] - fixed.camera()[name]) / per_px)
        names, covariance = fixed.interior_covariance()
        assert u_formal == pytest.approx(np.sqrt(covariance[names.index(name), names.index(name)]) / per_px)


def test_points_off_in_the_plane_are_told_from_bending(rng):
    off = 0.3 * rng.standard_normal((80, 2))
    simulated, _ = bent(rng, lambda x, y: np.column_stack([off, 0 * x]))
    check = check_field(adjusted(simulated.network, start_flat(simulated)))
    field = check.field.compared.deviations
    assert check.verdict == "free" and field.p_flat > RATE
    said = "not flat" in check.field.text.split(":")[0]
    assert said == (field.p_flat <= 0.01)  # one flat board in a hundred is said not to be
    centred = np.column_stack([off, np.zeros(80)])
    scale, rotation, shift = similarity(simulated.network.xyz + centred, simulated.network.xyz)
    left = scale * (simulated.network.xyz + centred) @ rotation.T + shift - simulated.network.xyz
    u = np.hypot(field.points.u_dx.max(), field.points.u_dy.max())
    assert field.rms_in_plane == pytest.approx(np.sqrt(np.mean(np.sum(left**2, axis=1))), abs=3 * u)


def test_flat_board_stands(rng):
    simulated, _ = bent(rng, lambda x, y: np.zeros((len(x), 3)))
    check = check_field(adjusted(simulated.network, simulated), level=RATE)
    assert check.verdict == "fixed" and check.adjustment is check.fixed and check.findings[0].level == "note"
    assert "are accepted" in check.field.text and check.hold_out.free.left_out_rms_px > check.hold_out.fixed.left_out_rms_px * 0.97


def test_stat_f_test_of_a_true_field_is_fair(rng):
    """p over 12 measurements of a flat board, Fisher's sum, two-sided."""
    simulated, _ = bent(rng, lambda x, y: np.zeros((len(x), 3)), images=8, points=20)
    p = [check_field(adjusted(measured_again(rng, simulated), simulated), folds=2).field.compared.p for _ in range(12)]
    total = -2 * np.log(p).sum()
    assert stats.chi2.ppf(RATE / 2, 24) < total < stats.chi2.isf(RATE / 2, 24)


def test_field_in_space(rng):
    """A volume of targets, one of which lies off by 2 mm: what a similarity of all of them leaves of it, within 6 u (0.09 mm)."""
    simulated = simulate(rng, images=14, points=40, known="fixed", bars=0)
    real = simulated.truth.xyz.copy()
    real[11] += [2.0, 0, 0]
    network = measured_again(rng, replace(simulated, truth=replace(simulated.truth, xyz=real)))
    check = check_field(adjusted(network, simulated))
    field, points = check.field.compared.deviations, check.field.compared.deviations.points
    off = np.linalg.norm([points.dx, points.dy, points.dz], axis=0)
    assert check.verdict == "free" and field.shape == "volume" and np.argmax(off) == 11
    scale, rotation, shift = similarity(real, simulated.network.xyz)
    left = np.linalg.norm((scale * real @ rotation.T + shift - simulated.network.xyz)[11])
    u = max(points.u_dx[11], points.u_dy[11], points.u_dz[11])
    assert off[11] == pytest.approx(left, abs=6 * u) and 0.005 < u < 0.03
    assert check.findings[0].kind == "field" and field.peak == pytest.approx(off[11])


def test_similarity_against_another_program(rng):
    points = rng.standard_normal((30, 3))
    turn, scale, shift = Rotation.random(rng=rng), 1.7, rng.standard_normal(3)
    onto = scale * turn.apply(points) + shift + 0.01 * rng.standard_normal((30, 3))
    found_scale, rotation, found_shift = similarity(points, onto)
    aligned, _ = Rotation.align_vectors(onto - onto.mean(axis=0), points - points.mean(axis=0))
    np.testing.assert_allclose(rotation, aligned.as_matrix(), atol=1e-10)
    turned = aligned.apply(points - points.mean(axis=0))
    assert found_scale == pytest.approx(np.sum(turned * (onto - onto.mean(axis=0))) / np.sum(turned**2))
    np.testing.assert_allclose(found_scale * rotation @ points.mean(axis=0) + found_shift, onto.mean(axis=0), atol=1e-12)


def test_too_few_images_leave_the_field_untested(rng):
    simulated, _ = bent(rng, bow, images=2)
    camera = simulated.network.cameras[0]
    few = replace(camera, values=simulated.truth.interior[0], free=np.array(NAMES) == "xp")
    check = check_field(adjusted(replace(simulated.network, cameras=(few,)), start_flat(simulated)))
    assert check.verdict == "fixed" and check.hold_out is None and "were not tested" in check.field.text


def test_free_points_are_no_field(rng):
    simulated = simulate(rng, images=6, points=30)
    with pytest.raises(InputError, match="given coordinates"):
        check_field(adjusted(simulated.network, simulated))
