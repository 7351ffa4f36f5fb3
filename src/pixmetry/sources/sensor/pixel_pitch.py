"""Pixel pitch: the true one differs from the one that is reckoned with, or differs along x and y."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.geometry import frame_centre, image_shift, map_contribution
from pixmetry.camera.light import Pull
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.random import Stream


class PixelPitch(Parameters):
    """True pitch over the nominal one, less 1. The scene's pixels are the nominal ones; the frame's centre stays."""

    error_x_rel: float = quantity(0.0, "1", "along x", ge=-0.2, le=0.2)
    error_y_rel: float = quantity(
        0.0, "1", "relative error of the pitch along y; -0.0349 for 8.6 × 8.3 µm taken as square", ge=-0.2, le=0.2
    )


def pull_of(params: PixelPitch, frame_shape: tuple[int, int]) -> Pull:
    """The map from pixel numbers to places in nominal pixels."""
    x0, y0 = frame_centre(frame_shape)
    sx, sy = 1 + params.error_x_rel, 1 + params.error_y_rel
    return lambda x, y: (x0 + (x - x0) * sx, y0 + (y - y0) * sy)


def forward(params: PixelPitch, signal: Signal, stream: Stream) -> Signal:
    """Look from pixels of the true pitch, which collect light by their area."""
    if not (params.error_x_rel or params.error_y_rel):
        return signal
    light = signal.own_light.moved(pull_of(params, signal.frame_shape))
    area = (1 + params.error_x_rel) * (1 + params.error_y_rel)
    return signal.with_light(replace(light, sensitivity=light.sensitivity * area))


def truth(params: PixelPitch, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Displacement of the image at every pixel, shape (rows, cols)."""
    return {name: shift[0] for name, shift in image_shift(pull_of(params, signal.frame_shape), signal).items()}


def propagate(params: PixelPitch, probe: Probe) -> Contribution:
    """A scale error ε displaces a target at x by ε x; spread over the frame."""
    return map_contribution(pull_of(params, probe.frame_shape), probe)


SOURCE = Source(
    id="sensor.pixel_pitch",
    title="Pixel pitch",
    description="A wrong value of the pixel pitch changes the scale of the image, differently along x and y if the pixels are not square.",
    number=4,
    stars=1,
    note="Note 22",
    parameters=PixelPitch,
    consumes=(Kind.LIGHT,),
    neutral=PixelPitch(),
    typical=PixelPitch(error_x_rel=1e-4, error_y_rel=1e-4),
    bound=PixelPitch(error_x_rel=1e-3, error_y_rel=1e-3),
    forward=forward,
    truth=truth,
    propagate=propagate,
    gum_class="G",
    equation="x = x_c + (n − x_c)(1 + ε);  Δx = −ε x",
    typical_size="0.038 px at the edge of 752 columns for ε = 1e-4",
    references=("J. G. Fryer, Camera calibration, in Atkinson (ed.), Close Range Photogrammetry and Machine Vision, 1996",),
    advice="Take both pitches from the data sheet, and let the calibration estimate the ratio of the scales.",
    reasons={
        "measure": "images depend on pitch over principal distance alone: twice the pitch and twice the distance leave all frames the "
        "same, so that no image tells the size of a pitch. A calibration gives the ratio of both pitches as affinity",
        "correct": "it changes no value of a frame, only what a pixel is in mm. Positions are multiplied by the true pitch instead",
    },
)
