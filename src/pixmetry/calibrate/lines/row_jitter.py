"""Line jitter in nanoseconds, from what positions on lines scatter: x against y, or what all lines share in one row of one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pixmetry.calibrate.lines.line_residuals import AxisResiduals
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates


@dataclass(frozen=True)
class Sampling:
    """How a delay of the line becomes a shift of a position.

    Parameters
    ----------
    pixel_time_ns : float
        Time between two samples of the line.
    rows : float
        Rows that were averaged into a position along x; their jitters are independent.
    gain : float
        By how many pixels a delay of one pixel moves a position: 1 for a line that is smooth between its samples, more where the line's
        steps have not settled when they are sampled.
    """

    pixel_time_ns: float
    rows: float = 1.0
    gain: float = 1.0

    def __post_init__(self) -> None:
        if not min(self.pixel_time_ns, self.rows, self.gain) > 0:
            value = (self.pixel_time_ns, self.rows, self.gain)
            raise InputError("jitter cannot be measured with this sampling", where="sampling", value=value, allowed="numbers above 0")

    @property
    def ns2_per_px2(self) -> float:
        """Variance of the rows' delays over that of positions."""
        return self.rows * (self.pixel_time_ns / self.gain) ** 2


@dataclass(frozen=True)
class RowVariance:
    """One-way analysis of variance of positions on several lines, grouped by rows.

    H. Scheffé, The Analysis of Variance (1959), 7.2: with m lines, ``between`` has the expectation w + m c and ``within`` w, where c is
    the variance that is common to a row and w the rest.

    Parameters
    ----------
    between_px2, within_px2 : float
        Mean squares.
    dof : (float, float)
        Their degrees of freedom.
    lines : int
    """

    between_px2: float
    within_px2: float
    dof: tuple[float, float]
    lines: int

    @classmethod
    def of(cls, position_px: np.ndarray, *, free_share: float = 1.0, repeated: bool = False) -> RowVariance:
        """From residuals across lines.

        Parameters
        ----------
        position_px : ndarray, shape (frames, lines, rows)
            Rows with a NaN on one of the lines are left out.
        free_share : float
            Share of the variance that is left in residuals after a fit: (n − 2)/n for a straight line through n positions.
        repeated : bool
            Whether the frames show the same, so that the mean over the frames is taken off: then what is fixed does not count.
        """
        v = np.asarray(position_px, float)
        if v.ndim != 3 or v.shape[1] < 2 or (repeated and v.shape[0] < 2) or not 0 < free_share <= 1:
            allowed = "(frames, lines, rows) with two lines at least, and two frames if repeated; a share of 0 to 1"
            raise InputError("no rows to compare", where="row jitter", value=v.shape, allowed=allowed)
        if repeated:
            v, free_share = v - v.mean(axis=0), free_share * (1 - 1 / v.shape[0])
        m = v.shape[1]
        v = np.moveaxis(v, 1, 2).reshape(-1, m)
        v = v[np.isfinite(v).all(axis=1)]
        if not len(v):
            raise InputError("no row has a position on every line", where="row jitter", remedy="leave out lines that leave the frame")
        dof = len(v) * free_share, len(v) * free_share * (m - 1)
        mean = v.mean(axis=1, keepdims=True)
        return cls(float(m * np.sum(mean**2) / dof[0]), float(np.sum((v - mean) ** 2) / dof[1]), dof, m)

    @classmethod
    def pooled(cls, parts: Sequence[RowVariance]) -> RowVariance:
        """Several tables as one; all with as many lines."""
        b, w = (np.array([p.dof[k] for p in parts]) for k in (0, 1))
        between = float(b @ [p.between_px2 for p in parts] / b.sum())
        within = float(w @ [p.within_px2 for p in parts] / w.sum())
        return cls(between, within, (float(b.sum()), float(w.sum())), parts[0].lines)

    def jitter(self, sampling: Sampling) -> Estimates:
        """``jitter_ns`` from what the lines share in a row; an upper limit (one-sided 95 %) where that is not significant."""
        m = self.lines
        u = np.hypot(self.between_px2 * np.sqrt(2 / self.dof[0]), self.within_px2 * np.sqrt(2 / self.dof[1])) / m
        method = "analysis of variance: common part of the positions of several lines in one row"
        confounders = ("patterns fixed to rows",)
        return _estimate((self.between_px2 - self.within_px2) / m, u, self.within_px2 / m, self.dof, sampling, method, confounders)


