"""Termination, impedance and loss of the video cable: what comes back from the far end arrives late, as a ghost to the right."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.line import SMALLEST_ECHO, Line
from pixmetry.camera.line_contribution import through_line
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.cable._undo import without

DELAY_S_PER_M = 2 / (0.66 * 299_792_458.0)  # there and back, at 0.66 of the speed of light
MOST_NEAR = 256  # pixels to the left that the frozen mode follows
NEPER_DB = 20 / np.log(10)
REFERENCE_HZ = 5e6  # at which the loss is stated: the top of the video band
POLES_HZ = np.geomspace(5e3, 150e6, 7)  # of the filter for the skin effect, fitted at the frequencies below
FITTED_HZ = np.geomspace(1e3, 50e6, 400)


class Termination(Parameters):
    """A line of one impedance between a source and a load of others."""

    length_m: float = quantity(5.0, "m", "length of the cable", ge=0, le=200)
    line_ohm: float = quantity(75.0, "Ω", "characteristic impedance of the cable", gt=10, le=300)
    source_ohm: float = quantity(75.0, "Ω", "output impedance of the camera", gt=0, le=1e4)
    load_ohm: float = quantity(75.0, "Ω", "input impedance of the grabber", gt=0, le=1e6)
    loss_db: float = quantity(0.0, "dB", "attenuation over one way, the same at all frequencies", ge=0, le=20)
    skin_db: float = quantity(0.0, "dB", "attenuation over one way at 5 MHz; it grows with the square root of the frequency", ge=0, le=3)

    @property
    def ghost(self) -> float:
        """Amplitude of each echo relative to the one before: Γ_S Γ_L e^(−2 loss)."""
        reflection = [(z - self.line_ohm) / (z + self.line_ohm) for z in (self.source_ohm, self.load_ohm)]
        return reflection[0] * reflection[1] * 10 ** (-self.loss_db / 10)

    @property
    def delay_s(self) -> float:
        """Delay of each echo after the one before."""
        return self.length_m * DELAY_S_PER_M


def time_scale_s(loss_db: float) -> float:
    """T of exp(−√(sT)), which loses so many decibels at 5 MHz: |H| = exp(−√(πfT)). Its step response is erfc(½ √(T/t))."""
    return float((loss_db / NEPER_DB) ** 2 / (np.pi * REFERENCE_HZ))


@lru_cache(maxsize=32)
def skin_filter(loss_db: float) -> tuple[np.ndarray, np.ndarray]:
    """Zeros and poles in rad/s of a rational exp(−√(sT)) with gain 1 at frequency 0.

    H = 1 − Σ r_i s/(s + p_i) with fixed poles, fitted by least squares to 50 MHz: right to 0.2 % (0.7 % at 3 dB). Below 5 kHz,
    where currents fill the conductor, the loss no longer falls. Its zeros are the eigenvalues of A − b c/d of the filter's state space.
    """
    poles, s = 2 * np.pi * POLES_HZ, 2j * np.pi * FITTED_HZ
    wanted = np.exp(-np.sqrt(s * time_scale_s(loss_db))) - 1
    basis = -s[:, None] / (s[:, None] + poles)
    r = np.linalg.lstsq(np.vstack([basis.real, basis.imag]), np.concatenate([wanted.real, wanted.imag]), rcond=None)[0]
    zeros = np.linalg.eigvals(-np.diag(poles) - np.ones((len(r), 1)) * (r * poles) / (1 - r.sum()))
    return zeros.astype(complex), -poles.astype(complex)


def echoes(params: Termination) -> tuple[np.ndarray, np.ndarray]:
    """Delays in s and amplitudes of the signal and its echoes, (1 − ρ) ρ^k; what is too small joins the last one."""
    rho = params.ghost
    if abs(rho) < 1e-12:
        return np.zeros(1), np.ones(1)
    count = max(1, math.ceil(math.log(SMALLEST_ECHO) / math.log(abs(rho))))
    amplitude = (1 - rho) * rho ** np.arange(count + 1)
    amplitude[-1] /= 1 - rho
    return params.delay_s * np.arange(count + 1), amplitude


def forward(params: Termination, signal: Signal, stream: Stream) -> Signal:
    """Add the whole series of echoes, (1 − ρ) Σ ρ^k y(t − kτ): a patch of constant light keeps its level.

    The skin effect acts on all of it once; what an echo loses of its high frequencies on its further ways is not counted.
    """
    line = _through(params, signal.own_line)
    return signal if line is signal.own_line else signal.with_line(line)


def _through(params: Termination, line: Line) -> Line:
    if abs(params.ghost) >= 1e-12:
        line = line.echoed(*echoes(params))
    return line.filtered(*skin_filter(params.skin_db)) if params.skin_db else line


def correct(params: Termination, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Take echoes and skin effect out, behind the other filters of the line (`cable._undo`)."""
    if abs(params.ghost) < 1e-12 and not params.skin_db:
        return signal
    return without(signal, lambda line: _through(params, line))


