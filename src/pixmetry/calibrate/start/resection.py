"""Pose of one image from known points, and points from posed images: the two steps by which start values grow.

Both work on directions (u, v) = (X/Z, Y/Z), so that any lens model stands behind them. Poses come from OpenCV's solvers: P3P inside a
RANSAC (Ke & Roumeliotis 2017) against mislabelled points, SQPnP (Terzakis & Lourakis 2020) and, for plane fields, both answers of IPPE
(Collins & Bartoli 2014); the one that fits best is refined.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pixmetry.calibrate.start import _pose_kernels as kernels
from pixmetry.core.arrays import Array
from pixmetry.core.extras import import_extra

FEWEST = 4  # points from which an image is posed: three determine it, a fourth selects among the answers
FLAT = 0.02  # thickness by extent below which points count as a plane
RIGHT_SHARE = 0.6  # of an image's points that must fit
TRIPLES = 30  # of points, one of which is right with near certainty while no more than a third of the points is wrong
SMALLEST_SPREAD = 1 - np.cos(np.deg2rad(1.5))  # of rays to a point: 1.5° between two of them


class Pose(NamedTuple):
    """R (X − X₀), which of the points fit within the tolerance, and the mean of min(error, tolerance)², of directions."""

    rotation: np.ndarray
    position: np.ndarray
    fits: np.ndarray
    cost: float


def thickness(xyz: np.ndarray) -> tuple[float, float]:
    """Smallest and middle extent of points, relative to the largest: (0, …) for a plane, (0, 0) for a line."""
    if len(xyz) < 2:
        return 0.0, 0.0
    values = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    values = np.pad(values, (0, 3 - len(values)))
    return (values[2] / values[0], values[1] / values[0]) if values[0] > 0 else (0.0, 0.0)


def pose(uv: np.ndarray, xyz: np.ndarray, tolerance: float) -> Pose | None:
    """Pose of an image; None if there is none that enough points agree with.

    Parameters
    ----------
    uv : ndarray, shape (n, 2)
        Directions of the image points.
    xyz : ndarray, shape (n, 3)
    tolerance : float
        Error of a direction, beyond which a point counts as wrong.
    """
    good = np.isfinite(uv).all(axis=1) & np.isfinite(xyz).all(axis=1)
    if good.sum() < FEWEST:
        return None
    middle = xyz[good].mean(axis=0)
    size = float(np.sqrt(np.mean((xyz[good] - middle) ** 2))) or 1.0
    there, seen = (xyz[good] - middle) / size, np.ascontiguousarray(uv[good])
    flat, line = thickness(there)
    if line < 1e-3:
        return None
    best = _best_of(there, seen, _answers(there, seen, flat), tolerance)
    if best is None or not best.fits.all():  # wrong points among them, or none that all agree with
        other = _best_of(there, seen, _consenting(there, seen, flat, tolerance), tolerance)
        best = other if best is None or (other is not None and other.cost < best.cost) else best
    if best is None or best.fits.sum() < max(FEWEST, RIGHT_SHARE * len(seen)):
        return None
    fits = np.zeros(len(uv), bool)
    fits[good] = best.fits
    return Pose(best.rotation, middle + size * best.position, fits, best.cost)


def _answers(xyz: np.ndarray, uv: np.ndarray, flat: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotation vectors and shifts by all points."""
    cv2 = import_extra("cv2")

    found: list[tuple[np.ndarray, np.ndarray]] = []
    for solver in [cv2.SOLVEPNP_SQPNP] + ([cv2.SOLVEPNP_IPPE] if flat < FLAT else []):
        try:
            _, turns, shifts, _ = cv2.solvePnPGeneric(xyz, uv, np.eye(3), None, flags=solver)
            found += list(zip(turns, shifts, strict=True))
        except cv2.error:
            pass  # a degenerate sample; the other solvers' answers stand
    return found


