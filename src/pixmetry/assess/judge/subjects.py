"""Values to be compared or checked: those of a data sheet, an assessment, a calibration or a series, read from their files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from pixmetry.assess.judge.differences import Subject
from pixmetry.assess.results import RESULTS_SCHEMA
from pixmetry.calibrate.files.record import LINES_SCHEMA, RESULT_SCHEMA
from pixmetry.core.checksums import check_record
from pixmetry.core.errors import InputError
from pixmetry.core.number import Number
from pixmetry.emva.files.json_format import SCHEMA, WHAT_TO_NAME, is_xml, read_bytes, sheet_of_record, value_of
from pixmetry.emva.files.sheets import read_sheet
from pixmetry.emva.records import MONO, DataSheet
from pixmetry.files.strict_json import number_in, parse_json
from pixmetry.series.records import SERIES_SCHEMA

RESULT_FILES = ("results.json", "calibration.json", "series.json")
CALIBRATED = ".calibrated"  # end of the key of what a calibration leaves


def load_subject(source: DataSheet | str | Path, name: str = "") -> Subject:
    """Read the values to be compared: from a data sheet, its file, or the results of an assessment, calibration or series, or their folder.

    Raises
    ------
    InputError
        If it is none of these.
    """
    if isinstance(source, DataSheet):
        return _of_sheet(source, name or str(source.camera.get("name") or "data sheet"))
    path = Path(source)
    if path.is_dir():
        path = next((path / file for file in RESULT_FILES if (path / file).is_file()), path)
        if path.is_dir():
            remedy = "name a data sheet, or the folder of an assessment, of a calibration or of a series"
            raise InputError(f"folder without {' or '.join(RESULT_FILES)}", where=str(path), remedy=remedy)
    name, raw = name or str(source), read_bytes(path)
    if is_xml(raw):
        return _of_sheet(read_sheet(path), name)
    record = parse_json(raw, str(path), WHAT_TO_NAME)
    check_record(record, str(path))
    schema = record.get("schema", "no schema")
    if schema in READERS:
        return READERS[schema](record, name, str(path))
    if schema != SCHEMA:
        allowed = ", ".join((SCHEMA, *READERS))
        what = "no data sheet, assessment, calibration or series"
        raise InputError(what, where=str(path), value=schema, allowed=allowed, remedy="check the file")
    return _of_sheet(sheet_of_record(record, str(path)), name)


def _of_sheet(sheet: DataSheet, name: str) -> Subject:
    values = {(result.channel, key): value for result in sheet.results for key, value in result.values.items()}
    release = sheet.results[0].release if sheet.results else ""
    known = number_in(sheet.conditions.get("photons_u_rel"), f"{name}: photons_u_rel")
    return Subject(name, "data sheet", release, sheet.camera, values, {}, 0.0 if math.isnan(known) else known)


def _of_assessment(record: Mapping[str, Any], name: str, where: str) -> Subject:
    values: dict[str, Number] = {}
    try:
        transfer = (record.get("photon_transfer") or {}).get("estimates", [])
        groups = {**record["estimates"], "photon_transfer": transfer, "spatial": record.get("spatial") or []}
        for source, estimates in groups.items():
            values |= {f"{source}.{e['name']}": Number.from_record(e) for e in estimates}
        results = (record.get("emva1288") or {}).get("results", {})
        standard = {k: v for k, v in results.items() if not k.startswith("index_")}
        values |= {f"emva1288.{key}": value_of(v, f"{where}: emva1288.{key}") for key, v in standard.items()}
        budget = record["budget"]
        values |= _of_budget(budget, _gain_u_rel(groups["photon_transfer"]))
        how = {"estimator": _estimator_text(budget["estimator"]), "target": str(budget["target"]["kind"])}
        worth = ((budget["target"], how["estimator"]), dict(_sizes(budget["verdicts"][0])))
        placed = {(MONO, key): value for key, value in values.items()}
        return Subject(name, "assessment", "", dict(record["camera"]), placed, dict(record["unmeasured"]), worth=worth, how=how)
    except (KeyError, IndexError, TypeError, AttributeError, ValueError):
        raise InputError("damaged results of an assessment", where=where, remedy="make the assessment again") from None


def _gain_u_rel(estimates: Iterable[Mapping[str, Any]]) -> float:
    """Relative uncertainty of the gain, on which every number of a budget rests."""
    return next((float(e["u"]) / float(e["value"]) for e in estimates if e["name"] == "gain_dn_per_e" and e["value"]), 0.0)


def _estimator_text(estimator: Mapping[str, Any]) -> str:
    """Name and settings; not what follows from camera and target."""
    settings = {k: estimator[k] for k in ("window", "sigma") if estimator.get(k) is not None}
    return ", ".join([str(estimator["name"]), *(f"{k} = {v:g}" for k, v in settings.items())])


def _of_budget(budget: Mapping[str, Any], gain_u_rel: float) -> dict[str, Number]:
    """Target, rows and totals of a budget, with u of what repeating the measurement would change.

    Of a measured row that is what its parameters leave open, of all others half of what its formula declares to leave open; with both the
    gain's. A total holds the rows', each as far as it counts, the gain's, which all of them share, and the error of chance where it is by
    Monte Carlo. What a calibration leaves of a row is as uncertain, relatively, as the row.
    """
    units = {True: "px", False: "1"}
    values = {f"budget.target.{k}": Number(float(v), 0.0, math.inf, units[k.endswith("_px")]) for k, v in _numbers(budget["target"])}
    known_rows: list[tuple[Mapping[str, Any], float]] = []
    for row in budget.get("rows", ()):
        contribution, total = row["contribution"], float(row["total_px"])
        if contribution is None or row["status"] in ("not applicable", "left to calibration"):
            continue
        formula = 0.5 * max(float(contribution["model_error"]) * total, float(contribution["floor_px"]))
        known = float(row["u_of_total_px"]) if row["status"] == "measured" else formula
        known_rows.append((row, known))
        for state, size in _sizes(row):
            left = size / total if total else 1.0
            values[f"budget.{row['name']}{state}"] = Number(
                size, left * math.hypot(known, gain_u_rel * total), math.inf, "px", row["status"]
            )
    by = budget.get("headline") or {}
    chance = float(by.get("se_simulated_px") or 0.0) if by.get("by") == "Monte Carlo" else 0.0
    for group, holds in (("verdicts", False), ("with_accepted", True)):
        counted = [(row, known) for row, known in known_rows if holds or row["status"] != "accepted"]
        for one in budget.get(group, ()):
            key = f"budget.{'verdict' if group == 'verdicts' else group}.{int(one.get('frames', 1))}_frames"
            for state, size in _sizes(one):
                square = sum(_square_u(row, known, int(one.get("frames", 1)), state) for row, known in counted)
                u = math.hypot(math.sqrt(square) / size if size else 0.0, gain_u_rel * size, chance)
                values[key + state] = Number(size, u, math.inf, "px", str(by.get("by", "sum")))
    return values


def _sizes(record: Mapping[str, Any]) -> list[tuple[str, float]]:
    """A total, and what a calibration leaves of it, where the record says so; each with the end of its key."""
    left = record.get("calibrated_px")
    return [("", float(record["total_px"])), *([] if left is None else [(CALIBRATED, float(left))])]


def _square_u(row: Mapping[str, Any], known: float, frames: int, state: str) -> float:
    """Square of a row's size times its uncertainty, in the mean over frames."""
    total = float(row["total_px"])
    size = dict(_sizes(row)).get(state, total)
    return (size * known * (size / total if total else 0.0) * _kept(row, frames, size)) ** 2


