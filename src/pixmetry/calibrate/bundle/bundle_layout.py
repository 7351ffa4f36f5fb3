"""What takes part in an adjustment, in the order in which the kernels of the bundle want it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress

import numpy as np

from pixmetry.calibrate.bundle._bundle_kernels import ELIMINATED, HELD, Incidence
from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.bundle.network import PER_IMAGE_NAMES, Network, ScaleBars, State
from pixmetry.calibrate.bundle.rig import Rig, Ties, rig_of
from pixmetry.core.arrays import Array, Flags, Ints
from pixmetry.core.errors import InputError, MeasureError

POSE = ("rx", "ry", "rz", "X0", "Y0", "Z0")
LEAST_IN_IMAGE = 3  # image points: six numbers for six parameters of the pose


@dataclass(frozen=True)
class Layout:
    """Observations sorted by point and image, and the index of each unknown.

    Parameters
    ----------
    network : Network
    order : ndarray of int, shape (n,)
        Image coordinates whose image and point are determined, sorted by point, then image.
    used : ndarray of bool, shape (n,)
        In that order: those that take part.
    first : ndarray of int, shape (points + 1,)
    by_image : ndarray of int
        Those of eliminated points that take part, image by image.
    x, y, whiten, image, point : ndarray
        In that order; ``whiten`` (n, 3): lower triangle of the inverse Cholesky factor of the covariance.
    free : ndarray of int, shape (cameras, f)
        Free interior parameters, -1 after the last.
    camera_col, camera_count, image_col, point_col : ndarray of int
        First reduced unknown of each camera, its number, of each image (-1: none), of each point (see the kernels).
    extra : ndarray of int, shape (2,)
        Columns of x-scale and x-shift behind those of the camera's orientation; -1: not estimated.
    columns : tuple of str
        Names of the reduced unknowns.
    held : ndarray of bool, shape (points, 3)
        Coordinates that are no unknowns.
    prior : ndarray, shape (points, 3)
        Weights of the coordinates known beforehand.
    bars : ScaleBars
        Between determined points.
    constraints : ndarray, shape (constraints, unknowns)
        Rows of unit length whose product with the reduced unknowns stays 0.
    form, per_px : ndarray, shape (cameras,), (cameras, 2)
        Direction of the distortion and projection; length units per pixel.
    rig : Rig, optional
        Images whose poses depend on each other.
    notes : tuple of str
    """

    network: Network
    order: Ints
    used: Flags
    first: Ints
    by_image: Ints
    x: Array
    y: Array
    whiten: Array
    image: Ints
    point: Ints
    free: Ints
    camera_col: Ints
    camera_count: Ints
    image_col: Ints
    point_col: Ints
    extra: Ints
    columns: tuple[str, ...]
    held: Flags
    prior: Array
    bars: ScaleBars
    constraints: Array
    form: Ints
    per_px: Array
    rig: Rig | None = None
    notes: tuple[str, ...] = ()

    @property
    def determined(self) -> Flags:
        """Points that take part, bool."""
        return np.bincount(self.point, minlength=len(self.network.points)) > 0

    @property
    def eliminated(self) -> Ints:
        """Indices of the points that are eliminated."""
        return np.flatnonzero(self.point_col == ELIMINATED)

    @property
    def estimated(self) -> Flags:
        """Reduced unknowns that are estimated, bool: all but the held coordinates of points that bars join."""
        out = np.ones(len(self.columns), bool)
        joined = np.flatnonzero(self.point_col >= 0)
        out[self.point_col[joined][:, None] + np.arange(3)] = ~self.held[joined]
        return out

    @property
    def free_columns(self) -> tuple[str, ...]:
        """Names of the reduced unknowns that are estimated."""
        return tuple(compress(self.columns, self.estimated))

    @property
    def camera_of(self) -> Ints:
        """Camera of each image."""
        return self.network.camera_of.astype(np.int64)

    @cached_property
    def incidence(self) -> Incidence:
        """What sees what, and which unknowns there are, as the kernels take it."""
        free = np.ascontiguousarray(self.free[:, : int(self.camera_count.max())])
        columns = (self.camera_col, self.camera_count, self.image_col, self.point_col)
        return Incidence(self.image, self.point, self.first, self.camera_of, free, self.extra, *columns)

    def ties(self, state: State) -> Ties | None:
        """How the unknowns of a rig's images depend on those of the rig, at a state; None without a rig."""
        return None if self.rig is None else Ties(self.rig, state, self.image_col, len(self.columns))

    @property
    def per_image(self) -> int:
        """Unknowns of an image."""
        return len(POSE) + len([name for name in PER_IMAGE_NAMES if name in self.network.per_image])


