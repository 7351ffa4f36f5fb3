"""Lens, pixel and optical low-pass filter from the pixels of slanted edges, fitted together.

The edge spread has a closed form: a Gaussian (lens), a box of the light-sensitive part of the pixel, and the two or four images of a
birefringent plate. Place, bend and both levels are free for every edge; what the camera does is common to all. The variance of the spread,
v = σ² + a²/12 + d²/4, is always well determined. What shares in it, only where the edges are sharp enough: then the box and the plate have
zeros of their frequency response that a Gaussian has not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.core.threads import map_tiles
from pixmetry.observe._edge_kernels import edge_normal, edge_table
from pixmetry.observe.edges import Region, Spread, line_at, pixels_of

HALF_PX = 12.0  # pixels so far from each edge enter
TABLE_PX = 1 / 16  # step of the tables of the spread
REACH_PX = HALF_PX + 0.25
NAMES = ("spread_var_px2", "width_x_px", "width_y_px", "separation_x_px", "separation_y_px", "amount")
V, AX, AY, DX, DY, S = range(6)
LOWEST = np.array([1e-3, 0.05, 0.05, 0.02, 0.02, -1.0])  # of a plate that is free: at 0 nothing depends on it
HIGHEST = np.array([25.0, 1.5, 1.5, 4.0, 4.0, 2.0])  # of a width: more than the pixel, so that noise about a full pixel is not cut off
LEAST_SIGMA_PX = 0.03
MASK_PX, AMOUNT_U = (
    1.0,
    0.3,
)  # of a sharpening that nobody tells: its usual radius, and how strong it usually is (standard deviation about 0)
SHARPENED = 4.0  # u of its amount, from which on it is there
STARTS_A, STARTS_D = (0.6, 1.0), (0.5, 1.0, 1.5)  # widths and separations from which the fits begin
ITERATIONS, TRIAL_ITERATIONS, CONVERGED = 40, 7, 1e-3  # the last in χ²
MOST_ROWS = 4000  # of the edges of each direction that enter the fit
FOUND_CHI2 = 25.0  # by which χ² must fall for a source to count as present
SEARCH_STEP_PX = 0.02  # to which the widest possible plate is found
LARGEST_U_A = 0.2  # of a width that is given as a value
FILTERED_REL = 0.15  # correlation of the noise of neighbouring pixels, from which on they were filtered
MISFIT = 4.0  # χ² per bin of the mean residuals, from which on the model does not describe the edges
IMPOSSIBLE_U = 4.0  # by which a pixel may seem wider than its pitch
MISFIT_BINS_PX = 0.25
METHOD = "joint fit of a Gaussian, a rectangular aperture and a birefringent plate to the pixels of slanted edges"


@dataclass(frozen=True)
class _Edge:
    """The pixels of one edge, its line, and what of the camera lies along its normal."""

    values: Array
    place: Array
    line: Array
    levels: Array
    variances: Array
    main: int  # 0: a step along x; 1: along y
    coloured: float  # variance of a mean of pixels over that of independent ones

    @property
    def slope(self) -> float:
        """Columns per row in the middle."""
        return float(self.line[1] / (0.5 * (len(self.values) - 1)))


def fit_edges(measured: Sequence[tuple[Region, Spread]]) -> Estimates:
    """Fit what all edges have in common.

    Parameters
    ----------
    measured : sequence of (Region, Spread)
        The edges, as `pixmetry.observe.edges` finds them.

    Returns
    -------
    Estimates
        ``spread_var_px2`` (v, the mean of x and y) always, alone where another shape is seen. ``sigma_px`` of the Gaussian;
        ``width_x_px``, ``width_y_px`` of the aperture where their u is below 0.2; ``separation_x_px``, ``separation_y_px`` of the plate if
        χ² needs it, else as upper limits. Of a direction without edges there is nothing. Empty if there are no edges.

    Notes
    -----
    Levenberg–Marquardt on (v, a, d) from several starts; the parameters of each edge are eliminated (Schur complement). Weights are the
    variances on both sides of the edge, in between by the share of the step. The covariance is multiplied by χ²/dof if that is above 1,
    and by the correlation of neighbouring pixels. Of many edges the strongest enter, 4000 rows for each direction.

    A weak sharpening (unsharp mask of 1 px, amount 0 ± 0.3) is always among the unknowns: what it could do is in the u of the others. If
    it is there, v alone is given, as it was before the mask. A plate counts as present if χ² falls by 25. If it does not, the plate is
    anything between none and the widest that raises χ² by 2.71 with all else fitted again: the other values are the middles of what these
    fits span, and half of the span counts in their u.
    """
    if not measured:
        return Estimates.empty()
    edges = [_edge(region, spread) for region, spread in _strongest(measured)]
    axes = sorted({e.main for e in edges})
    free_a, free_d = [AX + m for m in axes], [DX + m for m in axes]
    start = _start(edges, free_a)
    plain = _best_fit(edges, [_with(start, free_a, a) for a in STARTS_A], [V, *free_a, S])
    sharp = _with(plain.parameters, free_a, 0.8)
    plate = _best_fit(plain.edges, [_with(sharp, free_d, d) for d in STARTS_D], [V, *free_a, *free_d, S])
    scale = max(plate.chi2 / plate.dof, 1.0)
    filtered = float(np.median([max(abs(s.along_rel), abs(s.neighbour_rel)) for _, s in measured]))
    if filtered > FILTERED_REL:
        told = (
            f"the noise of neighbouring pixels is correlated by {filtered:.2f}: a filter (sharpening, demosaicing, noise reduction) lies "
            "behind the pixels, and the edges show it together with lens and pixel"
        )
        return _of_wrong_model(min(plain, plate, key=lambda f: f.chi2), told)
    present = (plain.chi2 - plate.chi2) / scale > FOUND_CHI2
    if present:
        return _estimates(plate, axes)
    wrong = misfit(plain)
    if wrong > MISFIT:
        return _of_wrong_model(plain, _misfit_text(wrong))
    return _estimates(plain, axes, _possible_plates(plain, free_a, scale))


def _best_fit(edges: Sequence[_Edge], starts: Sequence[Array], free: Sequence[int]) -> _Fit:
    """The fit from the start that leads to the smallest χ² after a few steps."""
    tried = [_fit(edges, start, free, TRIAL_ITERATIONS) for start in starts]
    best = min(tried, key=lambda f: f.chi2)
    return _fit(best.edges, best.parameters, free)


def _strongest(measured: Sequence[tuple[Region, Spread]]) -> list[tuple[Region, Spread]]:
    """The edges with the largest step over noise, up to a number of rows for each direction: more rows cost time and tell little."""
    chosen: list[tuple[Region, Spread]] = []
    for axis in "xy":
        rows = 0
        own = [m for m in measured if m[0].across == axis]
        for region, spread in sorted(own, key=lambda m: -abs(m[1].height) / m[1].noise_dn):
            if rows < MOST_ROWS:
                chosen.append((region, spread))
            rows += region.rows
    return chosen


def _edge(region: Region, spread: Spread) -> _Edge:
    half = min(region.half_px, HALF_PX)
    values, distance = pixels_of(region, half)
    place = distance / region.cosine + region.centre[:, None]
    left, right = spread.low_dn, spread.low_dn + spread.height
    coloured = (1 + 2 * max(spread.along_rel, 0.0)) * (1 + 2 * max(spread.neighbour_rel, 0.0))
    levels = np.array([left, right])
    return _Edge(values, place, region.line, levels, np.array(spread.variances_dn2), "xy".index(region.across), coloured)


def _start(edges: Sequence[_Edge], free_a: Sequence[int]) -> Array:
    """Start values: v from the distance between 16 and 84 % of the step, roughly by the mean slope in the middle."""
    found = []
    for e in edges:
        z = ((e.place - line_at(e.line, len(e.values))[:, None]) / np.hypot(1, e.slope)).ravel()
        share = ((e.values - e.levels[0]) / (e.levels[1] - e.levels[0])).ravel()
        at = np.isfinite(share) & (np.abs(z) < 6)
        order = np.argsort(z[at])
        places, shares = z[at][order], share[at][order]
        widths = np.diff(places, prepend=places[0])
        # second moment of the line spread: 2 ∫ z (H(z) − E(z)) dz
        found.append(float(2 * (places * ((places > 0) - shares) * widths).sum()))
    v = float(np.clip(np.median(found), 0.12, 20))
    return np.array([v, 1.0, 1.0, 0.0, 0.0, 0.0])


def _with(parameters: Array, which: Sequence[int], value: float) -> Array:
    """Parameters with some replaced, v raised so that a Gaussian is left."""
    out = parameters.copy()
    out[list(which)] = value
    tied = _tied(out, which)
    out[V] = max(out[V], _of_others(tied) + 0.2**2)
    return out


def _tied(parameters: Array, which: Sequence[int]) -> Array:
    """Of a direction without edges the aperture and the plate are taken as those of the other."""
    out = parameters.copy()
    for first, second in ((AX, AY), (DX, DY)):
        has = (first in which, second in which)
        if has == (True, False):
            out[second] = out[first]
        elif has == (False, True):
            out[first] = out[second]
    return out


def _of_others(p: Array) -> float:
    """What aperture and plate have of v, the mean of x and y."""
    return float((p[AX] ** 2 + p[AY] ** 2) / 24 + (p[DX] ** 2 + p[DY] ** 2) / 8)


@dataclass(frozen=True)
class _Fit:
    """A fit: all six parameters, which of them were free, their covariance (free ones only, without scale), and the edges as fitted."""

    parameters: Array
    free: tuple[int, ...]
    covariance: Array
    chi2: float
    dof: int
    edges: tuple[_Edge, ...]


def _tables(edge: _Edge, p: Array, free: Sequence[int]) -> Array:
    """Spread, its slope, and its derivatives by the free parameters; v is one of them, so σ² = v − others."""
    cosine = 1 / np.hypot(1, edge.slope)
    sine = max(abs(edge.slope) * cosine, 1e-3)
    main, other = edge.main, 1 - edge.main
    sigma = np.sqrt(max(p[V] - _of_others(p), LEAST_SIGMA_PX**2))
    n = int(2 * REACH_PX / TABLE_PX) + 1
    raw, blurred = np.empty((2, 7, n))
    for out, width in ((raw, sigma), (blurred, np.hypot(sigma, MASK_PX))):
        edge_table(-REACH_PX, TABLE_PX, float(width), float(p[AX + main] * cosine), float(p[AX + other] * sine),
                   float(p[DX + main] * cosine), float(p[DX + other] * sine), out)  # fmt: skip
    by_amount = raw[0] - blurred[0]
    raw = raw + p[S] * (raw - blurred)
    by_var = raw[2]
    full = {
        V: by_var,
        AX + main: raw[3] * cosine - p[AX + main] / 12 * by_var,
        AX + other: raw[4] * sine - p[AX + other] / 12 * by_var,
        DX + main: raw[5] * cosine - p[DX + main] / 4 * by_var,
        DX + other: raw[6] * sine - p[DX + other] / 4 * by_var,
        S: by_amount,
    }
    # a tied parameter goes with the free one
    for first, second in ((AX, AY), (DX, DY)):
        if (first in free) != (second in free):
            full[first] = full[second] = full[first] + full[second]
    return np.ascontiguousarray(np.concatenate([raw[:2], np.array([full[k] for k in free])]))


def _normal(edge: _Edge, p: Array, free: Sequence[int]) -> tuple[Array, Array, float]:
    order, shared = len(edge.line) - 1, len(free)
    n = order + 3 + shared
    matrix, right = np.empty((n, n)), np.empty(n)
    cosine = float(1 / np.hypot(1, edge.slope))
    centre = line_at(edge.line, len(edge.values))
    chi2 = edge_normal(edge.values, edge.place, centre, cosine, HALF_PX, edge.levels, edge.variances, order, _tables(edge, p, free),
                       -REACH_PX, TABLE_PX, matrix, right)  # fmt: skip
    return matrix, right, chi2


def _fit(edges: Sequence[_Edge], start: Array, free: Sequence[int], iterations: int = ITERATIONS) -> _Fit:
    """Levenberg–Marquardt; every trial takes the step of the shared parameters and the steps of each edge that belong to it."""
    p, now = _tied(start, free), list(edges)
    shared, damping = len(free), 1e-3
    prior = np.array([AMOUNT_U**-2 if k == S else 0.0 for k in free])
    found = map_tiles(partial(_normal, p=p, free=free), now)
    chi2 = sum(c for *_, c in found) + float(prior @ p[list(free)] ** 2)
    for _turn in range(iterations):
        reduced, right = np.diag(prior * (1 + damping)), -prior * p[list(free)]
        solved = []
        for matrix, side, _ in found:
            own = len(side) - shared
            damped: Array = matrix + damping * np.diag(np.diag(matrix))
            both = np.linalg.solve(damped[:own, :own], np.column_stack([damped[:own, own:], side[:own]]))
            reduced += damped[own:, own:] - damped[own:, :own] @ both[:, :-1]
            right += side[own:] - damped[own:, :own] @ both[:, -1]
            solved.append(both)
        step = np.linalg.lstsq(reduced, right, rcond=1e-13)[0]
        trial = p.copy()
        trial[list(free)] = np.clip(p[list(free)] + step, LOWEST[list(free)], HIGHEST[list(free)])
        trial = _tied(trial, free)
        trial[V] = max(trial[V], _of_others(trial) + LEAST_SIGMA_PX**2)
        taken = trial[list(free)] - p[list(free)]
        moved = []
        for e, both in zip(now, solved, strict=True):
            change = both[:, -1] - both[:, :-1] @ taken
            moved.append(replace(e, line=e.line + change[: len(e.line)], levels=e.levels + change[len(e.line) :]))
        tried = map_tiles(partial(_normal, p=trial, free=free), moved)
        after = sum(c for *_, c in tried) + float(prior @ trial[list(free)] ** 2)
        if after <= chi2:
            gone = chi2 - after
            p, now, found, chi2, damping = trial, moved, tried, after, max(damping / 10, 1e-9)
            if gone < CONVERGED:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    information = np.diag(prior)
    for matrix, side, _ in found:
        own = len(side) - shared
        information += matrix[own:, own:] - matrix[own:, :own] @ np.linalg.solve(matrix[:own, :own], matrix[:own, own:])
    inverse = np.asarray(np.linalg.pinv(information, hermitian=True), float)
    pixels = sum(int(np.isfinite(e.values).sum()) for e in now)
    dof = pixels - sum(len(e.line) + 2 for e in now) - shared
    return _Fit(p, tuple(free), inverse, float(chi2), max(dof, 1), tuple(now))


def misfit(fit: _Fit) -> float:
    """χ² per bin of the mean residuals over the distance from the edge: 1 where the model describes the edges."""
    squares, bins = 0.0, 0
    edges = np.arange(-8.0, 8.0 + MISFIT_BINS_PX, MISFIT_BINS_PX)
    for axis in (0, 1):
        own = [e for e in fit.edges if e.main == axis]
        if not own:
            continue
        sums = np.zeros((2, len(edges) - 1))
        for e in own:
            table = _tables(e, fit.parameters, fit.free)
            cosine = 1 / np.hypot(1, e.slope)
            z = ((e.place - line_at(e.line, len(e.values))[:, None]) * cosine).ravel()
            share = np.interp(z, np.arange(table.shape[1]) * TABLE_PX - REACH_PX, table[0])
            height = e.levels[1] - e.levels[0]
            weight = 1 / (e.variances[0] + (e.variances[1] - e.variances[0]) * np.clip(share, 0, 1)) / e.coloured
            residual = (e.values.ravel() - e.levels[0] - height * share) * np.sign(height)
            known = np.isfinite(residual)
            for k, part in enumerate((weight * residual, weight)):
                sums[k] += np.histogram(z[known], edges, weights=part[known])[0]
        filled = sums[1] > 0
        squares += float((sums[0][filled] ** 2 / sums[1][filled]).sum())
        bins += int(filled.sum())
    return squares / max(bins, 1)


def _possible_plates(plain: _Fit, free_a: Sequence[int], scale: float) -> list[_Fit]:
    """Fits with separations, the same in x and y, up to the largest whose χ² is no more than 2.71 above that without a plate.

    They are given by rising separation. Between the ends the other values need not be in order: σ falls at first, and rises again as the
    plate takes the place of the aperture.
    """
    free, near = [V, *free_a, S], plain

    def at(d: float, near: _Fit) -> _Fit:
        start = near.parameters.copy()
        start[[DX, DY]] = d
        start[V] = max(start[V], _of_others(start) + 0.1**2)
        return _fit(near.edges, start, free, TRIAL_ITERATIONS)

    def fits(found: _Fit) -> bool:
        return (found.chi2 - plain.chi2) / scale <= ONE_SIDED_95**2

    widest, step = 0.0, 0.25
    while step > SEARCH_STEP_PX:
        found = at(widest + step, near)
        if fits(found) and widest + step < HIGHEST[DX]:
            widest, near = widest + step, found
        else:
            step /= 2
    between = [at(part * widest, plain) for part in (0.5, 0.75, 0.9)] if widest else []
    return [*(f for f in between if fits(f)), near]


def _misfit_text(wrong: float) -> str:
    return (
        f"the edges do not follow a Gaussian lens, a rectangular aperture and a birefringent plate (χ² of the mean residuals {wrong:.0f} "
        "per bin): another lens, diffraction, sharpening, gamma, charge that is late or repelled, or a printed edge that is not sharp"
    )


def _of_wrong_model(fit: _Fit, told: str) -> Estimates:
    """v alone, where its parts are not those of the model; its u grows with the misfit, and by a third of what a mask took from it.

    A mask of radius r and amount s takes s r² from v; one of another radius than is fitted, 0.7 to 2 px, leaves up to a third of that.
    """
    u = float(np.sqrt(fit.covariance[0, 0] * _scale(fit) * max(misfit(fit), 1.0)))
    u = float(np.hypot(u, abs(fit.parameters[S]) * MASK_PX**2 / 3))
    row = ("spread_var_px2", float(fit.parameters[V]), u, float(fit.dof), "px²")
    return Estimates.from_rows([row], method=METHOD, reasons={"spread_var_px2": told})


def _scale(fit: _Fit) -> float:
    """Variance over that of independent pixels with the assumed noise."""
    return max(fit.chi2 / fit.dof, 1.0) * float(np.mean([e.coloured for e in fit.edges]))


def _estimates(best: _Fit, axes: Sequence[int], possible: Sequence[_Fit] = ()) -> Estimates:
    """Values with their covariance; ``possible`` are fits with a plate where none was found, the widest last."""
    wrong = misfit(best)
    if wrong > MISFIT:
        return _of_wrong_model(best, _misfit_text(wrong))
    free = list(best.free)
    values, joint = _derived(best)
    amount, u_amount = values[free.index(S)], np.sqrt(joint[free.index(S), free.index(S)])
    if abs(amount) > SHARPENED * u_amount:
        what = "sharpened" if amount > 0 else "smoothed"
        mask = f"the edges are {what} behind the pixels (an unsharp mask of {MASK_PX:g} px fits with amount {amount:+.2f} ± {u_amount:.3f})"
        return _of_wrong_model(best, mask)
    widest = 0.0
    if possible:  # the truth is any of these: the middle of what they span, and half of the span as u
        widest = float(possible[-1].parameters[DX])
        each = np.array([values, *(_derived(f)[0] for f in possible)])
        joint = joint + np.diag((0.5 * np.ptp(each, axis=0)) ** 2)
        values = 0.5 * (each.min(axis=0) + each.max(axis=0))
    labels = [*(NAMES[k] for k in free), "sigma_px"]
    u = np.sqrt(np.diag(joint))
    hidden = [i for i, k in enumerate(free) if k in (AX, AY) and u[i] > LARGEST_U_A]
    wide = [float(values[i]) for i, k in enumerate(free) if k in (AX, AY) and values[i] - 1 > IMPOSSIBLE_U * u[i]]
    if wide:
        told = f"the pixel would be {max(wide):.2f} of its pitch wide, which no pixel is: sharpening, another lens, or gamma"
        return _of_wrong_model(best, told)
    advice = "focus better, or take more edges with less noise"
    reasons = {labels[i]: f"the blur hides the aperture (u would be {u[i]:.2f} px): {advice}" for i in hidden}
    if hidden:  # σ² = v − a²/12 with an aperture anywhere between none and all of the pixel
        var = float(values[0]) - 0.5 / 12 - float((best.parameters[DX] ** 2 + best.parameters[DY] ** 2) / 8)
        var -= widest**2 / 8
        spread = (1 / 12) ** 2 / 12 + (widest**2 / 4) ** 2 / 12 + joint[0, 0]
        values[-1] = np.sqrt(max(var, LEAST_SIGMA_PX**2))
        joint[-1, :] = joint[:, -1] = 0.0
        joint[-1, -1] = spread / (4 * values[-1] ** 2)
        reasons["sigma_px"] = "the blur hides the aperture, which is taken as anything between none and all of the pixel"
    kept = [i for i in range(len(labels)) if i not in hidden and labels[i] != NAMES[S]]
    limits = set()
    sigma, u_sigma = float(values[-1]), float(np.sqrt(joint[-1, -1]))
    if sigma < 3 * u_sigma:
        values[-1] = np.sqrt(sigma**2 + ONE_SIDED_95 * 2 * sigma * u_sigma)
        limits.add("sigma_px")
        reasons["sigma_px"] = "not significantly above zero; 95 % upper limit"
    names = tuple(labels[i] for i in kept)
    units = tuple("px²" if name == NAMES[V] else "px" for name in names)
    joint = joint[np.ix_(kept, kept)]
    dof = np.full(len(kept), float(best.dof))
    out = Estimates(names, values[kept], joint, dof, units, METHOD, _confounders(names, joint), frozenset(limits), reasons=reasons)
    if not possible:
        return out
    limit = widest + SEARCH_STEP_PX
    rows = [(NAMES[DX + m], limit, limit / ONE_SIDED_95, float(best.dof), "px") for m in axes]
    why = dict.fromkeys((r[0] for r in rows), f"χ² falls by less than {FOUND_CHI2:g} with a plate; 95 % upper limit")
    return out.join(Estimates.from_rows(rows, method=METHOD, limits=frozenset(why), reasons=why))


def _derived(fit: _Fit) -> tuple[Array, Array]:
    """The free parameters and σ, with their covariance: σ² = v − a²/12 − d²/4, of the mean of x and y."""
    p, free = fit.parameters, list(fit.free)
    sigma = float(np.sqrt(max(p[V] - _of_others(p), LEAST_SIGMA_PX**2)))
    jacobian = np.zeros((len(free) + 1, len(free)))
    jacobian[:-1] = np.eye(len(free))
    for i, k in enumerate(free):
        if k in (V, S):
            by = float(k == V)
        else:
            tied = (AX if k == AY else AY if k == AX else DX if k == DY else DY) not in free
            by = -float(p[k]) / (12 if k in (AX, AY) else 4) * (2 if tied else 1)
        jacobian[-1, i] = by / (2 * sigma)
    values = np.append(p[free], sigma)
    return values, np.asarray(jacobian @ (fit.covariance * _scale(fit)) @ jacobian.T, float)


def _confounders(names: Sequence[str], covariance: Array) -> tuple[str, ...]:
    """Pairs of values that the edges hardly tell apart."""
    u = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(u, u)
    told = []
    for i in range(len(names)):
        for j in range(i):
            if abs(correlation[i, j]) > 0.9 and "spread_var_px2" not in (names[i], names[j]):
                told.append(f"{names[j]} and {names[i]} from slanted edges are correlated by {correlation[i, j]:+.2f}")
    return tuple(told)
