"""Check points against the independent simulator: their joint covariance, χ² and ratios over fresh noise, errors that are named."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm

import pixmetry
from calibrate.adjusted import measured_again
from calibrate.networks import Simulated, predicted, simulate
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.network import Adjustment, Network, State
from pixmetry.calibrate.checks.check_points import CheckPoints, _text, _turned, check_findings, check_record, joint_covariance
from pixmetry.calibrate.records import CheckRecord
from pixmetry.core.errors import InputError

FALSE_FAILURE = 1e-6
U_MM = np.array([0.02, 0.03, 0.0])  # of check points
U_CONTROL_MM = 0.03
KINDS = {"control": 0, "control and bars": 0, "heights": 3, "free with bars": 6, "free": 7}  # and what of the datum is missing


def world(rng: np.random.Generator, kind: str, **more) -> Simulated:
    """A network in a frame of its own, as far as nothing gives one."""
    simulated = simulate(rng, **{"images": 10, "points": 40, "bars": 2 if "bars" in kind else 0, **more})
    points = len(simulated.network.points)
    xyz, u_xyz = np.full((points, 3), np.nan), np.full((points, 3), np.inf)
    if kind.startswith("control"):
        xyz[:6], u_xyz[:6] = simulated.truth.xyz[:6], U_CONTROL_MM
    if kind == "heights":
        xyz[:8, 2], u_xyz[:8, 2] = simulated.truth.xyz[:8, 2], U_CONTROL_MM
    return replace(simulated, network=replace(simulated.network, xyz=xyz, u_xyz=u_xyz))


def start(rng: np.random.Generator, kind: str, truth: State) -> State:
    """The truth, turned, moved and stretched by what is missing."""
    if kind.startswith("control"):
        return truth
    turn = Rotation.from_euler("z", rng.uniform(-3, 3)) if kind == "heights" else Rotation.random(random_state=rng)
    shift, scale = 500 * rng.standard_normal(3), 1.0 if kind != "free" else float(np.exp(rng.standard_normal()))
    shift[2] *= kind != "heights"
    matrix = turn.as_matrix()
    xyz, position = (scale * values @ matrix.T + shift for values in (truth.xyz, truth.position))
    return replace(truth, xyz=xyz, position=position, rotation=truth.rotation @ matrix.T)


def measured(rng: np.random.Generator, kind: str, simulated: Simulated, exact: np.ndarray) -> Adjustment:
    network, truth = measured_again(rng, simulated, exact), simulated.truth
    bars = network.bars
    length = np.linalg.norm(truth.xyz[bars.start] - truth.xyz[bars.end], axis=1) + bars.u * rng.standard_normal(len(bars))
    xyz = np.where(np.isfinite(network.xyz), truth.xyz + U_CONTROL_MM * rng.standard_normal(network.xyz.shape), np.nan)
    return adjust(replace(network, xyz=xyz, bars=replace(bars, length=length)), start(rng, kind, truth))


def given(rng: np.random.Generator, simulated: Simulated, points: np.ndarray) -> CheckPoints:
    xyz = simulated.truth.xyz[points] + U_MM * rng.standard_normal((len(points), 3))
    return CheckPoints(tuple(simulated.network.points[k] for k in points), xyz, np.tile(U_MM, (len(points), 1)))


def dense_normals(network: Network, state: State) -> np.ndarray:
    """Normal equations of all points, then of poses and ten interior parameters, by difference quotients of the simulator's projection."""
    points, images = len(network.points), len(network.images)
    scale = np.concatenate(
        [np.full(3 * points, 1.0), np.tile([1e-3] * 3 + [1.0] * 3, images), 1e-3 * np.maximum(np.abs(state.interior[0, :10]), 1e-3)]
    )

    def at(p: np.ndarray) -> State:
        p = p * scale * 1e-2
        xyz, pose, interior = p[: 3 * points], p[3 * points : -10].reshape(images, 6), state.interior.copy()
        interior[0, :10] += p[-10:]
        turned = Rotation.from_rotvec(pose[:, :3]).as_matrix() @ state.rotation
        return replace(state, xyz=state.xyz + xyz.reshape(-1, 3), rotation=turned, position=state.position + pose[:, 3:], interior=interior)

    whiten = 1 / np.sqrt(network.covariance_px2[:, [0, 2]]).ravel()
    steps = np.eye(len(scale))
    J = np.stack([(predicted(network, at(s)) - predicted(network, at(-s))).ravel() * whiten / 2 for s in steps], axis=1) / (1e-2 * scale)
    N = J.T @ J
    weight = np.where(np.isfinite(network.u_xyz), network.u_xyz, np.inf).ravel() ** -2.0
    N[range(3 * points), range(3 * points)] += weight
    for a, b, u in zip(network.bars.start, network.bars.end, network.bars.u, strict=True):
        row, away = np.zeros(len(N)), state.xyz[b] - state.xyz[a]
        row[3 * b : 3 * b + 3] = away / np.linalg.norm(away) / u
        row[3 * a : 3 * a + 3] = -row[3 * b : 3 * b + 3]
        N += np.outer(row, row)
    return N


