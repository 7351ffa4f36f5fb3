"""Dark current: electrons that heat sets free, in proportion to the exposure time and doubling every few degrees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream

BOLTZMANN_EV_PER_K = 8.617333262e-5  # CODATA 2018
ZERO_C_K = 273.15
CORNERS = {"top left": (0, 0), "top right": (0, 1), "bottom left": (1, 0), "bottom right": (1, 1)}


class DarkCurrent(Parameters):
    """Mean dark current of a pixel, how it grows with the temperature, and how it varies over the sensor.

    Offsets that are no charge are in ``sensor.dsnu``, single pixels with far too much of it in ``sensor.defects``.
    """

    rate_e_per_s: float = quantity(0.0, "e-/s", "mean dark current at the reference temperature", ge=0, le=1e7)
    reference_temperature_c: float = quantity(20.0, "°C", "sensor temperature at which the rate holds", ge=-200, le=150)
    doubling_c: float = quantity(8.0, "K", "temperature rise that doubles the rate", gt=1, le=50)
    law: Literal["doubling", "gap"] = quantity(
        "doubling", "1", "doubling: doubles every doubling_c; gap: proportional to T^1.5 e^(−E_g/2kT)"
    )
    gap_ev: float = quantity(1.12, "eV", "band gap E_g of the law 'gap'", gt=0.1, le=5)
    spread_log: float = quantity(0.0, "1", "standard deviation of the logarithm of the pixels' rates, at constant mean", ge=0, le=2)
    glow_e_per_s: float = quantity(0.0, "e-/s", "glow of the output amplifier in the corner pixel, at any temperature", ge=0, le=1e7)
    glow_reach_px: float = quantity(50.0, "px", "distance over which the glow falls to 1/e", ge=1, le=1e5)
    glow_corner: Literal["top left", "top right", "bottom left", "bottom right"] = quantity(
        "top left", "1", "corner of the frame where the amplifier is"
    )


def warming(params: DarkCurrent, temperature_c: np.ndarray | float) -> np.ndarray:
    """Dark current at a temperature over that at the reference temperature (EMVA 1288 R4.0 §7; Janesick 2007 for the gap)."""
    temperature = np.asarray(temperature_c, float)
    if params.law == "doubling":
        return np.exp2((temperature - params.reference_temperature_c) / params.doubling_c)
    kelvin, reference = temperature + ZERO_C_K, params.reference_temperature_c + ZERO_C_K
    return (kelvin / reference) ** 1.5 * np.exp(params.gap_ev / (2 * BOLTZMANN_EV_PER_K) * (1 / reference - 1 / kelvin))


def mean_e(params: DarkCurrent, exposure_s: np.ndarray | float, temperature_c: np.ndarray | float) -> np.ndarray:
    """Mean number of dark electrons of one exposure, float64, in the shape of the arguments."""
    mean: Array = params.rate_e_per_s * np.asarray(exposure_s, float) * warming(params, temperature_c)
    return mean


def unevenness(params: DarkCurrent, grid: Grid, stream: Stream) -> np.ndarray:
    """Rate of every pixel over the mean rate, fixed in the unit, shape (n, rows, cols): log-normal with mean 1."""
    return np.exp(stream.add_normal_fixed(np.float32(-0.5 * params.spread_log**2), grid, params.spread_log))


def glow_e_per_s(params: DarkCurrent, rows: np.ndarray, cols: np.ndarray, frame_shape: tuple[int, int]) -> np.ndarray:
    """Glow of the amplifier at pixels of these rows (n, rows) and columns (n, cols)."""
    row, col = (part * (size - 1) for part, size in zip(CORNERS[params.glow_corner], frame_shape, strict=True))
    distance = np.hypot((rows - row)[:, :, None], (cols - col)[:, None, :])
    glow: Array = params.glow_e_per_s * np.exp(-distance / params.glow_reach_px)
    return glow


def forward(params: DarkCurrent, signal: Signal, stream: Stream) -> Signal:
    """Add the mean dark electrons; the shot noise that follows draws them together with the light's."""
    added = mean_e(params, signal.exposure_s, signal.temperature_c).astype(np.float32)[:, None, None]
    if params.spread_log and params.rate_e_per_s:
        added = added * unevenness(params, signal.grid, stream)
    data = signal.data + added
    if params.glow_e_per_s:
        glow = glow_e_per_s(params, signal.rows, signal.cols, signal.frame_shape)
        data += (glow * signal.exposure_s[:, None, None]).astype(np.float32)
    return signal.with_data(data)


