"""A T-piece in front of the grabber: a stub whose far end is open, or a second termination that halves the load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.line import SMALLEST_ECHO
from pixmetry.camera.line_contribution import through_line
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.cable._undo import without

DELAY_S_PER_M = 2 / (0.66 * 299_792_458.0)  # there and back, at 0.66 of the speed of light


class TPiece(Parameters):
    """A branch of the cable at the grabber's input; the camera drives the line through its own impedance."""

    branch: Literal["none", "open", "terminated"] = quantity("none", "1", "no branch, one with an open end, or one with a termination")
    length_m: float = quantity(1.0, "m", "length of the branch", ge=0, le=200)
    branch_ohm: float = quantity(75.0, "Ω", "characteristic impedance of the branch", gt=10, le=300)
    end_ohm: float = quantity(75.0, "Ω", "termination at the end of the branch", gt=0, le=1e6)
    line_ohm: float = quantity(75.0, "Ω", "characteristic impedance of the cable from the camera", gt=10, le=300)
    load_ohm: float = quantity(75.0, "Ω", "input impedance of the grabber", gt=0, le=1e6)

    @property
    def waves(self) -> tuple[float, float, float, float]:
        """T into the junction from the line, T' back into it from the branch, Γ' seen from the branch, Γ_e at its end."""
        line, load, branch = 1 / self.line_ohm, 1 / self.load_ohm, 1 / self.branch_ohm
        end = 1.0 if self.branch == "open" else (self.end_ohm - self.branch_ohm) / (self.end_ohm + self.branch_ohm)
        total = line + load + branch
        return 2 * line / total, 2 * branch / total, 2 * branch / total - 1, end

    @property
    def level(self) -> float:
        """What is left of a constant level, relative to the same cable without the branch."""
        return float(echoes(self)[1].sum())


def echoes(params: TPiece) -> tuple[np.ndarray, np.ndarray]:
    """Delays in s and amplitudes at the junction, relative to the level without the branch.

    A wave enters the junction as T, goes down the branch, comes back as Γ_e, of which T' is seen and Γ' sent back again:
    T [1 + T' Γ_e z/(1 − Γ' Γ_e z)] with z = e^(−sτ). The camera's end takes up what is reflected to it.
    """
    if params.branch == "none":
        return np.zeros(1), np.ones(1)
    into, back, again, end = params.waves
    alone = 2 * params.load_ohm / (params.line_ohm + params.load_ohm)
    rho = again * end
    count = 1 if rho == 0 else 1 + int(np.ceil(np.log(SMALLEST_ECHO) / np.log(abs(rho))))
    k = np.arange(count)
    series = back * end * rho**k
    series[-1] /= 1 - rho
    delay = params.length_m * DELAY_S_PER_M * np.arange(count + 1)
    amplitude = into / alone * np.append(1.0, series)
    keep = amplitude != 0
    return delay[keep], amplitude[keep]


def forward(params: TPiece, signal: Signal, stream: Stream) -> Signal:
    """Add what comes back from the branch, and lower the level by the load that it is."""
    if params.branch == "none":
        return signal
    return signal.with_line(signal.own_line.echoed(*echoes(params)))


def correct(params: TPiece, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Bring the level back and take the echoes out, behind the other filters of the line (`cable._undo`)."""
    if params.branch == "none":
        return signal
    return without(signal, lambda line: line.echoed(*echoes(params)))


def near(params: TPiece, pixel_hz: float, row_px: int) -> tuple[int, int, int, int]:
    """Pixels to the left from which an echo comes."""
    delay, _ = echoes(params)
    return 0, 0, min(int(np.ceil(delay[-1] * pixel_hz)) + 1, 256), 0


def tail(params: TPiece, pixel_hz: float, row_px: int) -> float:
    """Sum of the echoes that come from farther left than `near`."""
    delay, amplitude = echoes(params)
    return float(np.abs(amplitude[delay * pixel_hz > near(params, pixel_hz, row_px)[2]]).sum())


def measure(observations: Observations) -> Estimates:
    """Length of an open branch of matched cable, from slanted edges. A second termination changes the level only: they do not show it."""
    found, clock_mhz = observations.video_line({"length_m": "branch_px"}, where="cable.t_piece")
    length = found.scaled({"length_m": (1 / (clock_mhz * 1e6 * DELAY_S_PER_M), "m")})
    return replace(length, settings={"branch": "open"}, reasons={"length_m": "of a branch of 75 Ω, at 0.66 of the speed of light"})


def propagate(params: TPiece, probe: Probe) -> Contribution:
    """The target with its echoes, on the rest of the camera's line; the level without the target, and thresholds, follow the load."""
    if params.branch == "none":
        return Contribution(u_x_px=0.0, u_y_px=0.0, gum_class="G", method="no branch")
    return through_line(probe, lambda line: line.echoed(*echoes(params)))


SOURCE = Source(
    id="cable.t_piece",
    title="T-piece and double termination",
    description="A branch at the grabber's input loads the line. An open end reflects the signal with a delay; a second termination "
    "lowers it.",
    number=25,
    stars=2,
    note="Note 11",
    parameters=TPiece,
    consumes=(Kind.VIDEO,),
    after=("sensor", "electronics"),
    before=("grabber", "storage"),
    neutral=TPiece(),
    typical=TPiece(branch="open", length_m=5.0),
    bound=TPiece(branch="open", length_m=10.0),
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    near=near,
    tail=tail,
    applies_to=("analogue",),
    option="a T-piece or a second termination",
    gum_class="G",
    equation="y' = T [y + T' Γ_e Σ_k (Γ' Γ_e)^k y(t − (k+1)τ)],  T = 2Y_0/(Y_0 + Y_L + Y_b),  T' = 2Y_b/(Y_0 + Y_L + Y_b),  Γ' = T' − 1",
    typical_size="level 2/3 when terminated twice; an open stub of matched cable moves a target by τ/4: 0.036 px per metre at 14.19 MHz",
    references=("D. M. Pozar, Microwave Engineering, 4th ed., §2.3 and §4.1 (reflection, and junctions of lines)",),
    leaves="detail that the bandwidth of the line has lost; noise, raised a little",
    advice="Remove T-pieces. Or loop the signal through inputs of high impedance, with one termination at the end of the line.",
)
