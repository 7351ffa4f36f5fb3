"""Mean curves of slanted edges that cross the rows (or columns) at nearly one angle: what a fit of the whole chain needs of their pixels.

Along the row everything behind the pixels acts at whole pixels, at any angle of the edge. So the pixels are binned by their distance from
the edge along the row, not along its normal. The edges of one direction and of nearly one slope make one curve from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pixmetry.core.arrays import Array, Flags, Ints
from pixmetry.observe._edge_kernels import bin_edge
from pixmetry.observe.edges import Region, Spread, pixels_of

BIN_PX = 0.125
LEFT_PX = 12.0  # before the edge
SLOPES_ALIKE = 0.012  # columns per row: edges within that are one curve
MOST_LAG = 6  # px, of the noise's autocovariance
WHITE_SHARE = 0.02  # of the variance that is white at least, so that no frequency counts as free of noise
LEAST_FILLED = 2  # pixels in a bin, on average, below which it is left out


@dataclass(frozen=True)
class EdgeCurve:
    """The mean of the edges of one direction and nearly one slope.

    Parameters
    ----------
    across : {"x", "y"}
        What the step goes along.
    slope : float
        Columns per row of the edge (rows per column, across y), the mean of all.
    place_px : ndarray, shape (n,)
        Distances along the row (column) from the edges' common place.
    value : ndarray, shape (n,)
        0 to the left of the edge, 1 to its right, of bins of `BIN_PX`.
    covariance : ndarray, shape (n, n)
        Of the values.
    edges, rows : int
    jitter_px2 : float
        Variance of the rows' places about a smooth line, less what the noise makes of it: known of steps along x only, else 0.
    u_jitter_px2 : float
    """

    across: str
    slope: float
    place_px: Array
    value: Array
    covariance: Array
    edges: int
    rows: int
    jitter_px2: float
    u_jitter_px2: float

    @cached_property
    def whitener(self) -> Array:
        """A matrix W with Wᵀ W the inverse of the covariance."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)), float)


def curves_of(measured: Sequence[tuple[Region, Spread]], right_px: float) -> tuple[EdgeCurve, ...]:
    """Reduce edges to mean curves.

    Parameters
    ----------
    measured : sequence of (Region, Spread)
        The edges, as `pixmetry.observe.edges` finds them.
    right_px : float
        How far to the right of steps along x pixels are wanted; edges with another one nearer than that take part as far as they reach.

    Returns
    -------
    tuple of EdgeCurve

    Notes
    -----
    Each edge is brought to the mean of all by its place and its two levels (linear least squares, two turns). What they have in common is
    left to the fit. The covariance follows from the variance of the pixels on both sides, the autocorrelation of the noise along the
    row, up to 6 px, and the jitter of the rows.
    """
    correlation = _correlation_along_rows(measured)
    curves = []
    for across in "xy":
        own = sorted((m for m in measured if m[0].across == across), key=lambda m: m[0].slope)
        while own:
            group = [m for m in own if m[0].slope - own[0][0].slope <= SLOPES_ALIKE]
            own = own[len(group) :]
            curve = _curve(group, right_px if across == "x" else LEFT_PX, correlation)
            if curve is not None:
                curves.append(curve)
    return tuple(curves)


def _correlation_along_rows(measured: Sequence[tuple[Region, Spread]]) -> Array:
    """Autocorrelation of the noise along the rows of the frame at 0 to `MOST_LAG` px, from pixels away from the edges."""
    sums = np.zeros((MOST_LAG + 1, 2))
    for region, spread in measured:
        value, distance = pixels_of(region)
        grid = spread.distance_px + 0.0
        residual = value - np.interp(distance, grid + _middle(spread), spread.value_dn)
        residual[np.abs(distance) < 3] = np.nan
        along = residual if region.across == "x" else residual.T  # rows of the frame
        for lag in range(MOST_LAG + 1):
            if along.shape[1] <= lag:
                continue
            product = along[:, lag:] * along[:, : along.shape[1] - lag]
            known = np.isfinite(product)
            scale = spread.noise_dn**2
            sums[lag] += product[known].sum() / scale, known.sum()
    mean = sums[:, 0] / np.maximum(sums[:, 1], 1)
    correlation = mean / mean[0] if mean[0] > 0 else np.eye(1, MOST_LAG + 1)[0]
    taper = 1 - np.arange(MOST_LAG + 1) / (2 * MOST_LAG)
    small = np.abs(correlation) < 3 / np.sqrt(np.maximum(sums[:, 1], 1))
    return np.asarray(np.where(small, 0.0, correlation * np.where(np.arange(MOST_LAG + 1) > 0, taper, 1.0)), float)


