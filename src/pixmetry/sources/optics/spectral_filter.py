"""Spectral filter in front of the sensor: how much of the light it passes, and how far its plate shifts the focus."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Literal

import numpy as np

from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.silicon import absorption_per_um
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

WAVELENGTH_NM = np.arange(300.0, 1200.5, 0.5)
SECOND_RADIATION_NM_K = 1.438776877e7  # hc/k, CODATA 2018


class SpectralFilter(Parameters):
    """A light's spectrum, a filter's band, and the plate that carries it."""

    light: Literal["blackbody", "led", "laser"] = quantity("blackbody", "name", "kind of spectrum")
    temperature_k: float = quantity(2856.0, "K", "temperature of the black body; 2856 K is CIE illuminant A", ge=1000, le=20000)
    light_nm: float = quantity(625.0, "nm", "centre wavelength of the diode or laser", ge=300, le=1200)
    light_width_nm: float = quantity(20.0, "nm", "full width at half maximum of the diode's Gaussian spectrum", ge=2, le=300)
    band: Literal["none", "short_pass", "band_pass"] = quantity("none", "name", "kind of filter")
    cut_nm: float = quantity(680.0, "nm", "half transmittance (short pass), or middle of the band (band pass)", ge=300, le=1200)
    width_nm: float = quantity(40.0, "nm", "full width at half maximum of the band", ge=2, le=600)
    edge_nm: float = quantity(10.0, "nm", "10 to 90 % width of each edge", ge=2, le=200)
    peak_rel: float = quantity(0.95, "1", "transmittance in the band", gt=0, le=1)
    collecting_depth_um: float = quantity(5.0, "µm", "depth of silicon that collects charge; it gives the spectral weights", gt=0, le=500)
    plate_um: float = quantity(0.0, "µm", "thickness of the plate, if the lens was focused without it", ge=0, le=10000)
    plate_index: float = quantity(1.52, "1", "refractive index of the plate", ge=1, le=3)
    f_number: float = quantity(4.0, "1", "working f-number", ge=0.7, le=64)
    pitch_um: float = quantity(8.6, "µm", "pixel pitch", gt=0, le=100)


def photon_spectrum(params: SpectralFilter) -> np.ndarray:
    """Photons per wavelength at `WAVELENGTH_NM`, of sum 1. Black body: Planck's law over the photon's energy, λ⁻⁴/(exp(c₂/λT) − 1)."""
    if params.light == "blackbody":
        shape = WAVELENGTH_NM**-4 / np.expm1(SECOND_RADIATION_NM_K / (WAVELENGTH_NM * params.temperature_k))
    else:
        width = params.light_width_nm if params.light == "led" else 1.0  # a laser's line is narrower than any filter's edge
        shape = np.exp(-4 * np.log(2) * ((WAVELENGTH_NM - params.light_nm) / width) ** 2)
    spectrum: Array = shape / shape.sum()
    return spectrum


def transmittance(params: SpectralFilter) -> np.ndarray:
    """Of the filter at `WAVELENGTH_NM`: logistic edges."""
    if params.band == "none":
        return np.ones_like(WAVELENGTH_NM)
    slope = params.edge_nm / (2 * np.log(9))  # a logistic goes from 10 to 90 % in 2 ln 9 of its scale

    def below(limit_nm: float) -> np.ndarray:
        share: Array = 0.5 - 0.5 * np.tanh((WAVELENGTH_NM - limit_nm) / (2 * slope))
        return share

    if params.band == "short_pass":
        return params.peak_rel * below(params.cut_nm)
    lower, upper = params.cut_nm - params.width_nm / 2, params.cut_nm + params.width_nm / 2
    transmission: Array = params.peak_rel * below(upper) * (1 - below(lower))
    return transmission


@lru_cache(maxsize=64)
def passed(params: SpectralFilter) -> float:
    """Share of the signal that passes: the mean transmittance over the spectrum that silicon of this depth absorbs."""
    seen = photon_spectrum(params) * -np.expm1(-absorption_per_um(WAVELENGTH_NM) * params.collecting_depth_um)
    return float((seen * transmittance(params)).sum() / seen.sum())


def defocus_px2(params: SpectralFilter) -> float:
    """Variance along each axis of the blur disc behind a plate: its focus lies t (n − 1)/n deeper, the disc's diameter is that over N."""
    shift_um = params.plate_um * (params.plate_index - 1) / params.plate_index
    return (shift_um / (4 * params.f_number * params.pitch_um)) ** 2  # a disc of diameter D has variance D²/16


def forward(params: SpectralFilter, signal: Signal, stream: Stream) -> Signal:
    """Dim the light and defocus it. The scene's photons are those that the sensor would see without the filter."""
    light = signal.own_light
    if params.band != "none":
        light = replace(light, sensitivity=light.sensitivity * passed(params))
    if params.plate_um:
        light = light.blurred(defocus_px2(params))
    return signal.with_light(light)


def measure(observations: Observations) -> Estimates:
    """Transmittance in the band, the end of the band and the thickness of the plate, from targets with the filter and without it."""
    bands, failed = observations.bands, observations.failed.get("bands", "")
    names = {n: n for n in ("peak_rel", "cut_nm", "plate_um", "f_number", "pitch_um")}
    return of_pictures(
        None if bands is None else bands.filter,
        names,
        where="optics.spectral_filter",
        pictures="targets with and without the filter at the same wavelengths",
        kind="bands",
        failed=failed,
    )


SOURCE = Source(
    id="optics.spectral_filter",
    title="Spectral filter",
    description="A filter keeps infrared light away from the sensor. It may also absorb the light of a laser, and its plate shifts the "
    "focus.",
    number=2,
    stars=1,
    note="Note 14",
    parameters=SpectralFilter,
    consumes=(Kind.LIGHT,),
    before=("sensor",),
    neutral=SpectralFilter(),
    typical=SpectralFilter(band="short_pass"),
    bound=SpectralFilter(band="short_pass", plate_um=100.0),
    forward=forward,
    measure=measure,
    gum_class="T",
    equation="µ' = µ ∫ τ S a dλ / ∫ S a dλ,  a = 1 − exp(−α d);  Δz = t (n − 1)/n,  σ = Δz/(4N)",
    typical_size="the random error grows as 1/√τ; a 670 nm laser loses a third under an infrared filter with its edge at 680 nm",
    references=("EMVA 1288 R4.0 Linear, §9 (spectral sensitivity)", "M. A. Green, Solar Energy Mat. & Solar Cells 92 (2008) 1305–1310"),
    advice="Match the filter's band to the light, and focus the lens with the filter in place.",
    reasons={
        "correct": "light that did not pass is in no value of the frame. The blur and the shift of the focus that the plate brings are "
        "part of the lens that is calibrated with it",
        "propagate": "it shifts no target by itself: less light counts in the shot noise, a wider spread in the sampling",
    },
)
