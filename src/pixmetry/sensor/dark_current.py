"""Dark current: electrons that heat sets free, in proportion to the exposure time and doubling every few degrees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pixmetry.core.contribution import Contribution, Probe
from pixmetry.core.estimates import Estimates
from pixmetry.core.observations import Observations
from pixmetry.core.random import Stream
from pixmetry.core.signal import Kind, Signal
from pixmetry.core.source import Parameters, Source, quantity


class DarkCurrent(Parameters):
    """Mean dark current of a pixel; how it varies from pixel to pixel is in ``sensor.dsnu`` and ``sensor.defects``."""

    rate_e_per_s: float = quantity(0.0, "e-/s", "mean dark current at the reference temperature", ge=0, le=1e7)
    reference_temperature_c: float = quantity(20.0, "°C", "sensor temperature at which the rate holds", ge=-200, le=150)
    doubling_c: float = quantity(8.0, "K", "rise of temperature that doubles it", gt=1, le=50)


def mean_e(params: DarkCurrent, exposure_s: np.ndarray | float, temperature_c: np.ndarray | float) -> np.ndarray:
    """Mean number of dark electrons of one exposure, float64, in the shape of the arguments."""
    warmer = (np.asarray(temperature_c, float) - params.reference_temperature_c) / params.doubling_c
    return params.rate_e_per_s * np.asarray(exposure_s, float) * np.exp2(warmer)


def forward(params: DarkCurrent, signal: Signal, stream: Stream) -> Signal:
    """Add the mean dark electrons; the shot noise that follows draws them together with the light's."""
    added = mean_e(params, signal.exposure_s, signal.temperature_c).astype(np.float32)
    return signal.with_data(signal.data + added[:, None, None])


def measure(observations: Observations) -> Estimates:
    """Read the slope of the dark signal against exposure time from the photon transfer (EMVA 1288 R4.0 §7)."""
    estimates = observations.fitted(
        {"rate_e_per_s": "dark_current_e_per_s"},
        "dark current needs dark frames at several exposure times",
        where="sensor.dark_current",
        remedy="take dark frames at six exposure times or more, the longest as long as the camera allows",
    )
    if observations.temperature_c is None:
        return estimates
    note = f"{estimates.reasons.get('rate_e_per_s', '')} holds at a sensor temperature of {observations.temperature_c:g} °C".strip()
    return replace(estimates, reasons={"rate_e_per_s": note})


def propagate(params: DarkCurrent, probe: Probe) -> Contribution:
    """Propagator P1 with white noise of K√µ_d; the pedestal itself comes off with the background."""
    dark_e = float(mean_e(params, probe.exposure_s, probe.temperature_c))
    u = probe.white(probe.gain_dn_per_e * np.sqrt(dark_e))
    return probe.contribution(u, "T", model_error=0.12, method="linear response of the estimator to white noise of variance K²µ_d")


SOURCE = Source(
    id="sensor.dark_current",
    title="Dark current",
    description="Heat adds electrons in proportion to the exposure time; their mean is a pedestal, their scatter is noise.",
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
    measure=measure,
    propagate=propagate,
    gum_class="T",
    equation="µ_d = r t 2^((T − T_ref)/8 K);  σ_y² = K² µ_d",
    typical_size="below 0.001 px at video exposure times; 300 e- raise 1.40 DN of noise to 1.41 DN at 0.0097 DN/e-",
    references=("EMVA 1288 R4.0 Linear, §7", "J. R. Janesick, Photon Transfer, SPIE Press 2007 (doubling temperature)"),
    advice="Cool the camera, or expose for a shorter time with more light; subtract a dark frame of the same time and temperature.",
    reasons={"correct": "its mean comes off with the dark frame that sensor.dsnu subtracts; its shot noise cannot be undone"},
)
