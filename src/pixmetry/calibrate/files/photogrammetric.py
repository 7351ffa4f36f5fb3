"""Cameras of photogrammetric programs, written and read: HALCON, Australis and PhotoModeler.

All three correct the measured point, x̄ → x̄ + Δx, as ``image_to_object`` does here, and count lengths in mm (HALCON in m), so that a
pixel pitch is needed. They differ in this:

- HALCON's camera parameters (``.dat``, ``.cal``: ParGroup, three lines a parameter): K1 … K3, P1, P2 of the polynomial model, or κ of the
  division model, x̄/(1 + κ r²); pixel (0, 0) is the centre of the first one, y down; no affinity, but a pitch of its own along x.
- Australis' report (``.txt``, "Camera Parameters"): K1 … K3, P1, P2, B1, B2 with standard errors; from the middle of the frame, y up.
- PhotoModeler's report (``.txt``, "Camera Calibration Standard Deviations"): K1 … K3, P1, P2 with standard deviations; the principal point
  from the outer corner of the frame, y down, the corrections with y up; width and height of the format instead of an affinity. The report
  does not say how many pixels the frame has.

References
----------
MVTec HALCON, reference of ``read_cam_par``, ``calibrate_cameras`` and chapter "2D Transformations"; Photometrix, report of an adjustment of
2006 and the formulas in its calibration files (as Vision Workbench's PhotometrixLensDistortion cites them); B1, B2: C. S. Fraser, ISPRS
J. 52 (1997) 149–159; PhotoModeler, help page "Lens Distortion Formulation" and a status report of version 2012.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pixmetry import __version__
from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.exchange import Known, carried_covariance, held
from pixmetry.core.errors import InputError

HALCON = ("c", "xp", "yp", "k1", "k2", "k3", "p1", "p2")
DIVISION = ("c", "xp", "yp", "d1")
AUSTRALIS = ("c", "xp", "yp", "k1", "k2", "k3", "p1", "p2", "b1", "b2")
BY = f"pixmetry {__version__}"
PER_M = {"k1": 1e-6, "k2": 1e-12, "k3": 1e-18, "p1": 1e-3, "p2": 1e-3, "d1": 1e-6}  # of HALCON's numbers in ours
POLYNOMIAL = {"Poly1": "k1", "Poly2": "k2", "Poly3": "k3", "Poly4": "p1", "Poly5": "p2"}
OTHER_LENSES = ("Tilt", "Rot", "ImagePlaneDist", "Magnification", "Vx", "Vy", "Vz")  # of HALCON: tilted, telecentric, line scan
FREE, HELD = 1e3, 1e-8  # initial standard errors of Australis
NUMBER = r"([-+]?\d+\.?\d*(?:[eE][-+]?\d+)?)"
DEVIATION = {  # of PhotoModeler: heading, short name, unit
    "c": ("Focal Length", "Focal", " mm"), "xp": ("Xp - principal point x", "Xp", " mm"), "yp": ("Yp - principal point y", "Yp", " mm"),
    "width": ("Fw - format width", "Fw", " mm"), "height": ("Fh - format height", "Fh", " mm"),
    "k1": ("K1 - radial distortion 1", "K1", ""), "k2": ("K2 - radial distortion 2", "K2", ""),
    "k3": ("K3 - radial distortion 3", "K3", ""), "p1": ("P1 - decentering distortion 1", "P1", ""),
    "p2": ("P2 - decentering distortion 2", "P2", ""),
}  # fmt: skip


def _pitch(model: CameraModel, who: str) -> tuple[float, float]:
    if model.sensor.pitch_x_um is None:
        remedy = "calibrate with the pitch of the pixels: pitch_um in a project, --pixel-um"
        raise InputError(f"{who} has lengths in millimetres, and the pixel pitch is not known", where=model.name, remedy=remedy)
    return model.sensor.per_px


def square_affinity(model: CameraModel) -> CameraModel:
    """The model whose pitch along x takes up the affinity, as programs have it that know a width and a height of the pixels only.

    From object to image b1 comes last, and the other model is the same one; from image to object it is so but for the product of b1 and
    the distortion.
    """
    b1, sensor = model["b1"], model.sensor
    if sensor.pitch_x_um is None or not b1:
        return model
    factor = 1 + b1 if model.direction == "image_to_object" else 1 / (1 + b1)
    return replace(model.with_values(b1=0.0), sensor=replace(sensor, pitch_x_um=sensor.pitch_x_um * factor))


def halcon_form(model: CameraModel, may_lose_px: float) -> CameraModel:
    """The model as HALCON holds it: polynomial, or division where the lens has only a first denominator."""
    _pitch(model, "HALCON")
    division = bool(model["d1"]) and not any(model[name] for name in HALCON[3:])
    names = DIVISION if division else HALCON
    return held(model, names, may_lose_px, "HALCON", "perspective", "image_to_object", square_affinity(model).sensor)


def halcon_text(model: CameraModel, may_lose_px: float) -> str:
    """Camera parameters as HALCON's ``read_cam_par`` takes them."""
    form = halcon_form(model, may_lose_px)
    mx, my = form.sensor.per_px
    lens = [("Kappa", "kappa", form["d1"] / PER_M["d1"], "::", "Radial distortion coefficient [1/(meter*meter)]")]
    if not form["d1"]:
        lens = [
            (name, name.lower(), form[ours] / PER_M[ours], "::", f"Coefficient {k} of the polynomial distortion")
            for k, (name, ours) in enumerate(POLYNOMIAL.items(), 1)
        ]
    rows = [
        ("Focus", "foc", form["c"] / 1000, ":0.0:", "Focal length of the lens [meter]"),
        *lens,
        ("Sx", "sx", mx / 1000, ":0.0:", "Width of a cell on the sensor [meter]"),
        ("Sy", "sy", my / 1000, ":0.0:", "Height of a cell on the sensor [meter]"),
        ("Cx", "cx", form["xp"], ":0.0:", "X-coordinate of the image center [pixel]"),
        ("Cy", "cy", form["yp"], ":0.0:", "Y-coordinate of the image center [pixel]"),
        ("ImageWidth", "imgw", form.sensor.cols, ":1:32767", "Width of the images [pixel]"),
        ("ImageHeight", "imgh", form.sensor.rows, ":1:32767", "Height of the images [pixel]"),
    ]
    out = [f"# Written by {BY}", "# INTERNAL CAMERA PARAMETERS", "", 'ParGroup: Camera: Parameter;\n  "Internal camera parameters";']
    for name, short, value, limits, what in rows:
        kind = "INT" if isinstance(value, int) else "DOUBLE"
        out.append(f'{name}:{short}: {value!r};\n  {kind}{limits};\n  "{what}";')
    return "\n\n".join(["\n".join(out[:3]), *out[3:]]) + "\n"


