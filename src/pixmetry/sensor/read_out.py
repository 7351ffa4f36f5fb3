"""Read-out of a progressive sensor: whole frames, two fields of one exposure woven again, or single fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from pixmetry.core.random import Grid, Stream
from pixmetry.core.signal import Kind, Signal, Windows
from pixmetry.core.source import Parameters, Source, quantity


class ReadOut(Parameters):
    """How the rows of one exposure leave the sensor."""

    mode: Literal["progressive", "woven", "field"] = quantity(
        "progressive", "1", "whole frames; both fields of one exposure, woven again by the grabber; one field a frame"
    )
    swapped: bool = quantity(False, "1", "woven: the grabber takes one field for the other, so the rows of every pair change places")
    lines: Literal["alternate", "summed"] = quantity("alternate", "1", "field: every other row; or the sum of a row and the next")
    field: Literal["even", "odd", "alternating"] = quantity("alternating", "1", "field: which one; alternating begins with the even one")


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
    grid, n_rows = signal.grid, signal.frame_shape[0]
    first = grid.row0 // 2
    count = max(1, min((grid.shape[0] - int(n_rows > 1 and _open_below(grid, n_rows))) // 2, n_rows // 2))
    row = 2 * (first[:, None] + np.arange(count)) + fields(params, grid.frame)[:, None]
    data = _rows(signal, row)
    if params.lines == "summed":  # the last pair of the odd field may lack its second row
        data = data + _rows(signal, row + 1)
    out = Grid(grid.frame, first, grid.col0, (count, grid.shape[1]))
    return replace(signal, data=data, grid=out, frame_shape=reshape(params, signal.frame_shape))
