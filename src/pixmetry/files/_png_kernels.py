"""Scalar loops of the PNG format."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.jit import jit


@jit
def undo_filters(lines: NDArray[np.uint8], step: int) -> bool:
    """Take the prediction of each row off, in place (PNG specification, third edition, §9.2).

    Parameters
    ----------
    lines : ndarray, shape (rows, 1 + bytes of a row), uint8
        Each row begins with the number of its filter.
    step : int
        Bytes per pixel.

    Returns
    -------
    known : bool
        False where a filter has a number that the format does not know.
    """
    rows, width = lines.shape
    for r in range(rows):
        kind = lines[r, 0]
        if kind == 0:
            continue
        if kind > 4:
            return False
        for i in range(1, width):
            left = int(lines[r, i - step]) if i > step else 0
            up = int(lines[r - 1, i]) if r > 0 else 0
            if kind == 1:
                guess = left
            elif kind == 2:
                guess = up
            elif kind == 3:
                guess = (left + up) >> 1
            else:
                corner = int(lines[r - 1, i - step]) if r > 0 and i > step else 0
                to_left, to_up, to_corner = abs(up - corner), abs(left - corner), abs(left + up - 2 * corner)
                if to_left <= to_up and to_left <= to_corner:
                    guess = left
                elif to_up <= to_corner:
                    guess = up
                else:
                    guess = corner
            lines[r, i] = np.uint8((int(lines[r, i]) + guess) & 255)
    return True


@jit
def join_bytes(lines: NDArray[np.uint8], out: NDArray[np.uint16]) -> None:
    """Make 16-bit values of rows of bytes, high byte first: ``lines`` as above, ``out`` of shape (rows, cols), uint16."""
    rows, cols = out.shape
    for r in range(rows):
        for c in range(cols):
            out[r, c] = (np.uint16(lines[r, 1 + 2 * c]) << np.uint16(8)) | np.uint16(lines[r, 2 + 2 * c])
