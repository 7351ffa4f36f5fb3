"""Scale bars and control points before they may pull at a network: image coordinates are tested without them, then they by the network.

A wrong bar with a small stated uncertainty is stronger than the image coordinates of its ends, and data snooping would throw these out.
So gross errors in the images are looked for without bars, and with control points that hardly weigh; then the known observations get their
weights, and the worst is left out and the network adjusted again as long as one is contradicted (Baarda's w-test). A fixed point most of
whose image points are gross errors is a wrong point: it is set free, and they take part again.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pixmetry.calibration.known_residuals import Known, bar_residuals, contradicted, control_residuals, group_record
from pixmetry.calibration.network import Adjustment, Network, ScaleBars, State
from pixmetry.calibration.resection import similarity
from pixmetry.calibration.snooping import Adjust, finest_factor, remove_gross_errors
from pixmetry.calibration.variance_components import image_sigma0, scaled
from pixmetry.core.errors import InputError, MeasureError

LOOSE = 0.05  # uncertainty, as a part of the field's extent, with which a control point does not pull at the image coordinates
INSEPARABLE = 0.99  # correlation of two residuals from which on it cannot be said which of the two is wrong
LEAST_FIXED = 3  # points whose distances from each other can be tested
LEAST_CONTROL = 4  # points that must stay for one to be left out
CONTROL_SHARE = 0.5  # of the points; more fixed ones are a test field
ABSURD = 0.1  # a bar that is wrong by such a part of its length, as one in other units, is out before any adjustment with it
LEAST_RAYS = 3  # rejected rays that condemn a fixed point, where they are more than half
MOST_WRONG = 0.2  # part of the fixed points that can be wrong one by one
WIDE = 2.0  # times what they seem to be, uncertainties are taken until gross errors are out
MANY_WRONG = 1 / 3  # of the control points: it is rather their uncertainties that are wrong
MOST = 20


@dataclass(frozen=True)
class CheckedKnown:
    """A network whose bars and control points it does not contradict.

    Parameters
    ----------
    network : Network
    gross : dict
        By ``scale_bars`` and ``control_points``: records as of `contradicted`, with ``left_out``; where it is False, the uncertainties of
        all bars were raised to the size of the contradiction. ``understated``: the ``factor`` by which those of all control points were
        raised instead, if so.
    """

    network: Network
    gross: dict[str, list[dict[str, Any]]] = field(default_factory=lambda: {"scale_bars": [], "control_points": [], "understated": []})


def has_known(network: Network) -> bool:
    """Whether there are bars or control points that can be tested."""
    return has_stated(network) or bool(few_fixed(network).any())


def has_stated(network: Network) -> bool:
    """Whether there are bars, or points with a stated uncertainty."""
    return len(network.bars) > 0 or bool((np.isfinite(network.u_xyz) & (network.u_xyz > 0)).any())


def weighted_instead(network: Network, clean: Adjustment) -> Network:
    """The network with the few points that are fixed given an uncertainty, that of one image of them: so they are tested."""
    fixed = few_fixed(network)
    if not fixed.any():
        return network
    state, rows = clean.state, clean.used & fixed[network.point]
    distance = np.linalg.norm(state.xyz[network.point[rows]] - state.position[network.image[rows]], axis=1)
    c_px = np.array([np.mean(clean.camera(k).c_px) for k in range(len(network.cameras))])[network.camera_of[network.image[rows]]]
    u = float(np.median(clean.sigma0 * np.sqrt(clean.network.covariance_px2[rows, 0]) * distance / c_px))
    return replace(network, u_xyz=np.where(fixed[:, None], u, network.u_xyz))


def fixed_again(network: Network, before: Network, weighted: Network) -> np.ndarray:
    """u_xyz of a checked network, with those points fixed that had been so before and that nothing contradicts."""
    same = (network.u_xyz == weighted.u_xyz).all(axis=1) & few_fixed(before)
    return np.where(same[:, None], before.u_xyz, network.u_xyz)


def few_fixed(network: Network) -> np.ndarray:
    """Fixed points, shape (points,), where they are control beside points that are free, and enough to contradict each other."""
    fixed = (network.u_xyz == 0).all(axis=1)
    seen = np.bincount(network.point, minlength=len(network.points)) > 1
    return fixed if LEAST_CONTROL <= fixed.sum() < CONTROL_SHARE * seen.sum() else np.zeros_like(fixed)


def fixed_record(adjustment: Adjustment, adjust: Adjust) -> dict[str, Any] | None:
    """Whether the fixed points of a network with free ones beside them fit it together; None without such points or without redundancy.

    The sum of squares falls by what the fixed points take when they are set free: over the degrees of freedom that go with them (3n − 7
    where nothing else gives the datum) and the variance of the free network it has an F-distribution.

    Parameters
    ----------
    adjustment : Adjustment
    adjust : callable
        `bundle.adjust`.

    Returns
    -------
    dict
        ``n``, ``f``, ``dof`` (of both), ``p``, and ``miss``: standard deviation of a coordinate that would explain it.

    References
    ----------
    K. R. Koch, Parameter Estimation and Hypothesis Testing in Linear Models (1999), 4.2 (general linear hypothesis).
    """
    from scipy import stats

    network = adjustment.network
    posed = np.isfinite(adjustment.state.position).all(axis=1)[network.image]
    seen = np.bincount(network.point[posed], minlength=len(network.points)) > 0
    fixed = (network.u_xyz == 0).all(axis=1) & seen
    if not LEAST_FIXED <= fixed.sum() < CONTROL_SHARE * seen.sum():
        return None
    try:  # what the fixed points threw out of their image points comes back, what the free network throws out goes
        released, used = set_free(network, np.flatnonzero(fixed)), adjustment.used | (posed & fixed[network.point])
        free = remove_gross_errors(released, adjustment.state, adjust, used=used).adjustment
        held = adjust(network, adjustment.state, used=free.used, covariance=False)
    except MeasureError:  # the network hangs on them
        return None
    redundant = held.dof - free.dof
    if redundant < 1 or free.dof < 1:
        return None
    variance = max(free.sigma0**2, finest_factor(network))
    f = float((held.sigma0**2 * held.dof - free.sigma0**2 * free.dof) / redundant / variance)
    there = fixed & np.isfinite(free.state.xyz).all(axis=1)
    off = _off(free.state.xyz[there], network.xyz[there], free, 3 * int(there.sum()) - redundant)
    miss = float(np.sqrt((off**2).sum() / redundant * max(1 - 1 / max(f, 1.0), 0.0)))
    return {"n": int(there.sum()), "f": f, "dof": (redundant, free.dof), "p": float(stats.f.sf(f, redundant, free.dof)), "miss": miss}


def _off(found: np.ndarray, given: np.ndarray, free: Adjustment, missing: int) -> np.ndarray:
    """Distances of points from where they should be, without what the datum leaves open: so many of its seven parameters."""
    if missing <= 0:
        return np.linalg.norm(given - found, axis=1)
    held = np.isfinite(free.network.u_xyz).all(axis=1) & np.isfinite(free.state.xyz).all(axis=1)
    scale, rotation, shift = similarity(found, given, np.ones(len(found)), scaled=not len(free.network.bars) and held.sum() < 2)
    return np.linalg.norm(given - scale * found @ rotation.T - shift, axis=1)


def loosened(network: Network) -> Network:
    """The network without bars, and with control points that hardly weigh."""
    weighted = np.isfinite(network.u_xyz) & ((network.u_xyz > 0) | few_fixed(network)[:, None])
    known = network.xyz[np.isfinite(network.xyz).all(axis=1)]
    extent = float(np.ptp(known, axis=0).max()) if len(known) else 0.0
    u_xyz = np.where(weighted, np.maximum(network.u_xyz, LOOSE * extent), network.u_xyz)
    return replace(network, bars=ScaleBars.none(), u_xyz=u_xyz)


def check_known(network: Network, clean: Adjustment, adjust: Adjust, *, stated: bool = True) -> tuple[CheckedKnown, State]:
    """Leave out bars and control points that the network contradicts; where these would be many, see whether their uncertainties are only
    stated too small.

    The network comes back with image coordinates weighted as the loosened one says, beside which bars and control points have their place;
    the state is that of the adjustment with them.

    Parameters
    ----------
    network : Network
    clean : Adjustment
        Of the `loosened` network, without gross errors in the images.
    adjust : callable
        `bundle.adjust`, or the same with some options chosen; with a posteriori covariances.
    stated : bool
        Whether the uncertainties of control points are those that they came with.

    Raises
    ------
    InputError
        If two bars differ by far and nothing tells which of them is wrong.
    """
    sigma0, dof = image_sigma0(clean)
    size = max(sigma0**2, finest_factor(network))
    weights = scaled(network, np.full((len(network.cameras), 2), size))  # from now on sigma0 of the image coordinates is 1
    checked, state = _without_absurd(CheckedKnown(weights), clean.state)
    left, adjustment = _without_contradicted(checked, state, clean, adjust, dof)
    out, control = len(left.gross["control_points"]), np.isfinite(weights.u_xyz) & (weights.u_xyz > 0)
    if not stated or out <= MANY_WRONG * control.any(axis=1).sum():
        return left, adjustment.state
    factor = WIDE * _understatement(weights, clean)
    again, adjustment = _without_contradicted(_raised(checked, factor), adjustment.state, clean, adjust, dof)
    group = group_record(adjustment, control_residuals(adjustment))
    if 2 * len(again.gross["control_points"]) > out or group is None:
        return left, adjustment.state  # with larger uncertainties they are wrong all the same
    better = float(np.sqrt(group["factor"]))
    gross = {**again.gross, "understated": [{"factor": factor * better}]}
    return replace(_raised(again, better), gross=gross), adjustment.state


def _without_contradicted(
    checked: CheckedKnown, state: State, clean: Adjustment, adjust: Adjust, dof: float
) -> tuple[CheckedKnown, Adjustment]:
    for _ in range(MOST):
        adjustment = adjust(checked.network, state, used=clean.used, redundancy=True)
        state = adjustment.state
        bars, control = bar_residuals(adjustment), control_residuals(adjustment)
        worst = [(k, found[0]) for k in (bars, control) if (found := contradicted(k, 1.0, dof))]
        if not worst:
            break
        known, record = max(worst, key=lambda item: item[1]["statistic"])
        checked = _without(checked, known, record, is_bar=known is bars)
        if not checked.gross["scale_bars" if known is bars else "control_points"][-1]["left_out"]:
            break
    return checked, adjustment


def _raised(checked: CheckedKnown, factor: float) -> CheckedKnown:
    u = checked.network.u_xyz
    return replace(checked, network=replace(checked.network, u_xyz=np.where(np.isfinite(u), factor * u, u)))


def _understatement(network: Network, clean: Adjustment) -> float:
    """What the middle one of the control points is off by, where they hardly pull at the network, over what was stated."""
    from scipy import stats

    from pixmetry.calibration.resection import fitted

    stated = np.isfinite(network.u_xyz).all(axis=1) & (network.u_xyz > 0).all(axis=1)
    rows = np.flatnonzero(stated & np.isfinite(clean.state.xyz).all(axis=1))
    away = fitted(clean.state.xyz[rows], network.xyz[rows])[3]
    return float(np.sqrt(np.median(away**2 / np.mean(network.u_xyz[rows] ** 2, axis=1)) / stats.chi2.median(3)))


def without_absurd_control(network: Network, state: State) -> tuple[Network, list[dict[str, Any]]]:
    """The network without weighted control points that lie far from where most of the others put them, such as those with swapped names;
    and their records."""
    from pixmetry.calibration.resection import fitted

    control = np.isfinite(network.u_xyz).all(axis=1) & (network.u_xyz > 0).any(axis=1)
    rows = np.flatnonzero(control & np.isfinite(state.xyz).all(axis=1))
    if len(rows) <= LEAST_CONTROL:
        return network, []
    away = fitted(state.xyz[rows], network.xyz[rows])[3]
    limit = ABSURD * float(np.ptp(network.xyz[rows], axis=0).max())
    bad = np.flatnonzero(away > limit)
    if not len(bad) or len(rows) - len(bad) < LEAST_CONTROL:
        return network, []
    size = {"critical": limit, "left_out": True}
    measured = [(network.points[rows[i]], float(away[i])) for i in bad]
    records = [{"name": name, "residual": off, "error": off, "statistic": off, **size} for name, off in measured]
    return set_free(network, rows[bad]), records


def _without_absurd(checked: CheckedKnown, state: State) -> tuple[CheckedKnown, State]:
    """Leave out bars in other units than most, or between other points: no adjustment could start with them. Bring the rest to scale."""
    bars = checked.network.bars
    if not len(bars):
        return checked, state
    computed = np.linalg.norm(state.xyz[bars.end] - state.xyz[bars.start], axis=1)
    ratio = bars.length / computed
    scale = 1.0
    if not np.isfinite(checked.network.u_xyz).any() and np.isfinite(ratio).any():
        scale = float(np.nanmedian(ratio))
        state = replace(state, xyz=scale * state.xyz, position=scale * state.position)
    bad = np.flatnonzero(np.abs(ratio / scale - 1) > ABSURD)
    if len(bad) and np.isinf(checked.network.u_xyz).all() and len(bars) < 3:
        found = f"lengths over computed ones: {ratio[0]:.6g}, {ratio[1]:.6g}"
        raise InputError("the two scale bars contradict each other", where="scale bars", value=found, remedy="check their units and points")
    records = []
    for i in bad:
        name = f"{checked.network.points[bars.start[i]]}–{checked.network.points[bars.end[i]]}"
        error = float(bars.length[i] - scale * computed[i])
        limit = {"statistic": float(abs(error) / bars.u[i]), "critical": float(ABSURD * bars.length[i] / bars.u[i])}
        records.append({"name": name, "residual": error, "error": error, **limit, "left_out": True})
    kept = np.setdiff1d(np.arange(len(bars)), bad)
    network = replace(checked.network, bars=ScaleBars(bars.start[kept], bars.end[kept], bars.length[kept], bars.u[kept]))
    return CheckedKnown(network, {**checked.gross, "scale_bars": records}), state


def wrong_fixed(network: Network, adjustment: Adjustment) -> np.ndarray:
    """Fixed points most of whose image points were rejected, as indices; none if they are so many that it is the field that is wrong."""
    size = len(network.points)
    rays = np.bincount(network.point, minlength=size)
    out = rays - np.bincount(network.point[adjustment.used], minlength=size)
    fixed = (network.u_xyz == 0).all(axis=1)
    wrong = np.flatnonzero(fixed & (out >= LEAST_RAYS) & (2 * out > rays))
    return wrong if len(wrong) <= MOST_WRONG * fixed.sum() else wrong[:0]


def set_free(network: Network, points: np.ndarray) -> Network:
    """The network with some points free; their coordinates stay as start values."""
    u = network.u_xyz.copy()
    u[points] = np.inf
    return replace(network, u_xyz=u)


def wrong_fixed_records(adjustment: Adjustment, points: np.ndarray) -> list[dict[str, Any]]:
    """How far points that were set free lie from where they were said to be; statistic and critical value of a χ² test, as its root."""
    from scipy import stats

    network, records = adjustment.network, []
    critical = float(np.sqrt(stats.chi2.isf(0.01 / len(network.points), 3)))
    for k in points:
        off, covariance = network.xyz[k] - adjustment.state.xyz[k], adjustment.point_covariance[k]
        if np.isfinite(covariance).all():
            size = float(np.linalg.norm(off))
            statistic = float(np.sqrt(off @ np.linalg.solve(covariance, off)))
            limit = {"statistic": statistic, "critical": critical}
            records.append({"name": network.points[k], "residual": size, "error": size, **limit, "left_out": True})
    return records


def _without(checked: CheckedKnown, known: Known, record: dict[str, Any], *, is_bar: bool) -> CheckedKnown:
    network, row = checked.network, known.name.index(record["name"])
    index = int(known.index[row])
    if is_bar:
        alone = _separable(known, row)
        bars = network.bars
        kept = np.arange(len(bars)) != index
        if alone:
            bars = ScaleBars(bars.start[kept], bars.end[kept], bars.length[kept], bars.u[kept])
        else:
            bars = replace(bars, u=np.maximum(bars.u, abs(record["error"])))
        network = replace(network, bars=bars)
    else:
        weighted = np.isfinite(network.u_xyz).all(axis=1)
        alone = bool(weighted.sum() > LEAST_CONTROL)
        u = network.u_xyz.copy()
        point = index // 3
        u[point] = np.inf if alone else np.maximum(u[point], abs(record["error"]))
        network = replace(network, u_xyz=u)
    kind = "scale_bars" if is_bar else "control_points"
    gross = {**checked.gross, kind: [*checked.gross[kind], {**record, "left_out": alone}]}
    return CheckedKnown(network, gross)


def _separable(known: Known, row: int) -> bool:
    u = np.sqrt(np.maximum(np.diag(known.cofactor), 1e-300))
    others = np.delete(known.cofactor[row] / u / u[row], row)
    return bool(np.abs(others).max(initial=0.0) < INSEPARABLE)
