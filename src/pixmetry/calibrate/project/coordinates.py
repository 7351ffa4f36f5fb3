"""Image coordinates from a table, in whatever unit and from whatever origin, as pixels from the centre of the top-left pixel; and start
values of the poses of images, in whatever form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.calibrate.bundle.network import Poses
from pixmetry.calibrate.project.tables import Table, first_few, index_of_names
from pixmetry.core.errors import InputError

MM_PER = {"mm": 1.0, "um": 1e-3}
UNITS = ("px", "mm", "um")
# how columns of uncertainties begin
UNCERTAINTIES = tuple(f"{kind}_{what}" for kind in ("u", "var", "sigma", "std") for what in ("x", "y", "px", "mm", "um")) + ("cov_xy",)
GUESS_PX = 0.05  # standard deviation of an image coordinate about which nothing is said; only the ratios of weights count then
OUTSIDE = 0.01  # of the frame's sides: how far outside of it a target's centre may be
MOST_OUTSIDE = 0.2  # of a camera's image coordinates: fewer are gross errors, more come from another frame, unit or origin
CENTRE = ("X0", "Y0", "Z0")
SHIFT = ("tx", "ty", "tz")
RAD_PER = {"deg": np.pi / 180, "gon": np.pi / 200, "rad": 1.0}
ROTATIONS = {
    "quaternion": ("qw", "qx", "qy", "qz"),
    "matrix": tuple(f"r{i}{j}" for i in "123" for j in "123"),
    **{unit: tuple(f"{angle}_{unit}" for angle in ("omega", "phi", "kappa")) for unit in RAD_PER},
}
COLUMNS = (*CENTRE, *SHIFT, *(name for names in ROTATIONS.values() for name in names))
SQUARE = 0.03  # how far R Rᵀ may be from 1: numbers of a matrix that were rounded


@dataclass(frozen=True)
class ImageCoordinates:
    """What image coordinates of a table count from; `unit` None: what the names of the columns say."""

    unit: str | None = None
    origin: str | None = None
    y: str | None = None


@dataclass(frozen=True)
class Measured:
    """Image coordinates of a table in pixels: x right, y down, from the centre of the top-left pixel.

    Parameters
    ----------
    images, points : tuple of str
        Names in the order in which they come.
    camera_of : ndarray of int, shape (images,)
    time_s : ndarray, shape (images,), or None
    poses : Poses or None
    image, point : ndarray of int, shape (n,)
    x_px, y_px : ndarray, shape (n,)
    covariance_px2 : ndarray, shape (n, 3)
    covariance_known : bool
    instant : ndarray of int, shape (images,), or None
        Images of one instant of a rig.
    """

    images: tuple[str, ...]
    points: tuple[str, ...]
    camera_of: np.ndarray
    time_s: np.ndarray | None
    poses: Poses | None
    image: np.ndarray
    point: np.ndarray
    x_px: np.ndarray
    y_px: np.ndarray
    covariance_px2: np.ndarray
    covariance_known: bool
    instant: np.ndarray | None = None


def measured(
    table: Table, images: Table | None, cameras: Sequence[CameraModel], given: ImageCoordinates, u_px: float | None = None
) -> Measured:
    """Image coordinates from a table with ``image, point`` and ``x_px, y_px`` (or ``x_mm, y_mm``, or ``x_um, y_um``).

    Raises
    ------
    InputError
        If a column is missing, a value cannot be used, a point is measured twice in an image, or more than a fifth of a camera's places
        are outside of its frame.
    """
    table = table.spelled("image", "point", *(f"{axis}_{unit}" for axis in "xy" for unit in UNITS))
    unit = _unit(table, given)
    table.need("image", "point", f"x_{unit}", f"y_{unit}")
    image, image_names = _numbered(table.texts("image"))
    point, point_names = _numbered(table.texts("point"))
    _refuse_twice(table, image, point, len(point_names))
    camera_of, time_s, poses = image_facts(images, image_names, cameras, lambda name: table.where(table.columns["image"].index(name)))
    camera = camera_of[image]
    x, y = table.numbers(f"x_{unit}"), table.numbers(f"y_{unit}")
    sign = -1.0 if upwards(table, given) else 1.0
    per_px = np.array([_units_per_px(model, unit, table) for model in cameras])[camera]
    start = np.array([_origin(model, given.origin or ("first_pixel" if unit == "px" else "centre"), sign) for model in cameras])[camera]
    x_px, y_px = start[:, 0] + x / per_px[:, 0], start[:, 1] + sign * y / per_px[:, 1]
    _refuse_outside(table, x_px, y_px, cameras, camera)
    covariance, known = _covariance(table, unit, per_px, sign, u_px)
    return Measured(image_names, point_names, camera_of, time_s, poses, image, point, x_px, y_px, covariance, known)


def upwards(table: Table, given: ImageCoordinates) -> bool:
    """Whether y of a table runs upwards: as the project says, else as is usual in its unit.

    Raises
    ------
    InputError
        If the table has no image coordinates, or in several units.
    """
    if given.y is not None:
        return given.y == "up"
    return _unit(table.spelled(*(f"{axis}_{unit}" for axis in "xy" for unit in UNITS)), given) != "px"


def _unit(table: Table, given: ImageCoordinates) -> str:
    """px, mm or um: what the names of the columns say, or the project where both are there."""
    there = [unit for unit in UNITS if f"x_{unit}" in table or f"y_{unit}" in table]
    if given.unit in there or (given.unit is not None and not there):
        return given.unit
    if not there:
        remedy = "name the two columns in the header, or under `columns:` of the project"
        allowed = "x_px and y_px, or x_mm and y_mm, or x_um and y_um"
        raise InputError("no image coordinates", where=table.source, value=", ".join(table.columns), allowed=allowed, remedy=remedy)
    if given.unit is not None:
        raise InputError(
            f"the image coordinates are in {there[0]}, the project says {given.unit}",
            where=table.source,
            value=", ".join(table.columns),
            remedy=f"write `unit: {there[0]}` under image_coordinates, or correct the names of the columns",
        )
    if len(there) > 1:
        remedy = "state the unit under image_coordinates, or delete two of the columns"
        raise InputError(
            "image coordinates in several units", where=table.source, value=", ".join(table.columns), allowed="one", remedy=remedy
        )
    return there[0]


def _numbered(names: Sequence[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    index: dict[str, int] = {}
    numbers = np.array([index.setdefault(name, len(index)) for name in names], dtype=np.int64)
    return numbers, tuple(index)


def _refuse_twice(table: Table, image: np.ndarray, point: np.ndarray, points: int) -> None:
    key = image * points + point
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(np.diff(key[order]) == 0)
    if len(same):
        first, second = min((int(order[i]), int(order[i + 1])) for i in same)
        name, where = table.columns["point"][first], table.columns["image"][first]
        raise InputError(
            f"point '{name}' is measured twice in image '{where}'",
            where=f"{table.source}, lines {table.lines[first]} and {table.lines[second]}",
            allowed="each point once in an image",
            remedy="delete one of the two, or name one of them otherwise",
        )


def image_facts(
    images: Table | None, names: Sequence[str], cameras: Sequence[CameraModel], where: Callable[[str], str]
) -> tuple[np.ndarray, np.ndarray | None, Poses | None]:
    """Camera, time and start pose of each image, from a table with ``image`` and, of several cameras, ``camera``; the rest if it is there.

    Raises
    ------
    InputError
        If an image is not in the table, or its camera is none of the project.
    """
    if images is None:
        if len(cameras) > 1:
            what = "several cameras, but no table that assigns images to them"
            raise InputError(what, where=where(names[0]), remedy="add `images: images.csv` with the columns image, camera")
        return np.zeros(len(names), np.int64), None, None
    images = images.spelled("image", "camera", "time_s")
    images.need("image", *(["camera"] if len(cameras) > 1 else []))
    rows = index_of_names(images, "image")
    missing = next((name for name in names if name not in rows), None)
    if missing is not None:
        what = f"image '{missing}' is not in the table of images"
        remedy = f"add it to {images.source} (a pose may be left empty), or correct its name"
        raise InputError(what, where=where(missing), allowed=first_few(rows), remedy=remedy)
    row_of = np.array([rows[name] for name in names])
    by_name = {model.name: k for k, model in enumerate(cameras)}
    camera_of = np.zeros(len(names), np.int64)
    if "camera" in images:
        told = images.texts("camera")
        wrong = next((row for row, name in enumerate(told) if name not in by_name), None)
        if wrong is not None:
            remedy = "correct the name, or add the camera"
            raise InputError(f"no camera '{told[wrong]}'", where=images.where(wrong), allowed=first_few(by_name), remedy=remedy)
        camera_of = np.array([by_name[told[row]] for row in row_of], dtype=np.int64)
    poses = start_poses(images)
    if poses is not None:
        poses = Poses(poses.rotation[row_of], poses.position[row_of])
    return camera_of, images.numbers("time_s")[row_of] if "time_s" in images else None, poses


def _units_per_px(model: CameraModel, unit: str, table: Table) -> tuple[float, float]:
    if unit == "px":
        return 1.0, 1.0
    if model.sensor.pitch_x_um is None or model.sensor.pitch_y_um is None:
        what = f"image coordinates in {unit}, but camera '{model.name}' has no pitch"
        raise InputError(what, where=table.source, remedy="add `pitch_um: ...` to the camera, or give coordinates in pixels")
    return tuple(p / 1000 / MM_PER[unit] for p in (model.sensor.pitch_x_um, model.sensor.pitch_y_um))  # type: ignore[return-value]


def _origin(model: CameraModel, origin: str, sign: float) -> tuple[float, float]:
    """Where the table's origin lies, px."""
    if origin == "centre":
        return model.sensor.centre
    x, y = (0.0, 0.0 if sign > 0 else model.sensor.rows - 1.0)
    first = {"first_pixel": 0.0, "corner": 0.5, "one": 1.0}[origin]  # what the centre of the first pixel is called
    return x - first, y - first * sign


