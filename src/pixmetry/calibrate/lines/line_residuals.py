"""What positions along straight lines leave over: their size along x and y, how far they are independent, and a test of x against y."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pixmetry.calibrate.records import LinesFTest

LAGS = 20
SIGNIFICANT = 3.29  # standard deviations: 1e-3, two-sided


@dataclass(frozen=True)
class AxisResiduals:
    """Residuals across the lines that determine x, or y.

    Parameters
    ----------
    rms_px, rms_um : float
        Square root of the sum of squares over ``dof``; ``rms_um`` is None without a pitch.
    n, lines : int
        Positions and lines.
    dof : float
        Degrees of freedom if all positions were independent: the sum of their redundancy numbers, n − 2 for every line, less the lens'.
    dof_effective : float
        dof / (1 + 2 Σ ρ_k²): those of a variance of values whose correlation with their k-th neighbour is ρ_k.
    correlation : ndarray, shape (LAGS,)
        ρ_k, free of what the straight line itself makes; less where lines are short.
    pairs : ndarray, shape (LAGS,)
        How many pairs it is made of.
    """

    rms_px: float
    rms_um: float | None
    n: int
    lines: int
    dof: float
    dof_effective: float
    correlation: np.ndarray
    pairs: np.ndarray

    @property
    def dof_of(self) -> dict[str, float]:
        """By how careful one is: every position, effective, one for each line (were a line's errors all one)."""
        return {"positions": self.dof, "effective": self.dof_effective, "lines": float(self.lines)}

    def to_record(self) -> dict[str, Any]:
        """Plain record for JSON."""
        return {
            "rms_px": self.rms_px,
            "rms_um": self.rms_um,
            "n": self.n,
            "lines": self.lines,
            "dof": self.dof_of,
            "correlation": self.correlation.tolist(),
        }


def axis_residuals(
    residual_px: np.ndarray, residual_um: np.ndarray | None, redundancy: np.ndarray, line_of: np.ndarray, along: np.ndarray
) -> AxisResiduals:
    """Sum up residuals; all arrays of shape (n,), ``along`` is the place along the line in any unit."""
    dof = float(redundancy.sum())
    lines = np.unique(line_of)
    products, pairs, made = np.zeros(LAGS), np.zeros(LAGS), np.zeros(LAGS)
    square = free = 0.0
    for line in lines:
        mine = np.flatnonzero(line_of == line)
        mine = mine[np.argsort(along[mine])]
        v, t = residual_px[mine], along[mine] - along[mine].mean()
        n, moment = len(mine), float(t @ t)
        square += float(v @ v)
        free += n - 2
        for k in range(1, min(LAGS, n // 4) + 1):
            products[k - 1] += v[k:] @ v[:-k]
            pairs[k - 1] += n - k
            made[k - 1] -= (n - k) / n + t[k:] @ t[:-k] / moment  # what a straight line fitted to white noise leaves
    variance = square / free if free > 0 else np.nan
    kept = pairs > 0
    with np.errstate(invalid="ignore"):
        correlation = (products[kept] / variance - made[kept]) / pairs[kept]
    rms_um = None if residual_um is None else float(np.sqrt(np.sum(residual_um**2) / dof))
    rms_px = float(np.sqrt(np.sum(residual_px**2) / dof))
    share = effective_share(correlation, pairs[kept])
    return AxisResiduals(rms_px, rms_um, len(residual_px), len(lines), dof, dof * share, correlation, pairs[kept])


def effective_share(correlation: np.ndarray, pairs: np.ndarray) -> float:
    """Effective over nominal degrees of freedom of a variance: 1/(1 + 2 Σ ρ_k²).

    G. V. Bayley, J. M. Hammersley, Suppl. J. R. Stat. Soc. 8 (1946) 184–197. The sampling variance 1/pairs of each ρ_k is taken off.
    """
    excess = float(np.sum(correlation**2 - 1 / pairs)) if len(pairs) else 0.0
    return 1 / (1 + 2 * max(excess, 0.0))


def correlation_inflation(axis: AxisResiduals) -> float:
    """Factor on variances of slow functions along the lines: 1 + 2 Σ ρ_k up to the first neighbour that is not correlated; at least 1."""
    if not len(axis.pairs):
        return 1.0
    low = np.flatnonzero(axis.correlation < SIGNIFICANT / np.sqrt(axis.pairs))
    first = low[0] if len(low) else len(axis.pairs)
    return float(1 + 2 * axis.correlation[:first].sum())


def pooled(axes: Sequence[AxisResiduals]) -> AxisResiduals:
    """Residuals of several calibrations as one."""
    dof = np.array([a.dof for a in axes])
    lags = min(len(a.pairs) for a in axes)
    pairs = np.sum([a.pairs[:lags] for a in axes], axis=0)
    weight = np.array([a.rms_px**2 for a in axes])[:, None] * np.array([a.pairs[:lags] for a in axes])
    correlation = np.sum(weight * np.array([a.correlation[:lags] for a in axes]), axis=0) / weight.sum(axis=0) if lags else np.zeros(0)
    um = None if any(a.rms_um is None for a in axes) else float(np.sqrt(dof @ np.array([a.rms_um for a in axes]) ** 2 / dof.sum()))
    px = float(np.sqrt(dof @ np.array([a.rms_px for a in axes]) ** 2 / dof.sum()))
    share = effective_share(correlation, pairs)
    lines, n = sum(a.lines for a in axes), sum(a.n for a in axes)
    return AxisResiduals(px, um, n, lines, float(dof.sum()), float(dof.sum() * share), correlation, pairs)


def compare_axes(x: AxisResiduals, y: AxisResiduals) -> LinesFTest:
    """One-sided F-test of x against y: line jitter can only make x worse."""
    from pixmetry.calibrate.checks.quality import f_test

    dof = {name: (x.dof_of[name], y.dof_of[name]) for name in x.dof_of}
    px = {name: f_test(x.rms_px**2, y.rms_px**2, *d) for name, d in dof.items()}
    um = None
    if x.rms_um is not None and y.rms_um is not None:
        um = {name: f_test(x.rms_um**2, y.rms_um**2, *d) for name, d in dof.items()}
    in_um = "" if um is None else f", {um['lines'][0]:.3f} in µm² (p = {um['lines'][2]:.2g})"
    text = (
        f"Variance along x over that along y: {px['lines'][0]:.3f} in px² (p = {px['lines'][2]:.2g}){in_um}; one-sided, one degree of "
        f"freedom for each line ({dof['lines'][0]:.0f}, {dof['lines'][1]:.0f}), critical value {px['lines'][1]:.3f} at 5 %."
    )
    critical, p_px = ({name: found[k] for name, found in px.items()} for k in (1, 2))
    p_um = None if um is None else {name: found[2] for name, found in um.items()}
    ratio_um2 = None if um is None else um["lines"][0]
    return LinesFTest(px["lines"][0], ratio_um2, dof, critical, p_px, p_um, "x above y", text)
