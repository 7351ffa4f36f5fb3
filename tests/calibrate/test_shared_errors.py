"""Errors that image points share: against dense algebra written out, and in simulated networks whose errors are correlated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from calibrate.networks import disturbed, predicted, simulate
from pixmetry.calibrate.bundle import shared_errors
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.bundle.network import SharedErrors
from pixmetry.calibrate.bundle.shared_errors import (
    Effect,
    effects_of,
    estimate_of,
    interior_parts,
    shared_moves,
    system_of,
    view_of,
    with_shared_errors,
)
from pixmetry.calibrate.bundle.solve import Options, calibrate_network
from pixmetry.calibrate.checks.check_points import joint_covariance
from pixmetry.calibrate.checks.hold_out import subset
from pixmetry.calibrate.checks.parts import halves_of, shared_findings, shared_words
from pixmetry.calibrate.page.page import page_of
from pixmetry.calibrate.page.text import NO_BREAK, shared_text
from pixmetry.calibrate.records import SharedByCamera, Tests, read_record, record_of
from pixmetry.report import html_of

RATE = 1e-6


def test_nothing_is_solved_for_where_nothing_is_significant():
    """SciPy's nnls of a system without columns ends the process ("double free"), not at once."""
    effect = Effect("image", 0, np.zeros((100, 2)), 1.0)
    for _ in range(1000):
        found = estimate_of([effect], np.eye(2), np.zeros(2), 100.0, 100, a_priori=True)
    assert found.theta.tolist() == [1.0, 0.0] and found.p.tolist() == [1.0] and not found.found


def moved(simulated, shift):
    """The network with other image coordinates."""
    n = simulated.network
    return replace(n, x_px=n.x_px + shift[:, 0], y_px=n.y_px + shift[:, 1])


def places(network):
    """Of image coordinates in the frame, −1 … 1."""
    sensor = network.cameras[0].sensor
    return 2 * (network.x_px / sensor.cols - 0.5), 2 * (network.y_px / sensor.rows - 0.5)


def bent_by_image(rng, simulated, size_px):
    """A quadratic displacement of its own in each image."""
    n = simulated.network
    x, y = places(n)
    shapes = np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=1)
    weights = size_px * rng.standard_normal((len(n.images), 6, 2))
    return moved(simulated, np.einsum("nk,nka->na", shapes, weights[n.image]))


def waves(rng, simulated, size_px):
    """One smooth field over the frame, the same in all images."""
    n = simulated.network
    angle, phase = rng.uniform(0, 2 * np.pi, (2, 6))
    along = 2 * np.pi / (0.6 * n.cameras[0].sensor.cols) * (np.outer(n.x_px, np.cos(angle)) + np.outer(n.y_px, np.sin(angle)))
    return moved(simulated, size_px * np.sqrt(2 / 6) * np.sin(along + phase) @ rng.standard_normal((6, 2)))


def dense(adjustment):
    """Whitened Jacobian of all unknowns by difference quotients of the tests' own projection."""
    network, state = adjustment.network, adjustment.state
    columns, base = [], predicted(network, state)
    free = np.flatnonzero(network.cameras[0].free)

    def column(changed, step):
        return ((predicted(network, changed) - base) / step / np.sqrt(network.covariance_px2[:, [0, 2]])).ravel()

    from scipy.spatial.transform import Rotation

    for k in free:
        step = 1e-6 * max(abs(state.interior[0, k]), 1e-3)
        interior = state.interior.copy()
        interior[0, k] += step
        columns.append(column(replace(state, interior=interior), step))
    for i in range(len(network.images)):
        for a in range(6):
            rotation, position = state.rotation.copy(), state.position.copy()
            step = 1e-7 if a < 3 else 1e-4
            if a < 3:
                rotation[i] = Rotation.from_rotvec(step * np.eye(3)[a]).as_matrix() @ rotation[i]
            else:
                position[i, a - 3] += step
            columns.append(column(replace(state, rotation=rotation, position=position), step))
    for j in range(len(network.points)):
        for a in range(3):
            xyz = state.xyz.copy()
            xyz[j, a] += 1e-4
            columns.append(column(replace(state, xyz=xyz), 1e-4))
    return np.array(columns).T, len(free)


def small(rng):
    return simulate(rng, images=8, points=16, bars=0)


