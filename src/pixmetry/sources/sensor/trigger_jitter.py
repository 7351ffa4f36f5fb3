"""Trigger jitter: the exposure does not begin when it is said to, so a moving target lies elsewhere."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class TriggerJitter(Parameters):
    """True start of the exposure minus the time that is written beside the frame."""

    latency_s: float = quantity(0.0, "s", "constant part", ge=-10, le=10)
    jitter_s: float = quantity(0.0, "s", "standard deviation from frame to frame", ge=0, le=1)
    clock_error_rel: float = quantity(
        0.0, "1", "rate at which the delay grows, because the clock of the time stamps is slow", ge=-0.01, le=0.01
    )


def delay_s(params: TriggerJitter, signal: Signal, stream: Stream) -> np.ndarray:
    """Delay of every frame, shape (n,)."""
    delay = params.latency_s + params.clock_error_rel * signal.time_s
    return delay + params.jitter_s * stream.normal_frames(signal.grid) if params.jitter_s else delay


def forward(params: TriggerJitter, signal: Signal, stream: Stream) -> Signal:
    """Look at the scene later by the delay."""
    if not signal.own_light.moving or not (params.latency_s or params.jitter_s or params.clock_error_rel):
        return signal
    return signal.with_light(signal.own_light.delayed(delay_s(params, signal, stream)[:, None]))


def truth(params: TriggerJitter, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Delay of every row, the same in all of a frame, shape (n, rows)."""
    return {"delay_s": delay_s(params, signal, stream)[:, None] * np.ones(signal.frame_shape[0])}


def measure(observations: Observations) -> Estimates:
    """Scatter of the time of exposure, from moving targets about their paths; latency and rate need another clock."""
    return observations.moving({"jitter_s": "jitter_s"}, where="sensor.trigger_jitter")


SOURCE = Source(
    id="sensor.trigger_jitter",
    title="Trigger and time-stamp jitter",
    description="The exposure starts later than its time stamp, by a constant, a drift and a random part. A moving target is then at "
    "another position.",
    parameters=TriggerJitter,
    consumes=(Kind.LIGHT,),
    after=("sensor.exposure", "sensor.interlace", "sensor.light_pulses", "sensor.rolling_shutter", "sensor.parasitic_light"),
    neutral=TriggerJitter(),
    typical=TriggerJitter(latency_s=50e-6, jitter_s=10e-6),
    bound=TriggerJitter(latency_s=2e-3, jitter_s=1e-3, clock_error_rel=1e-4),
    forward=forward,
    measure=measure,
    truth=truth,
    gum_class="O",
    equation="t' = t + t_latency + ε t + σ_t n;  shift v (t' − t)",
    typical_size="0.0005 px at 50 px/s and 10 µs; 0.05 px if a computer's clock gives the time to 1 ms",
    references=("IEEE 1588-2019 (precision time protocol)", "GigE Vision 2.0 (time stamps)"),
    advice="Use a hardware trigger and the time stamp of the camera, not of the computer. Synchronise clocks by PTP.",
    reasons={
        "correct": "a frame that is late and a scene that was displaced look the same: a frame does not contain its delay. "
        "Targets whose path is known tell it, and their speed times the delay is taken off positions",
        "propagate": "needs the target's speed, which the probe does not contain: u = v σ_t",
    },
)
