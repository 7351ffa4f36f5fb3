"""Image of a circle's centre: its distance from the centre of the ellipse that is the perspective image of the circle.

A camera with matrix K sees a plane with normal n; the plane's horizon is the line l = K⁻ᵀ n, and the image of the circle's centre is the
pole of that line with respect to the imaged ellipse C: c ~ C⁻¹ l. With centre p and shape matrix S of the ellipse,
(q − p)ᵀ S⁻¹ (q − p) = 1, that is

    c = p − S (l₁, l₂) / (l₁ p_x + l₂ p_y + l₃).

The normal is given, or comes from the ellipse itself (two answers for a single one), or from the ellipses of several circles of one plane.

References
----------
R. Hartley, A. Zisserman, Multiple View Geometry (2003), 2.2.3 (pole and polar), 8.5 (horizon). The same shift in other variables:
J. Heikkilä, IEEE PAMI 22(10), 1066 (2000); S. J. Ahn, H. J. Warnecke, R. Kotowski, Photogrammetric Record 16(93), 485 (1999).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.core.errors import InputError
from pixmetry.locate.circles.ellipses import CONTOUR_POINTS, NAMES, Ellipses, Pinhole, ellipse_through, matrices, spread, unit

LARGEST_STEP = 0.3  # rad: a normal that is less sure than this is not known
Undistort = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
MOST_CANDIDATES = 64  # targets whose two normals are tried as that of the common plane
LOG_ODDS = 15.1  # χ² with one degree of freedom beyond which one of two answers is rejected, at 1e-4


@dataclass(frozen=True)
class Centres:
    """Images of the circles' centres, arrays of shape (n,).

    Parameters
    ----------
    x_px, y_px : ndarray
    shift_x_px, shift_y_px : ndarray
        What was added to the ellipses' centres.
    var_x_px2, cov_xy_px2, var_y_px2 : ndarray
        From the covariances of the ellipses and of the normal; NaN if the ellipses have none.
    """

    x_px: np.ndarray
    y_px: np.ndarray
    shift_x_px: np.ndarray
    shift_y_px: np.ndarray
    var_x_px2: np.ndarray
    cov_xy_px2: np.ndarray
    var_y_px2: np.ndarray

    def __len__(self) -> int:
        return len(self.x_px)


def circle_seen(homography: np.ndarray, x: ArrayLike, y: ArrayLike, radius: ArrayLike) -> tuple[Ellipses, Centres]:
    """Ellipses as which circles of a plane are seen, and the images of their centres.

    Parameters
    ----------
    homography : ndarray, shape (3, 3)
        H of (x_px, y_px, 1) ~ H (x, y, 1), from the plane to the image.
    x, y, radius : array_like, shape (n,)
        In the plane, any unit.

    Raises
    ------
    InputError
        If a number cannot be used, or a circle reaches the plane's horizon.
    """
    h = np.asarray(homography, float)
    x, y, radius = np.broadcast_arrays(*(np.atleast_1d(np.asarray(v, float)) for v in (x, y, radius)))
    if h.shape != (3, 3) or not np.isfinite(h).all() or abs(np.linalg.det(h)) == 0 or not (radius > 0).all():
        raise InputError("circles cannot be projected", where="eccentricity", allowed="a regular 3 × 3 matrix, radii above 0")
    centre = np.stack([x, y, np.ones_like(x)]) if len(x) else np.empty((3, 0))
    seen = h @ centre
    if not (np.abs(seen[2]) > radius * np.hypot(h[2, 0], h[2, 1])).all():
        raise InputError("a circle reaches the horizon of its plane: its image is not an ellipse", where="eccentricity")
    # about the image of the centre: (u, v) of the unit circle goes to (M (u, v)) / (1 + w·(u, v))
    image = seen[:2] / seen[2]
    m = radius[:, None, None] * (h[None, :2, :2] - image.T[:, :, None] * h[None, 2:, :2]) / seen[2][:, None, None]
    w = radius[:, None] * h[None, 2, :2] / seen[2][:, None]
    rest = 1.0 - (w**2).sum(axis=1)
    offset = -(m @ w[:, :, None])[:, :, 0] / rest[:, None]
    outer = np.eye(2) + w[:, :, None] * w[:, None, :] / rest[:, None, None]
    shape = m @ outer @ m.swapaxes(1, 2) / rest[:, None, None]
    ellipses = Ellipses.of_conics(np.column_stack([image.T + offset, shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]]))
    zero = np.zeros(len(x))
    return ellipses, Centres(image[0], image[1], -offset[:, 0], -offset[:, 1], zero, zero, zero)


def homography_of(camera: Pinhole, normal: ArrayLike, centre: ArrayLike) -> np.ndarray:
    """Matrix from a plane to the image: the plane goes through ``centre`` (camera coordinates), which is its origin, across ``normal``."""
    n = unit(normal)
    first = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    first /= np.linalg.norm(first)
    map_of_plane: np.ndarray = camera.matrix @ np.column_stack([first, np.cross(n, first), np.asarray(centre, float)])
    return map_of_plane


def corrected(
    ellipses: Ellipses, camera: Pinhole, normal: ArrayLike | Plane | None = None, *, hint: ArrayLike | None = None, coplanar: bool = True
) -> Centres:
    """Images of the circles' centres from the ellipses that are seen.

    Parameters
    ----------
    ellipses : Ellipses
    camera : Pinhole
    normal : array_like, shape (3,) or (n, 3), or Plane, optional
        Of the circles' plane in camera coordinates, any sign and length. By default it is found from the ellipses.
    hint : array_like, shape (3,), optional
        A rough normal where the plane is found from the ellipses and two answers are left.
    coplanar : bool
        Whether all circles lie on one plane, if it is to be found; else each has a plane of its own and needs the hint.

    Raises
    ------
    InputError
        If two answers are left, the normal is no direction, or the plane's horizon crosses an ellipse.

    Notes
    -----
    The covariance comes from steps of one standard deviation along the principal directions of each ellipse's covariance, both ways; a
    plane that was found from each ellipse alone is found again at every step. The covariance of a `Plane` or of the common plane is added.
    """
    if normal is None and coplanar:
        normal = common_plane(ellipses, camera, hint)
        if normal.other_normal is not None and hint is None:
            raise _ambiguous(ellipses, camera, (normal.normal, normal.other_normal))
    if normal is None:
        if hint is None:
            raise InputError("each circle alone has two possible planes", where="eccentricity", remedy="give the normal, or a hint of it")
        toward = unit(hint)

        def shift(conics: np.ndarray) -> np.ndarray:
            both = normals_of(conics, camera)
            return _shifts(conics, camera, both[np.arange(len(both)), np.argmax(both @ toward, axis=1)])
    else:
        direction = normal.normal if isinstance(normal, Plane) else np.asarray(normal, float)

        def shift(conics: np.ndarray) -> np.ndarray:
            return _shifts(conics, camera, direction)

    return _with_covariance(ellipses, camera, shift, normal if isinstance(normal, Plane) else None)


def both_corrected(ellipses: Ellipses, camera: Pinhole) -> tuple[Centres, Centres]:
    """Both answers for each ellipse alone, in the order of `plane_normals`; their `shift` columns say how much hangs on the choice."""
    first, second = normals_of(ellipses.conics, camera).swapaxes(0, 1)
    return corrected(ellipses, camera, first), corrected(ellipses, camera, second)


def corrected_distorted(ellipses: Ellipses, camera: Pinhole, normal: ArrayLike | Plane, undistort: Undistort) -> Centres:
    """Images of the circles' centres in a camera whose lens distorts.

    Parameters
    ----------
    ellipses : Ellipses
        As seen, with distortion.
    camera : Pinhole
        The camera without it.
    normal : array_like or Plane
        As for `corrected`.
    undistort : callable
        ``(x_px, y_px) -> (x_px, y_px)``: where the camera without distortion would see what is seen at a place; arrays of any shape.

    Returns
    -------
    Centres
        Places in the distorted image; covariances are those of the ellipses' centres, moved by the same amount.

    Notes
    -----
    Points of each contour are undistorted, an ellipse is laid through them, its centre is corrected, and the result is brought back by
    Newton steps.
    """
    t = 2 * np.pi * np.arange(CONTOUR_POINTS) / CONTOUR_POINTS
    angle = np.deg2rad(ellipses.angle_deg)[:, None]
    u, v = ellipses.semi_major_px[:, None] * np.cos(t), ellipses.semi_minor_px[:, None] * np.sin(t)
    x = ellipses.x_px[:, None] + u * np.cos(angle) - v * np.sin(angle)
    y = ellipses.y_px[:, None] + u * np.sin(angle) + v * np.cos(angle)
    straight = [ellipse_through(*points) for points in zip(*undistort(x, y), strict=True)]
    ideal = corrected(Ellipses(*(np.concatenate([getattr(e, name) for e in straight]) for name in NAMES)), camera, normal)
    back_x, back_y = _distorted(ideal.x_px, ideal.y_px, ellipses.x_px, ellipses.y_px, undistort)
    none = np.full(len(ellipses), np.nan)
    var = [none] * 3 if ellipses.conic_covariance is None else [ellipses.conic_covariance[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1))]
    return Centres(back_x, back_y, back_x - ellipses.x_px, back_y - ellipses.y_px, *var)


def _distorted(x: np.ndarray, y: np.ndarray, x0: np.ndarray, y0: np.ndarray, undistort: Undistort) -> tuple[np.ndarray, np.ndarray]:
    """The places that `undistort` brings to (x, y), starting from (x0, y0)."""
    place, step = np.stack([x0, y0]).astype(float), 1e-3
    for _ in range(20):
        miss = np.stack([x, y]) - np.stack(undistort(*place))
        slopes = [np.stack(undistort(*(place + d))) - np.stack(undistort(*(place - d))) for d in step * np.eye(2)[:, :, None]]
        jacobian = np.stack(slopes, axis=1) / (2 * step)
        move = np.linalg.solve(jacobian.transpose(2, 0, 1), miss.T[:, :, None])[:, :, 0].T
        place += move
        if np.abs(move).max(initial=0.0) < 1e-10:
            return place[0], place[1]
    raise InputError("the distortion cannot be inverted there", where="undistort", remedy="give a smooth one-to-one map")


def _shifts(conics: np.ndarray, camera: Pinhole, normal: np.ndarray) -> np.ndarray:
    """From the ellipses' centres to the images of the circles' centres, shape (n, 2)."""
    line = np.broadcast_to(unit(normal) @ np.linalg.inv(camera.matrix), (len(conics), 3))
    slope, height = line[:, :2, None], (line[:, :2] * conics[:, :2]).sum(axis=1) + line[:, 2]
    reach = matrices(conics) @ slope
    if ((slope * reach).sum(axis=(1, 2)) >= height**2).any():
        raise InputError("the plane's horizon crosses an ellipse", where="eccentricity", remedy="check the normal and the camera's numbers")
    shifts: np.ndarray = -reach[:, :, 0] / height[:, None]
    return shifts


def _with_covariance(ellipses: Ellipses, camera: Pinhole, shift: Callable[[np.ndarray], np.ndarray], plane: Plane | None) -> Centres:
    start = ellipses.conics
    moved = shift(start)
    place = start[:, :2] + moved
    if ellipses.conic_covariance is None:
        covariance = np.full((len(ellipses), 2, 2), np.nan)
    else:
        covariance = spread(start, ellipses.conic_covariance, lambda p: p[:, :2] + shift(p))
        if plane is not None:
            values, axes = np.linalg.eigh(np.nan_to_num(plane.covariance, nan=0.0, posinf=0.0))
            for size, axis in zip(np.minimum(np.sqrt(np.maximum(values, 0.0)), LARGEST_STEP), axes.T, strict=True):
                step = 0.5 * (_shifts(start, camera, plane.normal + size * axis) - _shifts(start, camera, plane.normal - size * axis))
                covariance += step[:, :, None] * step[:, None, :]
    return Centres(place[:, 0], place[:, 1], moved[:, 0], moved[:, 1], covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1])


def _ambiguous(ellipses: Ellipses, camera: Pinhole, normals: tuple[np.ndarray, np.ndarray]) -> InputError:
    two = [np.hypot(*(_shifts(ellipses.conics, camera, n)).T).max() for n in normals]
    return InputError(
        "two planes explain these ellipses equally well",
        where="eccentricity",
        value=[n.round(4).tolist() for n in normals],
        remedy=f"give the normal or a hint of it; the corrections are up to {two[0]:.4f} px or {two[1]:.4f} px",
    )


@dataclass(frozen=True)
class Plane:
    """Normal of a plane in camera coordinates (z away from the camera), and how well the circles agree on it.

    Parameters
    ----------
    normal : ndarray, shape (3,)
    covariance : ndarray, shape (3, 3)
        NaN if too few circles without covariances gave it.
    chi2_per_dof : float
        Near 1 if all targets are circles of this plane and their covariances hold; NaN without covariances or for a single circle.
    other_normal : ndarray, shape (3,), optional
        The second answer that explains the ellipses, if nothing tells the two apart with 99.99 % certainty.
    """

    normal: np.ndarray
    covariance: np.ndarray
    chi2_per_dof: float = np.nan
    other_normal: np.ndarray | None = None


def plane_normals(ellipses: Ellipses, camera: Pinhole) -> np.ndarray:
    """The two normals that a circle seen as this ellipse can have; shape (n, 2, 3), unit vectors away from the camera."""
    return normals_of(ellipses.conics, camera)


def normals_of(conics: np.ndarray, camera: Pinhole) -> np.ndarray:
    """As `plane_normals`, of conics as in `Ellipses.conics`.

    Notes
    -----
    The cone Kᵀ C K through the ellipse has eigenvalues λ₁ ≥ λ₂ > 0 > λ₃ with eigenvectors e₁, e₂, e₃; a plane across
    ±√((λ₁ − λ₂)/(λ₁ − λ₃)) e₁ + √((λ₂ − λ₃)/(λ₁ − λ₃)) e₃ cuts it in a circle.
    """
    values, vectors = np.linalg.eigh(_cones(conics, camera))  # ascending
    low, middle, high = values.T
    along, across = np.sqrt((high - middle) / (high - low)), np.sqrt((middle - low) / (high - low))
    both = np.stack([s * along[:, None] * vectors[:, :, 2] + across[:, None] * vectors[:, :, 0] for s in (-1, 1)], axis=1)
    return both * np.where(both[:, :, 2:] < 0, -1.0, 1.0)


def common_plane(ellipses: Ellipses, camera: Pinhole, hint: ArrayLike | None = None) -> Plane:
    """Normal of the plane on which all these circles lie, by least squares.

    Parameters
    ----------
    ellipses : Ellipses
        Of one circle or more. Their covariances weight them; without, all half axes are taken as equally well known.
    camera : Pinhole
    hint : array_like, shape (3,), optional
        A rough normal: of the two answers (a single circle always has two) the one nearer to it is taken.

    Raises
    ------
    InputError
        If there is no ellipse, or the hint is no direction.

    Notes
    -----
    With u, v across n the residuals of one ellipse are (uᵀQu − vᵀQv, 2uᵀQv)/(uᵀQu + vᵀQv), Q = Kᵀ C K: zero if the plane cuts the cone in
    a circle. They are smooth in n and in the ellipse even where the circle is seen from the front and the two answers meet.
    """
    if len(ellipses) == 0:
        raise InputError("there is no ellipse that gives a plane", where="eccentricity")
    cones = _cones(ellipses.conics, camera)
    step = max(1, len(ellipses) // MOST_CANDIDATES)
    tried = plane_normals(ellipses[::step], camera)
    weight = _weights(ellipses, camera, tried[0, 0])
    cost = np.array([_chi2(_residuals(cones, n), weight) for n in tried.reshape(-1, 3)])
    found = [_refined(n, ellipses, camera, cones) for n in _two_starts(tried.reshape(-1, 3), cost)]
    found.sort(key=lambda f: f[2])
    (best, covariance, chi2), (other, other_covariance, other_chi2) = found[0], found[-1]
    dof = 2 * len(ellipses) - 2
    known = ellipses.conic_covariance is not None
    scale = 1.0 if known else (chi2 / dof if dof else np.nan)
    same = abs(best @ other) > 1 - 1e-12
    alike = not same and (dof == 0 or (other_chi2 - chi2) / (scale if scale > 0 else 1e-300) < LOG_ODDS)
    if alike and hint is not None and unit(hint) @ other > unit(hint) @ best:
        best, covariance, chi2, other = other, other_covariance, other_chi2, best
    reduced = chi2 / dof if known and dof else np.nan
    return Plane(best, covariance * scale, float(reduced), other if alike else None)


def _cones(conics: np.ndarray, camera: Pinhole) -> np.ndarray:
    """Cones Kᵀ C K through the ellipses in camera coordinates, shape (n, 3, 3), scaled to entries near 1."""
    k = np.diag(np.diag(camera.matrix))
    place = (conics[:, :2] - (camera.principal_x_px, camera.principal_y_px))[:, :, None]
    inverse = np.linalg.inv(matrices(conics))
    conic = np.empty((len(conics), 3, 3))
    conic[:, :2, :2] = inverse
    conic[:, :2, 2:] = -inverse @ place
    conic[:, 2:, :2] = conic[:, :2, 2:].swapaxes(1, 2)
    conic[:, 2, 2] = (place.swapaxes(1, 2) @ inverse @ place)[:, 0, 0] - 1.0
    size = np.sqrt(np.linalg.det(matrices(conics))) / camera.principal_distance_px**2
    cones: np.ndarray = k @ conic @ k * size[:, None, None]
    return cones


def _residuals(cones: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """How far the plane's cuts are from circles, shape (n, 2)."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    basis = np.stack([first, np.cross(normal, first)])
    cut = basis @ cones @ basis.T
    shape: np.ndarray = np.stack([cut[:, 0, 0] - cut[:, 1, 1], 2 * cut[:, 0, 1]], axis=1) / (cut[:, 0, 0] + cut[:, 1, 1])[:, None]
    return shape


