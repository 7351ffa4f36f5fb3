"""Spatial noise reduction: each pixel becomes a middle value of those around it."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Literal

import numpy as np

from pixmetry.camera.noise_covariance import CHARGE, MEDIAN, WHITE, gaussian_half
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.processing._codes import bits_of_camera, bordered, stored, surround
from pixmetry.sources.processing._kernels import bilateral, blur, median

METHOD = "autocovariance of the noise of flat-field pairs, against that of each filter"
CONFOUNDERS = ("noise reduction: a sharpening behind it; optics and pixels do not correlate noise",)
BLUR_NAME = re.compile(r"Gaussian blur of radius (\d) px")


class NoiseReduction(Parameters):
    """Kind and size of the filter."""

    method: Literal["off", "median", "gaussian", "bilateral"] = quantity("off", "1", "bilateral: only pixels of similar value")
    radius_px: int = quantity(1, "px", "pixels to each side", ge=1, le=7)
    sigma_px: float = quantity(1.0, "px", "standard deviation of the weights in space (gaussian, bilateral)", gt=0, le=16)
    range_dn: float = quantity(10.0, "DN", "standard deviation of the weights in grey value (bilateral)", gt=0, le=65535)
    bits: int = bits_of_camera()


def half_weights(params: NoiseReduction) -> np.ndarray:
    """Gaussian weights from the middle outwards, shape (radius + 1,), of sum 1 over both sides."""
    return gaussian_half(params.sigma_px, params.radius_px)


def forward(params: NoiseReduction, signal: Signal, stream: Stream) -> Signal:
    """Filter every frame separately, mirrored at its border."""
    if params.method == "off":
        return signal
    m = params.radius_px
    codes = bordered(signal.data, m)
    if params.method == "median":
        return signal.with_data(median(codes, m))
    half = half_weights(params)
    if params.method == "gaussian":
        return signal.with_data(stored(blur(codes, half), params.bits))
    line = np.concatenate([half[:0:-1], half])
    apart = np.arange(min(math.ceil(6 * params.range_dn), 65535) + 1)
    likeness = np.exp(-0.5 * (apart / params.range_dn) ** 2)
    return signal.with_data(bilateral(codes, np.outer(line, line), likeness, float(2**params.bits - 1)))


def context(params: NoiseReduction, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The filter's radius on each side."""
    return windows if params.method == "off" else surround(windows, params.radius_px, frame_shape)


def measure(observations: Observations) -> Estimates:
    """Read the filter off the noise: a Gaussian by its fitted width, a median by the correlation that it gives to any normal noise."""
    found, where = observations.noise_filter, "processing.noise_reduction"
    remedy = "switch off every other filter in the camera, and take raw frames"
    if found is None:
        raise MeasureError("needs the shot noise of flat fields", where=where, remedy="take pairs of flat fields and of dark frames")
    if found.kind in (WHITE, CHARGE):
        raise MeasureError("not found: neighbours are not correlated as behind a smoothing filter", where=where)
    blur = BLUR_NAME.fullmatch(found.name)
    if blur is not None:
        sigma, radius = found.fit["sigma_px"], float(blur[1])
        rows = [("sigma_px", sigma.value, sigma.u, math.inf, "px"), ("radius_px", radius, 0.0, math.inf, "px")]
        why = {"sigma_px": "method: gaussian"}
        return Estimates.from_rows(rows, method=METHOD, confounders=CONFOUNDERS, reasons=why, settings={"method": "gaussian"})
    if found.name.startswith(MEDIAN):
        why = {"radius_px": "method: median; the noise has its correlation at every lag"}
        return replace(found.fit, method=METHOD, confounders=CONFOUNDERS, reasons=why, settings={"method": "median"})
    raise MeasureError(f"what correlates neighbouring pixels is no Gaussian and no median ({found.name})", where=where, remedy=remedy)


SOURCE = Source(
    id="processing.noise_reduction",
    title="Spatial noise reduction",
    description="The filter smooths noise and small targets. Its effect on an edge depends on the noise there.",
    parameters=NoiseReduction,
    consumes=(Kind.CODES,),
    after=("sensor", "electronics", "cable", "grabber", "processing.defect_correction"),
    before=("storage", "processing.sharpening"),
    neutral=NoiseReduction(),
    typical=NoiseReduction(method="median"),
    bound=NoiseReduction(method="bilateral", radius_px=2, sigma_px=1.5, range_dn=20.0),
    forward=forward,
    measure=measure,
    context=context,
    option="noise reduction in the camera",
    gum_class="F",
    equation="y = median, Σ w x, or Σ w(Δr) w(Δx) x / Σ w(Δr) w(Δx) of the pixels around",
    typical_size="0.01 to 0.1 px on targets of 3 px or less; a target of one pixel vanishes",
    references=(
        "J. W. Tukey, Exploratory Data Analysis, Addison-Wesley 1977 (running medians)",
        "C. Tomasi, R. Manduchi, Bilateral filtering for gray and color images, ICCV 1998",
    ),
    advice="Switch it off; average frames instead.",
    reasons={
        "correct": "different images give one output: a median keeps the middle value alone, and weights that depend on grey values are "
        "lost with these values. Switch it off in the camera",
        "propagate": "its effect on an edge depends on the noise there: only a simulation with the camera's noise gives the contribution",
    },
)
