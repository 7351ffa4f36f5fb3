"""Temporal noise reduction: each frame is mixed with the last one that was put out."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.random import Stream
from pixmetry.sources.processing._codes import bits_of_camera, stored


class TemporalNoiseReduction(Parameters):
    """The recursive filter's weight."""

    alpha: float = quantity(0.0, "1", "share of the previous frame in the new one", ge=0, le=0.98)
    bits: int = bits_of_camera()


def start(params: TemporalNoiseReduction) -> float | None:
    """No frame yet; none at all where nothing is kept."""
    return float("nan") if params.alpha else None


def forward(params: TemporalNoiseReduction, signal: Signal, stream: Stream, state: np.ndarray | float | None) -> tuple[Signal, object]:
    """y = α y_before + (1 − α) x pixel by pixel; the camera keeps y unrounded (float64, shape (rows, cols)). The first frame is x."""
    if params.alpha == 0:
        return signal, state
    kept = np.asarray(state, float)
    out = np.empty(signal.data.shape, np.uint16)
    whole = kept.ndim == 2 and kept.shape == tuple(signal.frame_shape) != signal.data.shape[1:]
    for i, frame in enumerate(signal.data):
        if whole:  # windows on targets in the mode that freezes what lies around
            before = kept[np.ix_(signal.rows[i], signal.cols[i])]
            out[i] = stored(params.alpha * before + (1 - params.alpha) * frame, params.bits)
            continue
        now = frame.astype(float)
        kept = now if kept.ndim == 0 else params.alpha * kept + (1 - params.alpha) * now
        out[i] = stored(kept, params.bits)
    return signal.with_data(out), kept


SOURCE = Source(
    id="processing.temporal_noise_reduction",
    title="Temporal noise reduction",
    description="A recursive filter over the frames lowers the noise of a static scene. A moving target gets a tail.",
    parameters=TemporalNoiseReduction,
    consumes=(Kind.CODES,),
    after=("sensor", "electronics", "cable", "grabber", "processing.defect_correction"),
    before=("storage", "processing.sharpening"),
    neutral=TemporalNoiseReduction(),
    typical=TemporalNoiseReduction(alpha=0.5),
    bound=TemporalNoiseReduction(alpha=0.8),
    forward=forward,
    start=start,
    option="noise reduction in the camera",
    gum_class="O",
    equation="y(t) = α y(t − 1) + (1 − α) x(t);  noise √((1 − α)/(1 + α));  lag v α/(1 − α) T_f",
    typical_size="motion of one frame at α = 0.5; of four frames at 0.8",
    references=("A. V. Oppenheim, R. W. Schafer, Discrete-Time Signal Processing, Pearson 2010, §5.1 (group delay of a recursive filter)",),
    advice="Switch it off. Average frames afterwards, with the known motion.",
    reasons={
        "measure": "not measured: needs the correlation of the noise of successive frames of a steady scene: it is α",
        "propagate": "a target at rest is not shifted; the shift of a moving one, v α/(1 − α) T_f, needs its speed, which the probe lacks",
        "correct": "x = (y − α y_before)/(1 − α) needs the whole sequence without a gap",
    },
)
