"""Temporal noise reduction: each frame is mixed with the last one that was put out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.noise_covariance import frame_correlation
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.processing._codes import bits_of_camera, stored

MOST_CLIPPED, LEAST_DN2, NOT_SIGNIFICANT = 0.002, 0.3, 3.0
METHOD = "ratio of the mean squares of frame differences two and one frames apart, over stacks of a steady scene"
CONFOUNDERS = ("temporal noise reduction: pixels that blink or drift slowly; image lag of a kind that shares each charge out",)


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


def measure(observations: Observations) -> Estimates:
    """Read α off the stacks: half the mean square of differences of frames two apart over that of one apart, less 1, is α.

    Both stacks tell it, weighted by their u. Lag of the sensor, dark current that drifts and traps that blink act on one of them: where
    the two differ by more than their u allow, u is widened (Birge's ratio).
    """
    seen, where = observations.noise_covariance, "processing.temporal_noise_reduction"
    groups = [] if seen is None else np.flatnonzero((seen.n_successive > 3) & (seen.clipped <= MOST_CLIPPED)).tolist()
    if seen is None or not groups:
        remedy = "take 16 or more frames of each, one directly after the other, and not clipped"
        raise MeasureError("needs a stack of dark or bright frames in the order in which they were taken", where=where, remedy=remedy)
    if (seen.successive_dn2[groups, 0] < LEAST_DN2).all():
        remedy = "take bright frames at half of saturation, or set a higher gain"
        raise MeasureError("rounding hides the noise of the frames", where=where, remedy=remedy)
    parts = np.array([frame_correlation(seen, g) for g in groups if seen.successive_dn2[g, 0] >= LEAST_DN2])
    weight = parts[:, 1] ** -2.0
    alpha, u = float(weight @ parts[:, 0] / weight.sum()), float(weight.sum() ** -0.5)
    if len(parts) > 1:
        u *= max(1.0, float(np.sqrt((weight * (parts[:, 0] - alpha) ** 2).sum() / (len(parts) - 1))))
    if alpha > NOT_SIGNIFICANT * u:
        return Estimates.from_rows([("alpha", min(alpha, 0.98), u, np.inf, "1")], method=METHOD, confounders=CONFOUNDERS)
    why = {"alpha": "successive frames are not correlated; 95 % upper limit"}
    row = ("alpha", max(alpha, 0.0) + ONE_SIDED_95 * u, u, np.inf, "1")
    return Estimates.from_rows([row], method=METHOD, confounders=CONFOUNDERS, limits=frozenset({"alpha"}), reasons=why)


def correct(params: TemporalNoiseReduction, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Take off each frame the share of the one before, as it was put out: x = (y − α y_before)/(1 − α).

    Raises
    ------
    InputError
        If the signal holds no successive frames.
    """
    signal.need_frame_before()
    out = signal.data.astype(np.float32)  # of the first frame the one before is not known: it stays as it is
    out[1:] -= np.float32(params.alpha) * signal.data[:-1]
    out[1:] /= np.float32(1 - params.alpha)
    return signal.with_data(out)


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
    measure=measure,
    correct=correct,
    start=start,
    option="noise reduction in the camera",
    gum_class="O",
    equation="y(t) = α y(t − 1) + (1 − α) x(t);  noise √((1 − α)/(1 + α));  lag v α/(1 − α) T_f",
    typical_size="motion of one frame at α = 0.5; of four frames at 0.8",
    references=("A. V. Oppenheim, R. W. Schafer, Discrete-Time Signal Processing, Pearson 2010, §5.1 (group delay of a recursive filter)",),
    leaves="the rounding, enlarged by √(1 + α²)/(1 − α), the noise that the camera's own rounding adds, and the first frame of a sequence",
    advice="Switch it off. Average frames afterwards, with the known motion.",
    reasons={
        "propagate": "a target at rest is not shifted; the shift of a moving one, v α/(1 − α) T_f, needs its speed, which the probe lacks",
    },
)
