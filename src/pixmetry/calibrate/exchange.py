"""Camera models of OpenCV and COLMAP: written only where nothing is lost, or no more than was allowed.

OpenCV (and COLMAP's OPENCV family) goes from object to image with K1, K2, P1, P2, K3, a denominator and prisms, and knows no shear; its
fisheye is equidistant, with K1 … K4. COLMAP counts pixels from the corner of the top-left pixel, so that its principal point is half a
pixel greater. Neither has a place for uncertainties.

References
----------
OpenCV, module calib3d, "Camera Calibration and 3D Reconstruction"; COLMAP, src/colmap/sensor/models.h and the format of cameras.txt.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, POWERS, CameraModel, Direction, Projection, Sensor
from pixmetry.core.arrays import Array
from pixmetry.core.config import read_text
from pixmetry.core.door import MOST_SETTINGS_BYTES, one_sentence
from pixmetry.core.errors import InputError
from pixmetry.core.extras import import_extra

GRID = 33  # places along each side of the frame at which two models are compared
EXACT_PX = 1e-9
LEAST_SHARE = 0.5  # of the frame in which a lens must have an inverse, to be compared
PROJECTED_PX = 5.0  # apart at most, where a model stands for one of another projection
DEEPEST = 200  # levels and blanks before a line, of a file of OpenCV; a matrix has two or three
STORAGES = (".yaml", ".yml", ".xml", ".json")  # endings of files of OpenCV's FileStorage
OPENCV = ("c", "xp", "yp", "b1", "p1", "p2", "k1", "k2", "k3")  # what its five coefficients hold,
RATIONAL = (*OPENCV, "d1", "d2", "d3")  # what eight hold, and
PRISMATIC = (*RATIONAL, "s1", "s2", "s3", "s4")  # what twelve hold
FISHEYE = ("c", "xp", "yp", "b1", "k1", "k2", "k3", "k4")  # what its fisheye holds
ORDER = ("k1", "k2", "p2", "p1", "k3", "d1", "d2", "d3", "s1", "s2", "s3", "s4")  # our names of its coefficients
COLMAP: dict[str, tuple[str, ...]] = {  # by name: our parameters that it holds, besides c, xp and yp
    "SIMPLE_PINHOLE": (),
    "PINHOLE": ("b1",),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("b1", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("b1", "k1", "k2", "p1", "p2", "k3", "d1", "d2", "d3"),
    "OPENCV_FISHEYE": ("b1", "k1", "k2", "k3", "k4"),
}


@dataclass(frozen=True)
class Converted:
    """A model in another form.

    Parameters
    ----------
    model : CameraModel
    largest_px : float
        How far apart the two models see a point at most, over the frame; 0 where the form is exact.
    share : float
        Of the frame that was compared: in the rest the distortion has no inverse.
    """

    model: CameraModel
    largest_px: float
    share: float = 1.0


class Known(NamedTuple):
    """How well the parameters of a camera are known: names of the estimated ones, and their covariance."""

    names: tuple[str, ...]
    covariance: np.ndarray


def converted(
    model: CameraModel,
    direction: Direction,
    names: tuple[str, ...] = NAMES,
    projection: Projection | None = None,
    sensor: Sensor | None = None,
) -> Converted:
    """The model in another direction or projection, or with fewer parameters: fitted all over the frame by least squares.

    Parameters
    ----------
    model : CameraModel
    direction : {"image_to_object", "object_to_image"}
    names : tuple of str
        Parameters the new form has; the others are 0.
    projection : str, optional
        By default that of the model.
    sensor : Sensor, optional
        Likewise; with another pitch.

    Returns
    -------
    Converted

    Raises
    ------
    InputError
        If the model cannot be inverted in half of the frame, or is a fisheye that another projection cannot stand for.
    """
    kept = np.isin(NAMES, names)
    projection, sensor = projection or model.projection, sensor or model.sensor
    if (direction, projection, sensor) == (model.direction, model.projection, model.sensor) and not model.values[~kept].any():
        return Converted(model, 0.0)
    from scipy.optimize import least_squares

    x, y = (v.ravel() for v in np.meshgrid(np.linspace(0, model.sensor.cols - 1, GRID), np.linspace(0, model.sensor.rows - 1, GRID)))
    u, v = model.direction_of(x, y)
    there = np.isfinite(u + v)
    if there.mean() < LEAST_SHARE:
        remedy = "use fewer radial parameters, or targets nearer to the corners"
        raise InputError("the distortion has no inverse in most of the frame", where=model.name, remedy=remedy)
    x, y, u, v = x[there], y[there], u[there], v[there]
    start = np.where(kept & np.isin(NAMES, ("c", "xp", "yp", "b1", "b2")), model.values, 0.0)
    if direction != model.direction:
        start[3:5] *= -1  # to first order
        start[0] *= 1 - start[3] * (direction == "image_to_object")
    new = replace(model, direction=direction, projection=projection, sensor=sensor, values=start)

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

    starts = [start]
    if projection == model.projection:  # strong corrections are not reached from none: from these, or their first terms turned round
        turned = direction != model.direction
        powers = np.array(POWERS) * (1 if direction == "image_to_object" else -1)
        lens = -model.values * model["c"] ** powers.astype(float) if turned else model.values
        starts.append(np.where(kept & np.isin(NAMES, ("k1", "p1", "p2") if turned else NAMES[5:]), lens, start))
    fits = [least_squares(misses, one[kept], slopes, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15) for one in starts]
    fit = min(fits, key=lambda one: one.cost)
    miss = misses(fit.x).reshape(2, -1)
    largest = float(np.hypot(*miss).max())
    if projection != model.projection and largest > PROJECTED_PX:  # a few terms of one projection do not stand for another
        what = f"a fisheye ({model.projection})" if projection == "perspective" else f"a {model.projection} lens"
        raise InputError(f"{what}, for which this form has no place", where=model.name, allowed=projection)
    return Converted(at(fit.x), largest, float(there.mean()))


def carried_covariance(model: CameraModel, form: CameraModel, known: Known, names: tuple[str, ...] = NAMES) -> Known:
    """Covariance of the parameters that a form of the model has, from that of the model's.

    A change of the model's parameters moves the image points of all directions; that of the form's which moves them alike, by least squares
    over the frame, is its derivative, as far as little is lost.

    Parameters
    ----------
    model, form : CameraModel
        As `converted` gives the second.
    known : Known
        Of the model.
    names : tuple of str
        Parameters of the form that may change.

    Returns
    -------
    Known
        Of those that the form has.
    """
    same = (model.direction, model.projection, model.sensor) == (form.direction, form.projection, form.sensor)
    if same and set(known.names) <= set(names):
        return known
    grid = np.linspace(0, model.sensor.cols - 1, GRID), np.linspace(0, model.sensor.rows - 1, GRID)
    u, v = model.direction_of(*(place.ravel() for place in np.meshgrid(*grid)))
    there = np.isfinite(u + v)
    own = [NAMES.index(name) for name in known.names]
    old = np.moveaxis(model.projected(u[there], v[there])[3], 2, 0)[own].reshape(len(own), -1)
    kept = [k for k, name in enumerate(NAMES) if name in names and (form.values[k] or name in known.names)]
    new = np.moveaxis(form.projected(u[there], v[there])[3], 2, 0)[kept].reshape(len(kept), -1)
    sound = np.isfinite(old).all(axis=0) & np.isfinite(new).all(axis=0)
    size = np.linalg.norm(new[:, sound], axis=1)
    by = np.linalg.lstsq((new[:, sound] / size[:, None]).T, old[:, sound].T, rcond=None)[0] / size[:, None]
    return Known(tuple(NAMES[k] for k in kept), by @ known.covariance @ by.T)


def opencv_form(model: CameraModel, tolerance_px: float = 0.0) -> dict[str, Any]:
    """What OpenCV takes: ``camera_matrix`` (3, 3), ``distortion_coefficients``, ``image_size`` (cols, rows), ``fisheye``.

    Coefficients are (5,) k1, k2, p1, p2, k3, or as many more as the model needs: (8,) with a denominator, (12,) with thin prisms; of a
    fisheye the (4,) of ``cv2.fisheye``.

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
    fisheye = model.projection != "perspective"
    names = FISHEYE if fisheye else opencv_names(model)
    form = held(model, names, tolerance_px, "OpenCV's fisheye" if fisheye else "OpenCV", "equidistant" if fisheye else "perspective")
    fx, _, fy, cx, cy = vision_values(form)
    return {
        "fisheye": fisheye,
        "image_size": (form.sensor.cols, form.sensor.rows),
        "camera_matrix": np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        "distortion_coefficients": np.array([form[name] for name in (FISHEYE[4:] if fisheye else ORDER[: len(names) - 4])]),
    }


