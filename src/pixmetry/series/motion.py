"""Moving targets: time between the fields of a frame and from row to row, length of the exposure, pulses of light, jitter of the trigger.

The two sets of rows of a frame, even and odd, are located apart. Where they are exposed at different times, a target of velocity v lies
v T_f apart in them. Where rows are exposed one after the other, the picture of a moving plate is sheared by v_x t_row and stretched by
v_y t_row. What the blur along the path tells is in `pixmetry.series.blur`. Targets at rest tell whether the rows of the two fields are
woven in the right order. Velocities come from the places in successive frames: a wrong time between frames makes all times wrong by the
same factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixmetry.camera.drift_series import CAMERA_MODES, GRABBER_MODES
from pixmetry.camera.motion_series import MotionSeries
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.series.blur import Cut, Look, cut_out, exposure_of, pulses_of, untold
from pixmetry.series.modes import FieldMotion, field_motion
from pixmetry.series.track import FrameTargets, find_targets, follow_targets, near_pairs

LEAST_FRAMES = 4  # of a run, for a velocity that may change and a check
LEAST_PX = 0.05  # from frame to frame, below which nothing moves
STATIC_LAG_PX = 0.02  # of even against odd rows without motion: what the pixels' phase does to a place
SIGNIFICANT = 3.0
SPREAD = 20.0  # of the velocities over the u of one, from which on they differ
PATH_DEGREE = 2  # of the polynomial over time that each run follows
FIELDS, ROWS = ("first_field", "even", "odd"), ("first_row", "top", "bottom")  # what the sign of a time says
METHOD = "places of moving targets in even and odd rows, over successive frames; weighted least squares"
SWAPPED_PX, NEARLY = 2.0, 0.25  # odd rows less even ones where a grabber swaps the rows of every pair; how near to it
ALTERNATE_PX, FEWEST_STILL = 0.5, 6  # of successive single fields; frames at rest that tell it
ROW_OFFSET = "rows_swapped_px"
NOTHING_MOVES = "nothing moves: let the targets move by a pixel or more from frame to frame"


@dataclass(frozen=True)
class Run:
    """Frames taken one after the other: the targets in even and in odd rows, each in order of time.

    ``cuts`` are windows about the targets of each frame, or nothing; ``exposure_s`` is 0 where it was not stated. ``pulsed``: in the light
    of two pulses, one for each field.
    """

    even: tuple[FrameTargets, ...]
    odd: tuple[FrameTargets, ...]
    cuts: tuple[Cut, ...] = ()
    exposure_s: float = 0.0
    pulsed: bool = False


def find_in_fields(frame: np.ndarray, name: str, time_s: float, **options: Any) -> tuple[FrameTargets, FrameTargets, Cut]:
    """Find the targets in the even and in the odd rows of a frame, and cut windows out about them; places count in rows of the frame.

    Raises
    ------
    InputError
        As of `find_targets`.
    """
    both = []
    for parity in (0, 1):
        found = find_targets(np.ascontiguousarray(frame[parity::2]), name, time_s, **{"kind": "ellipse", **options})
        wide = np.array([1.0, 2.0])
        covariance = found.covariance_px2 * wide[:, None] * wide
        both.append(FrameTargets(name, time_s, found.positions_px * wide + [0.0, parity], covariance))
    return both[0], both[1], cut_out(frame, both[0].positions_px, options.get("bits"))


def motion_of(runs: Sequence[Run], frame_shape: tuple[int, int]) -> MotionSeries:
    """What runs of frames with moving targets tell.

    Parameters
    ----------
    runs : sequence of Run
    frame_shape : (int, int)

    Returns
    -------
    MotionSeries

    Raises
    ------
    MeasureError
        If no run has four frames with three targets that can be followed.

    Notes
    -----
    Velocities: slope of a parabola through the path of every target. Time between fields: regression of the lag of the odd rows on the
    velocity, with a constant for each axis that is known to 0.02 px. Row time: shear and stretch of every frame, about those that all
    frames share, regressed on the velocity; the runs must differ in velocity, or the shear of the shutter is that of the plate.
    """
    parts = [part for part in (_followed(run) for run in runs) if part is not None]
    if not parts:
        raise MeasureError(
            f"no run shows 3 targets in {LEAST_FRAMES} frames in even and odd rows",
            where="motion",
            remedy="show a plate of targets that moves",
        )
    seen = [np.asarray(np.isfinite(p.speed).all(axis=2)) for p in parts]
    counts = np.concatenate([s.sum(axis=1) for s in seen])
    sums = np.concatenate([np.where(s[..., None], p.speed, 0).sum(axis=1) for s, p in zip(seen, parts, strict=True)])
    mean_speed = sums / np.maximum(counts, 1)[:, None]
    order, parts = _order_of_rows(parts)
    steady = [p for p in parts if not p.run.pulsed]
    fields, lag, u_lag = _fields(parts, steady)
    rows, shear, u_shear = _rows(parts, mean_speed, frame_shape)
    exposure, stated_s = _exposure(steady, rows)
    fit = fields.join(rows, _jitter(parts), exposure, order, _pulses(parts, fields, exposure, order))
    return MotionSeries(
        frames=len(counts), targets=int(counts.max()), speed_px_s=mean_speed, lag_px=lag, shear=shear, u_lag_px=u_lag,
        u_shear=u_shear, stated_exposure_s=stated_s, fit=fit,
    )  # fmt: skip


@dataclass(frozen=True)
class _Followed:
    """One run with its targets known: shapes (frames, targets, 2) and (frames, targets, 2, 2); ``noise`` is about the paths."""

    time_s: Array
    places: Array
    covariance: Array
    lag: Array
    lag_covariance: Array
    speed: Array
    common: Array  # of all targets of a frame about the paths, shape (frames, 2)
    common_var: Array
    run: Run
    cuts: tuple[Cut, ...]  # of these frames, or nothing


def _followed(run: Run) -> _Followed | None:
    """Know the targets of a run, and their velocities; None where there are too few."""
    if len(run.even) < LEAST_FRAMES:
        return None
    try:
        even, even_covariance = follow_targets(run.even)
    except MeasureError:
        return None
    odd, odd_covariance = np.full_like(even, np.nan), np.full_like(even_covariance, np.nan)
    for k, found in enumerate(run.odd):
        here = np.flatnonzero(np.isfinite(even[k]).all(axis=1))
        if not here.size or not len(found.positions_px):
            continue
        one, other = near_pairs(even[k, here], found.positions_px)
        odd[k, here[one]], odd_covariance[k, here[one]] = found.positions_px[other], found.covariance_px2[other]
    time_s = np.array([f.time_s for f in run.even])
    places, covariance = 0.5 * (even + odd), 0.25 * (even_covariance + odd_covariance)
    seen = np.asarray(np.isfinite(places).all(axis=2))
    kept = seen.sum(axis=0) >= LEAST_FRAMES
    if kept.sum() < 3:
        return None
    used = seen[:, kept].any(axis=1)  # a frame that shows none of them tells nothing
    both = np.ix_(used, kept)
    time_s, places, covariance, seen = time_s[used], places[both], covariance[both], seen[both]
    if not np.ptp(time_s) > 0:
        raise MeasureError("all frames of a run have the same time", where="motion", remedy="correct times_s")
    speed, left = np.full_like(places, np.nan), np.full_like(places, np.nan)
    scaled = (time_s - time_s.mean()) / np.ptp(time_s)
    basis = np.polynomial.polynomial.polyvander(scaled, PATH_DEGREE)
    for i in range(places.shape[1]):
        there = seen[:, i]
        path = np.linalg.lstsq(basis[there], places[there, i], rcond=None)[0]
        speed[there, i] = (path[1] + 2 * scaled[there, None] * path[2]) / np.ptp(time_s)
        left[there, i] = places[there, i] - basis[there] @ path
    number = np.maximum(seen.sum(axis=1), 1)[:, None]
    common = np.where(seen[..., None], left, 0).sum(axis=1) / number
    variance = np.where(seen[..., None], np.diagonal(covariance, axis1=2, axis2=3), 0).sum(axis=1) / number**2
    lag, lag_covariance = (odd - even)[both], (odd_covariance + even_covariance)[both]
    cuts = tuple(run.cuts[k] for k in np.flatnonzero(used)) if run.cuts else ()
    return _Followed(time_s, places, covariance, lag, lag_covariance, speed, common, variance, run, cuts)


def _order_of_rows(parts: Sequence[_Followed]) -> tuple[Estimates, list[_Followed]]:
    """How far odd rows lie from even ones without motion, which tells rows that are swapped; and the runs as if they were not.

    The lag of the odd rows is regressed on the velocity: what is left at rest is the order of the rows.
    """
    speed, lag = (np.concatenate([v.reshape(-1, 2) for v in both]) for both in zip(*((p.speed, p.lag) for p in parts), strict=True))
    seen = np.isfinite(speed).all(axis=1) & np.isfinite(lag).all(axis=1)
    pulsed = np.concatenate([np.full(p.lag[..., 0].size, p.run.pulsed) for p in parts])[seen]
    v, d = speed[seen, 1], lag[seen, 1]
    at_rest = np.abs(v) < LEAST_PX * 2 / max(float(np.median(np.diff(parts[0].time_s))), 1e-12)
    design = np.column_stack([np.ones(v.size), np.where(pulsed, 0.0, v), np.where(pulsed, v, 0.0)])
    if not at_rest.any() and np.linalg.matrix_rank(design, 1e-3 * float(np.abs(v).max(initial=1e-12))) < design.any(axis=0).sum():
        why = "all targets move at one speed along y: take a run at rest"
        return Estimates.from_rows([], reasons={ROW_OFFSET: why}), list(parts)
    offset = float(np.median(d[at_rest])) if at_rest.any() else float(np.linalg.lstsq(design, d, rcond=None)[0][0])
    u = STATIC_LAG_PX
    if abs(offset - SWAPPED_PX) < NEARLY:
        told = {ROW_OFFSET: "the rows of every pair are swapped: the grabber weaves the fields in the wrong order"}
        row = (ROW_OFFSET, offset, u, float(v.size), "px")
        found = Estimates.from_rows([row], method=METHOD, reasons=told, settings={"mode": "woven", "swapped": True})
        shift = np.array([0.0, SWAPPED_PX])
        return found, [replace(p, lag=p.lag - shift) for p in parts]
    if abs(offset) > NEARLY:
        what = f"odd rows lie {offset:.2f} rows from even ones at rest: the fields are not woven line by line"
        return Estimates.from_rows([], reasons={ROW_OFFSET: what}), list(parts)
    single = _alternates(parts)
    what = "the picture at rest alternates by half a row: single fields, even and odd in turn" if single else "the rows are in order"
    row = (ROW_OFFSET, abs(offset) + ONE_SIDED_95 * u, u, float(v.size), "px")
    found = Estimates.from_rows([row], method=METHOD, limits=frozenset([ROW_OFFSET]), reasons={ROW_OFFSET: what})
    settings: dict[str, str | int] = {"mode": "field", "field": "alternating"} if single else {"mode": "progressive", "swapped": False}
    return replace(found, settings=settings), list(parts)


def _alternates(parts: Sequence[_Followed]) -> bool:
    """Whether targets at rest go up and down by half a row from frame to frame, and do not move sideways."""
    for part in parts:
        if len(part.time_s) < FEWEST_STILL:
            continue
        middle = np.nanmean(part.places, axis=1)
        step = np.diff(middle, axis=0) * (-1.0) ** np.arange(len(middle) - 1)[:, None]
        mean, scatter = step.mean(axis=0), step.std(axis=0)
        if abs(abs(mean[1]) - ALTERNATE_PX) < NEARLY * ALTERNATE_PX and abs(mean[0]) < NEARLY * ALTERNATE_PX and scatter[1] < NEARLY:
            return True
    return False


def _exposure(parts: Sequence[_Followed], rows: Estimates) -> tuple[Estimates, float]:
    """Length of the exposure by the blur along the motion, and the stated one that it belongs to; 0 where none was stated.

    Runs of different stated exposures are taken together: their velocities count in proportion.
    """
    if not _moves(parts):
        return untold(NOTHING_MOVES), 0.0
    if not any(p.cuts for p in parts):
        return untold("the frames themselves are needed, not only places"), 0.0
    stated = [p.run.exposure_s for p in parts if _moves([p])] or [0.0]
    longest = max(stated)
    if longest > 0 >= min(stated):
        return untold("some runs state their exposure_s and others do not, and may differ: state it for all that move"), 0.0
    looks: dict[int, list[Look]] = {}
    for part, own in zip(parts, _known_again(parts), strict=True):
        share = part.run.exposure_s / longest if longest and part.run.exposure_s else 1.0  # without one, a run at rest
        for i, pairs in _looks(part).items():
            if i in own:
                both = [look for pair in pairs for look in pair]
                looks.setdefault(own[i], []).extend(replace(look, speed_px_s=look.speed_px_s * share) for look in both)
    moving = [np.sqrt(_speed_variance(p)) for p in parts if _moves([p])]
    u_speed = float(np.sqrt(np.mean(np.square(moving)) / len(moving)))
    return exposure_of(list(looks.values()), _signed_row_time_s(rows), u_speed), longest


def _signed_row_time_s(rows: Estimates) -> float:
    """Time from row to row, negative from the bottom up; 0 where it is not told."""
    if "row_time_s" not in rows or rows.limits:
        return 0.0
    return rows["row_time_s"].value * (-1.0 if rows.settings.get("first_row") == ROWS[2] else 1.0)


def _looks(part: _Followed) -> dict[int, list[tuple[Look, Look]]]:
    """Pictures of each target of a run in even and in odd rows."""
    found: dict[int, list[tuple[Look, Look]]] = {}
    for k, cut in enumerate(part.cuts):
        for i in np.flatnonzero(np.isfinite(part.lag[k]).all(axis=1)):
            even, odd = (part.places[k, i] + side * part.lag[k, i] for side in (-0.5, 0.5))
            at = cut.near(even)
            if at is not None:
                found.setdefault(int(i), []).append((cut.look(at, 0, even, part.speed[k, i]), cut.look(at, 1, odd, part.speed[k, i])))
    return found


def _known_again(parts: Sequence[_Followed]) -> list[dict[int, int]]:
    """For each run, its targets by their numbers in the first run."""
    first = _reference(parts[0])
    pairs = [_same_targets(first, _reference(part)) for part in parts]
    return [dict(zip(other.tolist(), one.tolist(), strict=True)) for one, other in pairs]


def _pulses(parts: Sequence[_Followed], fields: Estimates, exposure: Estimates, order: Estimates) -> Estimates:
    """Time between two pulses of light, and the share of steady light; nothing where no run is in such light."""
    pulsed = [p for p in parts if p.run.pulsed]
    names = ("separation_s", "ambient_share")
    if not pulsed:
        return Estimates.empty()
    if not _moves(pulsed):
        return Estimates.from_rows([], reasons=dict.fromkeys(names, NOTHING_MOVES))
    known = [fit[name].value for fit, name in ((fields, "field_period_s"), (exposure, "exposure_s")) if name in fit and not fit.limits]
    if len(known) < 2:
        what = "not separable: pulses farther apart, and steady light; take the same runs without pulses, which tell fields and exposure"
        return Estimates.from_rows([], reasons=dict.fromkeys(names, what))
    steady = next(p.run.exposure_s for p in parts if not p.run.pulsed)
    scale = pulsed[0].run.exposure_s / steady if steady and pulsed[0].run.exposure_s else 1.0
    first = fields.settings.get("first_field") == FIELDS[2]
    looks: dict[int, list[tuple[Look, Look]]] = {}
    for part, own in zip(pulsed, _known_again(pulsed), strict=True):
        for i, pairs in _looks(part).items():
            if i in own:
                looks.setdefault(own[i], []).extend((odd, even) if first else (even, odd) for even, odd in pairs)
    below = SWAPPED_PX * (-1.0 if first else 1.0) if order.settings.get("swapped") else 0.0
    return pulses_of(list(looks.values()), known[1] * scale, known[0], pulsed[0].run.exposure_s, below)


def _fields(parts: Sequence[_Followed], steady: Sequence[_Followed]) -> tuple[Estimates, Array, Array]:
    """Time between the fields, by the runs in steady light, and mean lag and its u of every frame."""
    normal, right = np.diag([0.0, STATIC_LAG_PX**-2, STATIC_LAG_PX**-2]), np.zeros(3)
    rows, lags, u_lags, of_speed = [], [], [], []
    for part in parts:
        seen = np.asarray(np.isfinite(part.lag).all(axis=2) & np.isfinite(part.speed).all(axis=2))
        weight = np.zeros_like(part.lag_covariance)
        weight[seen] = np.linalg.inv(part.lag_covariance[seen])
        lag, speed = np.where(seen[..., None], part.lag, 0.0), np.where(seen[..., None], part.speed, 0.0)
        design = np.zeros((*lag.shape, 3))
        design[..., 0] = speed
        design[..., 0, 1] = design[..., 1, 2] = 1.0
        own = np.einsum("kiap,kiab,kibq->pq", design, weight, design)
        if any(part is one for one in steady):
            normal += own
            of_speed.append(own[0, 0] ** 2 * _speed_variance(part))
            right += np.einsum("kiap,kiab,kib->p", design, weight, lag)
            rows.append((design, weight, lag))
        total = weight.sum(axis=1) + np.eye(2) * 1e-12
        lags.append(np.linalg.solve(total, np.einsum("kiab,kib->ka", weight, lag)[..., None])[..., 0])
        u_lags.append(np.sqrt(np.diagonal(np.linalg.inv(total), axis1=1, axis2=2)))
    lag, u_lag = np.concatenate(lags), np.concatenate(u_lags)
    if not _moves(steady):
        only = "light pulses decide when the fields are exposed: take a run without them" if not steady else NOTHING_MOVES
        return _untold("field_period_s", only), lag, u_lag
    found = np.linalg.solve(normal, right)
    left = [lag - design @ found for design, _, lag in rows]
    chi2 = sum(float(np.einsum("kia,kiab,kib->", r, w, r)) for r, (_, w, _) in zip(left, rows, strict=True))
    dof = sum(2 * int((w[..., 0, 0] > 0).sum()) for _, w, _ in rows) - 1
    slope = float(found[0]) / max(normal[0, 0], 1e-300)  # change of the result with the relative error of the speed of one run
    u = float(np.sqrt(np.linalg.inv(normal)[0, 0] * max(1.0, chi2 / max(dof, 1)) + slope**2 * sum(of_speed)))
    return _time("field_period_s", float(found[0]), u, dof, FIELDS, "even and odd rows are exposed together"), lag, u_lag


def _speed_variance(part: _Followed) -> float:
    """Relative variance of the speed of a run, from the scatter of all targets together about their paths (12 σ²/(n³ T²), n frames)."""
    speed = np.nanmean(part.speed, axis=1)
    size = np.linalg.norm(speed, axis=1)
    frames, period = len(part.time_s), float(np.median(np.diff(part.time_s)))
    if not size.min() > 0 or size.mean() * period < LEAST_PX:
        return 0.0
    left = (part.common * speed / size[:, None]).sum(axis=1)
    variance = float((left**2).sum()) / max(frames - PATH_DEGREE - 1, 1)
    return 12 * variance / (frames**3 * period**2 * float(size.mean()) ** 2)


def _moves(parts: Sequence[_Followed]) -> bool:
    """Whether anything moves from frame to frame."""
    return any(float(np.nanmax(np.linalg.norm(part.speed, axis=2))) * float(np.median(np.diff(part.time_s))) > LEAST_PX for part in parts)


def _time(name: str, value: float, u: float, dof: float, first: tuple[str, str, str], why: str) -> Estimates:
    """The size of a time, with its sign in words; or its limit."""
    if abs(value) > SIGNIFICANT * u:
        which, *rows = first
        told = {name: f"the {rows[value < 0]} row{'s are' if which == 'first_field' else ' is'} exposed first"}
        row = (name, abs(value), u, float(dof), "s")
        return Estimates.from_rows([row], method=METHOD, reasons=told, settings={which: rows[value < 0]})
    limit = abs(value) + ONE_SIDED_95 * u
    return Estimates.from_rows([(name, limit, u, float(dof), "s")], method=METHOD, limits=frozenset([name]), reasons={name: why})


def _untold(name: str, why: str) -> Estimates:
    return Estimates((), np.zeros(0), np.zeros((0, 0)), np.zeros(0), (), METHOD, reasons={name: why})


def _rows(parts: Sequence[_Followed], mean_speed: Array, frame_shape: tuple[int, int]) -> tuple[Estimates, Array, Array]:
    """Time from row to row, and shear and stretch of every frame with their u."""
    nothing = np.full((len(mean_speed), 2), np.nan)
    try:
        motion = _one_plate(parts, frame_shape)
    except MeasureError as problem:
        return _untold("row_time_s", str(problem.what)), nothing, nothing
    at = [motion.modes.index(mode) for mode in ("shear_rel", "affinity_rel")]
    used = motion.used
    shear = motion.values[:, at] * [1.0, -1.0]  # of x over y, and of y over y
    sign = np.array([1.0, -1.0])
    covariance = motion.covariance[:, at][:, :, at] * sign * sign[:, None] * max(1.0, motion.location_factor) ** 2
    u_shear = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    shear, u_shear = np.where(used[:, None], shear, np.nan), np.where(used[:, None], u_shear, np.nan)
    if not _moves(parts):
        return _untold("row_time_s", NOTHING_MOVES), shear, u_shear
    weight = np.linalg.inv(covariance[used])
    design = np.zeros((int(used.sum()), 2, 3))
    design[:, :, 0] = mean_speed[used]
    design[:, 0, 1] = design[:, 1, 2] = 1.0
    normal = np.einsum("kap,kab,kbq->pq", design, weight, design)
    size = np.sqrt(np.diag(normal))
    free = np.linalg.eigvalsh(normal / size / size[:, None])[0]
    spread = float(np.linalg.norm(mean_speed[used].std(axis=0)))
    noise = max(float(np.sqrt(_speed_variance(part)) * np.linalg.norm(np.nanmean(part.speed, axis=1), axis=1).mean()) for part in parts)
    if free < 1e-4 or spread < SPREAD * noise:
        why = "all frames have one velocity: the shear of the shutter is not told from that of the plate; move it at rest, to and fro"
        return _untold("row_time_s", why), shear, u_shear
    cofactor = np.linalg.inv(normal)
    found = cofactor @ np.einsum("kap,kab,kb->p", design, weight, shear[used])
    left = shear[used] - design @ found
    dof = 2 * int(used.sum()) - 3
    factor = max(1.0, float(np.einsum("ka,kab,kb->", left, weight, left)) / dof)
    of_speed = float(np.mean([_speed_variance(part) for part in parts])) / len(parts)
    value, u = float(found[0]), float(np.sqrt(cofactor[0, 0] * factor + found[0] ** 2 * of_speed))
    value *= 1 + value * float(mean_speed[used, 1].mean())  # for shear and stretch count from the mean plate, which is stretched
    return _time("row_time_s", value, u, dof, ROWS, "all rows are exposed together"), shear, u_shear


def _one_plate(parts: Sequence[_Followed], frame_shape: tuple[int, int]) -> FieldMotion:
    """Shear and stretch of all frames of all runs, about the mean plate."""
    first = _reference(parts[0])
    count = len(first)
    places, covariance = [], []
    for part in parts:
        own = np.full((len(part.places), count, 2), np.nan)
        own_covariance = np.full((len(part.places), count, 2, 2), np.nan)
        one, other = _same_targets(first, _reference(part))
        own[:, one], own_covariance[:, one] = part.places[:, other], part.covariance[:, other]
        places.append(own)
        covariance.append(own_covariance)
    centre = (0.5 * (frame_shape[1] - 1), 0.5 * (frame_shape[0] - 1))
    together, middle = np.concatenate(places), np.array(centre)
    shift = np.nanmean(together, axis=1, keepdims=True)
    motion = field_motion(together - shift + middle, np.concatenate(covariance), centre, analogue=True)
    assert motion.modes == (*CAMERA_MODES, *GRABBER_MODES)
    return motion


def _reference(part: _Followed) -> Array:
    """Places of all targets of a run about their middle: their means over the frames less the common motion."""
    shift = np.nanmean(part.places, axis=1, keepdims=True)
    mean: Array = np.nanmean(part.places - shift, axis=0)
    return mean


def _same_targets(known: Array, found: Array) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of targets of two plates that differ by a shift: the shift that most of them agree on."""
    shifts = (known[:, None] - found[None]).reshape(-1, 2)
    best: tuple[np.ndarray, np.ndarray] = (np.zeros(0, int), np.zeros(0, int))
    for shift in shifts:
        pairs = near_pairs(known, found + shift, 3.0)
        if len(pairs[0]) > len(best[0]):
            best = pairs
            if len(best[0]) == min(len(known), len(found)):
                break
    return best