def near(params: Termination, pixel_hz: float, row_px: int) -> tuple[int, int, int, int]:
    """Pixels to the left until the echoes have fallen below 1e-4; with a skin effect, whose tail is long, the most."""
    if params.skin_db:
        return 0, 0, MOST_NEAR, 0
    rho = abs(params.ghost)
    count = 0 if rho < 1e-4 else math.ceil(math.log(1e-4) / math.log(rho))
    return (0, 0, min(math.ceil(count * params.delay_s * pixel_hz) + 1, MOST_NEAR), 0)


def tail(params: Termination, pixel_hz: float, row_px: int) -> float:
    """Sum of the echoes that come from farther left than `near`, and what the skin effect still lacks of a step there."""
    if params.skin_db:
        lacks = math.erf(0.5 * math.sqrt(time_scale_s(params.skin_db) * pixel_hz / MOST_NEAR))
        return lacks + tail(params.model_copy(update={"skin_db": 0.0}), pixel_hz, row_px)
    if abs(params.ghost) < 1e-12:
        return 0.0
    first = math.floor((near(params, pixel_hz, row_px)[2] - 1) / max(params.delay_s * pixel_hz, 1e-9)) + 1
    return abs(params.ghost) ** first


def measure(observations: Observations) -> Estimates:
    """Length and impedances of a cable that makes the echoes which slanted edges show.

    An echo has an amplitude ρ = Γ_S Γ_L and a delay. For a positive ρ the impedance of the cable is given, between ends of 75 Ω; for a
    negative one those of the ends, of a cable of 75 Ω. Other impedances of the same ρ make the same echoes.
    """
    found, clock_mhz = observations.video_line({"ghost": "ghost_rel", "echo": "echo_px"}, where="cable.termination")
    ghost, length_m = found["ghost"].value, found["echo"].value / (clock_mhz * 1e6) / DELAY_S_PER_M
    root = math.sqrt(abs(ghost))
    units: tuple[str, ...] = ("m", "Ω")
    by_length = length_m / found["echo"].value
    if ghost > 0:
        names: tuple[str, ...] = ("length_m", "line_ohm")
        values = [length_m, 75 * (1 - root) / (1 + root)]
        jacobian = np.array([[0.0, by_length], [-75 / (root * (1 + root) ** 2), 0.0]])
    else:
        names, units = ("length_m", "source_ohm", "load_ohm"), ("m", "Ω", "Ω")
        values = [length_m, 75 * (1 + root) / (1 - root), 75 * (1 - root) / (1 + root)]
        jacobian = np.array([[0.0, by_length], [-75 / (root * (1 - root) ** 2), 0.0], [75 / (root * (1 + root) ** 2), 0.0]])
    told = f"the echo has an amplitude of {ghost:+.4f}: other impedances of cable and ends make the same one"
    return Estimates(
        names,
        np.array(values),
        jacobian @ found.covariance @ jacobian.T,
        np.full(len(names), found.dof.min()),
        units,
        found.method,
        found.confounders,
        reasons=dict.fromkeys(names[1:], told) | {"length_m": "at 0.66 of the speed of light"},
    )


def propagate(params: Termination, probe: Probe) -> Contribution:
    """The target with its echoes, on the rest of the camera's line; for a centroid over everything the first moment, Δx = ρτ/(1 − ρ)."""
    if abs(params.ghost) < 1e-12 and not params.skin_db:
        return Contribution(u_x_px=0.0, u_y_px=0.0, gum_class="G", method="no echo")
    return through_line(probe, lambda line: _through(params, line))


SOURCE = Source(
    id="cable.termination",
    title="Termination and impedance of the cable",
    description="A wrong impedance at both ends reflects part of the signal back and forth. Each echo is a ghost to the right of the "
    "target.",
    number=24,
    stars=2,
    note="Note 11",
    parameters=Termination,
    consumes=(Kind.VIDEO,),
    after=("sensor", "electronics"),
    before=("grabber", "storage"),
    neutral=Termination(),
    typical=Termination(length_m=5.0, line_ohm=50.0),
    bound=Termination(length_m=20.0, line_ohm=50.0, load_ohm=1000.0),
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    near=near,
    tail=tail,
    applies_to=("analogue",),
    gum_class="G",
    equation="y' = (1 − ρ) Σ_k ρ^k y(t − kτ),  ρ = Γ_S Γ_L e^(−2αL),  τ = 2L/(0.66 c);  skin effect: e^(−√(sT))",
    typical_size="0.030 px for 5 m of 50 Ω cable between 75 Ω ends at 14.19 MHz",
    references=("D. M. Pozar, Microwave Engineering, 4th ed., §2.3 (reflection on a terminated line)",),
    leaves="detail that the bandwidth of the line has lost; noise, raised a little",
    advice="Use 75 Ω cable with 75 Ω at both ends, short, without T-pieces; or a digital camera.",
)