def jitter_from_axes(
    x: AxisResiduals,
    y: AxisResiduals,
    sampling: Sampling,
    *,
    kind: str = "effective",
    noise_ratio: float = 1.0,
    jitter_dof: float | None = None,
) -> Estimates:
    """Line jitter from residuals along x (of lines along y) against those along y.

    Parameters
    ----------
    x, y : AxisResiduals
    sampling : Sampling
    kind : {"positions", "effective", "lines"}
        Which degrees of freedom to use.
    noise_ratio : float
        Variance along x over that along y (px²) that the positions would have without jitter.
    jitter_dof : float, optional
        Degrees of freedom of the jitter's own part, where lines share rows: the number of different rows. By default that of x.

    Returns
    -------
    Estimates
        ``jitter_ns``, an upper limit (one-sided 95 %) where the F-test finds x no worse than y.

    Notes
    -----
    σ_j² = (s_x² − R s_y²) · rows · (T/gain)². With c the jitter's part of s_x² and w the rest, the variance of s_x² is
    2 c²/ν_j + 4 c w/ν_x + 2 w²/ν_x. The limit is that of the variance ratio: s_x²/(R s_y²) over the 95 % lower point of F.
    """
    dof = x.dof_of[kind], y.dof_of[kind]
    whole, rest = x.rms_px**2, noise_ratio * y.rms_px**2
    c, w = max(whole - rest, 0.0), min(whole, rest)
    u2 = 2 * c**2 / (jitter_dof or dof[0]) + (4 * c * w + 2 * w**2) / dof[0] + 2 * rest**2 / dof[1]
    method = "variance along x minus that along y, positions on straight lines"
    confounders = ("different noise along x and y", "different patterns along x and y")
    return _estimate(whole - rest, np.sqrt(u2), rest, dof, sampling, method, confounders)


def _estimate(
    variance: float, u: float, unit: float, dof: tuple[float, float], sampling: Sampling, method: str, confounders: tuple[str, ...]
) -> Estimates:
    """From a variance in px² and its standard uncertainty; in units of ``unit`` it is F − 1."""
    from scipy.stats import f

    ratio, critical = 1 + variance / unit, float(f.isf(0.05, *dof))
    to_ns2 = sampling.ns2_per_px2
    best = float(np.sqrt(max(variance, 0.0) * to_ns2))
    limit = float(np.sqrt((max(ratio, 1.0) / f.isf(0.95, *dof) - 1) * unit * to_ns2))  # chance below 1 makes it no better
    if ratio > critical:
        row = ("jitter_ns", best, float(u * to_ns2 / (2 * best)), float((variance / u) ** 2 / 2), "ns")
        reasons = {"jitter_ns": f"at most {limit:.2f} ns (one-sided 95 %)"}
        return Estimates.from_rows([row], method=method, confounders=confounders, reasons=reasons)
    row = ("jitter_ns", limit, (limit - best) / 1.645, 1.0, "ns")
    reason = f"F = {ratio:.3f} is not above {critical:.3f} (5 %, one-sided, {dof[0]:.0f} and {dof[1]:.0f} degrees of freedom)"
    told = {"limits": frozenset({"jitter_ns"}), "reasons": {"jitter_ns": reason}}
    return Estimates.from_rows([row], method=method, confounders=confounders, **told)
