"""Moving targets: time between the fields of a frame, time from row to row, jitter of the trigger.

The two sets of rows of a frame, even and odd, are located apart. Where they are exposed at different times, a target of velocity v lies
v T_f apart in them. Where rows are exposed one after the other, the picture of a moving plate is sheared by v_x t_row and stretched by
v_y t_row. Velocities come from the places in successive frames: a wrong time between frames makes all times wrong by the same factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pixmetry.camera.drift_series import CAMERA_MODES, GRABBER_MODES
from pixmetry.camera.motion_series import MotionSeries
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
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
NOTHING_MOVES = "nothing moves: let the targets move by a pixel or more from frame to frame"


@dataclass(frozen=True)
class Run:
    """Frames taken one after the other: the targets in even and in odd rows, each in order of time."""

    even: tuple[FrameTargets, ...]
    odd: tuple[FrameTargets, ...]


def find_in_fields(frame: np.ndarray, name: str, time_s: float, **options: Any) -> tuple[FrameTargets, FrameTargets]:
    """Find the targets in the even and in the odd rows of a frame; places count in rows of the frame.

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
    return both[0], both[1]


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
    speed = np.concatenate([p.speed for p in parts])
    seen = np.isfinite(speed).all(axis=2)
    counted = np.maximum(seen.sum(axis=1), 1)[:, None]
    mean_speed = np.where(seen[..., None], speed, 0).sum(axis=1) / counted
    fields, lag, u_lag = _fields(parts)
    rows, shear, u_shear = _rows(parts, mean_speed, frame_shape)
    jitter = _jitter(parts)
    return MotionSeries(
        frames=len(speed), targets=int(seen.sum(axis=1).max()), speed_px_s=mean_speed, lag_px=lag, shear=shear, u_lag_px=u_lag,
        u_shear=u_shear, fit=fields.join(rows, jitter),
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
    return _Followed(time_s, places, covariance, lag, lag_covariance, speed, common, variance)


def _fields(parts: Sequence[_Followed]) -> tuple[Estimates, Array, Array]:
    """Time between the fields, and mean lag and its u of every frame."""
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
        normal += own
        of_speed.append(own[0, 0] ** 2 * _speed_variance(part))
        right += np.einsum("kiap,kiab,kib->p", design, weight, lag)
        rows.append((design, weight, lag))
        total = weight.sum(axis=1) + np.eye(2) * 1e-12
        lags.append(np.linalg.solve(total, np.einsum("kiab,kib->ka", weight, lag)[..., None])[..., 0])
        u_lags.append(np.sqrt(np.diagonal(np.linalg.inv(total), axis1=1, axis2=2)))
    found = np.linalg.solve(normal, right)
    left = [lag - design @ found for design, _, lag in rows]
    chi2 = sum(float(np.einsum("kia,kiab,kib->", r, w, r)) for r, (_, w, _) in zip(left, rows, strict=True))
    dof = sum(2 * int((w[..., 0, 0] > 0).sum()) for _, w, _ in rows) - 1
    slope = float(found[0]) / max(normal[0, 0], 1e-300)  # change of the result with the relative error of the speed of one run
    u = float(np.sqrt(np.linalg.inv(normal)[0, 0] * max(1.0, chi2 / max(dof, 1)) + slope**2 * sum(of_speed)))
    lag, u_lag = np.concatenate(lags), np.concatenate(u_lags)
    if not _moves(parts):
        return _untold("field_period_s", NOTHING_MOVES), lag, u_lag
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
