"""Amplifier noise: noise of the read-out electronics, independent in every pixel and frame."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.dark_rows import without_variance
from pixmetry.camera.observations import Observations, PatternList
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

TAIL = 3.0  # standard deviation of the rare wide part over that of the common one


class AmplifierNoise(Parameters):
    """White noise, referred to the electrons at the sense node."""

    white_e: float = quantity(0.0, "e-", "standard deviation in every pixel", ge=0, le=1e5)
    tail_share: float = quantity(0.0, "1", "share of the values from a normal distribution three times as wide; 0: Gaussian", ge=0, le=0.5)
    clock_ratio: float = quantity(
        1.0, "1", "pixel clock divided by the clock for which white_e holds; the bandwidth is proportional to it", gt=0, le=1e3
    )


def deviation_e(params: AmplifierNoise) -> float:
    """Standard deviation at the clock in use: the noise of a white band grows as the root of its width."""
    return params.white_e * math.sqrt(params.clock_ratio)


def forward(params: AmplifierNoise, signal: Signal, stream: Stream) -> Signal:
    """Add independent noise to every pixel: normal, or (1 − ε) N(0, s²) + ε N(0, 9 s²) with s² (1 + 8 ε) the whole variance."""
    scale = deviation_e(params)
    if params.tail_share == 0 or scale == 0:
        return signal.with_data(stream.add_normal(signal.data, signal.grid, scale))
    narrow = np.float32(scale / math.sqrt(1 + (TAIL**2 - 1) * params.tail_share))
    wide = stream.uniform(signal.grid) < np.float32(params.tail_share)
    return signal.with_data(stream.add_normal(signal.data, signal.grid, np.where(wide, np.float32(TAIL) * narrow, narrow)))


def measure(observations: Observations) -> Estimates:
    """Read the white dark noise of the photon transfer, free of quantisation and of row and column noise."""
    noise = observations.fitted(
        {"white_e": "dark_noise_e"},
        "amplifier noise needs a photon-transfer series with dark frames",
        where="electronics.amplifier_noise",
        remedy="take dark pairs",
    )
    found = None if observations.patterns is None else observations.patterns.strongest()
    fit, series = observations.photon_transfer_fit, observations.photon_transfer
    rows = observations.dark_rows
    if rows is not None and fit is not None and "gain_dn_per_e" in fit:
        square, u = (v / fit["gain_dn_per_e"].value ** 2 for v in rows.taken["pixel"])
        noise = without_variance(noise, "white_e", square, u, "hum or 1/f noise, which is measured by itself,")
    if found is None or fit is None or series is None or not found.moving.any() or noise.limits:
        return noise
    return _without_moving_waves(noise, fit["gain_dn_per_e"].value, found, series.dark.n_frames)


def _without_moving_waves(noise: Estimates, gain: float, found: PatternList, n_frames: np.ndarray) -> Estimates:
    """Take the variance A²/2 of moving waves off: to the fit they are white noise.

    Two frames of phases φ differ by A²/2·(1 − cos Δφ) in their variance, so over N levels it scatters by A²/2·√(N/2)/Σ(F − 1).
    """
    amplitude, u_amplitude = found.amplitude_dn[found.moving] / gain, found.u_amplitude_dn[found.moving] / gain
    free = float((n_frames - 1).sum())
    scatter = float((amplitude**4).sum()) * len(n_frames) / (8 * free**2)
    square = noise.values[0] ** 2 - float((amplitude**2).sum()) / 2
    u_square = np.sqrt((2 * noise.values[0]) ** 2 * noise.covariance[0, 0] + scatter + float(((amplitude * u_amplitude) ** 2).sum()))
    if square < 3 * u_square:
        limit = float(np.sqrt(max(square, 0.0) + 1.645 * u_square))
        reason = {"white_e": "moving waves explain the noise of the dark frames; 95 % upper limit"}
        covariance = np.array([[(u_square / (2 * limit)) ** 2]])
        return replace(noise, values=np.array([limit]), covariance=covariance, limits=frozenset({"white_e"}), reasons=reason)
    value = float(np.sqrt(square))
    return replace(noise, values=np.array([value]), covariance=np.array([[(u_square / (2 * value)) ** 2]]))


def propagate(params: AmplifierNoise, probe: Probe) -> Contribution:
    """Propagator P1 with the same standard deviation in every pixel."""
    u = probe.white(probe.gain_dn_per_e * deviation_e(params))
    return probe.contribution(u, "T", model_error=0.12, method="linear response of the estimator to white noise")


SOURCE = Source(
    id="electronics.amplifier_noise",
    title="Amplifier noise",
    description="The output amplifier and the circuits behind it add white noise. It grows with the pixel clock.",
    number=18,
    stars=2,
    note="Note 17",
    parameters=AmplifierNoise,
    consumes=(Kind.ELECTRONS,),
    after=("sensor",),
    neutral=AmplifierNoise(),
    typical=AmplifierNoise(white_e=10.0),
    bound=AmplifierNoise(white_e=90.0),
    forward=forward,
    measure=measure,
    propagate=propagate,
    gum_class="T",
    equation="n' = n + σ_d √(f/f_ref) z,  z ~ N(0, 1), or (1 − ε) N(0, s²) + ε N(0, 9 s²)",
    typical_size="0.004 px for 88 e- on a disc of 7 px at 15 000 electrons; with the shot noise 0.0057 px",
    references=("EMVA 1288 R4.0 Linear, §2.2 and §6.5", "J. R. Janesick, Photon Transfer, SPIE Press 2007, ch. 11"),
    advice="Read out more slowly, use more light, or average N frames (1/√N).",
    reasons={
        "correct": "a frame with other noise and another scene has the same values: noise cannot be removed from a single frame. "
        "Averaging frames lowers it"
    },
)
