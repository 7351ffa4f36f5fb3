"""The normal equations of the bundle adjustment at a state, and their solution: points eliminated, the rest by Cholesky factors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.calibrate.bundle import _bundle_kernels as kernels
from pixmetry.calibrate.bundle._bundle_kernels import Eliminated, Linear, Measured, Points, Stretch
from pixmetry.calibrate.bundle._model_kernels import Cameras, Views
from pixmetry.calibrate.bundle.bundle_layout import Layout
from pixmetry.calibrate.bundle.datum import Datum, null_space
from pixmetry.calibrate.bundle.network import State
from pixmetry.calibrate.bundle.rig import Ties
from pixmetry.core.arrays import Array, Flags

LOSSES = ("none", "huber", "cauchy")
BLOCK_POINTS = 256
MOST_BENT = 0.3  # size of a second-order term, relative to its step: beyond, the series says nothing
DENSE_GAIN = 16.0  # a multiplication in a matrix product takes this share of the time of one that is gathered


@dataclass(frozen=True)
class Loss:
    """How large residuals count: ``scale`` in units of sqrt(``unit``), the robust variance; None: as the residuals at hand have it."""

    kind: str = "none"
    scale: float = 2.5
    unit: float | None = None


@dataclass
class Linearised:
    """Residuals and Jacobian at a state."""

    state: State
    residual: Array  # (n, 2), whitened
    jacobian: Array  # (n, 2, q)
    valid: Flags  # (n,), the point has an image
    weight: Array  # (n,), by the robust loss; 0 where it takes no part
    unit: float  # robust variance of a whitened coordinate, by which the loss counts
    cost: float

    @property
    def linear(self) -> Linear:
        """Jacobian and weights, as the kernels take them."""
        return Linear(self.jacobian, self.weight)


@dataclass
class Solved:
    """A step, with its normal equations."""

    step: Array
    points: Array
    gain: float  # by how much the cost would fall in a linear world
    factor: Array  # Cholesky factor of the scaled reduced system, in the work space
    scale: Array
    root: Array
    Z: Eliminated
    inner: Array  # the step in the unknowns of the factor: those of a rig where there is one
    ties: Ties | None = None


def linearise(layout: Layout, state: State, loss: Loss) -> Linearised:
    """Residuals, Jacobian and weights at a state."""
    n, at = len(layout.x), layout.incidence
    residual, jacobian = np.empty((n, 2)), np.empty((n, 2, at.free.shape[1] + 6 + int((layout.extra >= 0).sum()) + 3))
    measured, cameras = Measured(layout.x, layout.y, layout.whiten), Cameras(state.interior, layout.form, layout.per_px)
    stretch = Stretch(state.x_scale, state.x_shift_px, float(layout.network.scale_origin_px))
    views, points = Views(state.rotation, state.position), Points(state.xyz, layout.held)
    kernels.linearise(measured, at, cameras, views, stretch, points, residual, jacobian)
    valid = np.asarray(np.isfinite(residual).all(axis=1))
    residual[~valid] = 0.0
    loss_weight, unit = _loss_weight(residual, layout.used & valid, loss)
    weight = np.where(layout.used & valid, loss_weight, 0.0)
    return Linearised(state, residual, jacobian, valid, weight, unit, cost(layout, state, residual, weight))


def equations(layout: Layout, now: Linearised, work: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normal equations before points are eliminated: U in the work space (m, m), g (m,), V (points, 3, 3), h (points, 3)."""
    p = len(layout.network.points)
    g, V, h = np.zeros(len(work)), np.zeros((p, 3, 3)), np.zeros((p, 3))
    work[:] = 0.0
    kernels.normals(now.residual, now.linear, layout.incidence, work, g, V, h)
    _add_control(layout, now.state, work, g, V, h)
    return g, V, h


def _add_control(layout: Layout, state: State, U: np.ndarray, g: np.ndarray, V: np.ndarray, h: np.ndarray) -> None:
    """Coordinates known beforehand, and scale bars; a fixed coordinate gets weight 1, that its row be not empty."""
    gap = np.where(layout.prior > 0, layout.network.xyz - state.xyz, 0.0)
    weight = np.where(layout.held, 1.0, layout.prior)
    out = layout.point_col < 0
    V[out] += weight[out][:, :, None] * np.eye(3)
    h[out] += (layout.prior * gap)[out]
    for j in np.flatnonzero(layout.point_col >= 0):
        at = layout.point_col[j] + np.arange(3)
        U[at, at] += weight[j]
        g[at] += layout.prior[j] * gap[j]
    for a, b, length, u in zip(layout.bars.start, layout.bars.end, layout.bars.length, layout.bars.u, strict=True):
        away = state.xyz[b] - state.xyz[a]
        now = float(np.linalg.norm(away))
        row = np.zeros(len(g))
        for j, sign in ((a, -1.0), (b, 1.0)):
            if layout.point_col[j] >= 0:
                row[layout.point_col[j] + np.arange(3)] = sign * np.where(layout.held[j], 0.0, away / now) / u
        some = np.flatnonzero(row)
        U[np.ix_(some, some)] += np.outer(row[some], row[some])
        g += row * (length - now) / u


