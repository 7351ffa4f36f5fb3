"""Interlacing: odd and even rows are exposed one field period apart.

Row ``r`` of the woven frame is line ``r // 2`` of field ``r % 2``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class Interlace(Parameters):
    """Two fields that make a frame.

    Each field is exposed over the camera's exposure time: 40 ms in frame integration (so that the fields overlap by 20 ms), at most 20 ms
    in field integration, or less with an electronic shutter.
    """

    field_period_s: float = quantity(0.02, "s", "delay of the second field", ge=0, le=1)
    first_field: Literal["even", "odd"] = quantity("even", "1", "the rows that are exposed first")
    integration: Literal["frame", "field"] = quantity(
        "frame", "1", "frame: a line has the charge of its own row; field: of two rows, in different pairs in each field"
    )


def delay_s(params: Interlace, signal: Signal) -> np.ndarray:
    """How much later than the first field each row is exposed, shape (n, rows)."""
    second = signal.rows % 2 == (1 if params.first_field == "even" else 0)
    delay: Array = params.field_period_s * second
    return delay


def forward(params: Interlace, signal: Signal, stream: Stream) -> Signal:
    """Let the rows of the second field look later; in field integration, row r gathers what falls on rows r and r + 1.

    In both fields a line is the sum of its own row and the next (2k and 2k + 1, 2k + 1 and 2k + 2): the same aperture everywhere, whose
    middle lies half a row lower.
    """
    light = signal.own_light
    if params.integration == "field":
        light = light.moved(_half_a_row_down).spread(np.zeros(2), np.array([-0.5, 0.5]), np.array([0.5, 0.5]))
        light = replace(light, sensitivity=2 * light.sensitivity)
    if params.field_period_s and light.moving:
        light = light.delayed(delay_s(params, signal))
    return signal if light is signal.own_light else signal.with_light(light)


def _half_a_row_down(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return x, y + 0.5


def truth(params: Interlace, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Delay of every row, shape (n, rows), and the field that it belongs to: 0 is exposed first."""
    delay = delay_s(params, signal)
    parity = signal.rows % 2
    return {"delay_s": delay, "field": parity if params.first_field == "even" else 1 - parity}


def measure(observations: Observations) -> Estimates:
    """Delay of one field against the other, from moving targets; which rows come first is among the settings."""
    return observations.moving({"field_period_s": "field_period_s"}, where="sensor.interlace", settings=["first_field"])


SOURCE = Source(
    id="sensor.interlace",
    title="Interlacing",
    description="Odd and even rows are exposed one field period apart. A moving target splits into two combs.",
    number=10,
    stars=3,
    note="Note 4",
    parameters=Interlace,
    consumes=(Kind.LIGHT,),
    after=("sensor.exposure",),
    before=("sensor.light_pulses", "sensor.trigger_jitter"),
    neutral=Interlace(field_period_s=0.0),
    typical=Interlace(),
    bound=Interlace(integration="field"),
    forward=forward,
    measure=measure,
    truth=truth,
    applies_to=("analogue", "ccd", "cid"),
    gum_class="O",
    equation="row r looks at t + t_field (r mod 2);  v t_field = x_second − x_first;  mid-time t + t_exp/2 + t_field/2",
    typical_size="fields 1 px apart at 50 px/s; a disc of 7 px splits at 350 px/s; the centre in the frame is right to 0.003 px",
    references=(
        "ITU-R BT.470 (625 lines, 50 fields)",
        "C. Poynton, Digital Video and HD, 2nd ed., Morgan Kaufmann 2012 (interlaced scanning)",
    ),
    advice="Use a progressive camera. Or locate targets in each field separately, at the time of that field. Or use one flash for both "
    "fields.",
    reasons={
        "correct": "a target that is displaced between the fields and one of another shape give the same frame: the correction needs the "
        "speed of every target. Locate targets in each field separately instead; `pixmetry corrected` takes speeds",
        "propagate": "needs the target's speed, which the probe does not contain; the time of the frame is wrong by up to half a field",
    },
)
