"""Imaged ellipses with their covariances, and the camera without distortion that sees them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.core.errors import InputError
from pixmetry.locate.detect.targets import Positions

CONTOUR_POINTS = 64
NAMES = ("x_px", "y_px", "semi_major_px", "semi_minor_px", "angle_deg")


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion: ``x = principal_x_px + c X/Z``, ``y = principal_y_px + c · pitch_ratio · Y/Z``.

    Parameters
    ----------
    principal_distance_px : float
        c in pixels of the row direction.
    principal_x_px, principal_y_px : float
    pitch_ratio : float
        Pixel pitch along x over that along y.

    Raises
    ------
    InputError
        If a number is not finite, or distance or ratio are not above 0.
    """

    principal_distance_px: float
    principal_x_px: float
    principal_y_px: float
    pitch_ratio: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(list(vars(self).values())).all() and self.principal_distance_px > 0 and self.pitch_ratio > 0):
            raise InputError("the camera cannot be used", where="pinhole", allowed="finite numbers, distance and pitch ratio above 0")

    @property
    def matrix(self) -> np.ndarray:
        """K, shape (3, 3)."""
        c = self.principal_distance_px
        return np.array([[c, 0.0, self.principal_x_px], [0.0, c * self.pitch_ratio, self.principal_y_px], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Ellipses:
    """Imaged ellipses, arrays of shape (n,); angles from x towards y.

    Parameters
    ----------
    x_px, y_px, semi_major_px, semi_minor_px, angle_deg : ndarray
    conic_covariance : ndarray, shape (n, 5, 5), optional
        Of `conics`: centre in px, shape matrix in px².

    Raises
    ------
    InputError
        If a number is not finite, an axis is not above 0, or the shapes do not agree.
    """

    x_px: np.ndarray
    y_px: np.ndarray
    semi_major_px: np.ndarray
    semi_minor_px: np.ndarray
    angle_deg: np.ndarray
    conic_covariance: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name in NAMES:
            object.__setattr__(self, name, np.atleast_1d(np.asarray(getattr(self, name), float)))
        values = [getattr(self, name) for name in NAMES]
        if any(v.shape != values[0].shape or v.ndim != 1 for v in values) or not all(np.isfinite(v).all() for v in values):
            raise InputError("ellipses cannot be used", where="ellipses", allowed="finite numbers, as many of each kind")
        if len(values[0]) and min(self.semi_major_px.min(), self.semi_minor_px.min()) <= 0:
            raise InputError("an ellipse has no extent", where="ellipses", allowed="half axes above 0")
        if self.conic_covariance is not None:
            covariance = np.asarray(self.conic_covariance, float)
            if covariance.shape != (len(self), 5, 5) or not np.isfinite(covariance).all():
                allowed = f"({len(self)}, 5, 5), finite"
                raise InputError("the ellipses' covariance cannot be used", value=covariance.shape, allowed=allowed)
            object.__setattr__(self, "conic_covariance", covariance)

    def __len__(self) -> int:
        return len(self.x_px)

    def __getitem__(self, which: np.ndarray | slice) -> Ellipses:
        """A part of them, by mask, index array or slice."""
        covariance = None if self.conic_covariance is None else self.conic_covariance[which]
        x, y, major, minor, angle = (getattr(self, name)[which] for name in NAMES)
        return Ellipses(x, y, major, minor, angle, covariance)

    @property
    def conics(self) -> np.ndarray:
        """Centre and shape matrix S, (x − p)ᵀ S⁻¹ (x − p) = 1: the columns p_x, p_y, S_xx, S_xy, S_yy, shape (n, 5).

        Unlike axes and angle they, and their covariance, stay regular where the ellipse is a circle.
        """
        turn = _turn(self.angle_deg)
        s = (turn * np.stack([self.semi_major_px, self.semi_minor_px], axis=1)[:, None] ** 2) @ turn.swapaxes(1, 2)
        return np.column_stack([self.x_px, self.y_px, s[:, 0, 0], s[:, 0, 1], s[:, 1, 1]])

    @classmethod
    def of_conics(cls, conics: np.ndarray, covariance: np.ndarray | None = None) -> Ellipses:
        """From the columns of `conics`, shape (n, 5), and their covariance."""
        conics = np.asarray(conics, float)
        values, vectors = np.linalg.eigh(matrices(conics))
        angle = (np.rad2deg(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])) + 90) % 180 - 90
        axes = np.sqrt(np.maximum(values, 0.0))
        return cls(conics[:, 0], conics[:, 1], axes[:, 1], axes[:, 0], angle, covariance)

    @classmethod
    def of(cls, positions: Positions) -> Ellipses:
        """From a template fit of ellipses, with the covariance of the outline that goes with that of the places.

        Raises
        ------
        InputError
            If these are not positions of ellipses, or some have none.

        Notes
        -----
        Where the edge moves outwards by δ, the pixels tell of ∮ δ² w dl; a shift moves it by n·dx, a change of the shape matrix by
        ½|S⁻¹d| nᵀ dS n at d from the centre. The covariance of the place gives w, and w that of S.
        """
        missing = [name for name in NAMES[2:] if name not in positions.more]
        if missing:
            raise InputError("these positions have no ellipses", value=missing, remedy="locate with kind='ellipse'")
        a, b, angle = (np.asarray(positions.more[name], float) for name in NAMES[2:])
        covariance = np.zeros((len(a), 5, 5))
        covariance[:, 0, 0], covariance[:, 1, 1] = positions.var_x_px2, positions.var_y_px2
        covariance[:, 0, 1] = covariance[:, 1, 0] = positions.cov_xy_px2
        bad = ~np.isfinite(a + b + angle + positions.x_px + positions.y_px + covariance.sum(axis=(1, 2)))
        if bad.any():
            raise InputError("some positions have no ellipse", value=int(bad.sum()), remedy="leave them out")
        by_shift, by_shape = _outline_information(a, b, angle)
        weight = 0.5 * np.trace(np.linalg.inv(covariance[:, :2, :2] @ by_shift), axis1=1, axis2=2)
        covariance[:, 2:, 2:] = np.linalg.inv(by_shape * weight[:, None, None])
        return cls(positions.x_px, positions.y_px, a, b, angle, covariance)


