"""Sensor tilted against the lens: a perspective of the ideal image, and a focus that runs through it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.geometry import frame_centre, image_shift, map_contribution
from pixmetry.camera.light import Pull
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import MOVES_POINTS, Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class Tilt(Parameters):
    """Rotation of the sensor about the point where the optical axis meets it, the frame's centre."""

    tilt_x_deg: float = quantity(0.0, "deg", "tilt about y: growth of the distance from the lens with x", ge=-10, le=10)
    tilt_y_deg: float = quantity(0.0, "deg", "tilt about x: growth of the distance from the lens with y", ge=-10, le=10)
    principal_distance_mm: float = quantity(25.0, "mm", "distance from the exit pupil's centre to the sensor", gt=1, le=10000)
    f_number: float = quantity(8.0, "1", "working f-number, for the defocus", ge=0.7, le=64)
    pitch_x_um: float = quantity(8.6, "µm", "pixel pitch along x", gt=0, le=100)
    pitch_y_um: float = quantity(8.3, "µm", "pixel pitch along y", gt=0, le=100)


def rotation(params: Tilt) -> np.ndarray:
    """Directions of the sensor's axes in the camera, as columns; z points away from the lens."""
    a, b = np.radians([params.tilt_x_deg, params.tilt_y_deg])
    about_y = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    turn: Array = about_y @ about_x
    return turn


def places_mm(params: Tilt, x: np.ndarray, y: np.ndarray, frame_shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where places on the sensor lie in space, from the frame's centre."""
    x0, y0 = frame_centre(frame_shape)
    a, b = (x - x0) * params.pitch_x_um / 1000, (y - y0) * params.pitch_y_um / 1000
    r = rotation(params)
    return tuple(r[i, 0] * a + r[i, 1] * b for i in range(3))


def pull_of(params: Tilt, frame_shape: tuple[int, int]) -> Pull:
    """The map from the tilted sensor to the plane square to the axis, by central projection: a homography."""
    x0, y0 = frame_centre(frame_shape)

    def pull(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v, z = places_mm(params, x, y, frame_shape)
        scale = 1000 / (1 + z / params.principal_distance_mm)
        return x0 + u * scale / params.pitch_x_um, y0 + v * scale / params.pitch_y_um

    return pull


def defocus_px2(params: Tilt, x: np.ndarray, y: np.ndarray, frame_shape: tuple[int, int]) -> np.ndarray:
    """Variance along each axis of the blur disc of diameter |z|/N: (z/4N)², over the area of a pixel."""
    z_um = 1000 * places_mm(params, x, y, frame_shape)[2]
    return (z_um / (4 * params.f_number)) ** 2 / (params.pitch_x_um * params.pitch_y_um)


def measure(observations: Observations) -> Estimates:
    """From edges all over the frame at several settings of the focus. Coordinates cannot tell it: a tilted plane is seen by a homography,
    which is a pose and a principal point."""
    return of_pictures(
        None if observations.focus is None else observations.focus.fit,
        {name: name for name in ("tilt_x_deg", "tilt_y_deg", "f_number")},
        where="sensor.tilt",
        pictures="slanted edges all over the frame at three settings of the focus or more (focus_um)",
        kind="edge",
    )


def forward(params: Tilt, signal: Signal, stream: Stream) -> Signal:
    """Look through the homography, out of focus on both sides of the axis."""
    if not (params.tilt_x_deg or params.tilt_y_deg):
        return signal
    shape = signal.frame_shape
    light = signal.own_light.moved(pull_of(params, shape))
    return signal.with_light(light.blurred_by_place(lambda x, y: defocus_px2(params, x, y, shape)))


def truth(params: Tilt, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Displacement of the image at every pixel, shape (rows, cols)."""
    return {name: shift[0] for name, shift in image_shift(pull_of(params, signal.frame_shape), signal).items()}


def propagate(params: Tilt, probe: Probe) -> Contribution:
    """Displacement of targets all over the frame, before a calibration takes it up."""
    return map_contribution(pull_of(params, probe.frame_shape), probe)


SOURCE = Source(
    id="sensor.tilt",
    title="Sensor tilted against the lens",
    description="A sensor that is not perpendicular to the optical axis records a perspective of the image. Its focus varies from side "
    "to side.",
    number=7,
    stars=2,
    parameters=Tilt,
    consumes=(Kind.LIGHT,),
    neutral=Tilt(),
    typical=Tilt(tilt_x_deg=0.3, tilt_y_deg=-0.2),
    bound=Tilt(tilt_x_deg=1.0, tilt_y_deg=0.7, principal_distance_mm=12.5),
    forward=forward,
    truth=truth,
    propagate=propagate,
    gum_class="G",
    equation="ξ = ξ' cos α/(1 + ξ' sin α/c),  Δz = ξ' sin α;  principal point moves by c tan α",
    typical_size="α = 0.5° at 3.2 mm: 3.6 µm (c = 25 mm) to 11 µm (c = 8 mm); below 0.02 px after calibration",
    references=(
        "R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed. 2004, 8.4 (homographies between image planes)",
        "T. A. Clarke, X. Wang, J. G. Fryer, The principal point and CCD cameras, Photogrammetric Record 16 (1998) 293–312",
    ),
    advice="Calibrate: principal point and principal distance include nearly all of it. Shim the sensor if one side is out of focus.",
    measure=measure,
    reasons={
        "correct": f"{MOVES_POINTS}, by the calibration",
    },
)
