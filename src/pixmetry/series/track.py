"""Targets of a fixed field, found in every frame and known again from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.job import locate
from pixmetry.locate.track.tracker import gates_px

USELESS = Flag.NOT_CONVERGED | Flag.BORDER


@dataclass(frozen=True)
class FrameTargets:
    """Targets of one frame: ``positions_px``, shape (n, 2), and ``covariance_px2``, (n, 2, 2); ``blur_px`` and its u, (n, 2), or None."""

    name: str
    time_s: float
    positions_px: Array
    covariance_px2: Array
    blur_px: Array | None = None

    def to_record(self) -> dict[str, Any]:
        """Plain record, a line of the log."""
        (xx, xy), (_, yy) = np.moveaxis(self.covariance_px2, 0, -1)
        rows = np.column_stack([self.positions_px, xx, xy, yy, *([] if self.blur_px is None else [self.blur_px])])
        return {"frame": self.name, "time_s": self.time_s, "targets": rows.tolist()}

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> FrameTargets:
        """The targets of a record; ``KeyError``, ``TypeError`` or ``ValueError`` where it is none."""
        rows = np.array(record["targets"], float)
        rows = rows.reshape(len(rows), -1) if rows.size else np.zeros((0, 5))
        covariance = rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
        blur = rows[:, 5:7] if rows.shape[1] == 7 else None
        return cls(str(record["frame"]), float(record["time_s"]), rows[:, :2], covariance, blur)


def find_targets(frame: np.ndarray, name: str, time_s: float, **options: Any) -> FrameTargets:
    """Find and measure the targets of one frame, on one thread; ``options`` as of `pixmetry.locate`.

    Raises
    ------
    InputError
        If the frame or an option cannot be used.
    """
    found = locate(frame, name=name, threads=1, **options)
    xx, xy, yy = (np.asarray(found[n], float) for n in ("var_x_px2", "cov_xy_px2", "var_y_px2"))
    positions = np.column_stack([found["x_px"], found["y_px"]]).astype(float)
    good = (np.asarray(found["flags"]).astype(int) & int(USELESS) == 0) & np.isfinite(positions).all(axis=1) & (xx > 0) & (yy > 0)
    covariance = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    blur = np.column_stack([found[column] for column in ("blur_px", "u_blur_px")]).astype(float)
    return FrameTargets(name, time_s, positions[good], covariance[good], blur[good])


def follow_targets(frames: Sequence[FrameTargets]) -> tuple[Array, Array]:
    """Know the targets of one frame again in all others.

    Parameters
    ----------
    frames : sequence of FrameTargets
        In order of time.

    Returns
    -------
    positions_px, covariance_px2 : ndarray, shape (frames, targets, 2) and (frames, targets, 2, 2)
        NaN where a target was not found.

    Raises
    ------
    MeasureError
        If the frames show no targets.

    Notes
    -----
    The list of targets is that of the first frame with the usual number of them. A target is looked for where it was in the frame before,
    moved as all were from the frame before that; two belong together if each is the other's nearest, within 0.4 of the distance between
    neighbours.
    """
    counts = np.array([len(f.positions_px) for f in frames])
    if not counts.size or counts.max() == 0:
        raise MeasureError("no targets are found in any frame", where="series", remedy="check the kind of target, and that it is in focus")
    usual = np.bincount(counts[counts > 0]).argmax()
    start = int(np.flatnonzero(counts == usual)[0])
    first = frames[start].positions_px
    positions = np.full((len(frames), len(first), 2), np.nan)
    covariance = np.full((len(frames), len(first), 2, 2), np.nan)
    for order in (range(start, len(frames)), range(start - 1, -1, -1)):
        last, step = first.copy(), np.zeros(2)
        for k in order:
            found = frames[k]
            if not len(found.positions_px):
                continue
            one, other = near_pairs(last + step, found.positions_px)
            positions[k, one], covariance[k, one] = found.positions_px[other], found.covariance_px2[other]
            if one.size:
                step = np.median(found.positions_px[other] - last[one], axis=0)
                last = last + step
                last[one] = found.positions_px[other]
    return positions, covariance


def blur_of(frames: Sequence[FrameTargets], positions_px: Array) -> Array:
    """Variance of the blur of targets that were followed, and its u, px², shape (frames, targets, 2); NaN where it was not measured."""
    found = np.full(positions_px.shape, np.nan)
    for k, frame in enumerate(frames):
        if frame.blur_px is None:
            continue
        at = {tuple(place): row for place, row in zip(frame.positions_px.tolist(), frame.blur_px, strict=True)}
        for i, place in enumerate(positions_px[k].tolist()):
            if tuple(place) in at:
                blur, u = at[tuple(place)]
                found[k, i] = blur**2, 2 * blur * u
    return found


def near_pairs(known: Array, found: Array, gate: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Indices of places that are each other's nearest within a distance: by default 0.4 of that between neighbours, 25 px at most."""
    if gate is None:
        gate = float(gates_px(known).min())
    there, back = cKDTree(found).query(known)[1], cKDTree(known).query(found)[1]
    near = np.linalg.norm(found[there] - known, axis=1) < gate
    one = np.flatnonzero(near & (back[there] == np.arange(len(known))))
    return one, there[one]
