"""A rig after its adjustment: relative poses, whether the cameras stood still, and the distance of image points from epipolar lines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment
from pixmetry.calibrate.bundle.rig import RelativePoses, relative_poses
from pixmetry.calibrate.bundle.shared_errors import with_shared_errors
from pixmetry.calibrate.records import EpipolarRecord, RigCamera, RigidTest, RigRecord
from pixmetry.core.errors import MeasureError
from pixmetry.core.finding import Finding

RARE = 1e-3
FAR = 1.5  # scatter of the relative poses over that of noise, above which it is told


def rig_record(adjustment: Adjustment) -> RigRecord | None:
    """What an adjusted network says of its rig; None where it has none.

    Where the relative poses of single instants differ by more than noise explains, uncertainties are √F times as large, as that scatter
    tells (R. T. Birge, Phys. Rev. 40 (1932) 207–227).
    """
    poses = relative_poses(adjustment)
    if poses is None or adjustment.network.instant is None:
        return None
    rigid = rigid_test(adjustment)
    wider = rigid.f if rigid is not None and rigid.p < RARE else 1.0
    poses = replace(poses, covariance=poses.covariance * wider)
    cameras = tuple(_camera(poses, k) for k in range(len(poses.cameras)))
    taken = np.unique(adjustment.network.instant[adjustment.state.posed], return_counts=True)
    instants = int(((taken[1] > 1) & (taken[0] >= 0)).sum())
    taking = {adjustment.network.cameras[k].name for k in adjustment.network.camera_of[adjustment.state.posed]}
    root = poses.reference[0]
    joined = {root, *(name for name, reference in zip(poses.cameras, poses.reference, strict=True) if reference == root)}
    unjoined = tuple(sorted(taking - joined))
    return RigRecord(
        instants=instants,
        unit=adjustment.network.unit,
        cameras=cameras,
        covariance=poses.covariance,
        epipolar=epipolar_records(adjustment),
        rigid=rigid,
        widened=float(np.sqrt(wider)),
        unjoined=unjoined,
    )


def _camera(poses: RelativePoses, k: int) -> RigCamera:
    from scipy.spatial.transform import Rotation

    own, place = poses.block(k), poses.place[k]
    turn = Rotation.from_matrix(poses.rotation[k]).as_rotvec()
    along = place / max(float(np.linalg.norm(place)), 1e-300)
    axis = turn / max(float(np.linalg.norm(turn)), 1e-300)  # a turn about its own axis is what changes its angle, to first order
    return RigCamera(
        camera=poses.cameras[k],
        reference=poses.reference[k],
        rotation=poses.rotation[k],
        rotation_deg=np.rad2deg(turn),
        u_rotation_deg=np.rad2deg(np.sqrt(np.diag(own)[:3])),
        position=place,
        u_position=np.sqrt(np.diag(own)[3:]),
        baseline=float(np.linalg.norm(place)),
        u_baseline=float(np.sqrt(along @ own[3:, 3:] @ along)),
        angle_deg=float(np.rad2deg(np.linalg.norm(turn))),
        u_angle_deg=float(np.rad2deg(np.sqrt(axis @ own[:3, :3] @ axis))),
    )


def _pairs(adjustment: Adjustment) -> Iterator[tuple[int, int, list[tuple[int, int]]]]:
    """Pairs of cameras, with the pairs of their images of one instant."""
    network, posed = adjustment.network, adjustment.state.posed
    assert network.instant is not None
    at: dict[int, dict[int, int]] = {}
    for i in np.flatnonzero(posed & (network.instant >= 0)):
        at.setdefault(int(network.instant[i]), {})[int(network.camera_of[i])] = int(i)
    for first, second in combinations(range(len(network.cameras)), 2):
        images = [(one[first], one[second]) for one in at.values() if first in one and second in one]
        if images:
            yield first, second, images


def epipolar_records(adjustment: Adjustment) -> tuple[EpipolarRecord, ...]:
    """Distances of image points from the epipolar lines of the same points in the other camera, in images without distortion.

    The distance in the image of one camera is e c/√(l₁² + l₂²) with l = E x, E = [t]× R, e = x'ᵀ E x (R. Hartley, A. Zisserman, Multiple
    View Geometry, 2nd ed., 2004, chapter 9); its variance follows from both image coordinates. Both cameras count alike.
    """
    network, state = adjustment.network, adjustment.state
    factor = adjustment.sigma0**2
    rows_of = [np.flatnonzero(adjustment.used & (network.image == i)) for i in range(len(network.images))]
    out = []
    for first, second, images in _pairs(adjustment):
        squared, expected = [], []
        for i, j in images:
            _, a, b = np.intersect1d(network.point[rows_of[i]], network.point[rows_of[j]], return_indices=True)
            rows = rows_of[i][a], rows_of[j][b]
            if not len(a):
                continue
            R = state.rotation[j] @ state.rotation[i].T
            t = state.rotation[j] @ (state.position[i] - state.position[j])
            E = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ R
            (x, cov_x), (y, cov_y) = (_rays(adjustment, k, own) for k, own in ((first, rows[0]), (second, rows[1])))
            line, back = x @ E.T, y @ E
            e = np.einsum("ni,ni->n", y, line)
            variance = np.einsum("ni,nij,nj->n", back[:, :2], cov_x, back[:, :2])
            variance = factor * (variance + np.einsum("ni,nij,nj->n", line[:, :2], cov_y, line[:, :2]))
            for k, normal in ((second, line), (first, back)):
                scale = np.mean(adjustment.camera(k).c_px) ** 2 / (normal[:, 0] ** 2 + normal[:, 1] ** 2)
                squared.append(e**2 * scale)
                expected.append(variance * scale)
        if squared:
            all_squared, n = np.concatenate(squared), len(np.concatenate(squared)) // 2
            rms = float(np.sqrt(all_squared.mean()))
            noise = float(np.sqrt(np.concatenate(expected).mean()))
            u = float(np.sqrt(np.var(all_squared) / n) / (2 * rms)) if rms > 0 else 0.0
            out.append(EpipolarRecord(network.cameras[first].name, network.cameras[second].name, n, rms, u, noise))
    return tuple(out)


def _rays(adjustment: Adjustment, k: int, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions (u, v, 1) of image points, and the covariance of u, v."""
    model, network = adjustment.camera(k), adjustment.network
    u, v = model.direction_of(network.x_px[rows], network.y_px[rows])
    by_pixel = np.linalg.inv(model.projected(u, v)[2])
    var_x, cov, var_y = network.covariance_px2[rows].T
    covariance = np.stack([np.stack([var_x, cov], -1), np.stack([cov, var_y], -1)], -2)
    return np.column_stack([u, v, np.ones(len(u))]), by_pixel @ covariance @ np.swapaxes(by_pixel, 1, 2)