def ellipse_through(x_px: ArrayLike, y_px: ArrayLike) -> Ellipses:
    """The ellipse through points of a contour, for example points from which the lens's distortion has been taken out.

    Raises
    ------
    InputError
        If there are fewer than five points, or no ellipse goes through them.

    Notes
    -----
    Least squares of A u² + B uv + C v² + D u + E v = 1 about the points' middle, in units of their spread.
    """
    x, y = np.asarray(x_px, float), np.asarray(y_px, float)
    if x.ndim != 1 or x.shape != y.shape or len(x) < 5 or not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError("no ellipse fits these points", where="contour", allowed="five or more points, finite x and y")
    middle, spread = np.array([x.mean(), y.mean()]), max(np.hypot(x.std(), y.std()), 1e-300)
    u, v = (x - middle[0]) / spread, (y - middle[1]) / spread
    (a, b, c, d, e), _, rank, _ = np.linalg.lstsq(np.column_stack([u * u, u * v, v * v, u, v]), np.ones_like(u), rcond=1e-10)
    quadratic, linear = np.array([[a, b / 2], [b / 2, c]]), np.array([d, e])
    values, axes = np.linalg.eigh(quadratic)
    centre = -0.5 * np.linalg.pinv(quadratic) @ linear
    size = 1.0 + centre @ quadratic @ centre
    if rank < 5 or not (values * size > 0).all():
        raise InputError("no ellipse fits these points", where="contour", remedy="give points all around the target")
    semi = spread * np.sqrt(size / values)  # the smallest eigenvalue is the longest axis
    major = int(np.argmax(semi))
    angle = np.rad2deg(np.arctan2(axes[1, major], axes[0, major]))
    place = middle + spread * centre
    return Ellipses(place[0], place[1], semi[major], semi[1 - major], (angle + 90) % 180 - 90)


def matrices(conics: np.ndarray) -> np.ndarray:
    """Shape matrices of conics as in `Ellipses.conics`; shape (n, 2, 2)."""
    return conics[:, [[2, 3], [3, 4]]]


def _turn(angle_deg: np.ndarray) -> np.ndarray:
    """Unit vectors of the long and of the short axis as columns, shape (n, 2, 2)."""
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)


def _outline_information(a: np.ndarray, b: np.ndarray, angle_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """∮ g gᵀ dl along ellipses, g the outward move of the outline by a shift, (n, 2, 2), and by S_xx, S_xy, S_yy, (n, 3, 3)."""
    t = 2 * np.pi * (np.arange(CONTOUR_POINTS) + 0.5) / CONTOUR_POINTS
    slant = np.stack([np.cos(t) / a[:, None], np.sin(t) / b[:, None]], axis=1)  # S⁻¹ d in the ellipse's own axes
    steep = np.hypot(slant[:, 0], slant[:, 1])
    length = np.hypot(a[:, None] * np.sin(t), b[:, None] * np.cos(t)) * (2 * np.pi / CONTOUR_POINTS)
    normal = _turn(angle_deg) @ (slant / steep[:, None])
    x, y = normal[:, 0], normal[:, 1]
    shape = 0.5 * steep[:, None] * np.stack([x * x, 2 * x * y, y * y], axis=1)
    return (normal * length[:, None]) @ normal.swapaxes(1, 2), (shape * length[:, None]) @ shape.swapaxes(1, 2)


def spread(conics: np.ndarray, covariance: np.ndarray, function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Covariance, shape (n, m, m), of a function (n, m) of conics, shape (n, 5), with a covariance of shape (n, 5, 5).

    From steps of one standard deviation along the principal directions of their covariance, both ways, so that it stays of the right size
    where the function bends.
    """
    values, axes = np.linalg.eigh(covariance)
    middle = function(conics)
    total = np.zeros((*middle.shape, middle.shape[-1]))
    for k in range(5):
        step = np.sqrt(np.maximum(values[:, k], 0.0))[:, None] * axes[:, :, k]
        for sign in (-1, 1):
            moved = function(conics + sign * step) - middle
            total += 0.5 * moved[:, :, None] * moved[:, None, :]
    return total


def unit(direction: ArrayLike) -> np.ndarray:
    """Vectors of length 1 along the last axis.

    Raises
    ------
    InputError
        If there is none.
    """
    n = np.asarray(direction, float)
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    if n.shape[-1:] != (3,) or not (np.isfinite(n).all() and (length > 0).all()):
        raise InputError("the normal of a plane is not a direction", where="eccentricity", allowed="three finite numbers, not all 0")
    along: np.ndarray = n / length
    return along
