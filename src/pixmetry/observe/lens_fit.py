"""A lens limited by diffraction as the rival of a Gaussian one: which of them describes slanted edges, and its f-number.

The frequency response of a clear circular pupil ends at 1/(λN), that of a Gaussian never does. So the edges tell the two apart where they
are sharp enough, and the product λN is a length that no pixel aperture can imitate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates
from pixmetry.observe.edge_curves import BIN_PX, LEFT_PX, EdgeCurve, curves_of
from pixmetry.observe.edges import Region, Spread

PERIOD_PX = 128.0  # of the square wave that stands for an edge
MOST_FREQUENCY = 6.0  # cycles/px
NODE, WEIGHT = np.polynomial.legendre.leggauss(48)  # of the integral over the common part of two pupils
BETTER_CHI2 = 25.0  # by which χ² must be less than that of the Gaussian lens, and fall with a defocus
NEAR_PX, MISFIT = 2.0, 6.0  # χ² per bin so near to the edge, from which on they follow neither; below it, u grows with its root
WELL_FITTED, BETTER_NEAR = 2.0, 0.5  # above that χ² per bin, diffraction must have less than this part of that of the Gaussian lens
LARGEST_U_A = 0.2  # of a width of the pixel that is given
STEP = 1e-6  # of differences, px or waves
STARTS_AIRY, START_A, START_W = (0.4, 1.2), 0.85, 0.1
METHOD = "joint fit of a diffraction-limited lens and a rectangular aperture to slanted edges"


def defocused_response(s: Array, waves: float) -> Array:
    """Frequency response of a circular pupil with a defocus.

    Parameters
    ----------
    s : ndarray
        λNν: 1 at the limit.
    waves : float
        Zernike coefficient of √3 (2ρ² − 1), root mean square, as in `optics.point_spread`.

    Notes
    -----
    The pupil against itself, moved by 2s (H. H. Hopkins, Proc. R. Soc. A 231, 1955, 91): the aberrations differ by 8√3 W s x, so that
    OTF = (4/π) ∫ √(1 − (x + s)²) cos(16√3 π W s x) dx from 0 to 1 − s; with x + s = sin t by Gauss and Legendre.
    """
    s = np.minimum(np.abs(np.asarray(s, float)), 1.0)
    low = np.arcsin(s)
    half = 0.5 * (0.5 * np.pi - low)
    t = low[..., None] + half[..., None] * (NODE + 1)
    x = np.sin(t) - s[..., None]
    phase = 16 * np.sqrt(3) * np.pi * waves * s[..., None] * x
    out: Array = 4 / np.pi * (np.cos(t) ** 2 * np.cos(phase) * half[..., None]) @ WEIGHT
    return out


@dataclass(frozen=True)
class _LensFit:
    """A fit: lens and aperture, their covariance (without scale), χ² and degrees of freedom."""

    values: Array
    covariance: Array
    chi2: float
    dof: int
    near: float  # χ² per bin near the edges, where the lens shows


class _Drawn:
    """A curve, whitened, as a linear map of the spectrum of an edge; what no spectrum can reach is left out of it."""

    def __init__(self, curve: EdgeCurve) -> None:
        self.nu = np.asarray(np.arange(1, MOST_FREQUENCY * PERIOD_PX, 2) / PERIOD_PX, float)
        wave = 2 * np.exp(2j * np.pi * self.nu * curve.place_px[:, None]) / (1j * np.pi * self.nu * PERIOD_PX) * np.sinc(BIN_PX * self.nu)
        root = curve.whitener
        drawn = np.concatenate([root @ wave.real, -(root @ wave.imag)], axis=1)
        ones, value = root @ np.ones(len(curve.value)), root @ curve.value
        basis, size, _ = np.linalg.svd(np.column_stack([drawn, ones]), full_matrices=False)
        basis = basis[:, size > 1e-3]
        self.basis, self.near = basis, np.abs(curve.place_px) < NEAR_PX
        self.map, self.ones, self.value = basis.T @ drawn, basis.T @ ones, basis.T @ value
        self.rest, self.n = float(value @ value - self.value @ self.value), len(value)
        self.tilt, self.main = abs(curve.slope), 0 if curve.across == "x" else 1

    def share(self, lens: Array, a: Array, place: float) -> Array:
        """Part of the step that each value shows, behind a lens and an aperture."""
        nu = self.nu
        spectrum = lens * np.sinc(a[self.main] * nu) * np.sinc(a[1 - self.main] * nu * self.tilt) * np.exp(-2j * np.pi * nu * place)
        out: Array = self.map @ np.concatenate([spectrum.real, spectrum.imag]) + 0.5 * self.ones
        return out

    def residual(self, lens: Array, a: Array, own: Array) -> Array:
        """Of a lens, an aperture, and the edge's own place, level and height."""
        out: Array = self.value - own[1] * self.ones - own[2] * self.share(lens, a, float(own[0]))
        return out


