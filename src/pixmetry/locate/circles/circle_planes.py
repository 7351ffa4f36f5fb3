"""The plane of a circle from the ellipse as which it is seen: two answers for one circle, as a rule one for several on the same plane.

References
----------
D. Forsyth, J. L. Mundy, A. Zisserman et al., IEEE PAMI 13(10), 971 (1991), appendix.
K. Kanatani, W. Liu, CVGIP: Image Understanding 58(3), 286 (1993).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.core.errors import InputError
from pixmetry.locate.circles.ellipses import Ellipses, Pinhole, matrices, spread, unit

MOST_CANDIDATES = 64  # targets whose two normals are tried as that of the common plane
LOG_ODDS = 15.1  # χ² with one degree of freedom beyond which one of two answers is rejected, at 1e-4


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
        raise InputError("there is no ellipse to find a plane from", where="eccentricity")
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
    return k @ conic @ k * size[:, None, None]


def _residuals(cones: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """How far the plane's cuts are from circles, shape (n, 2)."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    basis = np.stack([first, np.cross(normal, first)])
    cut = basis @ cones @ basis.T
    return np.stack([cut[:, 0, 0] - cut[:, 1, 1], 2 * cut[:, 0, 1]], axis=1) / (cut[:, 0, 0] + cut[:, 1, 1])[:, None]


def _weights(ellipses: Ellipses, camera: Pinhole, normal: np.ndarray) -> np.ndarray:
    """Inverse covariances of the residuals, shape (n, 2, 2)."""
    if ellipses.conic_covariance is None:
        return ellipses.semi_minor_px[:, None, None] ** 2 * np.eye(2)
    covariance = spread(ellipses, lambda p: _residuals(_cones(p, camera), normal))
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
