"""Kernels of detection: runs of pixels beyond a threshold, the regions that they make, and which boxes are near each other."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.arrays import Array, Ints, Singles
from pixmetry.core.jit import jit

WORD, ONES = 8, 0x0101010101010101  # pixels that are compared at once, and a 1 in each of them
RUN = 5  # numbers of a run: row, first column, stop column, sign, and where the heights of its pixels are

Runs = NDArray[np.int32]  # shape (n, RUN), or a number of each run
Item = TypeVar("Item", bound=np.generic)


@jit
def mark(
    row: np.ndarray, low: Singles, low_step: Singles, high: Singles, high_step: Singles, f: np.float32, sides: NDArray[np.int8]
) -> None:
    """Write 1 where a pixel is above high + f·high_step, −1 where it is below low + f·low_step, and 0 in between."""
    for c in range(len(row)):
        v = np.float32(row[c])
        sides[c] = np.int8(v > high[c] + f * high_step[c]) - np.int8(v < low[c] + f * low_step[c])


@jit
def at_columns(nodes: Array, i: int, col_scale: float, value: Singles, step: Singles) -> None:
    """Row i of a map at every column, and the increments to row i + 1."""
    tiles, k, begin = nodes.shape[1], min(i + 1, nodes.shape[0] - 1), 0
    for j in range(max(tiles - 1, 1)):
        m = min(j + 1, tiles - 1)
        end = len(value) if j >= tiles - 2 else int(math.ceil((j + 1.5) / col_scale - 0.5))
        here, below = nodes[i, j], nodes[k, j]
        slope, slope_below = (nodes[i, m] - here) * col_scale, (nodes[k, m] - below) * col_scale
        offset = begin + 0.5 - (j + 0.5) / col_scale
        first, change = np.float32(here + offset * slope), np.float32(slope)
        first_step, step_change = np.float32(below - here + offset * (slope_below - slope)), np.float32(slope_below - slope)
        for c in range(end - begin):
            value[begin + c] = first + change * np.float32(c)
            step[begin + c] = first_step + step_change * np.float32(c)
        begin = end


@jit
def find_runs(frame: np.ndarray, low: Array, high: Array, row_scale: float, col_scale: float, first: int, stop: int) -> Runs:
    """Runs of pixels below the map low or above the map high in the rows first … stop; shape (n, RUN)."""
    columns, tiles = frame.shape[1], low.shape[0]
    runs, n = np.empty((4 * columns, RUN), np.int32), 0
    lows, low_steps = np.empty(columns, np.float32), np.empty(columns, np.float32)
    highs, high_steps = np.empty(columns, np.float32), np.empty(columns, np.float32)
    sides = np.zeros((columns + WORD) // WORD * WORD, np.int8)  # at least one 0 behind the last pixel ends the last run
    words = sides.view(np.int64)
    last = -1
    for r in range(first, stop):
        v = (r + 0.5) * row_scale - 0.5
        i = min(max(int(math.floor(v)), 0), max(tiles - 2, 0))
        if i != last:
            at_columns(low, i, col_scale, lows, low_steps)
            at_columns(high, i, col_scale, highs, high_steps)
            last = i
        mark(frame[r], lows, low_steps, highs, high_steps, np.float32(v - i if tiles > 1 else 0.0), sides[:columns])
        if len(runs) < n + columns:
            runs = doubled(runs)
        sign, start, alike = 0, 0, 0
        for w in range(len(words)):
            if words[w] == alike:
                continue
            for c in range(w * WORD, w * WORD + WORD):
                if sides[c] != sign:
                    if sign != 0:
                        runs[n, 0], runs[n, 1], runs[n, 2], runs[n, 3], runs[n, 4] = r, start, c, sign, 0
                        n += 1
                    sign, start = sides[c], c
            alike = ONES if sign > 0 else -1 if sign < 0 else 0
    return runs[:n].copy()


@jit
def doubled(table: NDArray[Item]) -> NDArray[Item]:
    """The table with as many rows again."""
    more = np.empty((2 * len(table), table.shape[1]), table.dtype)
    more[: len(table)] = table
    return more


@jit
def root(parent: Runs, i: int) -> int:
    """The first member of i's set; the path to it is halved."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@jit
def join_runs(runs: Runs, parent: Runs, touches: Runs) -> None:
    """Join runs of one sign that touch (corners count) in neighbouring rows; count the touches of each set at its root.

    The runs are in order of row and column. As a graph (a run is a node, a touch an edge) a set is planar, and what its
    edges have over a tree's are the holes of its region.
    """
    stop = len(runs)
    for i in range(stop):
        parent[i] = i
        touches[i] = 0
    i, above, above_stop = 0, 0, 0
    while i < stop:
        row = runs[i, 0]
        row_stop = i
        while row_stop < stop and runs[row_stop, 0] == row:
            row_stop += 1
        if above < above_stop and runs[above, 0] == row - 1:
            j = above
            for k in range(i, row_stop):
                while j < above_stop and runs[j, 2] < runs[k, 1]:
                    j += 1
                m = j
                while m < above_stop and runs[m, 1] <= runs[k, 2]:
                    if runs[m, 3] == runs[k, 3]:
                        a, b = root(parent, m), root(parent, k)
                        if a < b:
                            parent[b] = a
                            touches[a] += touches[b] + 1
                        elif b < a:
                            parent[a] = b
                            touches[b] += touches[a] + 1
                        else:
                            touches[a] += 1
                    m += 1
        above, above_stop = i, row_stop
        i = row_stop


