"""The camera of a budget, from one description or several: what was measured goes before a data sheet, and both are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.budget.parameters import UNSTATED_U_REL, told_values
from pixmetry.camera.camera import Camera, Element, load_camera
from pixmetry.camera.chain_order import in_order
from pixmetry.core.errors import InputError
from pixmetry.emva.files.json_format import SCHEMA as RESULT
from pixmetry.emva.files.json_format import is_xml
from pixmetry.emva.files.sheet_camera import camera_of_sheet
from pixmetry.emva.files.sheets import read_sheet
from pixmetry.emva.records import DataSheet
from pixmetry.files.strict_json import starts_with

RANK = {"measured": 3, "sheet": 2, "": 1, "typical": 0}  # what goes before what
GAIN, CONVERTER = "electronics.gain", "grabber.adc"
HEAD_BYTES = 200  # of a file, in which it says what it is
TOLD = {"measured", "sheet", ""}  # what a description knows itself; "": as a preset or a camera file describes it
DESCRIBED = "described"
COVERAGE = 2.0  # expanded uncertainties beyond which two values contradict each other


@dataclass(frozen=True)
class Disagreement:
    """One parameter in two descriptions of the camera.

    Parameters
    ----------
    name, parameter, unit : str
        Of the source in the chain.
    first, second : float
        Values, in the order of the descriptions; ``first_from`` and ``second_from`` say whence.
    u : float
        Standard uncertainty of their difference; 10 % of a value that states none.
    """

    name: str
    parameter: str
    unit: str
    first: float
    second: float
    first_from: str
    second_from: str
    u: float

    @property
    def agree(self) -> bool:
        """Whether they lie within two standard uncertainties of their difference."""
        return abs(self.first - self.second) <= COVERAGE * self.u


def camera_of(given: str | Path | Camera | Sequence[str | Path | Camera]) -> tuple[Camera, tuple[Disagreement, ...]]:
    """One camera of one description or several.

    Parameters
    ----------
    given : path, name of a preset, Camera, or several of them
        Camera files, data sheets, presets, and results of a test by EMVA 1288 (JSON or XML). What such a result does not say of the
        format (bits, rows, columns, pitch), the first of the others tells.

    Returns
    -------
    Camera
        That of the first description; a source that another one knows better (measured before sheet before typical) is taken from there.
    tuple of Disagreement
        Every parameter that two descriptions know, one of them at least from a measurement or a data sheet.

    Raises
    ------
    InputError
        If nothing is given, or two descriptions are of sensors of another size.
    """
    several = [given] if isinstance(given, str | Path | Camera) else list(given)
    if not several:
        raise InputError("no camera is given", allowed="a preset, a camera file, a data sheet or a result of EMVA 1288")
    read = [_read(c) for c in several]
    format_of = next((c for c in read if isinstance(c, Camera)), None)
    cameras = [
        c if isinstance(c, Camera) else _camera_of_result(c, Path(str(name)), format_of) for c, name in zip(read, several, strict=True)
    ]
    camera, found = cameras[0], []
    for other in cameras[1:]:
        if other.frame_shape != camera.frame_shape:
            sizes = " and ".join(f"{c.frame_shape[1]} × {c.frame_shape[0]} px in {c.name}" for c in (camera, other))
            raise InputError("the descriptions are of different sensors", value=sizes, remedy="name descriptions of one camera")
        found += _compared(camera, other)
        camera = _joined(camera, other)
    return camera, tuple(found)


def _read(given: str | Path | Camera) -> Camera | DataSheet:
    """A camera, or the result of a test by EMVA 1288."""
    if isinstance(given, Camera):
        return given
    path = Path(given)
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
        if starts_with(head.lower(), b"<!doctype html") or starts_with(head.lower(), b"<html"):
            remedy = "name the camera file, the data-sheet file, or the JSON or XML of the test"
            raise InputError("a page for reading, not a camera", where=str(path), remedy=remedy)
        if is_xml(head) or starts_with(head, b"{") and RESULT.partition("/1")[0].encode() in head:
            return read_sheet(path)
    return load_camera(given)


def _camera_of_result(sheet: DataSheet, path: Path, known: Camera | None) -> Camera:
    """The camera of the result of a test; its frames may be a window of those of the known camera."""
    if known is None:
        return camera_of_sheet(sheet, told={"name": path.stem})
    rows, cols = known.frame_shape
    told: dict[str, Any] = {"name": path.stem, "rows": rows, "cols": cols, "bits": known.facts.get("bits")}
    if known.pitch_um is not None:
        told |= {"pitch_x_um": known.pitch_um[0], "pitch_y_um": known.pitch_um[1]}
    own = sheet.camera
    window = own.get("sensor_rows") is None and all(
        own.get(name) is None or own[name] <= whole for name, whole in (("rows", rows), ("cols", cols))
    )
    if window:
        sheet = replace(sheet, camera={**own, "rows": rows, "cols": cols})
    return camera_of_sheet(sheet, told={key: value for key, value in told.items() if value is not None})


def _joined(one: Camera, other: Camera) -> Camera:
    """The first camera with what the other one knows better, all elements of a source together."""
    mine, theirs = _by_source(one), _by_source(other)
    for source_id, elements in theirs.items():
        if source_id not in mine or _rank(elements) > _rank(mine[source_id]):
            mine[source_id] = elements
            if source_id == GAIN and _rank(theirs.get(CONVERTER, ())) >= _rank(mine.get(CONVERTER, ())):
                mine[CONVERTER], bits = theirs[CONVERTER], other.facts.get("bits")  # the gain belongs to its steps and its black
                one = replace(one, facts={**one.facts, **({} if bits is None else {"bits": bits})})
    ordered = in_order(elements[0].source for elements in mine.values())
    facts = {**other.facts, **one.facts}
    chain = tuple(e for s in ordered for e in mine[s.id])
    return replace(one, chain=chain, pitch_um=one.pitch_um or other.pitch_um, facts=facts)


def _by_source(camera: Camera) -> dict[str, list[Element]]:
    found: dict[str, list[Element]] = {}
    for element in camera.chain:
        found.setdefault(element.source.id, []).append(element)
    return found


def _rank(elements: Sequence[Element]) -> int:
    return max((RANK[e.known_from] for e in elements), default=-1)


def _compared(one: Camera, other: Camera) -> list[Disagreement]:
    theirs = _by_source(other)
    found = []
    for element in one.chain:
        there = theirs.get(element.source.id, [])
        second = there[0] if len(there) == 1 else next((e for e in there if e.name == element.name), None)
        if second is None or not {element.known_from, second.known_from} <= TOLD or not (element.known_from or second.known_from):
            continue
        for name in type(element.params).model_fields:
            a, b = _value(element, name), _value(second, name)
            if a is None or b is None:
                continue
            u = float(np.hypot(a[1], b[1]))
            unit = element.source.units[name]
            mine, other_one = (e.known_from or DESCRIBED for e in (element, second))
            found.append(Disagreement(element.name, name, unit, a[0], b[0], mine, other_one, u))
    return found


def _value(element: Element, name: str) -> tuple[float, float] | None:
    """Value and standard uncertainty of a parameter; None where the description knows none."""
    if name in element.estimates.names:
        number = element.estimates[name]
        return None if number.kind != "value" else (number.value, number.u)
    states_u = element.known_from == "measured" and len(element.estimates) > 0
    value = told_values(element).get(name)
    if element.known_from not in TOLD or states_u or value is None:
        return None
    return value, UNSTATED_U_REL * abs(value)
