"""Video amplifier of the camera: of second order; where it is under-damped or wrongly loaded, edges overshoot and ring."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.line import reach_px
from pixmetry.camera.line_contribution import through_line
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

SHARE_BEYOND = 1e-4  # of a step, beyond the near context


class VideoAmplifier(Parameters):
    """The last stage that drives the line."""

    natural_mhz: float = quantity(8.0, "MHz", "natural frequency, ω0/2π", ge=0.1, le=200)
    damping: float = quantity(0.7, "1", "damping ratio ζ: below 1 it overshoots", ge=0.05, le=10)

    @property
    def poles(self) -> np.ndarray:
        """In rad/s, −ω0 (ζ ± √(ζ² − 1))."""
        root = np.sqrt(complex(self.damping**2 - 1))
        return 2e6 * math.pi * self.natural_mhz * np.array([-self.damping + root, -self.damping - root])

    @property
    def overshoot(self) -> float:
        """Share by which the response to a step passes its end value, e^(−πζ/√(1 − ζ²))."""
        return math.exp(-math.pi * self.damping / math.sqrt(1 - self.damping**2)) if self.damping < 1 else 0.0


def forward(params: VideoAmplifier, signal: Signal, stream: Stream) -> Signal:
    """Pass the line through ω0²/(s² + 2ζω0 s + ω0²)."""
    return signal.with_line(signal.own_line.filtered([], params.poles))


def near(params: VideoAmplifier, pixel_hz: float, row_px: int) -> tuple[int, int, int, int]:
    """Pixels to the left until the ringing has died away."""
    return 0, 0, reach_px([], params.poles, SHARE_BEYOND, pixel_hz), 0


def tail(params: VideoAmplifier, pixel_hz: float, row_px: int) -> float:
    """What is left of a step there."""
    return SHARE_BEYOND


def measure(observations: Observations) -> Estimates:
    """Natural frequency and damping from slanted edges."""
    names = {"natural_mhz": "natural_rel", "damping": "damping"}
    found, clock_mhz = observations.video_line(names, where="electronics.video_amplifier")
    return replace(found.scaled({"natural_mhz": (clock_mhz, "MHz")}), settings={})


def propagate(params: VideoAmplifier, probe: Probe) -> Contribution:
    """The target behind the amplifier, on the rest of the camera's line; for a centroid over everything the first moment, 2ζ/ω0."""
    return through_line(probe, lambda line: line.filtered([], params.poles))


SOURCE = Source(
    id="electronics.video_amplifier",
    title="Video amplifier",
    description="The camera's output stage delays the signal. If it is under-damped, it rings after edges.",
    note="Note 11",
    parameters=VideoAmplifier,
    consumes=(Kind.VIDEO,),
    after=(
        "sensor",
        "electronics.agc",
        "electronics.amplifier_noise",
        "electronics.column_noise",
        "electronics.flicker_noise",
        "electronics.gain",
        "electronics.gamma",
        "electronics.nonlinearity",
        "electronics.row_noise",
        "electronics.supply_pickup",
        "electronics.tap_gain",
        "electronics.telegraph_noise",
    ),  # fmt: skip
    before=("cable", "grabber", "storage"),
    typical=VideoAmplifier(natural_mhz=5.0, damping=0.25),
    bound=VideoAmplifier(natural_mhz=5.0, damping=0.2),
    forward=forward,
    measure=measure,
    propagate=propagate,
    near=near,
    tail=tail,
    applies_to=("analogue",),
    gum_class="G",
    equation="H(s) = ω0²/(s² + 2ζω0 s + ω0²),  Δx = 2ζ f_pixel/ω0",
    typical_size="0.18 to 0.27 px for ζ = 0.2 to 0.3 at f0 = 5 MHz and 14.19 MHz; a step overshoots by 53 to 37 %",
    references=("K. Ogata, Modern Control Engineering, 5th ed., §5-3 (second-order systems)",),
    advice="Load the output with its 75 Ω; use a camera with a flat video band, or a digital one.",
    reasons={
        "correct": "samples at the pixel rate do not tell the line between them, which its inverse needs, and the inverse amplifies the "
        "noise. Its delay moves all targets alike, and is part of the principal point",
        "neutral": "every amplifier has an upper frequency limit; switch the source off for a line without limit",
    },
)
