"""Changes to a camera from the command line: ``NAME.PARAMETER=VALUE``, ``exposure_s=0.02``, and names of sources to switch off."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from difflib import get_close_matches
from typing import Any

from pixmetry.camera.camera import Camera, Element, in_order, pitch_values
from pixmetry.camera.catalogue import get_source, sources
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import InputError

PERIOD = "frame_period_s"  # stands among the facts of a camera


def parse_override(text: str) -> tuple[str, Any]:
    """Read ``KEY=VALUE``; the value is read as YAML reads it.

    Raises
    ------
    InputError
        If it has another form.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    key, equals, value = (part.strip() for part in text.partition("="))
    form = InputError("not a setting", value=text, allowed="NAME.PARAMETER=VALUE, such as grabber.adc.offset_dn=32, or exposure_s=0.02")
    if not (key and equals and value):
        raise form
    try:
        return key, YAML(typ="safe", pure=True).load(value)
    except (YAMLError, ValueError):
        raise form from None


def parse_overrides(texts: Iterable[str]) -> dict[str, Any]:
    """Read several settings; see `parse_override`.

    Raises
    ------
    InputError
        If one has another form, or two change the same value.
    """
    found: dict[str, Any] = {}
    for key, value in map(parse_override, texts):
        if key in found:
            raise InputError(f"{key} is set twice", value=[found[key], value], remedy="keep one of the two")
        found[key] = value
    return found


def changed_camera(camera: Camera, overrides: Mapping[str, Any] | None = None, off: Iterable[str] = ()) -> Camera:
    """Return the camera with some parameters changed and some sources switched off.

    Parameters
    ----------
    camera : Camera
    overrides : mapping
        By ``NAME.PARAMETER``, the name being that in the chain, or by the name of a value of the camera itself (``exposure_s``,
        ``temperature_c``, ``unit_seed``, ``frame_period_s``, …).
    off : iterable of str
        Names in the chain.

    Raises
    ------
    InputError
        If there is no such source or parameter, a value is out of range, or the source is switched off in the camera.
    """
    own: dict[str, Any] = {}
    by_source: dict[str, dict[str, Any]] = {}
    for key, value in (overrides or {}).items():
        name, _, parameter = key.rpartition(".")
        if name:
            by_source.setdefault(_known(camera, name, parameter), {})[parameter] = value
        else:
            own[key] = value
    for name in by_source:
        if not camera[name].on:
            raise InputError(f"{name} is switched off in {camera.name}", remedy="set `enabled: true` for it in the camera file")
    changed = {
        name: camera[name].source.make({**camera[name].params.model_dump(), **values}, where=f"{camera.name}.{name}")
        for name, values in by_source.items()
    }
    if changed:  # all at once: some only fit together
        camera = replace(camera, chain=tuple(e.with_params(changed.get(e.name, e.params)) for e in camera.chain))
    names = [_known(camera, name) for name in off]
    return _with_own(camera, own).switched(off=names)


def with_source(camera: Camera, source_id: str) -> Camera:
    """Return the camera with one more source, at its place in the chain, with parameters that change nothing where it has such.

    Raises
    ------
    InputError, ChainError
        If there is no such source, or it cannot stand in this chain.
    """
    source = get_source(source_id)
    known: dict[str, float] = pitch_values(camera.pitch_um)
    bits = next((e.params.bits for e in camera.active if e.source.produces is Kind.CODES), None)
    if bits is not None:
        known |= {"bits": bits, "reference_dn": 2.0**bits - 1}
    none = {} if source.neutral is None else source.neutral.model_dump()
    params = source.make({**none, **{name: value for name, value in known.items() if name in source.parameters.model_fields}})
    order = [s.id for s in in_order([*(e.source for e in camera.chain), source])]
    later = set(order[order.index(source.id) + 1 :])
    at = next((i for i, e in enumerate(camera.chain) if e.source.id in later), len(camera.chain))
    return replace(camera, chain=(*camera.chain[:at], Element(source.id, source, params), *camera.chain[at:]))


def _known(camera: Camera, name: str, parameter: str = "") -> str:
    if name in camera:
        return name
    there = [e.name for e in camera.chain]
    if name in sources():
        ids = [e.name for e in camera.chain if e.source.id == name]
        if ids:
            raise InputError(f"{name} has a name of its own in {camera.name}", allowed=", ".join(ids), remedy="use that name")
        raise InputError(
            f"{name} is not in the chain of {camera.name}",
            allowed=", ".join(there),
            remedy=f"add `- source: {name}` to the chain in the camera file",
        )
    near = get_close_matches(name, there, n=1, cutoff=0.6)
    if parameter and f"{name}.{parameter}" in there:
        remedy = f"write {name}.{parameter}.PARAMETER=VALUE; `pixmetry sources` explains the parameters"
        raise InputError(f"{name}.{parameter} is a source, not a parameter", remedy=remedy)
    remedy = f"did you mean {near[0]}?" if near else "use a name of the chain, or of the camera's own values without a point"
    raise InputError(f"{camera.name} has no source named {name!r}", allowed=", ".join(there), remedy=remedy)


def _with_own(camera: Camera, values: dict[str, Any]) -> Camera:
    """Change values of the camera itself, checked by the camera file's own rules."""
    from pixmetry.camera.camera_schema import CameraRecord
    from pixmetry.core.config import validate

    same = {f.name for f in fields(Camera)} & set(CameraRecord.model_fields) - {"name", "facts", "chain", "measured"}
    allowed = sorted(same | {"rows", "cols", "pitch_x_um", "pitch_y_um", PERIOD})
    for key in values:
        if key not in allowed:
            near = get_close_matches(key, allowed, n=1, cutoff=0.6)
            remedy = f"did you mean {near[0]}?" if near else "for a parameter of a source write NAME.PARAMETER=VALUE"
            raise InputError(f"{camera.name} has no value {key!r}", allowed=", ".join(allowed), remedy=remedy)
    period = values.pop(PERIOD, None)
    if period is not None:
        if isinstance(period, bool) or not isinstance(period, int | float) or not 0 < period < 1e9:
            raise InputError("the time from frame to frame cannot be used", where=PERIOD, value=period, allowed="a number above 0, in s")
        camera = replace(camera, facts={**camera.facts, PERIOD: float(period)})
    if not values:
        return camera
    record = camera.to_record()
    checked = validate(CameraRecord, {**record, "chain": [], **values}, camera.name)
    pitch = None if checked.pitch_x_um is None else (checked.pitch_x_um, checked.pitch_y_um or checked.pitch_x_um)
    whole: dict[str, Any] = {"frame_shape": (checked.rows, checked.cols), "pitch_um": pitch}
    changed = replace(camera, **whole, **{name: getattr(checked, name) for name in same})
    before, after = pitch_values(camera.pitch_um), pitch_values(pitch)
    for element in camera.chain:  # sources that had the camera's pitch follow it
        own = element.params.model_dump()
        moved = {name: after[name] for name in before if name in own and own[name] == before[name] != after.get(name, before[name])}
        if moved:
            changed = changed.with_parameters(element.name, **moved)
    return changed
