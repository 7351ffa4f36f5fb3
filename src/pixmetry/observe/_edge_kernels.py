"""Scalar loops over frames with edges: places of steep steps, chains of them, and sums over the pixels about one edge."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.arrays import Array, Ints, Singles
from pixmetry.core.jit import jit

GAP_ROWS = 3  # over which a chain goes on without a step
ROOT_HALF, ROOT_2PI = 0.7071067811865476, 0.3989422804014327  # 1/√2, 1/√(2π)
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


@jit
def edge_table(z0: float, step: float, sigma: float, wide: float, narrow: float, far: float, near: float, out: Array) -> None:
    """Edge spread of a Gaussian, two boxes and two pairs of images, with its derivatives, over distances along the normal.

    Parameters
    ----------
    z0, step : float
        First distance and step, px.
    sigma : float
        Standard deviation of the Gaussian, px.
    wide, narrow : float
        Widths of the boxes along the normal, px: the pixel's sides times cosine and sine of the edge's angle.
    far, near : float
        Distances of the images of each pair along the normal, px, likewise.
    out : ndarray, shape (7, n)
        Set to the spread (0 to 1) and its derivatives by distance, sigma², wide, narrow, far, near.

    Notes
    -----
    With F₂ the second integral of the normal distribution, F₂' = F₁ = zΦ + σφ, F₂ = ((z² + σ²)Φ + zσφ)/2 and ∂F₂/∂σ² = Φ/2, the boxes make
    differences: E(z) = Σ ±F₂(z ± wide/2 ± narrow/2)/(wide narrow), averaged over z ± far/2 ± near/2.
    """
    area = wide * narrow
    for i in range(out.shape[1]):
        z = z0 + i * step
        for k in range(7):
            out[k, i] = 0.0
        for image in range(4):
            along = 0.5 if image % 2 else -0.5
            across = 0.5 if image // 2 else -0.5
            at = z + along * far + across * near
            value, slope, bend, by_wide, by_narrow = 0.0, 0.0, 0.0, 0.0, 0.0
            for corner in range(4):
                first = 0.5 if corner % 2 else -0.5
                second = 0.5 if corner // 2 else -0.5
                sign = 1.0 if first * second > 0 else -1.0
                x = at + first * wide + second * narrow
                share = 0.5 * math.erfc(-x / sigma * ROOT_HALF)
                density = math.exp(-0.5 * (x / sigma) ** 2) * ROOT_2PI
                one = x * share + sigma * density
                value += sign * 0.5 * ((x * x + sigma * sigma) * share + x * sigma * density)
                slope += sign * one
                bend += sign * share
                by_wide += sign * first * one
                by_narrow += sign * second * one
            value, slope, bend = value / area, slope / area, 0.5 * bend / area
            out[0, i] += 0.25 * value
            out[1, i] += 0.25 * slope
            out[2, i] += 0.25 * bend
            out[3, i] += 0.25 * (by_wide / area - value / wide)
            out[4, i] += 0.25 * (by_narrow / area - value / narrow)
            out[5, i] += 0.25 * along * slope
            out[6, i] += 0.25 * across * slope


@jit
def edge_normal(
    values: Array,
    place: Array,
    centre: Array,
    cosine: float,
    half: float,
    levels: Array,
    variances: Array,
    order: int,
    table: Array,
    z0: float,
    step: float,
    matrix: Array,
    right: Array,
) -> float:
    """Normal equations of one edge: weighted least squares of its pixels.

    Parameters
    ----------
    values, place : ndarray, shape (rows, width)
        Pixels (DN) and their columns (px); NaN where there is none.
    centre : ndarray, shape (rows,)
        Column of the edge.
    cosine, half : float
        Of the angle to the columns; farthest distance along the normal, px.
    levels, variances : ndarray, shape (2,)
        Levels left and right of the edge (DN), and the variance of a pixel on each (DN²).
    order : int
        Of the polynomial of the edge's line over −1 … 1.
    table : ndarray, shape (1 + 1 + shared, n)
        Spread, its derivative by distance, and its derivatives by the shared parameters.
    z0, step : float
        Of the table, px.
    matrix, right : ndarray, shape (order + 3 + shared,) twice and once
        Set to the normal matrix and the right side: line, left level, right level, shared parameters.

    Returns
    -------
    float
        χ².
    """
    rows, width = values.shape
    own, shared = order + 3, table.shape[0] - 2
    n = own + shared
    matrix[:] = 0.0
    right[:] = 0.0
    gradient = np.zeros(n)
    height = levels[1] - levels[0]
    total = 0.0
    last = table.shape[1] - 1
    for r in range(rows):
        t = (2.0 * r - (rows - 1)) / (rows - 1)
        for c in range(width):
            z = (place[r, c] - centre[r]) * cosine
            if abs(z) > half or np.isnan(values[r, c]):
                continue
            at = (z - z0) / step
            k = min(max(int(np.floor(at)), 1), last - 2)
            u = at - k
            # cubic through four points
            w0, w1 = -u * (u - 1) * (u - 2) / 6, (u + 1) * (u - 1) * (u - 2) / 2
            w2, w3 = -(u + 1) * u * (u - 2) / 2, (u + 1) * u * (u - 1) / 6
            share = w0 * table[0, k - 1] + w1 * table[0, k] + w2 * table[0, k + 1] + w3 * table[0, k + 2]
            steep = w0 * table[1, k - 1] + w1 * table[1, k] + w2 * table[1, k + 1] + w3 * table[1, k + 2]
            weight = 1.0 / (variances[0] + (variances[1] - variances[0]) * min(max(share, 0.0), 1.0))
            residual = values[r, c] - levels[0] - height * share
            power = -height * steep * cosine
            for j in range(order + 1):
                gradient[j] = power
                power *= t
            gradient[order + 1] = 1 - share
            gradient[order + 2] = share
            for j in range(shared):
                gradient[own + j] = height * (
                    w0 * table[2 + j, k - 1] + w1 * table[2 + j, k] + w2 * table[2 + j, k + 1] + w3 * table[2 + j, k + 2]
                )
            total += weight * residual * residual
            for i in range(n):
                scaled = weight * gradient[i]
                right[i] += scaled * residual
                for j in range(i + 1):
                    matrix[i, j] += scaled * gradient[j]
    for i in range(n):
        for j in range(i):
            matrix[j, i] = matrix[i, j]
    return total


@jit
def line_taps(poles: Array, residues: Array, delays: Array, amplitudes: Array, taps: Array) -> None:
    """What each sample of a video line has of the pixels before it.

    Parameters
    ----------
    poles, residues : ndarray, shape (k,), complex
        Of the filters, in radians per pixel period: the response to a step is 1 − Σ residue e^(pole t). None: a ramp over one period.
    delays, amplitudes : ndarray, shape (e,)
        Of all paths, in pixel periods.
    taps : ndarray, shape (n,)
        Set to S(k + ½) − S(k − ½), with S the response to a step over all paths.
    """
    before = 0.0
    for k in range(-1, taps.size):
        total = 0.0
        for e in range(delays.size):
            t = k + 0.5 - delays[e]
            if poles.size == 0:
                total += amplitudes[e] * min(max(t + 0.5, 0.0), 1.0)
            elif t > 0:
                value = 1.0
                for i in range(poles.size):
                    # the real part; the other half of a conjugate pair has the same
                    angle = poles[i].imag * t
                    value -= math.exp(poles[i].real * t) * (residues[i].real * math.cos(angle) - residues[i].imag * math.sin(angle))
                total += amplitudes[e] * value
        if k >= 0:
            taps[k] = total - before
        before = total
