"""The report of a calibration: one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry import __version__
from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.page import tables
from pixmetry.calibrate.page.check_points import check_points
from pixmetry.calibrate.page.control import control_points
from pixmetry.calibrate.page.text import (
    DIRECTIONS,
    of_camera,
    projection_levels,
    residual_record,
    sentence,
    sigma0_text,
    symbol,
    typeset,
    worth,
)
from pixmetry.report.numbers import NONE, fixed, length_px, significant
from pixmetry.report.page import Figure
from pixmetry.report.templates import filled, share_styles

if TYPE_CHECKING:
    from pixmetry.calibrate.bundle.model import CameraModel
    from pixmetry.calibrate.page.figures import Residuals
    from pixmetry.calibrate.records import Calibration, DistortionCurves, EccentricityRecord, FieldTest, HoldOut

WORST_IMAGES = 6  # on each of the two sheets that are not folded
VERDICTS = {"fixed": "held as given", "free": "estimated anew, as its given coordinates are not exact enough"}
MOST_SHEETS = 30  # of small images on a page; more would make it heavy


def write_page(calibration: Calibration, path: str | Path) -> Path:
    """Write the page and return its path; only an earlier page of this kind is replaced.

    Raises
    ------
    InputError
        If there is something else of that name, or it cannot be written.
    """
    from pixmetry.files import write_page as write

    return write(path, render(calibration))


def render(calibration: Calibration) -> str:
    """Return the page of a calibration as text."""
    return share_styles(filled("calibration.html.jinja", _content(calibration)))


def _content(calibration: Calibration) -> dict[str, Any]:
    from pixmetry.calibrate.page.space import field_map, network_views, plan_views

    adjustment, tests = calibration.adjustment, calibration.tests
    net, field, held = adjustment.network, tests.field, tests.hold_out
    cameras = [_camera(calibration, k) for k in range(len(net.cameras))]
    return {
        "version": __version__,
        "name": str(calibration.provenance.get("name") or ", ".join(c.name for c in net.cameras)),
        "facts": tables.network_facts(calibration),
        "sigma0": sigma0_text(calibration),
        "findings": [replace(f, text=typeset(sentence(f.text)), advice=typeset(sentence(f.advice))) for f in calibration.findings],
        "tested": tests.made,
        "cameras": cameras,
        "poses": [(_full(r.a), _full(r.b), fixed(r.r, 2)) for r in tests.correlations_with_poses or ()],
        "patterns": tables.patterns(tests.patterns or (), len(cameras) > 1),
        "gross": tables.gross_errors(tests.gross_errors or ()),
        "gross_tested": tests.gross_errors is not None,
        "images": tables.images(tests.images) if tests.images else None,
        "hold_out": tables.hold_out(held),
        "hold_out_text": _hold_out(held),
        "eccentricity": _eccentricity(tests.eccentricity),
        "folds": held and held.folds,
        "field": _field(field) if field else None,
        "field_map": field_map(adjustment, field.compared.deviations.points) if field and field.compared else None,
        "views": network_views(adjustment),
        "plans": plan_views(adjustment),
        "points": tables.worst_points(calibration),
        "undetermined": int(np.sum(~np.isfinite(adjustment.state.xyz).all(axis=1))),
        "all_fixed": bool(len(net.u_xyz) and np.all(net.u_xyz == 0)),
        "bars": tables.scale_bars(calibration),
        "control": control_points(calibration),
        "checked": check_points(calibration),
        "unit": net.unit,
        "datum": adjustment.datum,
        "notes": [n for n in adjustment.notes if not any(n.rstrip(".") in f.text for f in calibration.findings)],
        **provenance_rows(calibration.provenance),
    }


def _camera(calibration: Calibration, k: int) -> dict[str, Any]:
    """Everything that the page shows of one camera."""
    model = calibration.adjustment.camera(k)
    found = residual_record(calibration, k)
    levels = projection_levels(of_camera(calibration.tests.projection, model.name))
    if levels is not None and not any(levels):
        levels = None  # nothing was estimated of this camera
    test = of_camera(calibration.tests.f_test, model.name)
    parameters = tables.parameters(calibration, k)
    return {
        "name": model.name,
        "worth": worth(calibration, k),
        "verdict": [(axis, length_px(one.rms_px), _um(one.rms_um)) for axis, one in found.axes.items()] if found.n else [],
        "levels": levels and [length_px(v) for v in levels],
        "facts": camera_facts(model),
        "direction": DIRECTIONS[model.direction],
        "parameters": parameters,
        "known": any(r["u"].startswith("±") for r in parameters),
        "groups": tables.groups(calibration.tests.parameter_groups or (), model.name),
        "vision": tables.vision(calibration, model.name),
        "axes": tables.axes(calibration, k),
        "f_test": tables.f_test(calibration, model.name),
        "f_text": typeset(sentence(test.text if test is not None else "")),
        **_pictures(calibration, k),
    }


def _um(value: float | None) -> str:
    return "" if value is None else length_px(value)


def _full(name: str) -> str:
    """A camera's or image's parameter, ``camera:c``, for people."""
    owner, _, parameter = name.rpartition(":")
    return f"{owner}: {symbol(parameter)}" if owner else symbol(parameter)


def camera_facts(model: Any) -> str:
    """Size and pitch of a camera's pixels in a sentence."""
    sensor = model.sensor
    if sensor.pitch_x_um is None:
        return f"{sensor.cols} × {sensor.rows} pixels, pixel pitch not given: lengths in the image are in px."
    size = f"{significant(sensor.cols * sensor.pitch_x_um / 1000)} × {significant(sensor.rows * sensor.pitch_y_um / 1000)} mm"
    pitch = f"{significant(sensor.pitch_x_um, 4)} × {significant(sensor.pitch_y_um, 4)} µm"
    return f"{sensor.cols} × {sensor.rows} pixels of {pitch}, {size}."


