"""Scale bars and control points: does the network contradict what was known beforehand?

What is contradicted most is taken out and the others are tested again (in closed form: conditioning on its residual), so that one wrong
bar is not followed by the others that it has dragged along. The unit of the tests is the sigma0 of the image coordinates alone.
`control_of` says by how much given coordinates differ from those found.

References
----------
W. Baarda, A testing procedure for use in geodetic networks (1968).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment, Network, ScaleBars, State
from pixmetry.calibrate.checks.snooping import LEAST_REDUNDANCY, finest_factor
from pixmetry.calibrate.checks.variance_components import image_sigma0
from pixmetry.calibrate.records import Calibration, Contradicted, KnownGroup, Ratio
from pixmetry.core.arrays import Array

LIKELY = 2 * np.log(100.0)  # difference of two squared statistics: odds of 100 that it is the one and not the other that is wrong
SLIGHT = 1e-4  # redundancy from which on an error of something can be what others show
NOTHING_KNOWN = 1e6  # uncertainty of a bar that says nothing, over its length
MOST_JOINT = 100  # control points whose joint covariance is worth its time: of more, each has little to do with the others
NAMED = 2  # largest residuals of a group


@dataclass(frozen=True)
class Known:
    """Residuals of what was known beforehand.

    Parameters
    ----------
    name : tuple of str
    index : ndarray of int, shape (m,)
        Number of the bar; 3 × number of the point + number of the axis.
    value, residual, u : ndarray, shape (m,)
        Known value; known less computed; standard uncertainty a priori.
    cofactor : ndarray, shape (m, m)
        Of the residuals, for unit weight 1; correlations between control points only where these are in the joint covariance.
    """

    name: tuple[str, ...]
    index: np.ndarray
    value: np.ndarray
    residual: np.ndarray
    u: np.ndarray
    cofactor: np.ndarray

    def __len__(self) -> int:
        return len(self.name)

    @property
    def redundancy(self) -> Array:
        """Redundancy numbers, 0 … 1."""
        numbers: Array = np.clip(np.diag(self.cofactor) / self.u**2, 0.0, 1.0)
        return numbers


def bar_names(network: Network) -> tuple[str, ...]:
    """The ends of each bar; of several between the same points, the further ones are numbered."""
    ends = [f"{network.points[i]}–{network.points[k]}" for i, k in zip(network.bars.start, network.bars.end, strict=True)]
    before = [ends[:i].count(name) for i, name in enumerate(ends)]
    return tuple(f"{name} ({n + 1})" if n else name for name, n in zip(ends, before, strict=True))


def bar_residuals(adjustment: Adjustment, *, a_priori: bool = False) -> Known:
    """Residuals of the scale bars whose ends are determined; ``a_priori``: the covariance of the adjustment is without sigma0²."""
    network, bars = adjustment.network, adjustment.network.bars
    between = adjustment.state.xyz[bars.end] - adjustment.state.xyz[bars.start]
    length = np.linalg.norm(between, axis=1)
    there = np.flatnonzero(np.isfinite(length))
    places = {name: i for i, name in enumerate(adjustment.free_columns)}
    slopes = np.zeros((len(there), len(places)))
    for row, i in enumerate(there):
        for point, sign in ((bars.start[i], -1.0), (bars.end[i], 1.0)):
            for axis in range(3):
                place = places.get(f"{network.points[point]}:{'XYZ'[axis]}")
                if place is not None:
                    slopes[row, place] += sign * between[i, axis] / length[i]
    unit = 1.0 if a_priori else adjustment.sigma0**2
    touched = np.flatnonzero(slopes.any(axis=0))
    spread = slopes[:, touched] @ adjustment.covariance[np.ix_(touched, touched)] @ slopes[:, touched].T / unit
    names, u = tuple(bar_names(network)[i] for i in there), bars.u[there]
    return Known(names, there, bars.length[there], bars.length[there] - length[there], u, np.diag(u**2) - spread)


def control_residuals(adjustment: Adjustment, *, a_priori: bool = False) -> Known:
    """Residuals of the coordinates of points that are known with an uncertainty."""
    network, unit = adjustment.network, 1.0 if a_priori else adjustment.sigma0**2
    variance = np.diagonal(adjustment.point_covariance, axis1=1, axis2=2) / unit
    there = np.isfinite(network.u_xyz) & (network.u_xyz > 0) & np.isfinite(network.xyz) & np.isfinite(variance)
    names = tuple(f"{network.points[k]} {'XYZ'[axis]}" for k, axis in zip(*np.nonzero(there), strict=True))
    value, u, cofactor = network.xyz[there], network.u_xyz[there], np.diag(network.u_xyz[there] ** 2 - variance[there])
    places = {name: i for i, name in enumerate(adjustment.free_columns)}
    column = np.array([places.get(f"{network.points[k]}:{'XYZ'[axis]}", -1) for k, axis in np.argwhere(there)], int)
    joint = np.flatnonzero(column >= 0)
    cofactor[np.ix_(joint, joint)] = np.diag(u[joint] ** 2) - adjustment.covariance[np.ix_(column[joint], column[joint])] / unit
    return Known(names, np.flatnonzero(there), value, value - adjustment.state.xyz[there], u, cofactor)


def jointly(network: Network, state: State) -> Network:
    """The network with its control points in the joint covariance: bars that say nothing lead from one to the next."""
    known = np.isfinite(network.u_xyz) & (network.u_xyz > 0) & np.isfinite(network.xyz)
    seen = np.bincount(network.point, minlength=len(network.points)) > 0
    rows = np.flatnonzero(known.any(axis=1) & seen & state.located)
    if not 1 < len(rows) <= MOST_JOINT:
        return network
    b, length = network.bars, np.linalg.norm(state.xyz[rows[1:]] - state.xyz[rows[:-1]], axis=1)
    some, nothing = length > 0, NOTHING_KNOWN * length.sum()
    more = (rows[:-1][some], rows[1:][some], length[some], np.full(some.sum(), nothing))
    return replace(network, bars=ScaleBars(*(np.concatenate(two) for two in zip((b.start, b.end, b.length, b.u), more, strict=True))))


def contradicted(known: Known, sigma0: float, dof: float, false_alarms: float = 0.01) -> list[Contradicted]:
    """Values that the network contradicts, worst first.

    Parameters
    ----------
    known : Known
    sigma0, dof : float
        Of the image coordinates alone (`image_sigma0`).
    false_alarms : float
        Right ones that may be expected to be named; the level of each test is this over their number.
    """
    from scipy import stats

    if not len(known):
        return []
    critical = float(stats.t.isf(false_alarms / len(known) / 2, max(dof, 1.0)))
    v, q, out = known.residual.copy(), known.cofactor.copy(), []
    for _ in range(len(known)):
        w = _statistics(known, v, q) / sigma0
        worst = int(np.argmax(w))
        if not w[worst] > critical:
            break
        error = v[worst] * known.u[worst] ** 2 / q[worst, worst]
        out.append(Contradicted(known.name[worst], float(known.residual[worst]), float(error), float(w[worst]), critical))
        v, q = _without(v, q, worst)
    return out


def rivals(known: Known, wrong: Sequence[int], sigma0: float, above: float = np.inf) -> list[int]:
    """Those of which one may be wrong in place of the first of ``wrong``, beside the others of these: of two of them alone, each would
    explain the residuals nearly as well (their χ² differ by less than `LIKELY`), or their statistic is above a critical value."""
    v, q = known.residual.copy(), known.cofactor.copy()
    for i in wrong[1:]:
        v, q = _without(v, q, i)
    square = (_statistics(known, v, q, SLIGHT) / sigma0) ** 2
    near = square > min(max(square[wrong[0]] - LIKELY, 0.0), above**2)
    return [int(i) for i in np.flatnonzero(near) if i not in wrong]


def _statistics(known: Known, v: np.ndarray, q: np.ndarray, least: float = LEAST_REDUNDANCY) -> np.ndarray:
    """|v| over its standard deviation, of those that have some redundancy."""
    testable = np.diag(q) > least * known.u**2
    return np.where(testable, np.abs(v), 0.0) / np.sqrt(np.where(testable, np.diag(q), 1.0))


def _without(v: np.ndarray, q: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Residuals and their cofactors with one of them left out."""
    if not q[i, i] > 0:
        return v, q
    column = q[:, i] / q[i, i]
    v, q = v - column * v[i], q - np.outer(column, q[i])
    v[i] = 0.0
    q[i, :] = q[:, i] = 0.0
    return v, q


