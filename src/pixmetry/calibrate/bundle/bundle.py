"""Self-calibrating bundle adjustment: all cameras, images and points at once, by least squares.

Gauss–Newton steps, on arcs for the cameras; where a step would not lower the cost as it should, it gets its second-order term, and where
that does not help, it is damped after Levenberg and Marquardt: the valleys of long lenses and flat fields are narrow and bent. Points are
eliminated (D. C. Brown, The bundle adjustment: progress and prospects, Int. Arch. Photogrammetry 21 (1976)), so that the system to be
solved holds the interior parameters, the images and the points that scale bars join. It is brought to a unit diagonal. Where control does
not fix the datum, H Hᵀ of the missing similarity parameters makes it regular; this changes no residual. A robust loss is least squares with
weights anew in each iteration (P. W. Holland and R. E. Welsch, Commun. Statist. A 6 (1977) 813–827).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pixmetry.calibrate.bundle.bundle_covariance import Cofactors, cofactors, raise_weak, residual_cofactors_px2
from pixmetry.calibrate.bundle.bundle_layout import Layout, layout_of, without
from pixmetry.calibrate.bundle.bundle_system import LOSSES, Linearised, Loss, Solved, bent, cost, equations, linearise, point_roots, solve
from pixmetry.calibrate.bundle.datum import Datum, aligned, datum_of, nearest_to_control
from pixmetry.calibrate.bundle.network import Adjustment, Network, State
from pixmetry.calibrate.bundle.rig import Ties, rigid
from pixmetry.core.arrays import Array, Flags
from pixmetry.core.errors import InputError
from pixmetry.core.threads import single_threaded_blas

SMALL = 1e-3  # largest (step / standard deviation)², over all unknowns, of a last step, and
LEFT, LEFT_ROBUST = 1e-6, 1e-4  # what the step after it would have
ROUNDING = 1e-14  # the same per image coordinate, in a priori weights: residuals that are nought
DAMPING_START, DAMPING_LEAST, DAMPING_MOST = 1e-6, 1e-7, 1e8
NEAR = 0.01  # share of the cost below which a step is one of the last
STRAIGHT = 0.5  # share of the predicted gain below which the way is bent, and a step with its second-order term is tried
PART = 0.1  # of a step, over which its bend is measured
MEET = 1e-11  # least pivot of a point's equations: the square of the angle at which its rays meet


def adjust(
    network: Network,
    start: State,
    *,
    loss: str = "none",
    loss_scale: float = 2.5,
    used: Flags | None = None,
    redundancy: bool = False,
    covariance: bool = True,
    a_priori: bool = False,
    max_iterations: int = 100,
) -> Adjustment:
    """Adjust a network.

    Parameters
    ----------
    network : Network
    start : State
        Start values; NaN: not determined, then its image coordinates take no part.
    loss : {"none", "huber", "cauchy"}
        How large residuals count.
    loss_scale : float
        Where they begin to count less, in (robust) standard deviations of an image point.
    used : ndarray of bool, shape (n,), optional
        Image coordinates that take part; all by default.
    redundancy : bool
        Also give redundancy numbers and cofactors of the residuals; those of an image coordinate that takes no part are its own and its
        prediction's together.
    covariance : bool
        Without it, the covariances are empty: (0, 0), and NaN for points; and a minimum that is not reached within ``max_iterations`` is
        no error but one of the notes.
    a_priori : bool
        Do not scale the covariances by the a posteriori sigma0².
    max_iterations : int

    Returns
    -------
    Adjustment

    Raises
    ------
    InputError
        If the loss is none of these, or a covariance or a bar cannot be.
    MeasureError
        If nothing can be adjusted, the unknowns are not determined (names them), or no minimum is found.
    """
    if loss not in LOSSES:
        raise InputError("no such loss", where="loss", value=loss, allowed=", ".join(LOSSES))
    with single_threaded_blas():
        layout, counts = layout_of(network, start, used), Loss(loss, loss_scale)
        start = _in_order(layout, start)
        datum = datum_of(layout, start)
        start = nearest_to_control(layout, start, datum)
        now = linearise(layout, aligned(layout, start, datum), counts)
        work = np.empty((len(layout.columns), len(layout.columns)))
        _, pivot = point_roots(layout, equations(layout, now, work)[1])
        loose = np.flatnonzero((pivot < MEET) & layout.determined)
        if len(loose):
            layout = without(layout, start, loose)
            datum = datum_of(layout, start)
            now = linearise(layout, aligned(layout, start, datum), counts)
            work = np.empty((len(layout.columns), len(layout.columns)))
        at, solved, now, costs = _iterate(layout, datum, now, counts, max_iterations, work)
        if solved is None:
            what = f"no minimum was found within {len(costs) - 1} steps"
            if covariance:
                raise_weak(layout, datum, now, what)
            layout = replace(layout, notes=(*layout.notes, what))
        found = cofactors(layout, datum, at, solved, redundancy) if covariance and solved is not None else None
        return _result(layout, datum, now, found, costs, redundancy, a_priori)


def _in_order(layout: Layout, start: State) -> State:
    """Fixed coordinates are those of the network; cameras of a rig stand still against each other; per-image parameters have mean zero over
    a camera's images."""
    x_scale, x_shift = start.x_scale.copy(), start.x_shift_px.copy()
    for place, values in zip(layout.extra, (x_scale, x_shift), strict=True):
        for k in range(len(layout.free)) if place >= 0 else ():
            of_camera = (layout.image_col >= 0) & (layout.camera_of == k)
            values[of_camera] -= values[of_camera].sum() / max(1, of_camera.sum())
    xyz = np.where(layout.held & np.isfinite(start.xyz), layout.network.xyz, start.xyz)
    start = replace(start, x_scale=x_scale, x_shift_px=x_shift, xyz=xyz)
    return start if layout.rig is None else rigid(layout.rig, start)


