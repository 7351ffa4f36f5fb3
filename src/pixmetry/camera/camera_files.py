"""Cameras as plain records and YAML files: written, read, built."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pixmetry.camera.chain_order import Element
from pixmetry.camera.unit_maps import MeasuredUnit, listing, read_unit_maps
from pixmetry.core.checksums import check_file
from pixmetry.core.errors import InputError

if TYPE_CHECKING:
    from pixmetry.camera.camera import Camera

SCHEMA = "pixmetry/camera/1"


def to_record(camera: Camera) -> dict[str, Any]:
    """Return the plain record that `load_camera` reads."""
    record: dict[str, Any] = {"schema": SCHEMA, "name": camera.name, "rows": camera.frame_shape[0], "cols": camera.frame_shape[1]}
    if camera.pitch_um is not None:
        record |= {"pitch_x_um": camera.pitch_um[0], "pitch_y_um": camera.pitch_um[1]}
    record |= {"exposure_s": camera.exposure_s, "temperature_c": camera.temperature_c, "unit_seed": camera.unit_seed}
    optional = ("warm_up_k", "warm_up_s", "pixel_clock_hz", "line_period_s")
    record |= {n: getattr(camera, n) for n in optional if getattr(camera, n) != type(camera).__dataclass_fields__[n].default}
    if camera.measured is not None and any(e.maps for e in camera.chain):
        rows, cols = camera.measured.frame_shape
        record["measured"] = {"unit_seed": camera.measured.unit_seed, "rows": rows, "cols": cols}
    record["facts"] = dict(camera.facts)
    record["chain"] = [
        {"source": e.source.id, **({"name": e.name} if e.name != e.source.id else {}), **({} if e.on else {"enabled": False})}
        | {"parameters": e.params.model_dump(mode="json")}
        | ({"maps": listing(e.maps)} if e.maps else {})
        for e in camera.chain
    ]
    return record


def pitch_values(pitch_um: tuple[float, float] | None) -> dict[str, float]:
    """What sources that know the pixel pitch take from their camera, by the names of their parameters."""
    return {} if pitch_um is None else {"pitch_x_um": pitch_um[0], "pitch_y_um": pitch_um[1], "pitch_um": pitch_um[0]}


def clock_values(record: Any) -> dict[str, float]:
    """What sources that know the read-out's clock take from their camera, where its file states one."""
    told = record.model_fields_set
    values = {"line_time_us": 1e6 * record.line_period_s} if "line_period_s" in told else {}
    return values | ({"pixel_time_ns": 1e9 / record.pixel_clock_hz} if "pixel_clock_hz" in told else {})


def build_camera(record: Mapping[str, Any], where: str = "camera", folder: str | Path | None = None) -> Camera:
    """Build a camera from its plain record.

    Parameters
    ----------
    record : mapping
    where : str
        For messages.
    folder : path, optional
        Where the archive of what was measured in its unit stands, for a record that names one.

    Raises
    ------
    InputError, ChainError
        With the place in the record that cannot be used.
    """
    from pixmetry.camera.camera import Camera
    from pixmetry.camera.camera_schema import CameraRecord
    from pixmetry.camera.catalogue import get_source
    from pixmetry.core.config import validate

    checked = validate(CameraRecord, record, where)
    elements = []
    pitch = None if checked.pitch_x_um is None else (checked.pitch_x_um, checked.pitch_y_um or checked.pitch_x_um)
    known = pitch_values(pitch) | clock_values(checked)  # unless a source says otherwise
    for i, entry in enumerate(checked.chain):
        source = get_source(entry.source, f"{where}, chain[{i}]")
        own = {name: value for name, value in known.items() if name in source.parameters.model_fields}
        params = source.make(own | entry.parameters, where=f"{where}, chain[{i}] {entry.source}")
        elements.append(Element(entry.name or entry.source, source, params, entry.enabled))
    wanted = {element.name: entry.maps for element, entry in zip(elements, checked.chain, strict=True) if entry.maps}
    measured = None
    if wanted:
        if checked.measured is None:
            raise InputError("maps of no unit", where=where, remedy="write `measured:` with unit_seed, rows and cols, or delete `maps:`")
        if folder is None or checked.measured.file is None:
            raise InputError("the measured maps of this camera are not given", where=where, remedy="load the camera from its file")
        measured = MeasuredUnit(checked.measured.unit_seed, (checked.measured.rows, checked.measured.cols))
        found = read_unit_maps(Path(folder) / checked.measured.file, wanted)
        elements = [replace(e, maps=found.get(e.name, {})) for e in elements]
    same = ("exposure_s", "temperature_c", "unit_seed", "facts", "warm_up_k", "warm_up_s", "pixel_clock_hz", "line_period_s")
    settings = {name: getattr(checked, name) for name in same}
    return Camera(checked.name, (checked.rows, checked.cols), tuple(elements), pitch, measured=measured, **settings)


def load_camera(path: str | Path) -> Camera:
    """Read a camera from its YAML file, or one of the presets by its name.

    Raises
    ------
    InputError, ChainError
        If there is no such file or preset, it cannot be used, or a result stands beside it that was written with another one.
    """
    from importlib.resources import files

    from pixmetry.core.config import load_yaml

    presets = {p.name.removesuffix(".yaml"): p for p in (files("pixmetry.camera") / "presets").iterdir() if p.name.endswith(".yaml")}
    if str(path) in presets:
        path = Path(str(presets[str(path)]))
    elif not Path(path).is_file():
        raise InputError("no such camera file or preset", value=str(path), allowed=f"a YAML file, or one of {', '.join(sorted(presets))}")
    else:
        check_file(path)
    return build_camera(load_yaml(path), str(path), Path(path).parent)
