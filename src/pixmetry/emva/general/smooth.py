"""Smooth curves through scattered levels, and how far these scatter beyond their known noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

HIGHEST_DEGREE = 7


@dataclass(frozen=True)
class SmoothFit:
    """Weighted least-squares polynomial. ``values``, ``slopes``, ``residuals`` (of the ordinates) and ``leverage`` have shape (n,)."""

    values: np.ndarray
    slopes: np.ndarray
    residuals: np.ndarray
    leverage: np.ndarray
    dof: int


@dataclass(frozen=True)
class ScatterFit:
    """A smooth fit, and the standard deviations of its ordinates that its residuals bear out.

    ``excess`` is the factor of the ``shape`` that was given; ``dof`` holds for the whole of ``u``.
    """

    fit: SmoothFit
    excess: float
    u: np.ndarray
    dof: float

    @property
    def standardised(self) -> np.ndarray:
        """Residuals over their standard deviations, freed of what the fit took."""
        z = np.divide(self.fit.residuals, self.u, out=np.zeros_like(self.u), where=self.u > 0)
        return z / np.sqrt(np.maximum(1 - self.fit.leverage, 0.05))


def fit_smooth(x: np.ndarray, y: np.ndarray, sigma: np.ndarray, degree: int) -> SmoothFit:
    """Polynomial of a degree in x with weights 1/sigma², by orthogonal factors of its Chebyshev basis."""
    basis, derivative = _basis(x, degree)
    q, r = np.linalg.qr(basis / sigma[:, None])
    coefficients = np.linalg.solve(r, q.T @ (y / sigma))
    values = basis @ coefficients
    return SmoothFit(values, derivative @ coefficients, y - values, (q**2).sum(axis=1), x.size - degree - 1)


def _basis(x: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Chebyshev polynomials over the range of ``x`` and their derivatives, each of shape (n, degree + 1)."""
    low, high = float(x.min()), float(x.max())
    half = max(0.5 * (high - low), 1e-300)
    place = (x - 0.5 * (low + high)) / half
    derivatives = np.polynomial.chebyshev.chebder(np.eye(degree + 1)) if degree else np.zeros((1, 1))
    return np.polynomial.chebyshev.chebvander(place, degree), np.polynomial.chebyshev.chebval(place, derivatives).T / half


def choose_degree(x: np.ndarray, y: np.ndarray, sigma: np.ndarray, start: int = 3) -> int:
    """Degree of the polynomial that follows the levels without following their noise.

    A cubic; a higher degree where Akaike's criterion, corrected for small samples (Hurvich & Tsai 1989), asks for it: a camera with a
    strong curve must not be taken for one that scatters. With few levels less, so that one degree of freedom is left.
    """
    n = x.size
    lowest = max(min(start, n - 3), 1)
    best, chosen = np.inf, lowest
    rounding = 1e-24 * float(((y / sigma) ** 2).sum()) + 1e-300
    for degree in range(lowest, max(min(HIGHEST_DEGREE, n // 5), lowest) + 1):
        p = degree + 2
        if n - p - 1 <= 0:
            break
        rss = float(((fit_smooth(x, y, sigma, degree).residuals / sigma) ** 2).sum())
        score = n * np.log(max(rss, rounding)) + 2 * p * n / (n - p - 1)
        if score < best:
            best, chosen = score, degree
    return chosen


def fit_scatter(x: np.ndarray, y: np.ndarray, sigma: np.ndarray, shape: np.ndarray, degree: int | None = None) -> ScatterFit:
    """Smooth curve with weights that hold an excess scatter: u² = sigma² + τ² shape².

    Parameters
    ----------
    x, y : ndarray, shape (n,)
    sigma : ndarray, shape (n,)
        Known standard deviations of ``y``.
    shape : ndarray, shape (n,)
        How the excess grows from level to level.
    degree : int, optional
        Of the polynomial; chosen from the levels if it is not given.

    Notes
    -----
    τ² is where the weighted sum of squares equals its degrees of freedom (Mandel & Paule 1970), zero if it lies below them without any.
    """
    sigma = np.maximum(sigma, 1e-9 * (float(np.abs(y).max()) or 1.0))
    degree = choose_degree(x, y, np.hypot(sigma, 1e-2 * shape)) if degree is None else degree

    def surplus(tau: float) -> float:
        fit = fit_smooth(x, y, np.hypot(sigma, tau * shape), degree)
        return float((fit.residuals**2 / (sigma**2 + (tau * shape) ** 2)).sum()) - fit.dof

    tau = 0.0
    if surplus(0.0) > 0:
        low, high = -16.0, 1.0  # logarithms
        for _ in range(18):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if surplus(np.exp(middle)) > 0 else (low, middle)
        tau = float(np.exp(0.5 * (low + high)))
    u = np.hypot(sigma, tau * shape)
    fit = fit_smooth(x, y, u, degree)
    share = float(np.median((tau * shape) ** 2 / u**2))
    return ScatterFit(fit, tau, u, fit.dof / max(share**2, 1e-12))
