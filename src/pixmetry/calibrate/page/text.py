"""Result of a calibration in words: the sentences of its page, its terminal summary and its tables."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from pixmetry.core.finding import finding_lines, sentence
from pixmetry.report.numbers import (
    MINUS,
    NO_BREAK,
    NONE,
    SUPERSCRIPT,
    THIN,
    PrintedNumber,
    decimals_of,
    fixed,
    length_px,
    pretty_unit,
    significant,
    uncertain,
)

if TYPE_CHECKING:
    from pixmetry.calibrate.records import (
        AxisComponent,
        Calibration,
        CameraComponents,
        CameraResiduals,
        Halves,
        ParameterTest,
        ProjectionMap,
        SharedByCamera,
    )

T = TypeVar("T")
COLUMNS = 100  # of the terminal
HELD = 1e-3  # u in the middle of the frame over that in the corners, below which the principal point is held
POOR = 1.25  # rms of all image points over that of a typical one, from which on both are said
GIVEN_DIGITS = 8  # of a value that was given and held
TITLES = {
    "c": "Principal distance",
    "xp": "Principal point, x",
    "yp": "Principal point, y",
    "b1": "Affinity",
    "b2": "Shear",
    "p1": "Decentring",
    "p2": "Decentring",
    **{f"k{n}": "Radial" for n in range(1, 6)},
    **{f"d{n}": "Radial, denominator" for n in range(1, 4)},
    **{f"s{n}": "Thin prism" for n in range(1, 5)},
}
DIRECTIONS = {
    "image_to_object": "corrects image coordinates (image to object, as in photogrammetry)",
    "object_to_image": "distorts ideal directions (object to image, as in computer vision)",
}


def symbol(name: str) -> str:
    """A parameter's sign as photogrammetry writes it."""
    return name.upper() if name[0] in "bpkds" else name


def p_text(p: float | None) -> str:
    """A probability: two digits, or a bound where it is below a millionth."""
    if p is None or not np.isfinite(p):
        return NONE
    return f"<{THIN}10⁻⁶" if p < 1e-6 else significant(p, 2)


def typeset(text: str) -> str:
    """A sentence made for a terminal, with true minus signs and powers of ten."""
    text = re.sub(r"(\d)e([+-]?\d+)\b", lambda m: f"{m[1]}{THIN}×{THIN}10{str(int(m[2])).translate(SUPERSCRIPT)}", text)
    return re.sub(r"(?<![\w.⁻])-(?=\d)", MINUS, text)


def of_camera(test: Mapping[str, T] | None, camera: str) -> T | None:
    """Record of a test for a camera; None if it was not made."""
    return None if test is None else test.get(camera)


def residual_record(calibration: Calibration, camera: int) -> CameraResiduals:
    """Number and rms of the residuals of a camera, from its test or, without one, from the adjustment."""
    from pixmetry.calibrate.records import CameraResiduals

    adjustment = calibration.adjustment
    model = adjustment.network.cameras[camera]
    found = of_camera(calibration.tests.residuals, model.name)
    if found is not None:
        return found
    net, v = adjustment.network, adjustment.residual_px
    mine = adjustment.used & (net.camera_of[net.image] == camera) & np.isfinite(v).all(axis=1)
    rms = np.sqrt(np.mean(v[mine] ** 2, axis=0)) if mine.any() else np.full(2, np.nan)
    pitch = (model.sensor.pitch_x_um, model.sensor.pitch_y_um)
    um = [None if one is None else float(value * one) for value, one in zip(rms, pitch, strict=True)]
    return CameraResiduals(int(mine.sum()), float(rms[0]), float(rms[1]), um[0], um[1], None, None)


