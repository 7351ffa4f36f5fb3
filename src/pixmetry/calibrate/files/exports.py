"""Cameras for other programs: each in the form that the program reads, with what is lost said in pixels.

A format is a function from cameras to texts. What it cannot hold beyond the pixels that may be lost is refused for that file alone; the
other files are written.

References
----------
ROS, sensor_msgs/CameraInfo and camera_calibration_parsers (the YAML file); Kalibr, wiki page "yaml formats" (camchain.yaml); mrcal, "Camera
model representation" (.cameramodel); Agisoft Metashape Professional user manual, appendix "Camera models"; MathWorks, cameraIntrinsics.
HALCON, Australis and PhotoModeler are in `pixmetry.calibrate.files.photogrammetric`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pixmetry import __version__
from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.calibrate.exchange import (
    EXACT_PX,
    OPENCV,
    RATIONAL,
    STORAGES,
    Converted,
    Known,
    colmap_line,
    colmap_names,
    converted,
    held,
    opencv_form,
    opencv_names,
    opencv_text,
    vision_values,
)
from pixmetry.calibrate.files.photogrammetric import (
    AUSTRALIS,
    DIVISION,
    HALCON,
    australis_text,
    halcon_text,
    photomodeler_text,
    square_affinity,
)
from pixmetry.calibrate.records import RigRecord
from pixmetry.core.errors import InputError
from pixmetry.files.output import Output, check_files, write_together

COLMAP_KINDS = ("PINHOLE", "OPENCV", "FULL_OPENCV")  # of COLMAP, the simplest that loses nothing is taken
COLMAP_HEAD = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
BY = f"pixmetry {__version__}"
# How a file that pixmetry wrote begins: no other one is replaced.
REMARK = re.compile(rb"# Written by pixmetry ")
YAML_MARK = re.compile(rb'%YAML[: ]1\.[0-9]\s+(---\s+)?written_by: "?pixmetry ')
OPENCV_MARKS = {
    ".yaml": YAML_MARK,
    ".yml": YAML_MARK,
    ".xml": re.compile(rb'<\?xml version="1\.0"\?>\s*<opencv_storage>\s*<written_by>"?pixmetry '),
    ".json": re.compile(rb'\{\s*"written_by": "pixmetry '),
}
XML_MARK = re.compile(rb'<\?xml version="1\.0" encoding="UTF-8"\?>\s*<!-- Written by pixmetry ')
MATLAB_MARK = re.compile(rb"% Written by pixmetry ")
AUSTRALIS_MARK = re.compile(rb"Australis Bundle Adjustment Results: Camera Parameters\s+Written by pixmetry ")
PHOTOMODELER_MARK = re.compile(rb"Status Report Tree\s+Project Name: written by pixmetry ")
RADTAN, EQUIDISTANT = ("c", "xp", "yp", "b1", "k1", "k2", "p1", "p2"), ("c", "xp", "yp", "b1", "k1", "k2", "k3", "k4")
METASHAPE = ("c", "xp", "yp", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
PHOTOGRAMMETRIC: dict[str, tuple[str, ...]] = {"halcon": HALCON, "australis": AUSTRALIS, "photomodeler": HALCON}
MATLAB = ("c", "xp", "yp", "b1", "b2", "k1", "k2", "k3", "p1", "p2")


@dataclass(frozen=True)
class Told:
    """What a format is told beside the cameras: the ending of its file, what may be lost, the rig, and how well cameras are known."""

    ending: str
    may_lose_px: float
    rig: RigRecord | None
    known: Mapping[str, Known]


@dataclass(frozen=True)
class Format:
    """One format.

    Parameters
    ----------
    title : str
        Name of the program, in sentences.
    endings : tuple of str
        That a file may have.
    together : bool
        Whether all cameras are in one file; otherwise each has a file of its own.
    text : callable
        Of (cameras, what else is told) the text of one file.
    marks : mapping of str to pattern
        By ending: how a file that was written here begins.
    """

    title: str
    endings: tuple[str, ...]
    together: bool
    text: Callable[[Sequence[CameraModel], Told], str]
    marks: Mapping[str, re.Pattern[bytes]]


@dataclass(frozen=True)
class Exported:
    """What `write_exports` wrote and did not.

    Parameters
    ----------
    sentences : tuple of str
        One for each camera in each file, with what it lost.
    refused : tuple of (Path, InputError)
        Files that were not written, and why.
    """

    sentences: tuple[str, ...]
    refused: tuple[tuple[Path, InputError], ...]


def ros_text(model: CameraModel, may_lose_px: float) -> str:
    """A camera_info file of ROS: plumb_bob, rational_polynomial or equidistant; R is the unit matrix, P the camera matrix."""
    form = opencv_form(model, may_lose_px)
    d = form["distortion_coefficients"]
    if len(d) == 12:
        form = opencv_form(held(model, RATIONAL, may_lose_px, "ROS"))
        d = form["distortion_coefficients"]
    kind = "equidistant" if form["fisheye"] else "rational_polynomial" if len(d) == 8 else "plumb_bob"
    K = form["camera_matrix"]
    cols, rows = form["image_size"]
    matrices = {
        "camera_matrix": K,
        "distortion_coefficients": d[None],
        "rectification_matrix": np.eye(3),
        "projection_matrix": np.column_stack([K, np.zeros(3)]),
    }
    lines = [f"# Written by {BY}", f"image_width: {cols}", f"image_height: {rows}", f"camera_name: {_word(model.name)}"]
    for name, matrix in matrices.items():
        lines += [f"{name}:", f"  rows: {matrix.shape[0]}", f"  cols: {matrix.shape[1]}", f"  data: {_listed(matrix.ravel())}"]
        lines += [f"distortion_model: {kind}"] if name == "camera_matrix" else []
    return "\n".join(lines) + "\n"


def kalibr_text(models: Sequence[CameraModel], may_lose_px: float, rig: RigRecord | None) -> str:
    """A camchain.yaml of Kalibr: pinhole with radtan or equidistant; T_cn_cnm1 in metres where the cameras are a rig."""
    lines = [f"# Written by {BY}"]
    frames = {} if rig is None else rig.frames()
    metre = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "um": 1e-6, "inch": 0.0254}
    for k, model in enumerate(models):
        fisheye = model.projection != "perspective"
        form = held(model, EQUIDISTANT if fisheye else RADTAN, may_lose_px, "Kalibr", "equidistant" if fisheye else "perspective")
        fx, _, fy, cx, cy = vision_values(form)
        names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p2", "p1")
        others = [i for i, other in enumerate(models) if i != k and {model.name, other.name} <= set(frames)]
        lines += [
            f"cam{k}:  # {_word(model.name)}",
            "  camera_model: pinhole",
            f"  intrinsics: {_listed([fx, fy, cx, cy])}",
            f"  distortion_model: {'equidistant' if fisheye else 'radtan'}",
            f"  distortion_coeffs: {_listed([form[name] for name in names])}",
            f"  resolution: [{form.sensor.cols}, {form.sensor.rows}]",
            f"  cam_overlaps: {others}",
            f"  rostopic: /cam{k}/image_raw",
        ]
        if k and rig is not None and {models[k - 1].name, model.name} <= set(frames):
            (R0, d0), (R1, d1) = frames[models[k - 1].name], frames[model.name]
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = R1 @ R0.T, R1 @ (d0 - d1) * metre[rig.unit]
            lines += ["  T_cn_cnm1:", *(f"  - {_listed(row)}" for row in T)]
    return "\n".join(lines) + "\n"


def mrcal_text(model: CameraModel, may_lose_px: float, rig: RigRecord | None) -> str:
    """A .cameramodel of mrcal: LENSMODEL_OPENCV5, 8 or 12, or LENSMODEL_STEREOGRAPHIC; the reference is the rig's first camera."""
    from scipy.spatial.transform import Rotation

    if model.projection == "stereographic":
        form, kind, lens = held(model, ("c", "xp", "yp", "b1"), may_lose_px, "mrcal", "stereographic"), "STEREOGRAPHIC", []
        fx, _, fy, cx, cy = vision_values(form)
    elif model.projection == "perspective":
        told = opencv_form(model, may_lose_px)
        lens = told["distortion_coefficients"].tolist()
        kind, K = f"OPENCV{len(lens)}", told["camera_matrix"]
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    else:
        allowed = "perspective or stereographic"
        raise InputError(f"mrcal has no place for a fisheye ({model.projection})", where=model.name, allowed=allowed, remedy="take another")
    turn, shift = np.zeros(3), np.zeros(3)
    if rig is not None and model.name in (frames := rig.frames()):
        R, d = frames[model.name]
        turn, shift = Rotation.from_matrix(R).as_rotvec(), -R @ d
    return (
        f"# Written by {BY}\n{{\n    'lensmodel': 'LENSMODEL_{kind}',\n    'intrinsics': {_listed([fx, fy, cx, cy, *lens])},\n"
        f"    'extrinsics': {_listed([*turn, *shift])},\n    'imagersize': [{model.sensor.cols}, {model.sensor.rows}],\n}}\n"
    )


