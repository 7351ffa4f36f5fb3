"""Cameras from the files of other programs: ROS, Kalibr, mrcal, Metashape, HALCON, Australis and PhotoModeler.

OpenCV and COLMAP are in `pixmetry.calibrate.exchange`.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.exchange import model_of_opencv
from pixmetry.calibrate.files.photogrammetric import camera_of_halcon, cameras_of_australis, cameras_of_photomodeler
from pixmetry.core.config import load_yaml, read_text
from pixmetry.core.door import MOST_SETTINGS_BYTES, one_sentence
from pixmetry.core.errors import InputError

MRCAL = ("PINHOLE", "OPENCV4", "OPENCV5", "OPENCV8", "OPENCV12", "STEREOGRAPHIC")
ROS = {"plumb_bob": False, "rational_polynomial": False, "equidistant": True}
KEYS = ("distortion_model:", "distortion_coeffs:")  # of a YAML file of ROS, and of Kalibr
_OBSERVATIONS = re.compile(r"('optimization_inputs':\s*)b'[^'\\]*'")  # in base 85, which has neither quotes nor backslashes
METASHAPE = {"frame": "perspective", "fisheye": "equidistant", "equidistant_fisheye": "equidistant", "equisolid_fisheye": "equisolid"}


def read_cameras(path: str | Path, size: tuple[int, int] | None = None) -> dict[str, CameraModel] | None:
    """Cameras of a file by their names; None where it is of none of these programs.

    Parameters
    ----------
    path : path
    size : (int, int), optional
        Columns and rows of the frame, for a file that does not say them (PhotoModeler).

    Raises
    ------
    InputError
        If it is, but holds a model that has no place here, or something is missing.

    Examples
    --------
    >>> text = "{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [900.0, 905.0, 319.5, 239.5], 'imagersize': [640, 480]}"
    >>> written = Path("a.cameramodel").write_text(text)
    >>> [float(c) for c in read_cameras("a.cameramodel")["a"].c_px]
    [905.0, 905.0]
    """
    source = Path(path)
    ending = source.suffix.lower()
    if ending == ".json":  # none of these programs; a calibration of pixmetry may be long
        return None
    text = read_text(source) if ending == ".cameramodel" else read_text(source, MOST_SETTINGS_BYTES)
    with one_sentence("a camera file that cannot be read", str(source), remedy="write it again"):
        if ending == ".cameramodel":
            return {source.stem: _of_mrcal(ast.literal_eval(_of_settings(text, str(source))), str(source))}
        if ending == ".xml" and "<calibration>" in text and "opencv_storage" not in text:
            return {source.stem: _of_metashape(text, str(source))}
        if ending in (".dat", ".cal") and "ParGroup" in text:
            return {source.stem: camera_of_halcon(text, str(source))}
        if ending == ".txt" and "Camera Parameters" in text[:400]:
            return cameras_of_australis(text, str(source))
        if ending == ".txt" and "Camera Calibration Standard Deviations" in text:
            return cameras_of_photomodeler(text, str(source), size)
        if ending in (".yaml", ".yml") and not text.lstrip().startswith("%YAML") and any(key in text for key in KEYS):
            return _of_yaml(load_yaml(source), str(source))
    return None


def _of_settings(text: str, where: str) -> str:
    """A file of mrcal without remarks, and without the observations that it was made from, which may be most of it."""
    bare = _OBSERVATIONS.sub(r"\1b''", "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#")))
    if len(bare) > MOST_SETTINGS_BYTES:
        raise InputError("too long for a camera", where=where, allowed=f"up to {MOST_SETTINGS_BYTES >> 20} MiB beside its observations")
    return bare


def _of_mrcal(record: Mapping[str, Any], where: str) -> CameraModel:
    kind, q = record["lensmodel"].removeprefix("LENSMODEL_"), [float(value) for value in record["intrinsics"]]
    if kind not in MRCAL:
        raise InputError("a lens model of mrcal that pixmetry cannot represent", where=where, value=kind, allowed=", ".join(MRCAL))
    matrix = np.array([[q[0], 0, q[2]], [0, q[1], q[3]], [0, 0, 1.0]])
    cols, rows = (int(value) for value in record["imagersize"])
    model = model_of_opencv(matrix, np.array(q[4:]), (cols, rows), where=where)
    return replace(model, projection="stereographic") if kind == "STEREOGRAPHIC" else model


def _of_metashape(text: str, where: str) -> CameraModel:
    found = {node.tag: (node.text or "").strip() for node in ElementTree.fromstring(text)}
    if found.get("projection", "frame") not in METASHAPE:
        allowed = ", ".join(METASHAPE)
        raise InputError("a projection that pixmetry cannot represent", where=where, value=found["projection"], allowed=allowed)
    value = {name: float(number) for name, number in found.items() if name not in ("projection", "date")}
    sensor = Sensor(int(value["width"]), int(value["height"]))
    (x0, y0), f = sensor.centre, value["f"]
    lens: dict[str, Any] = {name: value.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2")}
    about: dict[str, Any] = {"xp": x0 + value.get("cx", 0.0), "yp": y0 + value.get("cy", 0.0)}
    about |= {name: value.get(name, 0.0) / f for name in ("b1", "b2")}
    if value.get("p3") or value.get("p4"):
        raise InputError("P3 and P4 have no place", where=where, allowed="P1 and P2", remedy="calibrate without them")
    projection: Any = METASHAPE[found.get("projection", "frame")]
    return CameraModel.of(sensor, "object_to_image", projection=projection, c=f, **about, **lens)


def _of_yaml(record: Mapping[str, Any], where: str) -> dict[str, CameraModel] | None:
    if "camera_matrix" in record and "distortion_model" in record:
        kind = record["distortion_model"]
        if kind not in ROS:
            raise InputError("a distortion model of ROS that pixmetry cannot represent", where=where, value=kind, allowed=", ".join(ROS))
        matrix = np.array(record["camera_matrix"]["data"], float).reshape(3, 3)
        lens = np.array(record["distortion_coefficients"]["data"], float)
        size = int(record["image_width"]), int(record["image_height"])
        name = str(record.get("camera_name", "camera"))
        return {name: replace(model_of_opencv(matrix, lens, size, where=where, fisheye=ROS[kind]), name=name)}
    if "cam0" not in record:
        return None
    out = {}
    for name in (key for key in record if str(key).startswith("cam")):
        one = record[name]
        kind = one["distortion_model"]
        if one["camera_model"] != "pinhole" or kind not in ("radtan", "equidistant", "none"):
            found, allowed = f"{one['camera_model']}, {kind}", "pinhole with radtan, equidistant or none"
            raise InputError("a camera model of Kalibr that pixmetry cannot represent", where=where, value=found, allowed=allowed)
        fx, fy, cx, cy = (float(value) for value in one["intrinsics"])
        matrix, lens = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array(one.get("distortion_coeffs", []), float)
        cols, rows = (int(value) for value in one["resolution"])
        out[str(name)] = replace(model_of_opencv(matrix, lens, (cols, rows), where=where, fisheye=kind == "equidistant"), name=str(name))
    return out
