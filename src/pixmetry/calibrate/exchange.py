"""Camera models of OpenCV and COLMAP: written only where nothing is lost, or no more than was allowed.

OpenCV (and COLMAP's OPENCV family) goes from object to image with K1, K2, P1, P2, K3 and knows no shear; COLMAP counts pixels from the
corner of the top-left pixel, so that its principal point is half a pixel greater. Neither has a place for uncertainties.

References
----------
OpenCV, module calib3d, "Camera Calibration and 3D Reconstruction"; COLMAP, src/colmap/sensor/models.h and the format of cameras.txt.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, CameraModel, Direction, Sensor
from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError
from pixmetry.core.extras import import_extra

GRID = 33  # places along each side of the frame at which two models are compared
EXACT_PX = 1e-9
STORAGES = (".yaml", ".yml", ".xml", ".json")  # endings of files of OpenCV's FileStorage
OPENCV = ("c", "xp", "yp", "b1", "p1", "p2", "k1", "k2", "k3")  # what its five coefficients hold
COLMAP: dict[str, tuple[str, ...]] = {  # by name: our parameters that it holds, besides c, xp and yp
    "SIMPLE_PINHOLE": (),
    "PINHOLE": ("b1",),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("b1", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("b1", "k1", "k2", "p1", "p2", "k3"),
}


@dataclass(frozen=True)
class Converted:
    """A model in another form.

    Parameters
    ----------
    model : CameraModel
    largest_px : float
        How far apart the two models see a point at most, over the frame; 0 where the form is exact.
    """

    model: CameraModel
    largest_px: float


def converted(model: CameraModel, direction: Direction, names: tuple[str, ...] = NAMES) -> Converted:
    """The model in another direction, or with fewer parameters: fitted all over the frame by least squares.

    Parameters
    ----------
    model : CameraModel
    direction : {"image_to_object", "object_to_image"}
    names : tuple of str
        Parameters the new form has; the others are 0.

    Returns
    -------
    Converted

    Raises
    ------
    InputError
        If the model cannot be inverted all over the frame.
    """
    kept = np.isin(NAMES, names)
    if direction == model.direction and not model.values[~kept].any():
        return Converted(model, 0.0)
    from scipy.optimize import least_squares

    x, y = (v.ravel() for v in np.meshgrid(np.linspace(0, model.sensor.cols - 1, GRID), np.linspace(0, model.sensor.rows - 1, GRID)))
    u, v = model.direction_of(x, y)
    if not np.isfinite(u + v).all():
        remedy = "use fewer radial parameters, or targets nearer to the corners"
        raise InputError("the distortion has no inverse in a part of the frame", where=model.name, remedy=remedy)
    start = np.where(kept & np.isin(NAMES, ("c", "xp", "yp", "b1", "b2")), model.values, 0.0)
    if direction != model.direction:
        start[3:5] *= -1  # to first order
        start[0] *= 1 - start[3] * (direction == "image_to_object")
    new = replace(model, direction=direction, values=start)

    def at(values: np.ndarray) -> CameraModel:
        row = start.copy()
        row[kept] = values
        return replace(new, values=row)

    def misses(values: Array) -> Array:
        a, b = at(values).project(u, v)
        gaps: Array = np.nan_to_num(np.concatenate([a - x, b - y]), nan=1e3)
        return gaps

    def slopes(values: np.ndarray) -> np.ndarray:
        by = np.nan_to_num(at(values).projected(u, v)[3][:, :, kept])
        return np.concatenate([by[:, 0], by[:, 1]])

    fit = least_squares(misses, start[kept], slopes, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    miss = misses(fit.x).reshape(2, -1)
    return Converted(at(fit.x), float(np.hypot(*miss).max()))


def opencv_form(model: CameraModel, tolerance_px: float = 0.0) -> dict[str, Any]:
    """What OpenCV takes: ``camera_matrix`` (3, 3), ``distortion_coefficients`` (5,) k1, k2, p1, p2, k3, ``image_size`` (cols, rows).

    Parameters
    ----------
    model : CameraModel
    tolerance_px : float
        How much a point may move, anywhere in the frame, by what OpenCV has no place for: shear, radial terms beyond K3, the other
        direction. 0 refuses any loss.

    Raises
    ------
    InputError
        If more than that would be lost; it says what.
    """
    form = _held(model, OPENCV, tolerance_px, "OpenCV")
    fx, _, fy, cx, cy = vision_values(form)
    return {
        "image_size": (form.sensor.cols, form.sensor.rows),
        "camera_matrix": np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        "distortion_coefficients": np.array([form["k1"], form["k2"], form["p2"], form["p1"], form["k3"]]),
    }


def opencv_text(model: CameraModel, ending: str, tolerance_px: float = 0.0) -> str:
    """Camera of a file in OpenCV's FileStorage format.

    Parameters
    ----------
    model : CameraModel
    ending : {".yaml", ".yml", ".xml", ".json"}
    tolerance_px : float

    Raises
    ------
    InputError
        If the ending is another one, and as `opencv_form` does.
    """
    cv2 = import_extra("cv2")

    from pixmetry import __version__

    if ending.lower() not in STORAGES:
        raise InputError("not a file of OpenCV's storage", value=ending, allowed=", ".join(STORAGES))
    form = opencv_form(model, tolerance_px)
    storage = cv2.FileStorage(ending.lower(), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("written_by", f"pixmetry {__version__}")
    storage.write("image_width", int(form["image_size"][0]))
    storage.write("image_height", int(form["image_size"][1]))
    storage.write("camera_matrix", form["camera_matrix"])
    storage.write("distortion_coefficients", form["distortion_coefficients"].reshape(1, 5))
    return str(storage.releaseAndGetString())


def write_opencv(model: CameraModel, path: str | Path, tolerance_px: float = 0.0) -> Path:
    """Write a file for OpenCV's FileStorage (.yaml, .yml, .xml or .json), replacing one of that name; raises like `opencv_text`."""
    target = Path(path)
    target.write_text(opencv_text(model, target.suffix, tolerance_px), encoding="utf-8")
    return target


