"""Covariance of a bundle adjustment: of the reduced unknowns, of each point, of the residuals; and what a weak network leaves open.

With the reduced system S = U − W V⁻¹ Wᵀ, the cofactors of the reduced unknowns are Q = S⁻¹, those of a point V⁻¹ + V⁻¹ Wᵀ Q W V⁻¹, and
those of the residuals of an image point Q_ll − J Q_xx Jᵀ. Points are taken a block at a time; no matrix of points by points is formed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from pixmetry.calibrate.bundle import _bundle_kernels as kernels
from pixmetry.calibrate.bundle.bundle_layout import POSE, Layout
from pixmetry.calibrate.bundle.bundle_system import (
    BLOCK_POINTS,
    Linearised,
    Solved,
    condensed,
    constraints_of,
    dense,
    equations,
    free_motions,
    point_roots,
    reduce,
    regularise,
    rows_of,
)
from pixmetry.calibrate.bundle.datum import Datum, carried, null_space
from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.bundle.network import PER_IMAGE_NAMES, Network, State
from pixmetry.calibrate.bundle.rig import rig_of
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError

SINGULAR = 1e10  # variance inflation at which a system counts as singular
ROUNDED = 1e14  # the same where rounding takes over
SAME = 0.999  # correlation from which two parameters cannot be told apart
ALONE = 0.8  # share of the weak direction above which it is one image's, or one point's
RIDGE = 1e-13  # added to a singular system of unit diagonal, to look at it


@dataclass(frozen=True)
class Cofactors:
    """Covariances for unit weight 1, in the stated datum.

    Parameters
    ----------
    reduced : ndarray, shape (m, m)
        Of the reduced unknowns that are estimated.
    points : ndarray, shape (points, 3, 3)
    residuals : ndarray, shape (n, 3), or None
        J Q_xx Jᵀ of the whitened image coordinates in the order of the layout: xx, xy, yy.
    """

    reduced: np.ndarray
    points: np.ndarray
    residuals: np.ndarray | None


@dataclass(frozen=True)
class WeakDirection:
    """The two groups of parameters that a network separates worst.

    Parameters
    ----------
    parameters : tuple of str
    correlation : float
    u : tuple of float
        Standard deviations of the two (for a group: of their mean).
    text : str
    """

    parameters: tuple[str, str]
    correlation: float
    u: tuple[float, float]
    text: str


def cofactors(layout: Layout, datum: Datum, now: Linearised, solved: Solved, residuals: bool) -> Cofactors:
    """All cofactors at a state.

    Raises
    ------
    MeasureError
        Where the unknowns are not determined.
    """
    Q = _inverse(layout, datum, now, solved)
    points = np.full((len(layout.point_col), 3, 3), np.nan)
    own = np.empty((len(layout.x), 3)) if residuals else None
    at, whole = layout.eliminated, dense(layout)
    if not whole:
        points[at] = _gathered(layout, solved, Q)[at]
    for begin in range(0, len(at) if whole or residuals else 0, BLOCK_POINTS):
        which = at[begin : begin + BLOCK_POINTS]
        if whole:
            Z = rows_of(layout, solved.Z, which)
            G = Z @ Q
            inner = G.reshape(len(which), 3, -1) @ np.swapaxes(Z.reshape(len(which), 3, -1), 1, 2)
            points[which] = _with_own(solved.root[which], inner)
        else:
            G = np.empty((3 * len(which), len(Q)))
            kernels.products(which, solved.Z, layout.incidence, Q, G)
        if own is not None:
            _residuals(layout, now, solved, which, points, Q, G, own)
    joined = np.flatnonzero(layout.point_col >= 0)
    if own is not None:
        others = np.setdiff1d(np.flatnonzero(layout.determined), at)
        _residuals(layout, now, solved, others, points, Q, np.zeros((1, len(Q))), own)
    Q, points = _in_datum(layout, datum, now, solved, Q, points)
    for j in joined:
        block = slice(layout.point_col[j], layout.point_col[j] + 3)
        points[j] = Q[block, block]
    points[layout.determined & layout.held.all(axis=1)] = 0.0
    held = layout.held & layout.determined[:, None]
    points[held[:, :, None] | held[:, None, :]] = 0.0
    return Cofactors(_of_estimated(layout, Q), points, own)


def _of_estimated(layout: Layout, Q: np.ndarray) -> np.ndarray:
    estimated = layout.estimated
    return Q if estimated.all() else Q[np.ix_(estimated, estimated)]


def _gathered(layout: Layout, solved: Solved, Q: np.ndarray) -> np.ndarray:
    """Cofactors of the eliminated points, from those parts of Q that they touch."""
    of_cameras = solved.Z.of_cameras
    n = of_cameras.shape[2]
    half = 0.5 * (of_cameras @ Q[:n, :n]) @ np.swapaxes(of_cameras, 1, 2)
    kernels.quadratic(solved.Z, layout.by_image, layout.incidence, Q, half)
    return _with_own(solved.root, half + np.swapaxes(half, 1, 2))


def _with_own(root: Array, inner: Array) -> Array:
    """V⁻¹ + V⁻¹ Wᵀ Q W V⁻¹ from L⁻¹ and Zᵀ Q Z."""
    whole: Array = np.swapaxes(root, 1, 2) @ (np.eye(3) + inner) @ root
    return whole


def _inverse(layout: Layout, datum: Datum, now: Linearised, solved: Solved) -> Array:
    """Cofactors of the reduced unknowns, in the datum that made the system regular."""
    from scipy.linalg.lapack import dpotri

    lower: Array = dpotri(solved.factor, lower=0, overwrite_c=1)[0].T
    if not np.diagonal(lower).max() < SINGULAR and not _weakly_placed(layout, datum, now, lower, solved):
        raise_weak(layout, datum, now, "the unknowns are not determined")
    kernels.scaled_whole(lower, solved.scale)
    if len(layout.constraints):
        C = constraints_of(layout, solved.ties)
        away = lower @ C.T
        lower -= away @ np.linalg.solve(C @ away, away.T)
    return lower if solved.ties is None else solved.ties.whole(lower)


def _weakly_placed(layout: Layout, datum: Datum, now: Linearised, lower: np.ndarray, solved: Solved) -> bool:
    """Whether a network is determined but for its place, which weak control gives: variance inflation without the seven of the datum."""
    if (layout.held & layout.determined[:, None]).any() or not np.diagonal(lower).max() < ROUNDED:
        return False
    whole = np.tril(lower) + np.tril(lower, -1).T
    motions = free_motions(layout, now.state, replace(datum, missing=7), solved.ties)
    H = np.linalg.qr(motions / solved.scale[:, None])[0]
    away = H @ (H.T @ whole)
    inflation = np.diagonal(whole) - 2 * np.diagonal(away) + np.sum((away @ H) * H, axis=1)
    return bool(inflation.max() < SINGULAR)


def _residuals(
    layout: Layout, now: Linearised, solved: Solved, which: np.ndarray, points: np.ndarray, Q: np.ndarray, G: np.ndarray, own: np.ndarray
) -> None:
    """Fill ``own`` for the image coordinates of the points ``which``."""
    if not len(which):
        return
    block = np.full(len(layout.point_col), -2, np.int64)
    block[which] = np.where(layout.point_col[which] == kernels.ELIMINATED, np.arange(len(which)), -1)
    place = block[layout.point]
    kernels.residual_cofactors(now.linear, layout.incidence, place, solved.root, points, Q, np.ascontiguousarray(G), own)


def _in_datum(
    layout: Layout, datum: Datum, now: Linearised, solved: Solved, Q: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """S-transformation of the cofactors to the stated datum: Q − X − Xᵀ with X = G ((BᵀG)⁻¹ Bᵀ Q − ½ K Gᵀ)."""
    if datum.missing == 0:
        return Q, points
    from scipy.linalg.blas import dgemm

    G, G_points, _ = null_space(layout, now.state, datum)
    B, B_points = carried(layout, G_points, datum)
    inverse = np.swapaxes(solved.root, 1, 2) @ solved.root
    right = B.copy()
    kernels.from_points(now.linear, layout.incidence, inverse @ B_points, right)
    QB = Q @ right
    QB_points = np.zeros_like(B_points)
    kernels.point_steps(now.linear, layout.incidence, solved.root, B_points, QB, QB_points)
    out = layout.point_col == kernels.ELIMINATED
    product = np.linalg.inv(np.einsum("jad,jae->de", B_points, G_points))
    K = product @ (B.T @ QB + np.einsum("jad,jae->de", B_points[out], QB_points[out])) @ product.T
    half = product @ QB.T - 0.5 * K @ G.T
    Q = dgemm(-1.0, np.hstack([G, half.T]), np.vstack([half, G.T]), beta=1.0, c=Q.T, overwrite_c=1).T
    X_points = G_points @ (product @ np.swapaxes(QB_points, 1, 2) - 0.5 * K @ np.swapaxes(G_points, 1, 2))
    return Q, points - X_points - np.swapaxes(X_points, 1, 2)


def raise_weak(layout: Layout, datum: Datum, now: Linearised, what: str) -> NoReturn:
    """Say which parameters a network does not separate.

    Raises
    ------
    MeasureError
        Always.
    """
    S = np.empty((len(layout.columns), len(layout.columns)))
    g, V, h = equations(layout, now, S)
    whole = np.diagonal(S).copy()
    root, _ = point_roots(layout, V)
    reduce(layout, condensed(layout, now, root), h, root, S, g)
    ties = layout.ties(now.state)
    if ties is not None:
        S, whole = ties.reduced(S), np.asarray((ties.T.power(2)).T @ whole)
    diagonal = np.diagonal(S)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, np.maximum(whole, 1e-300)))
    regularise(layout, datum, now.state, S, scale, ties)
    lower = np.tril(S)
    whole = lower + np.tril(lower, -1).T
    values, vectors = np.linalg.eigh(np.where(np.isfinite(whole), whole, 0.0))
    covariance = (vectors / (np.maximum(values, 0.0) + RIDGE)) @ vectors.T * np.outer(scale, scale)
    covariance = covariance if ties is None else ties.whole(covariance)
    weak = weak_direction(layout.free_columns, _of_estimated(layout, covariance), layout.network, now.state)
    remedy = "add images that are tilted and rolled against each other, hold one of these parameters fixed, or give control points"
    free = int(layout.camera_count.sum())
    if len(layout.network.images) < 3 and free:
        remedy = f"two images seldom determine {free} interior parameters: hold some of them fixed, or add images"
    cause = f"weakest: {weak.text}"
    if abs(weak.correlation) > SAME:
        cause = (
            f"{weak.parameters[0]} is not determined: it cannot be separated from {weak.parameters[1]} (correlation "
            f"{weak.correlation:+.6f})"
        )
        what, cause = cause, what
    raise MeasureError(f"{what}; {cause}", where="bundle adjustment", remedy=remedy)


def weak_direction(columns: tuple[str, ...], covariance: np.ndarray, network: Network, state: State) -> WeakDirection:
    """The two groups of parameters that a network separates worst: the direction of the largest eigenvalue of the correlation matrix.

    Parameters
    ----------
    columns : tuple of str
        As in `Adjustment.free_columns`.
    covariance : ndarray, shape (m, m)
        As in `Adjustment.covariance`.
    network, state
        Projection centres are looked at along the axes of their camera: "distance" is that along the optical axis.
    """
    from scipy.sparse.linalg import eigsh

    names, covariance = _along_axes(*_independent(columns, covariance, network, state), network, state)
    u = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    correlation = covariance / np.outer(u, u)
    direction = eigsh(correlation, k=1, which="LA", v0=np.ones(len(u)))[1][:, 0] if len(u) > 2 else np.ones(len(u))
    alone, share, kinds = _groups(names, direction, network)
    own, common = _worst_pair(alone, covariance), _worst_pair(kinds, covariance)
    if own is not None and (common is None or share > ALONE or 1 - abs(own.correlation) < 0.1 * (1 - abs(common.correlation))):
        return own
    assert common is not None  # there are two parameters, or nothing could be weak
    return common


def _independent(columns: tuple[str, ...], covariance: np.ndarray, network: Network, state: State) -> tuple[tuple[str, ...], np.ndarray]:
    """Without images whose poses follow from those of other images of their rig."""
    rig = rig_of(network, state.posed)
    if rig is None:
        return columns, covariance
    leading = {int(rig.image[row]) for row, _ in rig.tree}
    lost = {f"{network.images[i]}:{name}" for i in rig.image if int(i) not in leading for name in POSE}
    keep = [i for i, name in enumerate(columns) if name not in lost]
    return tuple(columns[i] for i in keep), covariance[np.ix_(keep, keep)]


def _worst_pair(groups: dict[str, list[int]], covariance: np.ndarray) -> WeakDirection | None:
    """The two groups whose means are most correlated."""
    if len(groups) < 2:
        return None
    means = np.zeros((len(groups), len(covariance)))
    for row, members in zip(means, groups.values(), strict=True):
        row[members] = 1 / len(members)
    of_groups = means @ covariance @ means.T
    u = np.sqrt(np.maximum(np.diagonal(of_groups), 1e-300))
    r = np.clip(of_groups / np.outer(u, u), -1, 1)
    a, b = np.unravel_index(np.argmax(np.abs(np.tril(r, -1))), r.shape)
    labels = list(groups)
    text = f"{labels[b]} with {labels[a]} (correlation {r[a, b]:+.6f})"
    return WeakDirection((labels[b], labels[a]), float(r[a, b]), (float(u[b]), float(u[a])), text)


def _along_axes(columns: tuple[str, ...], covariance: np.ndarray, network: Network, state: State) -> tuple[list[str], np.ndarray]:
    """Names and covariance with the projection centres along the axes of their camera."""
    index = {name: i for i, name in enumerate(columns)}
    names, covariance = list(columns), covariance.copy()
    for i, image in enumerate(network.images):
        at = index.get(f"{image}:X0")
        if at is None:
            continue
        three = slice(at, at + 3)
        covariance[three] = state.rotation[i] @ covariance[three]
        covariance[:, three] = covariance[:, three] @ state.rotation[i].T
        names[three] = [f"{image}:side", f"{image}:height", f"{image}:distance"]
    return names, covariance


def _groups(names: list[str], direction: np.ndarray, network: Network) -> tuple[dict[str, list[int]], float, dict[str, list[int]]]:
    """Rows of the parameters to be paired: those of the one image or point with the largest share in the weak direction, and that share;
    interior parameters one by one and, kind by kind, those of all images of a camera together."""
    several = len(network.cameras) > 1
    camera_of = {name: network.cameras[k].name for name, k in zip(network.images, network.camera_of, strict=True)}
    owners = []
    for name in names:
        head, _, kind = name.rpartition(":")
        owners.append(("camera" if kind in NAMES else "point" if kind in "XYZ" else "image", head, kind))
    share: dict[tuple[str, str], float] = {}
    groups: dict[str, list[int]] = {}
    for i, ((what, head, kind), part) in enumerate(zip(owners, direction, strict=True)):
        if what != "camera":
            share[what, head] = share.get((what, head), 0.0) + float(part) ** 2
        else:
            groups[f"{kind} of {head}" if several else kind] = [i]
        if what == "image" and kind not in PER_IMAGE_NAMES:  # the mean of those is nought
            groups.setdefault(f"the {kind} of all images" + (f" of {camera_of[head]}" if several else ""), []).append(i)
    what, most = max(share, key=lambda owner: share[owner])
    alone = {f"{kind} of {what} {most}": [i] for i, (w, head, kind) in enumerate(owners) if (w, head) == (what, most)}
    return alone, share[what, most], groups


def residual_cofactors_px2(layout: Layout, now: Linearised, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Redundancy numbers (n, 2) and cofactors of the residuals in px² (n, 3), in the order of the layout.

    An image coordinate that takes part has Q_ll − J Q Jᵀ; another, predicted by the rest, Q_ll + J Q Jᵀ and no redundancy number.
    """
    took = now.weight > 0
    sign = np.where(took, -1.0, 1.0)
    M = np.empty((len(own), 2, 2))
    M[:, 0, 0], M[:, 1, 1] = 1 + sign * own[:, 0], 1 + sign * own[:, 2]
    M[:, 0, 1] = M[:, 1, 0] = sign * own[:, 1]
    W = np.zeros_like(M)
    W[:, 0, 0], W[:, 1, 0], W[:, 1, 1] = layout.whiten.T
    back = np.linalg.inv(W)
    Q = back @ M @ np.swapaxes(back, 1, 2) / np.where(took, now.weight, 1.0)[:, None, None]
    redundancy = np.where(took[:, None], np.diagonal(back @ M @ W, axis1=1, axis2=2), np.nan)
    return redundancy, np.stack([Q[:, 0, 0], Q[:, 0, 1], Q[:, 1, 1]], axis=1)
