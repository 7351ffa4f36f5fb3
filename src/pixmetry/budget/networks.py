"""Networks of images as a scenario describes them: what errors of image points make of points in space and of a calibration.

Lengths are in units of the distance from the cameras to the middle of the object, the image in pixels along x from its middle. The
adjustment is linear about the true values, with orientations that are estimated too; the datum is a similarity to all points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

FILLED = 0.9  # of the frame by the targets of a calibration, seen straight on: obliquely, some of them lie beyond it
SHOWN = 0.94  # of the frame where targets are found: they must be wholly in it
LEAST_SEEN = 3  # images of each of them
DEPTH = 0.25  # of the object along the line of sight, over its width
OBLIQUE_RAD = np.radians(35.0)  # of the images of a calibration
MOST_IMAGES, MOST_TARGETS = 16, 64  # of a calibration that is computed; beyond them, variances fall with the number of image points
STEPS = (0.7548776662466927, 0.5698402909980532, 0.8191725133961645)  # irrational: an even spread
TEN, FOUR = slice(None), slice(0, 4)  # interior parameters of a lens, and of principal point and scale


@dataclass(frozen=True)
class Images:
    """Frames of one camera about an object.

    Parameters
    ----------
    c_px : float
        Principal distance over the pitch along x.
    frame_shape : (int, int)
    aspect : float
        Pitch in y over that in x.
    rotation, position : ndarray, shape (m, 3, 3), (m, 3)
        A point X is imaged at R (X − X₀), z forwards, y down.
    points : ndarray, shape (n, 3)
    seen : ndarray of bool, shape (m, n), optional
        Which image shows which point; all show all, where it is left out.
    measured : ndarray, shape (2, m, n), optional
        Measured places of the image points, as `image`: of these are the polynomials of a lens; without, the displacement is neglected.
    """

    c_px: float
    frame_shape: tuple[int, int]
    aspect: float
    rotation: np.ndarray
    position: np.ndarray
    points: np.ndarray
    seen: np.ndarray | None = None
    measured: np.ndarray | None = None

    @cached_property
    def at(self) -> np.ndarray:
        """Points in the frames of the cameras, shape (3, m, n)."""
        return np.asarray(np.einsum("mij,mnj->imn", self.rotation, self.points[None] - self.position[:, None]))

    @cached_property
    def image(self) -> np.ndarray:
        """Image points from the middle of the frame, shape (2, m, n), in pixels along x."""
        return np.asarray(self.c_px * self.at[:2] / self.at[2])

    @property
    def places_px(self) -> np.ndarray:
        """The same as places on the sensor, shape (2, m n)."""
        rows, cols = self.frame_shape
        return np.stack([self.image[0].ravel() + (cols - 1) / 2, self.image[1].ravel() / self.aspect + (rows - 1) / 2])

    @cached_property
    def jacobian(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the image points, shape (2, m, n, …): by 6 of the poses, and by 3 of the points."""
        a, b, z = self.at
        zero = np.zeros_like(a)
        by_place = (self.c_px / z)[..., None] * np.stack([np.stack([zero + 1, zero, -a / z], -1), np.stack([zero, zero + 1, -b / z], -1)])
        turned = np.stack([np.stack([zero, z, -b], -1), np.stack([-z, zero, a], -1), np.stack([b, -a, zero], -1)], -2)
        by_turn = np.einsum("cmnk,mnkj->cmnj", by_place, turned)
        by_point = np.einsum("cmnk,mkj->cmnj", by_place, self.rotation)
        return np.concatenate([by_turn, -by_point], -1), by_point

    @cached_property
    def interior(self) -> np.ndarray:
        """Displacements by the interior parameters, shape (10, 2, m, n): x0, y0, c, b1, b2, three radial terms, two of decentring."""
        return interior_basis(*(self.image if self.measured is None else self.measured) / (max(self.frame_shape) / 2))


