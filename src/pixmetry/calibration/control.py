"""Control points after an adjustment: by how much the coordinates that were given differ from those that were found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.calibration.network import Adjustment


@dataclass(frozen=True)
class Control:
    """Coordinates that were given with an uncertainty, of points that the adjustment determined.

    Parameters
    ----------
    point : ndarray of int, shape (m,)
    axis : ndarray of int, shape (m,)
        0, 1, 2 for X, Y, Z.
    given, u, residual : ndarray, shape (m,)
        In the object's unit; the residual is given less adjusted.
    """

    point: np.ndarray
    axis: np.ndarray
    given: np.ndarray
    u: np.ndarray
    residual: np.ndarray

    def __len__(self) -> int:
        return len(self.point)

    @property
    def ratio(self) -> np.ndarray:
        """Residuals over the uncertainty that was stated."""
        return self.residual / self.u


def control_of(adjustment: Adjustment) -> Control:
    """Given less adjusted coordinates of all weighted control points that took part, point by point.

    A control point that the network contradicts has been set free and is among the gross errors instead.
    """
    network, found = adjustment.network, adjustment.state.xyz
    weighted = np.isfinite(network.u_xyz) & (network.u_xyz > 0) & np.isfinite(network.xyz) & np.isfinite(found)
    point, axis = np.nonzero(weighted)
    given = network.xyz[weighted]
    return Control(point, axis, given, network.u_xyz[weighted], given - found[weighted])