def _consenting(xyz: np.ndarray, uv: np.ndarray, flat: float, tolerance: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """The same by the points that agree with each other."""
    cv2 = import_extra("cv2")

    try:
        found, turn, shift, chosen = cv2.solvePnPRansac(
            xyz, uv, np.eye(3), None, iterationsCount=300, reprojectionError=tolerance, confidence=0.9999, flags=cv2.SOLVEPNP_AP3P
        )
    except cv2.error:
        return []
    if not found or chosen is None or len(chosen) < FEWEST:
        return []
    inside = np.zeros(len(uv), bool)
    inside[chosen.ravel()] = True
    return [(turn, shift), *_answers(xyz[inside], uv[inside], flat)]


def _best_of(xyz: np.ndarray, uv: np.ndarray, candidates: list[tuple[np.ndarray, np.ndarray]], tolerance: float) -> Pose | None:
    """The candidate that fits best when it is refined."""
    from scipy.spatial.transform import Rotation

    best = None
    for turn, shift in candidates:
        if not (np.isfinite(turn).all() and np.isfinite(shift).all()):
            continue
        rotation, moved, fits = Rotation.from_rotvec(turn.ravel()).as_matrix(), shift.ravel().copy(), np.zeros(len(uv), bool)
        cost = kernels.refined(xyz, uv, rotation, moved, tolerance, FEWEST, fits)
        if best is None or cost < best.cost:
            best = Pose(rotation, -rotation.T @ moved, fits, cost)
    return best


def rays(uv: np.ndarray, rotation: np.ndarray) -> Array:
    """Unit vectors in the object's frame of directions (n, 2) with the rotations (n, 3, 3) of their images."""
    camera = np.column_stack([uv, np.ones(len(uv))])
    camera /= np.linalg.norm(camera, axis=1, keepdims=True)
    turned: Array = np.einsum("nji,nj->ni", rotation, camera)
    return turned


def intersect(origin: np.ndarray, ray: np.ndarray, point: np.ndarray, points: int, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Points where rays meet, wrong rays weighted down.

    Minimises Σ w |(I − d dᵀ)(X − o)|²/distance² for each point.

    Parameters
    ----------
    origin, ray : ndarray, shape (n, 3)
        Projection centres and unit vectors; NaN takes no part.
    point : ndarray of int, shape (n,)
    points : int
        Number of points.
    tolerance : float
        Angle (rad) about which a ray begins to count as wrong.

    Returns
    -------
    xyz : ndarray, shape (points, 3)
        NaN where fewer than two rays meet, or too parallel ones.
    fits : ndarray of bool, shape (n,)
        Rays that pass within three tolerances, with the point before the camera.
    """
    good = np.isfinite(origin).all(axis=1) & np.isfinite(ray).all(axis=1)
    rows = np.flatnonzero(good)
    o, d, p = origin[rows], ray[rows], point[rows]
    middle = o.mean(axis=0) if len(o) else np.zeros(3)
    o = o - middle
    xyz, fits = np.full((points, 3), np.nan), np.zeros(len(point), bool)
    if len(rows) == 0:
        return xyz, fits
    weight, found = np.ones(len(rows)), np.zeros(points, bool)
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    for _ in range(6):
        normal = _summed(p, points, weight[:, None] * across.reshape(-1, 9)).reshape(-1, 3, 3)
        right = _summed(p, points, weight[:, None] * np.einsum("nij,nj->ni", across, o))
        total = np.bincount(p, weight, points)
        values = np.linalg.eigvalsh(normal)
        found = (np.bincount(p, weight > 0, points) >= 2) & (values[:, 0] > SMALLEST_SPREAD * np.minimum(1.0, total / 2) * values[:, 2] / 2)
        solved = np.full((points, 3), np.nan)
        solved[found] = np.linalg.solve(normal[found], right[found][:, :, None])[:, :, 0]
        away = solved[p] - o
        depth = np.einsum("ni,ni->n", away, d)
        with np.errstate(all="ignore"):
            angle = np.linalg.norm(away - depth[:, None] * d, axis=1) / np.abs(depth)
            weight = np.where(depth > 0, (1 / depth**2) / (1 + (angle / tolerance) ** 2), 0.0)
        mean = np.bincount(p, np.nan_to_num(weight), points) / np.maximum(np.bincount(p, minlength=points), 1)
        weight = np.nan_to_num(weight / np.where(mean > 0, mean, 1.0)[p])
    near = found[p] & (depth > 0) & (angle < 3 * tolerance)
    count = np.bincount(p[near], minlength=points)
    xyz[count >= 2] = solved[count >= 2] + middle
    fits[rows] = near & (count >= 2)[p]
    return xyz, fits


def _summed(index: np.ndarray, size: int, values: np.ndarray) -> np.ndarray:
    return np.stack([np.bincount(index, column, size) for column in values.T], axis=1)


def motions(r: np.ndarray) -> np.ndarray:
    """Slopes of a similarity where it moves nothing yet: of points (n, 3) by shift, rotation, scale, shape (n, 3, 7)."""
    out = np.zeros((len(r), 3, 7))
    out[:, 0, 0] = out[:, 1, 1] = out[:, 2, 2] = 1.0
    out[:, 1, 3], out[:, 2, 3] = -r[:, 2], r[:, 1]
    out[:, 0, 4], out[:, 2, 4] = r[:, 2], -r[:, 0]
    out[:, 0, 5], out[:, 1, 5] = -r[:, 1], r[:, 0]
    out[:, :, 6] = r
    return out


def similarity(source: Array, target: Array, weight: Array | None = None, *, scaled: bool = True) -> tuple[float, Array, Array]:
    """Scale, rotation and shift that take points to others in least squares: target = scale · R source + shift.

    S. Umeyama, IEEE PAMI 13 (1991) 376–380.
    """
    w = np.full(len(source), 1 / len(source)) if weight is None else weight / weight.sum()
    a, b = source - w @ source, target - w @ target
    left, values, right = np.linalg.svd((b * w[:, None]).T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = (left * sign) @ right
    size = float(w @ (a**2).sum(axis=1))
    scale = float((values * sign).sum()) / size if scaled and size > 0 else 1.0  # one place has no size
    return scale, rotation, w @ target - scale * rotation @ (w @ source)


def fitted(source: Array, target: Array, *, scaled: bool = True) -> tuple[float, Array, Array, Array]:
    """`similarity` by iteratively reweighted least squares against wrong points, and the distances that remain.

    It begins with all points or with three, whatever leaves the least median: far points with exchanged names would turn all of them.
    Of three points none can be told to be wrong.
    """
    from pixmetry.core.random import generator

    starts, rng = [np.ones(len(source))], generator(0, "similarity")
    if len(source) > 3:
        starts += [np.isin(np.arange(len(source)), rng.choice(len(source), 3, replace=False)).astype(float) for _ in range(TRIPLES)]
    weight = min(starts, key=lambda start: float(np.median(_distances(source, target, similarity(source, target, start, scaled=scaled)))))
    for _ in range(15 if len(source) > 3 else 1):
        scale, rotation, shift = similarity(source, target, weight, scaled=scaled)
        left = _distances(source, target, (scale, rotation, shift))
        spread = max(1.5 * float(np.median(left)), 1e-12 * float(np.abs(target).max()), 1e-300)
        weight = 1 / (1 + (left / spread) ** 2)
    return scale, rotation, shift, left


def _distances(source: Array, target: Array, by: tuple[float, Array, Array]) -> Array:
    scale, rotation, shift = by
    distances: Array = np.linalg.norm(target - scale * source @ rotation.T - shift, axis=1)
    return distances
