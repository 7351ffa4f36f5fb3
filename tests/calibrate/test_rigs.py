"""Rigs: relative poses against the truth and against OpenCV, their covariance, the test whether cameras stood still, rectification."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calibrate.distances import Pooled
from calibrate.networks import image_of
from calibrate.rigs import relative_error, simulated_rig, written
from calibrate.test_calibration_images import View, chessboard
from pixmetry import calibrate, read_calibration
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.network import State
from pixmetry.calibrate.bundle.options import Options
from pixmetry.calibrate.bundle.rig import relative_poses
from pixmetry.calibrate.bundle.solve import calibrate_network
from pixmetry.calibrate.checks.added_terms import AddedTerms
from pixmetry.calibrate.checks.rig_check import epipolar_records, rig_findings, rig_record, rigid_test
from pixmetry.calibrate.files.exports import kalibr_text
from pixmetry.calibrate.project import load_project
from pixmetry.calibrate.project.rig_names import cameras_of_files, instants_of_names
from pixmetry.calibrate.rig_pair import CameraPair, camera_pair
from pixmetry.core.errors import InputError, MeasureError

RATE = 1e-6
CHESSBOARDS = Path(os.environ.get("PIXMETRY_DATA", "")) / "opencv-chessboards"


def _disturbed(rng, sim) -> State:
    truth = sim.truth
    n = len(truth.position)
    turn = Rotation.from_rotvec(0.01 * rng.standard_normal((n, 3))).as_matrix()
    xyz = truth.xyz + (0 if (sim.network.u_xyz == 0).all() else 2 * rng.standard_normal(truth.xyz.shape))
    return replace(truth, rotation=turn @ truth.rotation, position=truth.position + 5 * rng.standard_normal((n, 3)), xyz=xyz)


@pytest.mark.parametrize(
    "kind",
    [
        {},
        {"cameras": 3, "missing": ((0, 1), (1, 2), (2, 3), (1, 3)), "direction": "object_to_image"},
        {"known": "free", "bars": 2, "flat": False},
    ],
    ids=["stereo", "three-with-gaps", "free-with-bars"],
)
def test_relative_poses_err_as_their_covariance_says(kind, rng):
    """Over 12 rigs: 72 degrees of freedom and more; standard deviations wrong by −25 % or +45 % fail with 99.9 %."""
    pooled = Pooled(0.0, 0)
    for _ in range(12):
        sim = simulated_rig(rng, **kind)
        found = relative_poses(adjust(sim.network, _disturbed(rng, sim), a_priori=True))
        error = relative_error(found, sim)
        pooled += Pooled(float(error @ np.linalg.solve(found.covariance, error)), len(error))
    assert pooled.dof == 72 * (2 if "cameras" in kind else 1)
    assert pooled.p > RATE, pooled


def test_images_of_one_instant_keep_their_relative_pose(rng):
    """The poses of the adjusted images agree to rounding, and each instant costs six unknowns."""
    sim = simulated_rig(rng, instants=6)
    found = adjust(sim.network, _disturbed(rng, sim))
    alone = adjust(replace(sim.network, instant=None), sim.truth)
    R = found.state.rotation
    turns = np.stack([R[2 * t + 1] @ R[2 * t].T for t in range(6)])
    places = np.stack([R[2 * t] @ (found.state.position[2 * t + 1] - found.state.position[2 * t]) for t in range(6)])
    assert np.abs(turns - turns[0]).max() < 1e-12 and np.abs(places - places[0]).max() < 1e-8
    assert found.dof - alone.dof == 12 * 6 - 6 * (6 + 1)


def test_a_rig_is_the_minimum_under_its_condition(rng):
    """Against dense least squares with SciPy: another parametrisation, difference quotients, an independent projection."""
    from scipy.optimize import least_squares

    sim = simulated_rig(rng, instants=4, free=("c", "xp", "yp"))
    network, found = sim.network, adjust(sim.network, sim.truth)
    camera, instant = network.camera_of, network.instant

    def residuals(z):
        interior = sim.truth.interior.copy()
        interior[:, :3] = z[:6].reshape(2, 3)
        R, d = Rotation.from_rotvec(z[6:9]).as_matrix(), z[9:12]
        base = z[12:].reshape(-1, 6)
        out = []
        for i, (k, t) in enumerate(zip(camera, instant, strict=True)):
            turn = Rotation.from_rotvec(base[t, :3]).as_matrix()
            at = base[t, 3:] + (turn.T @ d if k else 0)
            rows = network.image == i
            x, y, _ = image_of(network.cameras[k], interior[k], R @ turn if k else turn, at, network.xyz[network.point[rows]])
            out += [x - network.x_px[rows], y - network.y_px[rows]]
        return np.concatenate(out) / 0.05

    first = np.flatnonzero(camera == 0)
    bases = [np.r_[Rotation.from_matrix(sim.truth.rotation[i]).as_rotvec(), sim.truth.position[i]] for i in first]
    interior = sim.truth.interior[:, :3].ravel()
    start = np.r_[interior, Rotation.from_matrix(sim.rotation[1]).as_rotvec(), sim.place[1], np.concatenate(bases)]
    models = tuple(replace(model, values=row) for model, row in zip(network.cameras, sim.truth.interior, strict=True))
    fixed = adjust(replace(network, cameras=models), sim.truth)
    dense = least_squares(residuals, start, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert 2 * dense.cost == pytest.approx(fixed.cost[-1], rel=1e-6)
    covariance = np.linalg.inv(dense.jac.T @ dense.jac)[9:12, 9:12] * fixed.sigma0**2
    np.testing.assert_allclose(relative_poses(fixed).block(0)[3:, 3:], covariance, rtol=1e-3, atol=1e-3 * covariance.max())
    np.testing.assert_allclose(relative_poses(fixed).place[0], dense.x[9:12], atol=1e-3)
    assert found.dof == fixed.dof


def test_cameras_that_stand_still_pass_and_moving_ones_do_not(rng):
    """12 still rigs: the sum of −2 ln p is χ² with 24 degrees of freedom. Turns of 0.05° are found, and widen the uncertainties."""
    stat = 0.0
    for _ in range(12):
        sim = simulated_rig(rng, instants=6)
        stat += -2 * np.log(rigid_test(adjust(sim.network, sim.truth)).p)
    assert chi2.sf(stat, 24) > RATE and chi2.cdf(stat, 24) > RATE
    sim = simulated_rig(rng, instants=8, moved_deg=0.05)
    found = adjust(sim.network, sim.truth)
    record = rig_record(found)
    assert record.rigid.p < 1e-6 and record.widened > 2
    (finding,) = rig_findings(record, instants_given=True)
    assert "scatter from instant to instant" in finding.text
    narrow = relative_poses(found).block(0)
    np.testing.assert_allclose(record.cameras[0].u_position, record.widened * np.sqrt(np.diag(narrow)[3:]))


def test_epipolar_distances_are_those_of_the_noise(rng):
    """rms distance within its u of what noise alone leaves, and as an independent computation has it."""
    sim = simulated_rig(rng, instants=10)
    found = adjust(sim.network, sim.truth)
    (record,) = epipolar_records(found)
    assert abs(record.rms_px - record.expected_px) < 6 * record.u_rms_px
    assert record.u_rms_px == pytest.approx(record.rms_px / np.sqrt(2 * record.n), rel=0.2)
    pair = camera_pair(_calibration(sim))
    network, squared = found.network, []
    for t in range(10):
        rows = [np.flatnonzero(network.image == 2 * t + k) for k in (0, 1)]
        _, a, b = np.intersect1d(network.point[rows[0]], network.point[rows[1]], return_indices=True)
        px = [np.column_stack([network.x_px, network.y_px])[rows[k]][which] for k, which in ((0, a), (1, b))]
        squared.append(pair.epipolar_distances(*px) ** 2)
        back = type(pair)(pair.second, pair.first, pair.rotation.T, -pair.rotation.T @ pair.translation)
        squared.append(back.epipolar_distances(px[1], px[0]) ** 2)
    assert np.sqrt(np.concatenate(squared).mean()) == pytest.approx(record.rms_px, rel=0.02)


def _calibration(sim):
    return calibrate_network(sim.network, Options(folds=0, snoop=False, field="fixed"), start=sim.truth)


def _true_pair(sim) -> CameraPair:
    models = [replace(model, values=row) for model, row in zip(sim.network.cameras, sim.truth.interior, strict=True)]
    return CameraPair(models[0], models[1], sim.rotation[1], -sim.rotation[1] @ sim.place[1])


def test_tests_of_patterns_know_the_rig(rng):
    """A term of each image's own is no nuisance that the poses of the rig could not take up: its covariance is finite, p is no miracle."""
    sim = simulated_rig(rng, instants=8)
    found = adjust(sim.network, sim.truth, redundancy=True)
    added = AddedTerms(found)
    term = np.zeros((len(added.rows), 2, 1))
    term[:, 0, 0] = sim.network.x_px[added.rows] * (sim.network.y_px[added.rows] - 768) / 1e6
    result = added.test(term)
    assert result.p > RATE
    normals = added.normals(term)
    assert np.all(normals.left <= normals.full)
    residual = found.residual_px[added.rows] / 0.05
    assert np.abs(added._cameras.T @ residual.ravel()).max() < 1e-4 * np.abs(added._cameras).T.dot(np.abs(residual.ravel())).max()