def _pictures(calibration: Calibration, k: int) -> dict[str, Any]:
    """Figures of one camera, by the part of the page where they stand."""
    from pixmetry.calibrate.page import figures as over
    from pixmetry.calibrate.page import plots

    adjustment, tests = calibration.adjustment, calibration.tests
    model, name = adjustment.camera(k), f"c{k + 1}"
    r = over.Residuals.of(adjustment, k)
    out: dict[str, Any] = {"matrix": [], "lens": [], "sensor": [], "plots": [], "worst": [], "sheets": [], "undrawn": 0}
    correlations = of_camera(tests.correlations, model.name)
    if correlations is not None and len(correlations.names) > 1:
        out["matrix"] = [plots.correlation_map(correlations.names, correlations.matrix, name)]
    curves, projection = of_camera(tests.curves, model.name), of_camera(tests.projection, model.name)
    out["lens"] = plots.curve_pictures(_bent(curves, model), model.direction, name) if curves is not None else []
    if projection is not None and np.nanmax(projection.u_px, initial=0.0) > 0:
        out["lens"].append(plots.projection_map(projection, model.sensor, name))
    if len(r):
        out["sensor"] = [over.residual_vectors(r, name), over.mean_vectors(r, name)]
        out["plots"] = [plots.against_radius(r, (model["xp"], model["yp"]), name), plots.against_phase(r, name)]
        out |= _sheets(calibration, r, name)
    grid = of_camera(tests.residual_grid, model.name) or calibration.grids.get(model.name)
    if grid is not None:
        out["sensor"].append(over.grid_vectors(grid, model.sensor, name))
    records = [i for i in tests.images or () if i.camera == model.name and i.n > 0]
    if len(records) > 1:
        out["plots"].append(plots.by_image(records, name))
    out["sensor"] = [p for p in out["sensor"] if p is not None]
    return out | {"thinned": bool(len(r)) and int(np.bincount(r.image).max()) > over.MOST_IN_SMALL}


def _bent(curves: DistortionCurves, model: CameraModel) -> DistortionCurves:
    """Curves without those of terms that are 0 and were not estimated."""
    held = {name for name, free, value in zip(NAMES, model.free, model.values, strict=True) if not free and not value}
    if {"p1", "p2"} <= held:
        curves = replace(curves, tangential=None)
    if {name for name in NAMES if name[0] == "k"} <= held:
        curves = replace(curves, radial=None, balanced=None)
    return curves


