"""Kernels of the processing: filters over codes. Inputs have a border; outputs are rounded once, halves up, and held in range."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.arrays import Array, Ints
from pixmetry.core.jit import jit


@jit(forceinline=True)
def _code(value: float, top: float) -> np.uint16:
    return np.uint16(min(max(np.floor(value + 0.5), 0.0), top))


@jit
def filter_by_place(codes: NDArray[np.uint16], row0: Ints, col0: Ints, weights: Array, top: float) -> NDArray[np.uint16]:
    """Correlate with the weights that belong to each pixel's place in a pattern of two by two.

    codes : uint16 (n, rows + 2 m, cols + 2 m); row0, col0 : int64 (n,), of the first pixel without border; weights : float64
    (2, 2, 2 m + 1, 2 m + 1).
    """
    size = weights.shape[2]
    n, rows, cols = codes.shape[0], codes.shape[1] - size + 1, codes.shape[2] - size + 1
    out = np.empty((n, rows, cols), np.uint16)
    sums = np.empty(cols + 1, np.float64)
    for i in range(n):
        for r in range(rows):
            here, there = weights[(row0[i] + r) % 2, col0[i] % 2], weights[(row0[i] + r) % 2, (col0[i] + 1) % 2]
            sums[:] = 0.0
            for a in range(size):
                for b in range(size):
                    w0, w1 = here[a, b], there[a, b]
                    if w0 == 0.0 and w1 == 0.0:
                        continue
                    line = codes[i, r + a, b : b + cols]
                    for pair in range(cols // 2):
                        sums[2 * pair] += w0 * np.float64(line[2 * pair])
                        sums[2 * pair + 1] += w1 * np.float64(line[2 * pair + 1])
                    if cols % 2:
                        sums[cols - 1] += w0 * np.float64(line[cols - 1])
            for c in range(cols):
                out[i, r, c] = _code(sums[c], top)
    return out


@jit
def blur(codes: NDArray[np.uint16], weights: Array) -> Array:
    """Symmetric separable filter, float64 (n, rows, cols); codes : uint16 with a border of m; weights : float64 (m + 1,)."""
    m = weights.size - 1
    n, rows, cols = codes.shape[0], codes.shape[1] - 2 * m, codes.shape[2] - 2 * m
    out = np.empty((n, rows, cols), np.float64)
    line = np.empty((rows + 2 * m, cols), np.float64)
    for i in range(n):
        for r in range(rows + 2 * m):
            for c in range(cols):
                total = weights[0] * np.float64(codes[i, r, c + m])
                for k in range(1, m + 1):
                    total += weights[k] * (np.float64(codes[i, r, c + m - k]) + np.float64(codes[i, r, c + m + k]))
                line[r, c] = total
        for r in range(rows):
            for c in range(cols):
                total = weights[0] * line[r + m, c]
                for k in range(1, m + 1):
                    total += weights[k] * (line[r + m - k, c] + line[r + m + k, c])
                out[i, r, c] = total
    return out


@jit(forceinline=True)
def _sort(values: np.ndarray, count: int) -> None:
    for a in range(1, count):
        v = values[a]
        b = a - 1
        while b >= 0 and values[b] > v:
            values[b + 1] = values[b]
            b -= 1
        values[b + 1] = v


@jit(forceinline=True)
def _order(values: NDArray[np.uint16], a: int, b: int) -> None:
    low, high = min(values[a], values[b]), max(values[a], values[b])
    values[a], values[b] = low, high


@jit(forceinline=True)
def _middle_of_nine(v: NDArray[np.uint16]) -> np.uint16:
    """Median of nine values by 19 exchanges (J. L. Smith, XCell 23, 1996); it ends up in place 4."""
    _order(v, 1, 2)
    _order(v, 4, 5)
    _order(v, 7, 8)
    _order(v, 0, 1)
    _order(v, 3, 4)
    _order(v, 6, 7)
    _order(v, 1, 2)
    _order(v, 4, 5)
    _order(v, 7, 8)
    _order(v, 0, 3)
    _order(v, 5, 8)
    _order(v, 4, 7)
    _order(v, 3, 6)
    _order(v, 1, 4)
    _order(v, 2, 5)
    _order(v, 4, 7)
    _order(v, 4, 2)
    _order(v, 6, 4)
    _order(v, 4, 2)
    return np.uint16(v[4])


@jit
def median(codes: NDArray[np.uint16], m: int) -> NDArray[np.uint16]:
    """Median of the square of 2 m + 1 pixels about each pixel; codes : uint16 with a border of m."""
    n, rows, cols = codes.shape[0], codes.shape[1] - 2 * m, codes.shape[2] - 2 * m
    out = np.empty((n, rows, cols), np.uint16)
    size = 2 * m + 1
    values = np.empty(size * size, np.uint16)
    for i in range(n):
        for r in range(rows):
            for c in range(cols):
                for a in range(size):
                    for b in range(size):
                        values[a * size + b] = codes[i, r + a, c + b]
                if size == 3:
                    out[i, r, c] = _middle_of_nine(values)
                else:
                    _sort(values, size * size)
                    out[i, r, c] = values[(size * size) // 2]
    return out


@jit
def bilateral(codes: NDArray[np.uint16], space: Array, likeness: Array, top: float) -> NDArray[np.uint16]:
    """Mean of the square about each pixel, weighted by distance and by likeness.

    codes : uint16 with a border of m; space : float64 (2 m + 1, 2 m + 1); likeness : float64, weight of each difference of codes; a
    difference beyond the table weighs nothing.
    """
    size = space.shape[0]
    m = size // 2
    n, rows, cols = codes.shape[0], codes.shape[1] - 2 * m, codes.shape[2] - 2 * m
    out = np.empty((n, rows, cols), np.uint16)
    for i in range(n):
        for r in range(rows):
            for c in range(cols):
                middle = np.int64(codes[i, r + m, c + m])
                total = 0.0
                weight = 0.0
                for a in range(size):
                    for b in range(size):
                        value = np.int64(codes[i, r + a, c + b])
                        apart = abs(value - middle)
                        if apart < likeness.size:
                            w = space[a, b] * likeness[apart]
                            total += w * np.float64(value)
                            weight += w
                out[i, r, c] = _code(total / weight, top)
    return out


@jit
def replace_outliers(codes: NDArray[np.uint16], step: int, threshold: float) -> NDArray[np.uint16]:
    """Replace a pixel that exceeds all its eight neighbours (``step`` pixels away) by more than the threshold, or falls below them all.

    It becomes their median, the mean of the middle two, halves up. codes : uint16 with a border of ``step``.
    """
    n, rows, cols = codes.shape[0], codes.shape[1] - 2 * step, codes.shape[2] - 2 * step
    out = np.empty((n, rows, cols), np.uint16)
    around = np.empty(8, np.int64)
    for i in range(n):
        for r in range(rows):
            for c in range(cols):
                middle = np.int64(codes[i, r + step, c + step])
                k = 0
                low, high = np.int64(65535), np.int64(0)
                for a in range(3):
                    for b in range(3):
                        if a != 1 or b != 1:
                            v = np.int64(codes[i, r + a * step, c + b * step])
                            around[k] = v
                            k += 1
                            low, high = min(low, v), max(high, v)
                if middle > high + threshold or middle < low - threshold:
                    _sort(around, 8)
                    middle = (around[3] + around[4] + 1) // 2
                out[i, r, c] = np.uint16(middle)
    return out
