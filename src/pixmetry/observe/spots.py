"""Bright spots on black at several exposures: what they leave in the rest of their columns and rows, and where they saturate.

The light of every pixel comes from the exposures in which its column does not saturate. What is left in the rest of a column is told by how
it grows with the exposure: smear, gathered while charge moves, does not grow; cross-talk grows with the charge that is held; charge that
full pixels spill ends in a streak.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.camera.observations import BrightSpots, Observations, Spot, SpotStreaks
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.observe.experiment import PictureGroup

FOUND, PEAK = 6.0, 30.0  # of a spot's pixels, and of its brightest one, over the noise
LINEAR = 0.9  # of the light expected, below which an exposure counts as saturated
UNSATURATED = 0.8  # of the plateau, up to which light is taken as measured
MARGIN_PX = 16  # from a spot, within which its own skirt and deferred charge may lie
END_PX = 4
LEAST_LINES = 16  # columns (rows) without spots, and rows (columns) of a column's (row's) rest
MOST_EXPOSURES = 8
SIGNIFICANT, DIFFERENT, FALLING = 3.3, 4.0, 3.0
STRAY = "stray light that is even along the rows or columns of the spots is taken for their cross-talk"
SATURATED, LESS_LIGHT = "spots are saturated in the shortest exposure", "add exposures in which they reach half of saturation"
METHOD = "level of the columns and rows of spots against those without, at all exposures together"


@dataclass(frozen=True)
class _Exposure:
    """Mean image of one exposure above black, and where it ends."""

    exposure_s: float
    frames: int
    image_dn: np.ndarray
    noise_dn: float  # spatial standard deviation of the dark pixels
    full_dn: float  # highest code above black

    @property
    def peak_dn(self) -> float:
        return float(self.image_dn.max())


def reduce_spots(groups: Sequence[PictureGroup], seen: Observations) -> Observations:
    """Find the spots, their light, and what they leave elsewhere; what cannot be measured becomes a reason."""
    try:
        return replace(seen, spots=spots_of(groups, seen))
    except MeasureError as problem:
        why = problem.what + (f" ({problem.remedy})" if problem.remedy else "")
        none = np.zeros(0)
        fit = replace(Estimates.empty(), reasons={"smear_s": why})
        nothing = BrightSpots((), none, none, none.astype(bool), none, none, none, float("nan"), False, None, "all", "below", fit, 0)
        return replace(seen, spots=nothing, notes=(*seen.notes, f"Bright spots: {why}"))


def spots_of(groups: Sequence[PictureGroup], seen: Observations) -> BrightSpots:
    """All that the groups of spots tell.

    Raises
    ------
    MeasureError
        If no spot is found, or all exposures saturate.
    """
    exposures = _exposures(groups, seen)
    saturated, plateau, u_plateau, clipped = _saturation(exposures)
    if saturated.all():
        raise MeasureError(SATURATED, remedy=LESS_LIGHT)
    found = _find_spots(exposures, saturated)
    light, u_rel, times = _light(exposures, saturated, plateau, _rows_of(found))
    shape = light.shape
    in_cols, in_rows = (_lines_of(found, shape[a], axis=a) for a in (1, 0))
    total = np.where(_mask(found, shape), light, 0.0)
    gain = _gain_of(seen, plateau)
    reach = [_reach(e, found, plateau if s else np.inf) for e, s in zip(exposures, saturated, strict=True)]
    usable = [k for k, e in enumerate(exposures) if not (saturated[k] and clipped)]
    columns = _rest_of_lines(exposures, usable, reach, total, in_cols, gain)
    plain = [k for k in usable if not saturated[k]]
    flipped = [replace(e, image_dn=e.image_dn.T) for e in exposures]
    rows = _rest_of_lines(flipped, plain, [_cols_of(found)] * len(exposures), total.T, in_rows, gain)
    fit, smear_rows, store = _fit(columns, rows, shape[0])
    bend = np.where([name in fit.limits for name in fit.names], 0.0, seen.bend_rel(max(e.peak_dn for e in exposures)) * fit.values)
    fit = replace(fit, covariance=fit.covariance + np.diag(bend**2))
    if saturated.any():
        reason = {"plateau_dn": "the highest code"} if clipped else {}
        fit = fit.join(Estimates.from_rows([("plateau_dn", plateau, u_plateau, np.inf, "DN")], method=METHOD, reasons=reason))
    up, down, u = _single_levels(columns, len(exposures))
    return BrightSpots(
        spots=found,
        exposure_s=np.array([e.exposure_s for e in exposures]),
        peak_dn=np.array([e.peak_dn for e in exposures]),
        saturated=saturated,
        level_up_s=up,
        level_down_s=down,
        u_level_s=u,
        plateau_dn=plateau if saturated.any() else float("nan"),
        clipped=clipped,
        streaks=_streaks(exposures, saturated, found, light, u_rel, times, reach, gain),
        smear_rows=smear_rows,
        smear_store=store,
        fit=fit,
        frame_rows=shape[0],
    )


def _exposures(groups: Sequence[PictureGroup], seen: Observations) -> list[_Exposure]:
    """Mean images above black by rising exposure, each exposure once."""
    if any(g.exposure_s <= 0 for g in groups):
        raise MeasureError("a group of spots without exposure time", remedy="add exposure_s to each")
    times = [g.exposure_s for g in groups]
    if len(set(times)) < len(times):
        raise MeasureError("two groups of spots have the same exposure time", remedy="list their frames in one group")
    pattern: np.ndarray | float = 0.0
    stack = seen.dark_stack
    if stack is not None and stack.mean_map_dn.shape == groups[0].moments.shape:
        pattern = stack.mean_map_dn - stack.mean_dn
    out = []
    for g in sorted(groups, key=lambda g: g.exposure_s):
        image = g.moments.mean_map_dn() - pattern
        black = float(np.median(image))
        noise = 1.4826 * float(np.median(np.abs(image - black)))
        out.append(_Exposure(g.exposure_s, g.moments.n_frames, image - black, max(noise, 0.05), 2**g.bits - 1 - black))
    return out


def _saturation(exposures: Sequence[_Exposure]) -> tuple[np.ndarray, float, float, bool]:
    """Which exposures saturate, the level at which they do with its u, and whether it is the highest code."""
    first = exposures[0]
    expected = np.array([first.peak_dn * e.exposure_s / first.exposure_s for e in exposures])
    peaks = np.array([e.peak_dn for e in exposures])
    saturated = peaks < LINEAR * expected
    if not saturated.any():
        if first.peak_dn > LINEAR * first.full_dn:
            raise MeasureError(SATURATED, remedy=LESS_LIGHT)
        return saturated, float("inf"), 0.0, False
    longest = exposures[int(np.flatnonzero(saturated)[-1])]
    values = longest.image_dn[longest.image_dn > LINEAR * longest.peak_dn]
    plateau = float(np.median(values))
    u = 1.4826 * float(np.median(np.abs(values - plateau))) / np.sqrt(values.size) + longest.noise_dn / np.sqrt(values.size)
    saturated = saturated | (peaks > UNSATURATED * plateau)
    return saturated, plateau, float(u), plateau > longest.full_dn - 1


def _light(
    exposures: Sequence[_Exposure], saturated: np.ndarray, plateau: float, rows: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Light of every pixel in DN/s above the rest of its column, its u from noise alone, and the time that it was summed, by column."""
    shape = exposures[0].image_dn.shape
    total, var, time = np.zeros(shape), np.zeros(shape), np.zeros(shape[1])
    for k, e in enumerate(exposures):
        plain = np.ones(shape[1], bool) if not saturated[k] else e.image_dn.max(axis=0) < UNSATURATED * plateau
        above, below = (
            _clean_means(rest, e.noise_dn) if len(rest) >= LEAST_LINES else np.zeros(shape[1])
            for rest in (e.image_dn[: max(rows[0] - MARGIN_PX, 0)], e.image_dn[rows[1] + MARGIN_PX :])
        )
        # the level changes where the light is: by its share from above
        risen = np.cumsum(np.maximum(e.image_dn, 0.0), axis=0)
        risen /= np.maximum(risen[-1], 1e-12)
        total += np.where(plain, e.image_dn - above - (below - above) * risen, 0.0)
        var += np.where(plain, e.noise_dn**2, 0.0)
        time += np.where(plain, e.exposure_s, 0.0)
    used = np.maximum(time, 1e-12)
    return np.where(time > 0, total / used, 0.0), np.where(time > 0, np.sqrt(var) / used, np.inf), time


