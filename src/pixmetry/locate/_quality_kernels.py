"""Kernels of the quality: how far targets differ from their neighbours."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.arrays import Array, Ints
from pixmetry.core.jit import jit

A_CELL = 3.0  # places in a cell, on average


@jit
def cells_of(x: Array, y: Array) -> tuple[float, int, int, Ints, Ints]:
    """Sort places into square cells: side, rows, columns, where each cell begins, and the places of all cells in turn."""
    n = len(x)
    left, top = x.min(), y.min()
    wide, high = x.max() - left, y.max() - top
    side = max(math.sqrt(A_CELL * wide * high / n), A_CELL * max(wide, high) / n, 1e-9)
    rows, cols = int(high / side) + 1, int(wide / side) + 1
    of, begin = np.empty(n, np.int64), np.zeros(rows * cols + 1, np.int64)
    for i in range(n):
        of[i] = int((y[i] - top) / side) * cols + int((x[i] - left) / side)
        begin[of[i] + 1] += 1
    for k in range(rows * cols):
        begin[k + 1] += begin[k]
    place, member = begin[:-1].copy(), np.empty(n, np.int64)
    for i in range(n):
        member[place[of[i]]] = i
        place[of[i]] += 1
    return side, rows, cols, begin, member


@jit
def from_neighbours(x: Array, y: Array, values: Array, count: int) -> Array:
    """Values, shape (kinds, n), less the medians of those of the ``count`` nearest other places."""
    kinds, n = values.shape
    side, rows, cols, begin, member = cells_of(x, y)
    apart = np.empty((kinds, n))
    near, square, own = np.empty(count, np.int64), np.empty(count), np.empty(count)
    left, top = x.min(), y.min()
    for i in range(n):
        row, col, found, ring = int((y[i] - top) / side), int((x[i] - left) / side), 0, 0
        while ring < max(rows, cols) and (found < count or square[count - 1] > ((ring - 1) * side) ** 2):
            for r in range(max(row - ring, 0), min(row + ring, rows - 1) + 1):
                whole = abs(r - row) == ring
                for c in range(col - ring, col + ring + 1, 1 if whole or ring == 0 else 2 * ring):
                    if c < 0 or c >= cols:
                        continue
                    for m in range(begin[r * cols + c], begin[r * cols + c + 1]):
                        j = member[m]
                        d = (x[j] - x[i]) ** 2 + (y[j] - y[i]) ** 2
                        if j == i or (found == count and d >= square[count - 1]):
                            continue
                        k = min(found, count - 1)
                        while k > 0 and square[k - 1] > d:
                            square[k], near[k] = square[k - 1], near[k - 1]
                            k -= 1
                        square[k], near[k] = d, j
                        found = min(found + 1, count)
            ring += 1
        for v in range(kinds):
            for k in range(found):
                value, m = values[v, near[k]], k
                while m > 0 and own[m - 1] > value:
                    own[m] = own[m - 1]
                    m -= 1
                own[m] = value
            middle = found // 2
            apart[v, i] = values[v, i] - (own[middle] if found % 2 else 0.5 * (own[middle - 1] + own[middle]))
    return apart