def test_answers_are_those_of_dense_least_squares(rng):
    """A = N⁻¹ Jᵀ F of interior parameters, and Fᵀ R F, against a pseudo-inverse of the whole design by difference quotients."""
    simulated = small(rng)
    found = adjust(simulated.network, disturbed(rng, simulated, 0.003))
    system = system_of(found)
    effects = effects_of(system.layout, system.now.state, system.now.weight > 0, view_of(found))
    assert [effect.kind for effect in effects] == ["image", "frame", "view"]
    J, free = dense(found)
    back = np.empty(2 * len(found.network), int)  # rows of the layout are in another order
    back[0::2], back[1::2] = 2 * system.layout.order, 2 * system.layout.order + 1
    scale = np.linalg.norm(J, axis=0)
    left, singular, right = np.linalg.svd(J / scale, full_matrices=False)
    inverse = right[:-7].T @ (left[:, :-7] / singular[:-7]).T / scale[:, None]  # seven have no effect: the datum
    for effect in effects:
        F = np.empty((len(back), effect.columns.shape[1]))
        F[back] = effect.columns if isinstance(effect.columns, np.ndarray) else effect.columns.toarray()
        right, step, points = system.answers(effect.columns)
        expected = inverse @ F
        size = np.abs(expected[:free]).max(axis=1, keepdims=True)
        np.testing.assert_allclose(step[:free] / size, expected[:free] / size, rtol=0, atol=1e-3)
        m = len(system.layout.columns)
        left = F.T @ F - right[:m].T @ step - right[m:].T @ points.reshape(-1, F.shape[1])
        np.testing.assert_allclose(left, F.T @ (F - J @ expected), rtol=0, atol=1e-3 * np.abs(left).max())


def test_independent_errors_leave_the_covariance_as_it_is(rng):
    """One network in a hundred may be found to have something in common; five of six would be with a probability below 1e-6."""
    found = []
    for _ in range(6):
        simulated = simulate(rng, images=8, points=30)
        one = adjust(simulated.network, disturbed(rng, simulated, 0.003))
        again = with_shared_errors(one)
        found.append(again.shared.found)
        if not again.shared.found:
            assert again.covariance is one.covariance and again.point_covariance is one.point_covariance
            np.testing.assert_array_equal(again.interior_dof(), one.dof)
    assert sum(found) <= 3  # 15 · 0.01⁴ and less: below 1e-6


@pytest.mark.parametrize("kind", [bent_by_image, waves])
def test_correlated_errors_are_covered(kind, rng):
    """The interior parameters of networks of 10 images whose errors are correlated: |error| stays within the stated 99.9 % interval (t with
    the stated degrees of freedom) in nine of ten cases at least, where independent errors would have it in less."""
    inside, inside_independent, widened = [], [], []
    for _ in range(4):
        simulated = simulate(rng, images=10, points=40, look="convergent", bars=0)
        network = kind(rng, simulated, 0.15)
        found = with_shared_errors(adjust(network, disturbed(rng, simulated, 0.003)))
        assert found.shared.found
        names, C = found.interior_covariance()
        off = np.abs((found.state.interior - simulated.truth.interior)[0, found.network.cameras[0].free])
        u, dof, plain = np.sqrt(np.diag(C)), found.interior_dof(), found.interior_u_independent()
        inside += list(off <= stats.t.ppf(0.9995, dof) * u)
        inside_independent += list(off <= stats.norm.ppf(0.9995) * plain)
        widened.append(np.median(u / plain))
        assert (dof < found.dof).all() and len(names) == len(dof)
    assert np.mean(inside) > 0.85
    assert np.mean(inside_independent) < np.mean(inside)
    assert np.median(widened) > 1.5


def test_variances_are_those_that_were_simulated(rng):
    """Quadratic displacements of 0.15 px a coefficient beside noise of 0.04 px, in 8 networks of 30 images: the mean squares of both over
    the true ones. One scatters by 25 % (80 networks), their mean by 9 %: five of that."""
    displaced, noise = [], []
    for _ in range(8):
        simulated = simulate(rng, images=30, points=60, bars=0)
        found = with_shared_errors(adjust(bent_by_image(rng, simulated, 0.15), disturbed(rng, simulated, 0.003)))
        x, y = places(simulated.network)
        kinds = dict(zip((kind for kind, _ in found.shared.kinds), found.shared.rms_px, strict=True))
        displaced.append(kinds["image"] ** 2 / (0.15**2 * np.mean(1 + x**2 + y**2 + x**4 + (x * y) ** 2 + y**4)))
        noise.append(found.sigma0**2 * found.shared.white_variance * found.network.covariance_px2[0, 0] / 0.04**2)
    assert 0.55 < np.mean(displaced) < 1.45
    assert 0.55 < np.mean(noise) < 1.45


