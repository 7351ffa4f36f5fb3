"""From pixels to the object: how well a point is known in space by rays from several images."""

from __future__ import annotations

import numpy as np

from pixmetry.core.errors import InputError


def point_covariance(u_px: tuple[float, float], px_per_mm: float, rays: int, base_to_height: float, distance_mm: float = 1.0) -> np.ndarray:
    """Covariance of a point that rays from several images meet in.

    Parameters
    ----------
    u_px : (float, float)
        Standard uncertainty of a measured place in x and y, the same in all images and independent between them.
    px_per_mm : float
        Scale of the image of an object at the distance of the base's middle.
    rays : int
        Images; two stand at the ends of a base, more on a circle with the base as its diameter, all turned towards the point.
    base_to_height : float
        Length of the base over its distance from the object.
    distance_mm : float
        Any: the covariance depends on angles and on the scale alone.

    Returns
    -------
    ndarray, shape (3, 3)
        In mm², axes along the base, across it, and along the line of sight.

    Raises
    ------
    InputError
        For fewer than two rays: one image tells no depth.

    Notes
    -----
    The inverse of the normal matrix Σ Jᵢᵀ diag(uₓ⁻², u_y⁻²) Jᵢ of an intersection with known cameras; the rows of Jᵢ are the directions
    across ray i times the scale of its image, which falls as the cameras stand farther off. In a bundle adjustment of many points what
    the cameras' own parameters add is small beside it (C. S. Fraser, Photogrammetric Engineering & Remote Sensing 50(8), 1984).

    Examples
    --------
    >>> from pixmetry.budget.object_space import point_covariance
    >>> u = point_covariance((0.02, 0.02), px_per_mm=2.0, rays=2, base_to_height=0.5).diagonal() ** 0.5
    >>> [round(float(v), 4) for v in u]
    [0.0075, 0.0073, 0.0301]
    """
    if rays < 2:
        raise InputError("a point in space needs rays from two images or more", where="count.rays", value=rays, allowed="2 or more")
    angle = np.pi * np.arange(rays) * (1 if rays == 2 else 2 / rays)
    half = 0.5 * base_to_height * distance_mm
    normal = np.zeros((3, 3))
    for a in angle:
        ray = np.array([-half * np.cos(a), -half * np.sin(a), distance_mm])
        far = float(np.linalg.norm(ray))
        ray /= far
        along_x = np.array([1.0, 0.0, 0.0]) - ray[0] * ray
        along_x /= np.linalg.norm(along_x)
        along_y = np.cross(ray, along_x)
        jacobian = np.stack([along_x, along_y]) * px_per_mm * distance_mm / far
        normal += jacobian.T @ np.diag(1 / np.square(u_px)) @ jacobian
    return np.asarray(np.linalg.inv(normal))