@pytest.mark.parametrize("kind", ["control and bars", "free"])
def test_the_covariance_is_that_of_the_whole_system(rng: np.random.Generator, kind: str) -> None:
    """Against the inverse of the normal equations of everything at once, for points of which some are ends of bars; what a similarity of
    the free network leaves of them is the same in any datum."""
    simulated = world(rng, kind, images=6, points=16, direction="object_to_image")
    network = simulated.network
    adjustment = adjust(network, simulated.truth, a_priori=True)
    free, ends = np.isinf(network.u_xyz).all(axis=1), np.isin(np.arange(len(network.points)), network.bars.start)
    points = np.concatenate([np.flatnonzero(free & ~ends)[:5], np.flatnonzero(free & ends)])
    N = dense_normals(network, adjustment.state)
    size = np.sqrt(np.diag(N))
    whole = np.linalg.pinv(N / np.outer(size, size), rcond=1e-10, hermitian=True) / np.outer(size, size)
    at = (3 * points[:, None] + np.arange(3)).ravel()
    expected, found = whole[np.ix_(at, at)], joint_covariance(adjustment, points, a_priori=True)
    if kind == "free":
        X = adjustment.state.xyz[points]
        turns = [np.cross(axis, X).ravel() for axis in np.eye(3)]
        G = np.stack([*(np.tile(axis, len(X)) for axis in np.eye(3)), *turns, X.ravel()], axis=1)
        left = np.eye(len(at)) - G @ np.linalg.pinv(G)
        expected, found = left @ expected @ left.T, left @ found @ left.T
    else:
        blocks = found.reshape(len(points), 3, len(points), 3)[range(len(points)), :, range(len(points))]
        assert np.abs(blocks - adjustment.point_covariance[points]).max() < 1e-3 * np.abs(expected).max()
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("partly", [False, True], ids=["whole", "partly known"])
def test_the_p_value_of_good_check_points_is_uniform(rng: np.random.Generator, kind: str, partly: bool) -> None:
    """Twelve adjustments with fresh noise: their p as normal deviates, the sum of these and of their squares, and all ratios.

    χ² of all together has 200 degrees of freedom or more, so wrong uncertainties of the differences by 40 % would be seen in any case.
    """
    simulated = world(rng, kind)
    points = rng.choice(np.arange(12, 40), 12, replace=False)
    exact = predicted(simulated.network, simulated.truth)
    deviates, total, dof, ratios = [], 0.0, 0, []
    for _ in range(12):
        checks = given(rng, simulated, points)
        if partly:
            checks.xyz[::3, 2], checks.xyz[1::3, :2] = np.nan, np.nan
        record = check_record(measured(rng, kind, simulated, exact), checks)
        assert record.datum_parameters == KINDS[kind] and record.n == record.dof + KINDS[kind] == (24 if partly else 36)
        deviates.append(norm.isf(record.p))
        total, dof = total + record.chi2, dof + record.dof
        ratios += [point.ratio for point in record.points]
    limit = norm.isf(FALSE_FAILURE / 8)
    assert abs(np.sum(deviates)) / np.sqrt(12) < limit
    assert chi2.sf(total / 1.05, dof) > FALSE_FAILURE / 8 and chi2.cdf(total * 1.05, dof) > FALSE_FAILURE / 8  # σ₀ has 500 redundancies
    z = np.array(ratios)[np.isfinite(ratios)]
    assert len(z) == 12 * record.n and np.abs(z).max() < 1.1 * norm.isf(FALSE_FAILURE / 8 / len(z))
    # the ratios hang together: no fewer than 72 of them are free
    assert chi2.sf(72 * np.mean(z**2) / 1.05, 72) > FALSE_FAILURE / 8 and chi2.cdf(72 * np.mean(z**2) * 1.05, 72) > FALSE_FAILURE / 8