def _moved(layout: Layout, state: State, solved: Solved) -> State:
    """The state after a step."""
    interior, rotation, position = state.interior.copy(), state.rotation.copy(), state.position.copy()
    x_scale, x_shift, xyz = state.x_scale.copy(), state.x_shift_px.copy(), state.xyz + solved.points
    joined = np.flatnonzero(layout.point_col >= 0)
    xyz[joined] += np.where(layout.held[joined], 0.0, solved.step[layout.point_col[joined][:, None] + np.arange(3)])
    for k in range(len(layout.free)):
        count = layout.camera_count[k]
        interior[k, layout.free[k, :count]] += solved.step[layout.camera_col[k] : layout.camera_col[k] + count]
    there = np.flatnonzero(layout.image_col >= 0)
    at = layout.image_col[there]
    turn, shift = solved.step[at[:, None] + np.arange(3)], solved.step[at[:, None] + np.arange(3, 6)]
    position[there] += _along_arc(rotation[there], turn, shift)
    rotation[there] = _turns(turn) @ rotation[there]
    if solved.ties is not None:
        rotation, position = _rig_moved(solved.ties, solved.step, rotation, position)
    for place, values in zip(layout.extra, (x_scale, x_shift), strict=True):
        if place >= 0:
            values[there] += solved.step[at + place]
    return State(interior, rotation, position, x_scale, x_shift, xyz)


def _rig_moved(ties: Ties, step: Array, rotation: Array, position: Array) -> tuple[Array, Array]:
    """Poses of all images after a step whose images of a rig stay together."""
    rig, before, inner = ties.rig, ties.frames, ties.inner(step)
    turn, shift = (inner[ties.base[:, None] + np.arange(first, first + 3)] for first in (0, 3))
    R, d, some = before.rotation.copy(), before.place.copy(), np.flatnonzero(ties.rel >= 0)
    R[some] = _turns(inner[ties.rel[some][:, None] + np.arange(3)]) @ R[some]
    d[some] += inner[ties.rel[some][:, None] + np.arange(3, 6)]
    at = before.base_position + _along_arc(before.base_rotation, turn, shift)
    base, t, k = _turns(turn) @ before.base_rotation, rig.instant, rig.camera
    rotation[rig.image] = R[k] @ base[t]
    position[rig.image] = at[t] + np.einsum("nji,nj->ni", base[t], d[k])
    return rotation, position


