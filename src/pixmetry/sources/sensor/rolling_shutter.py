"""Rolling shutter: every row is exposed a little later than the one before."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class RollingShutter(Parameters):
    """Time from row to row, and where the reading begins."""

    row_time_s: float = quantity(0.0, "s", "time from the read-out of one row to the next", ge=0, le=0.01)
    first_row: Literal["top", "bottom"] = quantity("top", "1", "the row that is read first")
    reset: Literal["rolling", "global"] = quantity(
        "rolling", "1", "rolling: all rows are exposed for the same time; global: all start together, and the last rows collect more light"
    )


def delay_s(params: RollingShutter, signal: Signal) -> np.ndarray:
    """How much later than the first row each row is read, shape (n, rows)."""
    rows = signal.rows.astype(float)
    return params.row_time_s * (rows if params.first_row == "top" else signal.frame_shape[0] - 1 - rows)


def forward(params: RollingShutter, signal: Signal, stream: Stream) -> Signal:
    """Let every row look in its own time; after a global reset, over a longer time."""
    light = signal.own_light
    if not params.row_time_s:
        return signal
    if params.reset == "rolling":
        return signal.with_light(light.delayed(delay_s(params, signal))) if light.moving else signal
    longer = (1 + delay_s(params, signal) / signal.exposure_s[:, None])[:, :, None]
    times, weights = light.moments
    start = signal.time_s[:, None, None]
    return signal.with_light(light.seen_at(start + (times - start) * longer, weights * longer))


def truth(params: RollingShutter, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Delay of the read-out and of the middle of the exposure of every row, and relative length of its exposure, shape (n, rows) each."""
    delay = delay_s(params, signal)
    if params.reset == "rolling":
        return {"read_delay_s": delay, "delay_s": delay, "exposure_rel": np.ones_like(delay)}
    return {"read_delay_s": delay, "delay_s": 0.5 * delay, "exposure_rel": 1 + delay / signal.exposure_s[:, None]}


def measure(observations: Observations) -> Estimates:
    """Time from row to row, from moving targets; where the reading begins is among the settings."""
    return observations.moving({"row_time_s": "row_time_s"}, where="sensor.rolling_shutter", settings=["first_row"])


SOURCE = Source(
    id="sensor.rolling_shutter",
    title="Rolling shutter",
    description="Rows are exposed one after the other. A moving target is sheared and stretched, and flickering light makes bands.",
    parameters=RollingShutter,
    consumes=(Kind.LIGHT,),
    after=("sensor.exposure",),
    before=("sensor.trigger_jitter",),
    neutral=RollingShutter(),
    typical=RollingShutter(row_time_s=10e-6),
    bound=RollingShutter(row_time_s=30e-6),
    forward=forward,
    measure=measure,
    truth=truth,
    applies_to=("cmos", "cid"),
    gum_class="O",
    equation="row r looks at t + r t_row;  shift v t_row (r − r0);  after a global reset row r gathers for t_exp + r t_row",
    typical_size="1.02 px from the first to the last of 2048 rows at 50 px/s and 10 µs",
    references=("C. Geyer, M. Meingast, S. Sastry, OMNIVIS 2005 (geometric models of rolling shutters)",),
    advice="Use a global shutter, or a strobe after a global reset. Otherwise model the time of every row.",
    reasons={
        "correct": "a target at row r belongs to the time of that row, so the correction needs its speed: a moving target and one of "
        "another shape give the same frame. `pixmetry corrected` takes speeds",
        "propagate": "needs the target's speed, which the probe does not contain",
    },
)