def _refuse_outside(table: Table, x_px: np.ndarray, y_px: np.ndarray, cameras: Sequence[CameraModel], camera: np.ndarray) -> None:
    """Refuse coordinates that are not of these frames; a few are gross errors, which the adjustment looks for."""
    size = np.array([(model.sensor.cols, model.sensor.rows) for model in cameras], dtype=float)[camera]
    place = np.stack([x_px, y_px], axis=1) + 0.5
    outside = ((place < -OUTSIDE * size) | (place > (1 + OUTSIDE) * size)).any(axis=1)
    for k in range(len(cameras)):
        bad = np.flatnonzero(outside & (camera == k))
        if len(bad) <= MOST_OUTSIDE * np.sum(camera == k):
            continue
        row = int(bad[0])
        cols, rows = size[row].astype(int)
        many = f", one of {len(bad)}" if len(bad) > 1 else ""
        raise InputError(
            f"outside of the frame of {cols} x {rows} pixels{many}",
            where=table.where(row),
            value=f"x {x_px[row]:.2f} px, y {y_px[row]:.2f} px from the centre of the top-left pixel",
            allowed=f"x up to {cols - 0.5}, y up to {rows - 0.5}",
            remedy="check cols, rows and pitch of the camera, and unit, origin and y under image_coordinates",
        )


