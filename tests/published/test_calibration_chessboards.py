"""The left images of OpenCV's stereo chessboards: OpenCV's own result from OpenCV's corners, and what a free field says about the board.

Runs where the environment variable PIXMETRY_DATA names the folder that holds opencv-chessboards.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Adjustment, Network
from pixmetry.calibrate.bundle.solve import Options, calibrate_network
from pixmetry.calibrate.images.images import ImageObservations, observations_of
from pixmetry.calibrate.records import Calibration

FOLDER = Path(os.environ.get("PIXMETRY_DATA", "")) / "opencv-chessboards"
pytestmark = pytest.mark.skipif(
    not (os.environ.get("PIXMETRY_DATA") and (FOLDER / "left01.jpg").is_file()),
    reason="PIXMETRY_DATA does not name a folder with opencv-chessboards",
)

COLS, ROWS = 9, 6
SIZE = (640, 480)
PLAIN = Options(field="fixed", loss="none", snoop=False, variance_components=False, folds=0)
OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")  # order of its standard deviations


def files() -> list[Path]:
    return sorted(FOLDER.glob("left*.jpg"))


@cache
def opencv_corners() -> np.ndarray:
    """findChessboardCorners and cornerSubPix, shape (13, 54, 2)."""
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.001)
    out = []
    for path in files():
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        found, corners = cv2.findChessboardCorners(grey, (COLS, ROWS))
        assert found
        out.append(cv2.cornerSubPix(grey, corners, (11, 11), (-1, -1), stop).reshape(-1, 2))
    return np.array(out)


def board() -> np.ndarray:
    row, col = np.divmod(np.arange(COLS * ROWS), COLS)
    return np.column_stack([col, row, np.zeros(len(row))]).astype(float)


def opencv_model() -> CameraModel:
    return CameraModel.of(Sensor(*SIZE), "object_to_image", free=("c", "xp", "yp", "b1", "p1", "p2", "k1", "k2", "k3"))


def opencv_network() -> Network:
    places = opencv_corners()
    images, n = places.shape[:2]
    return Network(
        cameras=(opencv_model(),),
        images=tuple(path.name for path in files()),
        camera_of=np.zeros(images, np.int64),
        points=tuple(f"{k // COLS}/{k % COLS}" for k in range(n)),
        x_px=places[..., 0].ravel().astype(float),
        y_px=places[..., 1].ravel().astype(float),
        image=np.repeat(np.arange(images), n),
        point=np.tile(np.arange(n), images),
        covariance_px2=np.tile([1.0, 0.0, 1.0], (images * n, 1)),
        xyz=board(),
        u_xyz=np.zeros((n, 3)),
        unit="squares",
    )


def as_opencv(adjustment: Adjustment) -> tuple[dict[str, float], dict[str, float]]:
    """Values and standard deviations by OpenCV's names: fx = c (1 + b1), and its p1 is the other one's p2."""
    camera = adjustment.camera()
    names, covariance = adjustment.interior_covariance()
    c, b1 = camera["c"], camera["b1"]
    slopes = {"fx": {"c": 1 + b1, "b1": c}, "fy": {"c": 1.0}, "cx": {"xp": 1.0}, "cy": {"yp": 1.0}, "p1": {"p2": 1.0}, "p2": {"p1": 1.0}}
    values = {"fx": c * (1 + b1), "fy": c, "cx": camera["xp"], "cy": camera["yp"], "p1": camera["p2"], "p2": camera["p1"]}
    values |= {k: camera[k] for k in ("k1", "k2", "k3")}
    u = {}
    for name in OPENCV:
        row = np.array([slopes.get(name, {name: 1.0}).get(own, 0.0) for own in names])
        u[name] = float(np.sqrt(row @ covariance @ row))
    return values, u


@cache
def located() -> ImageObservations:
    return observations_of(files(), "chessboard", grid=(COLS, ROWS), pitch=1.0)


@cache
def calibrated() -> Calibration:
    """From the corners located here, the board's coordinates free where images left out say so."""
    return calibrate_network(located().network(opencv_model(), unit="squares"), Options(field="auto"))