def _find_spots(exposures: Sequence[_Exposure], saturated: np.ndarray) -> tuple[Spot, ...]:
    """Bright places of the exposures that do not saturate, less those at the frame's ends.

    Raises
    ------
    MeasureError
        If there are none.
    """
    from scipy import ndimage

    plain = [e for k, e in enumerate(exposures) if not saturated[k]]
    image, noise = np.sum([e.image_dn for e in plain], axis=0), float(np.sqrt(sum(e.noise_dn**2 for e in plain)))
    image = image - np.median(image, axis=1, keepdims=True)  # without streaks along rows and columns
    image -= np.median(image, axis=0)
    labels, count = ndimage.label(image > FOUND * noise, np.ones((3, 3)))
    found, at_end = [], 0
    (rows, cols), time = image.shape, sum(e.exposure_s for e in plain)
    for number, (down, along) in enumerate(ndimage.find_objects(labels), start=1):
        inside = np.where(labels[down, along] == number, image[down, along], 0.0)
        if inside.max() < PEAK * noise or np.count_nonzero(inside) < 3:
            continue
        if min(down.start, along.start, rows - down.stop, cols - along.stop) < END_PX:
            at_end += 1
            continue
        y, x = (float((np.arange(inside.shape[a]) * inside.sum(axis=1 - a)).sum() / inside.sum()) for a in (0, 1))
        box = (max(down.start - 4, 0), min(down.stop + 4, rows)), (max(along.start - 2, 0), min(along.stop + 2, cols))
        found.append(Spot(along.start + x, down.start + y, *box, float(inside.max()) / time))
    if not found:
        where = f": {at_end} at the frame's end" if at_end else ""
        remedy = "move the spots away from the ends" if at_end else "brighter spots, or more frames in the short exposures"
        raise MeasureError(f"no spot is found in the exposures that do not saturate{where}", remedy=remedy)
    return tuple(found)


