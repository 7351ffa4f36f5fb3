"""What a calibration from straight lines is worth, in words and rows of text, for its page and for the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pixmetry.calibrate.page.text import TITLES, folded, length, p_text, sentence, symbol
from pixmetry.report.numbers import NO_BREAK, NONE, THIN, length_px, significant, uncertain

if TYPE_CHECKING:
    from pixmetry.calibrate.lines.plumb_line import LineCalibration
    from pixmetry.calibrate.records import LinesFTest

COUNTED = (("positions", "by position"), ("effective", "effective"), ("lines", "by line"))


def worth(calibration: LineCalibration) -> str:
    """One sentence on what is left over."""
    parts = [f"{length(a.rms_px, a.rms_um)} rms in {name}" for name, a in calibration.result.axes.items()]
    n, lines = int(calibration.result.used.sum()), len(calibration.result.lines)
    return f"{n} positions on {lines} lines lie straight in the corrected image to {' and '.join(parts)}."


def parameter_rows(calibration: LineCalibration) -> list[list[str]]:
    """Title, sign, value, u and unit of each parameter that was estimated, then of those held at another value than 0."""
    result = calibration.result
    rows = []
    for name, value, u, unit in zip(result.free, result.estimates.values, result.estimates.u, result.estimates.units, strict=True):
        number = uncertain(float(value), float(u), unit)
        rows.append([TITLES[name], symbol(name), number.value, "" if number.u == NONE else f"± {number.u}", number.unit])
    from pixmetry.calibrate.bundle.model import NAMES

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
        lines += ["", f"{'Warning' if finding.level == 'warning' else 'Note'}: {sentence(finding.text)}"]
        lines += [f"  To do: {finding.advice}"] if finding.advice else []
    return "\n".join(part for line in lines for part in folded(line)).replace(NO_BREAK, " ").replace(THIN, " ")


def _columns(rows: list[list[str]]) -> list[str]:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  " + "  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