def test_opencv_corners_and_model_give_opencv_parameters_and_standard_deviations() -> None:
    """Parameters within 1e-3 px (c, xp, yp; the others within what moves an image point by as much) and deviations within 1 %.

    ``calibrateCameraExtended`` scales the inverse of JᵀJ by the sum of squared residuals over (coordinates − unknowns), 1404 − 87 here,
    as an a posteriori sigma0² does: it takes errors as independent. On these pictures they are not (the last lines). (The rms it returns is
    per point, not per coordinate: √2 of the coordinates' rms.)
    """
    places = [p.astype(np.float32) for p in opencv_corners()]
    objects = [board().astype(np.float32)] * len(places)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 1000, 1e-15)
    rms, matrix, lens, _, _, deviations, *_ = cv2.calibrateCameraExtended(objects, places, SIZE, None, None, criteria=stop)
    k1, k2, p1, p2, k3 = lens.ravel()[:5]
    theirs = dict(zip(OPENCV, (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], k1, k2, p1, p2, k3), strict=True))

    adjustment = calibrate_network(opencv_network(), replace(PLAIN, shared_errors=False)).adjustment
    ours, u = as_opencv(adjustment)
    reach = np.hypot(*SIZE) / 2 / theirs["fx"]  # of a corner of the frame, as a tangent
    for name, power in zip(OPENCV, (0, 0, 0, 0, 3, 5, 2, 2, 7), strict=True):
        scale = 1.0 if power == 0 else theirs["fx"] * reach**power
        assert abs(ours[name] - theirs[name]) * scale < 1e-3, name
    for name, deviation in zip(OPENCV, deviations.ravel(), strict=False):
        assert u[name] == pytest.approx(float(deviation), rel=0.01), name
    assert np.sqrt(np.mean(np.sum(adjustment.residual_px**2, axis=1))) == pytest.approx(rms, rel=1e-6)
    assert adjustment.dof == 2 * 54 * 13 - 9 - 6 * 13

    stated = calibrate_network(opencv_network(), PLAIN).adjustment
    assert stated.shared is not None and stated.shared.found
    np.testing.assert_array_equal(stated.state.interior, adjustment.state.interior)
    independent = np.sqrt(np.diag(adjustment.interior_covariance()[1]))
    np.testing.assert_allclose(stated.interior_u_independent(), independent, rtol=1e-9)
    names, covariance = stated.interior_covariance()
    wider = dict(zip(names, np.sqrt(np.diag(covariance)) / independent, strict=True))
    assert all(wider[name] > 1.5 for name in ("c", "xp", "yp", "p1", "p2")), wider


def test_halves_of_the_pictures_agree_within_the_stated_uncertainties() -> None:
    """Every other picture, and the first half against the second: with uncertainties of independent errors F is 4.0 and 6.7 (p < 1e-4)."""
    tests = calibrated().tests
    (shared,), (halves,) = tests.shared_errors.values(), tests.halves.values()
    assert shared.found and set(shared.kinds) == {"image", "frame", "view", "oblique"}
    for one in halves:
        assert one.p > 0.05 and one.f < 2, (one.by, one.f)


def test_corners_are_those_of_opencv_in_another_order() -> None:
    """All 54 in all 13 images, to 0.06 px in the median. OpenCV's window of 23 px holds other edges where squares are small: a dozen of its
    corners are off by more than 0.3 px, the worst by 6 px, still far less than a square."""
    seen = located()
    assert seen.images == tuple(path.name for path in files()) and len(seen) == 13 * 54
    for i, theirs in enumerate(opencv_corners()):
        here = seen.image == i
        ours = np.column_stack([seen.x_px, seen.y_px])[here]
        distance = np.hypot(*(ours[:, None] - theirs[None]).transpose(2, 0, 1))
        assert (np.sort(distance.argmin(axis=1)) == np.arange(54)).all()
        nearest = distance.min(axis=1)
        assert np.median(nearest) < 0.1 and np.mean(nearest > 0.4) < 0.15 and nearest.max() < 8


def test_first_corner_is_the_same_in_all_images() -> None:
    """The board of 10 × 7 squares has one dark corner on the left: half a turn makes the colours wrong, in every image."""
    seen = located()
    for i, path in enumerate(files()):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(float)
        place = np.empty((ROWS, COLS, 2))
        row, col = np.array([name.split("/") for name in seen.points], int)[seen.point[seen.image == i]].T
        place[row, col] = np.column_stack([seen.x_px, seen.y_px])[seen.image == i]
        x, y = np.rint(0.25 * (place[:-1, :-1] + place[1:, :-1] + place[:-1, 1:] + place[1:, 1:])).astype(int).transpose(2, 0, 1)
        squares = grey[y, x]
        sign = np.where(np.add.outer(np.arange(ROWS - 1), np.arange(COLS - 1)) % 2 == 0, 1, -1)
        assert (sign * squares).sum() < 0, path.name
        along, down = place[0, -1] - place[0, 0], place[-1, 0] - place[0, 0]
        assert along[0] * down[1] - along[1] * down[0] > 0, path.name


def test_free_board_points_serve_images_left_out_of_the_fit() -> None:
    """The board is bent: with its points free the rms falls in images that took no part in the fit, not only in those that did."""
    held = calibrated().tests.hold_out
    assert held.free is not None
    assert held.free.left_out_rms_px < 0.8 * held.fixed.left_out_rms_px
    assert held.free.fit_rms_px < held.fixed.fit_rms_px


def test_report_says_that_the_board_is_not_flat() -> None:
    """By how much, and that the principal point moves by far more than its formal uncertainty with the board held fixed."""
    calibration = calibrated()
    said = [finding.text for finding in calibration.findings if "flat" in finding.kind + finding.text]
    assert said, [finding.kind for finding in calibration.findings]
    field = calibration.tests.field
    off, moved = field.compared.deviations, field.compared.first
    assert field.verdict == "free" and off.peak > off.rms > 0
    assert np.hypot(moved.moved_xp_px, moved.moved_yp_px) > 2 * np.hypot(moved.u_xp_px, moved.u_yp_px)