def metashape_text(model: CameraModel, may_lose_px: float) -> str:
    """A calibration XML of Agisoft Metashape: frame or (equidistant) fisheye; its b1 and b2 are in pixels, cx and cy from the middle."""
    fisheye = model.projection != "perspective"
    form = held(model, METASHAPE, may_lose_px, "Metashape", "equidistant" if fisheye else "perspective")
    f, skew, fy, cx, cy = vision_values(form)
    x0, y0 = form.sensor.centre
    values = {
        "projection": "equidistant_fisheye" if fisheye else "frame", "width": form.sensor.cols, "height": form.sensor.rows,
        "f": fy, "cx": cx - x0, "cy": cy - y0, "b1": f - fy, "b2": skew, **{name: form[name] for name in METASHAPE[5:]},
    }  # fmt: skip
    rows = "".join(f"  <{name}>{value}</{name}>\n" for name, value in values.items())
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<!-- Written by {BY} -->\n<calibration>\n{rows}</calibration>\n'


def matlab_text(model: CameraModel, may_lose_px: float) -> str:
    """A script that makes MATLAB's cameraIntrinsics, which count pixels from 1."""
    form = held(model, MATLAB, may_lose_px, "MATLAB")
    fx, skew, fy, cx, cy = vision_values(form)
    radial, tangential = [form[name] for name in ("k1", "k2", "k3")], [form["p2"], form["p1"]]
    return (
        f"% Written by {BY}: {_word(model.name)}\n"
        f"intrinsics = cameraIntrinsics([{fx!r} {fy!r}], [{cx + 1!r} {cy + 1!r}], [{form.sensor.rows} {form.sensor.cols}], ...\n"
        f'    "RadialDistortion", [{" ".join(map(repr, radial))}], "TangentialDistortion", [{" ".join(map(repr, tangential))}], ...\n'
        f'    "Skew", {skew!r});\n'
    )


