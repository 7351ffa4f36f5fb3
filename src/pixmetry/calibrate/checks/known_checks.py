"""Scale bars and control points before they may pull at a network: image coordinates are tested without them, then they by the network.

A wrong bar with a small stated uncertainty is stronger than the image coordinates of its ends, and data snooping would throw these out.
So gross errors in the images are looked for without bars and control (`bundle.loosened`); then the known observations get
their weights, and the worst is left out and the network adjusted again as long as one is contradicted (Baarda's w-test). Where another one
explains the contradiction nearly as well, both are given the uncertainty of their supposed error instead. Known points most of whose image
points were rejected nevertheless are set free, and their image points take part again: it is then rather what was known that is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from pixmetry.calibrate.bundle.loosened import in_frame
from pixmetry.calibrate.bundle.network import Adjustment, Network, ScaleBars, State
from pixmetry.calibrate.checks.known_residuals import (
    Known,
    bar_names,
    bar_residuals,
    contradicted,
    control_residuals,
    group_record,
    jointly,
    rivals,
)
from pixmetry.calibrate.checks.snooping import Adjust, finest_factor, remove_gross_errors
from pixmetry.calibrate.checks.variance_components import image_sigma0, scaled
from pixmetry.calibrate.records import Contradicted, FixedPoints
from pixmetry.calibrate.start.fit_to_control import brought_to, far_from_control
from pixmetry.calibrate.start.resection import intersect, rays
from pixmetry.core.arrays import Array, Flags
from pixmetry.core.errors import InputError, MeasureError

LEAST_FIXED = 3  # points whose distances from each other can be tested
LEAST_CONTROL = 4  # whole points that must stay for one to be left out as a whole
LEFT = 1.5  # redundancy of the other control points without a wrong one: with less they could agree by chance
CONTROL_SHARE = 0.5  # of the points; more fixed ones are a test field
ABSURD = 0.1  # a bar that is wrong by such a part of its length, as one in other units, is out before any adjustment with it
ABSURD_U = 10.0  # stated uncertainties that a coordinate which is so far off is off by, too
WIDE = 2.0  # times what they seem to be, uncertainties are taken until gross errors are out
MANY_WRONG = 1 / 3  # of the control points: it is rather their uncertainties that are wrong
MOST = 20
Kind = Literal["scale_bars", "control_points"]
LEAST_RAYS = 3  # rejected rays that condemn a known point, where they are more than half
MOST_WRONG = 0.2  # part of the known points that can be wrong one by one,
ONE_OF = 4  # and one of so few


@dataclass(frozen=True)
class Raised:
    """A known value whose uncertainty was raised, with the one that was stated."""

    kind: Kind
    name: str
    u: float


@dataclass(frozen=True)
class KnownFaults:
    """Known values that a network contradicts.

    Parameters
    ----------
    scale_bars, control_points : tuple of Contradicted
    raised : tuple of Raised
    understated : float or None
        Factor by which the uncertainties of all control points were raised, if so.
    untested : str or None
        Why nothing of this could be tested, if so.
    """

    scale_bars: tuple[Contradicted, ...] = ()
    control_points: tuple[Contradicted, ...] = ()
    raised: tuple[Raised, ...] = ()
    understated: float | None = None
    untested: str | None = None

    def of(self, kind: Kind) -> tuple[Contradicted, ...]:
        """Those of one kind."""
        return self.scale_bars if kind == "scale_bars" else self.control_points

    def __add__(self, later: KnownFaults) -> KnownFaults:
        return KnownFaults(
            self.scale_bars + later.scale_bars,
            self.control_points + later.control_points,
            self.raised + later.raised,
            later.understated if self.understated is None else self.understated,
            later.untested if self.untested is None else self.untested,
        )


@dataclass(frozen=True)
class CheckedKnown:
    """A network whose bars and control points it does not contradict.

    Parameters
    ----------
    network : Network
    faults : KnownFaults
    """

    network: Network
    faults: KnownFaults = field(default_factory=KnownFaults)


def has_known(network: Network) -> bool:
    """Whether there are bars or control points that can be tested."""
    return has_stated(network) or bool(few_fixed(network).any())


def has_stated(network: Network) -> bool:
    """Whether there are bars, or points with a stated uncertainty."""
    return len(network.bars) > 0 or bool((np.isfinite(network.u_xyz) & (network.u_xyz > 0)).any())


def weighted_instead(network: Network, clean: Adjustment) -> Network:
    """The network with the few coordinates that are fixed given an uncertainty, that of one image of them: so they are tested."""
    fixed = few_fixed(network)
    if not fixed.any():
        return network
    state, rows = clean.state, clean.used & fixed[network.point]
    rows = rows if rows.any() else clean.used
    distance = np.linalg.norm(state.xyz[network.point[rows]] - state.position[network.image[rows]], axis=1)
    c_px = np.array([np.mean(clean.camera(k).c_px) for k in range(len(network.cameras))])[network.camera_of[network.image[rows]]]
    u = float(np.median(clean.sigma0 * np.sqrt(clean.network.covariance_px2[rows, 0]) * distance / c_px))
    return replace(network, u_xyz=np.where(few_held(network), u, network.u_xyz))


def fixed_again(network: Network, before: Network, weighted: Network) -> np.ndarray:
    """u_xyz of a checked network, with those coordinates fixed that had been so before and that nothing contradicts."""
    same = (network.u_xyz == weighted.u_xyz) & few_held(before)
    return np.where(same, before.u_xyz, network.u_xyz)


def few_fixed(network: Network) -> Flags:
    """Points with fixed coordinates, shape (points,), where they are control beside free points, and enough are known to contradict each
    other."""
    fixed: Flags = np.any(network.u_xyz == 0, axis=1)
    known: Flags = np.any(np.isfinite(network.u_xyz), axis=1)
    seen = np.bincount(network.point, minlength=len(network.points)) > 1
    few = known.sum() >= LEAST_CONTROL and fixed.sum() < CONTROL_SHARE * seen.sum()
    return fixed if few else np.zeros_like(fixed)


def few_held(network: Network) -> Flags:
    """The fixed coordinates of `few_fixed` points, shape (points, 3)."""
    held: Flags = (network.u_xyz == 0) & few_fixed(network)[:, None]
    return held


def fixed_record(adjustment: Adjustment, adjust: Adjust) -> FixedPoints | None:
    """Whether the fixed points of a network with free ones beside them fit it together; None without such points or without redundancy.

    The sum of squares falls by what the fixed points take when they are set free: over the degrees of freedom that go with them (3n − 7
    where nothing else gives the datum) and the variance of the free network it has an F-distribution.

    Parameters
    ----------
    adjustment : Adjustment
    adjust : callable
        `bundle.adjust`.

    References
    ----------
    K. R. Koch, Parameter Estimation and Hypothesis Testing in Linear Models (1999), 4.2 (general linear hypothesis).
    """
    from scipy import stats

    network = adjustment.network
    posed = adjustment.state.posed[network.image]
    seen = np.bincount(network.point[posed], minlength=len(network.points)) > 0
    fixed = (network.u_xyz == 0).any(axis=1) & seen
    if not LEAST_FIXED <= fixed.sum() < CONTROL_SHARE * seen.sum():
        return None
    try:  # what the fixed points threw out of their image points comes back, what the free network throws out goes
        released = replace(network, u_xyz=np.where(network.u_xyz == 0, np.inf, network.u_xyz))
        used = adjustment.used | (posed & fixed[network.point])
        free = remove_gross_errors(released, adjustment.state, adjust, used=used).adjustment
        held = adjust(network, adjustment.state, used=free.used, covariance=False)
    except MeasureError:  # the network hangs on them
        return None
    redundant = held.dof - free.dof
    if redundant < 1 or free.dof < 1:
        return None
    variance = max(free.sigma0**2, finest_factor(network))
    f = float((held.sigma0**2 * held.dof - free.sigma0**2 * free.dof) / redundant / variance)
    there = fixed & free.state.located
    known = (network.u_xyz == 0)[there]
    off = _off(free.state.xyz[there], network.xyz[there], known, free, int(known.sum()) - redundant)
    miss = float(np.sqrt((off**2).sum() / redundant * max(1 - 1 / max(f, 1.0), 0.0)))
    return FixedPoints(int(there.sum()), f, (redundant, free.dof), float(stats.f.sf(f, redundant, free.dof)), miss)


def _off(found: Array, given: Array, known: Flags, free: Adjustment, missing: int) -> np.ndarray:
    """By how much known coordinates miss their points, without what the datum leaves open: so many of its seven parameters."""
    if missing > 0:
        held = np.isfinite(free.network.u_xyz).all(axis=1) & free.state.located
        found = brought_to(found, given, known, scaled=not len(free.network.bars) and held.sum() < 2)
    return (given - found)[known]


def loose_coordinates(network: Network) -> Flags:
    """Coordinates of control points that could pull at the image coordinates, shape (points, 3)."""
    return np.isfinite(network.u_xyz) & ((network.u_xyz > 0) | few_held(network))


def check_known(
    network: Network, clean: Adjustment, adjust: Adjust, state: State, used: np.ndarray, *, held: np.ndarray | None = None
) -> tuple[CheckedKnown, State]:
    """Leave out bars and control points that the network contradicts; where these would be many, see whether their uncertainties are only
    stated too small.

    The network comes back with image coordinates weighted as the loosened one says, beside which bars and control points have their place;
    the state is that of the adjustment with them.

    Parameters
    ----------
    network : Network
    clean : Adjustment
        Of the `pixmetry.calibrate.bundle.loosened` network, without gross errors in the images.
    adjust : callable
        `bundle.adjust`, or the same with some options chosen; with a posteriori covariances.
    state : State
        Where to begin.
    used : ndarray of bool, shape (n,)
        Image points that take part.
    held : ndarray of bool, shape (points, 3), optional
        Coordinates whose uncertainties are not those that they came with (`weighted_instead`).

    Raises
    ------
    InputError
        If two bars differ by far and nothing tells which of them is wrong.
    """
    sigma0, dof = image_sigma0(clean)
    size = max(sigma0**2, finest_factor(network))
    weights = scaled(network, np.full((len(network.cameras), 2), size))  # from now on sigma0 of the image coordinates is 1
    checked, state = _without_absurd(CheckedKnown(weights), state)
    left, adjustment = _without_contradicted(checked, state, used, adjust, dof)
    out, control = _wrong_points(left), np.isfinite(weights.u_xyz) & (weights.u_xyz > 0)
    if held is not None:
        control &= ~held
    whole = int(control.all(axis=1).sum())
    if whole < LEAST_CONTROL or out <= MANY_WRONG * control.any(axis=1).sum():
        return left, adjustment.state
    factor = WIDE * _understatement(weights, control, clean)
    try:
        again, adjustment = _without_contradicted(_raised(checked, control, factor), adjustment.state, used, adjust, dof)
    except MeasureError:  # with so little weight they do not hold the network
        return left, adjustment.state
    group = group_record(adjustment, control_residuals(adjustment))
    if 2 * _wrong_points(again) > out or group is None:
        return left, adjustment.state  # with larger uncertainties they are wrong all the same
    better = float(np.sqrt(group.factor))
    faults = replace(again.faults, understated=factor * better)
    return replace(_raised(again, control, better), faults=faults), adjustment.state


def _wrong_points(checked: CheckedKnown) -> int:
    """Control points that are contradicted, or that may be wrong instead."""
    names = (name for found in checked.faults.control_points for name in (found.name, *(found.rivals or ())))
    return len({name.rpartition(" ")[0] for name in names})


def _without_contradicted(
    checked: CheckedKnown, state: State, used: np.ndarray, adjust: Adjust, dof: float
) -> tuple[CheckedKnown, Adjustment]:
    for _ in range(MOST):
        adjustment = adjust(checked.network, state, used=used, redundancy=True)
        state = adjustment.state
        kinds: dict[Kind, Known] = {"scale_bars": bar_residuals(adjustment), "control_points": control_residuals(adjustment)}
        worst = {kind: found for kind, known in kinds.items() if (found := contradicted(known, 1.0, dof))}
        if not worst:
            break
        kind = max(worst, key=lambda kind: worst[kind][0].statistic)
        known, found = kinds[kind], worst[kind]
        if kind == "control_points":
            joint = _together(adjustment, adjust)
            known, found = (known, found[:1]) if joint is None else (joint, contradicted(joint, 1.0, dof) or found[:1])
        checked = _without(checked, known, found, kind)
    return checked, adjustment


def _together(adjustment: Adjustment, adjust: Adjust) -> Known | None:
    """Residuals of the control points with what they have to do with each other; None where that cannot be had."""
    network, state = adjustment.network, adjustment.state
    try:
        joint = adjust(jointly(network, state), state, used=adjustment.used, redundancy=True)
    except MeasureError:
        return None
    return control_residuals(replace(joint, network=network))


def _raised(checked: CheckedKnown, control: np.ndarray, factor: float) -> CheckedKnown:
    u = checked.network.u_xyz
    return replace(checked, network=replace(checked.network, u_xyz=np.where(control, factor * u, u)))


def _understatement(network: Network, control: np.ndarray, clean: Adjustment) -> float:
    """What the middle one of the whole control points is off by, where they hardly pull at the network, over what was stated."""
    from scipy import stats

    from pixmetry.calibrate.start.resection import fitted

    rows = np.flatnonzero(control.all(axis=1) & clean.state.located)
    away = fitted(clean.state.xyz[rows], network.xyz[rows])[3]
    return float(np.sqrt(np.median(away**2 / np.mean(network.u_xyz[rows] ** 2, axis=1)) / stats.chi2.median(3)))


def without_absurd_control(network: Network, state: State) -> tuple[Network, tuple[Contradicted, ...]]:
    """The network without weighted control points that lie far from where most of the others put them, such as those with swapped names;
    and their records."""
    from pixmetry.calibrate.start.resection import fitted

    control = np.isfinite(network.u_xyz).all(axis=1) & (network.u_xyz > 0).any(axis=1)
    rows = np.flatnonzero(control & state.located)
    if len(rows) <= LEAST_CONTROL:
        return network, ()
    away = fitted(state.xyz[rows], network.xyz[rows])[3]
    limit = ABSURD * float(np.ptp(network.xyz[rows], axis=0).max())
    bad = np.flatnonzero(away > limit)
    if not len(bad) or len(rows) - len(bad) < LEAST_CONTROL:
        return network, ()
    return set_free(network, rows[bad]), tuple(_far_off(network.points[rows[i]], float(away[i]), limit) for i in bad)


def _far_off(name: str, off: float, limit: float) -> Contradicted:
    """A control point that lies farther off than any error of measurement."""
    return Contradicted(name, off, off, off, limit, left_out=True)


def in_frame_of_control(network: Network, state: State) -> tuple[Network, State, tuple[Contradicted, ...]]:
    """The state in the frame in which most known coordinates of control points are right; the network without points that lie far from
    where it puts them; and their records.

    Parameters
    ----------
    network : Network
    state : State
        Without gross errors in the images, in any frame.
    """
    weighted: Flags = np.any(np.isfinite(network.u_xyz), axis=1) & np.all(network.u_xyz > 0, axis=1)
    u = np.where(weighted[:, None], network.u_xyz, np.inf)
    known = network.xyz[np.isfinite(u).all(axis=1)]
    limit = ABSURD * float(np.ptp(known, axis=0).max()) if len(known) else 0.0
    fit = far_from_control(state.xyz, network.xyz, u, limit) if (network.u_xyz > 0).all() else None
    if fit is None:
        return network, state, ()
    moved, miss = fit
    bad = np.flatnonzero((np.abs(miss) > np.maximum(limit, ABSURD_U * np.where(np.isfinite(u), u, 0.0))).any(axis=1))
    found = tuple(_far_off(network.points[k], float(np.linalg.norm(miss[k])), limit) for k in bad)
    return set_free(network, bad), in_frame(state, state.xyz, moved), found


def _without_absurd(checked: CheckedKnown, state: State) -> tuple[CheckedKnown, State]:
    """Leave out bars in other units than most, or between other points: no adjustment could start with them. Bring the rest to scale."""
    bars = checked.network.bars
    if not len(bars):
        return checked, state
    state, scaled_by_points = _to_scale_of_control(state, checked.network)
    computed = np.linalg.norm(state.xyz[bars.end] - state.xyz[bars.start], axis=1)
    ratio, scale = bars.length / computed, 1.0
    if not scaled_by_points and np.isfinite(ratio).any():
        scale = float(np.nanmedian(ratio))
        state = _enlarged(state, checked.network, scale)
    bad = np.flatnonzero(np.abs(ratio / scale - 1) > ABSURD)
    if len(bad) == len(bars) and not scaled_by_points:
        found = "lengths over computed ones: " + ", ".join(f"{one:.6g}" for one in ratio)
        what = f"the {'two ' if len(bars) == 2 else ''}scale bars contradict each other"
        raise InputError(what, where="scale bars", value=found, remedy="check their units and points")
    found_bars, names = [], bar_names(checked.network)
    for i in bad:
        error = float(bars.length[i] - scale * computed[i])
        statistic, critical = float(abs(error) / bars.u[i]), float(ABSURD * bars.length[i] / bars.u[i])
        found_bars.append(Contradicted(names[i], error, error, statistic, critical, left_out=True))
    kept = np.setdiff1d(np.arange(len(bars)), bad)
    network = replace(checked.network, bars=ScaleBars(bars.start[kept], bars.end[kept], bars.length[kept], bars.u[kept]))
    return CheckedKnown(network, replace(checked.faults, scale_bars=tuple(found_bars))), state


def _to_scale_of_control(state: State, network: Network) -> tuple[State, bool]:
    """The state in the scale of most distances between whole control points, if bars had brought it to another; whether there are any."""
    from scipy.spatial.distance import pdist

    whole = network.control & state.located
    if whole.sum() < 2:
        return state, False
    ratio = float(np.median(pdist(network.xyz[whole]) / np.maximum(pdist(state.xyz[whole]), 1e-300)))
    return (_enlarged(state, network, ratio) if ABSURD < abs(ratio - 1) < np.inf and ratio > 0 else state), True


def _enlarged(state: State, network: Network, scale: float) -> State:
    """The state scaled about the middle of the known points; fixed values stay."""
    known = np.isfinite(network.u_xyz).any(axis=1) & state.located
    middle = state.xyz[known].mean(axis=0) if known.any() else np.zeros(3)
    xyz = np.where(network.u_xyz == 0, state.xyz, middle + scale * (state.xyz - middle))
    return replace(state, xyz=xyz, position=middle + scale * (state.position - middle))


def _without(checked: CheckedKnown, known: Known, found: list[Contradicted], kind: Kind) -> CheckedKnown:
    """Leave out the value that is contradicted most; if others may be wrong instead, give all of them the uncertainty of their error."""
    wrong = [known.name.index(one.name) for one in found]
    going: list[int] = []
    if kind == "scale_bars":
        others, alone = rivals(known, wrong, 1.0), True
        network = _less_bars(checked.network, known, wrong[0], others)
    else:
        going = _going(checked.network, known, wrong[0])
        alone = known.redundancy.sum() - len(going) > LEFT
        others = rivals(known, wrong, 1.0) if alone else rivals(known, wrong[:1], 1.0, found[0].critical)
        network = _less_control(checked.network, known, wrong[0], others, going if alone else [])
    left_out = bool(alone and not others)
    axes = tuple(k % 3 for k in going) if left_out else ()
    worst = replace(found[0], left_out=left_out, rivals=tuple(known.name[i] for i in others), axes=axes)
    more = KnownFaults(scale_bars=(worst,)) if kind == "scale_bars" else KnownFaults(control_points=(worst,))
    return CheckedKnown(network, checked.faults + more)


def _supposed(known: Known, rows: list[int]) -> Array:
    """Sizes of the errors that these would have."""
    sizes: Array = np.abs(known.residual[rows]) / known.redundancy[rows]
    return sizes


def _less_bars(network: Network, known: Known, row: int, others: list[int]) -> Network:
    bars, rows = network.bars, [row, *others]
    if others:
        u = bars.u.copy()
        u[known.index[rows]] = np.maximum(u[known.index[rows]], _supposed(known, rows))
        return replace(network, bars=replace(bars, u=u))
    kept = np.arange(len(bars)) != known.index[row]
    return replace(network, bars=ScaleBars(bars.start[kept], bars.end[kept], bars.length[kept], bars.u[kept]))


def _going(network: Network, known: Known, row: int) -> list[int]:
    """Coordinates that go with a wrong one, as places in all of them: of many whole points the whole, for it may be another point; of few,
    its height or its position only."""
    point, axis = divmod(int(known.index[row]), 3)
    few = np.isfinite(network.u_xyz).all(axis=1).sum() <= LEAST_CONTROL
    axes = [0, 1, 2] if not few else [2] if axis == 2 else [0, 1]
    return [3 * point + k for k in axes if np.isfinite(network.u_xyz[point, k])]


def _less_control(network: Network, known: Known, row: int, others: list[int], going: list[int]) -> Network:
    u, rows = network.u_xyz.copy(), [row, *others]
    if others or not going:
        u.flat[known.index[rows]] = np.maximum(u.flat[known.index[rows]], _supposed(known, rows))
    else:
        u.flat[going] = np.inf
    return replace(network, u_xyz=u)


def _stated_of_bars(given: ScaleBars, used: ScaleBars) -> list[float]:
    """Stated uncertainties of the bars that are left; of some with the same length between the same points, its own if it is unchanged."""
    table = np.column_stack([given.start, given.end, given.length])
    rest, out = np.ones(len(given), bool), []
    for i in range(len(used)):
        same = np.flatnonzero(rest & (table == [used.start[i], used.end[i], used.length[i]]).all(axis=1))
        k = min(same, key=lambda k: given.u[k] != used.u[i])
        rest[k] = False
        out.append(float(given.u[k]))
    return out


def raised(given: Network, used: Network) -> tuple[Raised, ...]:
    """Bars and control coordinates that are less certain in one network than they were given in another."""
    out, bars = [], used.bars
    for i, (name, stated) in enumerate(zip(bar_names(used), _stated_of_bars(given.bars, bars), strict=True)):
        if bars.u[i] > stated:
            out.append(Raised("scale_bars", name, float(stated)))
    for k, axis in np.argwhere(np.isfinite(used.u_xyz) & (used.u_xyz > given.u_xyz)):
        out.append(Raised("control_points", f"{given.points[k]} {'XYZ'[axis]}", float(given.u_xyz[k, axis])))
    return tuple(out)


def mostly_lost(network: Network, adjustment: Adjustment) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of which something is known and most of whose image points in oriented images are out: indices, image points, those out."""
    size = len(network.points)
    posed = adjustment.state.posed[network.image]
    seen = np.bincount(network.point[posed], minlength=size)
    out = seen - np.bincount(network.point[adjustment.used], minlength=size)
    known = np.isfinite(network.u_xyz).any(axis=1)
    lost = np.flatnonzero(known & (out >= LEAST_RAYS) & (2 * out > seen))
    return lost, seen[lost], out[lost]


