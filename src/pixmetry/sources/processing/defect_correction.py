"""Defect correction in the camera: a pixel that stands out from all its neighbours is taken for a defect and replaced."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pixmetry.camera.noise_covariance import CHARGE, UNKNOWN, WHITE
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Flags
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.processing._codes import bordered, surround
from pixmetry.sources.processing._kernels import replace_outliers

OFF = 65535
ENOUGH, FEWER = 30.0, 0.7  # outliers; share of those due
METHOD = "single pixels above or below their eight neighbours in flat fields, against their number in normal noise"


class DefectCorrection(Parameters):
    """When a pixel is taken for a defect."""

    threshold_dn: int = quantity(
        OFF, "DN", "by how much a pixel is above the highest or below the lowest neighbour; 65535: off", ge=0, le=OFF
    )
    mosaic: Literal["none", "bayer"] = quantity("none", "1", "neighbours of the same colour lie two pixels away in a colour mosaic")


def reach(params: DefectCorrection) -> int:
    """Pixels from a pixel to its neighbours of the same colour."""
    return 2 if params.mosaic == "bayer" else 1


def forward(params: DefectCorrection, signal: Signal, stream: Stream) -> Signal:
    """Replace what stands out by the median of the eight neighbours; beyond the frame it is mirrored, which keeps the colours."""
    if params.threshold_dn == OFF:
        return signal
    return signal.with_data(replace_outliers(bordered(signal.data, reach(params)), reach(params), params.threshold_dn))


def context(params: DefectCorrection, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The neighbours."""
    return windows if params.threshold_dn == OFF else surround(windows, reach(params), frame_shape)


def replaced(params: DefectCorrection, codes: np.ndarray) -> np.ndarray:
    """Mask of the pixels of frames (n, rows, cols) that are taken for defects; one that equals the neighbours' median stays unseen."""
    if params.threshold_dn == OFF:
        return np.zeros(codes.shape, bool)
    changed: Flags = replace_outliers(bordered(codes, reach(params)), reach(params), params.threshold_dn) != codes
    return changed


def measure(observations: Observations) -> Estimates:
    """Read the threshold off the single outliers of bright frames: beyond it they are missing."""
    where, found, noise = "processing.defect_correction", observations.outliers, observations.noise_filter
    if found is None:
        remedy = "take a stack of bright frames at half of saturation, with a noise of 2 DN or more"
        raise MeasureError("needs the noise of bright frames", where=where, remedy=remedy)
    if noise is not None and noise.kind not in (WHITE, CHARGE, UNKNOWN):
        raise MeasureError(f"what correlates neighbouring pixels ({noise.name}) changes the outliers", where=where)
    large = slice(int(found.sigma_dn), None)
    if np.isnan(found.cut_dn) and found.counts[large].sum() < FEWER * found.expected[large].sum():
        what = "large outliers are fewer than in normal noise, and none are cut off: a threshold far below the noise, or a smoothing filter"
        remedy = "take bright frames of less noise, and switch off every filter in the camera"
        raise MeasureError(what, where=where, value=f"noise of {found.sigma_dn:.3g} DN", remedy=remedy)
    if np.isnan(found.cut_dn):
        there = np.flatnonzero(np.cumsum(found.expected[::-1])[::-1] > ENOUGH)
        reach = f"up to {int(there.max())} DN above their neighbours" if there.size else "of any size"
        raise MeasureError(f"not found: pixels {reach} are as many as normal noise has; a larger threshold would not show", where=where)
    why = {"threshold_dn": f"mosaic: {'bayer' if found.step == 2 else 'none'}; of normal noise {found.sigma_dn:.3g} DN wide, more were due"}
    row = ("threshold_dn", found.cut_dn, found.u_cut_dn, np.inf, "DN")
    settings = {"mosaic": "bayer" if found.step == 2 else "none"}
    return Estimates.from_rows([row], method=METHOD, reasons=why, settings=settings)


SOURCE = Source(
    id="processing.defect_correction",
    title="Defect correction",
    description="Single bright or dark pixels are replaced by the median of their neighbours. This also removes the peak of a target of "
    "one pixel.",
    number=17,
    parameters=DefectCorrection,
    consumes=(Kind.CODES,),
    after=("sensor", "electronics", "cable", "grabber"),
    before=("storage", "processing.demosaic", "processing.noise_reduction", "processing.sharpening"),
    neutral=DefectCorrection(),
    typical=DefectCorrection(threshold_dn=1),
    bound=DefectCorrection(threshold_dn=0),
    forward=forward,
    measure=measure,
    context=context,
    option="defect correction in the camera",
    gum_class="F",
    equation="y = median of the 8 neighbours if x > max + T or x < min − T, else x",
    typical_size="none on a disc of 7 px; a target of one pixel vanishes, one of 2 px is shifted by up to 0.3 px",
    references=("EMVA 1288 R4.0 Linear, §8.5 (defect pixels)",),
    advice="Switch it off, or let it replace only listed defects. Use targets of 3 px or more.",
    reasons={
        "correct": "the values that were replaced are not in the frame: whatever they were, it is the same. Switch the correction off in "
        "the camera, and use sensor.defects",
        "propagate": "the noise decides which pixels are replaced: only a simulation with the camera's noise gives the contribution",
    },
)