@pytest.mark.parametrize("kind", ["control", "free with bars", "free"])
def test_an_error_is_named(rng: np.random.Generator, kind: str) -> None:
    """One coordinate that is wrong by 10 u, of 44 points: what a similarity of these takes of it is small.

    Its ratio is about 9.5 ± 1, the largest of the others about 3 ± 0.5: both limits are five of these away.
    """
    simulated = world(rng, kind, points=60)
    points = rng.choice(np.arange(12, 60), 44, replace=False)
    adjustment = measured(rng, kind, simulated, predicted(simulated.network, simulated.truth))
    checks = given(rng, simulated, points)
    row, axis = int(rng.integers(44)), int(rng.integers(3))
    u = check_record(adjustment, checks).points[row].u_difference[axis]
    checks.xyz[row, axis] += 10 * u
    record = check_record(adjustment, checks)
    worst = record.worst
    assert (worst.name, worst.axis) == (checks.names[row], "XYZ"[axis])
    (finding,) = check_findings(record)
    assert finding.level == "warning" and f"{checks.names[row]} {'XYZ'[axis]}" in finding.text and "Check the coordinates" in finding.advice


@pytest.mark.parametrize("kind", ["heights", "free with bars", "free"])
def test_what_is_known_badly_does_not_pull(rng: np.random.Generator, kind: str) -> None:
    """A check point that is 50 mm off, by its u: the network moves to the others, as a whole, and keeps what the datum has."""
    simulated = world(rng, kind)
    adjustment = measured(rng, kind, simulated, predicted(simulated.network, simulated.truth))
    points = rng.choice(np.arange(12, 40), 10, replace=False)
    checks = given(rng, simulated, points)
    others = [point.difference for point in check_record(adjustment, checks).points[1:]]
    checks.xyz[0] += 50.0
    assert checks.u_xyz is not None
    checks.u_xyz[0] = 50.0
    record = check_record(adjustment, checks)
    assert abs(record.points[0].ratio[0]) == pytest.approx(1.0, abs=0.1)
    u = [point.u_difference for point in record.points[1:]]
    # the first point had a share in the fit: beside noise that is smaller than u, nothing comes in its place
    assert np.abs(np.array([point.difference for point in record.points[1:]]) - others).max() < 5 * np.max(u)
    found, before = np.array([point.found for point in record.points]), adjustment.state.xyz[points]
    apart = [np.linalg.norm(xyz[:, None] - xyz[None], axis=2) for xyz in (found, before)]
    if kind == "free":
        apart[1] *= apart[0].sum() / apart[1].sum()
    assert np.abs(apart[0] - apart[1]).max() < 1e-6
    if kind == "heights":
        assert np.abs(found[:, 2] - before[:, 2]).max() < 1e-6


def test_the_found_points_are_in_the_frame_of_the_check_points(rng: np.random.Generator) -> None:
    """Without noise a free network, turned and stretched, lies on its check points to rounding; u in that frame are the scaled ones."""
    simulated = world(rng, "free")
    network = replace(simulated.network, **dict(zip(("x_px", "y_px"), predicted(simulated.network, simulated.truth).T, strict=True)))
    adjustment = adjust(network, start(rng, "free", simulated.truth), a_priori=True)
    points = np.arange(10, 20)
    record = check_record(adjustment, CheckPoints(tuple(network.points[10:20]), simulated.truth.xyz[10:20]), a_priori=True)
    found = np.array([point.found for point in record.points])
    assert np.abs(found - simulated.truth.xyz[points]).max() < 1e-5 and record.chi2 < 1e-3
    scale = np.linalg.norm(simulated.truth.xyz[0] - simulated.truth.xyz[1])
    scale /= np.linalg.norm(adjustment.state.xyz[0] - adjustment.state.xyz[1])
    u = np.array([point.u_found for point in record.points])
    expected = scale**2 * np.trace(adjustment.point_covariance[points], axis1=1, axis2=2)
    np.testing.assert_allclose((u**2).sum(axis=1), expected, rtol=1e-4)


