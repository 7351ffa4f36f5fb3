"""Demosaicing: a camera makes full frames of one colour, or of the luminance, out of a mosaic of three."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.random import Stream
from pixmetry.sources.processing._codes import bits_of_camera, bordered, surround
from pixmetry.sources.processing._kernels import filter_by_place

LUMA = {"R": 0.299, "G": 0.587, "B": 0.114}  # ITU-R BT.601
REACH = 2

# Weights × 8 of Malvar, He and Cutler (2004): the bilinear value plus 1/2, 5/8 or 3/4 of the Laplacian of the pixel's own colour.
GREEN_AT_OTHER = np.array([[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]]) / 8
BESIDE = np.array([[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]]) / 8  # in its row
ACROSS = np.array([[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]]) / 8  # at the corners


class Demosaic(Parameters):
    """The mosaic, its interpolation, and the stored colour."""

    method: Literal["off", "bilinear", "malvar"] = quantity("off", "1", "malvar: linear with 5 × 5 weights by Malvar, He and Cutler")
    output: Literal["luma", "red", "green", "blue"] = quantity("luma", "1", "one colour, or 0.299 R + 0.587 G + 0.114 B")
    pattern: Literal["RGGB", "GRBG", "GBRG", "BGGR"] = quantity("RGGB", "1", "colours of pixels (0,0), (0,1), (1,0), (1,1), row by row")
    red_gain: float = quantity(1.0, "1", "white balance: factor on red pixels", gt=0, le=16)
    green_gain: float = quantity(1.0, "1", "factor on green pixels", gt=0, le=16)
    blue_gain: float = quantity(1.0, "1", "factor on blue pixels", gt=0, le=16)
    bits: int = bits_of_camera()


def channel_weights(method: str, pattern: str, row: int, col: int, colour: str) -> np.ndarray:
    """Weights, shape (5, 5), that give a colour at the place (row, col) of the pattern."""

    def at(r: int, c: int) -> str:
        return pattern[2 * (r % 2) + c % 2]

    here = at(row, col)
    out = np.zeros((5, 5))
    if here == colour:
        out[2, 2] = 1.0
        return out
    if method == "malvar":
        if colour == "G":
            return GREEN_AT_OTHER
        if here == "G":
            return BESIDE if at(row, col + 1) == colour else BESIDE.T
        return ACROSS
    near = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if at(row + r, col + c) == colour]
    for r, c in near:
        out[2 + r, 2 + c] = 1 / len(near)
    return out


def weights(params: Demosaic) -> np.ndarray:
    """Weights of the output on the raw mosaic at its four places, white balance included, shape (2, 2, 5, 5)."""
    mix = LUMA if params.output == "luma" else {params.output[0].upper(): 1.0}
    gain = {"R": params.red_gain, "G": params.green_gain, "B": params.blue_gain}
    out = np.zeros((2, 2, 5, 5))
    for row in (0, 1):
        for col in (0, 1):
            colours = [params.pattern[2 * ((row + r) % 2) + (col + c) % 2] for r in range(-REACH, 3) for c in range(-REACH, 3)]
            balance = np.array([gain[c] for c in colours]).reshape(5, 5)
            total = sum(share * channel_weights(params.method, params.pattern, row, col, colour) for colour, share in mix.items())
            out[row, col] = total * balance
    return out


def forward(params: Demosaic, signal: Signal, stream: Stream) -> Signal:
    """Fill in the mosaic and round once; beyond the frame it is mirrored."""
    if params.method == "off":
        return signal
    codes = bordered(signal.data, REACH)
    return signal.with_data(filter_by_place(codes, signal.grid.row0, signal.grid.col0, weights(params), float(2**params.bits - 1)))


def context(params: Demosaic, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """Two pixels on each side."""
    return windows if params.method == "off" else surround(windows, REACH, frame_shape)


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
        "measure": "not measured: needs the noise spectra at each position of the pattern; the camera's manual states the method",
        "correct": "the raw mosaic is lost, except at the pixels of the colour that is stored",
    },
)
