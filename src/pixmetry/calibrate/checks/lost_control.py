"""Known points most of whose image points were rejected: it is then rather what was known that is wrong. They are set free, and their
image points take part again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment, Network, State
from pixmetry.calibrate.records import Contradicted
from pixmetry.calibrate.start.resection import intersect, rays

LEAST_RAYS = 3  # rejected rays that condemn a known point, where they are more than half
MOST_WRONG = 0.2  # part of the known points that can be wrong one by one,
ONE_OF = 4  # and one of so few


def mostly_lost(network: Network, adjustment: Adjustment) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of which something is known and most of whose image points in oriented images are out: indices, image points, those out."""
    size = len(network.points)
    posed = np.isfinite(adjustment.state.position).all(axis=1)[network.image]
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
