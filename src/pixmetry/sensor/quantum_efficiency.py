"""Quantum efficiency: the share of the photons that become electrons."""

from __future__ import annotations

import numpy as np

from pixmetry.core.estimates import Estimates
from pixmetry.core.observations import Observations
from pixmetry.core.random import Stream
from pixmetry.core.signal import Kind, Signal
from pixmetry.core.source import Parameters, Source, quantity


class QuantumEfficiency(Parameters):
    """Mean number of electrons per photon, over the pixel's whole area."""

    quantum_efficiency: float = quantity(0.5, "1", "electrons per photon that falls on the pixel's area", gt=0, le=1)


def forward(params: QuantumEfficiency, signal: Signal, stream: Stream) -> Signal:
    """Turn the mean photons into the mean electrons."""
    return signal.with_data(signal.data * np.float32(params.quantum_efficiency), Kind.ELECTRONS)


def measure(observations: Observations) -> Estimates:
    """Read the ratio of responsivity to gain from the photon transfer; it needs the photons per pixel of each level."""
    return observations.fitted(
        {"quantum_efficiency": "quantum_efficiency"},
        "quantum efficiency needs a photon-transfer series of known irradiance",
        where="sensor.quantum_efficiency",
        remedy="give the photons per pixel of each level, from a calibrated photodiode",
    )


SOURCE = Source(
    id="sensor.quantum_efficiency",
    title="Quantum efficiency",
    description="Only a share of the photons becomes electrons that depends on the wavelength; it sets the shot noise of a light level.",
    number=43,
    note="Note 14",
    parameters=QuantumEfficiency,
    consumes=(Kind.PHOTONS,),
    produces=Kind.ELECTRONS,
    essential=True,
    after=("optics",),
    typical=QuantumEfficiency(),
    bound=QuantumEfficiency(),
    forward=forward,
    measure=measure,
    gum_class="T",
    equation="µ_e = η µ_p",
    typical_size="no shift; half the efficiency makes the shot noise √2 larger",
    references=("EMVA 1288 R4.0 Linear, §2.1 and §6",),
    advice="Use light at a wavelength where the sensor is sensitive and the lens is corrected.",
    reasons={
        "correct": "a common factor is no error of the image; the light that was lost cannot be had back",
        "propagate": "it scales the signal of all pixels alike, which moves nothing; what it does to the noise is in sensor.shot_noise",
        "neutral": "it is a conversion: without it there are no electrons",
    },
)
