"""Points of few rays that lost some: which of their rays agree with each other.

Where one of three or four rays is far off, a robust adjustment pulls the point so far that good rays look worse than the bad one, and once
a single ray is left nothing can be tested any more. With so few rays all their sets can be tried: with poses and cameras as they are, each
set is intersected by least squares, and a set agrees if none of its rays would be rejected in it, that is if leaving out any of them lowers
χ² by no more than the critical value. The largest set that agrees is taken. Where another one as large agrees too, but meets elsewhere, the
odds for it are exp(−Δχ²/2), for one ray or the other is wrong without anything being known of its error. Such points are decided, the
surest first, as long as no more wrong choices than false alarms are to be expected; of the rest it cannot be told which rays are right, and
none of these takes part.

References
----------
M. A. Fischler, R. C. Bolles, Random sample consensus, Commun. ACM 24 (1981) 381–395 (consensus sets; here all of them are tried).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import combinations

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment, Network, State
from pixmetry.core.arrays import Array

MOST_RAYS = 8  # of more, most are good, and the tests of an adjustment tell
MEET = 1e-11  # least determinant of a set's equations over the product of their diagonal: rays that hardly meet at an angle
REWEIGHTS = 3  # of the linear equations of an intersection by the depths found
AT_ONCE = 4000  # points


@dataclass(frozen=True)
class Mended:
    """Points with few rays, whose rays were selected again.

    Parameters
    ----------
    points : ndarray of int, shape (p,)
        Those where this changes something, and those where it cannot be told which rays are right.
    used : ndarray of bool, shape (n,)
        Image points that take part from now on.
    xyz : ndarray, shape (points, 3)
        Start values of all points.
    statistic : ndarray, shape (n,)
        Of image points of ``points`` that a set of rays without them contradicts: that of their prediction from it; else NaN.
    residual_px : ndarray, shape (n, 2)
        Their residuals in it.
    """

    points: np.ndarray
    used: np.ndarray
    xyz: np.ndarray
    statistic: np.ndarray
    residual_px: np.ndarray


@dataclass(frozen=True)
class _Rays:
    """Rays of points, shape (p, m) each: a point X misses one by (g X − h)/depth in whitened units, depth = axis · (X − centre)."""

    rows: np.ndarray
    g: np.ndarray
    h: np.ndarray
    axis: np.ndarray
    centre: np.ndarray
    root: np.ndarray

    def of(self, which: np.ndarray) -> _Rays:
        """Some of the points."""
        return _Rays(*(getattr(self, f.name)[which] for f in fields(self)))

    def at(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Whitened residuals (p, m, 2), their derivatives by the point (p, m, 2, 3), and depths (p, m)."""
        depth = np.einsum("pmi,pmi->pm", self.axis, xyz[:, None] - self.centre)
        with np.errstate(all="ignore"):
            white = (np.einsum("pmai,pi->pma", self.g, xyz) - self.h) / depth[..., None]
            slope = (self.g - white[..., None] * self.axis[:, :, None]) / depth[..., None, None]
        return white, slope, depth


@dataclass(frozen=True)
class _Sets:
    """All subsets of a given number of m rays, intersected; χ² is infinite if they do not meet in front of the cameras."""

    member: np.ndarray
    chi2: np.ndarray
    xyz: np.ndarray
    normal: np.ndarray

    def of(self, which: np.ndarray) -> _Sets:
        """The same for some of the points."""
        return _Sets(self.member, self.chi2[which], self.xyz[which], self.normal[which])


@dataclass(frozen=True)
class _Choice:
    """For each point the best of its largest consistent subsets, and the best one elsewhere (``worse``: by how much)."""

    rays: _Rays
    best: np.ndarray
    xyz: np.ndarray
    normal: np.ndarray
    rival: np.ndarray
    rival_xyz: np.ndarray
    rival_normal: np.ndarray
    worse: np.ndarray