def truth(params: DarkCurrent, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Mean dark current of every pixel in the first frame, at its temperature."""
    one = signal.take(np.array([0]))
    rate = params.rate_e_per_s * warming(params, one.temperature_c[0]) * unevenness(params, one.grid, stream)
    return {"dark_current_e_per_s": (rate + glow_e_per_s(params, one.rows, one.cols, one.frame_shape))[0]}


def measure(observations: Observations) -> Estimates:
    """Read the slope of the dark signal against exposure time from the photon transfer (EMVA 1288 R4.0 §7)."""
    estimates = observations.fitted(
        {"rate_e_per_s": "dark_current_e_per_s"},
        "dark current needs dark frames at several exposure times",
        where="sensor.dark_current",
        remedy="take dark frames at six exposure times or more, the longest as long as the camera allows",
    )
    estimates = _with_doubling(estimates, observations)
    if observations.temperature_c is None:
        return estimates
    note = f"{estimates.reasons.get('rate_e_per_s', '')} holds at a sensor temperature of {observations.temperature_c:g} °C".strip()
    return replace(estimates, reasons={**estimates.reasons, "rate_e_per_s": note})


def _with_doubling(estimates: Estimates, observations: Observations) -> Estimates:
    """The doubling temperature beside the rate, where dark frames at several temperatures tell it."""
    seen = observations.dark_temperatures
    if seen is None:
        return estimates
    name = "doubling_temperature_k"
    if name not in seen.fit:
        return replace(estimates, confounders=(*estimates.confounders, f"another doubling temperature: {seen.fit.reasons[name]}"))
    doubling = seen.fit.select({"doubling_c": name})
    least, most = 1.0, 50.0
    if not least < doubling["doubling_c"].value <= most:
        return estimates
    return estimates.join(doubling)


def propagate(params: DarkCurrent, probe: Probe) -> Contribution:
    """Propagator P1 with white noise of variance K²µ_d and the fixed spread of the rates; the pedestal comes off with the background.

    The class is that of the larger of the two. The glow is smooth over a target and taken to come off with the background too.
    """
    dark_e = float(mean_e(params, probe.exposure_s, probe.temperature_c))
    fixed_e2 = dark_e**2 * float(np.expm1(params.spread_log**2))
    u = probe.white(probe.gain_dn_per_e * np.sqrt(dark_e + fixed_e2))
    method = "linear response of the estimator to white noise of variance K²µ_d, and to the spread of the rates"
    return probe.contribution(u, "F" if fixed_e2 > dark_e else "T", model_error=0.12, method=method)


SOURCE = Source(
    id="sensor.dark_current",
    title="Dark current",
    description="Heat generates electrons in proportion to the exposure time. Their mean is an offset, their scatter is noise.",
    number=14,
    stars=1,
    note="Note 17",
    parameters=DarkCurrent,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.quantum_efficiency",),
    before=("sensor.shot_noise",),
    neutral=DarkCurrent(),
    typical=DarkCurrent(rate_e_per_s=20.0),
    bound=DarkCurrent(rate_e_per_s=1000.0),
    forward=forward,
    truth=truth,
    measure=measure,
    propagate=propagate,
    gum_class="T",
    equation="µ_d = r t 2^((T − T_ref)/8 K), or ∝ T^1.5 e^(−E_g/2kT);  pixels: log-normal;  glow: g t e^(−d/L);  σ_y² = K² µ_d",
    typical_size="below 0.001 px at video exposure times; 300 e- raise 1.40 DN of noise to 1.41 DN at 0.0097 DN/e-",
    references=("EMVA 1288 R4.0 Linear, §7", "J. R. Janesick, Photon Transfer, SPIE Press 2007 (doubling temperature)"),
    advice="Cool the camera, or expose for a shorter time with more light; subtract a dark frame of the same time and temperature.",
    reasons={
        "correct": "its shot noise adds to that of the light, and one value does not tell the two. Its mean is removed by the dark frame "
        "that sensor.dsnu subtracts"
    },
)
