"""Start values of a camera from another calibration: a `calibration.json`, a file of OpenCV, or COLMAP's cameras.txt."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pixmetry.calibrate.bundle.model import TEN, CameraModel, Direction, Sensor
from pixmetry.calibrate.exchange import converted, model_of_colmap, read_opencv, vision_values
from pixmetry.calibrate.files.record import stored_cameras
from pixmetry.calibrate.project.tables import first_few
from pixmetry.core.config import read_text
from pixmetry.core.errors import InputError

ENDINGS = (".json", ".yaml", ".yml", ".xml", ".txt")


def read_start(path: Path, name: str) -> CameraModel:
    """The camera that a file holds; of several the one of this name (COLMAP: CAMERA_ID).

    Raises
    ------
    InputError
        If the file cannot be read, or does not say which camera is meant.
    """
    if path.suffix.lower() not in ENDINGS:
        allowed = "calibration.json, a file of OpenCV's storage (.yaml, .yml, .xml, .json), or COLMAP's cameras.txt"
        raise InputError("no start values can be read from such a file", where=str(path), value=path.suffix, allowed=allowed)
    if path.suffix.lower() == ".txt":
        lines = [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
        return _of_name({line.split()[0]: line for line in lines}, name, path, model_of_colmap)
    if path.suffix.lower() == ".json" and _is_ours(path):
        return _of_name({model.name: model for model in stored_cameras(path)}, name, path, lambda model: model)
    return read_opencv(path)


def _is_ours(path: Path) -> bool:
    try:
        return str(json.loads(read_text(path)).get("schema", "")).startswith("pixmetry/")
    except (ValueError, AttributeError):
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
    names = (*TEN, *(name for name in ("k4", "k5") if model[name]))
    if model.sensor.per_px != sensor.per_px:
        seen = converted(model, "object_to_image", names).model
        fx, skew, fy, xp, yp = vision_values(seen)
        mx, c = sensor.per_px[0], fy * sensor.per_px[1]
        linear = {"c": c, "xp": xp, "yp": yp, "b1": fx * mx / c - 1, "b2": skew * mx / c}
        model = replace(seen, sensor=sensor).with_values(**linear)  # from object to image the lens has no unit
    return converted(model, wanted, names).model
