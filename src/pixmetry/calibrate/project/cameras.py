"""The cameras of a project: size and pitch from a preset, start values from the project or from another calibration.

That may be a `calibration.json`, a file of OpenCV, or COLMAP's cameras.txt. A preset's stored frames may have another grid of pixels than
its sensor: `stored_grid` says which.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, TEN, CameraModel, Direction, Sensor
from pixmetry.calibrate.exchange import converted, model_of_colmap, read_opencv, vision_values
from pixmetry.calibrate.files.imports import read_cameras
from pixmetry.calibrate.files.record import stored_cameras
from pixmetry.calibrate.lines.plumb_line import FREE
from pixmetry.calibrate.project.reader import Reader
from pixmetry.calibrate.project.schema import CameraEntry
from pixmetry.calibrate.project.tables import first_few
from pixmetry.camera.camera import Camera, load_camera
from pixmetry.camera.chain_order import Element
from pixmetry.core.config import read_text
from pixmetry.core.errors import InputError
from pixmetry.files.files import find_file

Pitch = tuple[float | None, float | None]
MIRRORED = ("b2", "p2", "s3", "s4")  # with y the other way round they change their sign, in both directions; yp is a place
CLOCK, READ_OUT, WINDOW = "grabber.sampling_clock", "sensor.read_out", "grabber.window_offset"
ENDINGS = (".json", ".yaml", ".yml", ".xml", ".txt", ".cameramodel", ".dat", ".cal")


@dataclass(frozen=True)
class Described:
    """One camera of a project.

    Parameters
    ----------
    model : CameraModel
        Start values; c is 0 where it is not known.
    preset : Camera or None
        Whose size and pitch it has.
    start : CameraModel or None
        What start values were taken from.
    where : str
        The project with its line, for messages.
    """

    model: CameraModel
    preset: Camera | None
    start: CameraModel | None
    where: str

    def check(self, size: Sequence[int], where: str = "", what: str = "the pictures have") -> None:
        """Refuse a frame that is not that of the preset, or of the calibration the start values are from.

        Raises
        ------
        InputError
            With both sizes.
        """
        if self.preset is not None:
            check_size(self.preset, size, where or self.where, what)
        if self.start is not None and tuple(size) != (self.start.sensor.cols, self.start.sensor.rows):
            allowed = f"{self.start.sensor.cols} x {self.start.sensor.rows} pixels"
            what, remedy = f"{what} another size than the camera of start_from", "take a calibration of the same frames"
            raise InputError(what, where=where or self.where, value=f"{size[0]} x {size[1]} pixels", allowed=allowed, remedy=remedy)


def described(entry: CameraEntry, reader: Reader, k: int, *, straight: bool = False, upwards: bool = False) -> Described:
    """Read what a project says of a camera.

    Parameters
    ----------
    entry : CameraEntry
    reader : Reader
    k : int
        Its number in the project.
    straight : bool
        It is calibrated from straight lines.
    upwards : bool
        Its image coordinates have y up: so the signs of B2 and P2 are meant.

    Raises
    ------
    InputError
        If a file or preset cannot be used, sizes differ, or c is to be held without a value.
    """
    preset = None if entry.camera is None else _preset(entry.camera, reader, k)
    start = None if entry.start_from is None else _start(entry, reader, k)
    cols, rows = entry.cols, entry.rows
    pitch: Pitch = (entry.pitch_x_um or entry.pitch_um, entry.pitch_y_um or entry.pitch_um)
    if preset is not None:
        grid = stored_grid(preset)
        cols, rows = cols or grid.cols, rows or grid.rows
        pitch = pitch if pitch[0] is not None else grid.pitch_um or (None, None)
    if start is not None:
        cols, rows = cols or start.sensor.cols, rows or start.sensor.rows
        pitch = pitch if pitch[0] is not None else (start.sensor.pitch_x_um, start.sensor.pitch_y_um)
    where = reader.where("cameras", k)
    if entry.c_mm is not None and pitch[0] is None:
        remedy = "add `pitch_um: ...` (--pixel-um), or give c_px"
        raise InputError("c_mm, but no pitch", where=where, allowed="c_mm with pitch_um, or c_px", remedy=remedy)
    sensor = Sensor(cols or 1, rows or 1, *pitch)  # the size of pictures is told by themselves
    model = replace(_model(entry, sensor, start, straight, upwards), interface=entry.interface or _interface_of(preset))
    out = Described(model, preset, start, where)
    if cols is not None:
        out.check((sensor.cols, sensor.rows), what="the project says")
    if not straight and not out.model["c"] > 0 and not out.model.free[0]:
        raise InputError("c is held fixed, but has no value", where=where, remedy="give c_mm or c_px, or add c to `free`")
    return out


def _model(entry: CameraEntry, sensor: Sensor, start: CameraModel | None, straight: bool, upwards: bool) -> CameraModel:
    given = entry.model_fields_set
    direction = entry.direction if start is None or "direction" in given else None
    based = CameraModel.of(sensor, entry.direction, projection=entry.projection) if start is None else on_sensor(start, sensor, direction)
    if "projection" in given and based.projection != entry.projection:
        allowed, remedy = f"projection: {based.projection}", "leave projection or start_from out"
        raise InputError("start values of another projection", where=entry.name, value=entry.projection, allowed=allowed, remedy=remedy)
    values = {name: getattr(entry, name) for name in NAMES[3:] if name in given}
    values |= {name: -values[name] for name in MIRRORED if upwards and name in values}
    values |= {name: value for name, value in (("xp", entry.xp_px), ("yp", entry.yp_px)) if value is not None}
    c = entry.c_mm if entry.c_mm is not None else entry.c_px * sensor.per_px[0] if entry.c_px is not None else based["c"]
    all_values = dict(zip(NAMES, based.values.tolist(), strict=True)) | values | {"c": c}
    free = entry.free if entry.free is not None else FREE if straight else TEN
    return CameraModel.of(sensor, based.direction, free, entry.name, based.projection, **all_values)


def _interface_of(preset: Camera | None) -> str | None:
    """How the frames of a preset come, where it says so, or has a frame grabber's clock."""
    if preset is None:
        return None
    told = preset.facts.get("interface")
    if told in ("digital", "analogue"):
        return str(told)
    return "analogue" if any("digital" not in e.source.applies_to and "analogue" in e.source.applies_to for e in preset.chain) else None