def _mask(found: Sequence[Spot], shape: tuple[int, ...]) -> np.ndarray:
    mask = np.zeros(shape, bool)
    for s in found:
        mask[slice(*s.rows), slice(*s.cols)] = True
    return mask


def _lines_of(found: Sequence[Spot], size: int, *, axis: int) -> np.ndarray:
    """Which columns (axis 1) or rows (axis 0) spots are in: 2, or near spots: 1."""
    kind = np.zeros(size, np.int8)
    for s in found:
        first, end = s.cols if axis else s.rows
        near = kind[max(first - MARGIN_PX, 0) : end + MARGIN_PX]
        np.maximum(near, 1, out=near)
    for s in found:
        kind[slice(*(s.cols if axis else s.rows))] = 2
    return kind


def _rows_of(found: Sequence[Spot]) -> tuple[int, int]:
    return min(s.rows[0] for s in found), max(s.rows[1] for s in found)


def _cols_of(found: Sequence[Spot]) -> tuple[int, int]:
    return min(s.cols[0] for s in found), max(s.cols[1] for s in found)


def _reach(exposure: _Exposure, found: Sequence[Spot], plateau: float) -> tuple[int, int]:
    """First row, and one behind the last, that spots and their streaks of full pixels touch."""
    first, end = _rows_of(found)
    if not np.isfinite(plateau):
        return first, end
    cols = np.unique(np.concatenate([np.arange(*s.cols) for s in found]))
    touched = np.flatnonzero((exposure.image_dn[:, cols] > max(0.3 * plateau, FOUND * exposure.noise_dn)).any(axis=1))
    return min(first, int(touched[0])) if touched.size else first, max(end, int(touched[-1]) + 1) if touched.size else end


@dataclass(frozen=True)
class _Rest:
    """Levels of the rest of columns (rows) with spots, above (left) and below (right) them, against those without."""

    side: np.ndarray  # shape (levels,): 0 above, 1 below
    of: np.ndarray  # shape (levels,): number of the exposure
    level_dn: np.ndarray  # shape (levels, lines)
    gap: np.ndarray  # shape (levels,): level far from the spots less that near them, over the mean of the line
    gap_covariance: np.ndarray
    light: np.ndarray  # shape (lines,), DN/s, sum over the line
    held_dn: np.ndarray  # shape (levels, lines): mean of the line
    covariance_dn2: np.ndarray  # shape (levels, levels)
    references: int


