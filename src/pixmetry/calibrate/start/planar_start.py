"""Plane test fields: homographies, and the principal distance they hold.

References
----------
R. Hartley & A. Zisserman, Multiple View Geometry, 2nd ed. 2004, algorithm 4.2 (normalised DLT); Z. Zhang, IEEE PAMI 22 (2000) 1330–1334,
section 3.1, here with the principal point in the middle of the frame.
"""

from __future__ import annotations

import numpy as np


def homography(plane: np.ndarray, image: np.ndarray, passes: int = 6) -> np.ndarray:
    """Homography that takes points of a plane to an image, both shape (n, 2), n ≥ 4; wrong points are weighted down.

    Raises
    ------
    ValueError
        If there are fewer than four points.
    """
    if len(plane) < 4:
        raise ValueError("a homography takes four points")
    (a, to_a), (b, to_b) = _normalised(plane), _normalised(image)
    weight = np.ones(len(a))
    ones, zero = np.ones(len(a)), np.zeros((len(a), 3))
    p = np.column_stack([a, ones])
    for _ in range(passes):
        rows = np.concatenate([np.hstack([p, zero, -b[:, :1] * p]), np.hstack([zero, p, -b[:, 1:] * p])])
        h = np.linalg.svd(rows * np.tile(weight, 2)[:, None])[2][-1].reshape(3, 3)
        with np.errstate(all="ignore"):
            seen = p @ h.T
            error = np.linalg.norm(seen[:, :2] / seen[:, 2:] - b, axis=1)
            spread = max(3.0 * float(np.nanmedian(error)), 1e-9)
            depth = np.abs(seen[:, 2]) / np.median(np.abs(seen[:, 2]))  # algebraic errors are geometric ones times the depth
            weight = np.nan_to_num(1 / (depth * np.sqrt(1 + (error / spread) ** 2)))
    h = np.linalg.inv(to_b) @ h @ to_a
    return h / np.linalg.norm(h)


def principal_distance(homographies: list[np.ndarray]) -> float:
    """Principal distance, in the unit of the image, from homographies into images about the principal point; NaN if they hold none.

    With ω = diag(1/c², 1/c², 1): h₁ᵀ ω h₂ = 0 and h₁ᵀ ω h₁ = h₂ᵀ ω h₂ for each; weak where the planes stand parallel
    to the image.
    """
    factors, constants = [], []
    for h in homographies:
        h1, h2 = h[:, 0], h[:, 1]
        size = np.linalg.norm(h1) * np.linalg.norm(h2)
        factors += [(h1[:2] @ h2[:2]) / size, (h1[:2] @ h1[:2] - h2[:2] @ h2[:2]) / size]
        constants += [h1[2] * h2[2] / size, (h1[2] ** 2 - h2[2] ** 2) / size]
    f, g = np.array(factors), -np.array(constants)
    slope = float(f @ g) / float(f @ f) if f.any() else np.nan  # 1/c²
    return float(1 / np.sqrt(slope)) if slope > 0 else float("nan")


def plane_coordinates(xyz: np.ndarray) -> np.ndarray:
    """Coordinates (n, 2) of points in the plane that lies through them."""
    a = xyz - xyz.mean(axis=0)
    return a @ np.linalg.svd(a, full_matrices=False)[2][:2].T


def _normalised(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    middle = points.mean(axis=0)
    scale = np.sqrt(2) / max(float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1)))), 1e-300)
    to = np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1]])
    return (points - middle) * scale, to
