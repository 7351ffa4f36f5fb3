"""Certificates with A1, A2, A3, R0, B1, B2, C1, C2: both readings of one set of numbers, and the test that tells them apart.

With x̄, ȳ from the principal point in mm and r² = x̄² + ȳ², these programs state

    Δx = x̄ (A1 (r² − R0²) + A2 (r⁴ − R0⁴) + A3 (r⁶ − R0⁶)) + B1 (r² + 2 x̄²) + 2 B2 x̄ȳ + C1 x̄ + C2 ȳ,
    Δy = ȳ (A1 (r² − R0²) + …) + B2 (r² + 2 ȳ²) + 2 B1 x̄ȳ,   measured = ideal + Δ.

Where Δ is evaluated is not written on a certificate. At the **measured** coordinates, ideal = measured − Δ(measured): corrections from
image to object with the opposite sign. At the **ideal** ones, measured = ideal + Δ(ideal): distortion from object to image. Both differ by
products of the distortion with itself: tenths of a pixel to many pixels, and A1 by many of its uncertainties.

With s = 1 + A1 R0² + A2 R0⁴ + A3 R0⁶ the first is c/s, −Aₙ/s, −B/s, −C/s. With s = 1 − A1 R0² − A2 R0⁴ − A3 R0⁶ the second is c s,
Aₙ c²ⁿ/s, B c/s, C/s; it holds but for the product of C1, C2 and the distortion.

References
----------
T. Luhmann, S. Robson, S. Kyle, J. Boehm, Close-Range Photogrammetry and 3D Imaging, 3rd ed., de Gruyter, Berlin 2020, section 3.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Network
from pixmetry.calibrate.bundle.options import Options
from pixmetry.core.errors import InputError, MeasureError

Evaluated = Literal["measured", "ideal"]
NUMBERS = ("c", "x0", "y0", "A1", "A2", "A3", "R0", "B1", "B2", "C1", "C2")
LARGEST = 1e6  # of any number in mm
CLEAR, LEAST = 14.0, 1.02  # logarithm of the likelihoods' ratio, and ratio of the scatter, that tell the readings apart


def models_of_certificate(numbers: Mapping[str, float], sensor: Sensor, *, y_up: bool = True) -> dict[Evaluated, CameraModel]:
    """Both readings of a certificate; nothing is free.

    Parameters
    ----------
    numbers : mapping
        c, x0, y0 (from the middle of the frame) and R0 in mm, A1 in 1/mm² and so on, B1, B2 in 1/mm, C1, C2; missing ones are 0. The sign
        of c does not matter.
    sensor : Sensor
        With its pitch.
    y_up : bool
        Whether y of the certificate runs upwards, as is usual.

    Returns
    -------
    dict
        By where the corrections are evaluated: ``"measured"`` and ``"ideal"``.

    Raises
    ------
    InputError
        If a name is unknown, a value is no finite number, c is missing, or the sensor has no pitch.

    Examples
    --------
    >>> models = models_of_certificate({"c": -28.5, "A1": -8e-5, "R0": 12}, Sensor(4288, 2848, 8.45, 8.45))
    >>> {where: (model.direction, round(model["c"], 3)) for where, model in models.items()}
    {'measured': ('image_to_object', 28.832), 'ideal': ('object_to_image', 28.828)}
    """
    if not isinstance(numbers, Mapping):
        raise InputError(
            "not the numbers of a certificate", where="numbers", value=type(numbers).__name__, allowed="names with their values"
        )
    if not isinstance(sensor, Sensor):
        raise InputError("not a sensor", where="sensor", value=type(sensor).__name__, allowed="Sensor(cols, rows, pitch_x_um, pitch_y_um)")
    unknown = next((name for name in numbers if name not in NUMBERS), None)
    if unknown is not None or not numbers.get("c"):
        what = "the principal distance is missing" if unknown is None else "not a number of such a certificate"
        raise InputError(what, where="certificate", value=unknown, allowed=", ".join(NUMBERS))
    if sensor.pitch_x_um is None:
        raise InputError("a certificate in mm, but no pitch", where="certificate", remedy="give the pixel pitch of the sensor")
    of = {name: _number(name, numbers.get(name, 0.0)) for name in NUMBERS}
    c, r2, turned = abs(of["c"]), of["R0"] ** 2, -1.0 if y_up else 1.0
    balance = of["A1"] * r2 + of["A2"] * r2**2 + of["A3"] * r2**3
    (mx, my), (x, y) = sensor.per_px, sensor.centre
    place = {"xp": x + of["x0"] / mx, "yp": y + turned * of["y0"] / my}
    lens = {"k1": of["A1"], "k2": of["A2"], "k3": of["A3"]}
    lens |= {"p1": of["B1"], "p2": turned * of["B2"], "b1": of["C1"], "b2": turned * of["C2"]}
    power = {"k1": 2, "k2": 4, "k3": 6, "p1": 1, "p2": 1, "b1": 0, "b2": 0}
    corrected, drawn = 1 + balance, 1 - balance
    if not (corrected > 0 and drawn > 0):
        raise InputError("A1, A2, A3 and R0 turn the image over", where="certificate", value=balance, allowed="A1 R0² + … between −1 and 1")
    measured = {name: -value / corrected for name, value in lens.items()}
    ideal = {name: value * c ** power[name] / drawn for name, value in lens.items()}
    return {
        "measured": CameraModel.of(sensor, "image_to_object", (), "camera", "perspective", c=c / corrected, **place, **measured),
        "ideal": CameraModel.of(sensor, "object_to_image", (), "camera", "perspective", c=c * drawn, **place, **ideal),
    }


def _number(name: str, value: object) -> float:
    real = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not real or not abs(float(value)) < LARGEST:  # type: ignore[arg-type]
        raise InputError("not a finite number", where=f"certificate, {name}", value=value, allowed=f"below {LARGEST:g}")
    return float(value)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Reading:
    """One reading of a certificate against image coordinates.

    Parameters
    ----------
    evaluated_at : {"measured", "ideal"}
    model : CameraModel
    rms_px : float
        Of the residuals with this camera held; infinite where no adjustment was found.
    """

    evaluated_at: Evaluated
    model: CameraModel
    rms_px: float


def compare_readings(network: Network, numbers: Mapping[str, float], *, y_up: bool = True) -> tuple[Reading, ...]:
    """Hold the camera of a certificate in either reading, adjust everything else, and compare what is left over; the better one first.

    Parameters
    ----------
    network : Network
        Image coordinates of one camera, best those that the certificate was made from; its camera gives frame and pitch.
    numbers : mapping
        As of `models_of_certificate`.
    y_up : bool

    Raises
    ------
    InputError
        If the network has several cameras, and as `models_of_certificate` does.
    MeasureError
        If the image coordinates do not tell the readings apart: the likelihoods of normal errors differ by less than 10⁶, or the residuals
        by less than 2 %.
    """
    from pixmetry.calibrate.bundle.solve import calibrate_network

    if not isinstance(network, Network):
        remedy = "take it from a project: load_project(path).network"
        raise InputError("not a network", where="network", value=type(network).__name__, allowed="Network", remedy=remedy)
    if len(network.cameras) != 1:
        raise InputError("a certificate of one camera", where="network", value=len(network.cameras), allowed="1")
    out = []
    for where, model in models_of_certificate(numbers, network.cameras[0].sensor, y_up=y_up).items():
        try:
            options = Options(folds=0, snoop=False, loss="none", variance_components=False)
            found = calibrate_network(replace(network, cameras=(model,)), options).adjustment
            rms = float(np.sqrt(np.nanmean(found.residual_px[found.used] ** 2)))
        except MeasureError:
            rms = float("inf")
        out.append(Reading(where, model, rms))
    out.sort(key=lambda one: one.rms_px)
    ratio = out[1].rms_px / out[0].rms_px if np.isfinite(out[0].rms_px) else 1.0
    if not (ratio > LEAST and 2 * len(network) * np.log(ratio) > CLEAR):
        what = f"both readings of the certificate leave {out[0].rms_px:.3g} px and {out[1].rms_px:.3g} px"
        remedy = "use image coordinates that reach the corners of the frame, and more of them; with so little distortion either will do"
        raise MeasureError(what, where="certificate", allowed="residuals that differ", remedy=remedy)
    return tuple(out)
