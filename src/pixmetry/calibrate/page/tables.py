"""Tables of a calibration's page, as rows of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.calibrate.page.space import largest_axis
from pixmetry.calibrate.page.text import (
    TITLES,
    as_given,
    counts,
    length,
    p_text,
    parameter_records,
    placed,
    record_of,
    residual_record,
    sentence,
    shown,
    symbol,
)
from pixmetry.report.numbers import NO_BREAK, NONE, fixed, length_px, signed, significant, uncertain

if TYPE_CHECKING:
    from pixmetry.calibrate.bundle.network import Calibration

MOST_POINTS = 20  # in the table of those that are known worst
NOT_SIGNIFICANT = 0.05
VISION = (("fx", "fx"), ("fy", "fy"), ("skew", "skew"), ("cx", "cx"), ("cy", "cy"))


def value(number: Any, digits: int = 3) -> str:
    """A number to so many digits; a dash where there is none."""
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
        strongest, p = r.get("strongest"), r.get("p_zero")
        off = r["value"] - centre.get(r["name"], np.nan)
        rows.append(
            {
                "title": TITLES[r["name"]],
                "symbol": symbol(r["name"]),
                "value": number.value,
                "u": "held fixed" if r["fixed"] else "" if number.u == NONE else f"± {number.u}",
                "unit": number.unit,
                "p": "" if p is None else p_text(p) + (", not significant" if p > NOT_SIGNIFICANT else ""),
                "with": f"{symbol(strongest['with'])} {fixed(strongest['r'], 2)}" if strongest else "",
                "off": f"{signed(off, length_px)}{NO_BREAK}px from the middle" if np.isfinite(off) else "",
            }
        )
    return rows


def vision(calibration: Calibration, name: str) -> list[tuple[str, str, str]]:
    """The same camera in the words of computer vision: name, value, u; in px."""
    found = record_of(calibration, "vision", name) or {}
    rows = []
    for key, title in VISION:
        if found.get(key) is not None:
            u = found.get(f"u_{key}")
            held = u is not None and float(u) == 0
            number = as_given(float(found[key]), "px") if held else uncertain(float(found[key]), np.nan if u is None else float(u), "px")
            rows.append((title, number.value, "" if number.u == NONE else f"± {number.u}"))
    return rows


def axes(calibration: Calibration, camera: int) -> list[dict[str, str]]:
    """Residuals of x and of y, their degrees of freedom, and the standard deviation by variance components."""
    name = calibration.adjustment.network.cameras[camera].name
    found, parts = residual_record(calibration, camera), record_of(calibration, "variance_components", name) or {}
    rows = []
    for axis in "xy":
        sigma, u = parts.get(f"sigma_{axis}_px"), parts.get(f"u_sigma_{axis}_px")
        number = None if sigma is None else uncertain(sigma, float("nan") if u is None else u, "px")
        rows.append(
            {
                "axis": axis,
                "n": str(found["n"]),
                "rms": length(found[f"rms_{axis}_px"], found.get(f"rms_{axis}_um")),
                "dof": NONE if found.get(f"dof_{axis}") is None else f"{found[f'dof_{axis}']:.0f}",
                "sigma": "" if number is None else number.value + ("" if number.u == NONE else f" ± {number.u}") + f"{NO_BREAK}px",
            }
        )
    return rows


def f_test(calibration: Calibration, name: str) -> list[dict[str, str]]:
    """Variance of x over that of y, in px² and in µm²."""
    found = record_of(calibration, "f_test", name)
    if found is None:
        return []
    rows = []
    for unit, key in (("px²", "px"), ("µm²", "um")):
        if found.get(f"ratio_{key}2") is not None:
            dof = f"{found['dof_x']:.0f} and {found['dof_y']:.0f}"
            row = {"unit": unit, "ratio": value(found[f"ratio_{key}2"]), "dof": dof, "critical": value(found.get("critical_95"))}
            rows.append(row | {"p": p_text(found.get(f"p_{key}"))})
    return rows


def images(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One row an image; columns of the x-scale, the x-shift and the time only where they were there."""
    has = {key: any(r.get(key) is not None for r in records) for key in ("x_scale", "x_shift_px", "time_s")}
    rows = []
    for r in records:
        numbers = [str(r["n"]), str(r["rejected"])] if r.get("oriented", True) else ["not oriented", NONE]
        cells = [*numbers, px(r["rms_x_px"]), px(r["rms_y_px"])]
        if has["time_s"]:
            cells.append(value(r.get("time_s"), 6))
        for key, u_key, factor in (("x_scale", "u_x_scale", 1e6), ("x_shift_px", "u_x_shift_px", 1.0)):
            if has[key]:
                cells.append(_with_u(r.get(key), r.get(u_key), factor))
        rows.append((str(r["image"]), str(r["camera"]), cells))
    heads = ["Points", "Rejected", "rms x / px", "rms y / px"]
    heads += [h for key, h in (("time_s", "Time / s"), ("x_scale", "x-scale / 10⁻⁶"), ("x_shift_px", "x-shift / px")) if has[key]]
    return {"heads": heads, "rows": rows}


