"""Blooming: excess charge of a full pixel of a CCD spills along its column.

A pixel that holds more than the full well gives its excess to the neighbours in the column, a part of it to the drain, until no pixel
holds too much. The end does not depend on the order of the spilling, and is found directly. Channel stops keep charge in its column.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.random import Stream
from pixmetry.sources.sensor._readout_kernels import spill

UNLIMITED_E = 1e9


class Blooming(Parameters):
    """Capacity of a pixel, and the paths of its excess charge."""

    full_well_e: float = quantity(20_000.0, "e-", "most electrons that a pixel holds", gt=1, le=UNLIMITED_E)
    up_share: float = quantity(0.5, "1", "share of the spilled charge that goes to the row above (with the smaller number)", ge=0, le=1)
    drained_share: float = quantity(0.0, "1", "share of every spill that a lateral drain takes", ge=0, le=1)
    drain_ratio: float = quantity(
        1.0, "1", "over-exposure up to which an overflow drain takes all the excess of a pixel; 1: no drain", ge=1, le=1e6
    )
    knee_rel: float = quantity(0.0, "1", "share of the capacity, below the top, in which a pixel already spills charge", ge=0, lt=1)
    ends: Literal["drain", "barrier"] = quantity("drain", "1", "charge at the end of the column is lost, or goes back")


def forward(params: Blooming, signal: Signal, stream: Stream) -> Signal:
    """Spill the excess along the columns until no pixel holds more than the full well; electrons go up or down each for itself."""
    if params.full_well_e == UNLIMITED_E:
        return signal
    draws = None if stream.quiet else (stream.key("ways"), signal.grid.frame, signal.grid.col0)
    return signal.with_data(_spilled(params, signal.data, draws))


def _spilled(params: Blooming, electrons: np.ndarray, draws: tuple[np.uint64, np.ndarray, np.ndarray] | None = None) -> np.ndarray:
    data = np.ascontiguousarray(electrons, np.float32)
    kept, barrier = 1.0 - params.drained_share, params.ends == "barrier"
    top = float(params.full_well_e)
    nowhere = np.zeros(len(data), np.int64)
    where = (np.uint64(0), nowhere, nowhere) if draws is None else draws
    ways = float(params.up_share), kept, barrier
    return spill(data, top, float(params.drain_ratio), float(params.knee_rel), *ways, draws is not None, *where)


def context(params: Blooming, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The whole column."""
    return windows.full_columns(frame_shape)


def propagate(params: Blooming, probe: Probe) -> Contribution:
    """Propagator P4: the estimator on the bloomed target; nothing while it stays below the knee."""
    gain = probe.gain_dn_per_e
    electrons = probe.signal_dn / gain
    if electrons.max() <= params.full_well_e * (1 - params.knee_rel):
        return probe.contribution((0.0, 0.0), "F", method="the target is below the full well")
    dx, dy = probe.moved(gain * _spilled(params, electrons).astype(np.float64))
    return probe.from_shifts(dx, dy, "F", model_error=0.5, method="the estimator on the target with the spilled charge within the window")


SOURCE = Source(
    id="sensor.blooming",
    title="Blooming",
    description="Charge beyond the full well spills along the column. If it spills more in one direction, the target's centre moves.",
    number=11,
    stars=2,
    parameters=Blooming,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.shot_noise",),
    before=("sensor.full_well", "sensor.charge_transfer"),
    neutral=Blooming(full_well_e=UNLIMITED_E),
    typical=Blooming(up_share=0.4),
    bound=Blooming(up_share=0.4, knee_rel=0.2),
    forward=forward,
    propagate=propagate,
    context=context,
    applies_to=("ccd",),
    gum_class="F",
    equation="q ← F,  (q − F)(1 − β) α to the row above, (q − F)(1 − β)(1 − α) to the row below, until q ≤ F everywhere",
    typical_size="α = 0.4: 0.19, 1.5 and 11.5 px on a disc of 5 px exposed 1.5, 3 and 10 times over the full well",
    references=(
        "J. R. Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, (full well and blooming)",
        "R. W. Cottle, J.-S. Pang, R. E. Stone, The Linear Complementarity Problem, Academic Press 1992 (uniqueness for M-matrices)",
    ),
    advice="Lower the exposure until the target peaks at 80 % of the full well; drop targets with streaks.",
    reasons={
        "measure": "needs a bright spot at exposures up to many times the full well: the lengths of its streaks upwards and downwards",
        "correct": "the original positions of the charge are lost: flag the columns, or fit full pixels as 'at least the full well'",
    },
)
