"""Start values of poses from a table of images: places, and rotations as matrices, quaternions, or angles of photogrammetry."""

from __future__ import annotations

import numpy as np

from pixmetry.calibrate.bundle.network import Poses
from pixmetry.calibrate.project.tables import Table
from pixmetry.core.errors import InputError

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
        what = f"rotations are told twice, by {first} and by {second}"
        allowed = "r11 … r33, or qw, qx, qy, qz, or omega, phi, kappa in one unit"
        raise InputError(what, where=table.source, allowed=allowed, remedy="leave one of the two out")
    ((unit, names),) = told
    if all(any(name in table for name in place) for place in (CENTRE, SHIFT)):
        what, allowed = "places of the images are told twice, by X0 … and by tx …", "X0, Y0, Z0, or tx, ty, tz"
        raise InputError(what, where=table.source, allowed=allowed, remedy="leave one of the two out")
    names = (*(SHIFT if any(name in table for name in SHIFT) else CENTRE), *names)
    table.need(*names)
    values = np.stack([table.numbers(name, empty=np.nan) for name in names], axis=1)
    missing = np.isnan(values)
    partly = missing.any(axis=1) & ~missing.all(axis=1)
    if partly.any():
        row = int(np.flatnonzero(partly)[0])
        remedy = "add what is missing, or leave all of them empty"
        raise InputError("a pose with some of its values", where=table.where(row), allowed=", ".join(names), remedy=remedy)
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
