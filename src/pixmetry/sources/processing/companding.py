"""Companding: codes go through a table to fewer bits for transport and back, and only so many different values remain."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from pixmetry.camera.code_table import TRUNCATED, CodeTable
from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.processing._codes import bits_of_camera

METHOD = "codes that never occur, against the tables of every law and number of bits"


class Companding(Parameters):
    """The curve of the table, and the width of the transport."""

    law: Literal["off", "truncated", "linear", "root"] = quantity(
        "off",
        "1",
        "truncated: lower bits cut off, as often in Mono8; linear: rounded; root: square root, with steps in proportion to the shot noise",
    )
    transport_bits: int = quantity(8, "bit", "bits during transport; at most those of the codes", ge=1, le=16)
    bits: int = bits_of_camera()


def code_table(params: Companding) -> CodeTable:
    """The table of these parameters."""
    return CodeTable(params.law, params.bits, params.transport_bits)


def forward(params: Companding, signal: Signal, stream: Stream) -> Signal:
    """Look every code up; one beyond the range counts as the highest."""
    if params.law == "off":
        return signal
    entries = code_table(params).entries()
    return signal.with_data(np.take(entries, signal.data, mode="clip"))


def measure(observations: Observations) -> Estimates:
    """Read the table off the codes that never occur.

    Codes whose lower bits are all zero are no proof of a table: values of a converter of fewer bits that were shifted left look the same.
    """
    where, counts, table = "processing.companding", observations.histogram, observations.code_table
    if counts is None:
        raise MeasureError("needs dark and bright frames", where=where, remedy="take flat fields at many levels")
    if table is None:
        found = np.flatnonzero(counts.counts)
        what = f"not found: {found.size} of the codes from {found[0]} to {found[-1]} occur, and no table of fewer bits leaves just these"
        raise MeasureError(what, where=where)
    if table.law == TRUNCATED:
        step = 2 ** (table.bits - table.transport_bits)
        converter = f"the codes of a converter of {table.transport_bits} bits shifted left"
        what = f"every code is a multiple of {step}: lower bits were cut off, or {converter}; frames do not tell which"
        raise MeasureError(what, where=where, remedy="see the camera's manual for the pixel format")
    why = f"law: {table.law}; all codes that occur are on this table"
    row = ("transport_bits", float(table.transport_bits), 0.0, math.inf, "bit")
    return Estimates.from_rows([row], method=METHOD, reasons={"transport_bits": why}, settings={"law": table.law})


def propagate(params: Companding, probe: Probe) -> Contribution:
    """Propagator P1 with the variance (step² − 1)/12 that wider steps add to that of whole codes; a half step of offset moves nothing."""
    step = code_table(params).step_dn(np.asarray(probe.signal_dn, float))
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
    measure=measure,
    propagate=propagate,
    option="fewer bits during transport than in the converter",
    gum_class="F",
    equation="y = T⁻¹(round T(x)),  T = (2^b − 1)(x/x_max)^γ,  γ = 1 or 1/2",
    typical_size="below 0.001 px if the steps are smaller than the noise",
    references=("EMVA 1288 R4.0 Linear, §2.2 (quantisation, step²/12)", "GenICam PFNC 2.4 (Mono8, Mono12)"),
    advice="Use the raw 10 or 12 bits. Otherwise keep the steps smaller than the noise.",
    reasons={
        "correct": "values that the table rounds to one entry give the same code: what was merged cannot be separated again. The scale "
        "of the codes is straight, so that nothing else is to be undone",
    },
)
