"""Gain of the read-out taps: neighbouring parts of the frame, and odd and even columns, go through amplifiers of their own."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

LEAST_COLS = 96  # of a frame whose borders are looked for


class TapGain(Parameters):
    """Gains of the amplifiers about their mean; neighbouring taps differ by the step, in turn up and down."""

    taps: int = quantity(2, "1", "parts of equal width, side by side, each with an amplifier of its own", ge=1, le=64)
    step_rel: float = quantity(0.0, "1", "gain of the second tap over that of the first, less 1", ge=-0.3, le=0.3)
    odd_even_rel: float = quantity(0.0, "1", "gain of odd columns over that of even ones, less 1", ge=-0.3, le=0.3)
    slope_rel: float = quantity(0.0, "1", "growth of the gain from black to the reference signal", ge=-0.3, le=0.3)
    reference_dn: float = quantity(4095.0, "DN", "signal above black to which the slope refers, the largest code", gt=0, le=1e9)


def tap_of(params: TapGain, cols: np.ndarray, frame_cols: int) -> np.ndarray:
    """Number of the tap of each column."""
    return cols * params.taps // frame_cols


def column_gain(params: TapGain, cols: np.ndarray, frame_cols: int) -> np.ndarray:
    """Gain of each column for small signals, float64: 1 ± step/2 by tap, ± odd_even/2 by parity."""
    side = tap_of(params, cols, frame_cols) % 2 - 0.5
    return 1 + params.step_rel * side + params.odd_even_rel * (cols % 2 - 0.5)


def forward(params: TapGain, signal: Signal, stream: Stream) -> Signal:
    """Multiply by each column's gain; it grows with the signal as far as the reference, to either side of black."""
    if params.step_rel == 0 and params.odd_even_rel == 0 and params.slope_rel == 0:
        return signal
    x = signal.data
    gain = column_gain(params, signal.cols, signal.frame_shape[1]).astype(np.float32)[:, None, :]
    if params.slope_rel == 0:
        return signal.with_data(x * gain)
    share = np.clip(x * np.float32(1 / params.reference_dn), -1, 1)
    return signal.with_data(x * (gain + np.float32(params.slope_rel) * share))


def correct(params: TapGain, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Divide by the gain; with a slope, by the root of y = x (g + s x/ref), or the straight line beyond the reference, in float64."""
    y = signal.data.astype(float)
    gain = column_gain(params, signal.cols, signal.frame_shape[1])[:, None, :]
    x = y / gain
    if params.slope_rel:
        ref, slope = params.reference_dn, params.slope_rel
        x = 2 * y / (gain + np.sqrt(np.maximum(gain**2 + 4 * slope * y / ref, 0)))
        x = np.where(y > ref * (gain + slope), y / (gain + slope), x)
        x = np.where(y < -ref * (gain - slope), y / (gain - slope), x)
    return signal.with_data(x.astype(np.float32))


def truth(params: TapGain, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Tap and small-signal gain of every column of the frame, shape (cols,)."""
    cols = np.arange(signal.frame_shape[1])
    return {"tap": tap_of(params, cols, len(cols)), "gain": column_gain(params, cols, len(cols))}


def measure(observations: Observations) -> Estimates:
    """Read what the columns of the flat field tell, see `pixmetry.observe.tap_steps`.

    Raises
    ------
    MeasureError
        Without stacks, or if they have few columns or are saturated.
    """
    where = "electronics.tap_gain"
    dark, _ = observations.stacks
    taps = observations.taps
    if taps is None or not len(taps.fit):
        what, value = f"needs a stack of bright frames, not saturated, of {LEAST_COLS} columns or more", f"{dark.shape[1]} columns"
        raise MeasureError(what, where=where, value=value, remedy="take 16 or more bright frames at half of saturation")
    return taps.fit


def propagate(params: TapGain, probe: Probe) -> Contribution:
    """Propagator P2 with e = x (g − 1): a border is anywhere in the frame, hence in a given column with probability (taps − 1)/columns.

    Away from the borders a tap's gain is common to the target and moves nothing. The slope bends the response alike for all columns.
    Few targets lie on a border: the kurtosis says so, ⟨(c + d)⁴⟩ = ⟨c⁴⟩ + 6⟨c² d²⟩ + ⟨d⁴⟩ with the shift d of a border, up or down, and
    that of stripes and slope, c, in the axis in which it is the larger.
    """
    x = np.asarray(probe.signal_dn, float)
    cols = np.arange(x.shape[2])
    stripes = probe.field(x * (params.odd_even_rel * (cols % 2 - 0.5)))
    bent = probe.field(x * params.slope_rel * np.clip(x / params.reference_dn, -1, 1))
    mean = [float(np.mean(b)) for b in bent]
    square = [float(np.mean(s**2) + np.mean(b**2)) for s, b in zip(stripes, bent, strict=True)]
    everywhere = [s**2 + b**2 for s, b in zip(stripes, bent, strict=True)]
    fourth = [float(np.mean(c2**2)) for c2 in everywhere]
    if params.step_rel:
        chance = (params.taps - 1) / probe.frame_shape[1]
        upwards = (params.taps - 1) % 2 / probe.frame_shape[1]  # borders that step up, less those that step down
        for border in range(1, x.shape[2]):
            shifts = probe.field(x * (params.step_rel * ((cols >= border) - 0.5)))
            square = [s + chance * float(np.mean(d**2)) for s, d in zip(square, shifts, strict=True)]
            more = [float(np.mean(d**4 + 6 * c2 * d**2)) for c2, d in zip(everywhere, shifts, strict=True)]
            fourth = [f + chance * m for f, m in zip(fourth, more, strict=True)]
            mean = [m + upwards * float(np.mean(d)) for m, d in zip(mean, shifts, strict=True)]
    larger = int(np.argmax(square))
    return Contribution(
        u_x_px=float(np.sqrt(max(square[0] - mean[0] ** 2, 0.0))),
        u_y_px=float(np.sqrt(max(square[1] - mean[1] ** 2, 0.0))),
        bias_x_px=mean[0],
        bias_y_px=mean[1],
        gum_class="F",
        model_error=0.3,
        method="linear response of the estimator to the gain steps, over all places of the borders",
        kurtosis=max(3.0, fourth[larger] / square[larger] ** 2) if square[larger] else 3.0,
    )


SOURCE = Source(
    id="electronics.tap_gain",
    title="Gain of the taps",
    description="Parts of the frame pass through different amplifiers with different gains. This gives steps at the borders and stripes "
    "of odd columns.",
    number=19,
    parameters=TapGain,
    consumes=(Kind.DN,),
    after=("sensor", "electronics.gain"),
    before=("cable", "grabber", "processing", "storage", "electronics.agc", "electronics.gamma"),
    neutral=TapGain(),
    typical=TapGain(step_rel=0.01, odd_even_rel=0.002),
    bound=TapGain(taps=4, step_rel=0.03, odd_even_rel=0.01, slope_rel=0.01),
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    truth=truth,
    option="several output amplifiers",
    gum_class="F",
    equation="y = x (1 ± Δg/2 ± Δg_oe/2 + g1 x/x_ref)",
    typical_size="(D/3π) Δg = 0.74 px · Δg for a border through a disc of 7 px: 0.007 px for 1 %",
    references=("ISO 14524:2009 (opto-electronic conversion function)", "EMVA 1288 R4.0 Linear, §8.2 (column split)"),
    leaves="the deviation of the taps' real curves from the model",
    advice="Balance the taps with a flat field: one gain for each tap, from the means of the columns on both sides of the border.",
)