def group_record(adjustment: Adjustment, known: Known) -> KnownGroup | None:
    """Variance factor of a group; None without redundancy."""
    from scipy import stats

    dof = float(known.redundancy.sum())
    if dof < 0.5:
        return None
    sigma0, dof_images = image_sigma0(adjustment)
    factor = float((known.residual**2 / known.u**2).sum() / dof / max(sigma0**2, finest_factor(adjustment.network)))
    tail = stats.f.sf(factor, dof, dof_images)
    ratio = known.residual / known.u
    largest = tuple(Ratio(known.name[i], float(ratio[i])) for i in np.argsort(-np.abs(ratio))[:NAMED])
    return KnownGroup(factor, dof, float(2 * min(tail, 1 - tail)), len(known), largest)


@dataclass(frozen=True)
class Control:
    """Coordinates that were given with an uncertainty, of points that the adjustment determined.

    Parameters
    ----------
    point : ndarray of int, shape (m,)
    axis : ndarray of int, shape (m,)
        0, 1, 2 for X, Y, Z.
    given, u, residual : ndarray, shape (m,)
        In the object's unit; the residual is given less adjusted, NaN of points of which no image point is left.
    raised : ndarray of bool, shape (m,)
        Those that weighed less than their u says, for the network contradicts them.
    """

    point: np.ndarray
    axis: np.ndarray
    given: np.ndarray
    u: np.ndarray
    residual: np.ndarray
    raised: np.ndarray

    def __len__(self) -> int:
        return len(self.point)


def control_of(calibration: Calibration) -> Control:
    """Given less adjusted coordinates of all weighted control points, point by point, with the uncertainties that were stated.

    A control point that the network contradicts has been set free and is among the gross errors instead, or weighs less.
    """
    network, found = calibration.adjustment.network, calibration.adjustment.state.xyz
    weighted = np.isfinite(network.u_xyz) & (network.u_xyz > 0) & np.isfinite(network.xyz) & np.isfinite(found)
    point, axis = np.nonzero(weighted)
    names = [f"{network.points[k]} {'XYZ'[a]}" for k, a in zip(point, axis, strict=True)]
    raised = calibration.tests.known.control_points.raised if calibration.tests.known is not None else {}
    stated = np.array([raised.get(name, u) for name, u in zip(names, network.u_xyz[weighted], strict=True)], float)
    rays = np.bincount(network.point[calibration.adjustment.used], minlength=len(network.points))
    residual = np.where(rays[point] > 0, network.xyz[weighted] - found[weighted], np.nan)
    return Control(point, axis, network.xyz[weighted], stated, residual, np.array([name in raised for name in names], bool))
