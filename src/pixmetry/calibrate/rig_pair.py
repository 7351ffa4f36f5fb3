"""Two cameras of a rig as computer vision wants them: R, T, E, F, and rectification with its maps.

Rectified images have the rows of both cameras along the same epipolar lines: both look along one direction, across the baseline, with one
principal distance (A. Fusiello, E. Trucco, A. Verri, Machine Vision and Applications 12 (2000) 16–22). The new x axis runs along the
baseline; the new z axis is the mean of both optical axes, as far as it is across the baseline. Where the baseline is more upright than
level, columns take the place of rows, as in OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.core.arrays import given_array
from pixmetry.core.errors import InputError

if TYPE_CHECKING:
    from pixmetry.calibrate.files.record import StoredCalibration
    from pixmetry.calibrate.records import Calibration


@dataclass(frozen=True)
class CameraPair:
    """Two cameras that stand still against each other.

    Parameters
    ----------
    first, second : CameraModel
    rotation : ndarray, shape (3, 3)
        R of R X + T, from the frame of the first to that of the second; as in OpenCV.
    translation : ndarray, shape (3,)
        T, in the unit of the object.
    """

    first: CameraModel
    second: CameraModel
    rotation: np.ndarray
    translation: np.ndarray

    @property
    def essential(self) -> np.ndarray:
        """E = [T]× R of x′ᵀ E x = 0, for x = (X/Z, Y/Z, 1)."""
        x, y, z = self.translation
        matrix: np.ndarray = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ self.rotation
        return matrix

    def epipolar_distances(self, first_px: np.ndarray, second_px: np.ndarray) -> np.ndarray:
        """Distances of points in the second image from the epipolar lines of the points in the first, px without distortion, shape (n,).

        Parameters
        ----------
        first_px, second_px : ndarray, shape (n, 2)
            Image coordinates of the same points.
        """
        first_px = given_array(first_px, "first_px", ("n", 2))
        second_px = given_array(second_px, "second_px", (len(first_px), 2))
        x, y = (np.column_stack([*model.direction_of(*px.T), np.ones(len(px))])
                for model, px in ((self.first, first_px), (self.second, second_px)))  # fmt: skip
        line = x @ self.essential.T
        distance: np.ndarray = np.einsum("ni,ni->n", y, line) / np.hypot(line[:, 0], line[:, 1]) * np.mean(self.second.c_px)
        return distance

    def rectified(self, size: tuple[int, int] | None = None) -> Rectification:
        """Rotations and a common camera matrix in which points have the same row in both images.

        Parameters
        ----------
        size : (cols, rows), optional
            Of the new frames; by default that of the first.

        Raises
        ------
        InputError
            If the cameras stand at one place, or look along their baseline.
        """
        base = -self.rotation.T @ self.translation  # from the first to the second, in the frame of the first
        length = float(np.linalg.norm(base))
        axes = np.array([0.0, 0.0, 1.0]) + self.rotation[2]
        upright = abs(base[1]) > abs(base[0])
        across = base / length if length > 0 else np.array([np.nan, 0.0, 0.0])
        z = axes - (axes @ across) * across
        if not np.linalg.norm(z) > 0.1:
            what = "the cameras stand at one place, or look along the line between them: there is no rectification"
            raise InputError(what, where=f"{self.first.name}, {self.second.name}", allowed="cameras side by side")
        z /= np.linalg.norm(z)
        along = across * np.sign(across[1] if upright else across[0])
        new = np.stack([np.cross(along, z), along, z] if upright else [along, np.cross(z, along), z])
        cols, rows = size or (self.first.sensor.cols, self.first.sensor.rows)
        turns = new, new @ self.rotation.T
        c = float(np.mean([np.mean(model.c_px) for model in (self.first, self.second)]))
        middles = []
        for model, turn in zip((self.first, self.second), turns, strict=True):
            ray = np.column_stack([*model.direction_of(*np.reshape(model.sensor.centre, (2, 1))), [1.0]]) @ turn.T
            middles.append(c * ray[0, :2] / ray[0, 2])
        principal = np.array([(cols - 1) / 2, (rows - 1) / 2]) - np.mean(middles, axis=0)
        shift = float((new @ base)[1 if upright else 0])
        return Rectification(self, turns, c, (float(principal[0]), float(principal[1])), (cols, rows), shift, upright)


@dataclass(frozen=True)
class Rectification:
    """A rectified pair.

    Parameters
    ----------
    pair : CameraPair
    rotations : (ndarray, ndarray)
        OpenCV’s R1 and R2: from the frame of each camera to the rectified one.
    c_px : float
    principal_px : (float, float)
        Of both new images.
    size : (cols, rows)
    shift : float
        Place of the second camera along the new x axis (y where the baseline is upright), in the unit of the object.
    upright : bool
    """

    pair: CameraPair
    rotations: tuple[np.ndarray, np.ndarray]
    c_px: float
    principal_px: tuple[float, float]
    size: tuple[int, int]
    shift: float
    upright: bool

    @property
    def projections(self) -> tuple[np.ndarray, np.ndarray]:
        """OpenCV’s P1 and P2, shape (3, 4): of points in the rectified frame of the first camera."""
        own = np.array([[self.c_px, 0, self.principal_px[0], 0], [0, self.c_px, self.principal_px[1], 0], [0, 0, 1.0, 0]])
        other = own.copy()
        other[1 if self.upright else 0, 3] = -self.c_px * self.shift
        return own, other

    @property
    def disparity_to_depth(self) -> np.ndarray:
        """OpenCV’s Q, shape (4, 4): (x, y, x − x′, 1) to the homogeneous point in the rectified frame of the first camera."""
        (cx, cy), c = self.principal_px, self.c_px
        return np.array([[1.0, 0, 0, -cx], [0, 1, 0, -cy], [0, 0, 0, c], [0, 0, 1 / self.shift, 0]])

    def maps(self, second: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Where in the picture each pixel of the rectified image is seen, px, as `cv2.remap` takes them, float32, shape (rows, cols).

        The whole model of the camera is used, so that nothing is lost by a conversion; NaN where a direction has no image.
        """
        model, turn = (self.pair.second, self.rotations[1]) if second else (self.pair.first, self.rotations[0])
        x, y = np.meshgrid(np.arange(self.size[0]), np.arange(self.size[1]))
        rays = np.stack([(x - self.principal_px[0]) / self.c_px, (y - self.principal_px[1]) / self.c_px, np.ones(x.shape)], axis=-1) @ turn
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = (np.where(rays[..., 2] > 0, rays[..., k] / rays[..., 2], np.nan) for k in (0, 1))
        px, py = model.project(u, v)
        return px.reshape(x.shape).astype(np.float32), py.reshape(x.shape).astype(np.float32)

    def places(self, x_px: np.ndarray, y_px: np.ndarray, second: bool = False) -> np.ndarray:
        """Image coordinates of a picture in the rectified image, shape (n, 2)."""
        model, turn = (self.pair.second, self.rotations[1]) if second else (self.pair.first, self.rotations[0])
        rays = np.column_stack([*model.direction_of(x_px, y_px), np.ones(len(np.atleast_1d(x_px)))]) @ turn.T
        found: np.ndarray = self.c_px * rays[:, :2] / rays[:, 2:] + self.principal_px
        return found


