"""Check points on a calibration's page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.calibrate.page.text import placed, sentence, typeset
from pixmetry.report.numbers import NONE, fixed, signed, significant

if TYPE_CHECKING:
    from pixmetry.calibrate.records import Calibration, CheckedPoint


def check_points(calibration: Calibration) -> dict[str, Any] | None:
    """A sentence, and rows of coordinate, given value, u, found value, u, given less found, that over the u of both, images; None where
    nothing was compared."""
    record = calibration.tests.check_points
    if record is None:
        return None
    rows = [_row(point, axis) for point in record.points for axis in range(3) if np.isfinite(point.given[axis])]
    critical = "" if record.worst is None else fixed(record.worst.critical, 1)
    fitted = f"the {record.datum_parameters} parameters" if record.datum_parameters > 1 else "the parameter"
    return {
        "text": typeset(sentence(record.text)),
        "rows": rows,
        "critical": critical,
        "level": f"{100 * record.level:g}",
        "fitted": fitted if record.datum_parameters else "",
    }


def _row(point: CheckedPoint, axis: int) -> list[str]:
    columns = (point.given, point.u_given, point.found, point.u_found, point.difference, point.ratio)
    given, u_given, found, u_found, off, ratio = (float(column[axis]) for column in columns)
    u = u_given or u_found
    return [
        f"{point.name} {'XYZ'[axis]}",
        placed(given, u),
        f"± {placed(u_given, u_given)}" if u_given else "exact",
        placed(found, u_found),
        NONE if not np.isfinite(u_found) else f"± {placed(u_found, u_found)}",
        NONE if not np.isfinite(off) else signed(off, lambda v: significant(v, 2)),
        NONE if not np.isfinite(ratio) else fixed(ratio, 1),
        str(point.images),
    ]