def camera_of_halcon(text: str, where: str) -> CameraModel:
    """The camera of a file of HALCON.

    Raises
    ------
    InputError
        If it is of another kind than an area-scan camera with a perspective lens, or something is missing.
    """
    lines = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#"))
    found = {m[1]: float(m[2]) for m in re.finditer(rf"(\w+)\s*:\s*\w+\s*:\s*{NUMBER}\s*;", lines)}
    other = next((name for name in OTHER_LENSES if found.get(name)), "Focus" if found.get("Focus") == 0 else None)
    if other is not None:
        allowed = "an area-scan camera with a perspective lens that is not tilted"
        value = f"{other} {found[other]:g}"
        raise InputError("a camera of HALCON that pixmetry cannot represent", where=where, value=value, allowed=allowed)
    missing = next((name for name in ("Focus", "Sx", "Sy", "Cx", "Cy", "ImageWidth", "ImageHeight") if name not in found), None)
    if missing is not None:
        raise InputError(f"{missing} is missing", where=where, remedy="write the file again with write_cam_par")
    sensor = Sensor(int(found["ImageWidth"]), int(found["ImageHeight"]), 1e6 * found["Sx"], 1e6 * found["Sy"])
    lens = {ours: PER_M[ours] * found.get(name, 0.0) for name, ours in {**POLYNOMIAL, "Kappa": "d1"}.items()}
    lens |= {"c": 1000 * found["Focus"], "xp": found["Cx"], "yp": found["Cy"]}
    return CameraModel.of(sensor, "image_to_object", (), "camera", "perspective", **lens)


def australis_form(model: CameraModel, may_lose_px: float) -> CameraModel:
    """The model as Australis holds it."""
    _pitch(model, "Australis")
    return held(model, AUSTRALIS, may_lose_px, "Australis", "perspective", "image_to_object")