def test_rectified_points_lie_in_the_same_row(rng):
    """Of the true rig: rows agree to rounding, disparities give the depth; the maps lead back to the picture."""
    cv2 = pytest.importorskip("cv2")
    sim = simulated_rig(rng, noise_px=1e-9)
    pair = _true_pair(sim)
    new = pair.rectified()
    network = sim.network
    rows = [np.flatnonzero(network.image == k) for k in (0, 1)]
    _, a, b = np.intersect1d(network.point[rows[0]], network.point[rows[1]], return_indices=True)
    shared = rows[0][a], rows[1][b]
    left, right = (new.places(network.x_px[own], network.y_px[own], second=k == 1) for k, own in enumerate(shared))
    assert np.abs(left[:, 1] - right[:, 1]).max() < 1e-5
    homogeneous = np.column_stack([left, left[:, 0] - right[:, 0], np.ones(len(left))]) @ new.disparity_to_depth.T
    found = homogeneous[:, :3] / homogeneous[:, 3:]
    points = network.xyz[network.point[rows[0]][a]]
    inside = (points - sim.truth.position[0]) @ sim.truth.rotation[0].T @ new.rotations[0].T
    np.testing.assert_allclose(found, inside, atol=1e-3)
    x, y = new.maps()
    at = left[0].round().astype(int)
    where = new.places(x[at[1], at[0]], y[at[1], at[0]])
    np.testing.assert_allclose(where[0], at, atol=1e-3)
    K = [np.array([[m.c_px[0], 0, m["xp"]], [0, m.c_px[1], m["yp"]], [0, 0, 1]]) for m in (pair.first, pair.second)]
    size = (pair.first.sensor.cols, pair.first.sensor.rows)
    R1, R2, *_ = cv2.stereoRectify(K[0], np.zeros(5), K[1], np.zeros(5), size, pair.rotation, pair.translation[:, None], alpha=0)
    for ours, theirs in zip(new.rotations, (R1, R2), strict=True):  # the same x axis; OpenCV turns otherwise about it
        np.testing.assert_allclose(ours[0], theirs[0], atol=1e-9)


