"""Scalar loops over frames with edges: places of steep steps, chains of them, and sums over the pixels about one edge."""

from __future__ import annotations

import numpy as np

from pixmetry.core.arrays import Array, Ints, Singles
from pixmetry.core.jit import jit

GAP_ROWS = 3  # over which a chain goes on without a step
LINK_PX = 1.6  # farthest from the step in the row before: an edge at 45 degrees moves by 1


@jit
def find_steps(frame: Singles, first: int, end: int, threshold: float, row: Ints, col: Array, size: Array) -> int:
    """Find the steepest places along the rows; the twin in plain NumPy is in the tests.

    The slope at a pixel is (I(x+1) + I(x+2) − I(x−1) − I(x−2))/2, the mean of three rows: the height of a step that is sharp. A place is
    where its size is above a threshold and above that of the two pixels to each side; parts of a pixel from a parabola.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), float32, DN
    first, end : int
        Rows that are searched; the first and the last row of the frame are not.
    threshold : float
        DN.
    row, col, size : ndarray, shape (most,)
        Set to row and column (px) of each place and the slope there (DN, with its sign).

    Returns
    -------
    int
        Number of places; at most the length of the arrays.
    """
    rows, cols = frame.shape
    slope = np.zeros(cols)
    total = np.zeros(cols)
    found = 0
    for r in range(max(first, 1), min(end, rows - 1)):
        for c in range(cols):
            total[c] = frame[r - 1, c] + frame[r, c] + frame[r + 1, c]
        for c in range(2, cols - 2):
            slope[c] = (total[c + 1] + total[c + 2] - total[c - 1] - total[c - 2]) / 6.0
        for c in range(4, cols - 4):
            here = abs(slope[c])
            if here < threshold:
                continue
            sign = 1.0 if slope[c] > 0 else -1.0
            before, after = sign * slope[c - 1], sign * slope[c + 1]
            if here < before or here <= after or here < sign * slope[c - 2] or here <= sign * slope[c + 2]:
                continue
            if found == row.size:
                return found
            bend = before - 2 * here + after
            row[found] = r
            col[found] = c + (0.5 * (before - after) / bend if bend < 0 else 0.0)
            size[found] = slope[c]
            found += 1
    return found


@jit
def link_steps(row: Ints, col: Array, size: Array, chain: Ints) -> int:
    """Number the chains of steps of one sign that follow each other from row to row.

    Parameters
    ----------
    row, col, size : ndarray, shape (steps,)
        By rising row.
    chain : ndarray, shape (steps,), int64
        Set to the number of each step's chain.

    Returns
    -------
    int
        Number of chains.
    """
    chains = 0
    followed = np.zeros(row.size, np.bool_)
    start = 0
    for i in range(row.size):
        while row[start] < row[i] - GAP_ROWS:
            start += 1
        best, nearest = -1, LINK_PX
        for j in range(i - 1, start - 1, -1):
            rows = row[i] - row[j]
            if rows == 0 or followed[j] or size[i] * size[j] < 0:
                continue
            if best >= 0 and row[best] > row[j]:
                break
            away = abs(col[i] - col[j])
            if away < nearest + (rows - 1):
                best, nearest = j, away - (rows - 1)
        if best < 0:
            chain[i] = chains
            chains += 1
        else:
            chain[i] = chain[best]
            followed[best] = True
    return chains


@jit
def bin_edge(frame: Singles, first: int, centre: Array, half: float, cosine: float, step: float, sums: Array) -> None:
    """Add the pixels about an edge to bins of their distance from it, along its normal.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), float32, DN
    first : int
        First row.
    centre : ndarray, shape (n,)
        Where the edge is in each row, px.
    half : float
        Farthest distance, px.
    cosine : float
        Of the angle between the edge and the columns.
    step : float
        Width of a bin, px; bin b is about ``(b − (bins − 1)/2) step``.
    sums : ndarray, shape (4, bins)
        Number of pixels, sums of their values, of their distances from the bin's middle, and of the squared values are added.
    """
    bins = sums.shape[1]
    middle = 0.5 * (bins - 1)
    for k in range(centre.size):
        low = max(int(np.ceil(centre[k] - half / cosine)), 0)
        high = min(int(np.floor(centre[k] + half / cosine)), frame.shape[1] - 1)
        for c in range(low, high + 1):
            place = (c - centre[k]) * cosine / step + middle
            b = int(np.floor(place + 0.5))
            if 0 <= b < bins:
                value = frame[first + k, c]
                sums[0, b] += 1
                sums[1, b] += value
                sums[2, b] += (place - b) * step
                sums[3, b] += value * value


@jit
def row_shifts(
    frame: Singles, first: int, centre: Array, half: float, cosine: float, step: float, curve: Array, slope: Array, shift: Array
) -> None:
    """How far each row's edge lies from where it was taken, by least squares against the mean curve, to first order.

    Parameters
    ----------
    frame, first, centre, half, cosine, step
        As in `bin_edge`.
    curve, slope : ndarray, shape (bins,)
        The mean edge at the middles of the bins (DN), and its derivative (DN/px).
    shift : ndarray, shape (n,)
        Set to the shifts along the row, px.
    """
    bins = curve.size
    middle = 0.5 * (bins - 1)
    for k in range(centre.size):
        low = max(int(np.ceil(centre[k] - half / cosine)), 0)
        high = min(int(np.floor(centre[k] + half / cosine)), frame.shape[1] - 1)
        product, square = 0.0, 0.0
        for c in range(low, high + 1):
            place = (c - centre[k]) * cosine / step + middle
            b = int(np.floor(place))
            if 0 <= b < bins - 1:
                part = place - b
                value = curve[b] * (1 - part) + curve[b + 1] * part
                steep = slope[b] * (1 - part) + slope[b + 1] * part
                product += steep * (frame[first + k, c] - value)
                square += steep * steep
        shift[k] = -product / square / cosine if square > 0 else 0.0
