"""Page of a calibration from straight lines, and its summary for the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.page.figures import correlation_map, curve_pictures, enlargement, frame, frame_height, length_key
from pixmetry.calibrate.page.page import FOOTER, camera_facts, number_table, typeset_findings
from pixmetry.calibrate.page.text import DIRECTIONS, TITLES, folded, length, p_text, symbol, typeset
from pixmetry.core.finding import finding_lines, sentence
from pixmetry.report import Answer, Figure, Page, Reading, Section, Text, html_of
from pixmetry.report.drawing import BLUE, RED, SOFT, canvas
from pixmetry.report.numbers import NO_BREAK, NONE, THIN, fixed, length_px, significant, uncertain
from pixmetry.report.provenance import provenance_section

if TYPE_CHECKING:
    from pixmetry.calibrate.lines.plumb_line import LineCalibration
    from pixmetry.calibrate.records import LinesFTest

MOST_IMAGES = 12  # that are drawn, those with the largest residuals
PARAMETERS = (
    "Value ± standard uncertainty u (k = 1, two significant digits). Pixel (0, 0) is the centre of the top-left pixel, x to the right, y "
    "down."
)
RESIDUALS = (
    "Lines along y determine x, lines along x determine y. rms: root of the sum of squares over the degrees of freedom, n − 2 for "
    "each line minus the share of the lens parameters."
)
COUNTING = (
    "By position: as if all were independent. Effective: fewer, because errors of neighbours along a line are correlated. By line: as if "
    "all errors of a line were equal, which is on the safe side."
)
COUNTED = (("positions", "by position"), ("effective", "effective"), ("lines", "by line"))


def write_page(calibration: LineCalibration, path: str | Path) -> Path:
    """Write the page as HTML and return its path; raises as that of a calibration by bundle adjustment."""
    from pixmetry.files import write_page as write

    return write(path, html_of(page_of(calibration)))


def page_of(calibration: LineCalibration) -> Page:
    """The page of a calibration from straight lines.

    Parameters
    ----------
    calibration : LineCalibration

    Returns
    -------
    Page
    """
    result, camera = calibration.result, calibration.camera()
    facts = [
        ("Images", str(len(set(calibration.image.tolist())))),
        ("Lines", str(len(result.lines))),
        ("Positions", str(len(calibration.x_px))),
        ("Left out", str(int((~result.used).sum()))),
    ]
    name = str(calibration.provenance.get("name") or camera.name)
    page = Page(name, "calibration from straight lines", "pixmetry lens calibration from straight lines", facts, FOOTER)
    verdict = page.add_section("Remaining residuals", name="verdict")
    readings = [
        Reading(axis, f"{length_px(a.rms_px)} px", "" if a.rms_um is None else f"= {length_px(a.rms_um)} µm")
        for axis, a in result.axes.items()
    ]
    verdict.add(Answer([Text(worth(calibration)), readings]), *typeset_findings(calibration.findings))
    if not calibration.findings:
        verdict.add_text("The tests of this calibration found nothing.", style="soft")
    lens = page.add_section("Lens", Text(PARAMETERS, "small soft"), name="parameters")
    lens.add_text(f"{camera_facts(camera)} The distortion model {DIRECTIONS[camera.direction]}.")
    lens.add(number_table("Parameters", ["Parameter", "", "Value", "± u", "Unit"], parameter_rows(calibration), 2))
    matrix = result.estimates.covariance / np.outer(result.estimates.u, result.estimates.u)
    lens.add(*curve_pictures(calibration.curves(), camera.direction, "lens"), correlation_map(result.free, matrix, "lens"))
    _residuals(page.add_section("Residuals across the lines", name="residuals"), calibration)
    if (origin := provenance_section(calibration.provenance)) is not None:
        page.sections.append(origin)
    return page


def _residuals(section: Section, calibration: LineCalibration) -> None:
    result = calibration.result
    section.add_text(RESIDUALS, style="small soft")
    section.add(number_table("Residuals by axis", axis_heads(calibration), axis_rows(calibration)))
    test = result.f_test
    if test:
        um = ["p in µm²"] if test.p_um else []
        heads = ["Degrees of freedom counted", "x and y", "Critical, 95 %", "p in px²", *um]
        section.add_text(typeset(sentence(test.text)))
        section.add(number_table("F-test of x against y", heads, f_rows(test)), Text(COUNTING, "small soft"))
    section.add(*drawn_lines(calibration))
    rows = [[str(r.image), str(r.line), r.axis, fixed(r.angle_deg, 2), str(r.n), length_px(r.rms_px), f"{r.dof:.1f}"] for r in result.lines]
    heads = ["Image", "Line", "Axis", "Angle / °", "Positions", "rms / px", "Degrees of freedom"]
    section.add_section(f"Table of the {len(rows)} lines", number_table("Lines", heads, rows, 3), fold=True)


def drawn_lines(calibration: LineCalibration) -> list[Figure]:
    """Lines over the sensor, image by image, with their residuals across them enlarged; all at one scale."""
    result, sensor = calibration.result, calibration.camera().sensor
    about_x = np.array([r.axis == "x" for r in result.lines])[result.line_of]
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


def worth(calibration: LineCalibration) -> str:
    """One sentence on the remaining residuals."""
    parts = [f"{length(a.rms_px, a.rms_um)} rms in {name}" for name, a in calibration.result.axes.items()]
    n, lines = int(calibration.result.used.sum()), len(calibration.result.lines)
    return f"{n} positions on {lines} lines lie on straight lines in the corrected image to {' and '.join(parts)}."


def parameter_rows(calibration: LineCalibration) -> list[list[str]]:
    """Title, sign, value, u and unit of each parameter that was estimated, then of those held at another value than 0."""
    result = calibration.result
    rows = []
    for name, value, u, unit in zip(result.free, result.estimates.values, result.estimates.u, result.estimates.units, strict=True):
        number = uncertain(float(value), float(u), unit)
        rows.append([TITLES[name], symbol(name), number.value, "" if number.u == NONE else f"± {number.u}", number.unit])
    model = result.camera
    for name, value, unit in zip(NAMES, model.values, model.units, strict=True):
        if name not in result.free and value:
            rows.append([TITLES[name], symbol(name), significant(float(value), 6), "held", unit if unit != "1" else ""])
    return rows


def axis_rows(calibration: LineCalibration) -> list[list[str]]:
    """Residuals by axis: positions, lines, rms in px, in fractions of a pixel, in µm, and degrees of freedom by how they are counted."""
    rows = []
    for name, axis in calibration.result.axes.items():
        um = [] if axis.rms_um is None else [length_px(axis.rms_um)]
        part = f"1/{1 / axis.rms_px:.0f}" if 0 < axis.rms_px < 0.7 else NONE
        dof = [f"{axis.dof_of[key]:.0f}" for key, _ in COUNTED]
        rows.append([name, str(axis.n), str(axis.lines), length_px(axis.rms_px), part, *um, *dof])
    return rows


def axis_heads(calibration: LineCalibration) -> list[str]:
    um = ["rms / µm"] if calibration.camera().sensor.pitch_x_um is not None else []
    return ["Axis", "Positions", "Lines", "rms / px", "in pixels", *um, *(f"dof {text}" for _, text in COUNTED)]


def f_rows(test: LinesFTest | None) -> list[list[str]]:
    """The F-test by how degrees of freedom are counted."""
    rows = []
    for key, text in COUNTED if test is not None else ():
        assert test is not None
        dof = " and ".join(f"{v:.0f}" for v in test.dof[key])
        um = [] if test.p_um is None else [p_text(test.p_um[key])]
        rows.append([text, dof, significant(test.critical_95[key]), p_text(test.p_px[key]), *um])
    return rows


def summary_text(calibration: LineCalibration) -> str:
    """Summary for the terminal."""
    lines = [worth(calibration), ""]
    lines += _columns(parameter_rows(calibration))
    lines += ["", *_columns([axis_heads(calibration), *axis_rows(calibration)])]
    test = calibration.result.f_test
    if test is not None and not any(test.text == f.text for f in calibration.findings):
        lines += ["", sentence(test.text)]
    for finding in calibration.findings:
        lines += ["", *finding_lines(finding)]
    return "\n".join(part for line in lines for part in folded(line)).replace(NO_BREAK, " ").replace(THIN, " ")


def _columns(rows: list[list[str]]) -> list[str]:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  " + "  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
