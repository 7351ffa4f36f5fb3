"""Control points on a calibration's page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pixmetry.calibration.control import control_of
from pixmetry.report.numbers import NONE, fixed, signed, significant, uncertain

if TYPE_CHECKING:
    from pixmetry.calibration.network import Calibration


def control_points(calibration: Calibration) -> list[list[str]]:
    """Coordinate, given value, u, given less adjusted, and that over u; those that were left out come first."""
    network, control = calibration.adjustment.network, control_of(calibration.adjustment)
    rows = [_left_out(record) for record in _gross(calibration) if record.get("left_out")]
    for k in range(len(control)):
        number = uncertain(float(control.given[k]), float(control.u[k]), network.unit)
        name = f"{network.points[control.point[k]]} {'XYZ'[control.axis[k]]}"
        rows.append([name, number.value, f"± {number.u}", _two_digits(control.residual[k]), fixed(float(control.ratio[k]), 1)])
    return rows


def _gross(calibration: Calibration) -> list[Mapping[str, Any]]:
    known = calibration.tests.get("known") or {}
    return list((known.get("control_points") or {}).get("gross") or ())


def _left_out(record: Mapping[str, Any]) -> list[str]:
    return [f"{record['name']} (left out)", NONE, NONE, _two_digits(record["error"]), NONE]


def _two_digits(number: float) -> str:
    return signed(float(number), lambda v: significant(v, 2))
