"""Lens distortion: the image of a point is shifted from its ideal position, by Brown's polynomial."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.geometry import frame_centre, image_shift, map_contribution
from pixmetry.camera.light import Pull
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import MOVES_POINTS, Parameters, Source, quantity
from pixmetry.core.errors import ParameterError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.optics._distortion_kernels import inverse, polynomial

RADIAL = ("k1_per_mm2", "k2_per_mm4", "k3_per_mm6", "k4_per_mm8", "k5_per_mm10")
CHECKED_PLACES = 33  # along each side of the frame, where the map must not fold


class Distortion(Parameters):
    """Radial and tangential coefficients on the image plane in millimetres, about a centre of their own."""

    direction: Literal["image_to_object", "object_to_image"] = quantity(
        "image_to_object",
        "name",
        "direction of the polynomial: from distorted to ideal positions (photogrammetry), or from ideal to distorted positions",
    )
    k1_per_mm2: float = quantity(0.0, "1/mm²", "radial, r³", ge=-0.1, le=0.1)
    k2_per_mm4: float = quantity(0.0, "1/mm⁴", "radial, r⁵", ge=-0.01, le=0.01)
    k3_per_mm6: float = quantity(0.0, "1/mm⁶", "radial, r⁷", ge=-0.001, le=0.001)
    k4_per_mm8: float = quantity(0.0, "1/mm⁸", "radial, r⁹", ge=-1e-4, le=1e-4)
    k5_per_mm10: float = quantity(0.0, "1/mm¹⁰", "radial, r¹¹", ge=-1e-5, le=1e-5)
    p1_per_mm: float = quantity(0.0, "1/mm", "tangential, (r² + 2x²) in x and 2xy in y", ge=-0.01, le=0.01)
    p2_per_mm: float = quantity(0.0, "1/mm", "tangential, 2xy in x and (r² + 2y²) in y", ge=-0.01, le=0.01)
    centre_x_px: float = quantity(0.0, "px", "centre of distortion minus the frame's centre, along x", ge=-1000, le=1000)
    centre_y_px: float = quantity(0.0, "px", "centre of distortion minus the frame's centre, along y", ge=-1000, le=1000)
    pitch_x_um: float = quantity(8.6, "µm", "pixel pitch along x", gt=0, le=100)
    pitch_y_um: float = quantity(8.3, "µm", "pixel pitch along y", gt=0, le=100)

    @property
    def coefficients(self) -> tuple[float, ...]:
        """K1 to K5, P1, P2."""
        return (*(getattr(self, name) for name in RADIAL), self.p1_per_mm, self.p2_per_mm)


def pull_of(params: Distortion, frame_shape: tuple[int, int]) -> Pull:
    """The map from places in the image to ideal places, in pixels.

    Raises
    ------
    ParameterError
        If the map folds, or has no inverse, somewhere in the frame.
    """
    _check(params, tuple(frame_shape))
    return _pull(params, frame_shape)


def _pull(params: Distortion, frame_shape: tuple[int, int]) -> Pull:
    x0, y0 = (c + d for c, d in zip(frame_centre(frame_shape), (params.centre_x_px, params.centre_y_px), strict=True))
    mm_x, mm_y = params.pitch_x_um / 1000, params.pitch_y_um / 1000
    kernel = polynomial if params.direction == "image_to_object" else inverse

    def pull(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = np.broadcast_arrays((x - x0) * mm_x, (y - y0) * mm_y)
        u, v = kernel(np.ascontiguousarray(a).ravel(), np.ascontiguousarray(b).ravel(), *params.coefficients)
        return x0 + u.reshape(a.shape) / mm_x, y0 + v.reshape(a.shape) / mm_y

    return pull


@lru_cache(maxsize=64)
def _check(params: Distortion, frame_shape: tuple[int, int]) -> None:
    """Refuse a map whose Jacobian is not positive at places all over the frame and around it."""
    rows, cols = frame_shape
    y, x = np.meshgrid(np.linspace(-1, rows, CHECKED_PLACES), np.linspace(-1, cols, CHECKED_PLACES), indexing="ij")
    pull, step = _pull(params, frame_shape), 1e-3
    (ax, ay), (bx, by), (cx, cy) = pull(x, y), pull(x + step, y), pull(x, y + step)
    det = ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) / step**2
    sound = np.isfinite(det) & (det > 0)
    if params.direction == "object_to_image":  # Newton's method must have arrived
        forth = params.model_copy(update={"direction": "image_to_object"})
        u, v = _pull(forth, frame_shape)(ax, ay)
        sound &= np.hypot(u - x, v - y) < 1e-8
    if not sound.all():
        raise ParameterError(
            "the distortion folds the image",
            where="optics.distortion",
            value=params.coefficients,
            allowed="coefficients for which every position in the frame has exactly one ideal position",
            remedy="reduce K1 to K5 (they refer to millimetres on the sensor), or check the pixel pitch",
        )


def forward(params: Distortion, signal: Signal, stream: Stream) -> Signal:
    """Look at the ideal places."""
    if not any(params.coefficients):
        return signal
    return signal.with_light(signal.own_light.moved(pull_of(params, signal.frame_shape)))


def truth(params: Distortion, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Displacement of the image at every pixel, shape (rows, cols)."""
    return {name: shift[0] for name, shift in image_shift(pull_of(params, signal.frame_shape), signal).items()}


def propagate(params: Distortion, probe: Probe) -> Contribution:
    """Propagator P6: the displacement itself, all over the frame, as long as nothing is calibrated."""
    return map_contribution(pull_of(params, probe.frame_shape), probe)


MEASURED = (*RADIAL, "p1_per_mm", "p2_per_mm", "centre_x_px", "centre_y_px", "pitch_x_um", "pitch_y_um")


def measure(observations: Observations) -> Estimates:
    """Read the polynomial from a calibration with targets."""
    return observations.calibrated(MEASURED, where="optics.distortion")


_BOUND: dict[str, Any] = {"k1_per_mm2": -1.5e-3, "k2_per_mm4": 2e-5, "p1_per_mm": 5e-5, "p2_per_mm": -5e-5}

SOURCE = Source(
    id="optics.distortion",
    title="Lens distortion",
    description="A point is imaged nearer to the centre or farther from it than in a pinhole camera. If lenses are decentred, it is "
    "also shifted sideways.",
    parameters=Distortion,
    consumes=(Kind.LIGHT,),
    before=("sensor",),
    neutral=Distortion(),
    typical=Distortion(k1_per_mm2=-5e-4, p1_per_mm=2e-5),
    bound=Distortion(**_BOUND),
    forward=forward,
    truth=truth,
    propagate=propagate,
    gum_class="G",
    equation="x' = x (1 + K1 r² + K2 r⁴ + K3 r⁶ + K4 r⁸ + K5 r¹⁰) + P1 (r² + 2x²) + 2 P2 x y;  y' likewise with P1 and P2 exchanged",
    typical_size="up to 10 µm or more in a corner before calibration, under 0.02 px after it",
    references=(
        "D. C. Brown, Close-range camera calibration, Photogrammetric Engineering 37 (1971) 855–866",
        "A. E. Conrady, Decentred lens-systems, MNRAS 79 (1919) 384–390",
    ),
    advice="Calibrate the camera with targets all over the image, and correct every position.",
    measure=measure,
    reasons={
        "correct": f"{MOVES_POINTS}, by the calibration",
    },
)
