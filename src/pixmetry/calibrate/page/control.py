"""Control points on a calibration's page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pixmetry.calibrate.checks.known_residuals import control_of
from pixmetry.calibrate.page.text import placed
from pixmetry.report.numbers import NONE, fixed, signed, significant

if TYPE_CHECKING:
    from pixmetry.calibrate.records import Calibration, Contradicted


def control_points(calibration: Calibration) -> list[list[str]]:
    """Coordinate, given value, u as it was stated, given less adjusted, and that over u; those that were left out come first.

    What no image point is left of has no adjusted value; what weighs less now, for the network contradicts it, is marked.
    """
    network, control = calibration.adjustment.network, control_of(calibration)
    gross = calibration.tests.known.control_points.gross if calibration.tests.known is not None else ()
    rows = [_left_out(one) for one in gross if one.left_out]
    contradicted = {one.name for one in gross}
    for k in range(len(control)):
        name = f"{network.points[control.point[k]]} {'XYZ'[control.axis[k]]}"
        u, residual = float(control.u[k]), float(control.residual[k])
        cells = [_two_digits(residual), fixed(residual / u, 1) if u else NONE]
        if control.raised[k]:
            name += " (contradicted, weighs less)" if name in contradicted else " (weighs less)"
        if np.isnan(residual):
            name, cells = f"{name} (no image point left)", [NONE, NONE]
        rows.append([name, placed(float(control.given[k]), u), f"± {placed(u, u)}" if u else "fixed", *cells])
    return rows


def _left_out(one: Contradicted) -> list[str]:
    return [f"{one.name} (left out)", NONE, NONE, _two_digits(one.error), NONE]


def _two_digits(number: float) -> str:
    return signed(float(number), lambda v: significant(v, 2))
