"""Parasitic light: the stores of a global shutter still see a little light while their rows wait for the read-out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from pixmetry.camera.light import GAUSS
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.random import Stream


class ParasiticLight(Parameters):
    """Sensitivity of the closed store, and how long each row waits."""

    sensitivity_rel: float = quantity(
        0.0, "1", "sensitivity of the storage node over that of the photodiode (reciprocal of the shutter efficiency)", ge=0, le=0.1
    )
    wait_s: float = quantity(50e-6, "s", "time from the end of the exposure to the read-out of the first row", ge=0, le=1)
    row_time_s: float = quantity(10e-6, "s", "time from the read-out of one row to the next", ge=0, le=0.01)
    first_row: Literal["top", "bottom"] = quantity("top", "1", "the row that is read first")


def stored_s(params: ParasiticLight, signal: Signal) -> np.ndarray:
    """How long each row waits in its store, shape (n, rows)."""
    rows = signal.rows.astype(float)
    order = rows if params.first_row == "top" else signal.frame_shape[0] - 1 - rows
    return params.wait_s + params.row_time_s * order


def gain(params: ParasiticLight, signal: Signal) -> np.ndarray:
    """Light gathered over that of the exposure alone, for a scene that stands still, shape (n, rows)."""
    brighter: Array = 1 + params.sensitivity_rel * stored_s(params, signal) / signal.exposure_s[:, None]
    return brighter


def forward(params: ParasiticLight, signal: Signal, stream: Stream) -> Signal:
    """Add three looks over the waiting time: a scene that stands still grows brighter from row to row, a moving one leaves a ghost."""
    if not params.sensitivity_rel:
        return signal
    nodes, shares = GAUSS[3]
    stored = stored_s(params, signal)[:, :, None]
    late = (signal.time_s + signal.exposure_s)[:, None, None] + stored * (0.5 + nodes)
    added = (gain(params, signal) - 1)[:, :, None] * shares
    times, weights = (np.broadcast_to(v, (*late.shape[:2], v.shape[2])) for v in signal.own_light.moments)
    return signal.with_light(signal.own_light.seen_at(np.concatenate([times, late], axis=2), np.concatenate([weights, added], axis=2)))


def correct(params: ParasiticLight, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Divide every row by its gain; exact for a scene that stands still."""
    return signal.with_data((signal.data / gain(params, signal)[:, :, None]).astype(np.float32))


def truth(params: ParasiticLight, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Gain of every row, and how long it waits, shape (n, rows) each."""
    return {"gain": gain(params, signal), "stored_s": stored_s(params, signal)}


SOURCE = Source(
    id="sensor.parasitic_light",
    title="Parasitic light sensitivity",
    description="The storage nodes of a global shutter collect stray light until they are read. This gives a gradient over the rows, "
    "and ghosts.",
    parameters=ParasiticLight,
    consumes=(Kind.LIGHT,),
    after=("sensor.exposure",),
    before=("sensor.trigger_jitter",),
    neutral=ParasiticLight(),
    typical=ParasiticLight(sensitivity_rel=1 / 2000, wait_s=1e-3),
    bound=ParasiticLight(sensitivity_rel=1 / 700, wait_s=1e-3, row_time_s=30e-6),
    forward=forward,
    correct=correct,
    truth=truth,
    applies_to=("cmos",),
    gum_class="F",
    equation="I(r) = E t_exp + PLS E (t_wait + r t_row)",
    typical_size="28 % from the first to the last row at 1/700, 20 ms of read-out and 0.1 ms of exposure: 0.0005 px on a disc of 7 px",
    references=("S. Lauxtermann et al., Int. Image Sensor Workshop 2007 (comparison of global shutter pixels)",),
    leaves="ghosts of targets that moved while rows waited",
    advice="Use a strobe as the only light, or expose longer.",
    reasons={
        "measure": "steady light at the shortest exposure shows only sensitivity × row time, as a slope along the rows that uneven light "
        "leaves too; spots at several exposures show it as a wrong exposure time",
        "propagate": "needs the share of light that falls in the waiting time; under steady light it is a gradient: shift g⟨y²⟩",
    },
)
