"""A smoothing spline over a sweep of light, linear in the data once its stiffness is chosen.

The abscissa is log(1 + p/p₁) with the smallest light p₁, over which even and logarithmic sweeps are followed alike, down to no light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LEVELS_PER_KNOT = 2
MOST_KNOTS = 24
STIFFNESSES = 10.0 ** np.arange(-10, 3.1, 0.5)
SOFTER = 0.1  # of the stiffness that cross-validation likes best: it weighs bias as much as noise, and u holds the noise only
SETTING_ERRORS = (10.0, 30.0, 100.0, 300.0)  # of the light of the darkest level, in units of what it scatters without
PLAIN = 60.0  # difference of −2 log likelihood that bends and noise seldom make
CAUTION = 1.4  # degrees of freedom count this much in cross-validation, which follows noise otherwise (Kim & Gu 2004)


@dataclass(frozen=True)
class ResponseSpline:
    """A smoother that is linear in the data: coefficients = matrix @ values at the levels."""

    knots: np.ndarray
    matrix: np.ndarray  # shape (coefficients, levels)
    span: float  # largest abscissa
    unit: float  # light p₁ of the abscissa z = log(1 + p/p₁)/span

    def rows(self, light: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Matrix from values at the levels to the spline or its slope by light, shape (light, levels)."""
        z = np.log1p(light / self.unit) / self.span
        basis = _basis(z, self.knots, derivative)
        if derivative:
            basis = basis / ((light + self.unit) * self.span)[:, None]
        return basis @ self.matrix


def _basis(z: np.ndarray, knots: np.ndarray, derivative: int = 0) -> np.ndarray:
    """Powers and truncated powers of a cubic spline on [0, 1], or their derivatives, shape (z, 4 + knots)."""
    factor = {0: 1.0, 1: 3.0, 2: 6.0}[derivative]
    power = 3 - derivative
    polynomial = np.stack([_power(z, n, derivative) for n in range(4)], axis=1)
    return np.hstack([polynomial, factor * np.maximum(z[:, None] - knots, 0.0) ** power])


def _power(z: np.ndarray, n: int, derivative: int) -> np.ndarray:
    coefficient = 1.0
    for k in range(derivative):
        coefficient *= n - k
    return coefficient * z ** max(n - derivative, 0)


@dataclass(frozen=True)
class Smoothing:
    """A smoother, and how unlikely the values are with it and its weights.

    ``misfit`` is −2 log likelihood of what each is off a curve through the others, up to what is common to all weights.
    """

    spline: ResponseSpline
    misfit: float


def smooth_response(light: np.ndarray, values: np.ndarray, weights: np.ndarray) -> Smoothing:
    """Penalised regression spline; the penalty is the integrated square of its second derivative by the abscissa.

    Parameters
    ----------
    light, values, weights : ndarray, shape (levels,)
        Light in rising order, above zero, four or more different ones. The values only serve to choose the stiffness, by generalised
        cross-validation (Craven & Wahba 1979).
    """
    unit = float(light[0])
    span = float(np.log1p(light[-1] / unit))
    z = np.log1p(light / unit) / span
    different = np.unique(z)
    n_knots = int(np.clip(different.size // LEVELS_PER_KNOT, 2, MOST_KNOTS))
    knots = np.quantile(different, np.arange(1, n_knots + 1) / (n_knots + 1))
    root = np.sqrt(weights / weights.mean())
    design = root[:, None] * _basis(z, knots)
    edges = np.concatenate([[0.0], knots, [1.0]])
    # two Gauss points an interval integrate the square of the piecewise linear second derivative exactly
    middle, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    points = np.concatenate([middle - half / np.sqrt(3), middle + half / np.sqrt(3)])
    bend = np.sqrt(np.tile(half, 2))[:, None] * _basis(points, knots, 2)

    # one basis in which the penalty is diagonal serves all stiffnesses (generalised singular values)
    q, r = np.linalg.qr(np.vstack([design, bend]))
    shapes, along, turn = np.linalg.svd(q[: light.size], full_matrices=False)
    straight, bent = np.minimum(along, 1.0) ** 2, 1 - np.minimum(along, 1.0) ** 2
    kept = straight / (straight + np.outer(STIFFNESSES, bent))
    weighted = root * values
    left = weighted - (kept * (shapes.T @ weighted)) @ shapes.T
    free = light.size - CAUTION * kept.sum(axis=1)
    scores = np.where(free > 0, (left**2).sum(axis=1) / np.maximum(free, 1e-9) ** 2, np.inf)
    stiffest = scores.size - 1 - int(np.argmin(scores[::-1]))
    gains = along / (straight + SOFTER * STIFFNESSES[stiffest] * bent)
    spline = ResponseSpline(knots, np.linalg.solve(r, turn.T * gains) @ shapes.T * root, span, unit)
    without = left[stiffest] / np.maximum(1 - shapes**2 @ kept[stiffest], 1e-6)  # what each level is off a curve through the others
    likely = light.size * np.log(max(float(without @ without), 1e-300)) - 2 * float(np.log(root).sum())
    return Smoothing(spline, likely)


def smooth_despite_setting(light: np.ndarray, values: np.ndarray, weights: np.ndarray) -> ResponseSpline:
    """The same, with less weight for the darkest levels where it is plain that their light is not what it was set to.

    A shutter that opens late, or light that leaks in, changes the light of all levels by amounts of one size, so that the darkest levels
    are off by most. The variance of a level then has a share that falls with the square of the light; it is taken where the levels are far
    more likely with it, each judged by a curve through the others. A bend that only the darkest levels of an even sweep show looks alike,
    and is then followed less closely at these.
    """
    best = smooth_response(light, values, weights)
    plain = best.misfit - PLAIN
    for darkest in SETTING_ERRORS:
        other = smooth_response(light, values, weights / (1 + (darkest * light[0] / light) ** 2))
        if other.misfit < min(plain, best.misfit):
            best = other
    return best.spline