def _with_u(number: float | None, u: float | None, factor: float) -> str:
    if number is None:
        return NONE
    shown = uncertain(factor * number, float("nan") if u is None else factor * u, "1")
    return shown.value + ("" if shown.u == NONE else f" ± {shown.u}") + (f"{NO_BREAK}{shown.unit}" if shown.unit else "")


def gross_errors(records: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Rejected image coordinates, the worst first."""
    rows = []
    for r in sorted(records, key=lambda r: -(r.get("statistic") or 0.0)):
        lengths = [px(r.get(key)) for key in ("residual_x_px", "residual_y_px", "error_x_px", "error_y_px")]
        rows.append([str(r["image"]), str(r["point"]), *lengths, value(r.get("statistic")), value(r.get("critical"))])
    return rows


def patterns(records: Sequence[Mapping[str, Any]], several: bool) -> list[dict[str, Any]]:
    """Patterns that were looked for in the residuals, the surest first; with the camera where there are several."""
    from pixmetry.calibrate.checks.patterns import MEANING, SOURCES

    rows = []
    for r in sorted(records, key=lambda r: 1.0 if r.get("p") is None else r["p"]):
        what, source, _ = MEANING.get(r["name"], (r["name"], "", ""))
        title = f"{r['camera']}: {what}" if several and r.get("camera") else sentence(what).rstrip(".")
        found, u = bool(r.get("significant")), r.get("u_px")
        amplitude = px(r.get("amplitude_px")) + (f" ± {px(u)}" if u is not None else "")
        why = f"As from {SOURCES[source]} ({source})." if found and source else ""
        advice = " ".join(part for part in (why, sentence(r.get("advice") or "")) if part)
        rows.append({"title": title, "amplitude": amplitude, "p": p_text(r.get("p")), "found": found, "advice": advice})
    return sorted(rows, key=lambda r: not r["found"])


def groups(records: Sequence[Mapping[str, Any]], name: str) -> list[list[str]]:
    """Joint tests of groups of parameters against 0."""
    mine = [r for r in records if r["camera"] == name]
    rows = []
    for r in mine:
        degrees = f"{r['dof'][0]:.0f} and {r['dof'][1]:.0f}"
        rows.append([str(r["group"]), ", ".join(symbol(n) for n in r["names"]), value(r["f"]), degrees, p_text(r["p"])])
    return rows


def hold_out(found: Mapping[str, Any] | None) -> list[list[str]]:
    """Images of the fit against images left out of it."""
    rows = []
    for key, title in (("fixed", "points as given"), ("free", "points free")):
        part = (found or {}).get(key)
        if part:
            rows.append([title, px(part["fit_rms_px"]), px(part["left_out_rms_px"]), px(part.get("left_out_median_px"))])
    return rows


def moved(field: Mapping[str, Any]) -> list[list[str]]:
    """By how much interior parameters moved when the field was set free, beside their formal u; by camera where there are several."""
    cameras = field.get("cameras") or {}
    records = list(cameras.items()) if len(cameras) > 1 else [("", field)]
    rows = []
    for name, record in records:
        for key in ("xp", "yp", "c"):
            shift, u = record.get(f"moved_{key}_px"), record.get(f"u_{key}_px")
            if shift is not None:
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

    raised = ((calibration.tests.get("known") or {}).get("scale_bars") or {}).get("raised") or {}
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
    """What the network is made of."""
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