def projection_levels(projection: ProjectionMap | None) -> tuple[float, float] | None:
    """Projection uncertainty in the middle of the frame and in the worst of its corners, px."""
    if projection is None:
        return None
    u = projection.u_px
    middle, corners = u[u.shape[0] // 2, u.shape[1] // 2], u[[0, 0, -1, -1], [0, -1, 0, -1]]
    if not (np.isfinite(middle) and np.isfinite(corners).any()) or not np.nanmax(u) > 0:  # 0: nothing of the camera was estimated
        return None
    return float(middle), float(np.nanmax(corners))


def middle_is_held(levels: tuple[float, float]) -> bool:
    """Whether nothing that was estimated moves the middle of the frame: its uncertainty is not nought, but not told."""
    return levels[0] < HELD * levels[1]


def length(px: float, um: float | None) -> str:
    """A length in px and, with a known pitch, in µm."""
    text = f"{length_px(px)}{NO_BREAK}px"
    return text if um is None or not np.isfinite(px) else f"{text} ({length_px(um)}{NO_BREAK}µm)"


def worth(calibration: Calibration, camera: int) -> str:
    """One sentence on the accuracy of the calibration of a camera."""
    found = residual_record(calibration, camera)
    name = calibration.adjustment.network.cameras[camera].name
    if found.n == 0:
        return "No image coordinate of this camera was used."
    if any(finding.level == "error" for finding in calibration.findings):
        in_x, in_y = (length(one.rms_px, one.rms_um) for one in found.axes.values())
        return f"Not calibrated: residuals are {in_x} rms in x and {in_y} in y."
    in_x, in_y = (length(one.rms_px, one.rms_um) for one in found.typical.values())
    text = f"The image coordinates agree with the calibrated camera to {in_x} rms in x and {in_y} in y"
    poor = max(one.rms_px / max(found.typical[axis].rms_px, 1e-300) for axis, one in found.axes.items())
    if poor > POOR:
        text += f" (of a typical image point; some are known to be poor, and all together leave {poor:.2g} times as much)"
    levels = projection_levels(of_camera(calibration.tests.projection, name))
    if levels is None:
        return text + "."
    places = f"{length_px(levels[0])}{NO_BREAK}px in the middle of the frame and {length_px(levels[1])}{NO_BREAK}px in its corners"
    if middle_is_held(levels):
        places = (
            f"{length_px(levels[1])}{NO_BREAK}px in the corners of the frame, without what is wrong with the principal point, which is held"
        )
    return f"{text}; the image of a given direction has a standard uncertainty of {places}."


def halves_text(halves: Sequence[Halves]) -> str:
    """Halves of a camera's images, calibrated apart, in one sentence."""
    parts = [f"{one.largest[1]:.1f} u ({symbol(one.largest[0])}; {one.by}; p {_equal(one.p)})" for one in halves]
    return f"Two halves of the images, calibrated apart, differ at most by {' and by '.join(parts)}."


def _equal(p: float) -> str:
    text = p_text(p)
    return text if text.startswith("<") else f"= {text}"


def shared_text(shared: SharedByCamera) -> str:
    """Whether errors of image points are independent, and what that does to u."""
    if not shared.found:
        return "The residuals show no errors that image points have in common: u is that of independent errors."
    from pixmetry.calibrate.checks.parts import shared_words

    have, parts = shared_words(shared)
    sizes = ", ".join(parts).replace(" px", f"{NO_BREAK}px")
    text = f"Image points {have} errors in common: {sizes}; {shared.independent_px:.3f}{NO_BREAK}px are independent."
    if not shared.names:
        return f"{text} The uncertainties of poses and points hold them."
    low, high = (f"{one:.1f}" for one in (shared.widened.min(), shared.widened.max()))
    return f"{text} u holds them: it is {low} to {high} times that of independent errors."


def sigma0_text(calibration: Calibration) -> str:
    """Scatter of the image coordinates, compared with their stated uncertainties."""
    adjustment = calibration.adjustment
    models = adjustment.network.cameras
    parts = [(model.name, of_camera(calibration.tests.variance_components, model.name)) for model in models]
    found = [(f"{name}: " if len(models) > 1 else "", record) for name, record in parts if record and np.isfinite(record.x.sigma_px)]
    if found:
        return " ".join(sentence(f"{name}{_scatter(record, known=adjustment.network.covariance_known)}") for name, record in found)
    value = significant(adjustment.sigma0, 3)
    if adjustment.network.covariance_known:
        return f"σ₀ = {value} with {adjustment.dof} degrees of freedom: 1 would mean that the image coordinates scatter as stated."
    return (
        f"σ₀ = {value} with {adjustment.dof} degrees of freedom; no covariance of the image coordinates was given, so the scale of "
        "their weights comes from the residuals."
    )


def _scatter(record: CameraComponents, *, known: bool) -> str:
    text = f"image coordinates scatter by {_with_u(record.x)} in x and {_with_u(record.y)} in y"
    if record.common and record.by_axis:
        text += " (one estimate for both: the images do not show that x and y differ)"
    if not known:
        return f"{text}, by their residuals: no covariance of the image coordinates was given"
    x, y = (f"{length_px(one.given_px)}{NO_BREAK}px in {axis}" for axis, one in record.axes.items())
    return f"{text}; stated uncertainties: {x} and {y}"


def _with_u(axis: AxisComponent) -> str:
    number = uncertain(axis.sigma_px, axis.u_sigma_px, "px")
    return f"{number.value}{NO_BREAK}px" if number.u == NONE else f"({number.value} ± {number.u}){NO_BREAK}px"


def parameter_records(calibration: Calibration, camera: int) -> list[ParameterTest]:
    """Estimated parameters and those held fixed at a value other than 0, in the order of the model."""
    from pixmetry.calibrate.bundle.model import NAMES
    from pixmetry.calibrate.records import ParameterTest

    adjustment = calibration.adjustment
    model = adjustment.camera(camera)
    tested = {r.name: r for r in calibration.tests.parameters or () if r.camera == model.name}
    u: dict[str, float] = {}
    if adjustment.covariance is not None:  # an adjustment may be asked to leave it out
        free, covariance = adjustment.interior_covariance(camera)
        u = dict(zip(free, np.sqrt(np.diag(covariance)), strict=True))
    rows = []
    for name, unit, value, free in zip(NAMES, model.units, model.values, model.free, strict=True):
        if name in tested:
            rows.append(tested[name])
        elif free or value != 0:
            rows.append(ParameterTest(model.name, name, float(value), u.get(name, np.nan), unit, fixed=not free))
    return rows


def counts(calibration: Calibration) -> tuple[str, str, str]:
    """How many images, points and image points took part; where not all did, of how many."""
    from pixmetry.calibrate.checks.tests import sizes

    pairs = sizes(calibration.adjustment).pairs
    images, points, observations = (str(part) if part == whole else f"{part} of {whole}" for part, whole in pairs)
    return images, points, observations


def shown(record: ParameterTest) -> PrintedNumber:
    """A parameter as text: with its uncertainty, or where it is held, with the digits that it was given."""
    return as_given(record.value, record.unit) if record.fixed else uncertain(record.value, record.u, record.unit)


def as_given(value: float, unit: str) -> PrintedNumber:
    """A value that was given, to at most eight significant digits; a power of ten is in the unit."""
    mantissa, _, exponent = f"{value:.{GIVEN_DIGITS}g}".partition("e")
    power = f"10{str(int(exponent)).translate(SUPERSCRIPT)}{NO_BREAK}" if exponent else ""
    return PrintedNumber(mantissa.replace("-", MINUS), NONE, (power + pretty_unit(unit)).rstrip(NO_BREAK))


def placed(value: float, u: float) -> str:
    """A coordinate to the place of the second digit of its uncertainty, all digits before it: no power of ten, however far the origin."""
    if not np.isfinite(value):
        return NONE
    if np.isfinite(u) and u > 0:
        return fixed(value, decimals_of(u))
    number = as_given(value, "1")
    return f"{number.value} {number.unit}".rstrip()


def summary_text(calibration: Calibration) -> str:
    """Summary for the terminal: what each camera is worth, what to know, its parameters."""
    adjustment = calibration.adjustment
    net = adjustment.network
    images, points, observations = counts(calibration)
    lines = [f"{images} images, {points} points, {observations} image points used. {sigma0_text(calibration)}"]
    for k, model in enumerate(net.cameras):
        lines += ["", f"{model.name}: {worth(calibration, k)}"]
        found = of_camera(calibration.tests.f_test, model.name)
        if found and found.text:
            lines.append(sentence(found.text))
        lines.append("")
        lines += _parameter_lines(calibration, k)
        if halves := of_camera(calibration.tests.halves, model.name):
            lines += ["", halves_text(halves)]
    for one in calibration.tests.rig.cameras if calibration.tests.rig is not None else ():
        apart = uncertain(one.baseline, one.u_baseline, net.unit)
        angle = uncertain(one.angle_deg, one.u_angle_deg, "°")
        text = f"{one.camera} stands {apart.value} ± {apart.u} {apart.unit} from {one.reference}, turned by {angle.value}° ± {angle.u}°."
        lines += ["", text]
    if calibration.tests.check_points is not None:
        lines += ["", sentence(calibration.tests.check_points.text)]
    for finding in calibration.findings:
        lines += ["", *finding_lines(finding)]
    return "\n".join(part for line in lines for part in folded(line)).replace(NO_BREAK, " ").replace(THIN, " ")


def folded(line: str) -> list[str]:
    """A line as lines of the terminal, indented like its beginning."""
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    return textwrap.wrap(line, COLUMNS, subsequent_indent=indent, break_long_words=False) or [""]


def _parameter_lines(calibration: Calibration, camera: int) -> list[str]:
    rows = []
    for r in parameter_records(calibration, camera):
        number, p = shown(r), r.p_zero
        said = "fixed" if r.fixed else ("" if number.u == NONE else f"± {number.u}")
        rows.append((symbol(r.name), number.value, said, number.unit, "not significant" if p is not None and p > 0.05 else ""))
    widths = [max((len(row[i]) for row in rows), default=0) for i in range(4)]
    return [f"  {a:<{widths[0]}}  {b:>{widths[1]}} {c:<{widths[2]}}  {d:<{widths[3]}}  {e}".rstrip() for a, b, c, d, e in rows]