def rigid_test(adjustment: Adjustment) -> RigidTest | None:
    """Whether the cameras stood still against each other: the network adjusted again with a pose of its own for each image.

    F is what the poses of their own explain, over the rest. Where image points share errors, these let single poses differ too: then F is
    of the differences of the relative poses from their mean by their joint covariance, with the shared errors in it. The scatter of the
    relative poses says how large the motion would be. None where an image alone does not determine its pose, or there is one instant.
    """
    from scipy.spatial.transform import Rotation
    from scipy.stats import f as distribution

    from pixmetry.calibrate.bundle.bundle import adjust

    network, state = adjustment.network, adjustment.state
    try:
        alone = adjust(replace(network, instant=None), state, used=adjustment.used)
    except MeasureError:
        return None
    more = adjustment.dof - alone.dof
    if more <= 0 or alone.dof <= 0 or (alone.used != adjustment.used).any():
        return None
    f, rest = max(0.0, (adjustment.cost[-1] - alone.cost[-1]) / more) / (alone.cost[-1] / alone.dof), float(alone.dof)
    alone = with_shared_errors(alone) if adjustment.shared is not None and adjustment.shared.found else alone
    places = {name: i for i, name in enumerate(alone.free_columns)}
    turns, shifts, noise, worst = [], [], [], (0.0, "")
    errors, slopes, group = [], [], []
    for number, (_, _, images) in enumerate(_pairs(adjustment)):
        for i, j in images:
            free, rig = ((_between(one.rotation, one.position, i, j)) for one in (alone.state, state))
            turn = Rotation.from_matrix(free[0] @ rig[0].T).as_rotvec()
            columns = [places[f"{network.images[n]}:rx"] + a for n in (j, i) for a in range(6)]
            J = _slopes(alone.state.rotation[i], *free)
            C = J @ alone.covariance[np.ix_(columns, columns)] @ J.T
            error = np.concatenate([turn, free[1] - rig[1]])
            distance = float(error @ np.linalg.solve(C, error))
            errors.append(error)
            slopes.append((columns, J))
            group.append(number)
            worst = max(worst, (distance, network.images[j]))
            turns.append(turn @ turn)
            shifts.append(error[3:] @ error[3:])
            noise.append((np.trace(C[:3, :3]), np.trace(C[3:, 3:])))
    expected = np.sqrt(np.mean(noise, axis=0))
    if alone.shared is not None and alone.shared.found:
        f, rest = _scatter(np.concatenate(errors), slopes, np.array(group), alone, more)
    return RigidTest(
        f=float(f),
        dof=(more, round(rest)),
        p=float(distribution.sf(f, more, rest)),
        scatter=float(np.sqrt(np.mean(shifts))),
        expected=float(expected[1]),
        scatter_deg=float(np.rad2deg(np.sqrt(np.mean(turns)))),
        expected_deg=float(np.rad2deg(expected[0])),
        worst=worst[1],
    )


