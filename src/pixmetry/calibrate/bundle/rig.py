"""Cameras that stand still against each other: the poses of the images of one instant are one pose of the rig.

Camera k of a rig sees a point X at R_k (R_t (X − X_t) − d_k): R_t, X_t is the pose of the rig's first camera at the instant t, R_k and d_k
are the rotation of camera k against that camera and its projection centre in the frame of that camera. So an image has
R = R_k R_t and X₀ = X_t + R_tᵀ d_k. The adjustment keeps its equations image by image; their unknowns x depend on the fewer y of the rig,

    ω = a_k + R_k ω_t,   δX₀ = δX_t + R_tᵀ b_k + R_tᵀ [d_k]× ω_t,

with small rotations ω about the axes of each camera, a_k of R_k, and b_k of d_k: x = T y. The normal equations are TᵀNT, the covariance
of x is T Q Tᵀ. Derived by putting exp([a]×) R_k exp([ω_t]×) R_t and its like into the two equations above, to first order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment, Network, State
from pixmetry.core.arrays import Array, Ints


@dataclass(frozen=True)
class Frames:
    """A rig at rest and on its way.

    Parameters
    ----------
    rotation : ndarray, shape (cameras, 3, 3)
        R_k of each camera of the rig; the unit matrix of a reference.
    place : ndarray, shape (cameras, 3)
        d_k, its projection centre in the frame of the reference.
    base_rotation : ndarray, shape (instants, 3, 3)
    base_position : ndarray, shape (instants, 3)
        Pose of the reference at each instant.
    """

    rotation: Array
    place: Array
    base_rotation: Array
    base_position: Array


@dataclass(frozen=True)
class Rig:
    """Which images belong together.

    Parameters
    ----------
    image : ndarray of int, shape (r,)
        Images of the rig.
    camera, instant : ndarray of int, shape (r,)
        Of each of them, among ``cameras`` and ``instants``.
    cameras : ndarray of int
        Which cameras of the network the rig has.
    instants : int
    tree : tuple of (int, bool)
        A way to all cameras and instants: a row of ``image``, and whether that image leads from its camera to its instant (or back).
    reference : ndarray of int, shape (cameras,)
        For each camera, the one (among ``cameras``) that its relative pose counts from. Cameras that no instant joins have different ones.
    """

    image: Ints
    camera: Ints
    instant: Ints
    cameras: Ints
    instants: int
    tree: tuple[tuple[int, bool], ...]
    reference: Ints

    @property
    def unknowns(self) -> int:
        """Of all poses of the rig."""
        return 6 * (self.instants + int((self.reference != np.arange(len(self.cameras))).sum()))

    def frames(self, state: State) -> Frames:
        """Relative poses and bases along the tree; the other images do not count."""
        n, m = len(self.cameras), self.instants
        R, d, base, at = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.tile(np.eye(3), (m, 1, 1)), np.zeros((m, 3))
        for row, to_instant in self.tree:
            k, t, i = self.camera[row], self.instant[row], self.image[row]
            if to_instant:
                base[t] = R[k].T @ state.rotation[i]
                at[t] = state.position[i] - base[t].T @ d[k]
            else:
                R[k] = state.rotation[i] @ base[t].T
                d[k] = base[t] @ (state.position[i] - at[t])
        return Frames(R, d, base, at)

    def posed(self, frames: Frames, state: State) -> State:
        """The state with the poses of all images of the rig from its frames."""
        k, t = self.camera, self.instant
        rotation, position = state.rotation.copy(), state.position.copy()
        rotation[self.image] = frames.rotation[k] @ frames.base_rotation[t]
        position[self.image] = frames.base_position[t] + np.einsum("nji,nj->ni", frames.base_rotation[t], frames.place[k])
        return replace(state, rotation=rotation, position=position)


def rig_of(network: Network, there: np.ndarray) -> Rig | None:
    """The rig of the images that take part (bool, (images,)); None where no instant has two of them."""
    if network.instant is None:
        return None
    image = np.flatnonzero(there & (network.instant >= 0))
    image = image[np.lexsort((network.camera_of[image], network.instant[image]))]
    cameras, camera = np.unique(network.camera_of[image], return_inverse=True)
    instants, instant = np.unique(network.instant[image], return_inverse=True)
    if not len(image) or np.bincount(instant).max() < 2:
        return None
    tree, reference = _tree(camera, instant, len(cameras), len(instants))
    return Rig(image.astype(np.int64), camera, instant, cameras, len(instants), tree, reference)


def _tree(camera: np.ndarray, instant: np.ndarray, cameras: int, instants: int) -> tuple[tuple[tuple[int, bool], ...], np.ndarray]:
    of_camera = [np.flatnonzero(camera == k).tolist() for k in range(cameras)]
    of_instant: list[list[int]] = [[] for _ in range(instants)]
    for row, t in enumerate(instant):
        of_instant[t].append(row)
    tree: list[tuple[int, bool]] = []
    reference, seen = np.full(cameras, -1), np.zeros(instants, bool)
    for first in range(cameras):
        if reference[first] >= 0:
            continue
        reference[first], queue = first, [first]
        while queue:
            new = [row for row in of_camera[queue.pop(0)] if not seen[instant[row]]]
            seen[instant[new]] = True
            tree += [(row, True) for row in new]
            for row in (other for one in new for other in of_instant[instant[one]]):
                if reference[camera[row]] < 0:
                    reference[camera[row]] = first
                    tree.append((row, False))
                    queue.append(int(camera[row]))
    return tuple(tree), reference


def rigid(rig: Rig, state: State) -> State:
    """Start values: the medians of the relative poses that the images show one by one, and the bases that follow.

    A relative pose counts from the camera before it in the tree; an instant stands where its images, each for itself, put it in the mean.
    """
    n, m = len(rig.cameras), rig.instants
    R, d, known = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), rig.reference == np.arange(n)
    row_at = {(int(k), int(t)): row for row, (k, t) in enumerate(zip(rig.camera, rig.instant, strict=True))}
    for k in dict.fromkeys(int(rig.camera[row]) for row, to_instant in rig.tree if not to_instant):
        turns, places = [], []
        for t in rig.instant[rig.camera == k]:
            i = rig.image[row_at[k, int(t)]]
            for j in np.flatnonzero(known):
                if (row := row_at.get((int(j), int(t)))) is not None and rig.reference[j] == rig.reference[k]:
                    base = R[j].T @ state.rotation[rig.image[row]]
                    turns.append(state.rotation[i] @ base.T)
                    places.append(base @ (state.position[i] - state.position[rig.image[row]]) + d[j])
        R[k], d[k], known[k] = _nearest_rotation(np.median(turns, axis=0)), np.median(places, axis=0), True
    base = np.swapaxes(R[rig.camera], 1, 2) @ state.rotation[rig.image]
    total = np.zeros((m, 3, 3))
    np.add.at(total, rig.instant, base)
    turned = np.stack([_nearest_rotation(one) for one in total])
    at, count = np.zeros((m, 3)), np.bincount(rig.instant, minlength=m)[:, None]
    np.add.at(at, rig.instant, state.position[rig.image] - np.einsum("nji,nj->ni", turned[rig.instant], d[rig.camera]))
    return rig.posed(Frames(R, d, turned, at / count), state)


def largest_turn(rig: Rig, state: State) -> tuple[float, int]:
    """Largest angle between an image as it stands and as the rig of `rigid` has it, degrees, and which image that is."""
    turn = np.swapaxes(rigid(rig, state).rotation[rig.image], 1, 2) @ state.rotation[rig.image]
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1.0, 1.0))
    worst = int(np.argmax(angle))
    return float(np.rad2deg(angle[worst])), int(rig.image[worst])


def _nearest_rotation(matrix: Array) -> Array:
    left, _, right = np.linalg.svd(matrix)
    turned: Array = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return turned


class Ties:
    """T at one state: how the unknowns of a layout, image by image, depend on those of its rig.

    Parameters
    ----------
    rig : Rig
    state : State
    image_col : ndarray of int
        First unknown of each image.
    columns : int
        Unknowns of the layout.
    """

    def __init__(self, rig: Rig, state: State, image_col: Ints, columns: int) -> None:
        from scipy.sparse import csr_matrix

        self.rig, self.frames, self.at = rig, rig.frames(state), image_col[rig.image]
        own = np.ones(columns, bool)
        own[self.at[:, None] + np.arange(6)] = False
        self.own = np.flatnonzero(own)
        joined = rig.reference != np.arange(len(rig.cameras))
        self.rel = np.where(joined, len(self.own) + 6 * (np.cumsum(joined) - 1), -1)
        self.base = len(self.own) + 6 * int(joined.sum()) + 6 * np.arange(rig.instants)
        self.size = len(self.own) + rig.unknowns
        rows, cols, values = [self.own], [np.arange(len(self.own))], [np.ones(len(self.own))]
        frames, i3 = self.frames, np.arange(3)

        def put(at: Ints, to: Ints, block: Array) -> None:
            rows.append(np.broadcast_to((at[:, None] + i3)[:, :, None], block.shape).ravel())
            cols.append(np.broadcast_to((to[:, None] + i3)[:, None, :], block.shape).ravel())
            values.append(block.ravel())

        k, t = rig.camera, rig.instant
        back, unit = np.swapaxes(frames.base_rotation[t], 1, 2), np.tile(np.eye(3), (len(k), 1, 1))
        put(self.at, self.base[t], frames.rotation[k])
        put(self.at + 3, self.base[t] + 3, unit)
        put(self.at + 3, self.base[t], back @ _across(frames.place[k]))
        some = self.rel[k] >= 0
        put(self.at[some], self.rel[k][some], unit[some])
        put(self.at[some] + 3, self.rel[k][some] + 3, back[some])
        self.T: Any = csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))), shape=(columns, self.size))

    def reduced(self, lower: Array) -> Array:
        """TᵀST of a symmetric matrix of which the lower triangle is given."""
        whole = np.tril(lower) + np.tril(lower, -1).T
        return np.ascontiguousarray(self.T.T @ (self.T.T @ whole).T)

    def whole(self, matrix: Array) -> Array:
        """T Q Tᵀ."""
        return np.ascontiguousarray((self.T @ (self.T @ matrix).T).T)

    def expanded(self, inner: Array) -> Array:
        """x = T y."""
        step: Array = self.T @ inner
        return step

    def inner(self, x: Array) -> Array:
        """y of x = T y, for x (columns,) or (columns, d)."""
        y = np.zeros((self.size, *x.shape[1:]))
        y[: len(self.own)] = x[self.own]
        f, rig = self.frames, self.rig
        for row, to_instant in rig.tree:
            k, t = rig.camera[row], rig.instant[row]
            turn, shift = x[self.at[row] : self.at[row] + 3], x[self.at[row] + 3 : self.at[row] + 6]
            r, b = self.rel[k], self.base[t]
            if to_instant:
                a, along = (y[r : r + 3], y[r + 3 : r + 6]) if r >= 0 else (np.zeros_like(turn), np.zeros_like(turn))
                y[b : b + 3] = f.rotation[k].T @ (turn - a)
                y[b + 3 : b + 6] = shift - f.base_rotation[t].T @ (along + _across(f.place[k]) @ y[b : b + 3])
            else:
                y[r : r + 3] = turn - f.rotation[k] @ y[b : b + 3]
                y[r + 3 : r + 6] = f.base_rotation[t] @ (shift - y[b + 3 : b + 6]) - _across(f.place[k]) @ y[b : b + 3]
        return y


def _across(vector: Array) -> Array:
    """[v]× of vectors (…, 3)."""
    x, y, z = np.moveaxis(np.asarray(vector, float), -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


@dataclass(frozen=True)
class RelativePoses:
    """How the cameras of a rig stand against each other.

    Parameters
    ----------
    cameras, reference : tuple of str
        Names of the cameras, and of the camera that each counts from; the references themselves are not among ``cameras``.
    rotation : ndarray, shape (n, 3, 3)
        R_k: a direction in the frame of the reference in that of the camera.
    place : ndarray, shape (n, 3)
        d_k, the projection centre in the frame of the reference, in the unit of the object.
    covariance : ndarray, shape (6 n, 6 n)
        Camera by camera: small rotations about the axes of the camera, rad, then ``place``.
    """

    cameras: tuple[str, ...]
    reference: tuple[str, ...]
    rotation: Array
    place: Array
    covariance: Array

    @property
    def translation(self) -> Array:
        """t of R X + t, which takes a point of the reference's frame to that of the camera, as OpenCV has it, shape (n, 3)."""
        moved: Array = -np.einsum("nij,nj->ni", self.rotation, self.place)
        return moved

    def block(self, k: int) -> Array:
        """Covariance of one camera, shape (6, 6)."""
        own = slice(6 * k, 6 * k + 6)
        return self.covariance[own, own]


def relative_poses(adjustment: Adjustment) -> RelativePoses | None:
    """Relative poses of the cameras of an adjusted rig, with their joint covariance; None where the network has no rig.

    Raises
    ------
    ValueError
        If the adjustment has no covariance.
    """
    network, state = adjustment.network, adjustment.state
    rig = rig_of(network, state.posed)
    if rig is None:
        return None
    if not len(adjustment.covariance):
        raise ValueError("an adjustment without covariance")
    places = {name: i for i, name in enumerate(adjustment.free_columns)}
    image_col = np.array([places.get(f"{name}:rx", -1) for name in network.images])
    ties = Ties(rig, state, image_col, len(places))
    some = np.flatnonzero(ties.rel >= 0)
    rows = (ties.rel[some][:, None] + np.arange(6)).ravel()
    covariance = ties.inner(ties.inner(adjustment.covariance)[rows].T)[rows]
    names = [network.cameras[k].name for k in rig.cameras]
    return RelativePoses(
        cameras=tuple(names[k] for k in some),
        reference=tuple(names[rig.reference[k]] for k in some),
        rotation=ties.frames.rotation[some],
        place=ties.frames.place[some],
        covariance=(covariance + covariance.T) / 2,
    )
