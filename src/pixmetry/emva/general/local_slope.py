"""Local slope of a noisy curve by a natural cubic smoothing spline (Reinsch 1967; Green & Silverman 1994, §2.3)."""

from __future__ import annotations

import numpy as np


def slope_matrix(x: np.ndarray, weights: np.ndarray, dof: float) -> np.ndarray:
    """The matrix that takes ordinates to the slopes, at the same places, of the smoothing spline through them.

    Parameters
    ----------
    x : ndarray, shape (n,)
        Abscissae, ascending, three or more.
    weights : ndarray, shape (n,)
        Inverse variances of the ordinates, up to a factor.
    dof : float
        Equivalent degrees of freedom, the trace of the smoother: 2 is a straight line, n an interpolation.

    Returns
    -------
    ndarray, shape (n, n)

    Notes
    -----
    The spline minimises Σ w (y − g)² + λ ∫ g''². With h the steps, its second derivatives are γ = R⁻¹Qᵀg, its ordinates
    g = (W + λ QR⁻¹Qᵀ)⁻¹ W y, and its slope at xᵢ is (gᵢ₊₁ − gᵢ)/hᵢ − hᵢ(2γᵢ + γᵢ₊₁)/6. λ is sought so that the trace is ``dof``.
    """
    n = x.size
    scale = float(x[-1] - x[0])
    h = np.diff(x) / scale
    q = np.zeros((n, n - 2))
    r = np.zeros((n - 2, n - 2))
    for j in range(n - 2):
        q[j : j + 3, j] = 1 / h[j], -1 / h[j] - 1 / h[j + 1], 1 / h[j + 1]
        r[j, j] = (h[j] + h[j + 1]) / 3
        if j < n - 3:
            r[j, j + 1] = r[j + 1, j] = h[j + 1] / 6
    bend = np.linalg.solve(r, q.T)  # ordinates to second derivatives at the inner places
    root = np.sqrt(weights / weights.mean())
    energy, shapes = np.linalg.eigh((q @ bend) / np.outer(root, root))
    energy = np.maximum(energy, 0.0)
    energy[:2] = 0.0  # constant and straight line
    shrink = 1 / (1 + _penalty(energy, min(dof, n - 1e-3)) * energy)
    smooth = (shapes * shrink) @ shapes.T * root / root[:, None]
    second = np.zeros((n, n))
    second[1:-1] = bend @ smooth
    step = h[:, None]
    slope = np.empty((n, n))
    slope[:-1] = np.diff(smooth, axis=0) / step - step * (2 * second[:-1] + second[1:]) / 6
    slope[-1] = (smooth[-1] - smooth[-2]) / h[-1] + h[-1] * (second[-2] + 2 * second[-1]) / 6
    return slope / scale


def _penalty(energy: np.ndarray, dof: float) -> float:
    """λ for which Σ 1/(1 + λ energy) is ``dof``, by bisection of its logarithm."""
    bent = energy[2:]
    low, high = -np.log(bent.max()) - 30, -np.log(bent.min()) + 30
    for _ in range(60):
        middle = 0.5 * (low + high)
        if 2 + float((1 / (1 + np.exp(middle) * bent)).sum()) > dof:
            low = middle
        else:
            high = middle
    return float(np.exp(0.5 * (low + high)))
