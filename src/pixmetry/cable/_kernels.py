"""Kernels of the cable: rows of the video line and their echoes."""

from __future__ import annotations

import numpy as np

from pixmetry.core.jit import jit


@jit
def add_ghosts(data, rho, delay_px, count):
    """Return (1 − ρ) Σ ρ^k y(x − kτ) along the rows; y is linear between pixels, and the first pixel goes on to the left."""
    n, rows, cols = data.shape
    out = np.empty_like(data)
    weight = np.empty(count + 1, np.float64)
    whole = np.empty(count + 1, np.int64)
    part = np.empty(count + 1, np.float64)
    for k in range(count + 1):
        shift = k * delay_px
        whole[k] = int(np.floor(shift))
        part[k] = shift - whole[k]
        weight[k] = (1.0 - rho) * rho**k
    for i in range(n):
        for r in range(rows):
            for c in range(cols):
                total = 0.0
                for k in range(count + 1):
                    a = max(c - whole[k], 0)
                    b = max(a - 1, 0)
                    total += weight[k] * ((1.0 - part[k]) * data[i, r, a] + part[k] * data[i, r, b])
                rest = rho ** (count + 1)
                out[i, r, c] = total + rest * data[i, r, 0]
    return out


@jit
def remove_ghosts(data, rho, delay_px):
    """Return x with x(c) = (y(c) − ρ y(c − τ)) / (1 − ρ), which undoes the whole echo series."""
    n, rows, cols = data.shape
    out = np.empty_like(data)
    whole = int(np.floor(delay_px))
    part = delay_px - whole
    for i in range(n):
        for r in range(rows):
            for c in range(cols):
                a = max(c - whole, 0)
                b = max(a - 1, 0)
                late = (1.0 - part) * data[i, r, a] + part * data[i, r, b]
                out[i, r, c] = (data[i, r, c] - rho * late) / (1.0 - rho)
    return out