def mend(adjustment: Adjustment, used: np.ndarray, allowed: np.ndarray, variance: float, critical: float, false_alarms: float) -> Mended:
    """Choose the rays of points that lost some.

    Parameters
    ----------
    adjustment : Adjustment
        Its poses and cameras stand.
    used : ndarray of bool, shape (n,)
        Image points that take part at present.
    allowed : ndarray of bool, shape (points,)
        Points that may be changed.
    variance : float
        Variance factor of the image points.
    critical : float
        Value of the statistic of an image point above which it is rejected.
    false_alarms : float
        Wrong choices that may be expected.

    Returns
    -------
    Mended
    """
    network, n = adjustment.network, len(adjustment.network)
    choices = [c for rays in _by_count(network, adjustment.state, used) for c in _choices(rays, variance, critical)]
    least = _least([c.worse for c in choices], adjustment.dof, false_alarms)
    now, xyz, points = used.copy(), adjustment.state.xyz.copy(), [np.zeros(0, int)]
    statistic, residual = np.full(n, np.nan), np.full((n, 2), np.nan)
    for choice in choices:
        present, told = used[choice.rays.rows], choice.worse >= least
        keep = choice.best & told[:, None]
        change = allowed[network.point[choice.rays.rows[:, 0]]] & ((keep != present).any(axis=1) | ~told)
        change &= choice.best.sum(axis=1) >= present.sum(axis=1)  # more rays have passed with the uncertainty of the poses
        rows = choice.rays.rows[change]
        points.append(network.point[rows[:, 0]])
        now[rows], xyz[points[-1]] = keep[change], np.where(told[change, None], choice.xyz[change], np.nan)
        for mine, answer, normal, outside in (
            (change, choice.xyz, choice.normal, ~choice.best),
            (change & ~told, choice.rival_xyz, choice.rival_normal, choice.best & ~choice.rival),
        ):
            _note(choice.rays.of(mine), answer[mine], normal[mine], outside[mine], variance, critical, statistic, residual)
    return Mended(np.concatenate(points), now, xyz, statistic, residual)


def _least(worse: list[np.ndarray], dof: int, false_alarms: float) -> float:
    """By how much a rival has to be worse, so that the odds for all those together are within the false alarms."""
    gap = np.sort(np.concatenate([np.zeros(0), *worse]))[::-1]
    odds = np.cumsum((1 + gap / max(dof, 1)) ** (-max(dof, 1) / 2))  # exp(−Δ/2), if the variance factor were known
    within = np.flatnonzero(odds <= false_alarms)
    return float(gap[within[-1]]) if len(within) else np.inf