def read_opencv(path: str | Path, pitch_um: tuple[float, float] | None = None) -> CameraModel:
    """Read a calibration that OpenCV's FileStorage holds.

    The usual names are understood: camera_matrix, cameraMatrix or K; distortion_coefficients, dist_coeffs or D; image_width, image_height.

    Parameters
    ----------
    path : path
    pitch_um : (float, float), optional
        Pixel pitches, to have the principal distance in millimetres.

    Raises
    ------
    InputError
        If the file cannot be read, or holds what would be lost here: a fisheye or rational model, thin prisms, a tilted sensor.
    """
    cv2 = import_extra("cv2")

    source = Path(path)
    try:
        storage = cv2.FileStorage(str(source), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError):  # the latter is what its constructor makes of the former
        storage = None
    if storage is None or not storage.isOpened():
        raise InputError("not a file of OpenCV's storage", where=str(source), allowed="YAML, XML or JSON as cv2.FileStorage writes it")

    def node(*names: str) -> Any:
        found = [storage.getNode(name) for name in names if not storage.getNode(name).empty()]
        if not found:
            raise InputError(f"{names[0]} is missing", where=str(source), allowed=" or ".join(names))
        return found[0]

    matrix = np.asarray(node("camera_matrix", "cameraMatrix", "CameraMatrix", "K").mat(), float)
    lens = np.asarray(node("distortion_coefficients", "dist_coeffs", "distCoeffs", "D").mat(), float).ravel()
    size = int(node("image_width", "imageWidth", "width").real()), int(node("image_height", "imageHeight", "height").real())
    return model_of_opencv(matrix, lens, size, pitch_um, where=str(source))


def model_of_opencv(
    camera_matrix: np.ndarray,
    distortion: np.ndarray,
    image_size: tuple[int, int],
    pitch_um: tuple[float, float] | None = None,
    where: str = "camera",
) -> CameraModel:
    """The model of an OpenCV camera matrix (3, 3) and its 0, 4 or 5 coefficients; more only if they are 0. Raises like `read_opencv`."""
    k = np.asarray(camera_matrix, float)
    d = np.zeros(5)
    lens = np.asarray(distortion, float).ravel()
    if k.shape != (3, 3) or not np.isfinite(k).all() or not (k[0, 0] > 0 and k[1, 1] > 0):
        raise InputError("not a camera matrix", where=where, allowed="3 × 3 with positive focal lengths")
    if len(lens) not in (0, 4, 5, 8, 12, 14) or not np.isfinite(lens).all():
        raise InputError("not OpenCV's coefficients", where=where, value=lens.tolist(), allowed="0, 4, 5, 8, 12 or 14 numbers")
    if lens[5:].any():
        what = "a rational, thin-prism or tilted model, which pixmetry cannot represent"
        raise InputError(what, where=where, value=lens[5:].tolist(), allowed="k1, k2, p1, p2, k3; the others 0")
    d[: min(len(lens), 5)] = lens[:5]
    mx, my = (1.0, 1.0) if pitch_um is None else (pitch_um[0] / 1000, pitch_um[1] / 1000)
    sensor = Sensor(*image_size, *(pitch_um or (None, None)))
    c = k[1, 1] * my
    return CameraModel.of(
        sensor, "object_to_image", name="camera",
        c=c, xp=k[0, 2], yp=k[1, 2], b1=k[0, 0] * mx / c - 1, b2=k[0, 1] * mx / c, k1=d[0], k2=d[1], p2=d[2], p1=d[3], k3=d[4],
    )  # fmt: skip