def wrong_known(network: Network, adjustment: Adjustment) -> np.ndarray:
    """Known points most of whose image points were rejected, as indices; none if they are so many that it is the field that is wrong."""
    lost, known = mostly_lost(network, adjustment)[0], int(np.isfinite(network.u_xyz).any(axis=1).sum())
    return lost if len(lost) <= max(MOST_WRONG * known, float(known >= ONE_OF)) else lost[:0]


def set_free(network: Network, points: np.ndarray) -> Network:
    """The network with some points free; their coordinates stay as start values."""
    u = network.u_xyz.copy()
    u[points] = np.inf
    return replace(network, u_xyz=u)


def where_seen(network: Network, adjustment: Adjustment, points: np.ndarray) -> State:
    """The state with some points where most of their rays meet; those whose rays meet nowhere stay."""
    state, rows = adjustment.state, np.flatnonzero(np.isin(network.point, points))
    image, uv = network.image[rows], np.full((len(rows), 2), np.nan)
    for k in range(len(network.cameras)):
        mine = np.flatnonzero(network.camera_of[image] == k)
        uv[mine] = np.column_stack(adjustment.camera(k).direction_of(network.x_px[rows[mine]], network.y_px[rows[mine]]))
    off = np.sqrt(network.covariance_px2[rows, 0]) * adjustment.sigma0
    tolerance = float(np.median(off / np.array([np.mean(adjustment.camera(k).c_px) for k in network.camera_of[image]])))
    found = intersect(state.position[image], rays(uv, state.rotation[image]), network.point[rows], len(state.xyz), tolerance)[0]
    return replace(state, xyz=np.where(np.isfinite(found), found, state.xyz))