def _rest_of_lines(
    exposures: Sequence[_Exposure],
    usable: Sequence[int],
    reach: Sequence[tuple[int, int]],
    total: np.ndarray,
    kind: np.ndarray,
    gain: float,
) -> _Rest | str:
    """Levels of the rest of the columns; or why there are none. Of rows: all transposed."""
    own, free = np.flatnonzero(kind == 2), np.flatnonzero(kind == 0)
    if free.size < LEAST_LINES:
        return f"only {free.size} columns or rows are without spots, {LEAST_LINES} are needed"
    size = total.shape[0]
    chosen = [usable[int(k)] for k in np.unique(np.linspace(0, len(usable) - 1, MOST_EXPOSURES).round().astype(int))] if usable else []
    levels, references, held, side, of, slopes, gaps, summed = [], [], [], [], [], [], [], []
    light = total.sum(axis=0)[own]
    for k in chosen:
        image, (first, end) = exposures[k].image_dn, reach[k]
        mean = image.mean(axis=0) - image[:, free].mean()
        for which, rest in enumerate((slice(0, max(first - MARGIN_PX, 0)), slice(min(end + MARGIN_PX, size), size))):
            part = image[rest]
            if part.shape[0] < LEAST_LINES:
                continue
            level = _clean_means(part, exposures[k].noise_dn)
            base = float(level[free].mean())
            levels.append(level[own] - base)
            references.append(level[free] - base)
            held.append(mean[own])
            side.append(which)
            of.append(k)
            summed.append(part.shape[0] * exposures[k].frames)
            half = part.shape[0] // 2
            upper, lower = (_clean_means(p, exposures[k].noise_dn) for p in (part[:half], part[half:]))
            near, far = (lower, upper) if which == 0 else (upper, lower)
            gap = far - near
            slopes.append(float((gap[own] - gap[free].mean()) @ mean[own]) / float(mean[own] @ mean[own]))
            gaps.append(gap[free])
    if not levels:
        return "the streaks of full pixels, or the spots, leave no rest of their columns or rows"
    noise = np.array(references)
    covariance = np.atleast_2d(np.cov(noise)) + 1e-12 * np.eye(len(levels))
    covariance *= 1 + float(light.sum() ** 2 / (light @ light)) / free.size  # the mean of the others, which all levels have in common
    weights = light**2 / float(light @ light)
    own_shot = [max(float(level @ weights), 0.0) * gain / values for level, values in zip(levels, summed, strict=True)]
    lines = np.array(held)
    products = lines @ lines.T
    spread = products / np.outer(np.diag(products), np.diag(products)) * (1 + float(light.sum() ** 2 / (light @ light)) / free.size)
    return _Rest(
        side=np.array(side),
        of=np.array(of),
        level_dn=np.array(levels),
        gap=np.array(slopes),
        gap_covariance=np.atleast_2d(np.cov(np.array(gaps))) * spread,
        light=light,
        held_dn=lines,
        covariance_dn2=covariance + np.diag(own_shot),
        references=free.size,
    )


def _clean_means(part: np.ndarray, noise_dn: float) -> np.ndarray:
    """Means of columns, in which single hot pixels count as four times the noise."""
    middle = np.median(part, axis=0)
    means: np.ndarray = middle + np.clip(part - middle, -4 * noise_dn, 4 * noise_dn).mean(axis=0)
    return means