def _sheets(calibration: Calibration, r: Residuals, name: str) -> dict[str, Any]:
    """Images one by one, the worst apart and the others in a fold, all at one scale."""
    from pixmetry.calibrate.page.figures import SHEET_COLS, SHEET_ROWS, enlargement, image_order, residual_sheet

    order = [int(i) for i in image_order(r)]
    if len(order) < 2:
        return {}
    scale = enlargement(r.dx, r.dy, r.sensor.cols, share=0.11)
    size = SHEET_COLS * SHEET_ROWS
    shown, rest = order[: 2 * WORST_IMAGES], order[2 * WORST_IMAGES :]
    open_parts = [shown[i : i + WORST_IMAGES] for i in range(0, len(shown), WORST_IMAGES)]
    parts = open_parts + [rest[i : i + size] for i in range(0, len(rest), size)]
    names = calibration.adjustment.network.images

    def sheet(number: int, images: list[int]) -> Figure:
        return residual_sheet(r, images, [_short(names[i]) for i in images], scale, f"{name}-sheet{number}")

    most = max(len(open_parts), MOST_SHEETS // len(calibration.adjustment.network.cameras))
    made = [sheet(i, part) for i, part in enumerate(parts[:most])]
    undrawn = len(order) - sum(len(part) for part in parts[:most])
    return {"worst": made[: len(open_parts)], "sheets": made[len(open_parts) :], "undrawn": undrawn}


def _short(name: str, most: int = 22) -> str:
    """An image's name as far as there is room; its end tells more than its beginning."""
    return name if len(name) <= most else "…" + name[1 - most :]


def _field(field: FieldTest) -> dict[str, Any]:
    compared, text = field.compared, typeset(sentence(field.text))
    if compared is None:
        return {"verdict": VERDICTS[field.verdict], "text": text, "moved": []}
    off, p = compared.deviations, tables.p_text(compared.p)
    sizes = [f"{significant(size, 2)} {off.unit} {word}" for size, word in ((off.rms, "rms"), (off.peak, "at most")) if size]
    said = "" if p == NONE else f" (p {p if p[0] == '<' else '= ' + p})"
    if sizes:
        text = f"The adjusted points lie {' and '.join(sizes)} off their given places{said}."
    if off.shape == "plane" and off.rms_in_plane is not None:
        inside = f"{significant(off.rms_in_plane, 2)} {off.unit}"
        text = f"The points leave their best plane by {' and '.join(sizes)}, and lie {inside} rms off in it{said}."
    if sizes and off.u:
        text += f" Their own uncertainty (k = 1) makes {significant(off.u, 2)} {off.unit} rms of the former."
    return {"verdict": VERDICTS[field.verdict], "text": text, "moved": tables.moved(compared)}


def _hold_out(found: HoldOut | None) -> str:
    if found is None:
        return ""
    texts = []
    p = tables.p_text(found.p)
    if p != NONE and found.fixed and found.free:
        told = p if p[0] == "<" else f"= {p}"
        texts.append(f"That the rms of images left out falls with free points has p {told} (paired over the images).")
    if found.expected_median_px:
        texts.append(
            f"With noise alone, half of the residuals of images left out would be above {length_px(found.expected_median_px)} px: "
            "points that few images see are worse known without one of them."
        )
    return " ".join(texts)


def _eccentricity(found: EccentricityRecord | None) -> str:
    if found is None or not found.corrected:
        return ""
    return (
        f"{found.corrected} image points were corrected for the eccentricity of circular targets, by at most "
        f"{length_px(found.largest_px)} px."
    )


def provenance_rows(record: Mapping[str, Any]) -> dict[str, Any]:
    """What both pages of calibrations tell about their origin."""
    libraries = ", ".join(f"{name} {version}" for name, version in (record.get("libraries") or {}).items())
    options = ", ".join(f"{key} = {value}" for key, value in (record.get("options") or {}).items())
    command = record.get("command") or ""
    rows = [
        ("pixmetry", record.get("pixmetry", "")),
        ("Python", record.get("python", "")),
        ("Libraries", libraries),
        ("Platform", record.get("platform", "")),
        ("Seed", "" if record.get("seed") is None else str(record["seed"])),
        ("Time (UTC)", str(record.get("time_utc", "")).replace("T", " ").removesuffix("+00:00")),
    ]
    return {
        "provenance": [(label, str(text)) for label, text in rows if text],
        "options": options,
        "command": command if isinstance(command, str) else " ".join(str(part) for part in command),
        "inputs": record.get("inputs") or (),
    }
