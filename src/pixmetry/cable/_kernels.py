"""Kernels of the cable: taking echoes out of rows of pixels."""

from __future__ import annotations

import numpy as np

from pixmetry.core.jit import jit


@jit
def remove_echoes(data, delays, amplitudes):
    """Return the held pixels x with y(c) = Σ a_k x(⌊c + ½ − d_k⌋), black before the first: from the left, pixel by pixel.

    ``data`` is float32 (n, rows, cols), sampled in the middle of every pixel; delays in pixel periods, rising from 0.
    """
    n, rows, cols = data.shape
    out = np.empty_like(data)
    back = np.empty(len(delays), np.int64)
    own = 0.0
    for k in range(len(delays)):
        back[k] = -int(np.floor(0.5 - delays[k]))
        if back[k] == 0:
            own += amplitudes[k]
    for i in range(n):
        for r in range(rows):
            for c in range(cols):
                late = 0.0
                for k in range(len(delays)):
                    if 0 < back[k] <= c:
                        late += amplitudes[k] * np.float64(out[i, r, c - back[k]])
                out[i, r, c] = (np.float64(data[i, r, c]) - late) / own
    return out