def _covariance(table: Table, unit: str, per_px: np.ndarray, sign: float, u_px: float | None) -> tuple[np.ndarray, bool]:
    """var x, cov xy, var y in px², and whether they are known."""
    out = np.zeros((len(table), 3))
    for name in (unit, "px"):
        scale = per_px if name == unit else np.ones_like(per_px)
        if f"var_x_{name}2" in table or f"var_y_{name}2" in table:
            table.need(f"var_x_{name}2", f"var_y_{name}2")
            out[:, 0] = table.numbers(f"var_x_{name}2", above=0) / scale[:, 0] ** 2
            out[:, 2] = table.numbers(f"var_y_{name}2", above=0) / scale[:, 1] ** 2
            if f"cov_xy_{name}2" in table:
                out[:, 1] = table.numbers(f"cov_xy_{name}2") * (sign if name == unit else 1.0) / (scale[:, 0] * scale[:, 1])
            bad = out[:, 1] ** 2 >= out[:, 0] * out[:, 2]
            if bad.any():
                row = int(np.flatnonzero(bad)[0])
                what = "no covariance matrix: its determinant is not above 0"
                raise InputError(what, where=table.where(row), allowed="cov_xy² below var_x var_y", remedy="correct it")
            return out, True
        if f"u_x_{name}" in table or f"u_y_{name}" in table:
            table.need(f"u_x_{name}", f"u_y_{name}")
            out[:, 0] = (table.numbers(f"u_x_{name}", above=0) / scale[:, 0]) ** 2
            out[:, 2] = (table.numbers(f"u_y_{name}", above=0) / scale[:, 1]) ** 2
            return out, True
        if f"u_{name}" in table:
            out[:, 0], out[:, 2] = ((table.numbers(f"u_{name}", above=0) / scale[:, axis]) ** 2 for axis in (0, 1))
            return out, True
    lost = next((name for name in table.columns if name.lower().startswith(UNCERTAINTIES)), None)
    if lost is not None:
        allowed = f"u_{unit}, u_x_{unit} with u_y_{unit}, or var_x_{unit}2 with var_y_{unit}2 and cov_xy_{unit}2"
        remedy = "rename it, or leave it out with `columns:`"
        raise InputError("an uncertainty of an unknown kind", where=table.source, value=lost, allowed=allowed, remedy=remedy)
    out[:, 0] = out[:, 2] = (u_px or GUESS_PX) ** 2
    return out, u_px is not None


