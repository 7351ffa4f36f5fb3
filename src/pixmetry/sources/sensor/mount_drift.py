"""Drift of the sensor in its mount: after switching on, and with the camera's attitude."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.geometry import frame_centre, image_shift
from pixmetry.camera.light import Pull
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import MOVES_POINTS, Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class MountDrift(Parameters):
    """Six parameters of an affine displacement that settle with two time constants, and the sag under the camera's own weight."""

    shift_x_px: float = quantity(0.0, "px", "settled displacement along x", ge=-100, le=100)
    shift_y_px: float = quantity(0.0, "px", "settled displacement along y", ge=-100, le=100)
    scale_rel: float = quantity(0.0, "1", "final change of scale", ge=-0.01, le=0.01)
    rotation_rad: float = quantity(0.0, "rad", "final rotation, positive from x to y", ge=-0.01, le=0.01)
    affinity_rel: float = quantity(0.0, "1", "final change of the scale along x alone", ge=-0.01, le=0.01)
    shear_rel: float = quantity(0.0, "1", "final shear: displacement along x over distance along y", ge=-0.01, le=0.01)
    fast_share: float = quantity(0.3, "1", "share that settles with the fast time constant (the chip)", ge=0, le=1)
    fast_s: float = quantity(120.0, "s", "fast time constant", gt=0, le=1e5)
    slow_s: float = quantity(1800.0, "s", "slow time constant (the body)", gt=0, le=1e6)
    sag_px: float = quantity(0.0, "px", "displacement by the camera's weight, camera level", ge=-10, le=10)
    roll_deg: float = quantity(0.0, "deg", "roll of the camera about its axis since the calibration", ge=-180, le=180)
    on_for_s: float = quantity(0.0, "s", "how long it had been on when frame 0 was taken", ge=0, le=1e8)


def settled(params: MountDrift, time_s: np.ndarray) -> np.ndarray:
    """Share of the drift that has happened at a time after switching on."""
    fast, slow = params.fast_share, 1 - params.fast_share
    return -fast * np.expm1(-time_s / params.fast_s) - slow * np.expm1(-time_s / params.slow_s)


def pull_of(params: MountDrift, time_s: np.ndarray, frame_shape: tuple[int, int]) -> Pull:
    """The map from displaced to first places: x' = A x + t about the frame's centre, inverted."""
    p, roll = settled(params, time_s + params.on_for_s), np.radians(params.roll_deg)
    turn = params.rotation_rad * p
    grown = 1 + params.scale_rel * p
    cos, sin = grown * np.cos(turn), grown * np.sin(turn)
    wide, sheared = 1 + params.affinity_rel * p, params.shear_rel * p
    tx = params.shift_x_px * p + params.sag_px * np.sin(roll)  # the direction of gravity, less what the calibration has seen of it
    ty = params.shift_y_px * p + params.sag_px * (np.cos(roll) - 1)
    x0, y0 = frame_centre(frame_shape)

    def pull(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v = x - x0 - tx, y - y0 - ty
        a, b = (cos * u + sin * v) / grown**2, (cos * v - sin * u) / grown**2
        return x0 + (a - sheared * b) / wide, y0 + b

    return pull


def _pull(params: MountDrift, signal: Signal) -> Pull:
    return pull_of(params, (signal.time_s + 0.5 * signal.exposure_s)[:, None, None], signal.frame_shape)


def forward(params: MountDrift, signal: Signal, stream: Stream) -> Signal:
    """Look from where the sensor is in the middle of each exposure."""
    drift = (params.shift_x_px, params.shift_y_px, params.scale_rel, params.rotation_rad, params.affinity_rel, params.shear_rel)
    if not any(drift) and not (params.sag_px and params.roll_deg):
        return signal
    return signal.with_light(signal.own_light.moved(_pull(params, signal)))


def truth(params: MountDrift, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Displacement of the image at every pixel, shape (n, rows, cols)."""
    return image_shift(_pull(params, signal), signal)


def measure(observations: Observations) -> Estimates:
    """Shift, scale and rotation of the image and how fast they settle, from a series of a fixed field."""
    names = ("shift_x_px", "shift_y_px", "scale_rel", "rotation_rad", "fast_share", "fast_s", "slow_s")
    fit = None if observations.drift is None else observations.drift.fit
    return of_pictures(
        fit,
        {name: name for name in names},
        where="sensor.mount_drift",
        pictures="a series of a fixed field",
        kind="series",
        failed=observations.failed.get("series", ""),
    )


SOURCE = Source(
    id="sensor.mount_drift",
    title="Drift of the sensor in its mount",
    description="Self-heating shifts, rotates and stretches the image until the temperature is stable. Play in the mount shifts it when "
    "the camera is rolled.",
    note="Note 15",
    parameters=MountDrift,
    consumes=(Kind.LIGHT,),
    neutral=MountDrift(),
    typical=MountDrift(shift_x_px=0.2, shift_y_px=0.1, scale_rel=2e-4, rotation_rad=5e-5, sag_px=0.05, roll_deg=90.0),
    bound=MountDrift(shift_x_px=2.0, shift_y_px=2.0, scale_rel=1e-3, rotation_rad=5e-4, sag_px=0.5, roll_deg=180.0),
    forward=forward,
    measure=measure,
    truth=truth,
    gum_class="D",
    equation="x' = (1 + s p) R(ρ p) [[1 + b₁ p, b₂ p], [0, 1]] x + t p + g(roll),  p = 1 − f e^(−t/τ₁) − (1 − f) e^(−t/τ₂)",
    typical_size="0.1 to 2 px for self-heating of 15 to 25 K; up to 0.2 px in the first hour for older cameras",
    references=(
        "S. Robson, T. A. Clarke, J. Chen, Suitability of the Pulnix TM6CN CCD camera for photogrammetric measurement, SPIE 2067 (1993)",
        "H. Handel, Compensation of thermal errors in vision based measurement systems using a system identification approach, ICSP 2008",
    ),
    advice="Wait until the camera is warm. Clamp the lens. Calibrate in the orientation in which you measure.",
    reasons={
        "correct": f"{MOVES_POINTS}, from the time or the temperature",
        "propagate": "it depends on the time of the frame, which the probe does not contain",
    },
)