def camera_pair(calibration: Calibration | StoredCalibration, first: str | None = None, second: str | None = None) -> CameraPair:
    """Two cameras of a calibrated rig.

    Parameters
    ----------
    calibration : Calibration or StoredCalibration
    first, second : str, optional
        Names; by default the first two of the rig.

    Raises
    ------
    InputError
        If the calibration has no rig, or not these cameras.

    Examples
    --------
    ``pair = camera_pair(pixmetry.read_calibration("result"))``, then ``cv2.remap(picture, *pair.rectified().maps(), cv2.INTER_LINEAR)``.
    """
    from pixmetry.calibrate.files.record import StoredCalibration, check_calibration

    check_calibration(calibration)
    for where, name in (("first", first), ("second", second)):
        if name is not None and not isinstance(name, str):
            raise InputError("not the name of a camera", where=where, value=type(name).__name__, allowed="a name")
    rig = calibration.tests.rig
    if isinstance(calibration, StoredCalibration):
        models = {model.name: model for model in calibration.cameras}
    else:
        models = {model.name: calibration.adjustment.camera(k) for k, model in enumerate(calibration.adjustment.network.cameras)}
    if rig is None or not rig.cameras:
        remedy = "calibrate them together: `rig: names` in the project, or --rig"
        raise InputError("the calibration has no rig", allowed="cameras with images of one instant", remedy=remedy)
    frames = rig.frames()
    a = first or next(iter(frames))
    b = second or next(name for name in frames if name != a)
    if a == b or not {a, b} <= set(frames):
        raise InputError("not two cameras of the rig", value=f"{a}, {b}", allowed=", ".join(frames))
    (turn, place), (other_turn, other_place) = frames[a], frames[b]
    return CameraPair(models[a], models[b], other_turn @ turn.T, other_turn @ (place - other_place))
