"""Kernels of the camera: windows of a whole frame."""

from __future__ import annotations

import numpy as np

from pixmetry.core.jit import jit


@jit
def cut_windows(frame, row0, col0, rows, cols):
    """Return the windows of ``rows`` × ``cols`` pixels whose first pixels are given, shape (n, rows, cols)."""
    out = np.empty((len(row0), rows, cols), frame.dtype)
    for i in range(len(row0)):
        for r in range(rows):
            for c in range(cols):
                out[i, r, c] = frame[row0[i] + r, col0[i] + c]
    return out