def test_an_upright_pair_keeps_columns(rng):
    """A baseline along y: columns agree."""
    pair = _true_pair(simulated_rig(rng, instants=2))
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = type(pair)(pair.first, pair.second, quarter @ pair.rotation @ quarter.T, quarter @ pair.translation)
    new = turned.rectified()
    point = np.array([30.0, -50, 1200])
    rays = [point @ new.rotations[0].T, (turned.rotation @ point + turned.translation) @ new.rotations[1].T]
    (x1, _), (x2, _) = (ray[:2] / ray[2] for ray in rays)
    assert new.upright and x1 == pytest.approx(x2, abs=1e-12)


def test_names_tell_cameras_and_instants():
    files = [Path(f"x/{side}{n:02d}.png") for side in ("left", "right") for n in (1, 2, 13)]
    assert {name: len(own) for name, own in cameras_of_files(files).items()} == {"left": 3, "right": 3}
    assert instants_of_names(["left01", "left13", "right13"], np.array([0, 0, 1])).tolist() == [0, 1, 1]
    assert instants_of_names(["cam0_0007", "cam0_0008", "cam1_0008"], np.array([0, 0, 1])).tolist() == [0, 1, 1]
    assert list(cameras_of_files([Path(f"{n:03d}_cam{k}.png") for n in range(3) for k in (0, 1)])) == ["cam0", "cam1"]
    with pytest.raises(InputError, match="same instant"):
        instants_of_names(["a", "b"], np.array([0, 1]))
    with pytest.raises(InputError, match="do not tell the cameras"):
        cameras_of_files([Path("a.png"), Path("b.png")])


