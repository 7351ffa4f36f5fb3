"""Cover glass of the sensor: a plane plate in the image space refracts slanting rays, and the image is no longer quite in proportion."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.geometry import frame_centre, image_shift, map_contribution
from pixmetry.camera.light import Pull
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import MOVES_POINTS, Parameters, Source, quantity
from pixmetry.core.random import Stream

NEWTON_STEPS = 6  # always, so that a place does not depend on the others of its window


class CoverGlass(Parameters):
    """A plate square to the optical axis, with which the lens was focused."""

    thickness_um: float = quantity(0.0, "µm", "thickness of the plate, or of all plates between lens and sensor; 0: none", ge=0, le=3000)
    index: float = quantity(1.5, "1", "refractive index", ge=1, le=2.5)
    principal_distance_mm: float = quantity(25.0, "mm", "distance of the exit pupil; it gives the angle of the chief ray", ge=4, le=10000)
    pitch_x_um: float = quantity(8.6, "µm", "pixel pitch along x", gt=0, le=100)
    pitch_y_um: float = quantity(8.3, "µm", "pixel pitch along y", gt=0, le=100)


def pull_of(params: CoverGlass, frame_shape: tuple[int, int]) -> Pull:
    """The map from places behind the plate to those without it, by Newton's method in tan θ = r/c.

    The plate draws a chief ray in by t (tan θ − tan θ'), sin θ = n sin θ'. Focusing moves the sensor back by t (1 − 1/n), which gives
    back what is in proportion to tan θ; so a place moves in by t (tan θ/n − tan θ/√(n² + (n² − 1) tan² θ)).
    """
    x0, y0 = frame_centre(frame_shape)
    c_um, n, n2 = 1000 * params.principal_distance_mm, params.index, params.index**2
    part = params.thickness_um / c_um

    def pull(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = np.broadcast_arrays((x - x0) * params.pitch_x_um / c_um, (y - y0) * params.pitch_y_um / c_um)
        seen = np.hypot(a, b)
        t = seen
        for _ in range(NEWTON_STEPS):
            root = np.sqrt(n2 + (n2 - 1) * t * t)
            t = t - (t - part * t * (1 / n - 1 / root) - seen) / (1 - part * (1 / n - n2 / root**3))
        grown = np.divide(t, seen, out=np.ones_like(seen), where=seen > 0)
        return x0 + (x - x0) * grown, y0 + (y - y0) * grown

    return pull


def forward(params: CoverGlass, signal: Signal, stream: Stream) -> Signal:
    """Look where the rays would have landed without the plate."""
    if not params.thickness_um or params.index == 1:
        return signal
    return signal.with_light(signal.own_light.moved(pull_of(params, signal.frame_shape)))


def truth(params: CoverGlass, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Displacement of the image at every pixel, shape (rows, cols)."""
    return {name: shift[0] for name, shift in image_shift(pull_of(params, signal.frame_shape), signal).items()}


def propagate(params: CoverGlass, probe: Probe) -> Contribution:
    """Displacement of targets all over the frame, before a calibration takes it up."""
    return map_contribution(pull_of(params, probe.frame_shape), probe)


SOURCE = Source(
    id="optics.cover_glass",
    title="Cover glass of the sensor",
    description="The window over the sensor refracts oblique rays. After focusing, a radial shift remains that grows with the third "
    "power of the radius.",
    note="successor of the sensor's alignment",
    parameters=CoverGlass,
    consumes=(Kind.LIGHT,),
    before=("sensor",),
    neutral=CoverGlass(),
    typical=CoverGlass(thickness_um=750.0, principal_distance_mm=5.0),
    bound=CoverGlass(thickness_um=1000.0, principal_distance_mm=4.0),
    forward=forward,
    truth=truth,
    propagate=propagate,
    gum_class="G",
    equation="Δr = −t (tan θ/n − tan θ'),  sin θ = n sin θ',  tan θ = r/c;  ≈ −t (n² − 1)/(2 n³) tan³θ",
    typical_size="0.75 mm of glass: 0.75 µm inwards at 10°, 6.3 µm at 20°; below 0.01 µm where the lens is telecentric on the image side",
    references=("M. Born, E. Wolf, Principles of Optics, 7th ed. 1999, §1.5 (law of refraction)",),
    advice="Calibrate with the glass in place: K1 includes nearly all of it.",
    reasons={
        "measure": "a plate displaces along the radius by an odd polynomial of the radius, as the lens does: a thicker plate and another "
        "distortion leave all coordinates the same. Light of several wavelengths tells no more, for the index of glass "
        "changes by 1 % from 450 nm to 850 nm; take its thickness from the sensor's drawing",
        "correct": f"{MOVES_POINTS}, by the calibration",
    },
)