def opencv_names(model: CameraModel) -> tuple[str, ...]:
    """Our parameters that the coefficients hold which OpenCV needs for a lens that is no fisheye."""
    return PRISMATIC if _uses(model, "s") else RATIONAL if _uses(model, "d") else OPENCV


def _uses(model: CameraModel, letter: str) -> bool:
    return any(value for name, value in zip(NAMES, model.values, strict=True) if name[0] == letter)


def opencv_covariance(model: CameraModel, form: dict[str, Any], known: Known) -> np.ndarray:
    """Covariance of the numbers that OpenCV has: fx, fy, cx, cy and the coefficients, in this order.

    Parameters
    ----------
    model : CameraModel
    form : dict
        `opencv_form` of it.
    known : Known
        How well the model's parameters are known.
    """
    d = form["distortion_coefficients"]
    lens = FISHEYE[4:] if form["fisheye"] else ORDER[: len(d)]
    names = ("c", "xp", "yp", "b1", *lens)
    projection: Projection = "equidistant" if form["fisheye"] else "perspective"
    own = converted(model, "object_to_image", names, projection).model
    of, covariance = carried_covariance(model, own, known, names)
    (mx, my), c, b1 = own.sensor.per_px, own["c"], own["b1"]
    slopes = {"c": (0, (1 + b1) / mx), "b1": (0, c / mx), "xp": (2, 1.0), "yp": (3, 1.0)} | {n: (4 + k, 1.0) for k, n in enumerate(lens)}
    by = np.zeros((4 + len(d), len(of)))
    for column, name in enumerate(of):
        row, slope = slopes[name]
        by[row, column] = slope
        if name == "c":
            by[1, column] = 1 / my
    return by @ covariance @ by.T


