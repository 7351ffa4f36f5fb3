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


@jit
def decimate(fine, mask, step, rows, cols):
    """Return the sums of ``fine`` under the mask at every ``step``-th cell, shape (n, rows, cols)."""
    n = fine.shape[0]
    out = np.empty((n, rows, cols), np.float64)
    height, width = mask.shape
    for i in range(n):
        for r in range(rows):
            for c in range(cols):
                total = 0.0
                for a in range(height):
                    for b in range(width):
                        total += mask[a, b] * fine[i, r * step + a, c * step + b]
                out[i, r, c] = total
    return out
