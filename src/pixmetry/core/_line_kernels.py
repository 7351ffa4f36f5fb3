"""Kernels of the video line: a held staircase through filters and echoes, read at any time."""

from __future__ import annotations

import numpy as np

from pixmetry.core.jit import jit


@jit
def read_line(data, first, black, poles, steps, direct, delays, amplitudes, times, out):
    """Read every row of a staircase at some times, in place of ``out``.

    Parameters
    ----------
    data : float32, (n, rows, cols)
        Levels that are held for one pixel period each; pixel ``first[i]`` is the first one of window ``i``.
    black : float64
        Level before the first and after the last pixel.
    poles, steps : complex128, (k,)
        The filter's response to a unit step is direct + Σ steps (exp(poles t) − 1), times in pixel periods.
    delays, amplitudes : float64, (e,)
        Echoes, the signal itself among them, in pixel periods.
    times : float64, (n, rows, m)
        When to read, in pixel periods; 0 is the beginning of pixel 0's hold.
    out : float32, (n, rows, m)
    """
    n, rows, cols = data.shape
    k, count = len(poles), times.shape[2]
    whole = np.exp(poles)
    state = np.zeros((cols + 1, k), np.complex128)  # of every pole at the beginning of every pixel's hold
    for i in range(n):
        for r in range(rows):
            for p in range(k):
                z = 0.0 + 0.0j
                for c in range(cols):
                    state[c, p] = z
                    z = whole[p] * z + steps[p] * (whole[p] - 1.0) * (data[i, r, c] - black)
                state[cols, p] = z
            last = np.nan
            decay = np.empty(k, np.complex128)
            for j in range(count):
                total = 0.0
                for e in range(len(delays)):
                    t = times[i, r, j] - delays[e] - first[i]
                    if t < 0.0:
                        continue
                    at = int(np.floor(t))
                    if at > cols:
                        at = cols
                    part = t - at
                    if part != last:
                        for p in range(k):
                            decay[p] = np.exp(poles[p] * part)
                        last = part
                    level = data[i, r, at] - black if at < cols else 0.0
                    value = direct * level
                    for p in range(k):
                        value += (decay[p] * state[at, p] + steps[p] * (decay[p] - 1.0) * level).real
                    total += amplitudes[e] * value
                out[i, r, j] = black + total
