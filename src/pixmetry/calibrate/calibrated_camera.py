"""A calibration in use: a camera's geometry in the parameters of the error sources, and the preset that takes lens and affinity over.

The bundle's model (`pixmetry.calibrate.bundle.model`) adds the lens's polynomial and the sensor's affinity in one place. A camera has them
in a row: the lens draws the image, then the sensor or the sampling shears it. The one is fitted to the other all over the frame, which also
turns the direction of the distortion.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, CameraModel
from pixmetry.calibrate.files.record import StoredCalibration, read_calibration
from pixmetry.calibrate.records import Calibration
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.observations import AFFINITY, LENS, TAKEN_UP, CameraGeometry, Observations
from pixmetry.camera.provenance import MEASURED
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates

GRID = 25  # places along each side of the frame
LARGEST_PX = 0.05  # two models that differ by more are not the same camera
POLYNOMIAL = ("p1_per_mm", "p2_per_mm", "k1_per_mm2", "k2_per_mm4", "k3_per_mm6", "k4_per_mm8", "k5_per_mm10")
HIGH = {"k4", "k5"}  # of a model without them they are 0
FITTED = ("principal_distance_mm", "centre_x_px", "centre_y_px", "b1", "b2", *POLYNOMIAL)
UNITS = ("mm", "px", "px", "1", "1", "1/mm", "1/mm", "1/mm²", "1/mm⁴", "1/mm⁶", "1/mm⁸", "1/mm¹⁰")


def calibrated_geometry(
    calibration: str | Path | StoredCalibration | Calibration | CameraGeometry,
    camera: str | None = None,
    pitch_um: tuple[float, float] | None = None,
) -> CameraGeometry:
    """What a calibration says of one camera, in the parameters of the error sources.

    What it leaves over is what its residuals have in common at one place of the frame
    (`pixmetry.calibrate.checks.residual_grid.systematic_rest`): the noise of the targets is no error of the camera.

    Parameters
    ----------
    calibration : path, StoredCalibration, Calibration or CameraGeometry
        A ``calibration.json`` or the folder that holds it, or what was read or calibrated.
    camera : str, optional
        Name of the camera; may be left out if there is one.
    pitch_um : (float, float), optional
        Of the pixels, for a calibration that was made in pixels.

    Returns
    -------
    CameraGeometry

    Raises
    ------
    InputError
        If the calibration cannot be read, has no such camera, or there is no pixel pitch.
    """
    if isinstance(calibration, CameraGeometry):
        return calibration
    if isinstance(calibration, str | Path):
        calibration = read_calibration(calibration)
    if isinstance(calibration, Calibration):
        adjusted = calibration.adjustment
        models, dof = tuple(adjusted.camera(k) for k in range(len(adjusted.network.cameras))), adjusted.dof
        covariances = [adjusted.interior_covariance(k) for k in range(len(models))]
    else:
        models, dof = calibration.cameras, calibration.dof
        covariances = [calibration.interior_covariance(k) for k in range(len(models))]
    names = [m.name for m in models]
    if camera is None and len(names) > 1 or camera is not None and camera not in names:
        remedy = "name it from Python: assess(…, calibration=calibrated_geometry(file, NAME))"
        raise InputError("the calibration has several cameras", value=camera, allowed=", ".join(names), remedy=remedy)
    k = 0 if camera is None else names.index(camera)
    record, grid = (calibration.tests.residuals or {}).get(names[k]), (calibration.tests.projection or {}).get(names[k])
    if record is None or grid is None or not record.n:
        raise InputError("no image coordinate of this camera took part", where=names[k], remedy="calibrate it, or name another camera")
    left = record.systematic_x_px or 0.0, record.systematic_y_px or 0.0
    sensor = models[k].sensor
    origin = f"calibration of {names[k]}, {sensor.cols} × {sensor.rows} px"
    u = float(np.sqrt(np.nanmean(grid.u_px**2)))
    model, (estimated, covariance) = models[k], covariances[k]
    if sensor.pitch_x_um is None:
        if pitch_um is None:
            remedy = "calibrate with pitch_um, or state the pitch in the campaign"
            raise InputError("a calibration in pixels, and the pixel pitch is not known", where=model.name, remedy=remedy)
        model, covariance = with_pitch(model, estimated, covariance, pitch_um)
    return geometry_of(model, estimated, covariance, dof=dof, u_px=(u, u), left_px=left, origin=origin)


def with_pitch(
    model: CameraModel, names: tuple[str, ...], covariance: np.ndarray, pitch_um: tuple[float, float]
) -> tuple[CameraModel, np.ndarray]:
    """A model in pixels, and the covariance of some of its parameters, with lengths in mm; the images of points do not change.

    Raises
    ------
    InputError
        If the pixels are not square: radial distortion in pixels then is none in mm.
    """
    x, y = pitch_um
    if not np.isclose(x, y, rtol=1e-6):
        what, remedy = "a calibration in pixels that are not square", "calibrate with pitch_x_um and pitch_y_um"
        raise InputError(what, where=model.name, value=f"{x:g} × {y:g} µm", allowed="square pixels", remedy=remedy)
    mm, power = x / 1000, np.zeros(len(NAMES))
    power[0] = 1
    if model.direction == "image_to_object":
        power[NAMES.index("p1") : NAMES.index("p2") + 1] = -1
        power[NAMES.index("k1") :] = -2 * np.arange(1, len(NAMES) - NAMES.index("k1") + 1)
    factor = mm**power
    own = factor[[NAMES.index(name) for name in names]]
    changed = replace(model, sensor=replace(model.sensor, pitch_x_um=x, pitch_y_um=y), values=model.values * factor)
    return changed, covariance * np.outer(own, own)


def geometry_of(
    model: CameraModel,
    names: tuple[str, ...],
    covariance: np.ndarray,
    *,
    dof: float = np.inf,
    u_px: tuple[float, float] = (0.0, 0.0),
    left_px: tuple[float, float] = (0.0, 0.0),
    origin: str = "calibration",
) -> CameraGeometry:
    """Turn a calibrated model into the parameters of the sources, with their covariance.

    Parameters
    ----------
    model : CameraModel
        With a pixel pitch.
    names, covariance : tuple of str, ndarray
        Estimated parameters (out of `pixmetry.calibrate.bundle.model.NAMES`) and their covariance.
    dof : float
    u_px, left_px : (float, float)
        See `CameraGeometry`.
    origin : str

    Returns
    -------
    CameraGeometry

    Raises
    ------
    InputError
        If there is no pitch, or five radial and two tangential coefficients cannot hold the model.
    """
    if model.sensor.pitch_x_um is None:
        raise InputError("the pixel pitch is not known", where=model.name, remedy="calibrate with pitch_um, so that lengths are in mm")
    high = bool(HIGH & set(names) or any(model[name] for name in HIGH))
    values, largest = _fitted(model, high)
    if not high and not largest < LARGEST_PX:  # the inverse of a polynomial may need more terms
        high = True
        values, largest = _fitted(model, high)
    if not largest < LARGEST_PX:
        what = "the lens of a camera file (K1 to K5, P1, P2, affinity and shear) cannot represent this model"
        raise InputError(what, where=model.name, value=f"up to {largest:.2g} px apart", allowed=f"up to {LARGEST_PX} px")
    slopes = np.zeros((len(FITTED), len(names)))
    for j, name in enumerate(names):
        step = float(np.sqrt(covariance[j, j]))
        if step:
            ends = [_fitted(model.with_values(**{name: model[name] + s * step}), high)[0] for s in (-1, 1)]
            slopes[:, j] = (ends[1] - ends[0]) / (2 * step)
    n = len(FITTED)
    full = np.zeros((n + 2, n + 2))
    full[:n, :n] = slopes @ covariance @ slopes.T
    lens = Estimates(
        (*FITTED, "pitch_x_um", "pitch_y_um"),
        np.array([*values, model.sensor.pitch_x_um, model.sensor.pitch_y_um]),
        full,
        np.array([*[float(dof)] * n, np.inf, np.inf]),
        (*UNITS, "µm", "µm"),
        method=f"calibration with targets ({origin})",
    )
    return CameraGeometry(lens, *u_px, *left_px, origin)


def _fitted(model: CameraModel, high: bool) -> tuple[np.ndarray, float]:
    """The sources' parameters that see directions as the model does, and the largest difference over the frame in px.

    ``high``: K4 and K5 are among them; else they stay 0.
    """
    from scipy.optimize import least_squares

    sensor = model.sensor
    mx, my = sensor.per_px
    x0, y0 = sensor.centre
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(0, sensor.cols - 1, GRID), np.linspace(0, sensor.rows - 1, GRID)))
    u, v = model.direction_of(x, y)
    if not np.isfinite(u + v).all():
        raise InputError("the distortion has no inverse in a part of the frame", where=model.name, remedy="use fewer radial parameters")
    reach = float(np.hypot(x0 * mx, y0 * my))
    scale = np.array([model["c"], 1, 1, 1e-3, 1e-3, 1 / reach, 1 / reach, *reach ** (-2.0 * np.arange(1, 6))])
    count = len(FITTED) if high else len(FITTED) - len(HIGH)

    def misses(scaled: np.ndarray) -> np.ndarray:
        c, cx, cy, b1, b2, p1, p2, k1, k2, k3, k4, k5 = np.concatenate([scaled, np.zeros(len(scale) - count)]) * scale
        a = (x - x0 - b2 * (y - y0)) / (1 + b1)
        a, b = (a - cx) * mx, (y - y0 - cy) * my
        r2 = a * a + b * b
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * (k4 + r2 * k5))))
        ideal_a = a * radial + p1 * (r2 + 2 * a * a) + 2 * p2 * a * b
        ideal_b = b * radial + p2 * (r2 + 2 * b * b) + 2 * p1 * a * b
        return np.concatenate([(ideal_a / c - u) * model["c"] / mx, (ideal_b / c - v) * model["c"] / my])

    sign = -1.0 if model.direction == "image_to_object" else 1.0
    start = np.zeros(len(FITTED))
    start[:5] = model["c"], model["xp"] - x0, model["yp"] - y0, sign * model["b1"], sign * model["b2"] * my / mx
    fit = least_squares(misses, (start / scale)[:count], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return np.concatenate([fit.x, np.zeros(len(scale) - count)]) * scale, float(np.hypot(*misses(fit.x).reshape(2, -1)).max())


def calibrated_camera(camera: Camera, geometry: CameraGeometry) -> Camera:
    """The camera with the calibrated lens and affinity, and without the sources that the calibration includes.

    Parameters
    ----------
    camera : Camera
        With the pixel pitch of the calibration.
    geometry : CameraGeometry

    Returns
    -------
    Camera
        Its facts have ``calibration`` and ``principal_distance_mm``; lens and affinity have their uncertainties, each with its own
        covariance. That between the two is not kept.

    Raises
    ------
    InputError
        If the pitches differ, or a value is out of a source's range.
    """
    pitch = tuple(geometry.lens[n].value for n in ("pitch_x_um", "pitch_y_um"))
    if camera.pitch_um is None or not np.allclose(camera.pitch_um, pitch, rtol=1e-6):
        allowed, remedy = str(camera.pitch_um), "calibrate with the pitch of the camera, or name the right camera"
        raise InputError("a calibration with another pixel pitch", where=camera.name, value=pitch, allowed=allowed, remedy=remedy)
    seen = Observations(geometry=geometry)
    chain = [e for e in camera.chain if e.source.id not in TAKEN_UP]
    at = next((i for i, e in enumerate(chain) if e.source.stage not in ("scene", "optics")), len(chain))
    for name in (AFFINITY, LENS):
        source = get_source(name, "calibrated camera")
        assert source.measure is not None  # both can be read from a geometry
        found = source.measure(seen)
        params = source.make({e.name: e.value for e in found}, where=f"{geometry.origin}, {name}")
        chain.insert(at, Element(name, source, params, known_from=MEASURED, estimates=found))
    facts = {"calibration": geometry.origin, "principal_distance_mm": geometry.lens["principal_distance_mm"].value}
    return replace(camera, chain=tuple(chain), facts={**camera.facts, **facts})