def _along_arc(rotation: Array, turn: Array, shift: Array) -> Array:
    """Shifts of projection centres, bent as a screw motion bends them: a camera that turns with its object in view goes round the object,
    not along the tangent (the exponential map of SE(3): F. Dellaert, M. Kaess, Factor Graphs for Robot Perception (2017), chapter 6).

    Rᵀ J R shift, with J = 1 − (1 − cos θ)/θ² [w]× + (θ − sin θ)/θ³ [w]×².
    """
    angle = np.maximum(np.linalg.norm(turn, axis=1), 1e-4)[:, None]  # below it the factors have their limits but for 1e-9
    along = np.einsum("nij,nj->ni", rotation, shift)
    across = np.cross(turn, along)
    bent = along - (1 - np.cos(angle)) / angle**2 * across + (angle - np.sin(angle)) / angle**3 * np.cross(turn, across)
    arc: Array = np.einsum("nji,nj->ni", rotation, bent)
    return arc


def _turns(w: Array) -> Array:
    """Rotation matrices exp([w]×) of rotation vectors, shape (n, 3, 3)."""
    from scipy.spatial.transform import Rotation

    turns: Array = Rotation.from_rotvec(w).as_matrix()
    return turns


def _iterate(
    layout: Layout, datum: Datum, now: Linearised, loss: Loss, most: int, work: np.ndarray
) -> tuple[Linearised, Solved | None, Linearised, list[float]]:
    """Iterate until the step is small; returns the equations of the last step, their solution (None: not reached), and the new state."""
    dof = max(1, _dof(layout, datum))
    tolerance = LEFT if loss.kind == "none" else LEFT_ROBUST
    damping, costs, before, placed = 0.0, [now.cost], 0.0, True
    near = datum.missing < 6  # then the state is aligned step by step: only small motions leave what is held as it is
    for _ in range(most):
        solved = solve(layout, datum, now, damping, work)
        if solved is not None:
            if solved.gain < NEAR * now.cost:
                near = True
                loss = replace(loss, unit=now.unit)  # weights by a scale that goes on moving need not settle
            last = _is_last(solved.gain, before, now.cost / dof, tolerance, ROUNDING * len(layout.x))
            after = _after(layout, datum, now, solved, loss, near)
            fall = _fall(layout, now, after)
            if not last and fall < STRAIGHT * solved.gain:
                other = _after(layout, datum, now, bent(layout, now, solved, _bend(layout, now, solved, loss)), loss, near)
                if _fall(layout, now, other) > fall:
                    after, fall = other, _fall(layout, now, other)
            if fall >= -now.cost * (1e-6 if last else 1e-12) - ROUNDING:
                costs.append(after.cost)
                if last and placed and damping == 0.0:
                    return now, solved, after, costs
                before = solved.gain if damping == 0.0 else 0.0
                kept = fall / solved.gain if solved.gain > 0 else 1.0
                damping *= max(0.1, 1 - (2 * min(kept, 1.0) - 1) ** 3)
                now, placed = after, near
                if last or damping < DAMPING_LEAST:
                    damping = 0.0
                continue
        damping = max(10 * damping, DAMPING_START)
        if damping > DAMPING_MOST:
            raise_weak(layout, datum, now, f"no minimum was found: after {len(costs) - 1} steps none lowers the cost")
    return now, None, now, costs


def _after(layout: Layout, datum: Datum, now: Linearised, solved: Solved, loss: Loss, align: bool) -> Linearised:
    state = _moved(layout, now.state, solved)
    return linearise(layout, aligned(layout, state, datum) if align else state, loss)


def _bend(layout: Layout, now: Linearised, solved: Solved, loss: Loss) -> np.ndarray:
    """Second derivative of the residuals along a step, by differences; 0 where a point loses its image."""
    ahead, behind = (linearise(layout, _moved(layout, now.state, _part(solved, part)), loss) for part in (PART, -PART))
    second = (ahead.residual - 2 * now.residual + behind.residual) / PART**2
    return np.where((now.valid & ahead.valid & behind.valid)[:, None], second, 0.0)


def _part(solved: Solved, share: float) -> Solved:
    return replace(solved, step=share * solved.step, points=share * solved.points)


