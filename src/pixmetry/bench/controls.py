"""The controls of the page, made from what the records declare: parameters of the sources with unit and range, entries of a scenario."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from functools import lru_cache
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from pixmetry.bench.notes import NOTES
from pixmetry.bench.state import Layout, preset_names, sheet_names
from pixmetry.budget.scenario import Scenario
from pixmetry.camera.camera import Camera
from pixmetry.camera.catalogue import STAGES, sources, to_record
from pixmetry.camera.source import Source
from pixmetry.locate.estimators import AUTO, estimators

STAGE_TITLES = {
    "scene": "Object and light",
    "optics": "Lens",
    "sensor": "Sensor",
    "electronics": "Electronics",
    "cable": "Cable",
    "grabber": "Frame grabber",
    "processing": "Processing",
    "storage": "Storage",
}
# Of the camera itself, with the ranges that a page can offer: name, unit, lowest, highest, meaning.
OWN = (
    ("exposure_s", "s", 1e-6, 10.0, "exposure time"),
    ("temperature_c", "°C", -60.0, 120.0, "of the sensor when it has settled"),
    ("unit_seed", "", 0, 1000, "of fixed patterns: another number is another camera of the type"),
)
SHOWN_PARTS = ("target", "light", "motion", "state", "count", "calibration", "storage", "object", "goal")


def control_of(name: str, field: FieldInfo) -> dict[str, Any]:
    """Name, kind, unit and range of one value: a number (``float``, ``int``), ``bool``, ``choice``, or ``fixed`` where no control fits."""
    extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
    of, may_be_none = _without_none(field.annotation)
    limits = {n: getattr(m, n) for m in field.metadata for n in ("ge", "gt", "le", "lt") if getattr(m, n, None) is not None}
    control: dict[str, Any] = {"name": name, "unit": extra.get("unit", ""), "text": field.description or "", "none": may_be_none}
    if get_origin(of) is Literal:
        return control | {"kind": "choice", "choices": list(get_args(of))}
    if of is bool:
        return control | {"kind": "bool"}
    if of in (int, float):
        low, high = limits.get("ge", limits.get("gt")), limits.get("le", limits.get("lt"))
        return control | {"kind": of.__name__, "low": low, "high": high, "open_low": "gt" in limits, "open_high": "lt" in limits}
    return control | {"kind": "fixed"}


def _without_none(annotation: Any) -> tuple[Any, bool]:
    parts = [a for a in get_args(annotation) if a is not type(None)]
    if get_origin(annotation) is not Literal and len(parts) == 1 and len(get_args(annotation)) == 2:
        return parts[0], True
    return annotation, False


def source_record(source: Source) -> dict[str, Any]:
    """All that the page shows of a source, whatever the camera."""
    typical, bound = source.typical.model_dump(mode="json"), source.bound.model_dump(mode="json")
    controls = [control_of(n, f) | {"typical": typical[n], "bound": bound[n]} for n, f in source.parameters.model_fields.items()]
    for control in controls:
        control["unit"] = source.units[control["name"]]
    words = {n: getattr(source, n) for n in ("description", "equation", "typical_size", "advice", "leaves", "option", "essential")}
    lists = {"references": list(source.references), "controls": controls}
    return to_record(source) | words | lists | {"in_frames": source.forward is not None}


@lru_cache
def catalogue_record() -> dict[str, Any]:
    """All that the page knows before a camera is chosen."""
    return {
        "stages": [{"id": s, "title": STAGE_TITLES[s]} for s in STAGES],
        "sources": {s.id: source_record(s) for s in sources().values()},
        "scenario": {part: [control_of(n, f) for n, f in fields] for part, fields in _parts()},
        "own": [
            {"name": n, "unit": u, "low": low, "high": high, "text": text, "kind": type(high).__name__, "none": False}
            for n, u, low, high, text in OWN
        ],
        "estimators": [AUTO, *(name for name in estimators("disc") if name != AUTO)],
        "notes": [asdict(n) for n in NOTES],
        "presets": list(preset_names()),
        "sheets": list(sheet_names()),
    }


def _parts() -> Iterator[tuple[str, list[tuple[str, FieldInfo]]]]:
    for part in SHOWN_PARTS:
        model = Scenario.model_fields[part].annotation
        assert isinstance(model, type) and issubclass(model, BaseModel)
        yield part, list(model.model_fields.items())


def camera_record(layout: Layout) -> dict[str, Any]:
    """The chain of this camera with the values of its parameters, and the scenario with all defaults filled in."""
    described: Camera = layout.setting.described
    changed = set(layout.state.set)
    elements = [
        {
            "name": e.name,
            "source": e.source.id,
            "on": e.on,
            "essential": e.source.essential,
            "added": e.name in layout.state.add,
            "known_from": e.known_from,
            "values": e.params.model_dump(mode="json"),
            "changed": [p for p in type(e.params).model_fields if f"{e.name}.{p}" in changed],
        }
        for e in described.chain
    ]
    facts = {n: v for n, v in described.facts.items() if isinstance(v, str | int | float | bool)}
    return {
        "name": described.name,
        "rows": described.frame_shape[0],
        "cols": described.frame_shape[1],
        "out": list(layout.camera.output_shape),
        "pitch_um": described.pitch_um,
        "analogue": any(e.source.stage == "grabber" and e.source.id != "grabber.adc" for e in described.chain),
        "facts": facts,
        "own": {n: getattr(described, n) for n, *_ in OWN},
        "chain": elements,
        "scenario": {name: value for name, (value, _) in layout.scenario.told.items()},
        "place_px": list(layout.place),
    }
