"""Demosaicing: a camera makes full frames of one colour, or of the luminance, out of a mosaic of three."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.mosaic_weights import LUMA, REACH, output_weights
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.processing._codes import bits_of_camera, bordered, surround
from pixmetry.sources.processing._kernels import filter_by_place

METHOD = "autocovariance of the noise at the four places of the mosaic, against that of each method (H. S. Malvar et al., ICASSP 2004)"
CONFOUNDERS = ("demosaicking: red and blue sites, which only the colour of the light tells apart; another method with the same weights",)


class Demosaic(Parameters):
    """The mosaic, its interpolation, and the stored colour."""

    method: Literal["off", "bilinear", "malvar"] = quantity("off", "1", "malvar: linear with 5 × 5 weights by Malvar, He and Cutler")
    output: Literal["luma", "red", "green", "blue"] = quantity("luma", "1", "one colour, or 0.299 R + 0.587 G + 0.114 B")
    pattern: Literal["RGGB", "GRBG", "GBRG", "BGGR"] = quantity("RGGB", "1", "colours of pixels (0,0), (0,1), (1,0), (1,1), row by row")
    red_gain: float = quantity(1.0, "1", "white balance: factor on red pixels", gt=0, le=16)
    green_gain: float = quantity(1.0, "1", "factor on green pixels", gt=0, le=16)
    blue_gain: float = quantity(1.0, "1", "factor on blue pixels", gt=0, le=16)
    bits: int = bits_of_camera()


def weights(params: Demosaic) -> np.ndarray:
    """Weights of the output on the raw mosaic at its four places, white balance included, shape (2, 2, 5, 5)."""
    mix = LUMA if params.output == "luma" else {params.output[0].upper(): 1.0}
    gain = {"R": params.red_gain, "G": params.green_gain, "B": params.blue_gain}
    return output_weights(params.method, params.pattern, mix, gain)


def forward(params: Demosaic, signal: Signal, stream: Stream) -> Signal:
    """Fill in the mosaic and round once; beyond the frame it is mirrored."""
    if params.method == "off":
        return signal
    codes = bordered(signal.data, REACH)
    return signal.with_data(filter_by_place(codes, signal.grid.row0, signal.grid.col0, weights(params), float(2**params.bits - 1)))


def context(params: Demosaic, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """Two pixels on each side."""
    return windows if params.method == "off" else surround(windows, REACH, frame_shape)


def measure(observations: Observations) -> Estimates:
    """Read method, stored colour and pattern off the noise at the four places of the mosaic; all are names, not numbers.

    Red and blue sites can change their names without a difference to the noise: a stored red is told from green, and not from blue.
    """
    found, where = observations.noise_filter, "processing.demosaic"
    if found is None:
        raise MeasureError("needs the shot noise of flat fields", where=where, remedy="take pairs of flat fields and of dark frames")
    if "output" not in found.fit.settings:
        raise MeasureError("not found: the noise has no period of two pixels that an interpolation of colours would leave", where=where)
    return replace(found.fit, method=METHOD, confounders=CONFOUNDERS)


def propagate(params: Demosaic, probe: Probe) -> Contribution:
    """The estimator on the filled-in mosaic of a grey target, at each of its four places in the pattern; and the rounding.

    The light is grey and balanced: what a sensor's colours let through and the white balance cancel, so here both are left out.
    """
    if params.method == "off":
        return probe.contribution((0.0, 0.0), "F", method="switched off")
    balanced = weights(params.model_copy(update={"red_gain": 1.0, "green_gain": 1.0, "blue_gain": 1.0}))
    x = np.pad(np.asarray(probe.signal_dn, float), ((0, 0), (REACH, REACH), (REACH, REACH)), mode="edge")
    views = np.lib.stride_tricks.sliding_window_view(x, (5, 5), axis=(1, 2))
    rows, cols = probe.signal_dn.shape[1:]
    shifts = []
    for row in (0, 1):
        for col in (0, 1):
            place = balanced[(np.arange(rows)[:, None] + row) % 2, (np.arange(cols) + col) % 2]
            shifts.append(probe.moved(np.einsum("prcab,rcab->prc", views, place)))
    dx, dy = (np.concatenate([s[a] for s in shifts]) for a in (0, 1))
    rounding = probe.white(np.sqrt(1 / 12))
    return probe.from_shifts(
        dx,
        dy,
        "F",
        beside=rounding,
        model_error=0.15,
        floor_px=5e-4,
        method="the estimator on the interpolated mosaic, over its four positions",
    )


SOURCE = Source(
    id="processing.demosaic",
    title="Demosaicing",
    description="Two of the three colours of every pixel are interpolated from its neighbours. The rule differs between the four "
    "positions of the mosaic, so targets shift.",
    parameters=Demosaic,
    consumes=(Kind.CODES,),
    after=("sensor", "electronics", "cable", "grabber", "processing.defect_correction"),
    before=("storage", "processing.noise_reduction", "processing.sharpening"),
    neutral=Demosaic(),
    typical=Demosaic(method="bilinear"),
    bound=Demosaic(method="bilinear", output="red"),
    forward=forward,
    measure=measure,
    propagate=propagate,
    context=context,
    option="a colour mosaic",
    gum_class="F",
    equation="y = Σ w_place(Δr, Δc) g_colour x",
    typical_size="bilinear 0.008–0.015 px at D = 3 px, 0.005–0.008 at 5, 0.002–0.005 at 7 to 10; red plane up to 0.022 px",
    references=(
        "H. S. Malvar, L. He, R. Cutler, High-quality linear interpolation for demosaicing of Bayer-patterned color images, ICASSP 2004",
        "ITU-R BT.601-7 (weights of the luminance)",
    ),
    advice="Store the raw mosaic, balance its colours, and locate targets in it. Use targets of 7 px or more.",
    reasons={
        "correct": "of the two colours that were not measured at a pixel nothing is in the frame, and the filter has mixed those of its "
        "neighbours. Take raw frames; the pixels of the stored colour are as they were",
    },
)