def _preset(name: str, reader: Reader, k: int) -> Camera:
    beside = reader.folder / name
    try:
        camera = load_camera(beside if beside.is_file() else name)
    except InputError as problem:
        where = problem.where if beside.is_file() else reader.where("cameras", k, "camera")
        raise InputError(problem.what, where=where, value=problem.value or name, allowed=problem.allowed, remedy=problem.remedy) from None
    if beside.is_file():
        reader.files.append(beside)
    return camera


def _start(entry: CameraEntry, reader: Reader, k: int) -> CameraModel:
    assert entry.start_from is not None
    path = find_file(reader.folder, entry.start_from, reader.where("cameras", k, "start_from"))
    reader.files.append(path)
    return read_start(path, entry.name, (entry.cols, entry.rows) if entry.cols and entry.rows else None)


@dataclass(frozen=True)
class StoredGrid:
    """The samples of a stored frame.

    Parameters
    ----------
    cols, rows : int
    pitch_um : (float, float) or None
        Distance of samples on the sensor; None where the sensor's pixel pitch is not known.
    changed : str
        What makes them others than the sensor's pixels; empty if they are the same.
    """

    cols: int
    rows: int
    pitch_um: tuple[float, float] | None
    changed: str


def stored_grid(camera: Camera) -> StoredGrid:
    """The grid of the frames that a camera stores.

    A grabber that samples with a clock f_s of its own has samples f_pixel/f_s pixels apart along the row (R. Lenz, D. Fritsch, ISPRS
    J. Photogramm. 45, 1990, 90); single fields have rows two pixels apart.
    """
    rows, cols = camera.output_shape
    scale, changes = np.ones(2), []
    for element in camera.active:
        step, change = _changed(camera, element)
        scale *= step
        changes += [change] * bool(change)
    if not changes and (rows, cols) != camera.frame_shape:
        changes.append(f"it stores {cols} x {rows} of the sensor's {camera.frame_shape[1]} x {camera.frame_shape[0]} pixels")
    pitch = None if camera.pitch_um is None else (camera.pitch_um[0] * float(scale[0]), camera.pitch_um[1] * float(scale[1]))
    return StoredGrid(cols, rows, pitch, " and ".join(changes))


def _changed(camera: Camera, element: Element) -> tuple[tuple[float, float], str]:
    """Distance of samples in x and y, in samples of before; and what an element does to the grid, in words."""
    params, name = element.params, element.source.id
    if name == CLOCK and params != element.source.neutral:
        ratio = camera.pixel_clock_hz / (1e6 * params.clock_mhz) if params.clock_mhz else 1.0
        if ratio != 1 or params.start_ns:
            return (ratio, 1.0), f"its grabber samples with a clock of its own ({ratio:.6g} pixels a sample)"
    if name == READ_OUT and params.mode == "field":
        return (1.0, 2.0), "it stores single fields (rows two pixels apart)"
    if name == WINDOW and (params.inactive_rows or params.row_offset or params.col_offset):
        row, col = params.row_offset, params.col_offset
        return (1.0, 1.0), f"its grabber stores a window that starts at row {row}, column {col}"
    return (1.0, 1.0), ""


