"""Kernels of faint targets: heights over the background in bins of two, four, eight … pixels, smoothed, and the peaks in them."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.arrays import Array, Flags, Ints, Singles
from pixmetry.core.jit import jit
from pixmetry.locate.detect._background_kernels import Map, least_and_most, map_at
from pixmetry.locate.detect._detect_kernels import RUN, Runs, at_columns, doubled
from pixmetry.locate.detect._region_kernels import FIELDS, add_faint, state

LONE = 1.5  # standard deviations by which a pixel may stand out of its neighbours
BLOCK = 64  # bins of a row that are looked at together
PEAK = 4  # numbers of a peak: x, y, score, side of the bin


@jit
def add_rows(
    upper: np.ndarray,
    lower: np.ndarray,
    level: Singles,
    level_step: Singles,
    reach: Singles,
    reach_step: Singles,
    f: np.float32,
    total: Singles,
    most: Singles,
) -> None:
    """Write the sum of two rows' heights over the level, each at most the reach, and the reach."""
    for c in range(len(upper)):
        middle, far = level[c] + f * level_step[c], reach[c] + f * reach_step[c]
        total[c] = min(max(np.float32(upper[c]) - middle, -far), far) + min(max(np.float32(lower[c]) - middle, -far), far)
        most[c] = far


@jit
def bin_heights(frame: np.ndarray, level: Map, reach: Map, first: int, stop: int, sigmas: float, out: Singles) -> None:
    """Fill rows first … stop of ``out``: sums over bins of 2 × 2 pixels of their heights, of variance 1 for white noise.

    ``reach`` is ``sigmas`` standard deviations of the noise: further than this no pixel counts, so that a defect is no target.
    """
    columns, tiles = frame.shape[1], level.nodes.shape[0]
    levels, level_steps = np.empty(columns, np.float32), np.empty(columns, np.float32)
    reaches, reach_steps = np.empty(columns, np.float32), np.empty(columns, np.float32)
    total, most = np.empty(columns, np.float32), np.empty(columns, np.float32)
    scale, last = np.float32(sigmas), -1
    for b in range(first, stop):
        v = (2 * b + 1.0) * level.row_scale - 0.5
        i = min(max(int(math.floor(v)), 0), max(tiles - 2, 0))
        if i != last:
            at_columns(level.nodes, i, level.col_scale, levels, level_steps)
            at_columns(reach.nodes, i, reach.col_scale, reaches, reach_steps)
            last = i
        f = np.float32(v - i if tiles > 1 else 0.0)
        add_rows(frame[2 * b], frame[2 * b + 1], levels, level_steps, reaches, reach_steps, f, total, most)
        row = out[b]
        for c in range(len(row)):
            row[c] = scale * (total[2 * c] + total[2 * c + 1]) / (most[2 * c] + most[2 * c + 1])