def _jitter(parts: Sequence[_Followed]) -> Estimates:
    """Scatter of the time of exposure, from that of all targets of a frame about their paths, along the motion."""
    squares, noise, weights, dof = 0.0, 0.0, 0.0, 0
    across = []
    for part in parts:
        speed = np.nanmean(part.speed, axis=1)
        size = np.linalg.norm(speed, axis=1)
        if size.max() * np.median(np.diff(part.time_s)) < LEAST_PX or len(part.time_s) < LEAST_FRAMES + 2:
            continue
        along = speed / size[:, None]
        lost = len(part.time_s) / (len(part.time_s) - PATH_DEGREE - 1)
        squares += float(((part.common * along).sum(axis=1) ** 2).sum()) * lost
        across.append((part.common @ np.array([[0, 1], [-1, 0]]) * along).sum(axis=1) * np.sqrt(lost))
        noise += float((part.common_var * along**2).sum())
        weights += float((size**2).sum())
        dof += len(part.time_s) - PATH_DEGREE - 1
    if not dof:
        why = f"no run of {LEAST_FRAMES + 2} frames or more in which the targets move"
        return _untold("jitter_s", why)
    sideways = float((np.concatenate(across) ** 2).sum())  # what moves the camera moves it across too
    variance = (squares - max(noise, sideways)) / weights
    u = np.sqrt(2 / dof) * np.hypot(squares, max(noise, sideways)) / weights
    if variance > SIGNIFICANT * u:
        std = float(np.sqrt(variance))
        return Estimates.from_rows([("jitter_s", std, float(u) / (2 * std), float(dof), "s")], method=METHOD)
    limit = float(np.sqrt(max(variance, 0.0) + ONE_SIDED_95 * u))
    why = "no more scatter along the motion than across it and than the noise of the places"
    row = ("jitter_s", limit, float(np.sqrt(u)) / 2, float(dof), "s")
    return Estimates.from_rows([row], method=METHOD, limits=frozenset(["jitter_s"]), reasons={"jitter_s": why})
