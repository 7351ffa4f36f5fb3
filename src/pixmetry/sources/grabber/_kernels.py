"""Kernels of the grabber: droop between two clamp pulses and its inverse, and conversion of the analogue line to codes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.arrays import Array, Singles
from pixmetry.core.jit import jit


@jit
def droop(data: Singles, loss: float, half: float, carry: float, stride: int) -> Singles:
    """Return y with y(t) = x(t) − s(t), s' = (x − s)/τ, in the middle of every pixel; float32 (n, rows, cols).

    ``loss`` is 1 − e^(−T/τ) for a pixel of duration T, ``half`` 1 − e^(−T/2τ). At the first pixel of a row, s is the share ``carry`` of
    what it was at the end of the row ``stride`` above; 0 in the first ones.
    """
    out = np.empty_like(data)
    end = np.zeros(stride)
    for i in range(data.shape[0]):
        end[:] = 0.0
        for r in range(data.shape[1]):
            s = carry * end[r % stride]
            for c in range(data.shape[2]):
                above = np.float64(data[i, r, c]) - s
                out[i, r, c] = above * (1.0 - half)
                s += loss * above
            end[r % stride] = s
    return out


@jit
def undroop(data: Singles, loss: float, half: float, carry: float, stride: int) -> Singles:
    """Return x of `droop` from y, from left to right and row by row."""
    out = np.empty_like(data)
    end = np.zeros(stride)
    for i in range(data.shape[0]):
        end[:] = 0.0
        for r in range(data.shape[1]):
            s = carry * end[r % stride]
            for c in range(data.shape[2]):
                above = np.float64(data[i, r, c]) / (1.0 - half)
                out[i, r, c] = above + s
                s += loss * above
            end[r % stride] = s
    return out


@jit
def quantise_ideal(data: Singles, factor: float, offset: float, top: float) -> NDArray[np.uint16]:
    """Return min(max(floor(factor·y + offset + 1/2), 0), top) as uint16."""
    flat = data.reshape(-1)
    out = np.empty(flat.size, np.uint16)
    for i in range(flat.size):
        v = np.floor(np.float64(flat[i]) * factor + offset + 0.5)
        out[i] = np.uint16(min(max(v, 0.0), top))
    return out.reshape(data.shape)


@jit
def quantise_at(data: Singles, factor: float, offset: float, thresholds: Array) -> NDArray[np.uint16]:
    """Return how many of the rising thresholds T_1 … T_top the value reaches, as uint16; it starts at the ideal code."""
    top = thresholds.size
    flat = data.reshape(-1)
    out = np.empty(flat.size, np.uint16)
    for i in range(flat.size):
        v = np.float64(flat[i]) * factor + offset
        k = int(min(max(np.floor(v + 0.5), 0.0), np.float64(top)))
        while k > 0 and thresholds[k - 1] > v:
            k -= 1
        while k < top and thresholds[k] <= v:
            k += 1
        out[i] = np.uint16(k)
    return out.reshape(data.shape)