def opencv_text(model: CameraModel, ending: str, tolerance_px: float = 0.0, known: Known | None = None) -> str:
    """Camera of a file in OpenCV's FileStorage format.

    Parameters
    ----------
    model : CameraModel
    ending : {".yaml", ".yml", ".xml", ".json"}
    tolerance_px : float
    known : Known, optional
        How well it is known: ``std_dev_intrinsics`` (as of ``cv2.calibrateCameraExtended``) and ``covariance_intrinsics``.

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
    storage.write("distortion_coefficients", form["distortion_coefficients"].reshape(1, -1))
    if form["fisheye"]:
        storage.write("fisheye_model", 1)
    if known is not None and known.names:
        covariance = opencv_covariance(model, form, known)
        storage.write("std_dev_intrinsics", np.sqrt(np.diag(covariance)).reshape(-1, 1))
        storage.write("covariance_intrinsics", covariance)
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
        If the file cannot be read, or holds what would be lost here: a tilted sensor.
    """
    cv2 = import_extra("cv2")

    source = Path(path)
    _check_nesting(source)
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

    with one_sentence("not a camera of OpenCV", str(source), allowed="a matrix, its coefficients and the size of the frame"):
        matrix = np.asarray(node("camera_matrix", "cameraMatrix", "CameraMatrix", "K").mat(), float)
        lens = np.asarray(node("distortion_coefficients", "dist_coeffs", "distCoeffs", "D").mat(), float).ravel()
        size = int(node("image_width", "imageWidth", "width").real()), int(node("image_height", "imageHeight", "height").real())
        fisheye = not storage.getNode("fisheye_model").empty() and bool(storage.getNode("fisheye_model").real())
    return model_of_opencv(matrix, lens, size, pitch_um, where=str(source), fisheye=fisheye)


