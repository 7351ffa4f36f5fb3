"""Logarithmic response of a CMOS pixel: its voltage is the logarithm of the photocurrent, with its own offset, slope and dark light."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream

BOLTZMANN_V_PER_K = 8.617333262e-5  # k/q, CODATA 2018
ZERO_C_K = 273.15
LEAST_REL = 1e-3  # of its mean, below which no pixel's slope or foot falls


class LogResponse(Parameters):
    """y = a + b f(x/c) of the electrons x that one exposure would gather, with a spread of a, b and c over the pixels of a unit."""

    mode: Literal["log", "lin-log"] = quantity("log", "1", "f(s) = ln(1 + s); or s up to a knee k, then k + ln(1 + s − k)")
    gain_dn_per_v: float = quantity(1000.0, "DN/V", "steps of the converter per volt", gt=0, le=1e8)
    slope_factor: float = quantity(
        1.0, "1", "slope factor n of the transistor below threshold: b = n kT/q per factor e of light", ge=1, le=3
    )
    foot_e: float = quantity(100.0, "e-", "c: light at which the response becomes logarithmic, dark current included", gt=0, le=1e7)
    knee_e: float = quantity(0.0, "e-", "lin-log: light up to which the response is linear", ge=0, le=1e7)
    offset_dn: float = quantity(0.0, "DN", "mean of a, the dark signal", ge=-1e5, le=1e5)
    offset_std_dn: float = quantity(0.0, "DN", "standard deviation of a over the pixels", ge=0, le=1e5)
    noise_dn: float = quantity(0.0, "DN", "temporal noise of pixel and read-out, the same at all levels: standard deviation", ge=0, le=1e4)
    slope_std_rel: float = quantity(0.0, "1", "relative standard deviation of b over the pixels", ge=0, le=0.3)
    foot_std_rel: float = quantity(0.0, "1", "relative standard deviation of c over the pixels", ge=0, le=0.3)


class Pixels(NamedTuple):
    """a in DN, b over its mean, c in electrons, of every pixel (or one number for all)."""

    a_dn: np.ndarray
    b_rel: np.ndarray
    c_e: np.ndarray


def pixels_of(params: LogResponse, grid: Grid, stream: Stream) -> Pixels:
    """The response of every pixel of the unit, arrays (n, rows, cols), float32."""
    one = np.float32(1)
    a = stream.add_normal_fixed(np.float32(params.offset_dn), grid, params.offset_std_dn, draw=0)
    b = np.maximum(stream.add_normal_fixed(one, grid, params.slope_std_rel, draw=1), np.float32(LEAST_REL))
    c = np.maximum(stream.add_normal_fixed(one, grid, params.foot_std_rel, draw=2), np.float32(LEAST_REL))
    return Pixels(a, b, np.float32(params.foot_e) * c)


def slope_dn(params: LogResponse, temperature_c: np.ndarray | float) -> np.ndarray:
    """Mean b in DN per factor e of light; n kT/q ln 10 is 59.5 mV a decade at 300 K for n = 1."""
    return params.gain_dn_per_v * params.slope_factor * BOLTZMANN_V_PER_K * (np.asarray(temperature_c, float) + ZERO_C_K)


def response_dn(params: LogResponse, electrons: np.ndarray, b_dn: np.ndarray | float, pixels: Pixels) -> np.ndarray:
    """Signal in DN of these electrons; less than none counts as none."""
    x = np.maximum(electrons, 0) / pixels.c_e
    if params.mode == "log":
        f = np.log1p(x)
    else:
        above = np.maximum(x - params.knee_e / pixels.c_e, 0)
        f = x - above + np.log1p(above)
    response: np.ndarray = pixels.a_dn + b_dn * pixels.b_rel * f
    return response


def forward(params: LogResponse, signal: Signal, stream: Stream) -> Signal:
    """Turn electrons into DN; it stands where ``electronics.gain`` does in a linear camera.

    Its own noise comes behind the logarithm: ahead of it, amplifier noise in electrons would be largest in the dark.
    """
    b = slope_dn(params, signal.temperature_c).astype(np.float32)[:, None, None]
    data = response_dn(params, signal.data, b, pixels_of(params, signal.grid, stream))
    return signal.with_data(stream.add_normal(data.astype(np.float32), signal.grid, params.noise_dn), Kind.DN)


def truth(params: LogResponse, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """a, b and c of every pixel, b at the temperature of the first frame."""
    one = signal.take(np.array([0]))
    a, b, c = (v[0] for v in pixels_of(params, one.grid, stream))
    return {"a_dn": a, "b_dn": b * float(slope_dn(params, one.temperature_c[0])), "c_e": c}


def measure(observations: Observations) -> Estimates:
    """Mean curve from patches of known light: slope (for a slope factor of 1), foot in electrons, and black.

    Spread of the pixels and noise are not told by patches.
    """
    names = {"gain_dn_per_v": "gain_dn_per_v", "foot_e": "foot_e"}
    return observations.curve(names, where="sensor.log_response")


def ideal(params: LogResponse) -> LogResponse:
    """The same response in every pixel, without noise."""
    return params.model_copy(update={"offset_std_dn": 0.0, "slope_std_rel": 0.0, "foot_std_rel": 0.0, "noise_dn": 0.0})


def propagate(params: LogResponse, probe: Probe) -> Contribution:
    """Propagator P1 on the target as it is seen, in logarithmic DN: the spread of line, slope and foot, and the noise.

    With y = b f(x/c) above black, a slope that is off by ε adds ε y, and a foot that is off by ε takes ε b s f'(s) away, s = x/c;
    above a knee k of light, which is k/c of the foot, ε b (k/c + s' f'(s')) with s' = s − k/c.
    """
    b = float(slope_dn(params, probe.temperature_c))
    f = np.maximum(probe.signal_dn, 0.0) / b
    knee = 0.0 if params.mode == "log" else params.knee_e / params.foot_e
    below, above = np.minimum(f, knee), np.expm1(np.maximum(f - knee, 0.0))
    parts = (
        probe.white(params.offset_std_dn),
        probe.white(params.slope_std_rel * b * f),
        probe.white(params.foot_std_rel * b * (below + above / (1 + above))),
    )
    time = probe.white(params.noise_dn)
    u_x, u_y = (float(np.sqrt(sum(p[axis] ** 2 for p in (*parts, time)))) for axis in (0, 1))
    method = "linear response of the estimator, in logarithmic DN, to the spread of the pixels' curves and to noise"
    return Contribution(u_x, u_y, "F", model_error=0.2, method=method, time_px=time)


SOURCE = Source(
    id="sensor.log_response",
    title="Logarithmic response",
    description="The pixel does not integrate; its output is the logarithm of the light. Every pixel has its own offset a, slope b and "
    "light c.",
    note="Section 3.2",
    parameters=LogResponse,
    consumes=(Kind.ELECTRONS,),
    produces=Kind.DN,
    essential=True,
    after=("optics", "sensor.shot_noise"),
    before=("electronics",),
    typical=LogResponse(offset_std_dn=1.8, slope_std_rel=0.01, foot_std_rel=0.05, noise_dn=0.3),
    bound=LogResponse(offset_std_dn=6.0, slope_std_rel=0.03, foot_std_rel=0.2, noise_dn=1.0),
    ideal=ideal,
    forward=forward,
    measure=measure,
    propagate=propagate,
    truth=truth,
    applies_to=("cmos",),
    option="a logarithmic response",
    gum_class="F",
    equation="y = a + b ln(1 + x/c) + noise,  b = n kT/q · gain;  lin-log: linear up to a knee, then logarithmic with the same slope",
    typical_size="a spread of a by 1–3 % of a decade is 2.3–7 % of the light: 0.005–0.016 px on a disc of 7 px (linearised)",
    references=(
        "D. Joseph, S. Collins, IEEE Trans. Instrum. Meas. 51(5), 996, 2002 (a, b, c of every pixel)",
        "EMVA 1288 R4.0 General",
    ),
    advice="Calibrate a, b and c of every pixel at four uniform levels or more, and invert the response before measuring.",
    reasons={
        "correct": "each pixel has a curve of its own, whose offset, slope and foot dark and flat stacks at one level do not show. It "
        "needs maps of all three, from flat fields over decades of light",
        "neutral": "it is a conversion: without it there is no digital signal",
    },
)