@pytest.mark.parametrize("rig", ["instant column", "rig: [[cam0-00, cam1-00], [cam0-03, cam1-03]]\n"])
def test_a_project_names_the_instants(rig, rng, tmp_path):
    """By a column or by a list; the result, its file and its page hold the relative pose, within 6 u of the truth."""
    sim = simulated_rig(rng, instants=6)
    found = calibrate(written(tmp_path, sim, rig), tmp_path / "result")
    stored = read_calibration(tmp_path / "result").tests.rig
    assert stored.instants == (2 if "[" in rig else 6)
    error = stored.cameras[0].position - sim.place[1]
    assert np.all(np.abs(error) < 6 * stored.cameras[0].u_position)
    np.testing.assert_allclose(stored.covariance, found.tests.rig.covariance)
    page = (tmp_path / "result" / "report.html").read_text()
    assert "Did the cameras stand still?" in page and "epipolar" in page
    assert stored.epipolar[0].n == found.tests.rig.epipolar[0].n


def test_images_that_fit_no_rig_are_named(rng):
    """A board that one camera counts from its other end, and images of other instants: the reason is the rig, no camera."""
    sim = simulated_rig(rng, instants=6)
    net, options = sim.network, Options(folds=0, field="fixed")
    other = net.camera_of[net.image] == 1
    half_turn = replace(net, point=np.where(other, len(net.points) - 1 - net.point, net.point))
    for wrong in (half_turn, replace(net, instant=np.where(net.camera_of == 1, (net.instant + 1) % 6, net.instant))):
        with pytest.raises(MeasureError, match=r"rig: the images fit when each .* cam[01]-0\d is turned by \d+°"):
            calibrate_network(wrong, options)


def test_cameras_that_no_instant_joins_are_all_named(rng):
    """Two pairs that share no instant: the second is told against its own first camera, and both of it are not joined to the first pair."""
    missing = tuple((k, t) for t in range(8) for k in range(4) if (k < 2) != (t < 4))
    sim = simulated_rig(rng, cameras=4, instants=8, missing=missing)
    record = rig_record(adjust(sim.network, sim.truth))
    assert record.unjoined == ("cam2", "cam3") and list(record.frames()) == ["cam0", "cam1"]
    assert [(one.camera, one.reference) for one in record.cameras] == [("cam1", "cam0"), ("cam3", "cam2")]
    (finding,) = rig_findings(replace(record, rigid=None), instants_given=True)
    assert finding.text.endswith("to cam0: cam2, cam3.")
    text = kalibr_text([replace(model, direction="object_to_image") for model in sim.network.cameras], 0.0, record)
    assert text.count("T_cn_cnm1") == 1
    assert [line.strip() for line in text.splitlines() if "overlaps" in line] == [f"cam_overlaps: {of}" for of in ([1], [0], [], [])]


def test_a_project_takes_instants_from_names(rng, tmp_path):
    sim = simulated_rig(rng, instants=4)
    network = load_project(written(tmp_path, sim, "rig: names\n")).network
    np.testing.assert_array_equal(network.instant, sim.network.instant)


