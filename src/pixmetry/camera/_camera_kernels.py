"""Kernels of the camera: windows of a whole frame."""

from __future__ import annotations

import numpy as np

from pixmetry.core.arrays import Array, Ints
from pixmetry.core.jit import jit


@jit
def cut_windows(frame: np.ndarray, row0: Ints, col0: Ints, rows: int, cols: int) -> np.ndarray:
    """Return the windows of ``rows`` × ``cols`` pixels whose first pixels are given, shape (n, rows, cols)."""
    out = np.empty((len(row0), rows, cols), frame.dtype)
    for i in range(len(row0)):
        for r in range(rows):
            line = frame[row0[i] + r, col0[i] : col0[i] + cols]
            for c in range(cols):
                out[i, r, c] = line[c]
    return out


@jit
def decimate(fine: Array, mask: Array, step: int, rows: int, cols: int) -> Array:
    """Return the sums of ``fine`` under the mask at every ``step``-th cell, shape (n, rows, cols).

    Every row of ``fine`` is split into its ``step`` phases, in which the cells that neighbouring sums take lie side by side.
    """
    n, height, width = fine.shape[0], mask.shape[0], mask.shape[1]
    out = np.zeros((n, rows, cols), np.float64)
    taps = -(-width // step)
    padded = np.zeros((height, taps * step), np.float64)
    padded[:, :width] = mask
    phases = np.zeros((step, cols + taps), np.float64)
    for i in range(n):
        for line in range((rows - 1) * step + height):
            for phase in range(step):
                for c in range(min(cols + taps, (fine.shape[2] - phase + step - 1) // step)):
                    phases[phase, c] = fine[i, line, c * step + phase]
            for r in range(max(0, -((height - 1 - line) // step)), min(rows, line // step + 1)):
                for tap in range(taps):
                    _add_taps(out[i, r], phases, tap, padded[line - r * step, tap * step : (tap + 1) * step])
    return out


@jit
def _add_taps(out: Array, phases: Array, first: int, weights: Array) -> None:
    """Add to every sum one cell of each phase, the ``first`` of them to sum 0."""
    end = first + len(out)
    if len(weights) == 4:  # side by side, so that the sums are loaded and stored once for all four
        w0, w1, w2, w3 = weights[0], weights[1], weights[2], weights[3]
        p0, p1, p2, p3 = phases[0, first:end], phases[1, first:end], phases[2, first:end], phases[3, first:end]
        for c in range(len(out)):
            out[c] = out[c] + w0 * p0[c] + w1 * p1[c] + w2 * p2[c] + w3 * p3[c]
        return
    for phase in range(len(weights)):
        weight, cells = weights[phase], phases[phase, first:end]
        for c in range(len(out)):
            out[c] += weight * cells[c]
