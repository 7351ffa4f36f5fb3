"""From pixels to the object: how well points are known in space by rays from several images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pixmetry.budget.answer import SIGNED, together_of
from pixmetry.budget.motion import OF_MOTION
from pixmetry.budget.networks import Images, solve
from pixmetry.budget.setting import MOST_POINTS, MOST_RAYS, Setting
from pixmetry.budget.table import COUNTED, SourceRow, independent_px

LEAST_PX = 1e-6  # of noise, by which an adjustment weighs


@dataclass(frozen=True)
class SpacePoint:
    """Uncertainty of points in space, k = 1; axes along the base, across it, and along the line of sight.

    Parameters
    ----------
    covariance_mm2 : ndarray, shape (3, 3)
        Mean over the object.
    worst_mm : ndarray, shape (3,)
        Standard uncertainty of the point where it is largest, axis by axis: most often at the edge of the field.
    shared_mm : ndarray, shape (3,)
        Part of the mean that comes of what is the same in every image, and is not averaged by more of them.
    """

    covariance_mm2: np.ndarray
    worst_mm: np.ndarray
    shared_mm: np.ndarray

    @property
    def u_mm(self) -> np.ndarray:
        """Standard uncertainty of the mean over the object, shape (3,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance_mm2)))


def point_of(rows: Sequence[SourceRow], setting: Setting, frames: int = 1, targets: int = 1) -> SpacePoint | None:
    """Points in space by the scenario's rays; None where the scale is not known, there is one ray, or nothing counts.

    Parameters
    ----------
    rows : sequence of SourceRow
    setting : Setting
    frames, targets : int
        Of which means are taken.

    Notes
    -----
    A bundle adjustment of the network that `Setting.network` lays out, linear about the truth: orientations are estimated from the points
    (unless they are known), interior parameters are held at what the calibration says, coordinates are relative to the mean of the points
    and to their mean size. What changes from image point to image point is propagated as noise; what the calibration leaves of a
    displacement over the frame goes through the same adjustment as it is, signs included where they are known, since it is the same in
    every image. What a motion shifts in all images alike, shifts the point.
    """
    network, scale = setting.network, setting.px_per_mm
    counted = [r for r in rows if r.status in COUNTED and r.after is not None]
    if network is None or scale is None or not counted:
        return None
    count, square = setting.scenario.count, np.array([1.0, setting.aspect])
    noise = square * independent_px(counted, frames, targets)
    sigma = (float(max(noise[0], LEAST_PX)), float(max(noise[1], LEAST_PX)))
    known = solve(network, sigma, posed=True)
    random = known.point_covariance
    found = known
    if count.points:
        found = solve(network, sigma)  # orientations by so many points, of which some are computed
        random = random + (found.point_covariance - random) * min(1.0, MOST_POINTS / count.points)
    random = random * min(1.0, MOST_RAYS / count.rays)
    signed, several = _fields(counted, network, square)
    moved = found.points_by(np.concatenate([signed[None], several])) if len(several) else found.points_by(signed[None])
    shared = np.einsum("knx,kny->nxy", moved, moved)
    mm = network.c_px / scale
    shared = mm**2 * shared + np.diag([*_along(counted, square, scale), 0.0])
    each = mm**2 * random + shared
    if not each.any():
        return None
    worst = np.sqrt(np.diagonal(each, axis1=1, axis2=2).max(axis=0))
    return SpacePoint(each.mean(axis=0), worst, np.sqrt(np.diag(shared.mean(axis=0))))


def _fields(rows: Sequence[SourceRow], network: Images, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is the same in every image, in pixels along x: the sum of what has a sign, shape (2, m, n), and the others, (k, 2, m, n)."""
    shape = network.image.shape
    signed, several = np.zeros(shape), []
    for row in rows:
        if row.fields_px is not None:
            fields = row.fields_px.reshape(-1, *shape) * square[:, None, None]
        elif row.after is not None and any(row.after.constant_px) and row.source_id not in OF_MOTION:
            fields = np.broadcast_to((np.array(row.after.constant_px) * square)[:, None, None], (1, *shape))
        else:
            continue
        if row.status in SIGNED and len(fields) == 1:
            signed = signed + fields[0]
        else:
            several += list(fields)
    return signed, np.array(several).reshape(-1, *shape)


def _along(rows: Sequence[SourceRow], square: np.ndarray, scale: float) -> np.ndarray:
    """Variance in mm² along X and Y of what a motion shifts in all images alike."""
    shifts = [(r.after.constant_px, r.status in SIGNED) for r in rows if r.after is not None and r.source_id in OF_MOTION]
    return np.square(np.array(together_of(shifts)) * square / scale)
