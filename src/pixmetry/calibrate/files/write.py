"""The files of a calibration: a folder with the report, all numbers as JSON, and tables of points, poses and residuals."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.calibrate.files.record import PIXELS, calibration_json, lines_json
from pixmetry.calibrate.lines.plumb_line import LineCalibration
from pixmetry.calibrate.records import Calibration
from pixmetry.calibrate.tables import point_columns, pose_columns, residual_columns
from pixmetry.camera.camera import Camera
from pixmetry.core.plain_text import cell, comment
from pixmetry.files.output import check_output, staged_output

KIND = "calibration"


def check_folder(folder: str | Path, of: Sequence[str | Path] = (), inputs: Iterable[Path] = ()) -> None:
    """Refuse a folder in which something else than an earlier calibration of the same would be lost; before any work is done.

    Parameters
    ----------
    folder : path
    of : sequence of str or Path
        What is calibrated: names, and files or folders.
    inputs : iterable of Path
        Files that must not be replaced.

    Raises
    ------
    InputError
        If it is a file, holds other files, an input or another calibration, or cannot be written to.
    """
    check_output(folder, KIND, of, inputs)


def write_results(
    calibration: Calibration,
    folder: str | Path,
    cameras: Mapping[str, Camera] | None = None,
    of: Sequence[str | Path] = (),
    inputs: Iterable[Path] = (),
) -> Path:
    """Write the folder of results, whole or not at all; an earlier calibration in it is replaced.

    Parameters
    ----------
    calibration : Calibration
    folder : path
    cameras : mapping of str to Camera, optional
        Further files, for `pixmetry simulate`.
    of, inputs
        As of `check_folder`, which tells the errors.
    """
    from pixmetry.calibrate.page.page import write_page

    with staged_output(folder, KIND, of, inputs) as place:
        for name, text in TABLES.items():
            (place / name).write_text(text(calibration), encoding="utf-8", newline="\n")
        write_page(calibration, place / "report.html")
        for name, camera in (cameras or {}).items():
            camera.save(place / name)
        _write_numbers(place, calibration_json, calibration)
    return Path(folder)


def write_line_results(
    calibration: LineCalibration, folder: str | Path, of: Sequence[str | Path] = (), inputs: Iterable[Path] = ()
) -> Path:
    """The same for a calibration from straight lines."""
    from pixmetry.calibrate.page.lines_page import write_page

    with staged_output(folder, KIND, of, inputs) as place:
        (place / "residuals.csv").write_text(line_residuals_csv(calibration), encoding="utf-8", newline="\n")
        write_page(calibration, place / "report.html")
        _write_numbers(place, lines_json, calibration)
    return Path(folder)


def _write_numbers(place: Path, text: Callable[..., str], calibration: Any) -> None:
    """Write all numbers, last of all: with the digests of the other files."""
    beside = [path.name for path in place.iterdir()]
    (place / "calibration.json").write_text(text(calibration, place, beside), encoding="utf-8", newline="\n")


def points_csv(calibration: Calibration) -> str:
    """Object points with their uncertainties; a table that a project can name as its points."""
    a = calibration.adjustment
    return _csv([f"unit {a.network.unit}; datum: {a.datum}"], point_columns(a))


def poses_csv(calibration: Calibration) -> str:
    """Projection centres and rotations of the images with their uncertainties."""
    a = calibration.adjustment
    text = "a point X is imaged at R (X - X0), R by rows, z forwards, x to the right, y down; u of rotations about the camera's axes"
    return _csv([f"unit {a.network.unit}; datum: {a.datum}", text], pose_columns(a))


def residuals_csv(calibration: Calibration) -> str:
    """Image coordinates with their residuals; a table that a project can name as its observations."""
    text = "residual: measured minus computed; image coordinates of centres, without eccentricity; variances as they were used"
    return _csv([PIXELS, text], residual_columns(calibration.adjustment))


def line_residuals_csv(calibration: LineCalibration) -> str:
    """Positions on lines with their residuals across them; a table that a project can name as its lines."""
    result = calibration.result
    columns: dict[str, Any] = {
        "image": calibration.image.tolist(),
        "line": calibration.line.tolist(),
        "x_px": calibration.x_px,
        "y_px": calibration.y_px,
        "axis": [result.lines[k].axis for k in result.line_of],
        "residual_px": result.residual_px,
        **({} if result.residual_um is None else {"residual_um": result.residual_um}),
        "used": result.used.astype(int),
        "redundancy": result.redundancy,
    }
    return _csv([PIXELS, "residual: across the line, towards +x (axis x: the line determines x) or +y"], columns)


# A new table of the results needs a line here.
TABLES: dict[str, Callable[[Calibration], str]] = {
    "points.csv": points_csv,
    "poses.csv": poses_csv,
    "residuals.csv": residuals_csv,
}


def _csv(comments: Iterable[str], columns: Mapping[str, Any]) -> str:
    text = io.StringIO()
    for line in comments:
        text.write(f"# {comment(line)}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(_texts(values) for values in columns.values()), strict=True))
    return text.getvalue()


def _texts(values: Any) -> list[Any]:
    """A number with ten digits, empty if there is none; names in a form that is safe in cells."""
    plain = values.tolist() if isinstance(values, np.ndarray) else values
    return [cell(v) if isinstance(v, str) else ("" if math.isnan(v) else f"{v:.10g}") if isinstance(v, float) else v for v in plain]