def _check_nesting(source: Path) -> None:
    """Refuse what lies so deep in each other that OpenCV's reader, which calls itself for each level, would end the process."""
    depth = most = 0
    for line in read_text(source, MOST_SETTINGS_BYTES).splitlines():
        most = max(most, len(line) - len(line.lstrip(" ")) if line.strip() else 0)
        for mark in re.findall(r"[\[{]|[\]}]|</?[A-Za-z_]", line):
            depth += 1 if mark in "[{" or (mark[0] == "<" and mark[1] != "/") else -1
            most = max(most, depth)
    if most > DEEPEST:
        raise InputError("nested too deep", where=str(source), allowed=f"up to {DEEPEST} levels", remedy="check the file")


def model_of_opencv(
    camera_matrix: np.ndarray,
    distortion: np.ndarray,
    image_size: tuple[int, int],
    pitch_um: tuple[float, float] | None = None,
    where: str = "camera",
    *,
    fisheye: bool = False,
) -> CameraModel:
    """The model of an OpenCV camera matrix (3, 3) and its 0, 4, 5, 8, 12 or 14 coefficients (the last two 0), or the four of its fisheye.

    Raises like `read_opencv`.
    """
    k = np.asarray(camera_matrix, float)
    lens = np.asarray(distortion, float).ravel()
    if k.shape != (3, 3) or not np.isfinite(k).all() or not (k[0, 0] > 0 and k[1, 1] > 0):
        raise InputError("not a camera matrix", where=where, allowed="3 × 3 with positive focal lengths")
    if k[1, 0] or (k[2] != (0, 0, 1)).any():
        raise InputError("not a camera matrix", where=where, value=k.tolist(), allowed="0 at its second row's begin, and 0, 0, 1 below")
    if len(lens) not in (0, 4, 5, 8, 12, 14) or not np.isfinite(lens).all():
        raise InputError("not OpenCV's coefficients", where=where, value=lens.tolist(), allowed="0, 4, 5, 8, 12 or 14 numbers")
    if fisheye and len(lens) not in (0, 4):
        raise InputError("not the coefficients of OpenCV's fisheye", where=where, value=lens.tolist(), allowed="0 or 4 numbers")
    if lens[12:].any():
        what = "a tilted sensor, which pixmetry cannot represent"
        raise InputError(what, where=where, value=lens[12:].tolist(), allowed="the thirteenth and fourteenth coefficient 0")
    names = FISHEYE[4:] if fisheye else ORDER
    values = dict(zip(names, lens, strict=False))
    mx, my = (1.0, 1.0) if pitch_um is None else (pitch_um[0] / 1000, pitch_um[1] / 1000)
    sensor = Sensor(*image_size, *(pitch_um or (None, None)))
    c = k[1, 1] * my
    return CameraModel.of(
        sensor, "object_to_image", name="camera", projection="equidistant" if fisheye else "perspective",
        c=c, xp=k[0, 2], yp=k[1, 2], b1=k[0, 0] * mx / c - 1, b2=k[0, 1] * mx / c, **values,
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
    projection: Projection = "equidistant" if kind == "OPENCV_FISHEYE" else "perspective"
    form = held(model, colmap_names(model, kind), tolerance_px, f"COLMAP's {kind}", projection)
    fx, _, fy, cx, cy = vision_values(form)
    if "b1" not in COLMAP[kind] and abs(fx - fy) * max(form.sensor.cols, form.sensor.rows) > EXACT_PX * fy:
        raise InputError(f"COLMAP's {kind} has one focal length", where=form.name, value=(fx, fy), remedy="take PINHOLE or OPENCV")
    focal = [fx, fy] if "b1" in COLMAP[kind] else [fx]
    lens = {"OPENCV": ORDER[:4], "FULL_OPENCV": ORDER[:8]}.get(kind, COLMAP[kind])
    numbers = [*focal, cx + 0.5, cy + 0.5, *(form[n] for n in lens if n != "b1")]
    return " ".join([str(camera_id), kind, str(form.sensor.cols), str(form.sensor.rows), *(repr(float(v)) for v in numbers)])


def colmap_names(model: CameraModel, kind: str) -> tuple[str, ...]:
    """Our parameters that a model of COLMAP is to hold: a denominator only if the lens has one."""
    return ("c", "xp", "yp", *(name for name in COLMAP[kind] if name[0] != "d" or _uses(model, "d")))


def model_of_colmap(line: str, pitch_um: tuple[float, float] | None = None) -> CameraModel:
    """The model of a line of COLMAP's cameras.txt.

    Raises
    ------
    InputError
        If the line cannot be read, or its model holds what would be lost here (field of view, other fisheyes).
    """
    parts = line.split()
    counts = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "FULL_OPENCV": 12, "OPENCV_FISHEYE": 8}
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
    return model_of_opencv(matrix, np.array(lens), (cols, rows), pitch_um, where="COLMAP", fisheye=kind == "OPENCV_FISHEYE")