def _scatter(
    errors: np.ndarray, slopes: list[tuple[list[int], np.ndarray]], group: np.ndarray, alone: Adjustment, dof: int
) -> tuple[float, float]:
    """Square of differences of relative poses (6 each) from the mean of their pair of cameras, by their joint covariance, over its degrees
    of freedom; and those of the covariance."""
    assert alone.shared is not None
    whole = np.zeros((len(errors), len(alone.covariance)))
    for i, (columns, J) in enumerate(slopes):
        whole[6 * i : 6 * i + 6, columns] = J
    C = whole @ alone.covariance @ whole.T
    size = np.sqrt(np.diag(C))
    weight = np.linalg.pinv(C / np.outer(size, size), rcond=1e-9, hermitian=True)
    mean = np.kron(group[:, None] == np.unique(group), np.eye(6)) / size[:, None]
    left = errors / size
    left = left - mean @ np.linalg.lstsq(mean.T @ weight @ mean, mean.T @ weight @ left, rcond=None)[0]
    taken = np.flatnonzero(whole.any(axis=0))
    return float(left @ weight @ left) / dof, float(np.mean(alone.shared.dof[taken]))


def _between(rotation: np.ndarray, position: np.ndarray, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """R and d of image j against image i."""
    return rotation[j] @ rotation[i].T, rotation[i] @ (position[j] - position[i])


def _slopes(base: np.ndarray, R: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Derivatives of a relative pose (a, b) by the poses (ω, X₀) of image j and of its base i, shape (6, 12)."""
    J = np.zeros((6, 12))
    J[:3, :3], J[:3, 6:9] = np.eye(3), -R
    J[3:, 3:6], J[3:, 9:12] = base, -base
    J[3:, 6:9] = -np.array([[0, -d[2], d[1]], [d[2], 0, -d[0]], [-d[1], d[0], 0]])
    return J


def rig_findings(record: RigRecord | None, *, instants_given: bool) -> list[Finding]:
    """What must be said of a rig."""
    if record is None:
        if not instants_given:
            return []
        text = "No instant has images of two cameras: nothing ties the cameras of the rig together."
        return [Finding("rig", text, "Check which images were taken at the same instant.", "warning")]
    out = []
    if record.unjoined:
        text = f"No chain of common instants joins these cameras to {record.cameras[0].reference}: {', '.join(record.unjoined)}."
        out.append(Finding("rig", text, "Take images of them together, or calibrate them alone.", "warning"))
    test = record.rigid
    if test is not None and test.p < RARE and (test.scatter > FAR * test.expected or test.scatter_deg > FAR * test.expected_deg):
        text = (
            f"The relative poses of the rig's cameras scatter from instant to instant by {test.scatter:.2g} {record.unit} and "
            f"{test.scatter_deg:.2g}°, where noise explains {test.expected:.2g} {record.unit} and {test.expected_deg:.2g}° "
            f"(F = {test.f:.3g}): the cameras moved, images of one instant were not taken together, or lens and field are not as they were "
            f"modelled. It is worst in {test.worst}. The uncertainties of the relative poses are {record.widened:.2g} times those of noise."
        )
        advice = "Check that the images of each instant belong together and were triggered together, and that no camera was touched."
        out.append(Finding("rig", text, advice, "warning"))
    return out
