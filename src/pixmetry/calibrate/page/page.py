"""The page of a calibration by bundle adjustment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.page import tables
from pixmetry.calibrate.page.sources import add_sources
from pixmetry.calibrate.page.text import (
    DIRECTIONS,
    halves_text,
    middle_is_held,
    of_camera,
    p_text,
    projection_levels,
    residual_record,
    shared_text,
    sigma0_text,
    symbol,
    typeset,
    worth,
)
from pixmetry.core.finding import sentence
from pixmetry.report import Answer, Column, Figure, Page, Points, Reading, Row, Run, Section, Table, Text, html_of, strong
from pixmetry.report.numbers import NONE, fixed, length_px, significant
from pixmetry.report.page import LONG, Inline
from pixmetry.report.provenance import provenance_section

if TYPE_CHECKING:
    from pixmetry.calibrate.bundle.model import CameraModel
    from pixmetry.calibrate.page.figures import Residuals
    from pixmetry.calibrate.records import (
        Calibration,
        DistortionCurves,
        EccentricityRecord,
        FieldTest,
        HoldOut,
        RigRecord,
        SharedByCamera,
    )
    from pixmetry.core.finding import Finding

WORST_IMAGES = 6  # on each of the two sheets that are not folded
VERDICTS = {"fixed": "held as given", "free": "estimated, because its given coordinates are not exact enough"}
MOST_SHEETS = 30  # of small images on a page; more would make it heavy
FOOTER = "Uncertainties are standard uncertainties (k = 1); x runs along rows, y along columns."
PARAMETERS = (
    "Value ± standard uncertainty u (k = 1, two significant digits). p is the probability of a value at least that far from 0 if it were "
    "0: a lens or affinity term with a large p is not significant. Pixel (0, 0) is the centre of the top-left pixel, x to the right, y "
    "down."
)
UNCERTAINTIES = (
    "± u is stated; “independent” is what it would be if errors of image points were independent; “95 %” is half of an interval of that "
    "coverage, by the effective degrees of freedom. Differences of halves are over their own uncertainty, which holds what the halves do "
    "not share."
)
LEFT_OUT = (
    "“Left out”: u by the jackknife, from the calibrations without each of {folds} parts of the images, over the u stated; it is rough, "
    "and does not see what all images share."
)
RESIDUALS = (
    "Residuals are measured minus computed image coordinates. Degrees of freedom are sums of redundancy numbers: of each residual, the "
    "share that the adjustment could not take up."
)


def write_page(calibration: Calibration, path: str | Path) -> Path:
    """Write the page as HTML and return its path; only an earlier page of this kind is replaced.

    Raises
    ------
    InputError
        If there is something else of that name, or it cannot be written.
    """
    from pixmetry.files import write_page as write

    return write(path, html_of(page_of(calibration)))


def page_of(calibration: Calibration) -> Page:
    """The page of a calibration.

    Parameters
    ----------
    calibration : Calibration

    Returns
    -------
    Page
    """
    net = calibration.adjustment.network
    name = str(calibration.provenance.get("name") or ", ".join(c.name for c in net.cameras))
    page = Page(name, "calibration", "pixmetry camera calibration", tables.network_facts(calibration), FOOTER)
    pictures = [_pictures(calibration, k) for k in range(len(net.cameras))]
    _verdict(page.add_section("Accuracy of the calibration", name="verdict"), calibration)
    _parameters(page.add_section("Interior parameters", name="parameters"), calibration, pictures)
    if any(p["lens"] for p in pictures):
        lens = page.add_section("Lens and projection", name="lens")
        for k, p in enumerate(pictures):
            if p["lens"]:
                _channel(lens, calibration, k).add(*p["lens"])
    if calibration.tests.rig is not None:
        _rig(page.add_section("Rig", name="rig"), calibration.tests.rig)
    _residuals(page.add_section("Residuals", name="residuals"), calibration, pictures)
    if calibration.tests.hold_out or calibration.tests.field:
        _field_section(page.add_section("Test field, and images left out", name="field"), calibration)
    _space(page.add_section("Network and object points", name="space"), calibration)
    if (origin := provenance_section(calibration.provenance)) is not None:
        page.sections.append(origin)
    return page


def _channel(section: Section, calibration: Calibration, k: int) -> Section:
    """The section for the parts of one camera: a separate one if there are several cameras."""
    cameras = calibration.adjustment.network.cameras
    return section if len(cameras) == 1 else section.add_section(cameras[k].name)


def typeset_findings(findings: Sequence[Finding]) -> list[Finding]:
    """Findings with true minus signs, capitals and full stops."""
    return [replace(f, text=typeset(sentence(f.text)), advice=typeset(sentence(f.advice))) for f in findings]


def number_table(label: str, heads: Sequence[str], rows: Sequence[Sequence[Inline]], words: int = 1, *, scrolls: bool = False) -> Table:
    """A table whose first columns hold words and the others numbers."""
    return Table(label, [Column(h, "left" if k < words else "right") for k, h in enumerate(heads)], list(rows), scrolls=scrolls)


def _verdict(section: Section, calibration: Calibration) -> None:
    """What each camera is worth, σ₀, and what was found."""
    parts: list[Text | Sequence[Reading]] = []
    cameras = calibration.adjustment.network.cameras
    for k in range(len(cameras)):
        model, found = calibration.adjustment.camera(k), residual_record(calibration, k)
        levels = projection_levels(of_camera(calibration.tests.projection, model.name))
        readings = [
            Reading(axis, f"{length_px(one.rms_px)} px", f"= {um} µm" if (um := _um(one.rms_um)) else "")
            for axis, one in (found.typical.items() if found.n else ())
        ]
        if levels is not None and any(levels):
            low, high = (length_px(v) for v in levels)
            held = middle_is_held(levels)
            told = (f"{high} px", "in the corners; principal point held") if held else (f"{low} px", f"to {high} px in the corners")
            readings.append(Reading("projection", *told))
        parts += [Text(strong(model.name))] if len(cameras) > 1 else []
        parts += [Text(worth(calibration, k)), *([readings] if readings else [])]
    section.add(Answer([*parts, Text(sigma0_text(calibration), "second")]))
    if calibration.findings:
        section.add(*typeset_findings(calibration.findings))
    elif calibration.tests.made:
        section.add_text("The tests of this calibration found nothing.", style="soft")
    else:
        section.add_text("This calibration was not tested for patterns, gross errors or the shape of its test field.", style="soft")


def _parameters(section: Section, calibration: Calibration, pictures: Sequence[Mapping[str, Any]]) -> None:
    section.add_text(PARAMETERS, style="small soft")
    for k in range(len(calibration.adjustment.network.cameras)):
        model, own = calibration.adjustment.camera(k), _channel(section, calibration, k)
        own.add_text(f"{camera_facts(model)} The distortion model {DIRECTIONS[model.direction]}.")
        rows = tables.parameters(calibration, k)
        own.add(_parameter_table(rows, f"Interior parameters of {model.name}"))
        own.add_text("B2 and P2 are for y down. For y up both change their sign; the other terms keep theirs.", style="small soft")
        if not any(r["u"].startswith("±") for r in rows):
            own.add_text("The uncertainty of the parameters was not computed.", style="small")
        if shared := of_camera(calibration.tests.shared_errors, model.name):
            _uncertainties(own, calibration, shared, model.name)
        if groups := tables.groups(calibration.tests.parameter_groups or (), model.name):
            own.add(number_table("Joint tests", ["Together", "Terms", "F", "Degrees of freedom", "p against 0"], groups, 2))
        if vision := tables.vision(calibration, model.name):
            part = own.add_section("In the notation of computer vision")
            part.add_table("The linear part of the camera", ["Name", Column("Value / px", "right"), Column("± u", "u")], vision)
            part.add_text(
                "The linear part of the camera. The lens terms above belong to their own model; they are not the coefficients of "
                "another model.",
                style="small soft",
            )
        if pictures[k]["matrix"]:
            own.add_section("Correlations", *pictures[k]["matrix"])
    if poses := calibration.tests.correlations_with_poses:
        rows_of = [(_full(r.a), _full(r.b), fixed(r.r, 2)) for r in poses]
        table = number_table("Correlations with poses", ["Interior parameter", "Pose", "r"], rows_of, 2)
        section.add_section("Strongest correlations with poses", table, fold=True)


def _uncertainties(own: Section, calibration: Calibration, shared: SharedByCamera, name: str) -> None:
    """What of u comes from errors that image points share; halves of the images, and parts left out, against u."""
    halves, left = of_camera(calibration.tests.halves, name), of_camera(calibration.tests.jackknife, name)
    part = own.add_section("Uncertainties against the images")
    part.add_text(typeset(shared_text(shared)))
    if halves:
        part.add_text(typeset(halves_text(halves)))
    if not shared.names:
        return
    heads, rows = tables.uncertainties(shared, halves or (), left)
    part.add(number_table(f"Uncertainties of {name}", heads, rows))
    part.add_text(UNCERTAINTIES + (f" {LEFT_OUT.format(folds=left.folds)}" if left else ""), style="small soft")


def _parameter_table(rows: Sequence[Mapping[str, str]], label: str) -> Table:
    columns: list[Column | str] = [
        "Parameter",
        "",
        Column("Value", "right"),
        Column("± u", "u"),
        Column("Unit", "unit"),
        "p against 0",
        "Correlates most with",
    ]
    cells = [
        [
            [r["title"], *([Run(f"\n{r['off']}", "small")] if r["off"] else [])],
            r["symbol"],
            r["value"],
            r["u"],
            r["unit"],
            Run(r["p"], "soft" if "not" in r["p"] else ""),
            r["with"],
        ]
        for r in rows
    ]
    return Table(label, columns, cells)


def _residuals(section: Section, calibration: Calibration, pictures: Sequence[Mapping[str, Any]]) -> None:
    """Residuals by axis with their test, over the sensor and image by image; patterns, gross errors, the images."""
    section.add_text(RESIDUALS, style="small soft")
    tests, cameras = calibration.tests, calibration.adjustment.network.cameras
    for k, drawn in enumerate(pictures):
        own = _channel(section, calibration, k)
        _axes_and_test(own, calibration, k)
        own.add(*drawn["sensor"], *drawn["plots"])
        if drawn["worst"]:
            _image_by_image(own, drawn)
    if text := _eccentricity(tests.eccentricity):
        section.add_text(text)
    _patterns(section, tables.patterns(tests.patterns or (), len(cameras) > 1))
    for k, model in enumerate(cameras):
        if (told := of_camera(tests.field_sources, model.name)) is not None:
            add_sources(_channel(section, calibration, k), told, calibration.adjustment.camera(k))
    if gross := tables.gross_errors(tests.gross_errors or ()):
        heads = ["Image", "Point", "Residual x / px", "y / px", "Error x / px", "y / px", "Statistic", "Critical"]
        many = f"{len(gross)} image points were" if len(gross) > 1 else "1 image point was"
        words = f"{many} rejected. “Residual” is the residual of the adjustment, “error” the estimated size of the gross error."
        part = section.add_section("Gross errors").add_text(words + _scrolls(gross))
        part.add(number_table("Gross errors", heads, gross, 2, scrolls=True))
    elif tests.gross_errors is not None:
        section.add_text("No gross error was found.")
    if tests.images:
        table = tables.images(tests.images)
        several = ["Camera"] if len(cameras) > 1 else []
        rows = [[image, *([camera] if several else []), *cells] for image, camera, cells in table["rows"]]
        shown = number_table("Images", ["Image", *several, *table["heads"]], rows, 1 + len(several), scrolls=True)
        section.add_section(f"Table of the {len(rows)} images", shown, fold=True)


def _axes_and_test(own: Section, calibration: Calibration, k: int) -> None:
    name = calibration.adjustment.camera(k).name
    axes = tables.axes(calibration, k)
    shown = [key for key in ("axis", "n", "rms", "dof", "sigma") if key != "sigma" or axes[0]["sigma"]]
    heads = ["Axis", "Points", "rms", "Degrees of freedom", "Variance component"][: len(shown)]
    own.add(number_table(f"Residuals by axis of {name}", heads, [[r[key] for key in shown] for r in axes]))
    told = of_camera(calibration.tests.f_test, name)
    if told is not None and told.text:
        own.add_text(typeset(sentence(told.text)))
    if test := tables.f_test(calibration, name):
        heads = ["F-test of x against y", "Ratio of variances", "Degrees of freedom", "Critical, 95 %", "p"]
        rows = [[f"in {r['unit']}", r["ratio"], r["dof"], r["critical"], r["p"]] for r in test]
        own.add(number_table(f"F-test of {name}", heads, rows))


def _image_by_image(own: Section, drawn: Mapping[str, Any]) -> None:
    part = own.add_section("Image by image", *drawn["worst"])
    words = "The images with the largest residuals first; all at one enlargement."
    part.add_text(words + (" Of images with many points an even selection is drawn." if drawn["thinned"] else ""), style="small soft")
    if drawn["sheets"]:
        rest = part.add_section("The other images", *drawn["sheets"], fold=True)
        if drawn["undrawn"]:
            rest.add_text(f"{drawn['undrawn']} more, with smaller residuals, are only in the table of images.", style="small soft")


def _scrolls(rows: Sequence[Any]) -> str:
    return " The table scrolls." if len(rows) > LONG else ""


def _patterns(section: Section, rows: Sequence[Mapping[str, Any]]) -> None:
    if not rows:
        return
    part = section.add_section("Patterns that were tested")
    found, others = [r for r in rows if r["found"]], [r for r in rows if not r["found"]]
    part.add(_pattern_table(found) if found else Text("None was found."))
    if others:
        title = f"{len(others)} that {'were' if len(others) > 1 else 'was'} not found"
        part.add_section(title, _pattern_table(others), fold=True)


def _pattern_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    shown = [Row([r["title"], r["amplitude"], r["p"]], r["advice"] if r["found"] else "") for r in rows]
    return Table("Patterns in the residuals", ["Pattern", Column("Amplitude / px", "right"), Column("p", "right")], shown)


def _field_section(section: Section, calibration: Calibration) -> None:
    from pixmetry.calibrate.page.space import field_map

    held, field = calibration.tests.hold_out, calibration.tests.field
    if held is not None and (rows := tables.hold_out(held)):
        heads = ["Test field", "rms of the fit / px", "rms of images left out / px", "half of them above / px"]
        section.add(number_table("Images left out", heads, rows))
        if text := _hold_out(held):
            section.add_text(text)
        parts = f"The images were left out in {held.folds} parts, one part after the other. " if held.folds else ""
        words = (
            "Of an image that was left out only the pose is estimated. A decrease in the fit that images left out do not show is not real."
        )
        section.add_text(parts + words, style="small soft")
    if not field:
        return
    told = _field(field)
    part = section.add_section("Shape of the test field" + (f": {told['verdict']}" if told["verdict"] else ""))
    if told["text"]:
        part.add_text(told["text"])
    if field.compared:
        part.add(field_map(calibration.adjustment, field.compared.deviations.points))
    if told["moved"]:
        heads = ["Moved with free points", "by / px", "formal u / px", "by / u"]
        part.add(number_table("Parameters that moved", heads, told["moved"]))
        words = "The formal u is that of the adjustment with the given coordinates; it does not include their errors."
        part.add_text(words, style="small soft")


def _space(section: Section, calibration: Calibration) -> None:
    """Datum, views of the network, what was given of the object, its points."""
    from pixmetry.calibrate.page.space import network_views

    adjustment = calibration.adjustment
    unit = adjustment.network.unit
    lost = int(np.sum(~adjustment.state.located))
    words = f" {adjustment.datum or 'not stated'}."
    if lost:
        few, them = ("points are", "them, or their") if lost > 1 else ("point is", "it, or its")
        words += f" {lost} {few} not determined: too few of the images that took part see {them} rays do not meet."
    section.add_text(strong("Datum:"), words)
    section.add(*network_views(adjustment))
    if bars := tables.scale_bars(calibration):
        heads = ["Between", f"Length / {unit}", "u", f"Measured minus adjusted / {unit}", "by / u"]
        section.add_section("Scale bars", number_table("Scale bars", heads, bars))
    if control := tables.control_points(calibration):
        heads = ["Coordinate", f"Given / {unit}", "u", f"Given minus adjusted / {unit}", "by / u"]
        part = section.add_section("Control points", number_table("Control points", heads, control, scrolls=True))
        if _scrolls(control):
            part.add_text("The table scrolls.", style="small soft")
    _check_points(section, calibration)
    _object_points(section, calibration)
    notes = [n for n in adjustment.notes if not any(n.rstrip(".") in f.text for f in calibration.findings)]
    if notes:
        section.add_section("Notes", Points(notes))


def _rig(section: Section, rig: RigRecord) -> None:
    """Relative poses of cameras that stand still against each other, whether they did, and epipolar distances."""
    heads = ["Camera", "against", f"Baseline / {rig.unit}", *(f"{axis} / {rig.unit}" for axis in "XYZ"), "Angle / °"]
    heads += ["About x / °", "About y / °", "About z / °"]
    section.add(number_table("Relative poses", heads, tables.relative_poses(rig), words=2))
    words = (
        "Projection centre in the frame of the other camera (x right, y down, z forwards), and the rotation vector of R: a point X of that "
        "frame is seen at R (X − X₀)."
    )
    if rig.widened > 1:
        words += f" Uncertainties are {significant(rig.widened, 2)} times those of noise, because the instants scatter."
    section.add_text(words, style="small soft")
    if rig.rigid is not None:
        test = rig.rigid
        section.add_text(
            strong("Did the cameras stand still?"),
            f" Over {rig.instants} instants, each with a pose of its own for every image, relative poses scatter by "
            f"{significant(test.scatter, 2)} {rig.unit} and {significant(test.scatter_deg, 2)}°; noise explains "
            f"{significant(test.expected, 2)} {rig.unit} and {significant(test.expected_deg, 2)}° (F = {significant(test.f, 3)}, "
            f"p = {p_text(test.p)}).",
        )
    if rig.epipolar:
        heads = ["Cameras", "Points", "rms distance / px", "u", "by noise / px"]
        part = section.add_section("Distances from epipolar lines", number_table("Epipolar distances", heads, tables.epipolar(rig)))
        part.add_text("In images without distortion, both cameras alike, of the image points that took part.", style="small soft")


def _check_points(section: Section, calibration: Calibration) -> None:
    checked = tables.check_points(calibration)
    if not checked:
        return
    unit = calibration.adjustment.network.unit
    part = section.add_section("Check points", Text(checked["text"]))
    if not checked["rows"]:
        return
    heads = ["Coordinate", f"Given / {unit}", "u", f"Found / {unit}", "u", f"Given minus computed / {unit}", "by / u", "Images"]
    part.add(number_table("Check points", heads, checked["rows"], scrolls=True))
    datum = f", less what {checked['fitted']} of the datum took up; the u found is that in the datum stated" if checked["fitted"] else ""
    chance = f" One of all would be above {checked['critical']} by chance in {checked['level']} % of cases." if checked["critical"] else ""
    words = f"They took no part in the adjustment. The last ratio is the difference over its u, which includes both parts{datum}.{chance}"
    part.add_text(words + _scrolls(checked["rows"]), style="small soft")


def _object_points(section: Section, calibration: Calibration) -> None:
    from pixmetry.calibrate.page.space import plan_views

    net, points = calibration.adjustment.network, tables.worst_points(calibration)
    part = section.add_section("Object points")
    if points["rows"]:
        sizes = f"{points['median']} {net.unit} (median), {points['largest']} {net.unit} (largest)"
        part.add_text(f"Largest semi-axis of a standard ellipsoid: {sizes}, in the datum stated.")
        part.add(*plan_views(calibration.adjustment))
        heads = ["Point", *(f"{axis} / {net.unit}" for axis in ("X", "Y", "Z", "Largest semi-axis")), "Rays"]
        title = f"Table of the {len(points['rows'])} points with the largest uncertainty"
        part.add_section(title, number_table("Object points", heads, points["rows"]), fold=True)
    elif len(net.u_xyz) and np.all(net.u_xyz == 0):
        part.add_text("All points were held at their given coordinates.")
    else:
        part.add_text("The uncertainty of the points was not computed.")


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
    from pixmetry.calibrate.page import figures

    adjustment, tests = calibration.adjustment, calibration.tests
    model, name = adjustment.camera(k), f"c{k + 1}"
    r = figures.Residuals.of(adjustment, k)
    out: dict[str, Any] = {"matrix": [], "lens": [], "sensor": [], "plots": [], "worst": [], "sheets": [], "undrawn": 0}
    correlations = of_camera(tests.correlations, model.name)
    if correlations is not None and len(correlations.names) > 1:
        out["matrix"] = [figures.correlation_map(correlations.names, correlations.matrix, name)]
    curves, projection = of_camera(tests.curves, model.name), of_camera(tests.projection, model.name)
    out["lens"] = figures.curve_pictures(_bent(curves, model), model.direction, name) if curves is not None else []
    if projection is not None and np.nanmax(projection.u_px, initial=0.0) > 0:
        out["lens"].append(figures.projection_map(projection, model.sensor, name))
    if len(r):
        out["sensor"] = [figures.residual_vectors(r, name), figures.mean_vectors(r, name)]
        out["plots"] = [figures.against_radius(r, (model["xp"], model["yp"]), name), figures.against_phase(r, name)]
        out |= _sheets(calibration, r, name)
    grid = of_camera(tests.residual_grid, model.name) or calibration.grids.get(model.name)
    if grid is not None:
        out["sensor"].append(figures.grid_vectors(grid, model.sensor, name))
    records = [i for i in tests.images or () if i.camera == model.name and i.n > 0]
    if len(records) > 1:
        out["plots"].append(figures.by_image(records, name))
    out["sensor"] = [p for p in out["sensor"] if p is not None]
    return out | {"thinned": bool(len(r)) and int(np.bincount(r.image).max()) > figures.MOST_IN_SMALL}


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
    """The end of an image's name, as far as there is room."""
    return name if len(name) <= most else "…" + name[1 - most :]


