"""Scalar loops over one frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.arrays import Ints
from pixmetry.core.jit import jit


@jit
def accumulate_frame(
    frame: np.ndarray, total: NDArray[np.uint32], total_sq: NDArray[np.uint64], row_sums: Ints, col_sums: Ints, counts: Ints
) -> None:
    """Add one frame to the running sums of its group, reading it once.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8 or uint16, DN
    total : ndarray, shape (rows, cols), uint32, DN
    total_sq : ndarray, shape (rows, cols), uint64, DN²
    row_sums, col_sums : ndarray, shape (rows,) and (cols,), int64, DN
        Set to the sums of this frame.
    counts : ndarray, shape (4, codes), int64
        Occurrences of each code. Four tables take turns because neighbouring pixels mostly hold the same few codes, and an
        increment has to wait for the previous one of the same table entry.
    """
    rows, cols = frame.shape
    fours = cols - cols % 4
    for c in range(cols):
        col_sums[c] = 0
    for r in range(rows):
        row_sum = 0
        for c in range(cols):
            value = int(frame[r, c])
            row_sum += value
            col_sums[c] += value
            total[r, c] += value
            total_sq[r, c] += value * value
        row_sums[r] = row_sum
        for c in range(0, fours, 4):
            counts[0, frame[r, c]] += 1
            counts[1, frame[r, c + 1]] += 1
            counts[2, frame[r, c + 2]] += 1
            counts[3, frame[r, c + 3]] += 1
        for c in range(fours, cols):
            counts[0, frame[r, c]] += 1


@jit
def count_codes(frame: np.ndarray, counts: Ints) -> None:
    """Count the codes of a frame; arguments as for :func:`accumulate_frame`."""
    rows, cols = frame.shape
    for r in range(rows):
        for c in range(cols):
            counts[c % 4, frame[r, c]] += 1


@jit
def sum_maps(
    total: NDArray[np.uint32], total_sq: NDArray[np.uint64], n_frames: int, row_totals: Ints, col_totals: Ints
) -> tuple[float, float]:
    """Sum the maps of a group over the pixels.

    Parameters
    ----------
    total, total_sq : ndarray, shape (rows, cols), uint32 and uint64
        Σ y and Σ y² over the frames.
    n_frames : int
    row_totals, col_totals : ndarray, shape (rows,) and (cols,), int64
        Set to the sums of ``total`` along the rows and columns.

    Returns
    -------
    deviations : float
        Σ over pixels of F Σy² − (Σy)², each term an exact integer.
    products : float
        Σ over pixels of (Σy)² − Σy², that is of the products of different frames.
    """
    rows, cols = total.shape
    f = np.uint64(n_frames)
    deviations = products = 0.0
    for c in range(cols):
        col_totals[c] = 0
    for r in range(rows):
        row_total = 0
        row_deviations = row_products = 0.0
        for c in range(cols):
            value = np.uint64(total[r, c])
            square = value * value
            row_total += int(total[r, c])
            col_totals[c] += int(total[r, c])
            row_deviations += float(f * total_sq[r, c] - square)
            row_products += float(square - total_sq[r, c])
        row_totals[r] = row_total
        deviations += row_deviations
        products += row_products
    return deviations, products


@jit
def sum_pair(first: np.ndarray, second: np.ndarray, row_sums: Ints, col_sums: Ints) -> tuple[int, int, tuple[int, int], tuple[int, int]]:
    """Sum the powers of the difference d = y1 − y0 of two frames, and y0 y1, exactly.

    Parameters
    ----------
    first, second : ndarray, shape (rows, cols), uint8 or uint16, DN
    row_sums, col_sums : ndarray, shape (2, rows) and (2, cols), int64, DN
        Set to the sums of the frames.

    Returns
    -------
    products, squares : int
        Σ y0 y1 and Σ d².
    cubes, fourths : tuple of int
        Σ d³ and Σ d⁴ as (high, low), to be read as 2³² · high + low.
    """
    rows, cols = first.shape
    low_half = np.int64(0xFFFFFFFF)
    products = squares = cubes_high = cubes_low = fourths_high = fourths_low = np.int64(0)
    for c in range(cols):
        col_sums[0, c] = col_sums[1, c] = 0
    for r in range(rows):
        row_0 = row_1 = np.int64(0)
        for c in range(cols):
            y0, y1 = np.int64(first[r, c]), np.int64(second[r, c])
            row_0 += y0
            row_1 += y1
            col_sums[0, c] += y0
            col_sums[1, c] += y1
            products += y0 * y1
        row_sums[0, r], row_sums[1, r] = row_0, row_1
        for c in range(cols):
            d = np.int64(second[r, c]) - np.int64(first[r, c])
            square = d * d
            squares += square
            cube = d * square  # within ± 2**48
            cubes_high += cube >> np.int64(32)
            cubes_low += cube & low_half
            fourth = np.uint64(square) * np.uint64(square)  # below 2**64
            fourths_high += np.int64(fourth >> np.uint64(32))
            fourths_low += np.int64(fourth & np.uint64(0xFFFFFFFF))
    return int(products), int(squares), (int(cubes_high), int(cubes_low)), (int(fourths_high), int(fourths_low))


@jit
def sum_squares(values: np.ndarray) -> tuple[int, int]:
    """Sum the squares of integers from 0 to 2³² − 1 exactly: (high, low), to be read as 2³² · high + low."""
    high = low = np.int64(0)
    for value in values:
        square = np.uint64(value) * np.uint64(value)
        high += np.int64(square >> np.uint64(32))
        low += np.int64(square & np.uint64(0xFFFFFFFF))
    return int(high), int(low)
