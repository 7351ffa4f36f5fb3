"""The bundle adjustment against dense least squares: an independent projection, Jacobians by difference quotients, one bordered matrix."""

from __future__ import annotations

import tracemalloc
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calibrate.networks import disturbed, predicted, simulate
from pixmetry.calibrate.bundle import bundle, bundle_covariance, bundle_system
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.bundle.network import Network, ScaleBars, State
from pixmetry.calibrate.checks.known_residuals import bar_residuals
from pixmetry.core.errors import InputError, MeasureError

RATE = 1e-6  # false failures of one statistical test


@dataclass
class Dense:
    """All unknowns in one vector, all observations in another; nothing is eliminated."""

    network: Network
    base: State

    def __post_init__(self) -> None:
        self.camera_free = [np.flatnonzero(camera.free) for camera in self.network.cameras]
        self.point_free = self.network.u_xyz > 0
        self.known = self.point_free & np.isfinite(self.network.u_xyz)
        self.sizes = [sum(map(len, self.camera_free)), 6 * len(self.network.images)]
        self.sizes += [len(self.network.images) * (name in self.network.per_image) for name in ("x_scale", "x_shift")]
        self.sizes += [int(self.point_free.sum())]
        self.at = np.concatenate([[0], np.cumsum(self.sizes)])

    def state(self, z: np.ndarray) -> State:
        parts = [z[a:b] for a, b in zip(self.at[:-1], self.at[1:], strict=True)]
        interior, xyz = self.base.interior.copy(), self.base.xyz.copy()
        begin = 0
        for k, free in enumerate(self.camera_free):
            interior[k, free] += parts[0][begin : begin + len(free)] * self.scale(k)[free]
            begin += len(free)
        pose = parts[1].reshape(-1, 6)
        xyz[self.point_free] += parts[4]
        return State(
            interior,
            Rotation.from_rotvec(pose[:, :3] * 1e-3).as_matrix() @ self.base.rotation,
            self.base.position + pose[:, 3:],
            self.base.x_scale + (parts[2] * 1e-3 if len(parts[2]) else 0.0),
            self.base.x_shift_px + (parts[3] if len(parts[3]) else 0.0),
            xyz,
        )

    def scale(self, k: int) -> np.ndarray:
        """Steps of the interior parameters that move an image point by about a pixel."""
        r = 2.5 if self.network.cameras[k].direction == "image_to_object" else 0.4
        return np.array([1e-2, 1, 1, 1e-3, 1e-3, *(2 * [1e-3 / r]), *(1e-3 / r ** (2 * n) for n in range(1, 6))])

    def units(self) -> np.ndarray:
        """What 1 in the vector means in the units of the unknowns."""
        parts = [self.scale(k)[free] for k, free in enumerate(self.camera_free)]
        parts.append(np.tile([1e-3] * 3 + [1.0] * 3, len(self.network.images)))
        return np.concatenate([*parts, np.full(self.sizes[2], 1e-3), np.ones(self.sizes[3] + self.sizes[4])])

    def residuals(self, z: np.ndarray) -> np.ndarray:
        """Whitened, measured less computed."""
        state, n = self.state(z), self.network
        v = np.stack([n.x_px, n.y_px], axis=1) - predicted(n, state)
        image = np.linalg.solve(self.roots(), v[:, :, None]).ravel()
        control = ((n.xyz - state.xyz) / np.where(self.known, n.u_xyz, 1))[self.known]
        bars = (n.bars.length - np.linalg.norm(state.xyz[n.bars.end] - state.xyz[n.bars.start], axis=1)) / n.bars.u
        return np.concatenate([image, control, bars])

    def roots(self) -> np.ndarray:
        """Cholesky factors of the covariances of the image coordinates."""
        var_x, cov, var_y = self.network.covariance_px2.T
        return np.linalg.cholesky(np.moveaxis(np.array([[var_x, cov], [cov, var_y]]), 2, 0))

    def jacobian(self) -> np.ndarray:
        m, h = self.at[-1], 1e-4
        steps = h * np.eye(m)
        return np.stack([(self.residuals(step) - self.residuals(-step)) / (2 * h) for step in steps], axis=1)

    def conditions(self) -> np.ndarray:
        """Rows of conditions among the unknowns: the per-image parameters of a camera sum to nought."""
        rows = []
        for block in (2, 3):
            for k in range(len(self.network.cameras)) if self.sizes[block] else ():
                row = np.zeros(self.at[-1])
                row[self.at[block] : self.at[block + 1]] = self.network.camera_of == k
                rows.append(row)
        return np.array(rows).reshape(-1, self.at[-1])