def test_moves_make_up_the_covariance_that_was_added(rng):
    """Reduced unknowns and points: stated covariance less the independent part is the product of the moves; joint covariances of points
    have the single ones as their blocks."""
    simulated = simulate(rng, images=10, points=25, known="partly")  # a third of the points hold the datum
    network = bent_by_image(rng, simulated, 0.15)
    before = adjust(network, disturbed(rng, simulated, 0.003))
    found = with_shared_errors(before)
    points = np.flatnonzero(np.isinf(network.u_xyz).all(axis=1) & np.isfinite(found.state.xyz).all(axis=1))[:8]
    moves, of_points = shared_moves(found, points)
    share = found.shared.white_variance
    np.testing.assert_allclose(found.covariance, share * before.covariance + moves @ moves.T, rtol=1e-6, atol=1e-12)
    joint = joint_covariance(found, points)
    for i, j in enumerate(points):
        block = slice(3 * i, 3 * i + 3)
        np.testing.assert_allclose(joint[block, block], found.point_covariance[j], rtol=1e-3, atol=1e-6 * joint.max())
    assert of_points.shape[0] == 24


def test_many_images_are_estimated_from_some_and_widened_by_all(rng, monkeypatch):
    """With a limit of 6 images the variances come from 6, and the covariance still holds the displacements of all 14."""
    simulated = simulate(rng, images=14, points=30, bars=0)
    one = adjust(bent_by_image(rng, simulated, 0.2), disturbed(rng, simulated, 0.003))
    whole = with_shared_errors(one)
    monkeypatch.setattr(shared_errors, "MOST_IMAGES", 6)
    part = with_shared_errors(one)
    assert part.shared.found
    ratio = np.sqrt(np.diag(part.interior_covariance()[1]) / np.diag(whole.interior_covariance()[1]))
    assert (ratio > 0.5).all() and (ratio < 2).all()  # six images of 14 alone would give less than a half


def test_halves_and_parts_are_in_every_report(rng):
    """Halves of independent images agree: p is uniform; below 1e-6 once in 5e5 such tests of two. They are read back as they were."""
    simulated = simulate(rng, images=12, points=30)
    tests = calibrate_network(simulated.network, Options(), simulated.truth).tests
    (halves,), (left,) = tests.halves.values(), tests.jackknife.values()
    assert [one.images for one in halves] == [(6, 6), (6, 6)]
    assert all(one.p > RATE for one in halves)
    assert left.folds == 5 and 0.1 < left.ratio < 5
    again = read_record(Tests, record_of(tests))
    np.testing.assert_array_equal(again.halves["camera"][0].u, halves[0].u)
    assert again.jackknife["camera"].folds == 5 and again.shared_errors["camera"].kinds == tests.shared_errors["camera"].kinds


def test_a_step_between_the_halves_is_seen(rng):
    """A principal distance that changes by 0.2 % after the sixth of twelve images, as of a lens that was touched."""
    simulated = simulate(rng, images=12, points=40, bars=0)
    n = simulated.network
    centre = simulated.truth.interior[0, 1:3]
    away = np.stack([n.x_px, n.y_px], axis=1) - centre
    network = moved(simulated, np.where((n.image < 6)[:, None], 0.002 * away, 0.0))
    found = with_shared_errors(adjust(network, disturbed(rng, simulated, 0.003)))
    every_other, in_order = halves_of(found)["camera"]
    k = in_order.names.index("c")
    c = simulated.truth.interior[0, 0]
    assert abs(in_order.difference[k] / c - 0.002) < 0.0005  # u of the difference is 0.00002
    assert abs(in_order.difference[k]) > abs(every_other.difference[k])  # that mixes images of before and after


def test_what_halves_share_cancels(rng):
    """With the same images twice, frame and view displacements move both halves alike: nothing of them is in the difference."""
    simulated = simulate(rng, images=10, points=30, bars=0)
    found = with_shared_errors(adjust(waves(rng, simulated, 0.15), disturbed(rng, simulated, 0.003)))
    assert found.shared.found
    network, start, kept = subset(found.network, found.state, np.ones(10, bool))
    part = adjust(network, start, used=found.used[kept])
    own, common = interior_parts(part, found)
    expected = found.interior_covariance()[1]
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose((own + common @ common.T) / size, expected / size, rtol=0, atol=0.02)  # bumps against their principal parts


def test_too_few_images_for_halves(rng):
    simulated = simulate(rng, images=5, points=40)
    assert halves_of(with_shared_errors(adjust(simulated.network, disturbed(rng, simulated, 0.003)))) == {}


def test_degrees_of_freedom_are_those_of_the_adjustment_without_a_search(rng):
    simulated = simulate(rng, images=5, points=20)
    one = adjust(simulated.network, disturbed(rng, simulated, 0.003))
    assert one.shared is None and (one.interior_dof() == one.dof).all()
    assert isinstance(with_shared_errors(one).shared, SharedErrors)