def check_size(camera: Camera, size: Sequence[int], where: str, what: str) -> None:
    """Refuse pictures or a project whose frame is not the one that the camera stores.

    Raises
    ------
    InputError
        With both sizes.
    """
    rows, cols = camera.output_shape
    if tuple(size) != (cols, rows):
        remedy = "name the camera that took them, or leave the preset out"
        found, allowed = f"{size[0]} x {size[1]} pixels", f"{cols} x {rows} pixels"
        raise InputError(f"{what} another size than the frames of {camera.name}", where=where, value=found, allowed=allowed, remedy=remedy)


def read_start(path: Path, name: str, size: tuple[int, int] | None = None) -> CameraModel:
    """The camera that a file holds; of several the one of this name (COLMAP: CAMERA_ID).

    Parameters
    ----------
    path : Path
    name : str
    size : (int, int), optional
        Columns and rows of the frame, for a file that does not say them.

    Raises
    ------
    InputError
        If the file cannot be read, or does not say which camera is meant.
    """
    if path.suffix.lower() not in ENDINGS:
        allowed = (
            "calibration.json, COLMAP's cameras.txt, a file of OpenCV (.yaml, .yml, .xml, .json), ROS, Kalibr, mrcal, Metashape, HALCON "
            "(.dat, .cal), or a report of Australis or PhotoModeler (.txt)"
        )
        raise InputError("no start values can be read from such a file", where=str(path), value=path.suffix, allowed=allowed)
    others = read_cameras(path, size)
    if others is not None:
        return _of_name(others, name, path, lambda model: model)
    if path.suffix.lower() in (".dat", ".cal"):
        allowed = "ParGroup: Camera: Parameter, as write_cam_par writes"
        raise InputError("not the camera parameters of HALCON", where=str(path), allowed=allowed)
    if path.suffix.lower() == ".txt":
        lines = [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
        return _of_name({line.split()[0]: line for line in lines}, name, path, model_of_colmap)
    if path.suffix.lower() == ".json" and _is_ours(path):
        return _of_name({model.name: model for model in stored_cameras(path)}, name, path, lambda model: model)
    return read_opencv(path)


def _is_ours(path: Path) -> bool:
    try:
        return str(json.loads(read_text(path)).get("schema", "")).startswith("pixmetry/")
    except (ValueError, AttributeError, RecursionError):
        return False


def _of_name(cameras: Mapping[str, Any], name: str, path: Path, made: Callable[[Any], CameraModel]) -> CameraModel:
    if name not in cameras and len(cameras) != 1:
        remedy = "give the project's camera the name that it has there"
        raise InputError(f"holds no camera '{name}'", where=str(path), allowed=first_few(cameras) or "at least one", remedy=remedy)
    return made(cameras.get(name, next(iter(cameras.values()))))


def on_sensor(model: CameraModel, sensor: Sensor, direction: Direction | None) -> CameraModel:
    """The model on another description of the same pixel grid, in a direction (None: its own).

    Another direction, and another pitch where corrections are in millimetres, are fitted all over the frame: good for start values.

    Raises
    ------
    InputError
        If the model cannot be inverted all over the frame, or has no principal distance and would have to be.
    """
    wanted = direction or model.direction
    if model.sensor.per_px == sensor.per_px and model.direction == wanted:
        return model
    if not model["c"] > 0:
        what = "start values without a principal distance cannot take another direction or pitch"
        remedy = f"write `direction: {model.direction}`, and the pitch that they were found with"
        raise InputError(what, where=model.name, remedy=remedy)
    names = (*TEN, *(name for name in NAMES if name not in TEN and model[name]))
    if model.sensor.per_px != sensor.per_px:
        seen = converted(model, "object_to_image", names).model
        fx, skew, fy, xp, yp = vision_values(seen)
        mx, c = sensor.per_px[0], fy * sensor.per_px[1]
        linear = {"c": c, "xp": xp, "yp": yp, "b1": fx * mx / c - 1, "b2": skew * mx / c}
        model = replace(seen, sensor=sensor).with_values(**linear)  # from object to image the lens has no unit
    return converted(model, wanted, names).model
