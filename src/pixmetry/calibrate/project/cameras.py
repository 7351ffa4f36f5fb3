"""The cameras of a project: size and pitch from a preset, start values from the project or from another calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pixmetry.calibrate.bundle.model import NAMES, TEN, CameraModel, Sensor
from pixmetry.calibrate.lines.plumb_line import FREE
from pixmetry.calibrate.project.presets import check_size, stored_grid
from pixmetry.calibrate.project.reader import Reader
from pixmetry.calibrate.project.schema import CameraEntry
from pixmetry.calibrate.project.starts import on_sensor, read_start
from pixmetry.camera.camera import Camera, load_camera
from pixmetry.core.errors import InputError
from pixmetry.files.files import find_file

Pitch = tuple[float | None, float | None]
MIRRORED = ("b2", "p2")  # with y the other way round they change their sign, in both directions of the distortion; yp is a place


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
    start = None if entry.start_from is None else _start(entry.start_from, entry.name, reader, k)
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
    out = Described(_model(entry, sensor, start, straight, upwards), preset, start, where)
    if cols is not None:
        out.check((sensor.cols, sensor.rows), what="the project says")
    if not straight and not out.model["c"] > 0 and not out.model.free[0]:
        raise InputError("c is to be held, but has no value", where=where, remedy="give c_mm or c_px, or add c to `free`")
    return out


def _model(entry: CameraEntry, sensor: Sensor, start: CameraModel | None, straight: bool, upwards: bool) -> CameraModel:
    given = entry.model_fields_set
    direction = entry.direction if start is None or "direction" in given else None
    based = CameraModel.of(sensor, entry.direction) if start is None else on_sensor(start, sensor, direction)
    values = {name: getattr(entry, name) for name in NAMES[3:] if name in given}
    values |= {name: -values[name] for name in MIRRORED if upwards and name in values}
    values |= {name: value for name, value in (("xp", entry.xp_px), ("yp", entry.yp_px)) if value is not None}
    c = entry.c_mm if entry.c_mm is not None else entry.c_px * sensor.per_px[0] if entry.c_px is not None else based["c"]
    all_values = dict(zip(NAMES, based.values.tolist(), strict=True)) | values | {"c": c}
    free = entry.free if entry.free is not None else FREE if straight else TEN
    return CameraModel.of(sensor, based.direction, free, entry.name, **all_values)


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


def _start(file: str, name: str, reader: Reader, k: int) -> CameraModel:
    path = find_file(reader.folder, file, reader.where("cameras", k, "start_from"))
    reader.files.append(path)
    return read_start(path, name)
