"""High dynamic range by two gains or a knee: a signal put together of two parts whose scales do not quite agree."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream

BOUNDLESS_DN = 1e9


class HdrGain(Parameters):
    """The upper part of the signal as it comes out after both parts are brought to the scale of the lower one."""

    mode: Literal["two gains", "knee"] = quantity(
        "two gains", "1", "two gains: the upper part is read at a low gain; knee: a response with a bend"
    )
    switch_dn: float = quantity(BOUNDLESS_DN, "DN", "signal above black where the upper part begins", gt=0, le=BOUNDLESS_DN)
    mismatch_rel: float = quantity(0.0, "1", "relative error of the ratio of the two slopes that the camera assumes", ge=-0.98, le=0.5)
    offset_dn: float = quantity(0.0, "DN", "two gains: error of the upper part's black level", ge=-1e4, le=1e4)
    column_std_rel: float = quantity(0.0, "1", "standard deviation of the ratio from column to column, fixed in the unit", ge=0, le=0.2)
    upper_noise_dn: float = quantity(0.0, "DN", "noise that the read-out of the upper part adds, on this scale", ge=0, le=1e4)
    ratio: int = quantity(1, "1", "two gains: step of the upper part in DN", ge=1, le=256)


def slopes(params: HdrGain, grid: Grid, stream: Stream) -> np.ndarray:
    """Slope of the upper part over the true one in each column, shape (n, cols), float32."""
    slope = np.full((len(grid.frame), grid.shape[1]), 1 + params.mismatch_rel, np.float32)
    if params.column_std_rel:
        slope += np.float32(params.column_std_rel) * stream.normal_cols_fixed(grid)
    return np.maximum(slope, 0)


def joined(params: HdrGain, lower: np.ndarray, upper: np.ndarray, slope: np.ndarray | float) -> np.ndarray:
    """The signal of two readings; which of them is taken hangs on the lower one (of a bend: the part above it gets another slope)."""
    if params.mode == "knee":
        return np.where(lower > params.switch_dn, params.switch_dn + slope * (upper - params.switch_dn), lower)
    high = slope * upper + params.offset_dn
    if params.ratio > 1:
        high = params.ratio * np.floor(high / params.ratio + 0.5)
    return np.where(lower > params.switch_dn, high, lower)


def forward(params: HdrGain, signal: Signal, stream: Stream) -> Signal:
    """Replace the signal above the switch by the reading of the upper part."""
    if params.switch_dn >= BOUNDLESS_DN:
        return signal
    upper = signal.data
    if params.upper_noise_dn:
        upper = stream.add_normal(upper, signal.grid, params.upper_noise_dn)
    slope = slopes(params, signal.grid, stream)[:, None, :]
    return signal.with_data(joined(params, signal.data, upper, slope).astype(np.float32))


def truth(params: HdrGain, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Slope of the upper part over the true one in each column."""
    return {"upper_slope_rel": slopes(params, signal.take(np.array([0])).grid, stream)[0]}


def correct(params: HdrGain, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Bring what lies above the middle of the jump back to the scale of the lower part, by the mean slope and offset."""
    if params.switch_dn >= BOUNDLESS_DN:
        return signal.with_data(signal.data.astype(np.float32))
    y, slope, at = signal.data.astype(np.float64), 1 + params.mismatch_rel, params.switch_dn
    if params.mode == "knee":
        x = np.where(y > at, at + (y - at) / slope, y)
    else:
        jump = slope * at + params.offset_dn - at
        x = np.where(y > at + jump / 2, (y - params.offset_dn) / slope, y)
    return signal.with_data(x.astype(np.float32))


def measure(observations: Observations) -> Estimates:
    """Place of a knee, and the slope above it over that below, from patches of known light."""
    return observations.curve(("switch_dn", "mismatch_rel"), where="electronics.hdr_gain")


def propagate(params: HdrGain, probe: Probe) -> Contribution:
    """Propagator P4: the estimator on the target with its upper part changed; P1 for the noise, P2 for the columns of that part."""
    signal = probe.signal_dn
    above = signal > params.switch_dn
    if not above.any():
        return probe.contribution((0.0, 0.0), "F", method="the target is below the level where the gain changes")
    dx, dy = probe.moved(joined(params, signal, signal, 1 + params.mismatch_rel))
    base = params.switch_dn if params.mode == "knee" else 0.0
    noise = probe.white(np.where(above, params.upper_noise_dn * (1 + params.mismatch_rel), 0.0))
    lines = probe.columns(np.where(above, params.column_std_rel * (signal - base), 0.0))
    u = [float(np.sqrt(np.var(d) + n**2 + c**2)) for d, n, c in zip((dx, dy), noise, lines, strict=True)]
    return Contribution(
        u_x_px=u[0],
        u_y_px=u[1],
        bias_x_px=float(np.mean(dx)),
        bias_y_px=float(np.mean(dy)),
        gum_class="F",
        model_error=0.2,
        method="the estimator on the target with its upper part changed; linear response to the noise and the columns of that part",
    )


SOURCE = Source(
    id="electronics.hdr_gain",
    title="Stitching of two gains",
    description="Bright pixels are read at a low gain and scaled up. The signal jumps where the gain changes; above it, noise and "
    "columns differ.",
    parameters=HdrGain,
    consumes=(Kind.DN,),
    after=("sensor", "electronics.gain"),
    before=("cable", "grabber", "storage"),
    neutral=HdrGain(),
    typical=HdrGain(switch_dn=60.0, mismatch_rel=0.02, offset_dn=0.5, column_std_rel=0.002, upper_noise_dn=0.5),
    bound=HdrGain(switch_dn=60.0, mismatch_rel=0.05, offset_dn=2.0, column_std_rel=0.005, upper_noise_dn=2.0, ratio=4),
    forward=forward,
    measure=measure,
    truth=truth,
    correct=correct,
    propagate=propagate,
    applies_to=("cmos",),
    option="several gains in one frame",
    gum_class="F",
    equation="y = x below s;  above: (1 + m + m_col) x + o + noise, in steps of the ratio;  knee: s + (1 + m)(x − s)",
    typical_size="below 0.002 px for 2 % of mismatch on a disc of 7 px",
    references=("EMVA 1288 R4.0 General (cameras with a non-linear response)",),
    leaves="pixels near the switch that were read on the other side of it by noise",
    advice="Expose so that the whole target is below or above the change of gain. Calibrate the ratio of the gains column by column.",
)