def lost_records(given: Network, adjustment: Adjustment, points: np.ndarray) -> tuple[Contradicted, ...]:
    """How far points that were set free lie from where they were said to be, along the axes of which something was said; statistic and
    critical value of a χ² test, as its root.

    Parameters
    ----------
    given : Network
        Before they were set free.
    adjustment : Adjustment
    points : ndarray of int
    """
    from scipy import stats

    records = []
    for k in points:
        axes = np.flatnonzero(np.isfinite(given.u_xyz[k]) & np.isfinite(given.xyz[k]))
        off = (given.xyz[k] - adjustment.state.xyz[k])[axes]
        covariance = adjustment.point_covariance[k][np.ix_(axes, axes)] + np.diag(given.u_xyz[k, axes] ** 2)
        if not len(axes) or not np.isfinite(covariance).all():
            continue
        name, size = given.points[k], float(np.linalg.norm(off))
        if len(axes) == 1:
            name, size = f"{name} {'XYZ'[axes[0]]}", float(off[0])
        statistic = float(np.sqrt(off @ np.linalg.solve(covariance, off)))
        critical = float(np.sqrt(stats.chi2.isf(0.01 / len(given.points), len(axes))))
        records.append(Contradicted(name, size, size, statistic, critical, left_out=True))
    return tuple(records)
