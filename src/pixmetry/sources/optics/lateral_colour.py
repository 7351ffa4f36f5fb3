"""Lateral colour: the image's scale depends on the wavelength, so another light moves the image and a wide spectrum smears it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.geometry import frame_centre, image_shift, map_contribution
from pixmetry.camera.light import Pull
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import MOVES_POINTS, Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class LateralColour(Parameters):
    """A scale that is linear in the wavelength, and the spectrum that the sensor sees."""

    scale_per_nm: float = quantity(0.0, "1/nm", "relative change of the image's scale per nanometre", ge=-1e-4, le=1e-4)
    mean_nm: float = quantity(550.0, "nm", "mean wavelength of the light on the sensor", ge=200, le=1200)
    std_nm: float = quantity(0.0, "nm", "standard deviation of the spectrum on the sensor", ge=0, le=400)
    reference_nm: float = quantity(550.0, "nm", "wavelength at which the image has its calibrated scale", ge=200, le=1200)


def pull_of(params: LateralColour, frame_shape: tuple[int, int]) -> Pull:
    """The map from places in the image to those at the reference wavelength."""
    x0, y0 = frame_centre(frame_shape)
    scale = 1 + params.scale_per_nm * (params.mean_nm - params.reference_nm)
    return lambda x, y: (x0 + (x - x0) / scale, y0 + (y - y0) / scale)


def forward(params: LateralColour, signal: Signal, stream: Stream) -> Signal:
    """Change the scale by the mean wavelength; smear by the spectrum's width, by a round spot of the radial variance."""
    light = signal.own_light
    if params.scale_per_nm and params.mean_nm != params.reference_nm:
        light = light.moved(pull_of(params, signal.frame_shape))
    if params.scale_per_nm and params.std_nm:
        x0, y0 = frame_centre(signal.frame_shape)
        each = 0.5 * (params.scale_per_nm * params.std_nm) ** 2
        light = light.blurred_by_place(lambda x, y: each * ((x - x0) ** 2 + (y - y0) ** 2))
    return signal.with_light(light)


def truth(params: LateralColour, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Displacement of the image at every pixel, shape (rows, cols)."""
    return {name: shift[0] for name, shift in image_shift(pull_of(params, signal.frame_shape), signal).items()}


def measure(observations: Observations) -> Estimates:
    """Change of the scale per nanometre, from the same targets in light of several wavelengths."""
    bands, failed = observations.bands, observations.failed.get("bands", "")
    return of_pictures(
        None if bands is None else bands.colour,
        {"scale_per_nm": "scale_per_nm"},
        where="optics.lateral_colour",
        pictures="targets in light of several wavelengths",
        kind="bands",
        failed=failed,
    )


def propagate(params: LateralColour, probe: Probe) -> Contribution:
    """Propagator P6: the displacement of targets all over the frame."""
    return map_contribution(pull_of(params, probe.frame_shape), probe)


SOURCE = Source(
    id="optics.lateral_colour",
    title="Lateral colour",
    description="The scale of the image depends on the wavelength: a change of the light moves the image outwards or inwards.",
    note="Note 14",
    parameters=LateralColour,
    consumes=(Kind.LIGHT,),
    before=("sensor",),
    neutral=LateralColour(),
    typical=LateralColour(scale_per_nm=2e-6, mean_nm=650.0, std_nm=30.0),
    bound=LateralColour(scale_per_nm=5e-6, mean_nm=750.0, std_nm=100.0),
    forward=forward,
    truth=truth,
    measure=measure,
    propagate=propagate,
    gum_class="G",
    equation="x(λ) = x₀ (1 + m (λ − λ₀));  Δr = r m (λ̄ − λ₀),  σ_r = r m σ_λ",
    typical_size="0.12 px (1 µm) at the edge between a diode and a halogen lamp",
    references=("ISO 19084:2015 (chromatic displacement)",),
    advice="Calibrate and measure under the same narrow-band light.",
    reasons={
        "correct": f"{MOVES_POINTS}, by a calibration in the light of the measurement",
    },
)