@jit
def blank_runs(bins: Singles, runs: Runs, margin: int) -> None:
    """Write 0 where runs of pixels are, and up to a margin around them."""
    rows, cols = bins.shape
    for k in range(len(runs)):
        a, b = max((runs[k, 0] - margin) // 2, 0), min((runs[k, 0] + margin) // 2 + 1, rows)
        c, d = max((runs[k, 1] - margin) // 2, 0), min((runs[k, 2] - 1 + margin) // 2 + 1, cols)
        for r in range(a, b):
            bins[r, c:d] = np.float32(0.0)


@jit
def fill_blanks(bins: Singles, value: np.float32) -> None:
    """Write a value where 0 is."""
    flat = bins.ravel()
    for i in range(len(flat)):
        flat[i] = value if flat[i] == np.float32(0.0) else flat[i]


@jit
def halved(bins: Singles) -> Singles:
    """Sums over 2 × 2 bins; white noise keeps its variance."""
    out = np.empty((bins.shape[0] // 2, bins.shape[1] // 2), np.float32)
    for r in range(len(out)):
        upper, lower, row = bins[2 * r], bins[2 * r + 1], out[r]
        for c in range(len(row)):
            row[c] = np.float32(0.5) * (upper[2 * c] + upper[2 * c + 1] + lower[2 * c] + lower[2 * c + 1])
    return out


@jit
def smooth_row(bins: Singles, r: int, column: Singles, out: Singles) -> None:
    """One row of bins, each with its neighbours, weights 1, 2, 1 along rows and columns; white noise of variance 1 keeps it."""
    above, here, below = bins[r - 1], bins[r], bins[r + 1]
    sixth, last = np.float32(1.0 / 6.0), len(here) - 1
    for c in range(len(here)):
        column[c] = above[c] + below[c] + np.float32(2.0) * here[c]
    for c in range(1, last):
        out[c] = sixth * (column[c - 1] + column[c + 1] + np.float32(2.0) * column[c])
    out[0], out[last] = out[1], out[last - 1]


@jit
def smooth_sample(bins: Singles, row_step: int, col_step: int) -> Singles:
    """A part of the smoothed bins."""
    rows, cols = bins.shape
    column, row = np.empty(cols, np.float32), np.empty(cols, np.float32)
    out, n = np.empty((rows // row_step + 1) * (cols // col_step + 1), np.float32), 0
    for r in range(2, rows - 2, row_step):
        smooth_row(bins, r, column, row)
        for c in range(2 + r % col_step, cols - 2, col_step):
            out[n] = row[c]
            n += 1
    return out[:n]


@jit
def find_peaks(bins: Singles, least: float, greatest: float, side: int, first: int, stop: int) -> Array:
    """Bins that, smoothed, are above ``greatest``, or below ``least``, and the extreme one of 3 × 3 bins; shape (n, PEAK).

    Not in the two outermost rows and columns: there the background's map is continued, not measured.
    """
    rows, cols = bins.shape
    out, n = np.empty((64, PEAK)), 0
    low, high = np.float32(least), np.float32(greatest)
    column, smooth = np.empty(cols, np.float32), np.empty((3, cols), np.float32)
    first, stop = max(first, 2), min(stop, rows - 2)
    if first < stop:
        smooth_row(bins, first - 1, column, smooth[(first - 1) % 3])
        smooth_row(bins, first, column, smooth[first % 3])
    for r in range(first, stop):
        smooth_row(bins, r + 1, column, smooth[(r + 1) % 3])
        row = smooth[r % 3]
        for begin in range(0, cols, BLOCK):
            end = min(begin + BLOCK, cols)
            lowest, highest = least_and_most(row[begin:end])
            if lowest >= low and highest <= high:
                continue
            for c in range(max(begin, 2), min(end, cols - 2)):
                s = row[c]
                if low <= s <= high:
                    continue
                extreme = True
                for i in range(3):
                    for j in range(c - 1, c + 2):
                        extreme = extreme and (smooth[i, j] <= s if s > high else smooth[i, j] >= s)
                if extreme:
                    if n == len(out):
                        out = doubled(out)
                    out[n, 0], out[n, 1], out[n, 2], out[n, 3] = side * (c + 0.5) - 0.5, side * (r + 0.5) - 0.5, s, side
                    n += 1
    return out[:n].copy()


@jit
def sharpen_peaks(frame: np.ndarray, level: Map, reach: Map, peaks: Array, sigmas: float, sizes: Array, steps: int) -> None:
    """Put each peak where a Gaussian weight of one of the sizes, at pixels up to ``steps`` away, has the highest score; write that.

    The heights are those of `bin_heights`, and none more than LONE above the second highest of its neighbours, which a defect would be.
    White noise has a score of variance 1.
    """
    rows, cols = frame.shape
    far = int(math.ceil(2.5 * sizes[-1]))
    wide = 2 * (steps + far) + 1
    raw, height = np.zeros((wide + 2, wide + 2)), np.empty((wide, wide))
    for k in range(len(peaks)):
        x, y, sign = int(peaks[k, 0] + 0.5), int(peaks[k, 1] + 0.5), 1.0 if peaks[k, 2] > 0.0 else -1.0
        most = sigmas / map_at(reach, float(x), float(y))[0]
        for i in range(wide + 2):
            for j in range(wide + 2):
                r, c = y + i - steps - far - 1, x + j - steps - far - 1
                inside = 0 <= r < rows and 0 <= c < cols
                h = sign * most * (frame[r, c] - map_at(level, float(c), float(r))[0]) if inside else 0.0
                raw[i, j] = min(max(h, -sigmas), sigmas)
        for i in range(wide):
            for j in range(wide):
                first, second = 0.0, 0.0
                for m in range(i, i + 3):
                    for n in range(j, j + 3):
                        h = raw[m, n] if m != i + 1 or n != j + 1 else 0.0
                        if h > first:
                            first, second = h, first
                        elif h > second:
                            second = h
                height[i, j] = min(raw[i + 1, j + 1], second + LONE)
        best = 0.0
        for size in sizes:
            row = np.array([math.exp(-0.5 * (i / size) ** 2) for i in range(-far, far + 1)])
            weight = np.outer(row, row)
            weight /= math.sqrt(np.sum(weight * weight))
            for i in range(2 * steps + 1):
                for j in range(2 * steps + 1):
                    score = np.sum(weight * height[i : i + 2 * far + 1, j : j + 2 * far + 1])
                    if score > best:
                        best = score
                        peaks[k, 0], peaks[k, 1] = float(x + j - steps), float(y + i - steps)
        peaks[k, 2] = sign * best


@jit
def strongest_peaks(peaks: Array, order: Ints) -> Flags:
    """Of peaks, taken in the given order, those that lie in no bins about one that was taken before."""
    keep = np.zeros(len(peaks), np.bool_)
    taken = np.empty(len(peaks), np.int64)
    count = 0
    for k in order:
        free = True
        for t in range(count):
            j = taken[t]
            if max(abs(peaks[k, 0] - peaks[j, 0]), abs(peaks[k, 1] - peaks[j, 1])) <= 1.5 * peaks[j, 3] + 0.5 * peaks[k, 3]:
                free = False
                break
        if free:
            keep[k] = True
            taken[count] = k
            count += 1
    return keep


@jit
def measure_peaks(frame: np.ndarray, peaks: Array, ground: Map, ends: tuple[float, float]) -> Array:
    """Targets about peaks, as `measure_regions` has them, in means over squares that suit the peaks' bins; shape (n, FIELDS)."""
    cols = frame.shape[1]
    out, found = np.zeros((max(len(peaks), 16), FIELDS)), 0
    for k in range(len(peaks)):
        x, y, half = int(peaks[k, 0] + 0.5), int(peaks[k, 1] + 0.5), int(peaks[k, 3]) // 2
        seed = np.zeros((1, RUN), np.int32)
        seed[0, 0], seed[0, 1], seed[0, 2], seed[0, 3] = y, max(x - half, 0), min(x + half + 1, cols), 1 if peaks[k, 2] > 0.0 else -1
        born = found
        out, found = add_faint(frame, ground, seed, half, out, born)
        if found > born:
            out[born, 14], out[born, 15], out[born, 16] = state(frame, out[born], 2, ends[0], ends[1]), seed[0, 3], -1.0 - k
    return out[:found]


@jit
def stand_apart(places: Array, known: int) -> Flags:
    """Of rows x, y, first and stop row, first and stop column those behind ``known`` whose box holds no earlier middle, nor the reverse."""
    n = len(places)
    apart = np.ones(n - known, np.bool_)
    for i in range(known, n):
        x, y = places[i, 0], places[i, 1]
        for j in range(i):
            if j >= known and not apart[j - known]:
                continue
            u, v = places[j, 0], places[j, 1]
            holds = places[i, 4] <= u < places[i, 5] and places[i, 2] <= v < places[i, 3]
            if holds or (places[j, 4] <= x < places[j, 5] and places[j, 2] <= y < places[j, 3]):
                apart[i - known] = False
                break
    return apart
