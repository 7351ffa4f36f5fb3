"""Low-pass filter before the converter: it smooths, and as every causal filter it does so to one side."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.line import group_delay_s, low_pass_poles, reach_px
from pixmetry.camera.line_contribution import through_line
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

SHARE_BEYOND = 1e-4  # of a step, beyond the near context


class LowPass(Parameters):
    """An analogue filter, which may be switched off."""

    kind: Literal["off", "rc", "butterworth", "bessel"] = quantity("off", "1", "kind of filter; rc is a chain of equal RC stages")
    order: int = quantity(3, "1", "number of poles", ge=1, le=8)
    cutoff_mhz: float = quantity(5.0, "MHz", "frequency of −3 dB (of each stage for rc)", ge=0.1, le=200)
    all_pass_mhz: float = quantity(
        0.0, "MHz", "corner frequency of an all-pass section, such as a wrong phase correction; 0: none", ge=0, le=200
    )

    @property
    def zeros(self) -> np.ndarray:
        """In rad/s."""
        return 2e6 * np.pi * self.all_pass_mhz * np.ones(1 if self.all_pass_mhz and self.kind != "off" else 0)

    @property
    def poles(self) -> np.ndarray:
        """In rad/s."""
        low_pass = 2e6 * np.pi * self.cutoff_mhz * low_pass_poles(self.kind, self.order)
        return np.append(low_pass, -self.zeros)


def forward(params: LowPass, signal: Signal, stream: Stream) -> Signal:
    """Pass the line through the filter."""
    if params.kind == "off":
        return signal
    return signal.with_line(signal.own_line.filtered(params.zeros, params.poles))


def near(params: LowPass, pixel_hz: float, row_px: int) -> tuple[int, int, int, int]:
    """Pixels to the left that still reach a pixel."""
    return 0, 0, 0 if params.kind == "off" else reach_px(params.zeros, params.poles, SHARE_BEYOND, pixel_hz), 0


def tail(params: LowPass, pixel_hz: float, row_px: int) -> float:
    """What is left of a step there."""
    return 0.0 if params.kind == "off" else SHARE_BEYOND


def delay_s(params: LowPass) -> float:
    """Group delay at frequency 0: the shift of a centroid, in time; τ for an RC filter, 2/ω_c for a Butterworth filter of third order."""
    return group_delay_s(params.zeros, params.poles)


def measure(observations: Observations) -> Estimates:
    """Kind, order and cut-off from slanted edges: orders 1 to 4 are told apart, all-pass sections are not looked for."""
    found, clock_mhz = observations.video_line({"cutoff_mhz": "cutoff_rel"}, where="grabber.low_pass")
    return found.scaled({"cutoff_mhz": (clock_mhz, "MHz")})


def propagate(params: LowPass, probe: Probe) -> Contribution:
    """The target behind the filter, on the rest of the camera's line."""
    if params.kind == "off":
        return Contribution(u_x_px=0.0, u_y_px=0.0, gum_class="G", method="no filter")
    return through_line(probe, lambda line: line.filtered(params.zeros, params.poles))


SOURCE = Source(
    id="grabber.low_pass",
    title="Low-pass filter",
    description="An anti-aliasing filter delays the line and smears edges to the right. With a fixed threshold, bright and faint "
    "targets shift differently.",
    number=27,
    stars=3,
    note="Note 6",
    parameters=LowPass,
    consumes=(Kind.VIDEO,),
    after=("sensor", "electronics", "cable"),
    before=("grabber.clamp", "grabber.fixed_pattern", "grabber.phase_pattern", "grabber.window_offset", "grabber.adc", "processing"),
    neutral=LowPass(),
    typical=LowPass(kind="butterworth", order=3, cutoff_mhz=5.0),
    bound=LowPass(kind="butterworth", order=3, cutoff_mhz=3.0),
    forward=forward,
    measure=measure,
    propagate=propagate,
    near=near,
    tail=tail,
    applies_to=("analogue",),
    gum_class="G",
    equation="H(s) = Π p_i/(p_i − s) (1 − s/a)/(1 + s/a),  Δx = f_pixel (2/a − Σ 1/p_i)",
    typical_size="0.376 px (RC 6 MHz), 0.564 (RC 4 MHz), 0.903 (Butterworth of third order, 5 MHz), 1.505 px (3 MHz) at 14.19 MHz",
    references=(
        "A. I. Zverev, Handbook of Filter Synthesis, Wiley 1967 (poles of Butterworth and Bessel filters)",
        "H. A. Beyer, IAPRS XXIX-B5, 1992, 561 (response of a grabber's filter to edges)",
    ),
    advice="Switch it off, unless the signal contains frequencies above half the sampling frequency. Calibrate and measure with the "
    "same setting.",
    reasons={
        "correct": "samples at the pixel rate do not tell the line between them, which its inverse needs, and the inverse amplifies the "
        "noise. Its delay moves all targets alike, and is part of the principal point",
    },
)