def _is_last(gain: float, before: float, variance: float, tolerance: float, rounding: float) -> bool:
    """Whether what the next step would gain (gain²/before, as steps shrink in a fixed ratio or faster) is nothing to speak of.

    A gain over the variance of unit weight is the square of the step's length in standard deviations of all unknowns together.
    """
    gain = abs(gain)
    following = gain * min(1.0, gain / before) if before > 0 else gain
    return gain <= rounding or (gain <= SMALL * variance and following <= tolerance * variance)


def _fall(layout: Layout, now: Linearised, after: Linearised) -> float:
    """By how much the cost fell, with the weights as they were; −inf if an image point was lost."""
    if (now.valid & ~after.valid).any():
        return -np.inf
    fall = now.cost - cost(layout, after.state, after.residual, now.weight)
    return fall if np.isfinite(fall) else -np.inf


def _dof(layout: Layout, datum: Datum) -> int:
    """Observations and constraints less unknowns."""
    dependent = 0 if layout.rig is None else 6 * len(layout.rig.image) - layout.rig.unknowns
    known = int(((layout.prior > 0) & layout.determined[:, None]).sum())
    unknown = int((~layout.held & layout.determined[:, None]).sum())
    free = int(layout.camera_count.sum()) + int((layout.image_col >= 0).sum()) * layout.per_image - dependent
    return 2 * int(layout.used.sum()) + len(layout.bars) + known + len(layout.constraints) + datum.missing - free - unknown


def _result(
    layout: Layout, datum: Datum, now: Linearised, found: Cofactors | None, costs: list[float], redundancy: bool, a_priori: bool
) -> Adjustment:
    network, n = layout.network, len(layout.network)
    dof = _dof(layout, datum) - 2 * int((layout.used & ~now.valid).sum())
    sigma0 = float(np.sqrt(now.cost / dof)) if dof > 0 else 1.0
    factor = 1.0 if a_priori else sigma0**2
    residual, used, weight = np.full((n, 2), np.nan), np.zeros(n, bool), np.ones(n)
    w = layout.whiten
    own = now.residual[:, 0] / w[:, 0]
    residual[layout.order] = np.stack([own, (now.residual[:, 1] - w[:, 1] * own) / w[:, 2]], axis=1)
    residual[layout.order[~now.valid]] = np.nan
    used[layout.order] = layout.used & now.valid
    weight[layout.order] = np.where(now.weight > 0, now.weight, 1.0)
    numbers = variances = None
    if found is not None and found.residuals is not None:  # as redundancy was asked for
        numbers, variances = np.full((n, 2), np.nan), np.full((n, 3), np.nan)
        numbers[layout.order], variances[layout.order] = residual_cofactors_px2(layout, now, found.residuals)
    notes = layout.notes
    lost = int((layout.used & ~now.valid).sum())
    if lost:
        notes += (f"{lost} image points take no part: the adjusted point is behind its camera, or the distortion has no inverse there",)
    if dof <= 0:
        notes += ("there is no redundancy: the standard deviation of unit weight cannot be estimated and is set to 1",)
    return Adjustment(
        network=network,
        state=_of_determined(layout, now.state),
        used=used,
        residual_px=residual,
        weight=weight,
        sigma0=sigma0,
        dof=dof,
        free_columns=layout.free_columns,
        covariance=np.zeros((0, 0)) if found is None else np.multiply(found.reduced, factor, out=found.reduced),
        point_covariance=np.full((len(network.points), 3, 3), np.nan) if found is None else factor * found.points,
        redundancy=numbers,
        residual_covariance_px2=variances,
        datum=datum.text,
        iterations=len(costs) - 1,
        cost=tuple(costs),
        notes=notes,
    )


def _of_determined(layout: Layout, state: State) -> State:
    """NaN for images and points that were not used, except completely known points; fixed values keep their digits."""
    images, points = layout.image_col >= 0, layout.determined
    partly: Flags = np.any(np.isinf(layout.network.u_xyz), axis=1)
    known = np.where(partly[:, None] & ~points[:, None], np.nan, layout.network.xyz)
    return replace(
        state,
        rotation=np.where(images[:, None, None], state.rotation, np.nan),
        position=np.where(images[:, None], state.position, np.nan),
        xyz=np.where(points[:, None] & ~layout.held, state.xyz, known),
    )
