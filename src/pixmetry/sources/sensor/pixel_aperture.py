"""Light-sensitive area of a pixel: smaller than the pitch, perhaps off the pixel's centre."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pixmetry.camera.geometry import image_shift
from pixmetry.camera.light import Pull
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class PixelAperture(Parameters):
    """A rectangle within the pixel, the same in all pixels."""

    width_x_px: float = quantity(1.0, "px", "width divided by the pitch", ge=0.05, le=1)
    width_y_px: float = quantity(1.0, "px", "height divided by the pitch", ge=0.05, le=1)
    offset_x_px: float = quantity(0.0, "px", "centre of the rectangle minus the pixel's centre, along x", ge=-0.5, le=0.5)
    offset_y_px: float = quantity(0.0, "px", "centre of the rectangle minus the pixel's centre, along y", ge=-0.5, le=0.5)
    collected_rel: float = quantity(
        1.0,
        "1",
        "light counted over that on the whole pixel: the width times the height without microlenses; 1 if the quantum efficiency, as by "
        "EMVA 1288, refers to the whole pixel already",
        gt=0,
        le=1,
    )


def pull_of(params: PixelAperture) -> Pull:
    """The map from the pixel's centre to that of its rectangle."""
    return lambda x, y: (x + params.offset_x_px, y + params.offset_y_px)


def forward(params: PixelAperture, signal: Signal, stream: Stream) -> Signal:
    """Narrow the window through which each pixel looks, and move it."""
    light = signal.own_light
    width, height = light.aperture_px
    if params.offset_x_px or params.offset_y_px:
        light = light.moved(pull_of(params))
    size = width * params.width_x_px, height * params.width_y_px
    return signal.with_light(replace(light, aperture_px=size, sensitivity=light.sensitivity * params.collected_rel))


def truth(params: PixelAperture, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Displacement of the image at every pixel, shape (rows, cols)."""
    return {name: shift[0] for name, shift in image_shift(pull_of(params), signal).items()}


def measure(observations: Observations) -> Estimates:
    """Width and height from slanted edges. Noise about a full pixel may give more than 1, which no pixel has: then it is 1 with that u."""
    names = ("width_x_px", "width_y_px")
    found = observations.edge_optics({name: name for name in names}, where="sensor.pixel_aperture")
    return replace(found, values=np.minimum(found.values, 1.0))


SOURCE = Source(
    id="sensor.pixel_aperture",
    title="Light-sensitive area smaller than the pitch",
    description="Each pixel is sensitive on part of its square only. Sharp targets fall between pixels, and their centres have an error "
    "that depends on the sub-pixel phase.",
    number=3,
    stars=1,
    note="Note 21",
    parameters=PixelAperture,
    consumes=(Kind.LIGHT,),
    neutral=PixelAperture(),
    typical=PixelAperture(width_x_px=0.6, width_y_px=0.8),
    bound=PixelAperture(width_x_px=0.4, width_y_px=0.6),
    forward=forward,
    measure=measure,
    truth=truth,
    gum_class="F",
    equation="s = I ∗ box(a_x, a_y) at the pixel;  MTF = |sinc(a ν)|;  periodic error a₁ = |H'(1)|/(π H(0))",
    typical_size="a Gaussian spot of σ = 0.4 px: 0.014 px at full fill, 0.07 px at a width of 0.4",
    references=(
        "S. K. Park, R. Schowengerdt, M.-A. Kaczynski, Modulation-transfer-function analysis for sampled image systems, "
        "Applied Optics 23 (1984) 2572–2582",
    ),
    advice="Widen the target's image to a spread of 0.6 px or more, or take a sensor with microlenses.",
    reasons={
        "correct": "light between the sensitive areas is recorded nowhere: images that differ there alone give the same frame. Frames "
        "that are shifted by parts of a pixel can be interleaved instead",
        "propagate": "it only changes the undersampling; that needs the spread in front of the pixel, which the probe does not contain",
    },
)
