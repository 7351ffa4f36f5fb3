"""Sharpening: the difference from a blurred copy is added to the frame (unsharp mask)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.noise_covariance import CHARGE, WHITE, gaussian_half, response_to_white, unsharp_kernel
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.processing._codes import bits_of_camera, bordered, stored, surround
from pixmetry.sources.processing._kernels import blur

WEAK = 1e-3
METHOD = "autocovariance of the shot noise of flat-field pairs, up to 4 px, against that of an unsharp mask"
CONFOUNDERS = ("sharpening: a filter with the same power spectrum; noise does not tell the sign of its phase, edges do",)


class Sharpening(Parameters):
    """Strength and width of the mask."""

    amount: float = quantity(0.0, "1", "share of the difference from the blurred copy that is added", ge=0, le=10)
    sigma_px: float = quantity(1.0, "px", "standard deviation of the Gaussian that blurs the copy", gt=0, le=8)
    bits: int = bits_of_camera()


def gaussian(sigma_px: float) -> np.ndarray:
    """Sampled Gaussian from its middle to three standard deviations, shape (m + 1,), of sum 1 over both sides."""
    return gaussian_half(sigma_px, math.ceil(3 * sigma_px))


def forward(params: Sharpening, signal: Signal, stream: Stream) -> Signal:
    """x + amount (x − blurred x), rounded once; an overshoot beyond the range is cut off."""
    if params.amount == 0:
        return signal
    half = gaussian(params.sigma_px)
    blurred = blur(bordered(signal.data, half.size - 1), half)
    return signal.with_data(stored((1 + params.amount) * signal.data.astype(float) - params.amount * blurred, params.bits))


def context(params: Sharpening, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """Three standard deviations on each side."""
    return surround(windows, math.ceil(3 * params.sigma_px), frame_shape) if params.amount else windows


def measure(observations: Observations) -> Estimates:
    """Read strength and width off the correlation of the shot noise of neighbouring pixels, which a mask makes negative.

    The part of the noise that grows with light tells it: what arises behind the filter, such as its rounding, does not.
    """
    found = observations.noise_filter
    if found is None:
        remedy = "take pairs of flat fields and of dark frames, bright enough that the shot noise exceeds the noise in the dark"
        raise MeasureError("needs the shot noise of flat fields", where="processing.sharpening", remedy=remedy)
    if found.kind in (WHITE, CHARGE):
        shape = (response_to_white(unsharp_kernel(WEAK, 1.0))[0][1:]) / WEAK
        weighed = np.linalg.solve(found.covariance, shape)
        u = float(shape @ weighed) ** -0.5
        amount = float(weighed @ found.correlation[1:]) * u**2
        reasons = {"amount": "neighbours have no negative correlation; 95 % upper limit for a mask of 1 px"}
        row = ("amount", max(amount, 0.0) + ONE_SIDED_95 * u, u, math.inf, "1")
        return Estimates.from_rows([row], method=METHOD, confounders=CONFOUNDERS, limits=frozenset({"amount"}), reasons=reasons)
    if "amount" not in found.fit:
        what = f"what correlates neighbouring pixels ({found.name}) is no sharpening, and hides a weak one"
        raise MeasureError(what, where="processing.sharpening", remedy="switch off every filter in the camera, and take raw frames")
    return replace(found.fit, method=METHOD, confounders=CONFOUNDERS)


def propagate(params: Sharpening, probe: Probe) -> Contribution:
    """The estimator on the sharpened target, whose undershoot ends at black; and the rounding. The mask is symmetric: no bias."""
    x = np.asarray(probe.signal_dn, float)
    half = gaussian(params.sigma_px)
    m = half.size - 1
    padded = np.pad(x, ((0, 0), (m, m), (m, m)), mode="edge")
    full = np.concatenate([half[:0:-1], half])
    for axis in (1, 2):
        padded = np.lib.stride_tricks.sliding_window_view(padded, full.size, axis=axis) @ full
    dx, dy = probe.moved(np.clip(x + params.amount * (x - padded), 0, 2**params.bits - 1))
    rounding = probe.white(math.sqrt(1 / 12)) if params.amount else (0.0, 0.0)
    return probe.from_shifts(
        dx,
        dy,
        "F",
        beside=rounding,
        model_error=0.15,
        floor_px=5e-4,
        method="the estimator on the sharpened target",
    )


SOURCE = Source(
    id="processing.sharpening",
    title="Sharpening",
    description="Edges get a rim that is too bright inside and too dark outside. The noise grows and becomes correlated between "
    "neighbours.",
    parameters=Sharpening,
    consumes=(Kind.CODES,),
    after=("sensor", "electronics", "cable", "grabber", "processing.noise_reduction"),
    before=("storage",),
    neutral=Sharpening(),
    typical=Sharpening(amount=0.5),
    bound=Sharpening(amount=2.0, sigma_px=1.5),
    forward=forward,
    measure=measure,
    propagate=propagate,
    context=context,
    option="sharpening in the camera",
    gum_class="F",
    equation="y = x + a (x − G_σ ∗ x);  overshoot at a step of height h: a h (1 − w_0)/2 beside it",
    typical_size="0.01 to 0.1 px on targets of 3 px or less, through clipping and the threshold",
    references=("R. C. Gonzalez, R. E. Woods, Digital Image Processing, 4th ed., Pearson 2018, §3.6 (unsharp masking)", "ISO 12233:2023"),
    advice="Switch it off.",
    reasons={
        "correct": "codes that it pushed beyond the ends of the range are cut off, and many images give these. The others would need a "
        "deconvolution, which a symmetric filter does not need for its centres",
    },
)