def _field(field: FieldTest) -> dict[str, Any]:
    compared, text = field.compared, typeset(sentence(field.text))
    if compared is None:
        return {"verdict": VERDICTS[field.verdict], "text": text, "moved": []}
    off, p = compared.deviations, p_text(compared.p)
    sizes = [f"{significant(size, 2)} {off.unit} {word}" for size, word in ((off.rms, "rms"), (off.peak, "at most")) if size]
    said = "" if p == NONE else f" (p {p if p[0] == '<' else '= ' + p})"
    if sizes:
        text = f"The adjusted points lie {' and '.join(sizes)} off their given positions{said}."
    if off.shape == "plane" and off.rms_in_plane is not None:
        inside = f"{significant(off.rms_in_plane, 2)} {off.unit}"
        text = f"The points deviate from their best plane by {' and '.join(sizes)}, and lie {inside} rms off in it{said}."
    if sizes and off.u:
        text += f" Their own uncertainty (k = 1) makes {significant(off.u, 2)} {off.unit} rms of the former."
    return {"verdict": VERDICTS[field.verdict], "text": text, "moved": tables.moved(compared)}


def _hold_out(found: HoldOut | None) -> str:
    if found is None:
        return ""
    texts = []
    p = p_text(found.p)
    if p != NONE and found.fixed and found.free:
        told = p if p[0] == "<" else f"= {p}"
        texts.append(f"The decrease of the rms of images left out with free points has p {told} (paired over the images).")
    if found.expected_median_px:
        texts.append(
            f"With noise alone, half of the residuals of images left out would be above {length_px(found.expected_median_px)} px: "
            "points in few images are less well known without one of them."
        )
    return " ".join(texts)


def _eccentricity(found: EccentricityRecord | None) -> str:
    if found is None or not found.corrected:
        return ""
    return (
        f"{found.corrected} image points were corrected for the eccentricity of circular targets, by at most "
        f"{length_px(found.largest_px)} px."
    )
