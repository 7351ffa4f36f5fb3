"""Image stabilisation: a sensor or lens group that is held by actuators lies a little differently in every frame."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.geometry import frame_centre, image_shift
from pixmetry.camera.light import Pull
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import MOVES_POINTS, Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class Stabilisation(Parameters):
    """Standard deviations from frame to frame, independent of each other."""

    shift_std_px: float = quantity(0.0, "px", "standard deviation of the position along each axis", ge=0, le=100)
    roll_std_rad: float = quantity(0.0, "rad", "standard deviation of the rotation about the frame's centre", ge=0, le=0.05)


def poses(params: Stabilisation, signal: Signal, stream: Stream) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Displacement along x and y and rotation from x to y of every frame's image, shape (n,) each."""
    x, y, roll = (stream.normal_frames(signal.grid, draw).astype(float) for draw in range(3))
    return params.shift_std_px * x, params.shift_std_px * y, params.roll_std_rad * roll


def pull_of(params: Stabilisation, signal: Signal, stream: Stream) -> Pull:
    """The map from places in the displaced image to those in the image at rest."""
    tx, ty, roll = (v[:, None, None] for v in poses(params, signal, stream))
    cos, sin = np.cos(roll), np.sin(roll)
    x0, y0 = frame_centre(signal.frame_shape)

    def pull(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v = x - x0 - tx, y - y0 - ty
        return x0 + cos * u + sin * v, y0 + cos * v - sin * u

    return pull


def forward(params: Stabilisation, signal: Signal, stream: Stream) -> Signal:
    """Look from the pose of each frame."""
    if not (params.shift_std_px or params.roll_std_rad):
        return signal
    return signal.with_light(signal.own_light.moved(pull_of(params, signal, stream)))


def truth(params: Stabilisation, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Displacement of the image at every pixel, shape (n, rows, cols)."""
    return image_shift(pull_of(params, signal, stream), signal)


def propagate(params: Stabilisation, probe: Probe) -> Contribution:
    """Displacement, and rotation times the distance from the centre, for targets anywhere in the frame."""
    size = min(probe.signal_dn.shape[1:])
    mean_square = [  # of evenly spread places at which the target's window fits into the frame
        ((side - 1 - 2 * (size // 2 + 1)) ** 2 / 12) for side in probe.frame_shape
    ]
    ux = np.sqrt(params.shift_std_px**2 + params.roll_std_rad**2 * mean_square[0])
    uy = np.sqrt(params.shift_std_px**2 + params.roll_std_rad**2 * mean_square[1])
    return Contribution(float(ux), float(uy), "D", model_error=0.05, method="displacement and rotation of the frame")


def measure(observations: Observations) -> Estimates:
    """Scatter of the whole image from frame to frame, from a series of a fixed field."""
    names = ("shift_std_px", "roll_std_rad")
    fit = None if observations.drift is None else observations.drift.fit
    told = {name: name for name in names}
    return of_pictures(
        fit,
        told,
        where="sensor.stabilisation",
        pictures="a series of a fixed field",
        kind="series",
        failed=observations.failed.get("series", ""),
    )


SOURCE = Source(
    id="sensor.stabilisation",
    title="Stabilised sensor",
    description="The actuators of an image stabiliser move and rotate the image from frame to frame, even on a tripod.",
    parameters=Stabilisation,
    consumes=(Kind.LIGHT,),
    neutral=Stabilisation(),
    typical=Stabilisation(shift_std_px=0.1, roll_std_rad=1e-4),
    bound=Stabilisation(shift_std_px=0.5, roll_std_rad=1e-3),
    forward=forward,
    measure=measure,
    truth=truth,
    propagate=propagate,
    option="a stabilised sensor",
    gum_class="D",
    equation="x' = R(ρ_f) x + t_f,  ρ_f and t_f new in every frame",
    typical_size="0.1 to 10 px, common to all targets of a frame",
    references=("ISO 20954-1:2019 (image stabilisation performance)",),
    advice="Switch the stabilisation off, or estimate principal point and roll for every image.",
    reasons={
        "correct": f"{MOVES_POINTS}, by the pose of each frame",
    },
)
