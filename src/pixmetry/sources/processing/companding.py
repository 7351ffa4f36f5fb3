"""Companding: codes go through a table to fewer bits for transport and back, and only so many different values remain."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.random import Stream
from pixmetry.sources.processing._codes import bits_of_camera, stored


class Companding(Parameters):
    """The curve of the table, and the width of the transport."""

    law: Literal["off", "truncated", "linear", "root"] = quantity(
        "off",
        "1",
        "truncated: lower bits cut off, as often in Mono8; linear: rounded; root: square root, with steps in proportion to the shot noise",
    )
    transport_bits: int = quantity(8, "bit", "bits during transport; at most those of the codes", ge=1, le=16)
    bits: int = bits_of_camera()


def table(params: Companding) -> np.ndarray:
    """What becomes of each code, uint16, shape (2^bits,)."""
    code = np.arange(2**params.bits)
    lost = params.bits - params.transport_bits
    if params.law == "off" or (lost <= 0 and params.law != "root"):
        return code.astype(np.uint16)
    if params.law == "truncated":
        return (code >> lost << lost).astype(np.uint16)
    top, way = 2**params.bits - 1, 2**params.transport_bits - 1
    power = 0.5 if params.law == "root" else 1.0
    sent = stored(way * (code / top) ** power, params.transport_bits)
    return stored(top * (sent / way) ** (1 / power), params.bits)


def forward(params: Companding, signal: Signal, stream: Stream) -> Signal:
    """Look every code up; one beyond the range counts as the highest."""
    if params.law == "off":
        return signal
    entries = table(params)
    return signal.with_data(np.take(entries, signal.data, mode="clip"))


def step_dn(params: Companding, level_dn: np.ndarray) -> np.ndarray:
    """Width of the step at a level: the inverse of the curve's slope, at least 1."""
    top, way = 2.0**params.bits - 1, 2.0**params.transport_bits - 1
    if params.law == "off":
        return np.ones_like(level_dn)
    if params.law == "root":
        step: Array = np.maximum(2 * np.sqrt(np.maximum(level_dn, 0) * top) / way, 1.0)
        return step
    if params.law == "truncated":
        return np.full_like(level_dn, 2.0 ** max(params.bits - params.transport_bits, 0))
    return np.full_like(level_dn, max(top / way, 1.0))


def propagate(params: Companding, probe: Probe) -> Contribution:
    """Propagator P1 with the variance (step² − 1)/12 that wider steps add to that of whole codes; a half step of offset moves nothing."""
    step = step_dn(params, np.asarray(probe.signal_dn, float))
    u = probe.white(np.sqrt((step**2 - 1) / 12))
    method = "linear response of the estimator to the rounding of the wider steps, as white noise"
    return probe.contribution(u, "F", model_error=0.35, floor_px=math.sqrt(1 / 12) * 1e-3, method=method)


SOURCE = Source(
    id="processing.companding",
    title="Companding and transport in fewer bits",
    description="Codes of 12 bits are sent as 8 bits and expanded again: many codes never occur, and values are rounded twice.",
    parameters=Companding,
    consumes=(Kind.CODES,),
    after=("sensor", "electronics", "cable", "grabber"),
    before=("storage",),
    neutral=Companding(),
    typical=Companding(law="root", bits=12),
    bound=Companding(law="truncated", bits=12),
    forward=forward,
    propagate=propagate,
    option="fewer bits during transport than in the converter",
    gum_class="F",
    equation="y = T⁻¹(round T(x)),  T = (2^b − 1)(x/x_max)^γ,  γ = 1 or 1/2",
    typical_size="below 0.001 px if the steps are smaller than the noise",
    references=("EMVA 1288 R4.0 Linear, §2.2 (quantisation, step²/12)", "GenICam PFNC 2.4 (Mono8, Mono12)"),
    advice="Use the raw 10 or 12 bits. Otherwise keep the steps smaller than the noise.",
    reasons={
        "measure": "not measured: needs the gaps of a code histogram over an even spread of levels",
        "correct": "values that rounding merged cannot be separated again",
    },
)
