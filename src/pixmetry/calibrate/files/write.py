"""The files of a calibration: a folder with the report, all numbers as JSON, and tables of points, poses and residuals; and its cameras
for OpenCV and COLMAP, with what is lost said in pixels."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry import __version__
from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.calibrate.exchange import COLMAP, EXACT_PX, OPENCV, STORAGES, colmap_line, converted, opencv_text
from pixmetry.calibrate.files.record import PIXELS, calibration_json, lines_json
from pixmetry.calibrate.lines.plumb_line import LineCalibration
from pixmetry.calibrate.records import Calibration
from pixmetry.calibrate.tables import point_columns, pose_columns, residual_columns
from pixmetry.camera.camera import Camera
from pixmetry.core.errors import InputError
from pixmetry.core.plain_text import cell, comment
from pixmetry.files.output import Output, check_files, check_output, staged_output, write_together

KIND = "calibration"
COLMAP_KINDS = ("PINHOLE", "OPENCV", "FULL_OPENCV")  # of COLMAP, the simplest that loses nothing is taken
COLMAP_HEAD = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
# How a file that pixmetry wrote begins: no other one is replaced.
COLMAP_MARK = re.compile(rb"# Written by pixmetry ")
OPENCV_MARKS = {
    ".yaml": re.compile(rb'%YAML[: ]1\.[0-9]\s+(---\s+)?written_by: "?pixmetry '),
    ".xml": re.compile(rb'<\?xml version="1\.0"\?>\s*<opencv_storage>\s*<written_by>"?pixmetry '),
    ".json": re.compile(rb'\{\s*"written_by": "pixmetry '),
}
OPENCV_MARKS[".yml"] = OPENCV_MARKS[".yaml"]


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


def check_exports(opencv: Path | None, colmap: Path | None, folder: Path, sources: Iterable[Path] = ()) -> None:
    """Refuse names that files cannot be written to, before any work is done.

    Raises
    ------
    InputError
        If a file has another ending, is a folder, lies in the folder of results, is one of the sources, or exists and was not written by
        an earlier export.
    """
    if opencv is not None and opencv.suffix.lower() not in STORAGES:
        raise InputError("not a file of OpenCV's storage", where=str(opencv), allowed=", ".join(STORAGES))
    outputs = _outputs([opencv] if opencv is not None else [], colmap)
    for path in (output.path for output in outputs):
        if path.resolve().is_relative_to(folder.resolve()):
            remedy = "choose a folder beside it"
            raise InputError("lies in the folder of results, which is replaced as a whole", where=str(path), remedy=remedy)
    check_files(outputs, sources)


def write_exports(
    models: Iterable[CameraModel], opencv: Path | None, colmap: Path | None, may_lose_px: float = 0.0, sources: Iterable[Path] = ()
) -> list[str]:
    """Write the files, all or none; of those that exist, only earlier exports are replaced.

    Parameters
    ----------
    models : iterable of CameraModel
    opencv : Path, optional
        For OpenCV's FileStorage; of several cameras each has a file of its own, ``NAME`` before the ending.
    colmap : Path, optional
        A ``cameras.txt`` with all cameras, numbered from 1.
    may_lose_px : float
        How far a point may move, anywhere in the frame, by what a program has no place for.
    sources : iterable of Path
        Files that must not be replaced.

    Returns
    -------
    list of str
        A sentence for each file, with what it lost.

    Raises
    ------
    InputError
        If more would be lost, the principal distance is not known, a file cannot be written, or another one would be replaced.
    """
    cameras = list(models)
    unknown = next((model.name for model in cameras if not model["c"] > 0), None)
    if unknown is not None:
        remedy = "calibrate with a test field, or give c_mm or c_px"
        raise InputError(
            "cannot be exported without a principal distance, which straight lines do not determine", where=unknown, remedy=remedy
        )
    places = _opencv_places(cameras, opencv)
    lines, told, texts = [f"# Written by pixmetry {__version__}\n{COLMAP_HEAD}# Number of cameras: {len(cameras)}\n"], [], []
    for k, model in enumerate(cameras):
        if opencv is not None:
            texts.append(opencv_text(model, opencv.suffix, may_lose_px))
        if colmap is not None:
            kind, lost = _simplest(model)
            lines.append(f"# {' '.join(model.name.split())}\n{colmap_line(model, k + 1, kind, may_lose_px)}\n")
            told.append(_export_sentence(colmap, f"{model.name} as camera {k + 1}, {kind}", lost))
    texts += ["".join(lines)] if colmap is not None else []
    write_together(_outputs(places, colmap), [text.encode() for text in texts], sources)
    for model, path in zip(cameras, places, strict=False):
        told.append(_export_sentence(path, f"{model.name} for OpenCV", converted(model, "object_to_image", OPENCV).largest_px))
    return told


def _outputs(opencv: Iterable[Path], colmap: Path | None) -> list[Output]:
    found = [Output(path, OPENCV_MARKS[path.suffix.lower()]) for path in opencv]
    return found + ([Output(colmap, COLMAP_MARK)] if colmap is not None else [])


def _opencv_places(cameras: list[CameraModel], opencv: Path | None) -> list[Path]:
    """The file of each camera; with several cameras the name is before the ending."""
    if opencv is None or len(cameras) == 1:
        return [] if opencv is None else [opencv]
    owns = [re.sub(r"[^A-Za-z0-9._-]+", "_", model.name) for model in cameras]
    twice = next((own for own in owns if owns.count(own) > 1), None)
    if twice is not None:
        remedy = "give the cameras names that differ in letters and digits"
        raise InputError("would be the file name of two cameras", where=f"{opencv.stem}-{twice}{opencv.suffix}", remedy=remedy)
    return [opencv.with_name(f"{opencv.stem}-{own}{opencv.suffix}") for own in owns]


def _simplest(model: CameraModel) -> tuple[str, float]:
    """COLMAP's simplest model that loses nothing, else the one with the most parameters; and what that loses, px."""
    lost = 0.0
    for kind in COLMAP_KINDS:
        lost = converted(model, "object_to_image", ("c", "xp", "yp", *COLMAP[kind])).largest_px
        if lost <= EXACT_PX:
            return kind, lost
    return COLMAP_KINDS[-1], lost


def _export_sentence(path: Path, what: str, lost: float) -> str:
    return f"{path}: {what}; " + ("nothing is lost" if lost <= EXACT_PX else f"up to {lost:.2g} px are lost")
