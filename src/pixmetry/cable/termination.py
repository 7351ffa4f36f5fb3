"""Termination and impedance of the video cable: what comes back from the far end arrives late, as a ghost to the right."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from pixmetry.cable._kernels import add_ghosts, remove_ghosts
from pixmetry.core.contribution import Contribution, Probe
from pixmetry.core.random import Stream
from pixmetry.core.signal import Kind, Signal, Windows
from pixmetry.core.source import Parameters, Source, quantity

DELAY_NS_PER_M = 1e9 / (0.66 * 299_792_458.0) * 2  # there and back, at 0.66 of the speed of light


class Termination(Parameters):
    """A line of one impedance between a source and a load of others."""

    length_m: float = quantity(5.0, "m", "length of the cable", ge=0, le=200)
    line_ohm: float = quantity(75.0, "Ω", "characteristic impedance of the cable", gt=10, le=300)
    source_ohm: float = quantity(75.0, "Ω", "output impedance of the camera", gt=0, le=1e4)
    load_ohm: float = quantity(75.0, "Ω", "input impedance of the grabber", gt=0, le=1e6)
    loss_db: float = quantity(0.0, "dB", "attenuation over one way", ge=0, le=20)
    pixel_clock_mhz: float = quantity(14.1875, "MHz", "pixels per microsecond on the line", gt=0.1, le=1000)

    @property
    def ghost(self) -> float:
        """Amplitude of each echo relative to the one before: Γ_S Γ_L e^(−2 loss)."""
        reflection = [(z - self.line_ohm) / (z + self.line_ohm) for z in (self.source_ohm, self.load_ohm)]
        return reflection[0] * reflection[1] * 10 ** (-self.loss_db / 10)

    @property
    def delay_px(self) -> float:
        """Delay of each echo in pixels."""
        return self.length_m * DELAY_NS_PER_M * self.pixel_clock_mhz * 1e-3


def echoes(params: Termination) -> int:
    """How many echoes stand above 1e-7 of the signal."""
    return 0 if abs(params.ghost) < 1e-12 else math.ceil(math.log(1e-7) / math.log(abs(params.ghost)))


def forward(params: Termination, signal: Signal, stream: Stream) -> Signal:
    """Add the whole series of echoes, (1 − ρ) Σ ρ^k y(x − kτ): a patch of constant light keeps its level."""
    if params.ghost == 0.0:
        return signal
    return signal.with_data(add_ghosts(np.ascontiguousarray(signal.data, np.float32), params.ghost, params.delay_px, echoes(params)))


def correct(params: Termination, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Take the echoes out with the exact inverse of the series, y'(x) = (y(x) − ρ y'… ) up to interpolation."""
    if params.ghost == 0.0:
        return signal
    return signal.with_data(remove_ghosts(np.ascontiguousarray(signal.data, np.float32), params.ghost, params.delay_px))


def context(params: Termination, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The whole row: an echo comes from anywhere to the left."""
    return windows.full_rows(frame_shape)


def near(params: Termination) -> tuple[int, int, int, int]:
    """Pixels to the left until the echoes have fallen below 1e-4."""
    rho = abs(params.ghost)
    count = 0 if rho < 1e-4 else math.ceil(math.log(1e-4) / math.log(rho))
    return (0, 0, min(math.ceil(count * params.delay_px) + 1, 256), 0)


def tail(params: Termination) -> float:
    """Sum of the echoes that come from farther left than `near`."""
    if params.ghost == 0.0:
        return 0.0
    first = math.floor((near(params)[2] - 1) / max(params.delay_px, 1e-9)) + 1
    return abs(params.ghost) ** first


def propagate(params: Termination, probe: Probe) -> Contribution:
    """The target with its echoes seen by the estimator; for a centroid over everything it is the first moment, Δx = ρτ/(1 − ρ)."""
    if params.ghost == 0.0:
        return Contribution(u_x_px=0.0, u_y_px=0.0, gum_class="G", method="no echo")
    ghosted = add_ghosts(
        np.ascontiguousarray(probe.signal_dn - probe.background_dn, np.float32), params.ghost, params.delay_px, echoes(params)
    )
    dx, dy = probe.moved(ghosted + probe.background_dn)
    return probe.from_shifts(dx, dy, "G", model_error=0.1, method="the estimator on the target with its echoes")


SOURCE = Source(
    id="cable.termination",
    title="Termination and impedance of the cable",
    description="A wrong impedance at both ends sends part of the signal to and fro; each echo is a ghost to the right of its target.",
    number=24,
    stars=2,
    note="Note 11",
    parameters=Termination,
    consumes=(Kind.DN,),
    after=("sensor", "electronics"),
    before=("grabber", "storage"),
    neutral=Termination(),
    typical=Termination(length_m=5.0, line_ohm=50.0),
    bound=Termination(length_m=20.0, line_ohm=50.0, load_ohm=1000.0),
    forward=forward,
    correct=correct,
    propagate=propagate,
    context=context,
    near=near,
    tail=tail,
    applies_to=("analogue",),
    gum_class="G",
    equation="y' = (1 − ρ) Σ_k ρ^k y(x − kτ),  ρ = Γ_S Γ_L e^(−2αL),  τ = 2L/(0.66 c) f_pixel",
    typical_size="0.030 px for 5 m of 50 Ω cable between 75 Ω ends at 14.19 MHz",
    references=("D. M. Pozar, Microwave Engineering, 4th ed., §2.3 (reflection on a terminated line)",),
    advice="Use 75 Ω cable with 75 Ω at both ends, short, without T-pieces; or a digital camera.",
    reasons={"measure": "needs the image of a sharp edge or line: dark and flat frames do not carry it"},
)