def bordered(A: np.ndarray, conditions: np.ndarray, in_datum: np.ndarray) -> tuple[np.ndarray, int]:
    """Cofactors of all unknowns with inner constraints over those marked, from the inverse of the bordered normal equations."""
    full = np.concatenate([A, conditions])
    singular, V = np.linalg.svd(full)[1:]
    missing = full.shape[1] - int((singular > 1e-7 * singular[0]).sum())
    null = V[len(V) - missing :] if missing else np.zeros((0, len(V)))
    border = np.concatenate([conditions, np.where(in_datum, null, 0.0)])
    whole = np.block([[A.T @ A, border.T], [border, np.zeros((len(border), len(border)))]])
    return np.linalg.inv(whole)[: len(V), : len(V)], missing


def weighted(rng: np.random.Generator, network: Network, truth: State) -> Network:
    """Correlated image coordinates of different weight."""
    n = len(network)
    var = network.covariance_px2[:, [0, 2]] * rng.uniform(0.5, 2.0, (n, 2))
    cov = rng.uniform(-0.7, 0.7, n) * np.sqrt(var.prod(axis=1))
    return replace(network, covariance_px2=np.column_stack([var[:, 0], cov, var[:, 1]]))


def control(rng: np.random.Generator, network: Network, truth: State, u: dict[int, tuple[float, float, float]]) -> Network:
    """Some points known beforehand, a coordinate with u = 0 exactly."""
    u_xyz, xyz = np.full_like(network.u_xyz, np.inf), network.xyz.copy()
    for j, values in u.items():
        u_xyz[j] = values
        xyz[j] = truth.xyz[j] + np.where(np.isfinite(values), values, 0.0) * rng.standard_normal(3)
    return replace(network, xyz=xyz, u_xyz=u_xyz)