@pytest.mark.parametrize("kind", ["heights", "free with bars", "free"])
@pytest.mark.parametrize("partly", [False, True], ids=["whole", "partly known"])
def test_the_origin_may_be_far_away(rng: np.random.Generator, kind: str, partly: bool) -> None:
    """Check points in the coordinates of a country, in mm: whatever of them nothing else gives changes nothing but the found points.

    Coordinates of 10⁹ are rounded by 6e-8, a hundred-thousandth of what points are known to.
    """
    simulated = world(rng, kind)
    adjustment = measured(rng, kind, simulated, predicted(simulated.network, simulated.truth))
    checks = given(rng, simulated, rng.choice(np.arange(12, 40), 9, replace=False))
    if partly:
        checks.xyz[::3, 2], checks.xyz[1::3, :2] = np.nan, np.nan
    near = check_record(adjustment, checks)
    assert near.datum_parameters == KINDS[kind]
    for size in (5e6, 1e9):
        far_away = size * rng.choice([-1.0, 1.0], 3) * rng.uniform(0.1, 1, 3) * (1, 1, kind != "heights")
        far = check_record(adjustment, replace(checks, xyz=checks.xyz + far_away))
        assert (far.n, far.dof, far.datum_parameters) == (near.n, near.dof, near.datum_parameters)
        assert far.chi2 == pytest.approx(near.chi2, rel=1e-3) and far.p == pytest.approx(near.p, rel=1e-2)
        for key, offset in (("found", far_away), ("u_found", 0.0), ("difference", 0.0), ("u_difference", 0.0)):
            values = [np.array([getattr(point, key) for point in record.points]) for record in (near, far)]
            np.testing.assert_allclose(values[1] - offset, values[0], atol=2e-6, err_msg=key)


@pytest.mark.parametrize("factor", [1e-10, 1e6])
def test_a_free_network_may_be_of_any_size(rng: np.random.Generator, factor: float) -> None:
    simulated = world(rng, "free")
    network = measured_again(rng, simulated, predicted(simulated.network, simulated.truth))
    checks = given(rng, simulated, rng.choice(np.arange(12, 40), 9, replace=False))
    truth = simulated.truth
    scaled = replace(truth, xyz=factor * truth.xyz, position=factor * truth.position)
    same, found = (check_record(adjust(network, state), checks) for state in (truth, scaled))
    assert found.datum_parameters == 7 and found.dof == same.dof and found.chi2 == pytest.approx(same.chi2, rel=1e-3)


def test_a_similarity_of_many_points(rng: np.random.Generator) -> None:
    """Against the product with a matrix of blocks; of 1500 points this one has 160 MB, and nothing beside the covariance is larger."""
    A, turn = rng.standard_normal((30, 30)), rng.standard_normal((3, 3))
    blocks = np.kron(np.eye(10), turn)
    np.testing.assert_allclose(_turned(A @ A.T, turn), blocks @ A @ A.T @ blocks.T, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "count", "told"), [("free", 3, False), ("free with bars", 3, False), ("free", 4, True), ("control", 1, True)]
)
def test_so_few_say_nothing(rng: np.random.Generator, kind: str, count: int, told: bool) -> None:
    simulated = world(rng, kind)
    points = rng.choice(np.arange(12, 40), count, replace=False)
    adjustment = measured(rng, kind, simulated, predicted(simulated.network, simulated.truth))
    record = check_record(adjustment, given(rng, simulated, points))
    assert (record.p is not None) == (record.worst is not None) == told == ("cannot test" not in record.text)
    assert np.isfinite([point.ratio for point in record.points]).all() == told
    assert not [f for f in check_findings(record) if record.worst is None]


def test_points_that_are_not_determined_are_named(rng: np.random.Generator) -> None:
    simulated = world(rng, "control")
    network = simulated.network
    kept = network.point != 20
    network = replace(network, **{name: getattr(network, name)[kept] for name in ("x_px", "y_px", "image", "point", "covariance_px2")})
    checks = given(rng, simulated, np.array([20, 21]))
    checks = replace(checks, names=("T21", "elsewhere"))
    adjustment = adjust(network, replace(simulated.truth, xyz=np.where(np.arange(40)[:, None] == 20, np.nan, simulated.truth.xyz)))
    record = check_record(adjustment, checks)
    assert record.n == 0 and record.p is None and np.isnan(record.points[0].found).all()
    (finding,) = check_findings(record)
    assert finding.level == "warning" and "T21, elsewhere" in finding.text
    record = check_record(adjustment, replace(checks, names=("T22", "T21")))
    assert record.n == 3 and [point.images > 0 for point in record.points] == [True, False]