def test_instants_that_cannot_be_are_refused(rng, tmp_path):
    sim = simulated_rig(rng, instants=4)
    project = written(tmp_path, sim, "rig: [[cam0-00, cam0-01]]\n")
    with pytest.raises(InputError, match="one camera and one instant"):
        calibrate(project)
    project.write_text(project.read_text().replace("cam0-01]", "cam7-01]"))
    with pytest.raises(InputError, match="no image 'cam7-01'"):
        calibrate(project)


@pytest.mark.skipif(not CHESSBOARDS.is_dir(), reason="PIXMETRY_DATA has no opencv-chessboards")
def test_the_stereo_pairs_agree_with_opencv(tmp_path):
    """Baseline and rotation of the published chessboards, board as given, against cv2.stereoCalibrate on corners of its own.

    OpenCV locates corners otherwise, so half of the scatter is its own; it states none. Agreement within 3 u.
    """
    cv2 = pytest.importorskip("cv2")
    pictures = [CHESSBOARDS / f"{side}{n:02d}.jpg" for side in ("left", "right") for n in (*range(1, 8), 9, 11, 12)]
    found = calibrate(
        pictures, rig=True, grid="9x6", pitch_mm=25, direction="object_to_image", free="c, xp, yp, b1, p1, p2, k1, k2, k3",
        options={"folds": 0, "field": "fixed", "snoop": False},
    )  # fmt: skip
    (ours,) = found.tests.rig.cameras
    board = np.zeros((54, 3), np.float32)
    board[:, :2] = np.mgrid[0:9, 0:6].T.reshape(-1, 2) * 25
    corners = []
    for path in pictures:
        grey = cv2.imread(str(path), 0)
        ok, places = cv2.findChessboardCorners(grey, (9, 6))
        assert ok
        corners.append(cv2.cornerSubPix(grey, places, (5, 5), (-1, -1), (3, 60, 1e-6)))
    n, size = len(pictures) // 2, (640, 480)
    left, right = corners[:n], corners[n:]
    start = [cv2.calibrateCamera([board] * n, one, size, None, None)[1:3] for one in (left, right)]
    result = cv2.stereoCalibrate([board] * n, left, right, *start[0], *start[1], size, flags=0, criteria=(3, 300, 1e-10))
    R, T = result[5], result[6].ravel()
    assert ours.baseline == pytest.approx(np.linalg.norm(T), abs=3 * ours.u_baseline)
    turn = np.rad2deg(Rotation.from_matrix(ours.rotation @ R.T).as_rotvec())
    assert np.all(np.abs(turn) < 3 * ours.u_rotation_deg)
    assert np.all(np.abs(ours.position + R.T @ T) < 4 * ours.u_position)


def test_one_picture_of_a_held_camera_is_enough(rng, tmp_path):
    """A camera of which nothing is estimated needs one picture; of another the error says whose pictures are too few."""
    import imagecodecs

    for side, count in (("left", 1), ("right", 3)):
        for k in range(count):
            frame = View((3.0, 2.5), 14.0, 10.0 * k, 20 - 15 * k, 5.0).frame(chessboard(7, 6), rng)
            (tmp_path / f"{side}{k}.png").write_bytes(imagecodecs.png_encode(frame))
    text = "schema: pixmetry/calibration/1\ncameras:\n- {name: left, c_px: 600, free: none}\n- {name: right}\nrig: names\n"
    text += "pictures: {files: {left: 'left*.png', right: 'right*.png'}, kind: chessboard, grid: 7x6, pitch: 10}\n"
    project = tmp_path / "project.yaml"
    project.write_text(text)
    network = load_project(project).network
    assert network.images == ("left0.png", "right0.png", "right1.png", "right2.png")
    assert network.instant.tolist() == [0, 0, 1, 2]
    project.write_text(text.replace(", free: none", ""))
    with pytest.raises(MeasureError, match="images of left: 1 of 1 images can be used"):
        load_project(project)