def layout_of(network: Network, start: State, used: np.ndarray | None) -> Layout:
    """Decide what takes part.

    Raises
    ------
    InputError
        Where a covariance, a bar or an index cannot be.
    MeasureError
        Where nothing is left.
    """
    _check(network)
    take = np.ones(len(network), bool) if used is None else np.asarray(used, bool).copy()
    take &= np.isfinite(network.x_px) & np.isfinite(network.y_px)
    held = network.u_xyz == 0
    image_there = start.posed & np.all(np.isfinite(start.rotation), axis=(1, 2))
    take, image_there, point_there = _determined(network, take, image_there, start.located)
    known = image_there[network.image] & point_there[network.point]
    known &= np.isfinite(network.x_px) & np.isfinite(network.y_px)
    if not (take & known).any():
        remedy = "give start values for images and points"
        raise MeasureError("no image coordinates are left to adjust", where="bundle adjustment", remedy=remedy)
    order = np.flatnonzero(known)
    order = order[np.lexsort((network.image[order], network.point[order]))].astype(np.int64)
    point = network.point[order].astype(np.int64)
    image = network.image[order].astype(np.int64)

    cameras = [np.flatnonzero(camera.free) for camera in network.cameras]
    seen = np.isin(np.arange(len(cameras)), network.camera_of[image_there])
    count = np.array([len(free) if there else 0 for free, there in zip(cameras, seen, strict=True)], np.int64)
    free = np.full((len(cameras), max(1, count.max())), -1, np.int64)
    columns = []
    for k, which in enumerate(cameras):
        if seen[k]:
            free[k, : len(which)] = which
            columns += [f"{network.cameras[k].name}:{NAMES[w]}" for w in which]
    camera_col = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int64)
    image_col, extra, constraints = _images(network, image_there, int(count.sum()), columns)
    bars, point_col = _points(network, point_there, held, len(columns), columns)
    with np.errstate(divide="ignore"):
        prior = np.where(held | ~point_there[:, None], 0.0, 1.0 / network.u_xyz**2)
    return Layout(
        network=network,
        order=order,
        used=take[order],
        first=np.searchsorted(point, np.arange(len(network.points) + 1)).astype(np.int64),
        by_image=_by_image(image, take[order] & (point_col[point] == ELIMINATED)),
        x=network.x_px[order].astype(float),
        y=network.y_px[order].astype(float),
        whiten=_whitening(network.covariance_px2[order]),
        image=image,
        point=point,
        free=free,
        camera_col=camera_col,
        camera_count=count,
        image_col=image_col,
        point_col=point_col,
        extra=extra,
        columns=tuple(columns),
        held=held,
        prior=prior,
        bars=bars,
        constraints=np.array([np.pad(row, (0, len(columns) - len(row))) for row in constraints]).reshape(-1, len(columns)),
        form=np.array([camera.form for camera in network.cameras], np.int64),
        per_px=np.array([camera.sensor.per_px for camera in network.cameras], float),
        rig=rig_of(network, image_there),
        notes=_lost_bars(network, point_there),
    )


def _lost_bars(network: Network, there: np.ndarray) -> tuple[str, ...]:
    b = network.bars
    lost = np.flatnonzero(~(there[b.start] & there[b.end]))
    names = ", ".join(f"{network.points[b.start[k]]}–{network.points[b.end[k]]}" for k in lost)
    return (f"scale bars are not used, because an end point is not determined: {names}",) if len(lost) else ()


