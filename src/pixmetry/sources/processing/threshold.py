"""Threshold and sampling: the error that an estimator makes on a perfect, noise-free frame, because it sees pixels."""

from __future__ import annotations

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Parameters, Source


class Threshold(Parameters):
    """It has no parameter here: the threshold belongs to the estimator."""


def propagate(params: Threshold, probe: Probe) -> Contribution:
    """The S-curve: estimated minus true position at each phase."""
    method = "the estimator on noise-free targets at the probe's phases"
    return probe.from_shifts(probe.x_hat_px - probe.x_px, probe.y_hat_px - probe.y_px, "F", model_error=0.05, method=method)


SOURCE = Source(
    id="processing.threshold",
    title="Threshold and sampling",
    description="The pixels above a threshold change with the position of the target within the pixel, and so does the measured centre.",
    number=37,
    stars=3,
    note="Note 8",
    parameters=Threshold,
    consumes=(Kind.CODES,),
    typical=Threshold(),
    bound=Threshold(),
    propagate=propagate,
    gum_class="F",
    equation="e(c) = −2 Σ_k S_k sin(2πkc)/∫h,  S_k = ∫ x h(x) sin(2πkx) dx",
    typical_size="0.0024 px hard, 0.0011 px soft, for a disc of 7 px and a threshold of three standard deviations",
    references=("B. F. Alexander, K. C. Ng, Optical Engineering 30(9), 1991 (systematic error of the centroid)",),
    advice="Set the threshold three standard deviations above the background and subtract it (soft threshold).",
    reasons={
        "forward": "it acts in the estimator, not on the frame",
        "measure": "it acts in the estimator, and no frame holds it. The budget evaluates it there",
        "correct": "it acts in the estimator and not on frames. Choose a soft threshold, or fit a model of the target",
        "neutral": "every estimator works on pixels",
    },
)
