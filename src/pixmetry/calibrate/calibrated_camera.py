"""A calibration in use: what it says of a camera's geometry, and the preset that takes lens and affinity over."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, CameraModel
from pixmetry.calibrate.files.record import StoredCalibration, read_calibration
from pixmetry.calibrate.geometry import geometry_of
from pixmetry.calibrate.records import Calibration
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.observations import AFFINITY, LENS, TAKEN_UP, CameraGeometry, Observations
from pixmetry.core.errors import InputError


def calibrated_geometry(
    calibration: str | Path | StoredCalibration | Calibration | CameraGeometry,
    camera: str | None = None,
    pitch_um: tuple[float, float] | None = None,
) -> CameraGeometry:
    """What a calibration says of one camera, in the parameters of the error sources.

    What it leaves over is what its residuals have in common at one place of the frame (`pixmetry.calibrate.geometry.systematic_rest`):
    the noise of the targets is no error of the camera.

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
        raise InputError("which camera of the calibration is not clear", value=camera, allowed=", ".join(names), remedy=remedy)
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
            remedy = "calibrate with pitch_um, or say in the campaign what the pitch of its camera is"
            raise InputError("a calibration in pixels, and the pixel pitch is not known", where=model.name, remedy=remedy)
        model, covariance = with_pitch(model, estimated, covariance, pitch_um)
    return geometry_of(model, estimated, covariance, dof=dof, u_px=(u, u), left_px=left, origin=origin)


def with_pitch(
    model: CameraModel, names: tuple[str, ...], covariance: np.ndarray, pitch_um: tuple[float, float]
) -> tuple[CameraModel, np.ndarray]:
    """A model in pixels and the covariance of some of its parameters with lengths in mm; the camera sees what it saw.

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


def calibrated_camera(camera: Camera, geometry: CameraGeometry) -> Camera:
    """The camera with a calibrated lens and affinity in place of what it had, and without what the calibration takes up with them.

    Parameters
    ----------
    camera : Camera
        With the pixel pitch of the calibration.
    geometry : CameraGeometry

    Returns
    -------
    Camera
        Its facts have ``calibration`` and ``principal_distance_mm``.

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
        values = {e.name: e.value for e in source.measure(seen)}
        chain.insert(at, Element(name, source, source.make(values, where=f"{geometry.origin}, {name}")))
    facts = {"calibration": geometry.origin, "principal_distance_mm": geometry.lens["principal_distance_mm"].value}
    return replace(camera, chain=tuple(chain), facts={**camera.facts, **facts})
