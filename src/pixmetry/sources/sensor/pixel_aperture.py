"""Light-sensitive area of a pixel: smaller than the pitch, perhaps off the pixel's centre."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pixmetry.camera.finer_grid import BORDER_PX, FINER_KEY, LEAST_CONTRAST, SHIFT_KEY, ShiftedFrames
from pixmetry.camera.geometry import image_shift
from pixmetry.camera.light import Pull
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream


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


def transfer(params: PixelAperture, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
    """Complex contrast that the rectangle leaves to frequencies along x and y, in cycles per pixel."""
    turn = np.exp(2j * np.pi * (params.offset_x_px * fx + params.offset_y_px * fy))
    return np.asarray(np.sinc(params.width_x_px * fx) * np.sinc(params.width_y_px * fy) * turn)


def correct(params: PixelAperture, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Part the frequencies that shifted frames fold together, on a finer grid, and divide them by the transfer of the sensitive area.

    ``maps`` holds the shifts of the frames, shape (n, 2), and the pixels of the finer grid in a pixel along x and y.

    Raises
    ------
    InputError
        If there are no shifts, or these do not part the frequencies.
    """
    missing = [key for key in (SHIFT_KEY, FINER_KEY) if key not in maps]
    if missing:
        remedy = "take several frames of a scene at rest, shifted by parts of a pixel, and give their shifts (--shifts)"
        raise InputError(f"the correction needs {missing[0]!r} of these frames", where="sensor.pixel_aperture", remedy=remedy)
    finer = int(maps[FINER_KEY][0]), int(maps[FINER_KEY][1])
    rows, cols = signal.data.shape[1:]
    grid = ShiftedFrames(np.asarray(maps[SHIFT_KEY], float), finer, (rows, cols))
    image, _ = grid.restored(signal.data, lambda fx, fy: transfer(params, fx, fy))
    one = signal.take(np.zeros(1, np.int64))
    return replace(one, data=image[None].astype(np.float32), grid=Grid.whole([0], image.shape), frame_shape=image.shape)


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
    correct=correct,
    truth=truth,
    gum_class="F",
    equation="s = I ∗ box(a_x, a_y) at the pixel;  MTF = |sinc(a ν)|;  periodic error a₁ = |H'(1)|/(π H(0))",
    typical_size="a Gaussian spot of σ = 0.4 px: 0.014 px at full fill, 0.07 px at a width of 0.4",
    references=(
        "S. K. Park, R. Schowengerdt, M.-A. Kaczynski, Modulation-transfer-function analysis for sampled image systems, "
        "Applied Optics 23 (1984) 2572–2582",
        "R. Y. Tsai, T. S. Huang, Multiframe image restoration and registration, Advances in Computer Vision and Image Processing 1 (1984) "
        "317–339",
    ),
    advice="Widen the target's image to a spread of 0.6 px or more, or take a sensor with microlenses. A scene at rest: put frames "
    "together that are shifted by parts of a pixel (pixmetry correct --shifts).",
    leaves=f"frequencies to which the area leaves a contrast below {LEAST_CONTRAST:g} (a full pixel: about 1 and 2 cycles per pixel), "
    f"detail beyond the finer grid, and a border of {BORDER_PX} pixels",
    reasons={
        "propagate": "it only changes the undersampling; that needs the spread in front of the pixel, which the probe does not contain",
    },
)
