"""Products of the noise of two frames with itself at small lags, and the squares of their difference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.arrays import Ints
from pixmetry.core.jit import jit

REACH = 4  # px to each side
LEFT, RIGHT = 2, 3  # zeros beside a line of the columns of one parity


@jit(fastmath={"reassoc", "contract", "nsz"})  # sums of a line in any order, so that they are taken eight at a time
def sum_lag_products(first: np.ndarray, second: np.ndarray, margin: int, sums: NDArray[np.float64]) -> float:
    """Products of the difference of two frames with itself at lags up to ± `REACH` pixels, by the place in the pattern of two by two.

    Parameters
    ----------
    first, second : ndarray, shape (rows, cols), uint8 or uint16, DN
    margin : int
        Pixels on each side that are left out.
    sums : ndarray, shape (2, 2, 5, 9), float64, DN²
        Set: ``sums[r, c, j, 4 + i]`` to Σ z(y, x) z(y + j, x + i) over the pixels inside of the margin whose row and column have the
        parities r and c and whose partner lies there too; z is the difference without the means of its rows and columns.

    Returns
    -------
    float
        Mean of the first frame inside of the margin, DN.

    Notes
    -----
    Columns of even and of odd number lie in two arrays, so that every sum runs over neighbours in memory.
    """
    rows, cols = first.shape[0] - 2 * margin, first.shape[1] - 2 * margin
    of_row, of_col = np.zeros(rows, np.int64), np.zeros(cols, np.int64)
    light = np.int64(0)
    for r in range(rows):
        one, two = first[margin + r, margin : margin + cols], second[margin + r, margin : margin + cols]
        total = np.int64(0)
        for c in range(cols):
            d = np.int64(two[c]) - np.int64(one[c])
            light += np.int64(one[c])
            total += d
            of_col[c] += d
        of_row[r] = total
    grand = of_row.sum() / (rows * cols)
    half, full = (cols + 1) // 2, cols // 2
    lines = np.zeros((rows + REACH, 2, LEFT + half + RIGHT), np.float32)
    even, odd = np.zeros(half, np.float32), np.zeros(half, np.float32)
    for k in range(half):
        even[k] = of_col[2 * k] / rows
    for k in range(full):
        odd[k] = of_col[2 * k + 1] / rows
    for r in range(rows):
        row_mean = np.float32(of_row[r] / cols - grand)
        one, two = first[margin + r, margin : margin + cols], second[margin + r, margin : margin + cols]
        line = lines[r, 0, LEFT:]
        for k in range(half):
            line[k] = np.float32(np.int32(two[2 * k]) - np.int32(one[2 * k])) - row_mean - even[k]
        line = lines[r, 1, LEFT:]
        for k in range(full):
            line[k] = np.float32(np.int32(two[2 * k + 1]) - np.int32(one[2 * k + 1])) - row_mean - odd[k]
    sums[:] = 0.0
    for r in range(rows):
        for p in range(2):
            own = lines[r, p, LEFT : LEFT + half]
            for j in range(REACH + 1):
                # column 2k + p + i is number k + (i − (p + i) % 2 + p) / 2 of its parity
                same, other = lines[r + j, p], lines[r + j, 1 - p]
                s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = np.float32(0)
                for k in range(half):
                    z = own[k]
                    s0 += z * same[k]
                    s2 += z * same[k + 1]
                    s4 += z * same[k + 2]
                    s6 += z * same[k + 3]
                    s8 += z * same[k + 4]
                    s1 += z * other[k + p]
                    s3 += z * other[k + p + 1]
                    s5 += z * other[k + p + 2]
                    s7 += z * other[k + p + 3]
                at = sums[r % 2, p, j]
                at[0] += s0
                at[1] += s1
                at[2] += s2
                at[3] += s3
                at[4] += s4
                at[5] += s5
                at[6] += s6
                at[7] += s7
                at[8] += s8
    return light / (rows * cols)


@jit
def sum_differences(first: np.ndarray, second: np.ndarray, row_sums: Ints, col_sums: Ints) -> int:
    """Sums of the difference of two frames: of its squares, and over its rows and columns; exact.

    Parameters
    ----------
    first, second : ndarray, shape (rows, cols), uint8 or uint16, DN
    row_sums, col_sums : ndarray, shape (rows,) and (cols,), int64, DN
        Set.

    Returns
    -------
    int
    """
    rows, cols = first.shape
    squares = np.int64(0)
    for c in range(cols):
        col_sums[c] = 0
    for r in range(rows):
        total = np.int64(0)
        for c in range(cols):
            d = np.int64(second[r, c]) - np.int64(first[r, c])
            total += d
            squares += d * d
            col_sums[c] += d
        row_sums[r] = total
    return int(squares)