def _weights(ellipses: Ellipses, camera: Pinhole, normal: np.ndarray) -> np.ndarray:
    """Inverse covariances of the residuals, shape (n, 2, 2)."""
    if ellipses.conic_covariance is None:
        return ellipses.semi_minor_px[:, None, None] ** 2 * np.eye(2)
    covariance = spread(ellipses.conics, ellipses.conic_covariance, lambda p: _residuals(_cones(p, camera), normal))
    floor = 1e-24 * np.eye(2)  # a covariance of zero is an exact ellipse
    return np.linalg.inv(covariance + floor)


def _chi2(residuals: np.ndarray, weight: np.ndarray) -> float:
    return float(np.einsum("ni,nij,nj->", residuals, weight, residuals))


def _two_starts(tried: np.ndarray, cost: np.ndarray) -> list[np.ndarray]:
    """The best candidate, and the best of those that are not near to it but across the line of sight."""
    best = tried[np.argmin(cost)]
    mirrored = np.array([-best[0], -best[1], best[2]])
    other = tried @ mirrored > tried @ best
    return [best, tried[other][np.argmin(cost[other])] if other.any() else best]


def _refined(normal: np.ndarray, ellipses: Ellipses, camera: Pinhole, cones: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Gauss–Newton over the two angles of the normal, damped; returns normal, covariance and χ²."""
    weight = _weights(ellipses, camera, normal)
    chi2, damping = _chi2(_residuals(cones, normal), weight), 1e-6
    for _ in range(60):
        across = np.linalg.svd(normal[None])[2][1:]
        step = 1e-6
        slopes = np.stack([_residuals(cones, unit(normal + step * t)) - _residuals(cones, unit(normal - step * t)) for t in across], axis=2)
        jacobian = slopes / (2 * step)
        matrix = np.einsum("nia,nij,njb->ab", jacobian, weight, jacobian)
        gradient = np.einsum("nia,nij,nj->a", jacobian, weight, _residuals(cones, normal))
        move = -np.linalg.solve(matrix + damping * np.trace(matrix) * np.eye(2) + 1e-300 * np.eye(2), gradient)
        new = unit(normal + move @ across)
        value = _chi2(_residuals(cones, new), weight)
        if value <= chi2:
            normal, chi2, damping = new, value, damping / 10
            if np.abs(move).max() < 1e-12:
                break
        elif damping > 1e6:
            break
        else:
            damping *= 10
    covariance = across.T @ np.linalg.pinv(matrix) @ across
    return normal * (1.0 if normal[2] >= 0 else -1.0), covariance, chi2