def _by_count(network: Network, state: State, used: np.ndarray) -> list[_Rays]:
    """Rays of free points of 2 … `MOST_RAYS` that lost some of them or have no place, the points sorted by how many they have."""
    there = np.isfinite(network.x_px) & np.isfinite(network.y_px) & np.isfinite(state.position[network.image, 0])
    count, lost = (np.bincount(network.point[w], minlength=len(state.xyz)) for w in (there, there & ~used))
    wanted = (count >= 2) & (count <= MOST_RAYS) & (lost > 0) & np.isinf(network.u_xyz).all(axis=1)
    rows = np.flatnonzero(there & wanted[network.point])
    rows = rows[np.argsort(network.point[rows], kind="stable")]
    many, out = count[network.point[rows]], []
    for m in np.unique(many):
        table = rows[many == m].reshape(-1, m)
        out += [_rays(network, state, part) for part in np.array_split(table, -(-len(table) // AT_ONCE))]
    return out


def _rays(network: Network, state: State, rows: np.ndarray) -> _Rays:
    flat = rows.ravel()
    image = network.image[flat]
    stretch = 1 + state.x_scale[image]
    x = network.scale_origin_px + (network.x_px[flat] - state.x_shift_px[image] - network.scale_origin_px) / stretch
    uv, slope = np.full((len(flat), 2), np.nan), np.full((len(flat), 2, 2), np.nan)
    for k, camera in enumerate(network.cameras):
        mine = np.flatnonzero(network.camera_of[image] == k)
        model = replace(camera, values=state.interior[k])
        uv[mine] = np.column_stack(model.direction_of(x[mine], network.y_px[flat[mine]]))
        slope[mine] = model.projected(*uv[mine].T)[2]
    slope[:, 0] *= stretch[:, None]
    root = np.linalg.cholesky(network.covariance_px2[flat][:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    turn = state.rotation[image]
    miss = uv[:, :, None] * turn[:, 2:] - turn[:, :2]  # times X − X₀: depth times what a direction is off
    g = (np.linalg.inv(root) @ slope @ miss).reshape(*rows.shape, 2, 3)
    centre = state.position[image].reshape(*rows.shape, 3)
    axis, root = turn[:, 2].reshape(centre.shape), root.reshape(*rows.shape, 2, 2)
    return _Rays(rows, g, np.einsum("pmai,pmi->pma", g, centre), axis, centre, root)


def _choices(rays: _Rays, variance: float, critical: float) -> list[_Choice]:
    """The largest sets that agree, by their size; points without one are left out."""
    out, m = [], rays.rows.shape[1]
    sets = _intersected(rays, m, variance)
    for size in range(m, 1, -1):
        smaller = _intersected(rays, size - 1, variance) if size > 2 else None
        agree = _highest(sets, smaller) <= critical
        found = np.asarray(agree.any(axis=1))
        if found.any():
            out.append(_choice(rays.of(found), sets.of(found), agree[found], critical))
        rays = rays.of(~found)
        if smaller is None or not len(rays.rows):
            break
        sets = smaller.of(~found)
    return out


def _intersected(rays: _Rays, size: int, variance: float) -> _Sets:
    """Every set of so many rays at its place: linear equations, with the depths of the last solution as weights."""
    p, m = rays.rows.shape
    which = np.array(list(combinations(range(m), size)))
    middle = rays.centre.mean(axis=1)[:, None]  # large coordinates would cost digits
    g, axis, centre = rays.g[:, which], rays.axis[:, which], rays.centre[:, which] - middle[:, :, None]
    h = np.einsum("pskai,pski->pska", g, centre)
    depth = np.ones(g.shape[:3])
    with np.errstate(all="ignore"):
        for _ in range(REWEIGHTS):
            a = (g / depth[..., None, None]).reshape(p, len(which), -1, 3)
            normal = a.swapaxes(2, 3) @ a
            meet = np.linalg.det(normal) > MEET * np.prod(np.diagonal(normal, axis1=2, axis2=3), axis=2)
            right = a.swapaxes(2, 3) @ (h / depth[..., None]).reshape(p, len(which), -1, 1)
            xyz = np.linalg.solve(np.where(meet[..., None, None], normal, np.eye(3)), right)[..., 0]
            depth = np.einsum("pski,pski->psk", axis, xyz[:, :, None] - centre)
        white = (np.einsum("pskai,psi->pska", g, xyz) - h) / depth[..., None]
        chi2 = (white**2).sum(axis=(2, 3)) / variance
    meet &= (depth > 0).all(axis=2) & np.isfinite(chi2)
    member = np.zeros((len(which), m), bool)
    member[np.arange(len(which))[:, None], which] = True
    return _Sets(member, np.where(meet, chi2, np.inf), xyz + middle, normal / variance)


def _highest(sets: _Sets, smaller: _Sets | None) -> Array:
    """By how much leaving out one ray lowers χ² at most, shape (p, sets); of two rays, their χ²."""
    if smaller is None:
        return sets.chi2
    place = {tuple(member): i for i, member in enumerate(smaller.member.tolist())}
    size = int(sets.member[0].sum())
    without = np.empty((len(sets.member), size), int)
    for s, member in enumerate(sets.member):
        for i, ray in enumerate(np.flatnonzero(member)):
            without[s, i] = place[tuple(j != ray and bool(b) for j, b in enumerate(member))]
    rest = np.where(np.isfinite(smaller.chi2), smaller.chi2, 0.0)
    fall: Array = sets.chi2 - rest[:, without].min(axis=2)
    return fall


def _choice(rays: _Rays, sets: _Sets, agree: np.ndarray, critical: float) -> _Choice:
    p = np.arange(len(agree))
    chi2 = np.where(agree, sets.chi2, np.inf)
    best = chi2.argmin(axis=1)
    xyz, normal = sets.xyz[p, best], sets.normal[p, best]
    away = sets.xyz - xyz[:, None]
    elsewhere = np.where(np.einsum("psi,pij,psj->ps", away, normal, away) > critical, chi2, np.inf)
    rival = elsewhere.argmin(axis=1)
    return _Choice(
        rays, sets.member[best], xyz, normal,
        sets.member[rival], sets.xyz[p, rival], sets.normal[p, rival], elsewhere[p, rival] - chi2[p, best],
    )  # fmt: skip


def _note(
    rays: _Rays, xyz: np.ndarray, normal: np.ndarray, outside: np.ndarray, variance: float, critical: float,
    statistic: np.ndarray, residual: np.ndarray,
) -> None:  # fmt: skip
    """Write down the rays outside a set that contradict it: statistic of the prediction from it, and residual in px."""
    white, slope, _ = rays.at(xyz)
    spread = np.eye(2) * variance + slope @ np.linalg.solve(normal[:, None], slope.swapaxes(2, 3))
    value = np.einsum("pma,pma->pm", white, np.linalg.solve(spread, white[..., None])[..., 0])
    off = outside & (value > critical)
    statistic[rays.rows[off]], residual[rays.rows[off]] = value[off], (rays.root[off] @ white[off][..., None])[..., 0]