@jit
def group_runs(runs: Runs) -> tuple[Runs, Ints]:
    """Put the runs of each region together: the runs by region, each in order of row and column, and where each region starts."""
    n = len(runs)
    parent, label = np.empty(n, np.int32), np.empty(n, np.int32)
    join_runs(runs, parent, label)
    count = 0
    for i in range(n):
        j = root(parent, i)
        if j == i:
            label[i] = count
            count += 1
        else:
            label[i] = label[j]
    start = np.zeros(count + 1, np.int64)
    for i in range(n):
        start[label[i] + 1] += 1
    for i in range(count):
        start[i + 1] += start[i]
    place = start[:-1].copy()
    grouped = np.empty_like(runs)
    for i in range(n):
        k = place[label[i]]
        grouped[k] = runs[i]
        place[label[i]] += 1
    return grouped, start


@jit
def boxes_in_reach(box: Ints, reach: Array, light: Array) -> tuple[Ints, Ints]:
    """For each box i (first row, stop row, first column, stop column) the others j whose gap, in rows and in columns, is at most
    ``reach[i]`` or half of that and ``light[j]``.

    The boxes are put into square cells as large as their mean side and the mean reach, each into all the cells that it touches when
    grown by its light; and looked for in those that a box touches when grown by its reach. The work grows with the number of boxes.
    """
    n = len(box)
    start = np.zeros(n + 1, np.int64)
    if n == 0:
        return start, np.empty(0, np.int64)
    side, rows, cols = 0.0, 0, 0
    for i in range(n):
        side += (0.5 * (box[i, 1] - box[i, 0] + box[i, 3] - box[i, 2]) + reach[i]) / n
        rows, cols = max(rows, box[i, 1]), max(cols, box[i, 3])
    cell = max(side, math.sqrt(rows * cols / (4.0 * n)), 1.0)
    high, wide = int(rows / cell) + 1, int(cols / cell) + 1
    fill = np.zeros(high * wide + 1, np.int64)
    for i in range(n):
        top, bottom, left, right = cells_of(box[i], light[i], cell, high, wide)
        for r in range(top, bottom + 1):
            for c in range(left, right + 1):
                fill[r * wide + c + 1] += 1
    for k in range(high * wide):
        fill[k + 1] += fill[k]
    place, member = fill[:-1].copy(), np.empty(fill[-1], np.int64)
    for i in range(n):
        top, bottom, left, right = cells_of(box[i], light[i], cell, high, wide)
        for r in range(top, bottom + 1):
            for c in range(left, right + 1):
                member[place[r * wide + c]] = i
                place[r * wide + c] += 1
    index, used = np.empty(8 * n, np.int64), 0
    seen = np.full(n, -1, np.int64)
    for i in range(n):
        begin = used
        top, bottom, left, right = cells_of(box[i], reach[i], cell, high, wide)
        for r in range(top, bottom + 1):
            for c in range(left, right + 1):
                for k in range(fill[r * wide + c], fill[r * wide + c + 1]):
                    j = member[k]
                    if seen[j] == i or j == i:
                        continue
                    seen[j] = i
                    far = max(reach[i], 0.5 * reach[i] + light[j])
                    if max(box[j, 0] - box[i, 1], box[i, 0] - box[j, 1]) > far or max(box[j, 2] - box[i, 3], box[i, 2] - box[j, 3]) > far:
                        continue
                    if used == len(index):
                        more = np.empty(2 * used, np.int64)
                        more[:used] = index
                        index = more
                    index[used] = j
                    used += 1
        index[begin:used].sort()
        start[i + 1] = used
    return start, index[:used].copy()


@jit(inline="always")
def cells_of(box: Ints, grown: float, cell: float, high: int, wide: int) -> tuple[int, int, int, int]:
    """First and last row and column of the cells that a box touches when it is grown."""
    top, bottom = max(int((box[0] - grown) / cell), 0), min(int((box[1] + grown) / cell), high - 1)
    left, right = max(int((box[2] - grown) / cell), 0), min(int((box[3] + grown) / cell), wide - 1)
    return top, bottom, left, right


@jit
def sample_rings(
    frame: np.ndarray,
    x: Array,
    y: Array,
    semi_major: Array,
    semi_minor: Array,
    angle: Array,
    radii: Array,
    directions: Array,
    start: int,
    stop: int,
    out: Array,
) -> None:
    """Interpolate linearly at centre + M (ρ cos φ, ρ sin φ), with M the map of the unit circle to the target's outline.

    out (n, len(radii), len(directions)) becomes NaN outside the frame. M is the symmetric map that has the ellipse's axes.
    """
    rows, cols = frame.shape
    for i in range(start, stop):
        c, s = math.cos(angle[i]), math.sin(angle[i])
        m11 = semi_major[i] * c * c + semi_minor[i] * s * s
        m12 = (semi_major[i] - semi_minor[i]) * c * s
        m22 = semi_major[i] * s * s + semi_minor[i] * c * c
        for d in range(directions.shape[0]):
            ex, ey = math.cos(directions[d]), math.sin(directions[d])
            dx, dy = m11 * ex + m12 * ey, m12 * ex + m22 * ey
            for r in range(radii.shape[0]):
                px, py = x[i] + radii[r] * dx, y[i] + radii[r] * dy
                if not (0.0 <= px <= cols - 1.0 and 0.0 <= py <= rows - 1.0):
                    out[i, r, d] = np.nan
                    continue
                col, row = min(int(px), cols - 2), min(int(py), rows - 2)
                fx, fy = px - col, py - row
                top = (1.0 - fx) * frame[row, col] + fx * frame[row, col + 1]
                bottom = (1.0 - fx) * frame[row + 1, col] + fx * frame[row + 1, col + 1]
                out[i, r, d] = (1.0 - fy) * top + fy * bottom