def interior_basis(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Displacements of places by the interior parameters, shape (10, 2, …)."""
    one, zero, r2 = np.ones_like(x), np.zeros_like(x), x**2 + y**2
    radial = [[x * r2**k, y * r2**k] for k in (1, 2, 3)]
    decentring = [[r2 + 2 * x * x, 2 * x * y], [2 * x * y, r2 + 2 * y * y]]
    return np.array([[one, zero], [zero, one], [x, y], [x, zero], [y, zero], *radial, *decentring])


@dataclass(frozen=True)
class Solved:
    """A linear adjustment: x = (AᵀA + BBᵀ)⁻¹ Aᵀ l over weighted image points.

    Parameters
    ----------
    inverse : ndarray, shape (3n, 2mn)
        Of the points' coordinates by the weighted image points.
    weight : (float, float)
        One over the standard deviations of x and y.
    interior : ndarray, shape (k, 2mn)
        The same of the interior parameters.
    """

    inverse: np.ndarray
    weight: tuple[float, float]
    interior: np.ndarray

    def points_by(self, fields: np.ndarray) -> np.ndarray:
        """Displacements of the points by those of their images, of shape (…, 2, m, n) in pixels along x; shape (…, n, 3)."""
        weighted = fields * np.array(self.weight)[:, None, None]
        found = weighted.reshape(*fields.shape[:-3], -1) @ self.inverse.T
        return np.asarray(found.reshape(*fields.shape[:-3], -1, 3))

    @property
    def point_covariance(self) -> np.ndarray:
        """Of each point for independent image points, shape (n, 3, 3)."""
        by_point = self.inverse.reshape(-1, 3, self.inverse.shape[1])
        return np.asarray(np.einsum("nik,njk->nij", by_point, by_point))

    @property
    def interior_covariance(self) -> np.ndarray:
        """Of the interior parameters."""
        return np.asarray(self.interior @ self.interior.T)


def solve(images: Images, sigma_px: tuple[float, float], interior: slice | None = None, posed: bool = False) -> Solved:
    """Adjust points, poses (unless they are ``posed``: known) and perhaps interior parameters."""
    by_pose, by_point = images.jacobian
    m, n = by_pose.shape[1:3]
    basis = np.zeros((0, 2, m, n)) if interior is None else images.interior[interior]
    q, poses = len(basis), 0 if posed else 6 * m
    a = np.zeros((2, m, n, 3 * n + poses + q))
    k = np.arange(n)
    for j in range(3):
        a[:, :, k, 3 * k + j] = by_point[..., j]
    if poses:
        for i in range(m):
            a[:, i, :, 3 * n + 6 * i : 3 * n + 6 * i + 6] = by_pose[:, i]
    a[..., 3 * n + poses :] = np.moveaxis(basis, 0, -1)
    weight = (1 / sigma_px[0], 1 / sigma_px[1])
    a *= np.array(weight)[:, None, None, None]
    if images.seen is not None:
        a *= images.seen[..., None]
    a = a.reshape(2 * m * n, -1)
    normal = a.T @ a
    if poses:
        datum = _similarity(images.points)
        size = np.trace(normal[: 3 * n, : 3 * n]) / (3 * n)
        normal[: 3 * n, : 3 * n] += size * datum @ datum.T
    inverse = np.linalg.solve(normal, a.T)
    return Solved(inverse[: 3 * n], weight, inverse[3 * n + poses :])


def _similarity(points: np.ndarray) -> np.ndarray:
    """Shifts, rotations and scale of the points, orthonormal, shape (3n, 7)."""
    x, y, z = (points - points.mean(axis=0)).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    columns = [(one, zero, zero), (zero, one, zero), (zero, zero, one), (zero, -z, y), (z, zero, -x), (-y, x, zero), (x, y, z)]
    return np.linalg.qr(np.array([np.stack(c, -1).ravel() for c in columns]).T)[0]


# ---- where images stand ------------------------------------------------------------------------------------------------------------


def stations(rays: int, base_to_height: float, arrangement: str) -> np.ndarray:
    """Where cameras stand before an object in the origin, at −z, shape (rays, 3): on a circle or a row with the base as its diameter."""
    half = 0.5 * base_to_height
    if arrangement == "row" or rays == 2:
        x, y = half * np.linspace(1, -1, rays), np.zeros(rays)
    else:
        angle = 2 * np.pi * np.arange(rays) / rays
        x, y = half * np.cos(angle), half * np.sin(angle)
    return np.stack([x, y, np.full(rays, -1.0)], -1)


def towards(position: np.ndarray, roll: np.ndarray | float = 0.0) -> np.ndarray:
    """Rotations of cameras that look at the origin, x along the base, shape (m, 3, 3)."""
    z = -position / np.linalg.norm(position, axis=1, keepdims=True)
    x = np.array([1.0, 0.0, 0.0]) - z[:, :1] * z
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    c, s = (np.broadcast_to(v, len(z))[:, None] for v in (c, s))
    return np.stack([c * x + s * y, c * y - s * x, z], 1)


def images_of(
    c_px: float, frame_shape: tuple[int, int], aspect: float, position: np.ndarray, rotation: np.ndarray, points: int, filled: float
) -> Images:
    """Frames at these stations of points that are spread over an object as large as all of them see."""
    rows, cols = frame_shape
    half = np.array([cols, aspect * rows]) / 2
    size = filled
    while True:
        width = size * half / c_px
        found = Images(c_px, frame_shape, aspect, rotation, position, _spread(points) * [*width, DEPTH * width.max()])
        if size < 0.05 or (found.at[2] > 0.1).all() and (np.abs(found.image) < 0.98 * half[:, None, None]).all():
            return found
        size *= 0.95


def measuring(
    c_px: float, frame_shape: tuple[int, int], aspect: float, rays: int, base_to_height: float, arrangement: str, points: int, filled: float
) -> Images:
    """The network of a scenario's points: every point in every image."""
    position = stations(rays, base_to_height, arrangement)
    return images_of(c_px, frame_shape, aspect, position, towards(position), points, filled)


def calibrating(c_px: float, frame_shape: tuple[int, int], aspect: float, images: int, targets: int, depth: float) -> tuple[Images, float]:
    """A calibration's network: oblique images all round a field, rolled by quarters; and what variances are to be multiplied by."""
    m, n = min(images, MOST_IMAGES), min(targets, MOST_TARGETS)
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(m)
    position = -np.stack([np.sin(OBLIQUE_RAD) * np.cos(angle), np.sin(OBLIQUE_RAD) * np.sin(angle), np.full(m, np.cos(OBLIQUE_RAD))], -1)
    rotation = towards(position, 0.5 * np.pi * np.arange(m))
    half = np.array([1.0, aspect]) * np.array(frame_shape)[::-1] / 2
    width = FILLED * half / c_px
    field = Images(c_px, frame_shape, aspect, rotation, position, _spread(n) * [*width, depth * width.max()])
    seen = (np.abs(field.image) < SHOWN * half[:, None, None]).all(axis=0)
    often = np.flatnonzero(seen.sum(axis=0) >= min(LEAST_SEEN, m))
    field = replace(field, points=field.points[often], seen=seen[:, often])
    return field, seen[:, often].sum() / (images * targets)


def _spread(points: int) -> np.ndarray:
    """Places in a cube of ±1, evenly spread, shape (points, 3)."""
    return (0.5 + np.arange(points)[:, None] * np.array(STEPS)) % 1 * 2 - 1