def colmap_text(models: Sequence[CameraModel], may_lose_px: float) -> str:
    """COLMAP's cameras.txt, each camera in the simplest model that holds it."""
    lines = [f"# Written by {BY}\n{COLMAP_HEAD}# Number of cameras: {len(models)}\n"]
    for k, model in enumerate(models):
        lines.append(f"# {' '.join(model.name.split())}\n{colmap_line(model, k + 1, _simplest(model)[0], may_lose_px)}\n")
    return "".join(lines)


def _simplest(model: CameraModel) -> tuple[str, Converted]:
    """COLMAP's simplest model that loses nothing, else the one with the most parameters; and what that loses."""
    if model.projection != "perspective":
        return "OPENCV_FISHEYE", _found("COLMAP", model)
    found = None
    for kind in COLMAP_KINDS:
        found = converted(model, "object_to_image", colmap_names(model, kind))
        if found.largest_px <= EXACT_PX:
            return kind, found
    assert found is not None
    return COLMAP_KINDS[-1], found


def _word(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name)


def _listed(values: Iterable[float]) -> str:
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"


def _marked(endings: Iterable[str], mark: re.Pattern[bytes] = REMARK) -> dict[str, re.Pattern[bytes]]:
    return dict.fromkeys(endings, mark)


FORMATS: dict[str, Format] = {
    "opencv": Format("OpenCV", STORAGES, False, lambda models, told: opencv_text(models[0], told.ending, told.may_lose_px,
                                                                                 told.known.get(models[0].name)), OPENCV_MARKS),
    "colmap": Format("COLMAP", (".txt",), True, lambda models, told: colmap_text(models, told.may_lose_px), _marked([".txt"])),
    "ros": Format("ROS", (".yaml", ".yml"), False, lambda models, told: ros_text(models[0], told.may_lose_px), _marked([".yaml", ".yml"])),
    "kalibr": Format("Kalibr", (".yaml", ".yml"), True, lambda models, told: kalibr_text(models, told.may_lose_px, told.rig),
                     _marked([".yaml", ".yml"])),
    "mrcal": Format("mrcal", (".cameramodel",), False, lambda models, told: mrcal_text(models[0], told.may_lose_px, told.rig),
                    _marked([".cameramodel"])),
    "metashape": Format("Metashape", (".xml",), False, lambda models, told: metashape_text(models[0], told.may_lose_px),
                        _marked([".xml"], XML_MARK)),
    "matlab": Format("MATLAB", (".m",), False, lambda models, told: matlab_text(models[0], told.may_lose_px),
                     _marked([".m"], MATLAB_MARK)),
    "halcon": Format("HALCON", (".dat", ".cal"), False, lambda models, told: halcon_text(models[0], told.may_lose_px),
                     _marked([".dat", ".cal"])),
    "australis": Format("Australis", (".txt",), True, lambda models, told: australis_text(models, told.may_lose_px, told.known),
                        _marked([".txt"], AUSTRALIS_MARK)),
    "photomodeler": Format("PhotoModeler", (".txt",), True, lambda models, told: photomodeler_text(models, told.may_lose_px, told.known),
                           _marked([".txt"], PHOTOMODELER_MARK)),
}  # fmt: skip


