"""Tables of a calibration's page, as rows of text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.calibrate.checks.known_residuals import control_of
from pixmetry.calibrate.page.space import largest_axis
from pixmetry.calibrate.page.text import (
    TITLES,
    as_given,
    counts,
    length,
    of_camera,
    p_text,
    parameter_records,
    placed,
    residual_record,
    shown,
    symbol,
    typeset,
)
from pixmetry.core.finding import sentence
from pixmetry.report.numbers import NO_BREAK, NONE, fixed, length_px, signed, significant, uncertain

if TYPE_CHECKING:
    from pixmetry.calibrate.records import (
        Calibration,
        CheckedPoint,
        Contradicted,
        FieldComparison,
        GrossError,
        GroupTest,
        Halves,
        HoldOut,
        ImageRecord,
        Jackknife,
        Pattern,
        RigRecord,
        SharedByCamera,
    )

MOST_POINTS = 20  # in the table of those that are known worst
NOT_SIGNIFICANT = 0.05


def value(number: Any, digits: int = 3) -> str:
    """A number rounded to some digits; a dash if there is none."""
    return NONE if number is None else significant(float(number), digits)


def px(number: Any) -> str:
    return NONE if number is None else length_px(float(number))


def parameters(calibration: Calibration, camera: int) -> list[dict[str, str]]:
    """Interior parameters with u, significance against 0 and the strongest correlation."""
    adjustment = calibration.adjustment
    centre = dict(zip(("xp", "yp"), adjustment.network.cameras[camera].sensor.centre, strict=True))
    rows = []
    for r in parameter_records(calibration, camera):
        number = shown(r)
        strongest, p = r.strongest, r.p_zero
        off = r.value - centre.get(r.name, np.nan)
        rows.append(
            {
                "title": TITLES[r.name],
                "symbol": symbol(r.name),
                "value": number.value,
                "u": "held fixed" if r.fixed else "" if number.u == NONE else f"± {number.u}",
                "unit": number.unit,
                "p": "" if p is None else p_text(p) + (", not significant" if p > NOT_SIGNIFICANT else ""),
                "with": f"{symbol(strongest.with_)} {fixed(strongest.r, 2)}" if strongest else "",
                "off": f"{signed(off, length_px)}{NO_BREAK}px from the middle" if np.isfinite(off) else "",
            }
        )
    return rows


def vision(calibration: Calibration, name: str) -> list[tuple[str, str, str]]:
    """The same camera in the words of computer vision: name, value, u; in px."""
    found = of_camera(calibration.tests.vision, name)
    rows = []
    for title, value, u in () if found is None else found.rows:
        number = as_given(value, "px") if u == 0 else uncertain(value, u, "px")
        rows.append((title, number.value, "" if number.u == NONE else f"± {number.u}"))
    return rows


def axes(calibration: Calibration, camera: int) -> list[dict[str, str]]:
    """Residuals of x and of y, their degrees of freedom, and the standard deviation by variance components."""
    name = calibration.adjustment.network.cameras[camera].name
    found, parts = residual_record(calibration, camera), of_camera(calibration.tests.variance_components, name)
    rows = []
    for (axis, one), part in zip(found.axes.items(), (None, None) if parts is None else (parts.x, parts.y), strict=True):
        number = None if part is None else uncertain(part.sigma_px, part.u_sigma_px, "px")
        rows.append(
            {
                "axis": axis,
                "n": str(found.n),
                "rms": length(one.rms_px, one.rms_um),
                "dof": NONE if one.dof is None else f"{one.dof:.0f}",
                "sigma": "" if number is None else number.value + ("" if number.u == NONE else f" ± {number.u}") + f"{NO_BREAK}px",
            }
        )
    return rows


def f_test(calibration: Calibration, name: str) -> list[dict[str, str]]:
    """Variance of x over that of y, in px² and in µm²."""
    found = of_camera(calibration.tests.f_test, name)
    if found is None:
        return []
    rows, dof = [], f"{found.dof_x:.0f} and {found.dof_y:.0f}"
    for unit, ratio, p in (("px²", found.ratio_px2, found.p_px), ("µm²", found.ratio_um2, found.p_um)):
        if ratio is not None:
            rows.append({"unit": unit, "ratio": value(ratio), "dof": dof, "critical": value(found.critical_95), "p": p_text(p)})
    return rows


def images(records: Sequence[ImageRecord]) -> dict[str, Any]:
    """One row an image; columns of the x-scale, the x-shift and the time only where they were there."""
    timed = any(r.time_s is not None for r in records)
    scaled, shifted = any(r.x_scale is not None for r in records), any(r.x_shift_px is not None for r in records)
    rows = []
    for r in records:
        numbers = [str(r.n), str(r.rejected)] if r.oriented else ["not oriented", NONE]
        cells = [*numbers, px(r.rms_x_px), px(r.rms_y_px)]
        cells += [value(r.time_s, 6)] if timed else []
        cells += [_with_u(r.x_scale, r.u_x_scale, 1e6)] if scaled else []
        cells += [_with_u(r.x_shift_px, r.u_x_shift_px, 1.0)] if shifted else []
        rows.append((r.image, r.camera, cells))
    heads = ["Points", "Rejected", "rms x / px", "rms y / px"]
    heads += [head for there, head in ((timed, "Time / s"), (scaled, "x-scale / 10⁻⁶"), (shifted, "x-shift / px")) if there]
    return {"heads": heads, "rows": rows}


def _with_u(number: float | None, u: float | None, factor: float) -> str:
    if number is None:
        return NONE
    shown = uncertain(factor * number, float("nan") if u is None else factor * u, "1")
    return shown.value + ("" if shown.u == NONE else f" ± {shown.u}") + (f"{NO_BREAK}{shown.unit}" if shown.unit else "")


def gross_errors(records: Sequence[GrossError]) -> list[list[str]]:
    """Rejected image coordinates, the worst first."""
    rows = []
    for r in sorted(records, key=lambda r: -r.statistic):
        lengths = [px(length) for length in (r.residual_x_px, r.residual_y_px, r.error_x_px, r.error_y_px)]
        rows.append([r.image, r.point, *lengths, value(r.statistic), value(r.critical)])
    return rows


def patterns(records: Sequence[Pattern], several: bool) -> list[dict[str, Any]]:
    """Patterns that were looked for in the residuals, the surest first; with the camera where there are several."""
    from pixmetry.calibrate.checks.patterns import MEANING, cause_words

    rows = []
    for r in sorted(records, key=lambda r: r.p):
        what, _, _ = MEANING.get(r.name, (r.name, "", ""))
        title = f"{r.camera}: {what}" if several else sentence(what).rstrip(".")
        amplitude = px(r.amplitude_px) + (f" ± {px(r.u_px)}" if r.u_px is not None else "")
        words = "" if not r.significant else cause_words(r)
        if r.significant and r.behind in MEANING:
            words = f"{'in part ' if r.left else ''}explained where {MEANING[r.behind][0]}"
        why = f"{sentence(words)}" if words else ""
        advice = " ".join(part for part in (why, sentence(r.advice)) if part)
        rows.append({"title": title, "amplitude": amplitude, "p": p_text(r.p), "found": r.significant, "advice": advice})
    return sorted(rows, key=lambda r: not r["found"])


def groups(records: Sequence[GroupTest], name: str) -> list[list[str]]:
    """Joint tests of groups of parameters against 0."""
    rows = []
    for r in (r for r in records if r.camera == name):
        degrees = f"{r.dof[0]:.0f} and {r.dof[1]:.0f}"
        rows.append([r.group, ", ".join(symbol(n) for n in r.names), value(r.f), degrees, p_text(r.p)])
    return rows


def uncertainties(shared: SharedByCamera, halves: Sequence[Halves], left: Jackknife | None) -> tuple[list[str], list[list[str]]]:
    """Heads and rows: u of each parameter with and without errors that image points share, its 95 %, and what halves of the images and
    parts left out say of it."""
    from scipy import stats

    heads = ["Parameter", "u / u independent", "Degrees of freedom", "95 %"]
    heads += [f"{one.by}: difference / u" for one in halves] + (["left out: u / u"] if left else [])
    rows = []
    for i, name in enumerate(shared.names):
        row = [symbol(name), fixed(shared.widened[i], 2), f"{shared.dof[i]:.0f}", f"± {stats.t.ppf(0.975, max(1.0, shared.dof[i])):.2f} u"]
        row += [signed(one.ratio[one.names.index(name)], lambda r: fixed(r, 1)) if name in one.names else NONE for one in halves]
        if left:
            k = left.names.index(name)
            row.append(fixed(left.u[k] / left.stated[k], 1) if left.stated[k] > 0 else NONE)
        rows.append(row)
    return heads, rows


def hold_out(found: HoldOut | None) -> list[list[str]]:
    """Images of the fit against images left out of it."""
    titles = {"fixed": "points as given", "free": "points free"}
    parts = {} if found is None else found.parts
    return [[titles[key], px(p.fit_rms_px), px(p.left_out_rms_px), px(p.left_out_median_px)] for key, p in parts.items()]


def moved(compared: FieldComparison) -> list[list[str]]:
    """Change of the interior parameters with a free test field, with their formal u; by camera if there are several."""
    cameras = compared.cameras if len(compared.cameras) > 1 else {"": compared.first}
    rows = []
    for name, record in cameras.items():
        for key, (shift, u) in record.by_name.items():
            ratio = NONE if not u else fixed(abs(shift) / u, 1)
            rows.append([f"{name}: {symbol(key)}" if name else symbol(key), signed(shift, length_px), px(u), ratio])
    return rows


def worst_points(calibration: Calibration) -> dict[str, Any]:
    """Points by the largest semi-axis of their standard ellipsoid."""
    adjustment = calibration.adjustment
    net, covariance = adjustment.network, adjustment.point_covariance
    if covariance is None:
        return {"rows": [], "median": "", "largest": ""}
    size = largest_axis(covariance)
    rays = np.bincount(net.point[adjustment.used], minlength=len(net.points))
    known = np.flatnonzero(size > 0)
    rows = []
    for k in known[np.argsort(-size[known], kind="stable")][:MOST_POINTS]:
        u = np.sqrt(np.maximum(np.diag(covariance[k]), 0.0))
        texts = [f"{placed(v, s)} ± {placed(s, s)}" if s > 0 else placed(v, s) for v, s in zip(adjustment.state.xyz[k], u, strict=True)]
        rows.append([net.points[k], *texts, value(size[k], 2), str(rays[k])])
    if not rows:
        return {"rows": [], "median": "", "largest": ""}
    return {"rows": rows, "median": value(np.median(size[known]), 2), "largest": value(size[known].max(), 2)}


def scale_bars(calibration: Calibration) -> list[list[str]]:
    """Scale bars with their residuals: measured less adjusted length; u is that which was stated."""
    from pixmetry.calibrate.checks.known_residuals import bar_names

    raised = calibration.tests.known.scale_bars.raised if calibration.tests.known is not None else {}
    net, xyz = calibration.adjustment.network, calibration.adjustment.state.xyz
    bars = net.bars
    adjusted = np.linalg.norm(xyz[bars.end] - xyz[bars.start], axis=1)
    rows, names = [], bar_names(net)
    for k in range(len(bars)):
        residual = float(bars.length[k] - adjusted[k])
        u = float(raised.get(names[k], bars.u[k]))
        number = uncertain(float(bars.length[k]), u, net.unit)
        ratio = fixed(residual / u, 1) if u > 0 and np.isfinite(residual) else NONE
        ends = f"{net.points[bars.start[k]]} – {net.points[bars.end[k]]}" + (" (contradicted, weighs less)" if names[k] in raised else "")
        rows.append([ends, number.value, f"± {number.u}", signed(residual, lambda v: significant(v, 2)), ratio])
    return rows


def network_facts(calibration: Calibration) -> list[tuple[str, str]]:
    """Numbers of the network: images, points, observations."""
    adjustment = calibration.adjustment
    net = adjustment.network
    images_count, points_count, used = counts(calibration)
    rays = np.bincount(net.point[adjustment.used], minlength=len(net.points))
    seen = rays[rays > 0]
    facts = [("Cameras", str(len(net.cameras)))] if len(net.cameras) > 1 else []
    return facts + [
        ("Images", images_count),
        ("Points", points_count),
        ("Image points used", used),
        ("Rays per point", value(seen.mean()) if len(seen) else NONE),
        ("Degrees of freedom", str(adjustment.dof)),
        ("Iterations", str(adjustment.iterations)),
    ]


def check_points(calibration: Calibration) -> dict[str, Any] | None:
    """A sentence, and rows of coordinate, given value, u, found value, u, given less found, that over the u of both, images; None where
    nothing was compared."""
    record = calibration.tests.check_points
    if record is None:
        return None
    rows = [_checked_row(point, axis) for point in record.points for axis in range(3) if np.isfinite(point.given[axis])]
    critical = "" if record.worst is None else fixed(record.worst.critical, 1)
    fitted = f"the {record.datum_parameters} parameters" if record.datum_parameters > 1 else "the parameter"
    return {
        "text": typeset(sentence(record.text)),
        "rows": rows,
        "critical": critical,
        "level": f"{100 * record.level:g}",
        "fitted": fitted if record.datum_parameters else "",
    }


def _checked_row(point: CheckedPoint, axis: int) -> list[str]:
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


def relative_poses(rig: RigRecord) -> list[list[str]]:
    """Cameras of a rig against their references: baseline, position, angle and rotation vector, each ± u."""
    rows = []
    for one in rig.cameras:
        numbers = [(one.baseline, one.u_baseline), *zip(one.position, one.u_position, strict=True), (one.angle_deg, one.u_angle_deg)]
        numbers += list(zip(one.rotation_deg, one.u_rotation_deg, strict=True))
        rows.append([one.camera, one.reference, *(_with_u(float(v), float(u), 1.0) for v, u in numbers)])
    return rows


def epipolar(rig: RigRecord) -> list[list[str]]:
    """Pairs of cameras with the rms distance of their image points from epipolar lines."""
    return [
        [f"{one.first} and {one.second}", str(one.n), value(one.rms_px), value(one.u_rms_px, 2), value(one.expected_px)]
        for one in rig.epipolar
    ]


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
