"""Charge injection: the reset leaves an uncertain charge on the sense node, and clock edges couple into the signal."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.random import Stream

BOLTZMANN_J_PER_K = 1.380649e-23  # SI 2019, exact
ELECTRON_C = 1.602176634e-19  # SI 2019, exact
ZERO_C_K = 273.15


class ChargeInjection(Parameters):
    """Reset noise of the sense node, injected charge, and the feed-through of clock edges."""

    node_ff: float = quantity(0.0, "fF", "capacitance C of the sense node; 0 for no reset noise", ge=0, le=1e5)
    injection_std_e: float = quantity(0.0, "e-", "scatter of the charge that the clocks inject into each sample", ge=0, le=1e4)
    cds: bool = quantity(False, "1", "correlated double sampling: the reset level of each pixel, half a pixel earlier, is subtracted")
    spike_e: float = quantity(0.0, "e-", "depth of the negative transient in a sample taken at the clock edge", ge=0, le=1e5)
    spike_period_px: int = quantity(2, "px", "period of the clock edges in columns, from column 0 on", ge=1, le=4096)
    settling_px: float = quantity(0.5, "px", "time constant of the transient, in periods of the pixel clock", gt=0, le=1000)


def noise_e(params: ChargeInjection, temperature_c: np.ndarray | float) -> np.ndarray:
    """Temporal noise in electrons: √(kTC)/q of the reset, which double sampling removes, and the injection, which it counts twice."""
    kelvin = np.asarray(temperature_c, float) + ZERO_C_K
    if params.cds:
        return np.full(kelvin.shape, np.sqrt(2) * params.injection_std_e)
    reset = np.sqrt(BOLTZMANN_J_PER_K * kelvin * params.node_ff * 1e-15) / ELECTRON_C
    return np.hypot(reset, params.injection_std_e)


def feed_through_e(params: ChargeInjection, cols: np.ndarray) -> np.ndarray:
    """Fixed pattern −a e^(−t/τ) at columns t after the last edge; with double sampling the difference of two points half a column apart."""
    after = np.exp(-(cols % params.spike_period_px) / params.settling_px)
    depth = params.spike_e * (np.expm1(-0.5 / params.settling_px) if params.cds else 1.0)
    return -depth * after


def forward(params: ChargeInjection, signal: Signal, stream: Stream) -> Signal:
    """Add the noise of the reset and of the injection, new in every pixel and frame, and the fixed pattern of the clock."""
    data, noise = signal.data, noise_e(params, signal.temperature_c).astype(np.float32)
    if noise.any():
        data = stream.add_normal(data, signal.grid, noise[:, None, None])
    if params.spike_e:
        data = data + feed_through_e(params, signal.cols).astype(np.float32)[:, None, :]
    return signal.with_data(data)


def truth(params: ChargeInjection, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Fixed pattern of the columns in electrons."""
    return {"feed_through_e": feed_through_e(params, signal.cols[0])}


def propagate(params: ChargeInjection, probe: Probe) -> Contribution:
    """Propagator P1 with white noise, and the clock's pattern at every phase to the target; the class is that of the larger part."""
    gain, m = probe.gain_dn_per_e, params.spike_period_px
    u_x, u_y = probe.white(gain * float(noise_e(params, probe.temperature_c)))
    method = "linear response of the estimator to white noise and to the clock pattern at every phase"
    if not params.spike_e or m == 1:
        return probe.contribution((u_x, u_y), "T", model_error=0.12, method=method)
    pattern = gain * feed_through_e(params, np.arange(m))
    pattern -= np.median(pattern)  # the level of the background, which comes off
    cols = np.arange(probe.gx.shape[2])
    shifts = np.array([probe.field(np.broadcast_to(pattern[(cols + k) % m], probe.gx.shape)) for k in range(m)])
    bias, fixed = shifts.mean(axis=(0, 2)), shifts.std(axis=(0, 2))
    return Contribution(
        u_x_px=float(np.hypot(u_x, fixed[0])),
        u_y_px=float(np.hypot(u_y, fixed[1])),
        bias_x_px=float(bias[0]),
        bias_y_px=float(bias[1]),
        gum_class="F" if fixed[0] > u_x else "T",
        model_error=0.15,
        method=method,
    )


SOURCE = Source(
    id="sensor.charge_injection",
    title="Charge injection and reset noise",
    description="The reset of the sense node leaves a noise charge of √(kTC), and clock edges couple into the signal. This gives noise "
    "and a pattern of columns.",
    number=16,
    stars=1,
    parameters=ChargeInjection,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.shot_noise", "sensor.full_well", "sensor.charge_transfer"),
    before=("electronics",),
    neutral=ChargeInjection(),
    typical=ChargeInjection(node_ff=10.0, spike_e=20.0),
    bound=ChargeInjection(node_ff=30.0, injection_std_e=30.0, spike_e=100.0),
    forward=forward,
    truth=truth,
    propagate=propagate,
    option="a reset of the sense node for every pixel",
    gum_class="T",
    equation="σ = √(kTC)/q;  pattern −a e^(−t/τ);  with double sampling √2 σ_inj and a e^(−t/τ) (1 − e^(−1/2τ))",
    typical_size="40 e- for 10 fF at 300 K: 0.002 px on a disc of 7 px at 15 000 electrons",
    references=("J. R. Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, ch. 6 (reset noise, double sampling)",),
    advice="Use correlated double sampling and a slow clock; subtract a dark frame for the pattern of the clock.",
    reasons={
        "measure": "dark frames give the sum of its noise and the amplifier's: both are white in space and time, with and without double "
        "sampling, and less of one with more of the other leaves all frames alike. Frames at one clock rate do not tell them "
        "apart; the fixed pattern of its clock is part of the DSNU",
        "correct": "a frame with other noise and another scene has the same values: noise cannot be removed from a single frame. The "
        "dark frame that sensor.dsnu subtracts removes its pattern",
    },
)
