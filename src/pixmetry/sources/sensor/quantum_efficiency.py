"""Quantum efficiency: the share of the photons that become electrons."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.silicon import FIRST_NM, LAST_NM, absorption_per_cm
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

NODES = 65  # of the Gauss-Legendre quadrature over the band of light: 1e-4 over the whole table


class QuantumEfficiency(Parameters):
    """Mean number of electrons per photon, over the pixel's whole area: a number, or from what silicon absorbs."""

    quantum_efficiency: float = quantity(0.5, "1", "electrons per photon that falls on the pixel's area", gt=0, le=1)
    model: Literal["number", "silicon"] = quantity(
        "number", "1", "number: as given; silicon: from the absorption over the collecting depth"
    )
    wavelength_nm: float = quantity(550.0, "nm", "centre wavelength of the light, in vacuum", ge=FIRST_NM, le=LAST_NM)
    bandwidth_nm: float = quantity(0.0, "nm", "full width of the band; the photons are evenly distributed over it", ge=0, le=900)
    depth_um: float = quantity(5.0, "um", "depth d of the silicon that collects charge", gt=0, le=1000)
    dead_layer_um: float = quantity(0.0, "um", "thickness of the silicon above it, whose charge is lost", ge=0, le=10)
    reflectance: float = quantity(0.05, "1", "share R of the light that the surface reflects", ge=0, lt=1)
    collected: float = quantity(1.0, "1", "share CCE of the charge that is collected, fill factor included", gt=0, le=1)


def spectral_efficiency(params: QuantumEfficiency, wavelength_nm: np.ndarray | float) -> np.ndarray:
    """η(λ) = (1 − R)·CCE·e^(−αd₀)·(1 − e^(−αd)) of the silicon, in the shape of the wavelength."""
    per_um = 1e-4 * absorption_per_cm(wavelength_nm)
    lost = np.exp(-per_um * params.dead_layer_um)
    return (1 - params.reflectance) * params.collected * lost * -np.expm1(-per_um * params.depth_um)


def efficiency(params: QuantumEfficiency) -> float:
    """Electrons per photon of the light: the number given, or the mean of η(λ) over the band (its part within the table)."""
    if params.model == "number":
        return params.quantum_efficiency
    if params.bandwidth_nm == 0:
        return float(spectral_efficiency(params, params.wavelength_nm))
    low, high = (min(max(params.wavelength_nm + s * params.bandwidth_nm / 2, FIRST_NM), LAST_NM) for s in (-1, 1))
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    return float(weights @ spectral_efficiency(params, 0.5 * (low + high) + 0.5 * (high - low) * nodes)) / 2


def forward(params: QuantumEfficiency, signal: Signal, stream: Stream) -> Signal:
    """Turn the mean photons into the mean electrons."""
    return signal.with_data(signal.data * np.float32(efficiency(params)), Kind.ELECTRONS)


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
    description="Only a share of the photons becomes electrons. The share depends on the wavelength and determines the shot noise of a "
    "light level.",
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
    equation="µ_e = η µ_p;  silicon: η(λ) = (1 − R) CCE e^(−α d₀) (1 − e^(−α d))",
    typical_size="no shift; half the efficiency makes the shot noise √2 larger",
    references=("EMVA 1288 R4.0 Linear, §2.1 and §6", "M. A. Green, Sol. Energ. Mat. Sol. Cells 92, 1305, 2008 (absorption of silicon)"),
    advice="Use light at a wavelength where the sensor is sensitive and the lens is corrected.",
    reasons={
        "correct": "a factor common to all pixels is no error of the image. Light that made no electron is in no value of the frame",
        "propagate": "it scales the signal of all pixels alike and moves no target; its effect on the noise is in sensor.shot_noise",
        "neutral": "it is a conversion: without it there are no electrons",
    },
)