def _middle(spread: Spread) -> float:
    """Where the bins of a spread have their middle, from the place of half of the step: its distances are counted from that."""
    return float(-0.5 * (spread.distance_px[0] + spread.distance_px[-1]))


@dataclass
class _Binned:
    """One edge in bins along the row: pixels, their mean, mean distance from the bins' middles; levels and place within the group."""

    count: Array
    mean: Array
    away: Array
    variances: tuple[float, float]
    low: float
    height: float
    shift: float = 0.0


def _binned(region: Region, spread: Spread, bins: int, half: float) -> _Binned:
    sums = np.zeros((4, bins))
    bin_edge(region.frame, region.first, region.centre, half, 1.0, BIN_PX, sums)
    n = np.maximum(sums[0], 1)
    return _Binned(sums[0], sums[1] / n, sums[2] / n, spread.variances_dn2, spread.low_dn, spread.height)


def _curve(group: Sequence[tuple[Region, Spread]], right_px: float, correlation: Array) -> EdgeCurve | None:
    rows = np.array([r.rows for r, _ in group], float)
    reach = np.array([min(r.right_px / r.cosine, right_px) for r, _ in group])
    # the farthest that most of the rows reach
    order = np.argsort(reach)
    right = float(reach[order][np.searchsorted(np.cumsum(rows[order]), 0.3 * rows.sum())])
    kept = [m for m, far in zip(group, reach, strict=True) if far >= right - 1e-9]
    half = np.floor(max(right, LEFT_PX) / BIN_PX) * BIN_PX
    bins = 2 * int(half / BIN_PX) + 1
    place = np.asarray((np.arange(bins) - 0.5 * (bins - 1)) * BIN_PX, float)
    inside = (place >= -LEFT_PX) & (place <= right)
    edges = [_binned(r, s, bins, half + BIN_PX) for r, s in kept]
    for _ in range(3):
        value, count, variance = _mean_curve(edges)
        _bring_together(edges, value, place, inside)
    value, count, variance = _mean_curve(edges)
    share = sum(e.count for e in edges) / len(edges)
    filled = inside & (share * len(edges) >= LEAST_FILLED) & np.isfinite(value)
    if filled.sum() < 8 * LEFT_PX:
        return None
    slope = float(np.average([r.slope for r, _ in kept], weights=[r.rows for r, _ in kept]))
    at = np.asarray(np.flatnonzero(filled), np.int64)
    covariance = _covariance(at, variance[at], correlation, slope if kept[0][0].across == "y" else 1.0)
    jitter, u_jitter = 0.0, 0.0
    if kept[0][0].across == "x":
        jitter, u_jitter = _jitter(kept, value, correlation)
        moved = _moved_by_rows([r for r, _ in kept], edges, value, half)[at]
        covariance += jitter * moved @ moved.T
    total_rows = int(sum(r.rows for r, _ in kept))
    return EdgeCurve(kept[0][0].across, slope, place[at], value[at], covariance, len(kept), total_rows, jitter, u_jitter)


def _mean_curve(edges: Sequence[_Binned]) -> tuple[Array, Array, Array]:
    """Weighted mean of normalised edges at the bins' middles, number of pixels, and the variance of white noise of each bin."""
    total, weighed, away, squares = np.zeros((4, len(edges[0].count)))
    for e in edges:
        share = np.clip((e.mean - e.low) / e.height, 0, 1)
        var = (e.variances[0] + (e.variances[1] - e.variances[0]) * share) / e.height**2
        weight = e.count / np.mean(e.variances) * e.height**2
        total = total + weight
        weighed = weighed + weight * (e.mean - e.low) / e.height
        away = away + weight * (e.away - e.shift)
        squares = squares + weight**2 / np.maximum(e.count, 1) * var
    full = np.maximum(total, 1e-300)
    value, away = weighed / full, away / full
    at = np.arange(len(full))
    known = total > 0
    value = np.interp(at, at[known], value[known])
    curve = value
    for _ in range(2):
        curve = value - away * np.gradient(curve, BIN_PX)
    return np.asarray(curve, float), np.asarray(total, float), np.asarray(squares / full**2, float)


