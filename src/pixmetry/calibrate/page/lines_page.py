"""The report of a calibration from straight lines: one HTML file that needs nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry import __version__
from pixmetry.calibrate.page import lines_text as text
from pixmetry.calibrate.page.figures import enlargement, frame, frame_height, length_key
from pixmetry.calibrate.page.page import camera_facts, provenance_rows
from pixmetry.calibrate.page.plots import correlation_map, curve_pictures
from pixmetry.calibrate.page.text import DIRECTIONS, sentence, typeset
from pixmetry.report.drawing import BLUE, RED, SOFT, canvas
from pixmetry.report.numbers import fixed, length_px, significant
from pixmetry.report.page import Figure
from pixmetry.report.templates import filled, share_styles

if TYPE_CHECKING:
    from pixmetry.calibrate.lines.line_calibration import LineCalibration

MOST_IMAGES = 12  # that are drawn, those with the largest residuals


def write_page(calibration: LineCalibration, path: str | Path) -> Path:
    """Write the page and return its path; raises as `calibration_page.write_page`."""
    from pixmetry.files import write_page as write

    return write(path, render(calibration))


def render(calibration: LineCalibration) -> str:
    """Return the page as text."""
    return share_styles(filled("lines.html.jinja", _content(calibration)))


def _content(calibration: LineCalibration) -> dict[str, Any]:
    result, camera = calibration.result, calibration.camera()
    images = list(dict.fromkeys(calibration.image.tolist()))
    told = provenance_rows(calibration.provenance)
    inputs = [[i["name"], str(i["size_bytes"]), i["sha256"]] for i in told["inputs"]]
    facts = [("Images", str(len(images))), ("Lines", str(len(result.lines))), ("Positions", str(len(calibration.x_px)))]
    matrix = result.estimates.covariance / np.outer(result.estimates.u, result.estimates.u)
    lens = [*curve_pictures(calibration.curves(), camera.direction, "lens"), correlation_map(result.free, matrix, "lens")]
    rows = [
        [str(r["image"]), str(r["line"]), r["axis"], fixed(r["angle_deg"], 2), str(r["n"]), length_px(r["rms_px"]), f"{r['dof']:.1f}"]
        for r in result.lines
    ]
    return {
        "version": __version__,
        "name": str(calibration.provenance.get("name") or camera.name),
        "facts": [*facts, ("Left out", str(int((~result.used).sum())))],
        "worth": text.worth(calibration),
        "verdict": [(n, length_px(a.rms_px), "" if a.rms_um is None else length_px(a.rms_um)) for n, a in result.axes.items()],
        "findings": [replace(f, text=typeset(sentence(f.text)), advice=typeset(sentence(f.advice))) for f in calibration.findings],
        "camera": camera_facts(camera),
        "direction": DIRECTIONS[camera.direction],
        "parameters": text.parameter_rows(calibration),
        "lens": lens,
        "axis_heads": text.axis_heads(calibration),
        "axes": text.axis_rows(calibration),
        "f_text": typeset(sentence(result.f_test["text"])) if result.f_test else "",
        "f_rows": text.f_rows(result.f_test),
        "with_um": bool(result.f_test and result.f_test["p_um"]),
        "drawn": drawn_lines(calibration),
        "lines": rows,
        **told,
        "inputs": inputs,
    }


def drawn_lines(calibration: LineCalibration) -> list[Figure]:
    """Lines over the sensor, image by image, with their residuals across them enlarged; all at one scale."""
    result, sensor = calibration.result, calibration.camera().sensor
    about_x = np.array([r["axis"] == "x" for r in result.lines])[result.line_of]
    dx, dy = np.where(about_x, result.residual_px, 0.0), np.where(about_x, 0.0, result.residual_px)
    images, index = np.unique(calibration.image, return_inverse=True)
    square = np.bincount(index, np.where(result.used, result.residual_px, 0.0) ** 2) / np.bincount(index)
    shown = np.argsort(-square, kind="stable")[:MOST_IMAGES]
    factor, key = enlargement(dx[result.used], dy[result.used], sensor.cols, share=0.03)
    made = []
    for k, image in enumerate(shown):
        with canvas(frame_height(sensor)) as (figure, axes):
            frame(axes, sensor)
            for line in np.unique(result.line_of[index == image]):
                at = np.flatnonzero(result.line_of == line)
                at = at[np.argsort(result.along[at])]
                x, y = calibration.x_px[at], calibration.y_px[at]
                axes.plot(x, y, color=SOFT, linewidth=0.5)
                good = at[result.used[at]]
                shifted = calibration.x_px[good] + factor * dx[good], calibration.y_px[good] + factor * dy[good]
                axes.plot(*shifted, color=BLUE, linewidth=0.8)
            lost = np.flatnonzero((index == image) & ~result.used)
            axes.plot(calibration.x_px[lost], calibration.y_px[lost], "x", color=RED, markersize=4)
            length_key(axes, factor, key)
            mine = f"{images[image]}: residuals across the lines, {significant(factor, 1)} times enlarged"
            caption = f"{mine}; crosses are positions that were left out." if len(lost) else f"{mine}."
            made.append(Figure(figure, f"lines{k + 1}", f"Residuals across the lines of {images[image]}", caption))
    return made