def _kept(row: Mapping[str, Any], frames: int, size: float) -> float:
    """Part of the square of a row's size that the mean over several frames keeps; what drifts or is the object's stays whole."""
    contribution = row["contribution"]
    if frames == 1 or size == 0 or contribution["gum_class"] in ("D", "O"):
        return 1.0
    in_time = 0.5 * sum(float(v) ** 2 for v in contribution["time_px"])
    return 1.0 - (1.0 - 1.0 / frames) * min(in_time / size**2, 1.0)


def _numbers(record: Mapping[str, Any]) -> list[tuple[str, float]]:
    return [(k, v) for k, v in record.items() if isinstance(v, int | float) and not isinstance(v, bool)]


def _of_calibration(record: Mapping[str, Any], name: str, where: str) -> Subject:
    """Interior parameters of each camera, and the standard deviation of unit weight.

    Coordinates of points and poses are left out: they belong to what was photographed, and to the datum. A single camera is compared
    whatever its name.
    """
    try:
        cameras, sigma0, dof = record["cameras"], _float(record["sigma0"]), float(record["dof"])
        values = {(MONO, "sigma0"): Number(sigma0, sigma0 / math.sqrt(2 * dof) if dof > 0 else math.nan, dof)}
        for camera in cameras:
            channel = MONO if len(cameras) == 1 else str(camera["name"])
            for p in camera["parameters"]:
                u, of_u = 0.0, math.inf  # held fast: a number as it was given
                if p["free"]:
                    u, of_u = _float(p["u"]), _float(p.get("dof", dof))
                values[channel, p["name"]] = Number(_float(p["value"]), u, of_u, p["unit"])
        return Subject(name, "calibration", "", _camera_facts(cameras), values, {})
    except (KeyError, IndexError, TypeError, AttributeError, ValueError):
        raise InputError("a damaged calibration", where=where, remedy="calibrate again") from None


def _of_lines(record: Mapping[str, Any], name: str, where: str) -> Subject:
    """Lens parameters that straight lines determine."""
    try:
        values = {(MONO, e["name"]): Number.from_record(e) for e in record["parameters"]}
        return Subject(name, "calibration from straight lines", "", _camera_facts(record["cameras"]), values, {})
    except (KeyError, IndexError, TypeError, AttributeError, ValueError):
        raise InputError("a damaged calibration", where=where, remedy="calibrate again") from None


def _of_series(record: Mapping[str, Any], name: str, where: str) -> Subject:
    """How far the image moves while a camera warms up, its time constants, and when it is stable."""
    try:
        values = {(MONO, e["name"]): Number.from_record(e) for e in record["estimates"]}
        values[MONO, "stable_s"] = Number.from_record(record["stable"])
        if "focus" in record:
            values[MONO, "blur_change_px2"] = Number.from_record(record["focus"])
        facts = {key: record[key] for key in ("cols", "rows", "tolerance_px")}
        return Subject(name, "series", "", facts, values, dict(record["not_told"]))
    except (KeyError, IndexError, TypeError, AttributeError, ValueError):
        raise InputError("a damaged series", where=where, remedy="measure the series again") from None


def _float(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _camera_facts(cameras: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """What else should agree; of several cameras nothing, as they go by their names."""
    known = list(cameras)
    names = ("name", "cols", "rows", "pitch_x_um", "pitch_y_um", "direction")
    return {name: known[0][name] for name in names} if len(known) == 1 else {}


READERS: dict[str, Callable[[Mapping[str, Any], str, str], Subject]] = {
    RESULTS_SCHEMA: _of_assessment,
    RESULT_SCHEMA: _of_calibration,
    LINES_SCHEMA: _of_lines,
    SERIES_SCHEMA: _of_series,
}