def _solve(rest: _Rest, design: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
    """Values, covariance and χ² of levels that are the sum of the design's arrays, each of shape (levels, lines), times a value."""
    levels = len(rest.level_dn)
    shrink = max(rest.references - levels - 2, 1) / (rest.references - 1)  # of the inverse of an estimated covariance
    inverse = shrink * np.linalg.inv(rest.covariance_dn2)
    a = np.array(design)  # (values, levels, lines)
    normal = np.einsum("igc,gh,jhc->ij", a, inverse, a)
    right = np.einsum("igc,gh,hc->i", a, inverse, rest.level_dn)
    covariance = np.linalg.inv(normal)
    values = covariance @ right
    left = rest.level_dn - np.einsum("i,igc->gc", values, a)
    return values, covariance, float(np.einsum("gc,gh,hc->", left, inverse, left))


def _fit(columns: _Rest | str, rows: _Rest | str, frame_rows: int) -> tuple[Estimates, str, str]:
    """Smear and cross-talk as estimates, the rows that charge passes, and the side of the store."""
    reasons: dict[str, str] = {}
    parts: list[Estimates] = []
    passed, store = "all", "below"
    if isinstance(columns, str):
        reasons |= {"smear_s": columns, "col_crosstalk": columns}
    else:
        made, why, passed, store = _of_columns(columns, frame_rows)
        parts, reasons = parts + made, reasons | why
    if isinstance(rows, str):
        reasons["row_crosstalk"] = rows
    else:
        values, covariance, _ = _solve(rows, [rows.held_dn * (rows.side == k)[:, None] for k in (0, 1) if np.any(rows.side == k)])
        made, why = _crosstalk("row_crosstalk", values, covariance, rows, "left and right")
        parts, reasons = parts + made, reasons | why
    whole = Estimates.empty().join(*parts)
    return replace(whole, reasons={**reasons, **whole.reasons}), passed, store


def _of_columns(rest: _Rest, frame_rows: int) -> tuple[list[Estimates], dict[str, str], str, str]:
    """Smear, which is the same at all exposures, and cross-talk of columns, which grows with the charge."""
    light = np.broadcast_to(rest.light, rest.level_dn.shape)
    sides = [light * (rest.side == k)[:, None] for k in (0, 1)]
    names = {("all", "below"): light, ("passed", "below"): sides[0], ("passed", "above"): sides[1]}
    told = np.ptp(np.log(rest.held_dn.sum(axis=1))) > np.log(1.8)
    both = len(set(rest.side.tolist())) == 2
    choices = names if both else {("all", "below"): light}
    fits = {name: _solve(rest, [one, rest.held_dn] if told else [one]) for name, one in choices.items()}
    best = min(fits, key=lambda name: fits[name][2])
    values, covariance, chi2 = fits[best]
    value, u = float(values[0]) * frame_rows, float(np.sqrt(covariance[0, 0])) * frame_rows
    reasons: dict[str, str] = {}
    notes = []
    if not told:
        notes.append("cross-talk of columns leaves the same at one exposure; take spots at exposures of 1 : 2 or more")
    others = sorted(f[2] for name, f in fits.items() if name != best)
    if value > SIGNIFICANT * u and (not both or others[0] - chi2 < DIFFERENT**2):
        notes.append("whether charge passes all rows, or only those up to the storage: the streak is too weak, or seen on one side only")
        best, values, covariance = ("all", "below"), *fits[("all", "below")][:2]
        value, u = float(values[0]) * frame_rows, float(np.sqrt(covariance[0, 0])) * frame_rows
    product = "product of the transfer time and the sensitivity during it (leak_rel 1); spots do not tell one from the other"
    if value > SIGNIFICANT * u:
        rows, limits, reason = [("smear_s", value, u, float(rest.references), "s")], frozenset[str](), product
    else:
        limit = max(value, 0.0) + ONE_SIDED_95 * u
        best = ("all", "below")
        rows, limits = [("smear_s", limit, u, float(rest.references), "s")], frozenset({"smear_s"})
        reason = f"not significantly above zero; 95 % upper limit of the {product}"
    smear = Estimates.from_rows(rows, method=METHOD, limits=limits, reasons={"smear_s": reason}, confounders=tuple(notes))
    if not told:
        reasons["col_crosstalk"] = "one exposure does not tell cross-talk from smear; take spots at exposures of 1 : 2 or more"
        return [smear], reasons, *best
    talk, why = _crosstalk("col_crosstalk", values[1:2], covariance[1:2, 1:2], rest, "above and below")
    if not talk or limits:
        return [smear, *talk], reasons | why, *best
    joint = smear.join(*talk)
    cross = covariance[0, 1] * frame_rows * (0.0 if talk[0].limits else 1.0)
    joint.covariance[0, 1] = joint.covariance[1, 0] = cross
    return [joint], reasons | why, *best


def _crosstalk(name: str, slopes: np.ndarray, covariance: np.ndarray, rest: _Rest, sides: str) -> tuple[list[Estimates], dict[str, str]]:
    """Cross-talk from the slope B of levels on the mean of the line, which holds the cross-talk itself: κ = B/(1 − B)."""
    inverse = np.linalg.inv(covariance)
    u = float(inverse.sum() ** -0.5)
    slope = float(inverse.sum(axis=0) @ slopes) * u**2
    value = slope / (1 - slope)
    if value > SIGNIFICANT * u:
        if slopes.size == 2:
            gap, u_gap = slopes[0] - slopes[1], np.sqrt(covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1])
            if abs(gap) > DIFFERENT * u_gap:
                return [], {name: f"{sides} of the spots differ: a delayed signal or stray light, not cross-talk of a whole line"}
        inverse = np.linalg.inv(rest.gap_covariance)
        if abs(float(inverse.sum(axis=0) @ rest.gap)) > FALLING * float(np.sqrt(inverse.sum())):
            return [], {name: "the level changes with the distance from the spots: stray light or a tail, not cross-talk of a whole line"}
        rows = [(name, value, u / (1 - slope) ** 2, float(rest.references), "1")]
        return [Estimates.from_rows(rows, method=METHOD, confounders=(STRAY,))], {}
    limit = max(value, 0.0) + ONE_SIDED_95 * u
    why = {name: "not significantly above zero; 95 % upper limit"}
    rows = [(name, limit, u, float(rest.references), "1")]
    return [Estimates.from_rows(rows, method=METHOD, limits=frozenset({name}), reasons=why)], {}


