"""Photon shot noise: electrons arrive one by one, so their number scatters about its mean as Poisson's law has it."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source
from pixmetry.core.random import Stream


class ShotNoise(Parameters):
    """It has no parameter: the mean fixes the scatter."""


def forward(params: ShotNoise, signal: Signal, stream: Stream) -> Signal:
    """Draw the number of electrons of every pixel from Poisson's law about the mean that has gathered so far."""
    return signal.with_data(stream.poisson(signal.data, signal.grid))


def propagate(params: ShotNoise, probe: Probe) -> Contribution:
    """Propagator P1 with the variance K·(signal in DN): variance in electrons equals the mean."""
    u = probe.white(np.sqrt(probe.gain_dn_per_e * np.maximum(probe.signal_dn, 0.0)))
    return probe.contribution(u, "T", model_error=0.12, method="linear response of the estimator to white noise of variance K·µ")


SOURCE = Source(
    id="sensor.shot_noise",
    title="Photon shot noise",
    description="The number of electrons in a pixel, dark electrons included, has a Poisson distribution.",
    note="Figure 3.20",
    parameters=ShotNoise,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.quantum_efficiency", "sensor.dark_current"),
    neutral=None,
    typical=ShotNoise(),
    bound=ShotNoise(),
    forward=forward,
    propagate=propagate,
    gum_class="T",
    equation="n ~ Poisson(µ_e);  σ_y² = K µ_y",
    typical_size="0.004 px on a disc of 7 px at 15 000 electrons",
    references=("EMVA 1288 R4.0 Linear, §2.2", "M. B. Giles, ACM TOMS 42(1), 2016, algorithm 955 (inversion)"),
    advice="Collect more electrons: a brighter target up to 80 % of saturation, a larger target, or N frames (1/√N).",
    reasons={
        "measure": "it has no free parameter. The gain that scales it is measured by electronics.gain from the photon transfer",
        "correct": "a frame with other noise and another scene has the same values: noise cannot be removed from a single frame. "
        "Averaging frames lowers it",
        "neutral": "all light has it",
    },
)
