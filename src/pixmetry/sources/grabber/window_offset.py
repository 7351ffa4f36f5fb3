"""Set-up of the grabber's window: which rows and columns are stored, and the lines in it that hold no image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import model_validator

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import ParameterError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream


class WindowOffset(Parameters):
    """The part of the frame that is stored; what lies outside the image is black."""

    row_offset: int = quantity(0, "px", "row of the image that is stored first", ge=-4096, le=65536)
    col_offset: int = quantity(0, "px", "column of the image that is stored first", ge=-4096, le=65536)
    row_increment: int = quantity(1, "px", "step in which the grabber sets its first row; the offset must be a multiple of it", ge=1, le=64)
    col_increment: int = quantity(1, "px", "the same for the first column", ge=1, le=64)
    rows: int = quantity(0, "px", "rows stored; 0: as many as the image has", ge=0, le=65536)
    cols: int = quantity(0, "px", "columns stored; 0: as many as the image has", ge=0, le=65536)
    inactive_rows: int = quantity(0, "px", "stored rows at the top that contain no image", ge=0, le=4096)

    @model_validator(mode="after")
    def _can_be_set(self) -> WindowOffset:
        for name, offset, step in (
            ("row_offset", self.row_offset, self.row_increment),
            ("col_offset", self.col_offset, self.col_increment),
        ):
            if offset % step:
                below = offset // step * step
                raise ParameterError(
                    f"this grabber cannot start there: it sets its window in steps of {step}", where=name, value=offset,
                    allowed=f"{below} or {below + step}", remedy="take one of these, or state the step of your grabber",
                )  # fmt: skip
        return self


def reshape(params: WindowOffset, frame_shape: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns stored."""
    return params.rows or frame_shape[0], params.cols or frame_shape[1]


def place(params: WindowOffset, x: np.ndarray, y: np.ndarray, frame_shape: tuple[int, int], frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions of points of the image in the stored window."""
    row, col = params.row_offset, params.col_offset
    return x - col, y - row


def context(params: WindowOffset, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The same part of the image, as far as there is one; else the nearest pixel of it."""
    row, col = params.row_offset, params.col_offset
    r0, r1 = (np.clip(windows.row0 + row + d, 0, frame_shape[0] - 1) for d in (0, windows.rows - 1))
    c0, c1 = (np.clip(windows.col0 + col + d, 0, frame_shape[1] - 1) for d in (0, windows.cols - 1))
    return Windows(r0, c0, r1 - r0 + 1, c1 - c0 + 1)


def forward(params: WindowOffset, signal: Signal, stream: Stream) -> Signal:
    """Store the window: pixel (r, c) is pixel (r + r0, c + c0) of the image, black outside it and in the inactive rows.

    A window that touches the border of the image stands for all that is stored beyond it.
    """
    if params == WindowOffset():
        return signal
    stored = reshape(params, signal.frame_shape)
    row, col, grid, (n, rows, cols) = params.row_offset, params.col_offset, signal.grid, signal.data.shape
    row0, height = _span(grid.row0, rows, signal.frame_shape[0], row, stored[0])
    col0, width = _span(grid.col0, cols, signal.frame_shape[1], col, stored[1])
    r = (row0 + row - grid.row0)[:, None] + np.arange(height)
    c = (col0 + col - grid.col0)[:, None] + np.arange(width)
    active = (r >= 0) & (r < rows) & (row0[:, None] + np.arange(height) >= params.inactive_rows)
    inside = active[:, :, None] & ((c >= 0) & (c < cols))[:, None, :]
    at = np.clip(r, 0, rows - 1)[:, :, None], np.clip(c, 0, cols - 1)[:, None, :]
    data = np.where(inside, signal.data[np.arange(n)[:, None, None], at[0], at[1]], np.float32(0))
    return replace(signal, data=data, grid=Grid(grid.frame, row0, col0, (height, width)), frame_shape=stored)


def _span(first: np.ndarray, size: int, image: int, offset: int, stored: int) -> tuple[np.ndarray, int]:
    """First stored rows (or columns) of windows, and how many: the same number for all of them, as many as the largest needs."""
    begin = np.where(first == 0, 0, first - offset)
    end = np.where(first + size == image, stored, first + size - offset)
    begin = np.clip(begin, 0, stored - 1)
    end = np.clip(end, begin + 1, stored)
    return begin, int((end - begin).max(initial=1))


def measure(observations: Observations) -> Estimates:
    """Rows and columns in front of the active area, from a frame that shows its border."""
    found = observations.border(("row_offset", "col_offset"), where="grabber.window_offset")
    told = "one frame does not tell the step in which the grabber sets its window"
    steps = {name.replace("offset", "increment"): told for name in found.names}
    return found.join(Estimates.from_rows([(name, 1.0, 0.0, np.inf, "px") for name in steps], reasons=steps))


SOURCE = Source(
    id="grabber.window_offset",
    title="Offsets of the grabber's window",
    description="The stored image starts at another row and column than the sensor's image, in steps. Its first lines may contain no "
    "image.",
    number=26,
    stars=2,
    note="Note 12",
    parameters=WindowOffset,
    consumes=(Kind.DN,),
    after=("sensor", "electronics", "cable"),
    before=("grabber.adc", "processing"),
    neutral=WindowOffset(),
    typical=WindowOffset(row_offset=4, row_increment=4, col_offset=3, inactive_rows=2),
    bound=WindowOffset(row_offset=-8, row_increment=4, col_offset=-5, inactive_rows=4),
    forward=forward,
    measure=measure,
    reshape=reshape,
    place=place,
    context=context,
    applies_to=("analogue",),
    gum_class="G",
    equation="(r, c)_stored = (r, c)_image − (r_0, c_0),  r_0 a multiple of the grabber's step",
    typical_size="a few pixels of the principal point; 1 px is 8.3 µm down and 8.6 µm across a sensor of that pitch",
    references=("ITU-R BT.470-6 (lines and active part of a 625-line signal)",),
    advice="Calibrate the principal point with the grabber that measures, and do not change its window. Do not assume the middle of the "
    "stored image.",
    reasons={
        "correct": "it changes the numbers of rows and columns and no value. The camera's geometry gives the true position: coordinates "
        "are shifted instead",
        "propagate": "an offset of whole pixels moves all targets alike: it belongs to the principal point, not to the error of a target",
    },
)