Lens = Callable[[Array, Array], Array]  # (frequency along the normal, parameters) -> response


def _gaussian(nu: Array, p: Array) -> Array:
    return np.asarray(np.exp(-2 * (np.pi * p[0] * nu) ** 2), float)


def _diffraction(nu: Array, p: Array) -> Array:
    return defocused_response(p[0] * nu, float(p[1]) if len(p) > 1 else 0.0)


def _fit(curves: Sequence[_Drawn], lens: Lens, starts: Sequence[Array], low: Sequence[float], high: Sequence[float], k: int) -> _LensFit:
    """Least squares from several starts of (lens, aperture); the best."""
    from scipy.optimize import least_squares

    ends = np.cumsum([0, *(c.basis.shape[1] for c in curves)])

    def parts(p: Array) -> list[Array]:
        own = p[k + 2 :].reshape(-1, 3)
        return [c.residual(lens(c.nu * np.hypot(1, c.tilt), p[:k]), p[k : k + 2], o) for c, o in zip(curves, own, strict=True)]

    def residuals(p: Array) -> Array:
        return np.concatenate(parts(p))

    def jacobian(p: Array) -> Array:
        """By differences; place, level and height of a curve concern that curve alone."""
        now, out = residuals(p), np.zeros((ends[-1], len(p)))
        for j in range(k + 2):
            step = STEP if p[j] < highs[j] - STEP else -STEP
            out[:, j] = (residuals(np.concatenate([p[:j], [p[j] + step], p[j + 1 :]])) - now) / step
        for i, c in enumerate(curves):
            rows, (place, _, height) = slice(ends[i], ends[i + 1]), p[k + 2 + 3 * i : k + 5 + 3 * i]
            light = lens(c.nu * np.hypot(1, c.tilt), p[:k])
            share, moved = (c.share(light, p[k : k + 2], float(place) + by) for by in (0.0, STEP))
            out[rows, k + 2 + 3 * i : k + 5 + 3 * i] = np.stack([-height * (moved - share) / STEP, -c.ones, -share], axis=1)
        return out

    each = np.array([0.0, 0.0, 1.0] * len(curves))
    lows, highs = np.append(low, [-3.0, -0.3, 0.5] * len(curves)), np.append(high, [3.0, 0.3, 1.5] * len(curves))
    begins = [np.clip(np.append(s, each), lows, highs) for s in starts]
    found = [least_squares(residuals, b, jacobian, bounds=(lows, highs), x_scale="jac", max_nfev=60) for b in begins]
    best = min(found, key=lambda f: float(f.cost))
    n = sum(c.n for c in curves)
    covariance = np.linalg.pinv(best.jac.T @ best.jac, rcond=1e-14, hermitian=True)[: k + 2, : k + 2]
    chi2 = 2 * float(best.cost) + sum(c.rest for c in curves)
    bins = np.concatenate([(c.basis @ r)[c.near] for c, r in zip(curves, np.split(best.fun, ends[1:-1]), strict=True)])
    near = float(bins @ bins) / max(len(bins) - len(best.x), 1)
    return _LensFit(np.asarray(best.x[: k + 2], float), np.asarray(covariance, float), chi2, max(n - len(best.x), 1), near)