def colmap_line(model: CameraModel, camera_id: int = 1, kind: str = "FULL_OPENCV", tolerance_px: float = 0.0) -> str:
    """The camera's line of COLMAP's cameras.txt.

    Parameters
    ----------
    model : CameraModel
    camera_id : int
    kind : str
        One of `COLMAP`.
    tolerance_px : float
        As in `opencv_form`.

    Raises
    ------
    InputError
        If there is no such kind, or more would be lost.
    """
    if kind not in COLMAP:
        raise InputError("no such camera model of COLMAP", where="kind", value=kind, allowed=", ".join(COLMAP))
    form = _held(model, ("c", "xp", "yp", *COLMAP[kind]), tolerance_px, f"COLMAP's {kind}")
    fx, _, fy, cx, cy = vision_values(form)
    if "b1" not in COLMAP[kind] and abs(fx - fy) * max(form.sensor.cols, form.sensor.rows) > EXACT_PX * fy:
        raise InputError(f"COLMAP's {kind} has one focal length", where=form.name, value=(fx, fy), remedy="take PINHOLE or OPENCV")
    focal = [fx, fy] if "b1" in COLMAP[kind] else [fx]
    lens = {"OPENCV": ("k1", "k2", "p2", "p1"), "FULL_OPENCV": ("k1", "k2", "p2", "p1", "k3")}.get(kind, COLMAP[kind])
    numbers = [*focal, cx + 0.5, cy + 0.5, *(form[n] for n in lens if n != "b1"), *([0.0] * 3 if kind == "FULL_OPENCV" else [])]
    return " ".join([str(camera_id), kind, str(form.sensor.cols), str(form.sensor.rows), *(repr(float(v)) for v in numbers)])


def model_of_colmap(line: str, pitch_um: tuple[float, float] | None = None) -> CameraModel:
    """The model of a line of COLMAP's cameras.txt.

    Raises
    ------
    InputError
        If the line cannot be read, or its model holds what would be lost here (fisheye, field of view, rational terms).
    """
    parts = line.split()
    counts = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "FULL_OPENCV": 12}
    try:
        kind, cols, rows, q = parts[1], int(parts[2]), int(parts[3]), [float(v) for v in parts[4:]]
    except (IndexError, ValueError):
        raise InputError("not a line of cameras.txt", where="COLMAP", value=line, allowed="CAMERA_ID MODEL WIDTH HEIGHT PARAMS…") from None
    if kind not in counts:
        raise InputError("a camera model that pixmetry cannot represent", where="COLMAP", value=kind, allowed=", ".join(counts))
    if len(q) != counts[kind]:
        raise InputError(f"{kind} has {counts[kind]} parameters", where="COLMAP", value=len(q))
    if "b1" not in COLMAP[kind]:
        q.insert(1, q[0])
    fx, fy, cx, cy = q[:4]
    lens = [*q[4:6], 0.0, 0.0][:2] + [0.0] * 2 if kind.endswith("RADIAL") else q[4:]
    lens = [lens[0], 0.0, 0.0, 0.0] if kind == "SIMPLE_RADIAL" else lens
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1.0]])
    return model_of_opencv(matrix, np.array(lens), (cols, rows), pitch_um, where="COLMAP")


def vision_values(model: CameraModel) -> tuple[float, float, float, float, float]:
    """fx, skew, fy, cx, cy of a model that goes from object to image, px."""
    c, (mx, my) = model["c"], model.sensor.per_px
    return c * (1 + model["b1"]) / mx, c * model["b2"] / mx, c / my, model["xp"], model["yp"]


def _held(model: CameraModel, names: tuple[str, ...], tolerance_px: float, who: str) -> CameraModel:
    """The model in a form that goes from object to image and has these parameters, if no more is lost than is allowed."""
    form = converted(model, "object_to_image", names)
    if form.largest_px <= max(tolerance_px, EXACT_PX):
        return form.model
    lost = [n for n in NAMES if n not in names and model[n]]
    about = [f"{who} has no place for {', '.join(lost)}"] if lost else []
    if model.direction == "image_to_object":
        about.append(f"{who} distorts from object to image, this model corrects from image to object")
    enough = np.ceil(100 * form.largest_px / (step := 10.0 ** np.floor(np.log10(form.largest_px)))) / 100 * step  # three digits, upwards
    kept = ",".join(n for n in names if n in ("c", "xp", "yp") or model[n])
    remedy = (
        f"allow it with tolerance_px={enough:.3g} (on the command line --may-lose-px {enough:.3g}), or calibrate with direction "
        f"object_to_image and free {kept}"
    )
    raise InputError(f"{'; '.join(about)}: up to {form.largest_px:.2g} px would be lost", where=model.name, remedy=remedy)