def vision_values(model: CameraModel) -> tuple[float, float, float, float, float]:
    """fx, skew, fy, cx, cy of a model that goes from object to image, px."""
    c, (mx, my) = model["c"], model.sensor.per_px
    return c * (1 + model["b1"]) / mx, c * model["b2"] / mx, c / my, model["xp"], model["yp"]


def held(
    model: CameraModel,
    names: tuple[str, ...],
    tolerance_px: float,
    who: str,
    projection: Projection = "perspective",
    direction: Direction = "object_to_image",
    sensor: Sensor | None = None,
) -> CameraModel:
    """The model in a form of this direction that has these parameters, if no more is lost than is allowed.

    Raises
    ------
    InputError
        Otherwise; it says what ``who`` has no place for.
    """
    form = converted(model, direction, names, projection, sensor)
    if form.largest_px <= max(tolerance_px, EXACT_PX):
        return form.model
    pitched = sensor is not None and sensor != model.sensor
    lost = [n for n in NAMES if n not in names and model[n] and not (pitched and n == "b1")]
    about = [f"{who} has a width of the pixels in place of b1"] if pitched else []
    about += [f"{who} has no place for {', '.join(lost)}"] if lost else []
    if projection != model.projection:
        about.append(f"{who} is {projection}, this lens is {model.projection}")
    if model.direction != direction:
        ways = {"object_to_image": "distorts from object to image", "image_to_object": "corrects from image to object"}
        about.append(f"{who} {ways[direction]}, this model {ways[model.direction]}")
    enough = np.ceil(100 * form.largest_px / (step := 10.0 ** np.floor(np.log10(form.largest_px)))) / 100 * step  # three digits, upwards
    kept = ",".join(n for n in names if n in ("c", "xp", "yp") or model[n])
    remedy = (
        f"allow it with tolerance_px={enough:.3g} (on the command line --may-lose-px {enough:.3g}), or calibrate with direction "
        f"{direction} and free {kept}"
    )
    raise InputError(f"{'; '.join(about)}: up to {form.largest_px:.2g} px would be lost", where=model.name, remedy=remedy)