def _single_levels(rest: _Rest | str, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Level above and below, and its u, over the light of the column in one second, at every exposure."""
    out = np.full((3, count), np.nan)
    if isinstance(rest, str):
        return out[0], out[1], out[2]
    norm = float(rest.light @ rest.light)
    for level, side, k, var in zip(rest.level_dn, rest.side, rest.of, np.diag(rest.covariance_dn2), strict=True):
        out[side, k] = level @ rest.light / norm
        out[2, k] = np.sqrt(var / norm)
    return out[0], out[1], out[2]


def _gain_of(seen: Observations, plateau: float) -> float:
    """Gain for weights: the measured one, or as if a full pixel held 20 000 electrons."""
    fit = seen.photon_transfer_fit
    if fit is not None and "gain_dn_per_e" in fit:
        return fit["gain_dn_per_e"].value
    return (plateau if np.isfinite(plateau) else 4000.0) / 20_000.0


def _streaks(
    exposures: Sequence[_Exposure],
    saturated: np.ndarray,
    found: Sequence[Spot],
    light: np.ndarray,
    u_light: np.ndarray,
    times: np.ndarray,
    reach: Sequence[tuple[int, int]],
    gain: float,
) -> SpotStreaks | None:
    """Charge above and below each spot that is alone in its columns, in every saturated exposure whose streaks end within the frame."""
    rows, cols = light.shape
    owner = np.zeros(cols, int)
    for s in found:
        owner[slice(*s.cols)] += 1
    height = max(s.rows[1] - s.rows[0] for s in found)
    table: list[tuple[np.ndarray, int, int, int, float, tuple[int, int], tuple[float, float], float, float, float]] = []
    for s in found:
        first, end = s.rows
        for c in range(*s.cols):
            own = light[first:end, c].sum()
            noise = float(np.sqrt((u_light[first:end, c] ** 2).sum()))
            if owner[c] > 1 or not times[c] or own < 10 * noise:
                continue
            shot = np.sqrt(gain * own * times[c] / exposures[0].frames) / times[c]
            profile = np.zeros(height)
            profile[: end - first] = light[first:end, c]
            centre = first + int(np.argmax(profile))
            for k in np.flatnonzero(saturated).tolist():
                e = exposures[k]
                if e.image_dn[first:end, c].max() < UNSATURATED * e.peak_dn:
                    continue
                full = np.flatnonzero(e.image_dn[:, c] > 0.3 * e.peak_dn)
                if full[0] < MARGIN_PX + END_PX or full[-1] >= rows - MARGIN_PX - END_PX:
                    continue
                low, high = max(min(full[0], first) - MARGIN_PX, 0), min(max(full[-1] + 1, end) + MARGIN_PX, rows)
                ends = [_clean_means(part[:, c : c + 1], e.noise_dn)[0] for part in (e.image_dn[:low], e.image_dn[high:])]
                levels = float(ends[0]), float(ends[1])
                up, down = float(e.image_dn[low:centre, c].sum()), float(e.image_dn[centre + 1 : high, c].sum())
                charge = own * e.exposure_s
                var = (gain * charge + (high - low) * gain * 100.0) / e.frames + (1e-3 * e.peak_dn) ** 2 * (high - low)
                table.append(
                    (profile * e.exposure_s, first, centre, c, float(np.hypot(noise, shot) / own), (low, high), levels, up, down, var)
                )
    if not table:
        return None
    return SpotStreaks(*(np.array(v) for v in zip(*table, strict=True)))