def start_poses(table: Table) -> Poses | None:
    """Start values of the poses of a table's images.

    A matrix or a quaternion is R of R (X − X₀) = R X + t, the camera looking along +z with y down. Angles are those of Rx(ω) Ry(φ) Rz(κ),
    which turns from a camera that looks along −z with y up to the object (K. Kraus, Photogrammetry, 2nd ed., de Gruyter, Berlin 2007).

    Parameters
    ----------
    table : Table
        Rows without any of the values have no pose.

    Returns
    -------
    Poses or None
        In the order of the rows; None if there are no such columns.

    Raises
    ------
    InputError
        If columns or values are missing, or a matrix is no rotation.
    """
    table = table.spelled(*COLUMNS)
    if not any(name in table for name in COLUMNS):
        return None
    told = [(unit, names) for unit, names in ROTATIONS.items() if any(name in table for name in names)] or [("deg", ROTATIONS["deg"])]
    if len(told) > 1:
        first, second = (next(name for name in names if name in table) for _, names in told[:2])
        what = f"rotations are given twice, by {first} and by {second}"
        allowed = "r11 … r33, or qw, qx, qy, qz, or omega, phi, kappa in one unit"
        raise InputError(what, where=table.source, allowed=allowed, remedy="leave one of the two out")
    ((unit, names),) = told
    if all(any(name in table for name in place) for place in (CENTRE, SHIFT)):
        what, allowed = "positions of the images are given twice, by X0 … and by tx …", "X0, Y0, Z0, or tx, ty, tz"
        raise InputError(what, where=table.source, allowed=allowed, remedy="leave one of the two out")
    names = (*(SHIFT if any(name in table for name in SHIFT) else CENTRE), *names)
    table.need(*names)
    values = np.stack([table.numbers(name, empty=np.nan) for name in names], axis=1)
    missing = np.isnan(values)
    partly = missing.any(axis=1) & ~missing.all(axis=1)
    if partly.any():
        row = int(np.flatnonzero(partly)[0])
        remedy = "add what is missing, or leave all of them empty"
        raise InputError("an incomplete pose", where=table.where(row), allowed=", ".join(names), remedy=remedy)
    place, turn = values[:, :3], values[:, 3:]
    if unit == "matrix":
        rotation = _of_matrix(table, turn.reshape(-1, 3, 3))
    elif unit == "quaternion":
        rotation = _of_quaternion(table, turn)
    else:
        rotation = _of_angles(turn * RAD_PER[unit])
    return Poses(rotation, -np.einsum("nji,nj->ni", rotation, place) if names[0] == "tx" else place)


def _of_angles(angles: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    rotation, given = np.full((len(angles), 3, 3), np.nan), np.isfinite(angles[:, 0])
    if given.any():
        to_object = Rotation.from_euler("XYZ", angles[given]).as_matrix()
        rotation[given] = np.diag([1.0, -1.0, -1.0]) @ np.swapaxes(to_object, 1, 2)
    return rotation


def _of_quaternion(table: Table, turn: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    rotation, length = np.full((len(turn), 3, 3), np.nan), np.linalg.norm(turn, axis=1)
    if (length == 0).any():
        where = table.where(int(np.flatnonzero(length == 0)[0]))
        raise InputError("a quaternion of length 0", where=where, allowed="qw, qx, qy, qz, not all 0", remedy="correct it")
    given = length > 0
    if given.any():
        rotation[given] = Rotation.from_quat(turn[given][:, [1, 2, 3, 0]]).as_matrix()
    return rotation


def _of_matrix(table: Table, rotation: np.ndarray) -> np.ndarray:
    """The nearest rotations of matrices that are rotations but for rounding."""
    given = np.flatnonzero(np.isfinite(rotation[:, 0, 0]))
    off = np.abs(rotation[given] @ np.swapaxes(rotation[given], 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    bad = (off > SQUARE) | (np.linalg.det(rotation[given]) < 0)
    if bad.any():
        row = int(given[np.flatnonzero(bad)[0]])
        mirrored = np.linalg.det(rotation[row]) < 0
        what = "r11 … r33 mirror" if mirrored else "r11 … r33 are no rotation"
        remedy = "the camera looks along +z, x to the right, y down: change signs of whole rows" if mirrored else "correct them"
        raise InputError(what, where=table.where(row), allowed="orthonormal rows with determinant +1", remedy=remedy)
    left, _, right = np.linalg.svd(rotation[given])
    rotation = rotation.copy()
    rotation[given] = left @ right
    return rotation
