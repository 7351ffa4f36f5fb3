"""Read-out of a progressive sensor: whole frames, two fields of one exposure woven again, or single fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream


class ReadOut(Parameters):
    """How the rows of one exposure leave the sensor."""

    mode: Literal["progressive", "woven", "field"] = quantity(
        "progressive", "1", "progressive: whole frames; woven: both fields of one exposure, interleaved by the grabber; field: one field"
    )
    swapped: bool = quantity(False, "1", "woven: the grabber exchanges the two fields, so that the rows of every pair are swapped")
    lines: Literal["alternate", "summed"] = quantity("alternate", "1", "field: every other row, or the sum of a row and the next")
    field: Literal["even", "odd", "alternating"] = quantity("alternating", "1", "field: which one; alternating starts with even")


def fields(params: ReadOut, frame: np.ndarray) -> np.ndarray:
    """The field of every frame, 0 even and 1 odd, shape (n,)."""
    if params.field == "alternating":
        return frame % 2
    return np.full_like(frame, int(params.field == "odd"))


def forward(params: ReadOut, signal: Signal, stream: Stream) -> Signal:
    """Take the rows in the order and number of the mode."""
    if params.mode == "field":
        return _field(params, signal)
    if params.mode == "woven" and params.swapped:
        rows = signal.rows
        other = rows ^ 1
        other = np.where(other < signal.frame_shape[0], other, rows)  # the last row of an odd number has no partner
        return signal.with_data(np.take_along_axis(signal.data, (other - rows[:, :1])[:, :, None], axis=1))
    return signal


def _field(params: ReadOut, signal: Signal) -> Signal:
    grid = signal.grid
    first = (grid.row0 + 1) // 2
    count = max(1, (grid.shape[0] - int((grid.row0 % 2).max())) // 2)
    row = 2 * (first[:, None] + np.arange(count)) + fields(params, grid.frame)[:, None]
    data = _rows(signal, row)
    if params.lines == "summed":
        data = data + _rows(signal, row + 1)
    out = Grid(grid.frame, first, grid.col0, (count, grid.shape[1]))
    return replace(signal, data=data, grid=out, frame_shape=reshape(params, signal.frame_shape))


def _rows(signal: Signal, row: np.ndarray) -> np.ndarray:
    """Some rows of every window, by absolute number; below the last row of the frame there is no charge."""
    inside = row < signal.frame_shape[0]
    at = np.where(inside, row - signal.grid.row0[:, None], 0)
    return np.take_along_axis(signal.data, at[:, :, None], axis=1) * inside[:, :, None].astype(np.float32)


def context(params: ReadOut, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """Pairs of rows; for a field, twice the rows and one more, whichever field it is."""
    if params.mode == "woven" and params.swapped:
        return windows.aligned(2, 1, frame_shape)
    if params.mode != "field":
        return windows
    row0 = np.minimum(2 * windows.row0, frame_shape[0] - 1)
    return Windows(row0, windows.col0, np.minimum(2 * windows.rows + 1, frame_shape[0] - row0), windows.cols)


def reshape(params: ReadOut, frame_shape: tuple[int, int]) -> tuple[int, int]:
    """A field has half the rows."""
    return (max(1, frame_shape[0] // 2), frame_shape[1]) if params.mode == "field" else frame_shape


def place(params: ReadOut, x: np.ndarray, y: np.ndarray, frame_shape: tuple[int, int], frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Where a place of the frame lies in the field that this frame number holds."""
    if params.mode != "field":
        return x, y
    return x, 0.5 * (y - fields(params, np.asarray(frame)) - (0.5 if params.lines == "summed" else 0.0))


def truth(params: ReadOut, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """The first row of the sensor that each row of the output holds, shape (n, rows)."""
    n_rows = reshape(params, signal.frame_shape)[0]
    row = np.broadcast_to(np.arange(n_rows), (len(signal.grid.frame), n_rows))
    if params.mode == "field":
        return {"sensor_row": 2 * row + fields(params, signal.grid.frame)[:, None]}
    if params.mode == "woven" and params.swapped:
        return {"sensor_row": np.where(row ^ 1 < n_rows, row ^ 1, row)}
    return {"sensor_row": row}


def measure(observations: Observations) -> Estimates:
    """Order of the rows, by targets in even and in odd rows at rest: a choice among modes, without a number."""
    found = observations.moving({"rows_swapped_px": "rows_swapped_px"}, where="sensor.read_out", settings=["mode", "swapped", "field"])
    return replace(Estimates.empty(), method=found.method, settings=found.settings)


SOURCE = Source(
    id="sensor.read_out",
    title="Read-out modes of a progressive sensor",
    description="If the grabber interleaves two fields in the wrong order, the rows of every pair are swapped. A single field has half the "
    "rows, so small targets have a larger periodic error.",
    note="Section 3.2",
    parameters=ReadOut,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.shot_noise", "sensor.full_well", "sensor.blooming"),
    before=("electronics",),
    neutral=ReadOut(),
    typical=ReadOut(mode="woven", swapped=True),
    bound=ReadOut(mode="field"),
    forward=forward,
    measure=measure,
    truth=truth,
    context=context,
    reshape=reshape,
    place=place,
    gum_class="F",
    equation="woven, swapped: row r ← row r XOR 1;  field f: row k ← row 2k + f, or the sum of rows 2k + f and 2k + f + 1",
    typical_size="spot of σ 0.8 px: 0.13 px periodic in fields of alternate lines, 0.027 px of summed lines, below 0.0001 px in the frame",
    references=(
        "ITU-R BT.470 (625 lines, 50 fields)",
        "B. F. Alexander, K. C. Ng, Opt. Eng. 30(9), 1320, 1991 (periodic error of centroids)",
    ),
    advice="Use whole frames. If there are only fields, sum the lines, and check the order of the fields on a slanted edge.",
    reasons={
        "correct": "rows of the other field are not in the frame: any values there give the same one. Rows that are swapped are swapped "
        "back by the same source",
        "propagate": "needs the target on the raster of the field; the probe has it on the raster of the frame",
    },
)