inf = np.inf
CASES = {
    "free, inner constraints for all seven": (dict(bars=0, known="rough"), None),
    "two bars": (dict(bars=2), None),
    "all points fixed": (dict(bars=0, known="fixed", field="plane"), None),
    "a third of the points fixed": (dict(bars=1, known="partly"), None),
    "weighted control": (dict(bars=0), {j: (0.05, 0.02, 0.1) for j in range(4)}),
    "weak control": (dict(bars=0), {j: (50.0, 20.0, 100.0) for j in range(6)}),
    "one weighted point and one height": (dict(bars=1), {2: (0.03, 0.05, 0.0), 7: (inf, inf, 0.1)}),
    "all heights fixed": (dict(bars=2), {j: (inf, inf, 0.0) for j in range(16)}),
    "a fixed point and two coordinates of another": (dict(bars=0), {0: (0.0, 0.0, 0.0), 1: (inf, 0.0, 0.0)}),
    "one fixed point": (dict(bars=0), {3: (0.0, 0.0, 0.0)}),
    "three cameras": (dict(bars=1, cameras=3, images=12), None),
    "per image": (dict(bars=2, per_image=("x_scale", "x_shift"), cameras=2, images=10), None),
    "object to image": (dict(bars=2, direction="object_to_image"), None),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_agrees_with_dense_least_squares(name, rng, monkeypatch):
    """Minimum, covariances, redundancy; differences here are those of difference quotients (1e-5), not statistical."""
    options, known = CASES[name]
    simulated = simulate(rng, **({"images": 6, "points": 16} | options))
    network = weighted(rng, simulated.network, simulated.truth)
    if known:
        network = control(rng, network, simulated.truth, known)
    used = (rng.random(len(network)) > 0.05) | (network.image < 3)  # a point of one ray would be none
    start = disturbed(rng, simulated)
    both = []
    for dense in (True, False):
        monkeypatch.setattr(bundle_system, "dense", lambda layout, dense=dense: dense)
        monkeypatch.setattr(bundle_covariance, "dense", lambda layout, dense=dense: dense)
        both.append(adjust(network, start, used=used, redundancy=not dense, a_priori=True))
    oracle = Dense(network, both[0].state)
    J, v = oracle.jacobian(), oracle.residuals(np.zeros(oracle.at[-1]))
    take = np.concatenate([np.repeat(used, 2), np.ones(len(v) - 2 * len(network), bool)])
    A, v = J[take], v[take]
    in_datum = np.zeros(oracle.at[-1], bool)
    carries = np.isinf(network.u_xyz)
    whole = carries.all(axis=1, keepdims=True)
    in_datum[oracle.at[4] :] = (carries & whole if whole.any() else carries)[oracle.point_free]
    Q, missing = bordered(A, oracle.conditions(), in_datum)
    defects = {"free, inner constraints for all seven": 7, "two bars": 6, "one fixed point": 4, "all heights fixed": 3}
    assert missing == defects.get(name, missing)
    # the rule to stop leaves less than the last step gained; a wrong derivative leaves some 1
    assert abs(v @ A @ Q @ (A.T @ v)) < bundle.SMALL * both[0].sigma0 ** 2, "the cost has no minimum where it should"
    units = oracle.units()
    for found in both:
        assert (found.used == used).all()
        np.testing.assert_array_equal(found.state.xyz[network.u_xyz == 0], network.xyz[network.u_xyz == 0])
        np.testing.assert_allclose(found.cost[-1], v @ v, rtol=1e-8)
        assert found.dof == len(v) + len(oracle.conditions()) + missing - A.shape[1]
        np.testing.assert_allclose(found.sigma0, np.sqrt(v @ v / found.dof), rtol=1e-8)
        _check_covariances(found, oracle, Q * np.outer(units, units))
        of_bars = J[len(J) - len(network.bars) :] * network.bars.u[:, None]
        _close(np.diag(network.bars.u**2) - bar_residuals(found, a_priori=True).cofactor, of_bars @ Q @ of_bars.T)
    _check_residuals(both[1], oracle, J, Q, used)
    if name.startswith("free"):
        _stays_in_the_mean(found.state.xyz, network.xyz)


def _check_covariances(found, oracle: Dense, C: np.ndarray) -> None:
    rows = _rows(oracle, found.free_columns)
    _close(found.covariance, C[np.ix_(rows, rows)])
    where = np.full(found.network.u_xyz.shape, -1)
    where[oracle.point_free] = np.arange(oracle.at[4], oracle.at[5])
    for j in range(len(found.network.points)):
        block = np.zeros((3, 3))
        free = np.flatnonzero(where[j] >= 0)
        block[np.ix_(free, free)] = C[np.ix_(where[j, free], where[j, free])]
        _close(found.point_covariance[j], block)


def _rows(oracle: Dense, columns) -> list[int]:
    """Places of the named columns in the oracle's vector."""
    network, place = oracle.network, {}
    names = [f"{c.name}:{p}" for c, free in zip(network.cameras, oracle.camera_free, strict=True) for p in _interior(free)]
    names += [f"{i}:{p}" for i in network.images for p in ("rx", "ry", "rz", "X0", "Y0", "Z0")]
    for name in ("x_scale", "x_shift"):
        names += [f"{i}:{name}" for i in network.images if name in network.per_image]
    names += [f"{network.points[j]}:{'XYZ'[a]}" for j, a in zip(*np.nonzero(oracle.point_free), strict=True)]
    place = {name: i for i, name in enumerate(names)}
    return [place[name] for name in columns]


def _interior(free) -> list[str]:
    return [("c", "xp", "yp", "b1", "b2", "p1", "p2", "k1", "k2", "k3", "k4", "k5")[i] for i in free]


def _close(found: np.ndarray, expected: np.ndarray) -> None:
    """Covariances, each element against the standard deviations that it joins."""
    u = np.sqrt(np.diagonal(expected))
    assert (np.abs(found - expected) <= 1e-3 * np.outer(u, u) + 1e-300).all()


def _check_residuals(found, oracle: Dense, J: np.ndarray, Q: np.ndarray, used: np.ndarray) -> None:
    """Cofactors of residuals, and of the prediction errors of those left out; redundancy numbers as the diagonal of Qvv P."""
    n, root = len(used), oracle.roots()
    J = J[: 2 * n].reshape(n, 2, -1)
    sign = np.where(used, -1.0, 1.0)[:, None, None]
    Qvv = root @ (np.eye(2) + sign * np.einsum("iam,mk,ibk->iab", J, Q, J, optimize=True)) @ np.swapaxes(root, 1, 2)
    largest = oracle.network.covariance_px2.max()
    np.testing.assert_allclose(found.residual_covariance_px2, Qvv[:, [0, 0, 1], [0, 1, 1]], rtol=1e-3, atol=1e-4 * largest)
    P = np.linalg.inv(root @ np.swapaxes(root, 1, 2))
    np.testing.assert_allclose(found.redundancy[used], np.diagonal(Qvv @ P, axis1=1, axis2=2)[used], atol=2e-4)
    assert np.isnan(found.redundancy[~used]).all()
    xy = np.stack([oracle.network.x_px, oracle.network.y_px], axis=1)
    np.testing.assert_allclose(found.residual_px, xy - predicted(oracle.network, found.state), atol=1e-8)


def _stays_in_the_mean(xyz: np.ndarray, before: np.ndarray) -> None:
    """Inner constraints: no mean shift, rotation or change of size against the coordinates beforehand."""
    moved, arm = xyz - before, xyz - xyz.mean(axis=0)
    size = np.abs(arm).max()
    assert np.abs(moved.mean(axis=0)).max() < 1e-9 * size
    assert np.abs(np.cross(arm, moved).mean(axis=0)).max() < 1e-9 * size**2
    assert abs((arm * moved).sum(axis=1).mean()) < 1e-9 * size**2


def test_minimum_is_that_of_scipy(rng):
    simulated = simulate(rng, images=5, points=12, bars=2)
    found = adjust(simulated.network, disturbed(rng, simulated))
    oracle = Dense(simulated.network, simulated.truth)
    theirs = least_squares(oracle.residuals, np.zeros(oracle.at[-1]), method="trf", x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-10)
    # what the rule to stop leaves is less than the last step gained, and moved
    assert abs(2 * theirs.cost - found.cost[-1]) < bundle.SMALL * found.sigma0**2
    u = np.sqrt(np.diagonal(found.interior_covariance()[1]))
    assert (np.abs(oracle.state(theirs.x).interior[0, :10] - found.state.interior[0, :10]) < np.sqrt(bundle.SMALL) * u).all()


def test_interior_parameters_do_not_depend_on_the_datum(rng):
    simulated = simulate(rng, images=12, points=40, bars=1)
    start = disturbed(rng, simulated)
    free = adjust(simulated.network, start)
    u = np.full_like(simulated.network.u_xyz, np.inf)
    u[0] = 0.0
    held = adjust(replace(simulated.network, xyz=simulated.truth.xyz, u_xyz=u), start)
    np.testing.assert_allclose(held.cost[-1], free.cost[-1], rtol=1e-8)
    _close(held.interior_covariance()[1], free.interior_covariance()[1])  # linearised up to .03 u off the minimum, each in its own place
    assert "3 of the seven" in held.datum


def test_scale_bar_residual_takes_part(rng):
    simulated = simulate(rng, images=8, points=30, bars=1)
    network = simulated.network
    twice = replace(network, bars=replace(network.bars, length=2 * network.bars.length))
    start = disturbed(rng, simulated)
    one, other = adjust(network, start), adjust(twice, start)
    np.testing.assert_allclose(other.cost[-1], one.cost[-1], rtol=1e-6)  # one bar is no check: the network grows with it
    ends = [np.linalg.norm(f.state.xyz[network.bars.end] - f.state.xyz[network.bars.start]) for f in (one, other)]
    np.testing.assert_allclose(ends, [network.bars.length[0], 2 * network.bars.length[0]], rtol=1e-8)


def test_robust_losses_shrug_off_gross_errors(rng):
    """2 % of the points lie 20 px wrong. The interior parameters of the robust adjustment stay within their covariance times 4."""
    simulated = simulate(rng, images=20, points=60, gross_share=0.02, gross_px=20.0)
    start, network = disturbed(rng, simulated), simulated.network
    plain = adjust(network, start)
    assert plain.sigma0 > 5
    for loss in ("huber", "cauchy"):
        robust = adjust(network, start, loss=loss, a_priori=True)
        assert (robust.weight[simulated.gross] < 0.05).mean() > 0.9
        off = robust.state.interior[0, :10] - simulated.truth.interior[0, :10]
        assert off @ np.linalg.solve(robust.interior_covariance()[1], off) < 4 * chi2.isf(RATE, 10)
    with pytest.raises(InputError, match="huber"):
        adjust(network, start, loss="tukey")


def test_what_cannot_be_determined_is_left_out(rng):
    simulated = simulate(rng, images=8, points=30, bars=2)
    network, start = simulated.network, disturbed(rng, simulated)
    free = np.setdiff1d(np.arange(30), [*network.bars.start, *network.bars.end])
    lost, once, nowhere = free[:3]
    used = network.point != once
    used[np.flatnonzero(network.point == once)[0]] = True
    start.xyz[lost], start.rotation[7] = np.nan, np.nan
    network = replace(network, point=np.where(network.point == nowhere, once, network.point))
    used &= simulated.network.point != nowhere
    found = adjust(network, start, used=used)
    assert np.isnan(found.state.xyz[[lost, once, nowhere]]).all() and np.isfinite(found.state.xyz[free[3:]]).all()
    assert np.isnan(found.state.position[7]).all() and not any(name.startswith(f"{network.images[7]}:") for name in found.free_columns)
    assert not found.used[network.image == 7].any() and np.isnan(found.residual_px[network.image == 7]).all()
    assert np.isnan(found.point_covariance[lost]).all() and found.dof > 0


def test_a_point_of_which_little_is_known_may_take_no_part(rng):
    simulated = simulate(rng, images=6, points=20, bars=2)
    network = control(rng, simulated.network, simulated.truth, {0: (0.0, np.inf, np.inf)})
    start = disturbed(rng, simulated)
    found = adjust(network, start, used=network.point != 0)
    np.testing.assert_array_equal(np.isnan(found.state.xyz), np.repeat([[True], *[[False]] * 19], 3, axis=1))


def test_weighted_points_that_no_image_sees_change_nothing(rng):
    simulated = simulate(rng, images=8, points=30, known="partly", bars=0)
    network, start = simulated.network, disturbed(rng, simulated)
    known = np.flatnonzero(np.isfinite(network.xyz[:, 0]))
    network = replace(network, u_xyz=np.where(np.isfinite(network.xyz), 0.1, np.inf))
    unseen = network.point == known[0]
    columns = {name: getattr(network, name)[~unseen] for name in ("x_px", "y_px", "image", "point", "covariance_px2")}
    xyz = start.xyz.copy()
    xyz[known[0]] = np.nan
    found = adjust(replace(network, **columns), replace(start, xyz=xyz))
    same = adjust(network, start, used=~unseen)
    np.testing.assert_allclose(found.state.interior, same.state.interior, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(found.state.xyz[known[0]], network.xyz[known[0]])
    assert f"{len(known) - 1} points with weights" in found.datum


def test_rays_that_hardly_meet_do_not_determine_a_point(rng):
    """A point seen from one place only: two images with the same projection centre."""
    simulated = simulate(rng, images=8, points=30, bars=2)
    network, truth = simulated.network, simulated.truth
    point = int(np.setdiff1d(np.arange(30), [*network.bars.start, *network.bars.end])[0])
    there = np.flatnonzero(network.point == point)[:2]
    position = truth.position.copy()
    position[network.image[there[1]]] = position[network.image[there[0]]]
    used = (network.point != point) | np.isin(np.arange(len(network)), there)
    found = adjust(network, replace(truth, position=position), used=used)
    assert np.isnan(found.state.xyz[point]).all() and any("almost parallel" in note for note in found.notes)


def test_a_point_behind_a_camera_comes_back(rng):
    simulated = simulate(rng, images=10, points=30, known="partly", bars=0)
    start, network = disturbed(rng, simulated), simulated.network
    free = int(np.flatnonzero(np.isinf(network.u_xyz).any(axis=1))[0])
    first = int(network.image[network.point == free][0])
    axis = start.rotation[first][2]
    start.xyz[free] = start.position[first] - 50.0 * axis
    found = adjust(network, start)
    lost = any(network.points[free] in note for note in found.notes)  # behind nearly all of them: then it is said
    assert found.sigma0 < 1.5 and (found.used | (lost & (network.point == free))).all()


def test_parallel_views_of_a_plane_name_principal_distance_and_distances(rng):
    simulated = simulate(rng, images=8, points=40, field="plane", look="frontal", known="fixed", bars=0, noise_px=0.04)
    network, truth = simulated.network, simulated.truth
    rotation = np.stack([Rotation.from_rotvec([0, 0, 0.1 * i]).as_matrix() @ np.diag([1.0, -1.0, -1.0]) for i in range(8)])
    state = replace(truth, rotation=rotation, position=truth.position * [0.1, 0.1, 1.0])
    xy = predicted(network, state)
    good = np.isfinite(xy).all(axis=1)
    network = replace(network, x_px=xy[:, 0], y_px=xy[:, 1])
    with pytest.raises(MeasureError, match=r"c is not determined: .*the distance of all images \(correlation -(1\.0000|0\.9999)") as error:
        adjust(network, state, used=good)
    assert error.value.remedy


def test_errors_say_where(rng):
    simulated = simulate(rng, images=6, points=20)
    network, start = simulated.network, disturbed(rng, simulated)
    bad = network.covariance_px2.copy()
    bad[5, 1] = 1.0
    with pytest.raises(InputError, match="row 5"):
        adjust(replace(network, covariance_px2=bad), start)
    bars = ScaleBars(network.bars.start, network.bars.end, network.bars.length, 0 * network.bars.u)
    with pytest.raises(InputError, match="scale bar"):
        adjust(replace(network, bars=bars), start)
    with pytest.raises(MeasureError, match="no image coordinates"):
        adjust(network, start, used=np.zeros(len(network), bool))


def test_stops_where_it_is_told_to(rng):
    simulated = simulate(rng, images=8, points=30)
    start = disturbed(rng, simulated)
    early = adjust(simulated.network, start, covariance=False, max_iterations=1)
    assert early.iterations == 1 and early.notes and early.covariance.shape == (0, 0)
    with pytest.raises(MeasureError, match="no minimum"):
        adjust(simulated.network, start, max_iterations=1)


@pytest.mark.parametrize("field", ["plane", "volume"])
def test_a_long_lens_with_a_wrong_start_comes_down_quickly(field, rng):
    """From the bottom of the valley at a principal distance 5 % wrong; c is four widths of the frame. Plain damped steps take up to 40."""
    lens = {"c": 4 * 2048 * 0.00345, "k1": 1e-4, "k2": 0.0, "k3": 0.0}
    simulated = simulate(rng, images=12, points=60, field=field, interior=lens)
    network, start = simulated.network, disturbed(rng, simulated, 0.003)
    start.interior[:, 0] = 1.05 * simulated.truth.interior[:, 0]
    held = replace(network.cameras[0], free=np.zeros(len(NAMES), bool))
    valley = adjust(replace(network, cameras=(held,)), start, covariance=False)
    found = adjust(network, valley.state)
    assert valley.sigma0 > 3 > 1.4 > found.sigma0 and found.iterations <= 15


def test_a_turn_round_the_object_keeps_the_distance(rng):
    """A shift of the projection centre together with the turn that keeps a point in view moves it on the circle about that point."""
    at, middle = rng.standard_normal((2, 3))
    rotation = Rotation.random(rng=rng).as_matrix()
    axis = rng.uniform(-0.5, 0.5, 3)  # in the frame of the object
    shift, turn = np.cross(axis, at - middle), -rotation @ axis
    there = at + bundle._along_arc(rotation[None], turn[None], shift[None])[0]
    np.testing.assert_allclose(there, middle + Rotation.from_rotvec(axis).apply(at - middle), atol=1e-12)


def test_no_matrix_of_points_by_points(rng):
    """3000 points: their joint covariance would take 648 MB."""
    simulated = simulate(rng, images=8, points=3000)
    start = disturbed(rng, simulated)
    adjust(simulated.network, start)
    tracemalloc.start()
    adjust(simulated.network, start, redundancy=True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6


def test_one_image_of_known_points_gets_its_pose_only(rng):
    simulated = simulate(rng, images=5, points=20, known="fixed", bars=0)
    network, truth = simulated.network, simulated.truth
    known = replace(network.cameras[0], free=np.zeros(len(NAMES), bool), values=truth.interior[0])
    start = replace(disturbed(rng, simulated), interior=truth.interior)
    found = adjust(replace(network, cameras=(known,)), start, used=network.image == 2, a_priori=True)
    assert found.free_columns == tuple(f"{network.images[2]}:{name}" for name in ("rx", "ry", "rz", "X0", "Y0", "Z0"))
    assert found.dof == 2 * found.used.sum() - 6 and np.isnan(found.state.position[[0, 1, 3, 4]]).all()
    turn = Rotation.from_matrix(found.state.rotation[2] @ truth.rotation[2].T).as_rotvec()
    off = np.concatenate([turn, found.state.position[2] - truth.position[2]])
    assert off @ np.linalg.solve(found.covariance, off) < chi2.isf(RATE, 6)
    weak = bundle_covariance.weak_direction(found.free_columns, found.covariance, found.network, found.state)
    assert all(name.endswith(f"of image {network.images[2]}") for name in weak.parameters) and abs(weak.correlation) > 0.5


def test_fixed_points_in_line_leave_a_turn_open(rng):
    simulated = simulate(rng, images=6, points=12, bars=0)
    line = np.linspace(-100, 100, 12)[:, None] * [1.0, 0.3, 0.2]
    truth = replace(simulated.truth, xyz=line)
    x, y = predicted(simulated.network, truth).T
    camera = replace(simulated.network.cameras[0], free=np.zeros(len(NAMES), bool))
    network = replace(simulated.network, cameras=(camera,), x_px=x, y_px=y, xyz=line, u_xyz=np.zeros((12, 3)))
    with pytest.raises(MeasureError, match="leaves 1 of the seven"):
        adjust(network, truth)


def test_without_noise_the_truth_comes_out(rng):
    simulated = simulate(rng, images=8, points=30, noise_px=1e-9, known="partly", bars=0)
    network = replace(simulated.network, covariance_px2=np.tile([1.0, 0.0, 1.0], (len(simulated.network), 1)))
    found = adjust(network, disturbed(rng, simulated))
    assert found.sigma0 < 1e-7
    np.testing.assert_allclose(found.state.xyz, simulated.truth.xyz, atol=1e-5)
    np.testing.assert_allclose(found.state.interior[0, :3], simulated.truth.interior[0, :3], atol=1e-4)


def test_a_start_in_another_datum_is_moved_to_the_given_one(rng):
    simulated = simulate(rng, images=8, points=30, known="rough", bars=0)
    start, network = disturbed(rng, simulated), simulated.network
    turn = Rotation.from_rotvec(rng.uniform(-1, 1, 3)).as_matrix()
    moved = replace(start, xyz=3 * start.xyz @ turn.T + 100, position=3 * start.position @ turn.T + 100, rotation=start.rotation @ turn.T)
    here, there = adjust(network, start), adjust(network, moved)
    np.testing.assert_allclose(there.state.xyz, here.state.xyz, atol=1e-4)
    _stays_in_the_mean(there.state.xyz, network.xyz)