def cost(layout: Layout, state: State, residual: np.ndarray, weight: np.ndarray) -> float:
    """Weighted sum of squares of all observations."""
    gap = np.where((layout.prior > 0) & layout.determined[:, None], layout.network.xyz - state.xyz, 0.0)
    bars = layout.bars
    lengths = np.linalg.norm(state.xyz[bars.end] - state.xyz[bars.start], axis=1)
    return float(weight @ (residual**2).sum(axis=1) + (layout.prior * gap**2).sum() + (((bars.length - lengths) / bars.u) ** 2).sum())


def _loss_weight(residual: np.ndarray, used: np.ndarray, loss: Loss) -> tuple[np.ndarray, float]:
    """Weights by the length of the whitened residual, in units of its robust standard deviation (its square has the median 2 ln 2)."""
    if loss.kind == "none" or not used.any():
        return np.ones(len(residual)), 1.0
    squared = (residual**2).sum(axis=1)
    unit = loss.unit or float(np.median(squared[used])) / (2 * np.log(2)) or 1.0
    length = np.sqrt(squared / unit) / loss.scale
    return (1 / np.maximum(1.0, length) if loss.kind == "huber" else 1 / (1 + length**2)), unit


def point_roots(layout: Layout, V: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """L⁻¹ of the blocks of the points, and their smallest relative pivots."""
    root = np.zeros_like(V)
    return root, kernels.roots(V, layout.point_col, root)


def condensed(layout: Layout, now: Linearised, root: np.ndarray) -> Eliminated:
    """Z of the eliminated points."""
    Z = Eliminated(np.zeros((len(layout.x), 3, layout.per_image)), np.zeros((len(root), 3, int(layout.camera_count.sum()))))
    kernels.condense(now.linear, layout.incidence, root, Z)
    return Z


def reduce(layout: Layout, Z: Eliminated, h: np.ndarray, root: np.ndarray, S: np.ndarray, g: np.ndarray) -> None:
    """Eliminate the points: S (lower triangle) and its right side g, in place."""
    from scipy.linalg.blas import dsyrk

    of_cameras = Z.of_cameras
    n = of_cameras.shape[2]
    _reduce_right(layout, Z, h, root, g)
    if dense(layout):
        for at in range(0, len(layout.eliminated), BLOCK_POINTS):
            rows = rows_of(layout, Z, layout.eliminated[at : at + BLOCK_POINTS])
            dsyrk(-1.0, rows.T, beta=1.0, c=S.T, lower=0, overwrite_c=1)
        return
    S[:n, :n] -= np.tensordot(of_cameras, of_cameras, axes=([0, 1], [0, 1]))
    kernels.reduce_pairs(Z, layout.by_image, layout.incidence, S)


def _reduce_right(layout: Layout, Z: Eliminated, h: np.ndarray, root: np.ndarray, g: np.ndarray) -> None:
    """Eliminate the points from the right side g, in place."""
    of_images, of_cameras = Z
    t = np.einsum("jab,jb->ja", root, h)
    g[: of_cameras.shape[2]] -= np.einsum("jcm,jc->m", of_cameras, t)
    pulls = np.einsum("icm,ic->im", of_images, t[layout.point])
    np.subtract.at(g, layout.image_col[layout.image][:, None] + np.arange(layout.per_image), pulls)


def rows_of(layout: Layout, Z: Eliminated, which: np.ndarray) -> np.ndarray:
    """Zᵀ of some points in whole rows, shape (3 points, unknowns)."""
    rows = np.zeros((3 * len(which), len(layout.columns)))
    kernels.spread(which, Z, layout.incidence, rows)
    return rows


def dense(layout: Layout) -> bool:
    """Whether points are in so many images that products of whole rows are faster than gathering."""
    rows = np.diff(layout.first)[layout.eliminated] * layout.per_image + layout.camera_count.max(initial=0)
    return float((rows.astype(float) ** 2).sum()) * DENSE_GAIN > len(rows) * float(len(layout.columns)) ** 2


def solve(layout: Layout, datum: Datum, now: Linearised, damping: float, work: np.ndarray) -> Solved | None:
    """The step; None where the damped system is singular."""
    from scipy.linalg.lapack import dpotrf

    g, V, h = equations(layout, now, work)
    i, m = np.arange(3), np.arange(len(work))
    work[m, m] *= 1 + damping
    V[:, i, i] *= 1 + damping
    right = g.copy()
    root, _ = point_roots(layout, V)
    Z = condensed(layout, now, root)
    reduce(layout, Z, h, root, work, right)
    ties = layout.ties(now.state)
    if ties is not None:
        work, right = ties.reduced(work), ties.T.T @ right
    diagonal = np.diagonal(work)
    if not ((diagonal > 0) & np.isfinite(diagonal)).all():
        return None
    scale = 1 / np.sqrt(diagonal)
    regularise(layout, datum, now.state, work, scale, ties)
    factor, info = dpotrf(work.T, lower=0, overwrite_a=1, clean=0)
    if info:
        return None
    inner, step, points = _answer(layout, now, factor, scale, root, right, h, ties)
    return Solved(step, points, float(g @ step + (h * points).sum()), factor, scale, root, Z, inner, ties)


def bent(layout: Layout, now: Linearised, solved: Solved, second: np.ndarray) -> Solved:
    """The step with its second-order term: half of what cancels ``second``, the second derivative of the residuals along the step.

    M. K. Transtrum, J. P. Sethna, Improvements to the Levenberg–Marquardt algorithm (2012), arXiv:1201.5885: geodesic acceleration.
    """
    g, h = np.zeros(len(solved.step)), np.zeros_like(solved.points)
    kernels.gradients(second, now.linear, layout.incidence, g, h)
    _reduce_right(layout, solved.Z, h, solved.root, g)
    right = g if solved.ties is None else solved.ties.T.T @ g
    inner, step, points = _answer(layout, now, solved.factor, solved.scale, solved.root, right, h, solved.ties)
    length, along = np.linalg.norm(inner / solved.scale) / 2, np.linalg.norm(solved.inner / solved.scale)
    share = 0.5 if length < MOST_BENT * along else 0.0
    return replace(solved, step=solved.step + share * step, points=solved.points + share * points, inner=solved.inner + share * inner)


def _answer(
    layout: Layout,
    now: Linearised,
    factor: np.ndarray,
    scale: np.ndarray,
    root: np.ndarray,
    right: np.ndarray,
    h: np.ndarray,
    ties: Ties | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unknowns of the factor, reduced unknowns and points for a right side whose points are eliminated."""
    from scipy.linalg.lapack import dpotrs

    step = dpotrs(factor, right * scale, lower=0)[0]
    if len(layout.constraints):
        C = constraints_of(layout, ties) * scale
        away = dpotrs(factor, C.T, lower=0)[0]
        step -= away @ np.linalg.solve(C @ away, C @ step)
    step *= scale
    inner, step = step, step if ties is None else ties.expanded(step)
    points = np.zeros((*h.shape, 1))
    kernels.point_steps(now.linear, layout.incidence, root, h[:, :, None], step[:, None], points)
    points = points[:, :, 0]
    points[layout.held] = 0.0
    return inner, step, points


def constraints_of(layout: Layout, ties: Ties | None) -> np.ndarray:
    """Rows whose product with the unknowns of the factor stays 0."""
    return layout.constraints if ties is None else np.asarray(layout.constraints @ ties.T)


def regularise(layout: Layout, datum: Datum, state: State, S: np.ndarray, scale: np.ndarray, ties: Ties | None) -> None:
    """Give the lower triangle a unit diagonal, and add to it what datum and constraints leave out."""
    from scipy.linalg.blas import dsyrk

    kernels.scaled_lower(S, scale)
    more = [np.linalg.qr(free_motions(layout, state, datum, ties) / scale[:, None])[0]] if datum.missing else []
    if len(layout.constraints):
        rows = constraints_of(layout, ties) * scale
        more.append((rows / np.linalg.norm(rows, axis=1, keepdims=True)).T)
    if more:
        H = np.asfortranarray(np.concatenate(more, axis=1))
        dsyrk(1.0, H, beta=1.0, c=S.T, lower=0, overwrite_c=1)


def free_motions(layout: Layout, state: State, datum: Datum, ties: Ties | None) -> np.ndarray:
    """Motions of the unknowns of the factor that change no observation, shape (m, d)."""
    motions = null_space(layout, state, datum)[0]
    return motions if ties is None else ties.inner(motions)