def test_shared_errors_of_a_camera_that_is_held_are_told_without_its_parameters(rng):
    """Found, and said in finding and page, but no u of a parameter there is: no factor and no table of them."""
    simulated = simulate(rng, images=12, points=50, bars=0)
    bent = bent_by_image(rng, simulated, 0.3)
    camera = replace(bent.cameras[0], values=simulated.truth.interior[0].copy(), free=np.zeros_like(bent.cameras[0].free))
    found = calibrate_network(replace(bent, cameras=(camera,)), Options(folds=0, snoop=False))
    assert found.adjustment.shared.found and found.tests.shared_errors["camera"].names == ()
    (said,) = [one.text for one in found.findings if one.kind == "shared_errors"]
    assert said.endswith("The stated uncertainties hold them.")
    page = html_of(page_of(found))
    assert "The uncertainties of poses and points hold them." in page and "u / u independent" not in page


def test_each_image_of_a_rig_has_displacements_of_its_own(rng):
    """Images of the cameras take turns, as they do in a list of instants."""
    from calibrate.rigs import simulated_rig

    rig = simulated_rig(rng, instants=5)
    assert (np.diff(rig.network.camera_of) != 0).any() and (np.diff(rig.network.camera_of) < 0).any()
    found = adjust(rig.network, rig.truth)
    system = system_of(found)
    effect = effects_of(system.layout, system.now.state, system.now.weight > 0, view_of(found))[0]
    assert (effect.kind, effect.camera) == ("image", -1)
    row, column = effect.columns.nonzero()
    pairs = np.unique(np.stack([system.layout.image[row // 2], column // 12], axis=1), axis=0)
    images = np.unique(system.layout.image)
    np.testing.assert_array_equal(pairs, np.stack([images, np.arange(len(images))], axis=1))


def test_the_shift_of_oblique_targets_is_that_of_circles_on_the_axis(rng):
    """The column against integrals along the circles' images; off the axis both differ by less than c r² (|d| + |d|²)/Z²."""
    from pixmetry.calibrate.bundle.eccentric import eccentricity

    ideal = dict.fromkeys(("b1", "b2", "p1", "p2", "k1", "k2", "k3"), 0.0)
    simulated = simulate(rng, images=12, points=60, field="plane", bars=0, interior=ideal)
    network = replace(simulated.network, cameras=tuple(replace(one, free=np.isin(NAMES, ["c"])) for one in simulated.network.cameras))
    found = adjust(network, simulated.truth)
    system = system_of(found)
    layout, radius = system.layout, 4.0
    oblique = effects_of(layout, system.now.state, system.now.weight > 0, view_of(found))[-1]
    assert oblique.kind == "oblique" and oblique.columns.shape[1] == 1
    targets = replace(network, diameter=np.full(60, 2 * radius), normal=None)
    expected = eccentricity(targets, found.state).shift_px[layout.order]
    w, column = layout.whiten, oblique.columns.reshape(-1, 2)
    assert (w[:, 1] == 0).all()
    shift = radius**2 * column / w[:, [0, 2]]
    seen = np.einsum("nij,nj->ni", found.state.rotation[layout.image], found.state.xyz[layout.point] - found.state.position[layout.image])
    away = np.linalg.norm(seen[:, :2] / seen[:, 2:], axis=1)
    size = found.camera().c_px[0] * (radius / seen[:, 2]) ** 2
    assert (np.linalg.norm(shift - expected, axis=1) < (away + away**2 + 0.01) * size).all()
    near = away < 0.1
    assert near.sum() > 20
    assert np.sum(shift[near] * expected[near]) == pytest.approx(np.sum(expected[near] ** 2), rel=0.1)
    assert oblique.mean_square * radius**4 == pytest.approx(np.mean(shift**2), rel=1e-9)
    layout = replace(layout, network=replace(network, cameras=tuple(replace(one, projection="equidistant") for one in network.cameras)))
    kinds = [one.kind for one in effects_of(layout, system.now.state, system.now.weight > 0, view_of(found))]
    assert kinds == ["image", "frame", "view"]  # in a fisheye it would be that of the rays near 90° alone


def test_what_is_not_sure_is_said_so():
    """The shift of oblique targets counts from 10 % on; below what three digits show there is a sentence too."""
    u = np.ones(1)
    one = SharedByCamera(("image", "oblique"), np.array([0.0, 0.1]), np.array([0.4, 0.05]), 0.04, True, ("c",), u, u, u)
    assert shared_words(one) == ("may have", ["0.100 px of targets seen obliquely"])
    assert shared_words(replace(one, p=np.array([0.4, 0.001])))[0] == "have"
    assert shared_words(replace(one, rms_px=np.array([0.2, 0.1])))[0] == "have"
    tiny = replace(one, rms_px=np.array([0.0, 2e-4]))
    assert "may have errors in common (less than 0.001 px; independent: 0.040 px)" in shared_findings({"camera": tiny})[0].text
    assert shared_text(tiny).startswith(f"Image points may have errors in common: less than 0.001{NO_BREAK}px")
