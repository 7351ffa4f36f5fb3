"""What travels down the chain: a batch of equally sized windows of frames, with their kind and their place on the sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from pixmetry.camera.light import Light
from pixmetry.camera.line import Line
from pixmetry.core.errors import InputError
from pixmetry.core.random import Grid


class Kind(StrEnum):
    """Meaning of the numbers of a signal.

    ``PHOTONS`` mean photons per pixel and exposure; ``ELECTRONS`` charge (mean before, a sample after the shot noise); ``DN`` the
    analogue signal in units of the converter's step, black at 0; ``CODES`` stored whole numbers.

    Two kinds are functions that are not sampled yet: ``LIGHT``, a scene as pixels will look at it (`camera.light`), before ``PHOTONS``;
    and ``VIDEO``, the line signal in time (`camera.line`), between ``DN`` of the pixels and ``DN`` of the samples. The camera samples them
    at the first source that takes numbers.
    """

    LIGHT = "light"
    PHOTONS = "photons"
    ELECTRONS = "electrons"
    DN = "dn"
    VIDEO = "video"
    CODES = "codes"


@dataclass(frozen=True)
class Windows:
    """Windows on the pixel grid, one per entry of a batch: first row and column, and size; int64 arrays of shape (n,)."""

    row0: np.ndarray
    col0: np.ndarray
    rows: np.ndarray
    cols: np.ndarray

    @classmethod
    def of(cls, grid: Grid) -> Windows:
        """The windows of a grid."""
        n = len(grid.frame)
        return cls(grid.row0, grid.col0, np.full(n, grid.shape[0], np.int64), np.full(n, grid.shape[1], np.int64))

    @classmethod
    def one(cls, row0: int, col0: int, rows: int, cols: int) -> Windows:
        """A single window."""
        return cls(*(np.array([v], np.int64) for v in (row0, col0, rows, cols)))

    def expand(self, up: int, down: int, left: int, right: int, frame_shape: tuple[int, int]) -> Windows:
        """Widen by whole pixels, clipped to the frame."""
        row0, col0 = np.maximum(self.row0 - up, 0), np.maximum(self.col0 - left, 0)
        row1 = np.minimum(self.row0 + self.rows + down, frame_shape[0])
        col1 = np.minimum(self.col0 + self.cols + right, frame_shape[1])
        return Windows(row0, col0, row1 - row0, col1 - col0)

    def full_rows(self, frame_shape: tuple[int, int]) -> Windows:
        """The same rows over the whole width of the frame."""
        return Windows(self.row0, np.zeros_like(self.col0), self.rows, np.full_like(self.cols, frame_shape[1]))

    def full_columns(self, frame_shape: tuple[int, int]) -> Windows:
        """The same columns over the whole height of the frame."""
        return Windows(np.zeros_like(self.row0), self.col0, np.full_like(self.rows, frame_shape[0]), self.cols)

    def full_frame(self, frame_shape: tuple[int, int]) -> Windows:
        """The whole frame."""
        return self.full_rows(frame_shape).full_columns(frame_shape)

    def aligned(self, block_rows: int, block_cols: int, frame_shape: tuple[int, int]) -> Windows:
        """Widen to whole blocks of a raster that starts at pixel (0, 0), clipped to the frame."""
        row0, col0 = self.row0 // block_rows * block_rows, self.col0 // block_cols * block_cols
        row1 = np.minimum(-(-(self.row0 + self.rows) // block_rows) * block_rows, frame_shape[0])
        col1 = np.minimum(-(-(self.col0 + self.cols) // block_cols) * block_cols, frame_shape[1])
        return Windows(row0, col0, row1 - row0, col1 - col0)

    def equals(self, other: Windows) -> bool:
        """Whether every window is the same."""
        return all(np.array_equal(getattr(self, f), getattr(other, f)) for f in ("row0", "col0", "rows", "cols"))

    def take(self, index: np.ndarray) -> Windows:
        """The windows at some positions of the batch."""
        return Windows(self.row0[index], self.col0[index], self.rows[index], self.cols[index])


@dataclass(frozen=True)
class Clock:
    """How a camera reads out: pixel clock, and time from line to line of one field (CCIR by default)."""

    pixel_hz: float = 14.1875e6
    line_s: float = 64e-6


@dataclass(frozen=True)
class Signal:
    """A batch of windows at one point of the chain. It is never changed in place.

    Parameters
    ----------
    data : ndarray, shape (n, rows, cols)
        float32, or uint16 for codes.
    kind : Kind
    grid : Grid
        Frame number and first row and column of every window, in absolute pixels of the sensor.
    frame_shape : (int, int)
        Rows and columns of the whole frame.
    exposure_s, time_s, temperature_c : ndarray, shape (n,), float64
        Exposure time, time of the exposure's start in the sequence, and sensor temperature.
    clock : Clock
        The camera's read-out.
    light : Light
        Of the kind ``LIGHT`` (whose data hold nothing).
    line : Line
        Of the kind ``VIDEO`` (whose data are the pixels that the line holds one after the other); and with samples of a line that are to be
        corrected, what else the line did to them.

    Examples
    --------
    >>> from pixmetry.camera.camera import load_camera
    >>> from pixmetry.scene.uniform import Uniform
    >>> frame = load_camera("imx264_like").expose(Uniform(5000.0), window=(0, 0, 4, 6))
    >>> frame.kind, frame.data.shape, frame.data.dtype
    (<Kind.CODES: 'codes'>, (1, 4, 6), dtype('uint16'))
    """

    data: np.ndarray
    kind: Kind
    grid: Grid
    frame_shape: tuple[int, int]
    exposure_s: np.ndarray
    time_s: np.ndarray
    temperature_c: np.ndarray
    clock: Clock = Clock()
    light: Light | None = None
    line: Line | None = None

    def __len__(self) -> int:
        return len(self.data)

    @property
    def windows(self) -> Windows:
        """Where on the frame the windows lie."""
        return Windows.of(self.grid)

    @property
    def rows(self) -> np.ndarray:
        """Absolute row numbers, shape (n, rows)."""
        return self.grid.row0[:, None] + np.arange(self.data.shape[1])

    @property
    def cols(self) -> np.ndarray:
        """Absolute column numbers, shape (n, cols)."""
        return self.grid.col0[:, None] + np.arange(self.data.shape[2])

    @property
    def own_light(self) -> Light:
        """The light of a signal of that kind; every other signal has none, and to ask it for some is a mistake in a program."""
        if self.light is None:
            raise TypeError(f"a signal of the kind {self.kind} holds no light")
        return self.light

    @property
    def own_line(self) -> Line:
        """The line of a signal of the kind ``VIDEO``, as `own_light`."""
        if self.line is None:
            raise TypeError(f"a signal of the kind {self.kind} holds no line")
        return self.line

    def need_frame_before(self) -> None:
        """Refuse frames of which not each follows the one before it, for what a frame leaves in the next.

        Raises
        ------
        InputError
            If the signal holds no successive frames.
        """
        if len(self) < 2 or np.any(np.diff(self.grid.frame) != 1):
            raise InputError("needs the frame before", remedy="give frames that were taken without a pause, and say so (--sequence)")

    def with_data(self, data: np.ndarray, kind: Kind | None = None) -> Signal:
        """The same windows with new numbers (and, where the source converts, a new kind)."""
        return replace(self, data=data, kind=self.kind if kind is None else kind)

    def with_light(self, light: Light) -> Signal:
        """The same windows with the scene looked at in another way."""
        return replace(self, light=light)

    def with_line(self, line: Line) -> Signal:
        """The same pixels with another line signal made of them."""
        return replace(self, line=line)

    def take(self, index: np.ndarray) -> Signal:
        """The windows at some positions of the batch."""
        grid = Grid(self.grid.frame[index], self.grid.row0[index], self.grid.col0[index], self.grid.shape)
        return Signal(
            self.data[index],
            self.kind,
            grid,
            self.frame_shape,
            self.exposure_s[index],
            self.time_s[index],
            self.temperature_c[index],
            self.clock,
        )

    def crop(self, windows: Windows) -> Signal:
        """Cut every window down to a part of it; the parts must have one size and lie inside."""
        rows, cols = int(windows.rows[0]), int(windows.cols[0])
        dr, dc = windows.row0 - self.grid.row0, windows.col0 - self.grid.col0
        if (rows, cols) == self.data.shape[1:]:
            return self
        if (dr == dr[0]).all() and (dc == dc[0]).all():
            data = np.ascontiguousarray(self.data[:, dr[0] : dr[0] + rows, dc[0] : dc[0] + cols])
        else:
            data = self.data[
                np.arange(len(self))[:, None, None], dr[:, None, None] + np.arange(rows)[:, None], dc[:, None, None] + np.arange(cols)
            ]
        return replace(self, data=data, grid=Grid(self.grid.frame, windows.row0, windows.col0, (rows, cols)))