def check_exports(exports: Mapping[str, Path], folder: Path, sources: Iterable[Path] = ()) -> None:
    """Refuse names that files cannot be written to, before any work is done.

    Parameters
    ----------
    exports : mapping of str to Path
        By the names of `FORMATS`.
    folder : Path
        Of the results.
    sources : iterable of Path

    Raises
    ------
    InputError
        If a format is unknown, or a file has another ending, is a folder, lies in the folder of results, is one of the sources, or exists
        and was not written by an earlier export.
    """
    outputs = []
    for name, path in exports.items():
        if name not in FORMATS:
            raise InputError("no such format", where="export", value=name, allowed=", ".join(FORMATS))
        endings = FORMATS[name].endings
        if name != "colmap" and path.suffix.lower() not in endings:
            what = "not a file of OpenCV's storage" if name == "opencv" else f"not the ending of a file for {FORMATS[name].title}"
            raise InputError(what, where=str(path), allowed=", ".join(endings))
        if path.resolve().is_relative_to(folder.resolve()):
            remedy = "choose a folder beside it"
            raise InputError("lies in the folder of results, which is replaced as a whole", where=str(path), remedy=remedy)
        outputs.append(_output(name, path))
    check_files(outputs, sources)


def _output(name: str, path: Path) -> Output:
    marks = FORMATS[name].marks
    return Output(path, marks.get(path.suffix.lower(), next(iter(marks.values()))))