def without(layout: Layout, start: State, points: np.ndarray) -> Layout:
    """The same with some points left out, because their rays hardly meet."""
    xyz = start.xyz.copy()
    xyz[points] = np.nan
    used = np.zeros(len(layout.network), bool)
    used[layout.order[layout.used]] = True
    names = ", ".join(layout.network.points[j] for j in points[:5]) + (" …" if len(points) > 5 else "")
    note = f"{len(points)} points are not determined, because their rays are almost parallel: {names}"
    rest = layout_of(layout.network, replace(start, xyz=xyz), used)
    return replace(rest, notes=(*rest.notes, note))


def _check(network: Network) -> None:
    var_x, cov, var_y = np.asarray(network.covariance_px2, float).T
    bad = np.flatnonzero(~((var_x > 0) & (var_y > 0) & (var_x * var_y > cov**2)))
    if len(bad):
        found = tuple(float(v) for v in network.covariance_px2[bad[0]])
        raise InputError("not a covariance of image coordinates", where=f"row {bad[0]}", value=found, allowed="positive definite, in px²")
    if len(network.bars) and not ((network.bars.u > 0).all() and (network.bars.length > 0).all()):
        raise InputError("not a scale bar", where="scale bars", allowed="length and uncertainty above 0")


def _determined(network: Network, take: np.ndarray, images: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Leave out free points with fewer than two rays and images with too few points, until nothing changes."""
    needed = np.where(np.isinf(network.u_xyz).all(axis=1), 2, 1)
    while True:
        take = take & images[network.image] & points[network.point]
        rays = np.bincount(network.point[take], minlength=len(points))
        seen = np.bincount(network.image[take], minlength=len(images))
        fewer_points, fewer_images = points & (rays >= needed), images & (seen >= LEAST_IN_IMAGE)
        if (fewer_points == points).all() and (fewer_images == images).all():
            return take, images, points
        images, points = fewer_images, fewer_points


def _images(network: Network, there: np.ndarray, at: int, columns: list[str]) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Columns of the images; append their names."""
    more = [name for name in PER_IMAGE_NAMES if name in network.per_image]
    each = len(POSE) + len(more)
    image_col = np.full(len(network.images), -1, np.int64)
    image_col[there] = at + each * np.arange(there.sum())
    for i in np.flatnonzero(there):
        columns += [f"{network.images[i]}:{name}" for name in (*POSE, *more)]
    extra = np.array([len(POSE) + more.index(name) if name in more else -1 for name in PER_IMAGE_NAMES], np.int64)
    constraints = []
    for k in range(len(network.cameras)):
        of_camera = image_col[there & (network.camera_of == k)]
        for place in extra[extra >= 0]:
            if len(of_camera):
                row = np.zeros(len(columns))
                row[of_camera + place] = 1 / np.sqrt(len(of_camera))
                constraints.append(row)
    return image_col, extra, constraints


def _points(network: Network, there: np.ndarray, held: np.ndarray, at: int, columns: list[str]) -> tuple[ScaleBars, np.ndarray]:
    """Bars between determined points, and the columns of the points that they join; append their names."""
    keep = there[network.bars.start] & there[network.bars.end]
    b = network.bars
    bars = ScaleBars(b.start[keep], b.end[keep], b.length[keep], b.u[keep])
    point_col = np.where(there & ~held.all(axis=1), ELIMINATED, HELD).astype(np.int64)
    for j in np.unique(np.concatenate([bars.start, bars.end])):
        if point_col[j] == ELIMINATED:
            point_col[j] = at
            at += 3
            columns += [f"{network.points[j]}:{axis}" for axis in "XYZ"]
    return bars, point_col


def _by_image(image: np.ndarray, some: np.ndarray) -> np.ndarray:
    places = np.flatnonzero(some)
    return places[np.argsort(image[places], kind="stable")]


def _whitening(covariance_px2: np.ndarray) -> np.ndarray:
    """Lower triangle of L⁻¹, with L Lᵀ the covariance."""
    var_x, cov, var_y = np.asarray(covariance_px2, float).T
    l0 = np.sqrt(var_x)
    l1 = cov / l0
    l2 = np.sqrt(var_y - l1**2)
    return np.ascontiguousarray(np.stack([1 / l0, -l1 / (l0 * l2), 1 / l2], axis=1))