def _bring_together(edges: Sequence[_Binned], value: Array, place: Array, inside: Flags) -> None:
    """Fit place and levels of each edge to the mean curve."""
    steep = np.gradient(value, BIN_PX)
    for e in edges:
        at = inside & (e.count > 0)
        near = value + (e.away - e.shift) * steep
        matrix = np.stack([np.ones(at.sum()), near[at], -steep[at] * e.height], axis=1)
        root = np.sqrt(e.count[at])
        low, height, more = np.linalg.lstsq(matrix * root[:, None], e.mean[at] * root, rcond=None)[0]
        e.low, e.height, e.shift = float(low), float(height), float(e.shift + more)
    mean = float(np.mean([e.shift for e in edges]))
    for e in edges:
        e.shift -= mean


def _covariance(at: Ints, variance: Array, correlation: Array, px_per_px: float) -> Array:
    """Of bins: a pixel's neighbour along the frame's row lies so many px on, along the direction of the bins."""
    n = len(at)
    share = np.zeros((n, n))
    apart = at[None, :] - at[:, None]
    for lag in range(-MOST_LAG, MOST_LAG + 1):
        r = correlation[abs(lag)]
        if r:
            share += r * np.maximum(0.0, 1 - np.abs(apart - lag * px_per_px / BIN_PX))
    share *= 1 - WHITE_SHARE
    share[np.diag_indices(n)] += WHITE_SHARE
    root = np.sqrt(variance)
    out: Array = share * np.outer(root, root)
    lowest = float(np.linalg.eigvalsh(share)[0])
    if lowest < WHITE_SHARE / 2:  # an estimated autocorrelation need not be one of a process
        out[np.diag_indices(n)] += (WHITE_SHARE - lowest) * variance
    return out


def _moved_by_rows(regions: Sequence[Region], edges: Sequence[_Binned], value: Array, half: float) -> Array:
    """Change of the mean curve by 1 px of shift of each row of the pictures, shape (bins, rows); a row moves all edges that it crosses.

    A row has a pixel in every eighth bin alone, so that its shift is noise of these bins, and no blur of the mean.
    """
    bins = len(value)
    number = {key: i for i, key in enumerate(sorted({(r.picture, r.first + k) for r in regions for k in range(r.rows)}))}
    out, total = np.zeros((bins, len(number))), np.zeros(bins)
    for region, e in zip(regions, edges, strict=True):
        weight = e.height**2 / np.mean(e.variances)
        total += weight * e.count
        for k, centre in enumerate(region.centre):
            low, high = max(int(np.ceil(centre - half)), 0), min(int(np.floor(centre + half)), region.frame.shape[1] - 1)
            b = np.floor((np.arange(low, high + 1) - centre) / BIN_PX + 0.5 * (bins - 1) + 0.5).astype(int)
            out[b[(b >= 0) & (b < bins)], number[region.picture, region.first + k]] += weight
    steep = np.gradient(value, BIN_PX)
    moved: Array = out * (steep / np.maximum(total, 1e-300))[:, None]
    return moved


def _jitter(group: Sequence[tuple[Region, Spread]], value: Array, correlation: Array) -> tuple[float, float]:
    """Variance of the rows' places beyond noise, px², and its u."""
    steep = np.gradient(value, BIN_PX)
    lags = int(round(1 / BIN_PX)) * np.arange(MOST_LAG + 1)
    product = np.array([(steep[k:] * steep[: len(steep) - k]).sum() * BIN_PX for k in lags])
    of_noise = (correlation[0] * product[0] + 2 * (correlation[1:] * product[1:]).sum()) / product[0] ** 2
    excess, rows = 0.0, 0
    for region, spread in group:
        expected = of_noise * spread.noise_dn**2 / spread.height**2
        excess += region.rows * (region.scatter_px**2 - expected)
        rows += region.rows
    mean = excess / rows
    typical = float(np.mean([r.scatter_px**2 for r, _ in group]))
    return max(mean, 0.0), typical * float(np.sqrt(2 / rows))