def australis_text(models: Sequence[CameraModel], may_lose_px: float, known: Mapping[str, Known]) -> str:
    """The camera parameters as Australis reports them, all cameras in one file; its standard errors hold those of the calibration."""
    out = ["Australis Bundle Adjustment Results: Camera Parameters", "", f"Written by {BY}", ""]
    for number, model in enumerate(models, 1):
        form = australis_form(model, may_lose_px)
        u = _standard_errors(model, form, known)
        (mx, my), (x0, y0) = form.sensor.per_px, form.sensor.centre
        value = {name: form[name] for name in AUSTRALIS} | {"xp": (form["xp"] - x0) * mx, "yp": (y0 - form["yp"]) * my}
        value |= {name: -value[name] for name in ("p2", "b2")}  # y up
        out += [
            f"Results for Camera {number}    {' '.join(model.name.split())}    Lens",
            "",
            "Sensor Size      Pixel Size (mm)",
            f"  H  {form.sensor.cols:6d}       {mx!r}",
            f"  V  {form.sensor.rows:6d}       {my!r}",
            "",
            "  Camera      Initial          Total            Final         Initial       Final",
            " Variable      Value         Adjustment         Value       Std. Error   Std. Error",
            "",
        ]
        for name in AUSTRALIS:
            unit = " (mm)" if name in AUSTRALIS[:3] else ""
            numbers = f"{value[name]:.12e}  {0:.3e}  {value[name]:.12e}  {FREE if u[name] else HELD:.1e}  {u[name]:.6e}"
            out.append(f"{name.upper():>5}  {numbers}{unit}")
        out.append("")
    return "\n".join(out)


def cameras_of_australis(text: str, where: str) -> dict[str, CameraModel]:
    """The cameras of an Australis report by their names.

    Raises
    ------
    InputError
        If it has no camera, or something of one is missing.
    """
    out: dict[str, CameraModel] = {}
    for part in re.split(r"^\s*Results for Camera\s+", text, flags=re.MULTILINE)[1:]:
        head = re.match(r"(\d+)[ \t]*(.*?)[ \t]*(?:Lens[ \t]*)?$", part, re.MULTILINE)
        name = head[2] or f"camera {head[1]}" if head else "camera"
        size = {m[1]: (int(m[2]), float(m[3])) for m in re.finditer(rf"^\s*([HV])\s+(\d+)\s+{NUMBER}\s*$", part, re.MULTILINE)}
        row = rf"^\s*(C|XP|YP|K[123]|P[12]|B[12])\s+{NUMBER}\s+{NUMBER}\s+{NUMBER}\s+{NUMBER}"
        value = {m[1].lower(): float(m[4]) for m in re.finditer(row, part, re.MULTILINE)}
        if set(size) != {"H", "V"} or not {"c", "xp", "yp"} <= set(value):
            allowed = "H and V with the size of the sensor and of a pixel, C, XP and YP"
            raise InputError("not the camera parameters of Australis", where=f"{where}, {name}", allowed=allowed)
        (cols, mx), (rows, my) = size["H"], size["V"]
        sensor = Sensor(cols, rows, 1000 * mx, 1000 * my)
        x0, y0 = sensor.centre
        value |= {name: -value.get(name, 0.0) for name in ("p2", "b2")}  # y up
        value |= {"xp": x0 + value["xp"] / mx, "yp": y0 - value["yp"] / my}
        name = _unused(name, out)
        out[name] = CameraModel.of(sensor, "image_to_object", (), name, "perspective", **value)
    if not out:
        raise InputError("no camera in the report", where=where, allowed="Results for Camera 1 …")
    return out


def photomodeler_form(model: CameraModel, may_lose_px: float) -> CameraModel:
    """The model as PhotoModeler holds it."""
    _pitch(model, "PhotoModeler")
    return held(model, HALCON, may_lose_px, "PhotoModeler", "perspective", "image_to_object", square_affinity(model).sensor)


