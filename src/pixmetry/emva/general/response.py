"""The response of a series: curves that smooth it and tell how far levels scatter, its local slopes, and the level at which it ends.

The smoothing spline is linear in the data once its stiffness is chosen. Its abscissa is log(1 + p/p₁) with the smallest light p₁, over
which even and logarithmic sweeps are followed alike, down to no light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.emva.files.keys import SATURATED_FRACTION
from pixmetry.emva.records import Series

HIGHEST_DEGREE = 7


@dataclass(frozen=True)
class SmoothFit:
    """Weighted least-squares polynomial. ``values``, ``slopes``, ``residuals`` (of the ordinates) and ``leverage`` have shape (n,)."""

    values: Array
    slopes: Array
    residuals: Array
    leverage: Array
    dof: int


@dataclass(frozen=True)
class ScatterFit:
    """A smooth fit, and the standard deviations of its ordinates that its residuals bear out.

    ``excess`` is the factor of the ``shape`` that was given; ``dof`` holds for the whole of ``u``.
    """

    fit: SmoothFit
    excess: float
    u: Array
    dof: float

    @property
    def standardised(self) -> Array:
        """Residuals over their standard deviations, corrected for the degrees of freedom of the fit."""
        z = np.divide(self.fit.residuals, self.u, out=np.zeros_like(self.u), where=self.u > 0)
        return z / np.sqrt(np.maximum(1 - self.fit.leverage, 0.05))


def fit_smooth(x: Array, y: Array, sigma: Array, degree: int) -> SmoothFit:
    """Polynomial of a degree in x with weights 1/sigma², by orthogonal factors of its Chebyshev basis."""
    return _fit_basis(_basis(x, degree), y, sigma)


def _fit_basis(bases: tuple[Array, Array], y: Array, sigma: Array) -> SmoothFit:
    basis, derivative = bases
    q, r = np.linalg.qr(basis / sigma[:, None])
    coefficients = np.linalg.solve(r, q.T @ (y / sigma))
    values = basis @ coefficients
    return SmoothFit(values, derivative @ coefficients, y - values, (q**2).sum(axis=1), y.size - basis.shape[1])


def _basis(x: Array, degree: int) -> tuple[Array, Array]:
    """Chebyshev polynomials over the range of ``x`` and their derivatives, each of shape (n, degree + 1)."""
    low, high = float(x.min()), float(x.max())
    half = max(0.5 * (high - low), 1e-300)
    place = (x - 0.5 * (low + high)) / half
    derivatives = np.polynomial.chebyshev.chebder(np.eye(degree + 1)) if degree else np.zeros((1, 1))
    basis: Array = np.asarray(np.polynomial.chebyshev.chebvander(place, degree), dtype=float)
    return basis, np.asarray(np.polynomial.chebyshev.chebval(place, derivatives).T / half, dtype=float)


def choose_degree(x: Array, y: Array, sigma: Array, start: int = 3) -> int:
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


def fit_scatter(x: Array, y: Array, sigma: Array, shape: Array, degree: int | None = None) -> ScatterFit:
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
    bases = _basis(x, degree)

    def surplus(tau: float) -> float:
        fit = _fit_basis(bases, y, np.hypot(sigma, tau * shape))
        return float((fit.residuals**2 / (sigma**2 + (tau * shape) ** 2)).sum()) - fit.dof

    tau = 0.0
    if surplus(0.0) > 0:
        low, high = -16.0, 1.0  # logarithms
        for _ in range(18):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if surplus(np.exp(middle)) > 0 else (low, middle)
        tau = float(np.exp(0.5 * (low + high)))
    u = np.hypot(sigma, tau * shape)
    fit = _fit_basis(bases, y, u)
    share = float(np.median((tau * shape) ** 2 / u**2))
    return ScatterFit(fit, tau, u, fit.dof / max(share**2, 1e-12))


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

    knots: Array
    matrix: Array  # shape (coefficients, levels)
    span: float  # largest abscissa
    unit: float  # light p₁ of the abscissa z = log(1 + p/p₁)/span

    def rows(self, light: Array, derivative: int = 0) -> Array:
        """Matrix from values at the levels to the spline or its slope by light, shape (light, levels)."""
        z = np.log1p(light / self.unit) / self.span
        basis = _spline_basis(z, self.knots, derivative)
        if derivative:
            basis = basis / ((light + self.unit) * self.span)[:, None]
        return basis @ self.matrix


def _spline_basis(z: Array, knots: Array, derivative: int = 0) -> Array:
    """Powers and truncated powers of a cubic spline on [0, 1], or their derivatives, shape (z, 4 + knots)."""
    factor = {0: 1.0, 1: 3.0, 2: 6.0}[derivative]
    power = 3 - derivative
    polynomial = np.stack([_power(z, n, derivative) for n in range(4)], axis=1)
    return np.hstack([polynomial, factor * np.maximum(z[:, None] - knots, 0.0) ** power])


def _power(z: Array, n: int, derivative: int) -> Array:
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


def smooth_response(light: Array, values: Array, weights: Array) -> Smoothing:
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
    design = root[:, None] * _spline_basis(z, knots)
    edges = np.concatenate([[0.0], knots, [1.0]])
    # two Gauss points an interval integrate the square of the piecewise linear second derivative exactly
    middle, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    points = np.concatenate([middle - half / np.sqrt(3), middle + half / np.sqrt(3)])
    bend = np.sqrt(np.tile(half, 2))[:, None] * _spline_basis(points, knots, 2)

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


def smooth_despite_setting(light: Array, values: Array, weights: Array) -> ResponseSpline:
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


def slope_matrix(x: Array, weights: Array, dof: float) -> Array:
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


def _penalty(energy: Array, dof: float) -> float:
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


SATURATED_DEVIATE = 2.24  # 1.25 % of the pixels on a plateau below it: about there the variance is largest, which is what ends a 3.1 series
SEEN_FRACTION, SEEN_DEVIATE = 0.01, 2.24  # a little more shows hardly in mean and variance; draws choose among these levels
FLAT = 0.1  # of the steepest rise of the response over the logarithm of the light
CHORD, END_CHORD = 1.1, 1.019  # ratios of light over which a rise is read, so that scatter of the light does not matter
COLLAPSED, STEEPEST_FALL = 0.5, 3  # a variance below half of what it may fall to by a bend, p^-3 of the light: the level is on a plateau
NEAR = 1.5  # ratio of light within which levels have about the same noise


@dataclass(frozen=True)
class ResponseEnd:
    """What ends a series whose levels are in order of their light."""

    seen: int  # number of levels that follow the response
    clips: bool  # the top code ends it
    plateau_dn: float = np.inf  # mean of the saturated levels, where there are such below the top code
    noise_dn: float = 0.0  # of the pixels before the plateau, in time and space

    @property
    def found(self) -> bool:
        """Whether the series reaches its end."""
        return self.clips or bool(np.isfinite(self.plateau_dn))

    def saturation(self, mean_dn: Array, fraction_max: Array) -> Array:
        """Highest level with few enough pixels at the end, shape (...); arguments of shape (..., levels)."""
        below = (fraction_max <= SATURATED_FRACTION) & (self.plateau_dn - mean_dn >= SATURATED_DEVIATE * self.noise_dn)
        below = below[..., : self.seen]
        return np.where(below.any(axis=-1), self.seen - 1 - np.argmax(below[..., ::-1], axis=-1), 0)


def end_of(series: Series, light: Array) -> tuple[np.ndarray, ResponseEnd]:
    """The lit levels of one series (no draws) in order of their light, as indices, and what ends them; light of shape (levels,)."""
    order = np.argsort(light, kind="stable")
    order = order[light[order] > 0]
    known = (light, series.mean_dn, series.var_dn2, series.spatial_var_dn2, series.fraction_max)
    return order, find_end(*(np.asarray(values, dtype=float)[order] for values in known))


def find_end(light: Array, mean_dn: Array, var_dn2: Array, spatial_dn2: Array, fraction_max: Array) -> ResponseEnd:
    """Find the end of the response in one series; arrays of shape (levels,), in rising order of light.

    Notes
    -----
    Whatever its form, a response goes on rising with the logarithm of the light, until nothing more is stored. A plateau is found where
    the mean rises no more, or from a last level whose variance has collapsed. A pixel is on it when its noise takes it there, so a level's
    share of such pixels is the normal tail beyond the plateau; at the top code they are counted.
    """
    open_levels = np.flatnonzero(fraction_max <= SEEN_FRACTION)
    end = ResponseEnd(int(open_levels[-1]) + 1 if open_levels.size else 0, bool((fraction_max > SATURATED_FRACTION).any()))
    once, place = np.unique(light, return_inverse=True)
    if once.size < 3 or fraction_max[-1] >= 0.5:
        return end
    mean, var, spatial = (np.bincount(place, values) / np.bincount(place) for values in (mean_dn, var_dn2, spatial_dn2))
    log, last = np.log(once), once.size - 1
    lower = np.searchsorted(log, log[1:] - np.log(CHORD), side="right") - 1
    lower = np.maximum(lower, 0)
    steepest = ((mean[1:] - mean[lower]) / (log[1:] - log[lower])).max()
    flat = mean[last] - mean[:last] < FLAT * steepest * (log[last] - log[:last])
    far = log[:last] <= log[last] - np.log(END_CHORD)
    expected = (var * (once / once[last]) ** STEEPEST_FALL)[once >= once[last] / NEAR].max()
    if not flat[far][-1:].any() and not var[last] < COLLAPSED * expected:
        return end
    first = last if flat.all() or not flat.any() else int(np.flatnonzero(~flat)[-1]) + 1
    near = np.arange(once.size) >= min(np.searchsorted(once, once[first] / NEAR), max(first - 2, 0))
    noise = float(np.sqrt((var + np.maximum(spatial, 0.0))[near].max()))
    free = np.flatnonzero(mean[last] - mean_dn >= SEEN_DEVIATE * noise)
    seen = int(free[-1]) + 1 if free.size else 0
    return ResponseEnd(min(seen, end.seen), end.clips, float(mean[last]), noise)