@pytest.mark.parametrize("empty", [1, 3])
def test_rows_without_coordinates_are_not_taken_for_undetermined(rng: np.random.Generator, empty: int) -> None:
    simulated = world(rng, "control")
    adjustment = adjust(simulated.network, simulated.truth)
    checks = given(rng, simulated, np.array([20, 21, 22]))
    checks.xyz[:empty] = np.nan
    record = check_record(adjustment, checks)
    found = [finding for finding in check_findings(record) if "contradict" not in finding.text]
    assert [finding.level for finding in found] == ["warning" if empty == 3 else "note"]
    assert found[0].text.startswith(f"{empty} of 3 check points {'is' if empty == 1 else 'are'} without coordinates: T21")
    assert "not determined" not in found[0].text and ("could be compared" in record.text) == (empty == 3)


def test_lists_will_do(rng: np.random.Generator) -> None:
    simulated = world(rng, "control")
    adjustment = adjust(simulated.network, simulated.truth)
    checks = given(rng, simulated, np.array([20, 21]))
    assert checks.u_xyz is not None
    listed = CheckPoints(list(checks.names), checks.xyz.tolist(), checks.u_xyz.tolist())  # type: ignore[arg-type]
    assert check_record(adjustment, listed).chi2 == check_record(adjustment, checks).chi2 and listed.names == checks.names
    exact = CheckPoints(["T21"], [[1, 2, None]])  # type: ignore[arg-type, list-item]
    np.testing.assert_array_equal(exact.xyz, [[1, 2, np.nan]])
    np.testing.assert_array_equal(exact.u_xyz, [[0, 0, 0]])


@pytest.mark.parametrize(
    ("value", "text"), [(0.4, "0.40"), (0.04, "0.040"), (0.0996, "0.10"), (3, "3.0"), (9.96, "10"), (12.3, "12"), (2345, "2300")]
)
def test_two_digits_are_said(value: float, text: str) -> None:
    record = CheckRecord("mm", 0, 3, 3, 0.001, (value, np.nan, np.nan), (value,) * 3, None, None, None, "", ())
    assert f" {text} mm rms" in _text(record).replace("X ", "")


def test_the_argument_of_calibrate(rng: np.random.Generator) -> None:
    simulated = world(rng, "control", images=12)
    checks = given(rng, simulated, np.arange(20, 30))
    without = pixmetry.calibrate(simulated.network, options={"folds": 0})
    calibration = pixmetry.calibrate(simulated.network, options={"folds": 0}, check_points=checks)
    assert (calibration.adjustment.state.xyz == without.adjustment.state.xyz).all() and without.tests.check_points is None
    record = calibration.tests.check_points
    a = calibration.adjustment
    assert [point.name for point in record.points] == list(checks.names)
    np.testing.assert_allclose([p.difference for p in record.points], checks.xyz - a.state.xyz[20:30], atol=1e-12)
    with pytest.raises(InputError, match="'T3' is among the points and the check points"):
        pixmetry.calibrate(simulated.network, check_points=replace(checks, names=("T3", *checks.names[1:])))


@pytest.mark.parametrize(
    ("names", "xyz", "u"),
    [
        ("ab", np.zeros((1, 3)), None),
        ("aa", np.zeros((2, 3)), None),
        ("ab", np.full((2, 3), np.inf), None),
        ("ab", np.zeros((2, 3)), -np.ones((2, 3))),
        ("ab", np.zeros((2, 3)), np.zeros(2)),
        ("ab", [[1, 2, 3], [1, 2]], None),
        ("ab", [[1, 2, "3 mm"], [1, 2, 3]], None),
    ],
)
def test_what_cannot_be_check_points_is_refused(names: str, xyz: Any, u: np.ndarray | None) -> None:
    with pytest.raises(InputError, match="check points"):
        CheckPoints(tuple(names), xyz, u)
