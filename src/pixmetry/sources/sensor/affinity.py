"""Affinity and shear: rows and columns of the image that are not square to each other, or of different scales."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.geometry import frame_centre, image_shift, map_contribution
from pixmetry.camera.light import Pull
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import MOVES_POINTS, Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class Affinity(Parameters):
    """The additional parameters b₁ and b₂ of a bundle adjustment."""

    b1: float = quantity(0.0, "1", "ratio of the scales along x and y, minus 1", ge=-0.1, le=0.1)
    b2: float = quantity(0.0, "1", "shear: displacement along x over the distance along y", ge=-0.1, le=0.1)


def pull_of(params: Affinity, frame_shape: tuple[int, int]) -> Pull:
    """The map from places in the sheared image to ideal ones; the frame's centre stays."""
    x0, y0 = frame_centre(frame_shape)
    return lambda x, y: (x0 + ((x - x0) - params.b2 * (y - y0)) / (1 + params.b1), y + 0 * x)


def measure(observations: Observations) -> Estimates:
    """Read both from a calibration with targets."""
    return observations.calibrated(("b1", "b2"), where="sensor.affinity")


def forward(params: Affinity, signal: Signal, stream: Stream) -> Signal:
    """Shear and stretch the image along x."""
    return signal.with_light(signal.own_light.moved(pull_of(params, signal.frame_shape))) if params.b1 or params.b2 else signal


def truth(params: Affinity, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Displacement of the image at every pixel, shape (rows, cols)."""
    return {name: shift[0] for name, shift in image_shift(pull_of(params, signal.frame_shape), signal).items()}


def propagate(params: Affinity, probe: Probe) -> Contribution:
    """Displacement of targets all over the frame, before a calibration takes it up."""
    return map_contribution(pull_of(params, probe.frame_shape), probe)


SOURCE = Source(
    id="sensor.affinity",
    title="Affinity and shear of the image",
    description="The axes have different scales, or are not at right angles. The layout of the sensor or the timing of the read-out "
    "causes it.",
    number=7,
    stars=2,
    parameters=Affinity,
    consumes=(Kind.LIGHT,),
    neutral=Affinity(),
    typical=Affinity(b1=1e-4, b2=5e-5),
    bound=Affinity(b1=1e-3, b2=5e-4),
    forward=forward,
    truth=truth,
    propagate=propagate,
    gum_class="G",
    equation="x' = x (1 + b₁) + b₂ y",
    typical_size="0.04 px at the edge of 752 columns for b₁ = 1e-4; known to 1e-5 after a calibration",
    references=(
        "H. A. Beyer, Geometric and radiometric analysis of a CCD-camera based photogrammetric close-range system, ETH Zürich 1992",
        "C. S. Fraser, Digital camera self-calibration, ISPRS J. 52 (1997) 149–159",
    ),
    advice="Let the calibration estimate both, with images rolled by 90°.",
    measure=measure,
    reasons={
        "correct": f"{MOVES_POINTS}, by the calibration",
    },
)