def photomodeler_text(models: Sequence[CameraModel], may_lose_px: float, known: Mapping[str, Known]) -> str:
    """The cameras as PhotoModeler's status report has them, with standard deviations; for its camera dialogue and for readers of it."""
    step = "   "
    out = ["Status Report Tree", f"{step}Project Name: written by {BY}", f"{step}Information from most recent processing"]
    out += [f"{2 * step}Precisions / Standard Deviations", f"{3 * step}Camera Calibration Standard Deviations"]
    for number, model in enumerate(models, 1):
        form = photomodeler_form(model, may_lose_px)
        u, (mx, my) = _standard_errors(model, form, known), form.sensor.per_px
        value = {name: form[name] for name in HALCON} | {"xp": (form["xp"] + 0.5) * mx, "yp": (form["yp"] + 0.5) * my, "p2": -form["p2"]}
        value |= {"width": form.sensor.cols * mx, "height": form.sensor.rows * my}
        u |= {"width": u["b1"] * value["width"]}  # as the width takes the place of b1
        out.append(f"{4 * step}Camera{number}: {' '.join(model.name.split())} {form.sensor.cols}x{form.sensor.rows}")
        for name, (heading, short, unit) in DEVIATION.items():
            out += [f"{5 * step}{heading}", f"{6 * step}Value: {value[name]!r}{unit}"]
            out += [f"{6 * step}Deviation: {short}: {u[name]:.6e}{unit}"] if u.get(name) else []
    return "\n".join(out) + "\n"


def cameras_of_photomodeler(text: str, where: str, size: tuple[int, int] | None = None) -> dict[str, CameraModel]:
    """The cameras of a PhotoModeler report by their names.

    Parameters
    ----------
    text, where : str
    size : (int, int), optional
        Columns and rows of the frame. Otherwise they must be in the name of the camera, such as 2272x1704.

    Raises
    ------
    InputError
        If it has no camera, its frame is not known, or something is missing.
    """
    part = text.partition("Camera Calibration Standard Deviations")[2].partition("Photograph Standard Deviations")[0]
    heads = list(re.finditer(r"^\s*Camera\d+:[ \t]*(.*?)[ \t]*$", part, re.MULTILINE))
    if not heads:
        raise InputError("no camera in the report", where=where, allowed="the report of a project that calibrated its camera")
    out: dict[str, CameraModel] = {}
    for head, after in zip(heads, [*heads[1:], None], strict=True):
        name, own = head[1], part[head.end() : after.start() if after else None]
        told = re.search(r"(\d{2,6})\s*[xX×]\s*(\d{2,6})", name)
        pixels = size or ((int(told[1]), int(told[2])) if told else None)
        if pixels is None:
            remedy = "state cols and rows of the camera"
            raise InputError("does not say how many pixels the frame has", where=f"{where}, {name}", remedy=remedy)
        value = {}
        for key, (heading, _, _) in DEVIATION.items():
            found = re.search(rf"{re.escape(heading)}\s*Value:\s*{NUMBER}", own)
            value[key] = float(found[1]) if found else 0.0
        if not all(value[key] > 0 for key in ("c", "width", "height")):
            raise InputError("focal length or format is missing", where=f"{where}, {name}", allowed="Focal Length, Fw and Fh above 0")
        mx, my = value.pop("width") / pixels[0], value.pop("height") / pixels[1]
        value |= {"xp": value["xp"] / mx - 0.5, "yp": value["yp"] / my - 0.5, "p2": -value["p2"]}
        sensor = Sensor(*pixels, 1000 * mx, 1000 * my)
        name = _unused(name, out)
        out[name] = CameraModel.of(sensor, "image_to_object", (), name, "perspective", **value)
    return out


def _unused(name: str, taken: Mapping[str, CameraModel]) -> str:
    """The name of a camera, with a number where an earlier camera of the report has it: two of one type are two cameras."""
    return name if name not in taken else next(f"{name} ({k})" for k in range(2, len(taken) + 2) if f"{name} ({k})" not in taken)


def _standard_errors(model: CameraModel, form: CameraModel, known: Mapping[str, Known]) -> dict[str, float]:
    """u of a form's parameters, lengths in mm; 0 of those that were held."""
    u = dict.fromkeys(AUSTRALIS, 0.0)
    if model.name in known:
        names, covariance = carried_covariance(model, form, known[model.name], AUSTRALIS)
        u |= dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    mx, my = form.sensor.per_px
    return u | {"xp": u["xp"] * mx, "yp": u["yp"] * my}