def write_exports(
    models: Iterable[CameraModel],
    exports: Mapping[str, Path],
    may_lose_px: float = 0.0,
    sources: Iterable[Path] = (),
    rig: RigRecord | None = None,
    known: Mapping[str, Known] | None = None,
) -> Exported:
    """Write each file that its format can hold; of those that exist, only earlier exports are replaced.

    Parameters
    ----------
    models : iterable of CameraModel
    exports : mapping of str to Path
        By the names of `FORMATS`. Where each camera has a file of its own, several have ``NAME`` before the ending.
    may_lose_px : float
        How far a point may move, anywhere in the frame, by what a program has no place for.
    sources : iterable of Path
        Files that must not be replaced.
    rig : RigRecord, optional
        How the cameras stand, for formats that say it.
    known : mapping of str to Known, optional
        How well the cameras are known, by their names, for formats that have a place for it.

    Returns
    -------
    Exported

    Raises
    ------
    InputError
        If the principal distance is not known, a file cannot be written, or another one would be replaced.
    """
    cameras = list(models)
    unknown = next((model.name for model in cameras if not model["c"] > 0), None)
    if unknown is not None:
        remedy = "calibrate with a test field, or give c_mm or c_px"
        raise InputError(
            "cannot be exported without a principal distance, which straight lines do not determine", where=unknown, remedy=remedy
        )
    outputs, texts, told, refused = [], [], [], []
    for name, path in exports.items():
        one = FORMATS[name]
        for place, own in [(path, cameras)] if one.together else _places(cameras, path):
            try:
                text = one.text(own, Told(path.suffix.lower(), may_lose_px, rig, known or {}))
                told += [_sentence(name, place, model, k) for k, model in enumerate(own)]
            except InputError as problem:
                refused.append((place, problem))
                continue
            outputs.append(_output(name, place))
            texts.append(text.encode())
    if texts:
        write_together(outputs, texts, sources)
    return Exported(tuple(told), tuple(refused))


def _places(cameras: list[CameraModel], path: Path) -> list[tuple[Path, list[CameraModel]]]:
    """The file of each camera; with several cameras the name is before the ending."""
    if len(cameras) == 1:
        return [(path, cameras)]
    owns = [_word(model.name) for model in cameras]
    twice = next((own for own in owns if owns.count(own) > 1), None)
    if twice is not None:
        remedy = "give the cameras names that differ in letters and digits"
        raise InputError("would be the file name of two cameras", where=f"{path.stem}-{twice}{path.suffix}", remedy=remedy)
    return [(path.with_name(f"{path.stem}-{own}{path.suffix}"), [model]) for own, model in zip(owns, cameras, strict=True)]


def _found(name: str, model: CameraModel) -> Converted:
    """The model as a format holds it."""
    if name in PHOTOGRAMMETRIC:
        division = name == "halcon" and model["d1"] and not any(model[one] for one in HALCON[3:])
        sensor = model.sensor if name == "australis" else square_affinity(model).sensor
        return converted(model, "image_to_object", DIVISION if division else PHOTOGRAMMETRIC[name], "perspective", sensor)
    if name == "mrcal" and model.projection == "stereographic":
        return converted(model, "object_to_image", ("c", "xp", "yp", "b1"), "stereographic")
    if model.projection != "perspective" and name != "matlab":
        return converted(model, "object_to_image", METASHAPE if name == "metashape" else EQUIDISTANT, "equidistant")
    widest = opencv_names(model)
    names = {"kalibr": RADTAN, "metashape": METASHAPE, "matlab": MATLAB, "ros": OPENCV if widest == OPENCV else RATIONAL}
    return converted(model, "object_to_image", names.get(name, widest), "perspective")


def _sentence(name: str, path: Path, model: CameraModel, index: int) -> str:
    kind, found = _simplest(model) if name == "colmap" else ("", _found(name, model))
    what = f"{model.name} as camera {index + 1}, {kind}" if name == "colmap" else f"{model.name} for {FORMATS[name].title}"
    lost = "nothing is lost" if found.largest_px <= EXACT_PX else f"up to {found.largest_px:.2g} px are lost"
    if found.share < 1:
        lost += f"; in {100 * (1 - found.share):.2g} % of the frame the calibrated lens has no inverse, and nothing can be compared"
    return f"{path}: {what}; {lost}"
