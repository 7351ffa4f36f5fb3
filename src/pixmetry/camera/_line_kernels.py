"""Kernels of the video line: a held staircase through filters and echoes, read at any time; and numbers that are alike from row to row."""

from __future__ import annotations

import numpy as np

from pixmetry.core.arrays import Array, Flags, Ints, Singles
from pixmetry.core.jit import jit


@jit
def read_line(
    data: Singles,
    first: Ints,
    black: float,
    step: Array,
    table: Array,
    delays: Array,
    amplitudes: Array,
    at: Array,
    late: Array,
    length: int,
    out: Singles,
) -> None:
    """Read every row of a staircase at some times, into ``out``.

    Parameters
    ----------
    data : float32, (n, rows, cols)
        Levels that are held for one pixel period each; pixel ``first[i]`` is the first one of window ``i``.
    first : int64, (n,)
    black : float64
        Level before the first and after the last pixel.
    step : float64, (k, k + 1)
        The filter's state at the end of a pixel's hold, from that at its beginning and the pixel's level.
    table : float64, (m + 1, k + 1, 4)
        Weights of the state and of the level in what comes out a part of a period later: Taylor coefficients about m + 1 parts.
    delays, amplitudes : float64, (e,)
        Echoes, the signal itself among them, in pixel periods.
    at, late : float64, (n, samples) and (n, rows)
        Every row is read at ``at - late``, in pixel periods from the beginning of pixel 0's hold.
    length : int
        Periods from the first pixel for which a state is needed.
    out : float32, (n, rows, samples)
    """
    n, rows, cols = data.shape
    k, samples, nodes, paths = len(step), at.shape[1], table.shape[0] - 1, len(delays)
    # At the beginning of every period: the filter's state, and in the last column the level of the period. Row 0: before the first pixel.
    state = np.zeros((length + 2, k + 1))
    place = np.empty((paths, samples), np.int64)  # which period a sample sees through each path, and with which weights
    weight = np.empty((samples, paths, k + 1))
    even = np.empty(paths, np.bool_)  # whether these periods follow each other
    for i in range(n):
        for r in range(rows):
            if r == 0 or late[i, r] != late[i, r - 1]:
                for e in range(paths):
                    even[e] = True
                    for j in range(samples):
                        t = at[i, j] - late[i, r] - delays[e]
                        whole = np.floor(t)
                        place[e, j] = max(int(whole) - first[i], -1) + 1
                        even[e] = even[e] and (j == 0 or place[e, j] == place[e, j - 1] + 1)
                        if k == 0:  # every path has the weight of its amplitude
                            continue
                        part = t - whole
                        node = int(part * nodes + 0.5)
                        d = part - node / nodes
                        for q in range(k + 1):
                            c0, c1, c2, c3 = table[node, q, 0], table[node, q, 1], table[node, q, 2], table[node, q, 3]
                            weight[j, e, q] = amplitudes[e] * (((c3 * d + c2) * d + c1) * d + c0)
            for c in range(cols):
                state[c + 1, k] = np.float64(data[i, r, c]) - black
            if k == 0:
                sum_echoes(state[:, 0], place, even, amplitudes, black, out[i, r])
                continue
            for c in range(1, length + 1):
                for p in range(k):
                    total = 0.0
                    for q in range(k + 1):
                        total += step[p, q] * state[c, q]
                    state[c + 1, p] = total
            for j in range(samples):
                value = 0.0
                for e in range(paths):
                    c = place[e, j]
                    for q in range(k + 1):
                        value += weight[j, e, q] * state[c, q]
                out[i, r, j] = black + value


@jit
def sum_echoes(level: Array, place: Ints, even: Flags, amplitudes: Array, black: float, out: Singles) -> None:
    """Write the sum of levels through all paths, for a line without filters."""
    sums = np.zeros(len(out))
    for e in range(len(place)):
        a, p = amplitudes[e], place[e, 0]
        if even[e]:
            for j in range(len(out)):
                sums[j] += a * level[p + j]
        else:
            for j in range(len(out)):
                sums[j] += a * level[place[e, j]]
    for j in range(len(out)):
        out[j] = black + sums[j]


@jit
def moving_sum(white: Array, weights: Array, stride: int, out: Array) -> None:
    """Σ_k weights[k] white[i, r + stride (m − 1 − k)] for every row r, always in the same order of adding; float64 in, (n, rows) out."""
    m = len(weights)
    for i in range(out.shape[0]):
        for r in range(out.shape[1]):
            total = 0.0
            for k in range(m):
                total += weights[k] * white[i, r + stride * (m - 1 - k)]
            out[i, r] = total
