"""A camera with the geometry that a calibration found: its preset takes the lens and the affinity over."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pixmetry.core.camera import Camera, Element
from pixmetry.core.catalogue import get_source
from pixmetry.core.errors import InputError
from pixmetry.core.observations import AFFINITY, LENS, TAKEN_UP, CameraGeometry, Observations


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
        values = {e.name: e.value for e in source.measure(seen)}
        chain.insert(at, Element(name, source, source.make(values, where=f"{geometry.origin}, {name}")))
    facts = {"calibration": geometry.origin, "principal_distance_mm": geometry.lens["principal_distance_mm"].value}
    return replace(camera, chain=tuple(chain), facts={**camera.facts, **facts})
