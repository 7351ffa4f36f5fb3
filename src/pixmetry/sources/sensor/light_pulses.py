"""Two light pulses: one at the end of the first field and one at the start of the second, so that both see nearly the same instant."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from pixmetry.camera.light import GAUSS
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class LightPulses(Parameters):
    """One pulse for each field, and additional steady light."""

    separation_s: float = quantity(1e-3, "s", "time from the middle of the first pulse to the middle of the second", ge=0, le=1)
    pulse_s: float = quantity(20e-6, "s", "length of a pulse", ge=0, le=1)
    ambient_share: float = quantity(0.0, "1", "share of steady light in the exposure of a field; 1: no pulse", ge=0, le=1)
    first_field: Literal["even", "odd"] = quantity("even", "1", "the rows that are exposed first")


def delay_s(params: LightPulses, signal: Signal) -> np.ndarray:
    """Middle of the pulse that each row sees, from the end of the first field's exposure, shape (n, rows)."""
    second = signal.rows % 2 == (1 if params.first_field == "even" else 0)
    delay: Array = params.separation_s * (second - 0.5)
    return delay


def forward(params: LightPulses, signal: Signal, stream: Stream) -> Signal:
    """Let each row see its field's pulse, and the steady light at the times at which it looked before."""
    if not signal.own_light.moving or params.ambient_share == 1:
        return signal
    nodes, shares = GAUSS[3]
    middle = (signal.time_s + signal.exposure_s)[:, None] + delay_s(params, signal)
    at = middle[:, :, None] + params.pulse_s * nodes
    weights = np.broadcast_to((1 - params.ambient_share) * shares, at.shape)
    if params.ambient_share:
        times, before = signal.own_light.moments
        size = (*at.shape[:2], times.shape[2])
        at = np.concatenate([at, np.broadcast_to(times, size)], axis=2)
        weights = np.concatenate([weights, np.broadcast_to(params.ambient_share * before, size)], axis=2)
    return signal.with_light(signal.own_light.seen_at(at, weights))


def truth(params: LightPulses, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Middle of the pulse that each row sees, shape (n, rows)."""
    return {"pulse_time_s": (signal.time_s + signal.exposure_s)[:, None] + delay_s(params, signal)}


def measure(observations: Observations) -> Estimates:
    """Time between the pulses and the share of steady light, from moving targets with and without the pulses."""
    names, where = {n: n for n in ("separation_s", "ambient_share")}, "sensor.light_pulses"
    motion = observations.motion
    if motion is not None and not {*names} & {*motion.fit.names, *motion.fit.reasons}:
        remedy = "take runs of kind motion with pulsed: true, and the same without pulses"
        raise MeasureError("no frames of moving targets in the light of two pulses", where=where, remedy=remedy)
    return observations.moving(names, where=where, settings=["first_field"])


SOURCE = Source(
    id="sensor.light_pulses",
    title="Two light pulses",
    description="One pulse at the end of the first field and one at the start of the second expose both fields at nearly the same time. "
    "Steady light still blurs and separates the fields.",
    note="Note 4",
    parameters=LightPulses,
    consumes=(Kind.LIGHT,),
    after=("sensor.exposure", "sensor.interlace"),
    before=("sensor.trigger_jitter",),
    neutral=LightPulses(ambient_share=1.0),
    typical=LightPulses(ambient_share=0.05),
    bound=LightPulses(separation_s=1.6e-3, ambient_share=0.2),
    forward=forward,
    measure=measure,
    truth=truth,
    applies_to=("analogue", "ccd", "cid"),
    option="pulsed light",
    gum_class="O",
    equation="field 1: (1 − a) L(t_e − δt/2) + a ∫L;  field 2: (1 − a) L(t_e + δt/2) + a ∫L;  fields lie v δt apart",
    typical_size="0.05 px between the fields at 50 px/s and 1 ms, 0.35 px at 350 px/s",
    references=("M. Raffel et al., Particle Image Velocimetry, Springer 2018 (two pulses astride the transfer)",),
    advice="Place the pulses as close together as the field transfer allows. Block steady light by a filter for the colour of the pulses.",
    reasons={
        "correct": "a target that is displaced between the pulses and one of another shape give the same frame: the correction needs the "
        "speed of every target. Locate targets in each field separately instead",
        "propagate": "needs the target's speed, which the probe does not contain",
    },
)
