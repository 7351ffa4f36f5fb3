"""Control points after an adjustment: by how much the coordinates that were given differ from those that were found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.calibrate.records import Calibration


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