def fit_diffraction(measured: Sequence[tuple[Region, Spread]]) -> Estimates:
    """Fit a diffraction-limited lens, and say whether it describes the edges better than a Gaussian one.

    Parameters
    ----------
    measured : sequence of (Region, Spread)
        The edges, as `pixmetry.observe.edges` finds them.

    Returns
    -------
    Estimates
        ``airy_px`` (λN over the pixel pitch), ``width_x_px``, ``width_y_px`` where their u is below 0.2, and ``defocus_waves`` (its size;
        edges do not show the sign) if χ² falls by 25 with it. Empty where the Gaussian lens is not worse by 25, where neither describes
        the edges, and of edges of one direction alone; ``confounders`` tell where both do. Pixels are taken as square.
    """
    curves = curves_of(measured, LEFT_PX)
    if {c.across for c in curves} != {"x", "y"}:
        return Estimates.empty()
    drawn = [_Drawn(c) for c in curves]
    gauss = _fit(drawn, _gaussian, [np.array([s, START_A, START_A]) for s in (0.3, 0.7)], [0.02, 0.05, 0.05], [5, 1.3, 1.3], 1)
    starts = [np.array([airy, START_A, START_A]) for airy in STARTS_AIRY]
    clear = _fit(drawn, _diffraction, starts, [0.05, 0.05, 0.05], [8, 1.3, 1.3], 1)
    starts = [np.array([part * clear.values[0], START_W, *clear.values[1:]]) for part in (1.0, 0.7)]
    blurred = _fit(drawn, _diffraction, starts, [0.05, 0.0, 0.05, 0.05], [8, 0.5, 1.3, 1.3], 2)
    scale = max(min(f.chi2 / f.dof for f in (gauss, clear, blurred)), 1.0)
    best = blurred if clear.chi2 - blurred.chi2 > BETTER_CHI2 * scale else clear
    if best.near > MISFIT or best.near > max(WELL_FITTED, BETTER_NEAR * gauss.near) and gauss.chi2 > best.chi2:
        return Estimates.empty()  # neither lens describes the edges, and the one of more parameters comes a little nearer
    if gauss.chi2 - best.chi2 < BETTER_CHI2 * scale:
        alike = best.chi2 - gauss.chi2 < BETTER_CHI2 * scale
        x, y = best.values[-2:]
        rival = f"a lens limited by diffraction, λN = {best.values[0]:.2f} px, in front of a pixel of {x:.2f} × {y:.2f} of its pitch"
        return replace(Estimates.empty(), confounders=(rival,) if alike else ())
    names = ("airy_px", *(("defocus_waves",) if best is blurred else ()), "width_x_px", "width_y_px")
    units = tuple("waves" if name == "defocus_waves" else "px" for name in names)
    covariance = best.covariance * max(best.near, 1.0)
    whole = Estimates(names, best.values, covariance, np.full(len(names), float(best.dof)), units, METHOD)
    hidden = [name for name in names if name.startswith("width") and whole[name].u > LARGEST_U_A]
    why = "the lens hides the aperture: focus better, or take more edges with less noise"
    told = whole.select([name for name in names if name not in hidden])
    return replace(told, reasons=dict.fromkeys(hidden, why))


def with_other_lens(gaussian: Estimates, measured: Sequence[tuple[Region, Spread]]) -> Estimates:
    """The optics by the model of the lens that describes the edges: the Gaussian fit, or that of a diffraction-limited lens.

    Where the Gaussian fit gave way to a filter behind the pixels, which a lens is no rival of, it stays.
    """
    if "spread_var_px2" not in gaussian or "separation_x_px" in gaussian and "separation_x_px" not in gaussian.limits:
        return gaussian
    if "correlated" in gaussian.reasons.get("spread_var_px2", ""):
        return gaussian
    found = fit_diffraction(measured)
    if not len(found):
        return replace(gaussian, confounders=(*gaussian.confounders, *found.confounders))
    v = gaussian.select(["spread_var_px2"])
    limited = {"spread_var_px2": "of the middle of the edges: diffraction has no variance", "sigma_px": "the lens is no Gaussian"}
    return replace(found.join(replace(v, reasons={})), reasons={**found.reasons, **limited}, method=METHOD)
