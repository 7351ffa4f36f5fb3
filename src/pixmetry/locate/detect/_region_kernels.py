"""Kernels of regions: how many targets a region holds, and the place, size and shape of each above its half height."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.arrays import Array, Ints, Singles
from pixmetry.core.jit import jit
from pixmetry.locate.detect._background_kernels import Map, map_at
from pixmetry.locate.detect._detect_kernels import RUN, Runs, doubled, group_runs, join_runs

STRETCH = 32  # pixels over which the background is taken as straight
PROMINENT = 1.4  # height of a summit over that of the saddle to a higher one, for both to be targets
LEAST_LEVEL = 1e-9  # DN
STEP = 0.5**0.25  # from one level to the next below
SOLID = 20  # pixels from which on two outliers among them are not believed
GROWTHS = 5  # of the window in which a faint target is looked for
SEED = 1.5  # height of a top over the threshold, for a region to be more than noise
HALO, REACH = 0.4, 12.0  # see `spurious`
FIELDS = 17  # of a target: see `describe` and `measure_regions`
TWICE, GLARE = 1, 2  # why a target is none of its own: see `spurious`
BORDER, SATURATED, CLIPPED, OVERLAPPING = 1, 2, 4, 16  # of `targets.Flag`


class GroupedRuns(NamedTuple):
    """Runs of pixels, region by region."""

    runs: Runs  # shape (n, RUN)
    start: Ints  # region g has runs[start[g]:start[g + 1]]


class Outlines(NamedTuple):
    """Targets as they were found, arrays of shape (n,)."""

    x: Array  # px
    y: Array
    major: Array  # half axes, px
    minor: Array
    angle: Array  # degrees
    blur: Array  # px
    amplitude: Array  # DN
    box: Ints  # shape (n, 4): first and stop row, first and stop column


@jit
def heights(frame: np.ndarray, ground: Map, runs: Runs, out: Singles) -> int:
    """How far the pixels of the runs lie beyond the background, on the runs' side of it; and where in ``out`` each run's are."""
    n = 0
    for i in range(len(runs)):
        r, sign = runs[i, 0], np.float32(runs[i, 3])
        runs[i, 4] = n
        for begin in range(runs[i, 1], runs[i, 2], STRETCH):
            end = min(begin + STRETCH, runs[i, 2])
            value, slope_x, _ = map_at(ground, float(begin), float(r))
            level, slope = np.float32(value), np.float32(slope_x)
            row, height = frame[r, begin:end], out[n : n + end - begin]
            for c in range(len(row)):
                height[c] = sign * (np.float32(row[c]) - (level + slope * np.float32(c)))
            n += end - begin
    return n


@jit
def top_of(runs: Runs, height: Singles) -> tuple[float, float]:
    """Greatest height in the runs; and that of their plateau, the mean of what is above three quarters of the third greatest.

    Defective pixels are not of the plateau; where there are too few pixels to tell, all count.
    """
    first, second, third, n = np.float32(0.0), np.float32(0.0), np.float32(0.0), 0
    for i in range(len(runs)):
        for k in range(runs[i, 4], runs[i, 4] + runs[i, 2] - runs[i, 1]):
            n += 1
            h = height[k]
            if h > third:
                if h > first:
                    first, second, third = h, first, second
                elif h > second:
                    second, third = h, second
                else:
                    third = h
    most, total, kept = (third, -float(first) - float(second), -2) if n >= SOLID else (first, 0.0, 0)
    for i in range(len(runs)):
        for k in range(runs[i, 4], runs[i, 4] + runs[i, 2] - runs[i, 1]):
            if height[k] >= np.float32(0.75) * most:
                total += height[k]
                kept += 1
    return float(first), total / max(kept, 1)


@jit
def cut_runs(runs: Runs, height: Singles, level: float, parts: Runs) -> int:
    """Write those parts of the runs that are higher than a level into a table with room for them; return their number."""
    n = 0
    for i in range(len(runs)):
        inside, shift = False, runs[i, 1] - runs[i, 4]
        for k in range(runs[i, 4], runs[i, 4] + runs[i, 2] - runs[i, 1]):
            if (height[k] > level) != inside:
                inside = not inside
                if inside:
                    parts[n, 0], parts[n, 1], parts[n, 3], parts[n, 4] = runs[i, 0], k + shift, runs[i, 3], k
                else:
                    parts[n, 2] = k + shift
                    n += 1
        if inside:
            parts[n, 2] = runs[i, 2]
            n += 1
    return n


@jit
def count_joined(parts: Runs, parent: Runs, touches: Runs) -> tuple[int, int]:
    """Join the parts; return the number of separate ones and of the holes in them."""
    join_runs(parts, parent, touches)
    separate, holes = 0, 0
    for i in range(len(parts)):
        if parent[i] == i:
            separate += 1
            holes += touches[i]
    return separate, holes - len(parts) + separate


@jit
def describe(parts: Runs, height: Singles, level: float, top: float, holes: int, out: Array) -> None:
    """Fill in x, y, axes, angle, blur, amplitude, box, area, fill and holes of a connected part of a region."""
    area, steep, weight, wx, wy = 0.0, 0.0, 0.0, 0.0, 0.0
    sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0
    row, col, first_col, stop_col = parts[0, 0], parts[0, 1], parts[0, 1], parts[0, 2]
    for i in range(len(parts)):
        first_col, stop_col = min(first_col, parts[i, 1]), max(stop_col, parts[i, 2])
        y, x = float(parts[i, 0] - row), float(parts[i, 1] - col)
        n = float(parts[i, 2] - parts[i, 1])
        mid = x + 0.5 * (n - 1.0)
        area += n
        sx += n * mid
        sy += n * y
        sxx += n * (mid * mid + (n * n - 1.0) / 12.0)
        sxy += n * mid * y
        syy += n * y * y
        here, along = 0.0, 0.0
        for k in range(parts[i, 4], parts[i, 4] + parts[i, 2] - parts[i, 1]):
            h = float(height[k]) - level
            here += h
            along += h * x
            x += 1.0
            steep += 1.0 if height[k] < 0.75 * top else 0.0
        weight += here
        wx += along
        wy += here * y
    mx, my = sx / area, sy / area
    xx, xy, yy = sxx / area - mx * mx + 1.0 / 12.0, sxy / area - mx * my, syy / area - my * my + 1.0 / 12.0
    half, swing = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    large, small = half + swing, max(half - swing, 1.0 / 12.0)
    square, ratio = area / math.pi, math.sqrt(large / small)
    if holes > 0:  # outer ellipse of a ring: with axes R and ρR, area/π = R²(1 − ρ²) and 4√(λ1 λ2) = R²(1 + ρ²)
        square = 0.5 * (square + 4.0 * math.sqrt(large * small))
    out[0], out[1] = col + wx / weight, row + wy / weight
    out[2], out[3] = math.sqrt(square * ratio), math.sqrt(square / ratio)
    out[4] = math.degrees(0.5 * math.atan2(2.0 * xy, xx - yy))
    out[5] = rough_blur(area, steep, math.sqrt(0.5 * (out[2] ** 2 + out[3] ** 2)))
    out[6] = top
    out[7], out[8], out[9], out[10] = row, parts[len(parts) - 1, 0] + 1, first_col, stop_col
    out[11], out[12], out[13] = area, area / (4.0 * math.pi * math.sqrt(large * small)), holes


@jit
def rough_blur(area: float, steep: float, radius: float) -> float:
    """Standard deviation of a Gaussian edge of which ``steep`` pixels lie between half and three quarters of the height.

    That is 0.6745 of it, all around; of a Gaussian spot, where the plateau is missing, the area tells more.
    """
    if steep < 0.5 * area:
        return max(steep / (0.6745 * 2.0 * math.pi * radius), 0.3)
    return math.sqrt(area / (2.0 * math.pi * math.log(2.0)))


@jit
def state(frame: np.ndarray, out: Array, reach: int, low_dn: float, high_dn: float) -> int:
    """Flags of a box: whether it reaches the border, and whether grey values in it and just around it are at the ends of the scale."""
    flags = 0
    first_row, stop_row = int(out[7]) - reach, int(out[8]) + reach
    first_col, stop_col = int(out[9]) - reach, int(out[10]) + reach
    if first_row < 0 or first_col < 0 or stop_row > frame.shape[0] or stop_col > frame.shape[1]:
        flags |= BORDER
    first_col, stop_col = max(first_col, 0), min(stop_col, frame.shape[1])
    for r in range(max(first_row, 0), min(stop_row, frame.shape[0])):
        row = frame[r, first_col:stop_col]
        low, high = np.int32(0), np.int32(0)
        for c in range(len(row)):
            low |= np.int32(row[c] <= low_dn)
            high |= np.int32(row[c] >= high_dn)
        flags |= CLIPPED * (low != 0) | SATURATED * (high != 0)
    return flags


@jit
def largest(runs: Runs) -> Runs:
    """Of a table of runs those of the set with most pixels."""
    grouped, start = group_runs(runs)
    best, most = 0, 0
    for k in range(len(start) - 1):
        area = np.sum(grouped[start[k] : start[k + 1], 2] - grouped[start[k] : start[k + 1], 1])
        if area > most:
            best, most = k, area
    return grouped[start[best] : start[best + 1]]


@jit
def add_target(runs: Runs, height: Singles, level: float, out: Array, found: int) -> tuple[Array, int]:
    """Measure a part of a region, at its own half height if that is above the level, and write it behind those found."""
    top = top_of(runs, height)[1]
    parts = np.empty((np.sum(runs[:, 2] - runs[:, 1]) + 1, RUN), np.int32)
    level = max(level, 0.5 * top)
    parts = largest(parts[: cut_runs(runs, height, level, parts)])
    n = len(parts)
    holes = count_joined(parts, np.empty(n, np.int32), np.empty(n, np.int32))[1]
    if found == len(out):
        out = doubled(out)
    describe(parts, height, level, top, holes, out[found])
    return out, found + 1


@jit
def summits(runs: Runs, height: Singles, n: int, least: float, seed: float, least_area: int, out: Array, found: int) -> tuple[Array, int]:
    """Targets of a region that may hold several, of any heights.

    From the top down, level by level, a connected part is a target when it has come down to half its height with no target in it yet; and
    parts that meet earlier are targets each, if they rise PROMINENT times as high as the saddle and cover ``least_area`` pixels there.
    """
    level = STEP * top_of(runs, height)[0]
    before = np.full(n, -1, np.int32)  # which part of the level before a pixel belongs to
    old, old_start, old_level = runs[:0], np.zeros(1, np.int64), level
    old_done, old_worth = np.zeros(0, np.bool_), np.zeros(0, np.bool_)
    table = np.empty((n + 1, RUN), np.int32)
    while True:
        level = max(level, least)
        parts, start = group_runs(table[: cut_runs(runs, height, level, table)])
        count = len(start) - 1
        done, worth = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        seen_in = np.full(len(old_start), -1, np.int32)
        for p in range(count):
            part = parts[start[p] : start[p + 1]]
            most, area, kids = np.float32(0.0), 0, 0
            for i in range(len(part)):
                for k in range(part[i, 4], part[i, 4] + part[i, 2] - part[i, 1]):
                    most = max(most, height[k])
                    area += 1
                    kid = before[k]
                    if kid >= 0 and seen_in[kid] != p:
                        seen_in[kid] = p
                        kids += 1 if old_done[kid] or old_worth[kid] else 0
                        done[p] |= old_done[kid]
            if kids >= 2:
                for kid in range(len(old_start) - 1):
                    if seen_in[kid] == p and old_worth[kid] and not old_done[kid]:
                        out, found = add_target(old[old_start[kid] : old_start[kid + 1]], height, old_level, out, found)
                        done[p] = True
            if not done[p] and most >= seed and (level <= 0.5 * most or level <= least) and area >= least_area:
                out, found = add_target(part, height, level, out, found)
                done[p] = True
            worth[p] = area >= least_area and most >= PROMINENT * level and most - level >= least
        for i in range(len(parts)):
            before[parts[i, 4] : parts[i, 4] + parts[i, 2] - parts[i, 1]] = -1
        for p in range(count):
            for i in range(start[p], start[p + 1]):
                before[parts[i, 4] : parts[i, 4] + parts[i, 2] - parts[i, 1]] = p
        if level <= least:
            return out, found
        old, old_start, old_level, old_done, old_worth = parts, start, level, done, worth
        level *= STEP


@jit
def smooth_heights(frame: np.ndarray, ground: Map, sign: int, box: tuple[int, int, int, int], half: int, runs: Runs, out: Singles) -> None:
    """Heights of a window in the mean of 2·half + 1 pixels squared, as far as these are in the frame; and its rows as runs."""
    first_row, stop_row, first_col, stop_col = box
    rows, cols = frame.shape
    wide, begin, end = stop_col - first_col, max(first_col - half, 0), min(stop_col + half, cols)
    column = np.zeros(end - begin)
    for r in range(max(first_row - half, 0), min(first_row + half, rows)):
        for c in range(begin, end):
            column[c - begin] += frame[r, c]
    for r in range(first_row, stop_row):
        i = r - first_row
        runs[i, 0], runs[i, 1], runs[i, 2], runs[i, 3], runs[i, 4] = r, first_col, stop_col, sign, i * wide
        if r + half < rows:
            for c in range(begin, end):
                column[c - begin] += frame[r + half, c]
        if r - half - 1 >= max(first_row - half, 0):
            for c in range(begin, end):
                column[c - begin] -= frame[r - half - 1, c]
        high = min(r + half + 1, rows) - max(r - half, 0)
        total = 0.0
        for c in range(begin, min(first_col + half, end)):
            total += column[c - begin]
        for c in range(first_col, stop_col):
            if c + half < end:
                total += column[c + half - begin]
            if c - half - 1 >= begin:
                total -= column[c - half - 1 - begin]
            n = high * (min(c + half + 1, cols) - max(c - half, 0))
            out[i * wide + c - first_col] = sign * (total / n - map_at(ground, float(c), float(r))[0])


@jit
def add_faint(frame: np.ndarray, ground: Map, region: Runs, half: int, out: Array, found: int) -> tuple[Array, int]:
    """Measure a region whose half height is in the noise: with smoothed heights, in a window that grows until it contains the region.

    The means are over 2·half + 1 pixels squared.
    """
    rows, cols = frame.shape
    first_row, stop_row, first_col, stop_col = region[0, 0], region[len(region) - 1, 0] + 1, region[0, 1], region[0, 2]
    for i in range(len(region)):
        first_col, stop_col = min(first_col, region[i, 1]), max(stop_col, region[i, 2])
    middle = region[len(region) // 2]
    grown = 2
    for growth in range(GROWTHS):
        grown *= 2
        a, b = max(first_row - grown, 0), min(stop_row + grown, rows)
        c, d = max(first_col - grown, 0), min(stop_col + grown, cols)
        window, height = np.empty((b - a, RUN), np.int32), np.empty((b - a) * (d - c), np.float32)
        smooth_heights(frame, ground, region[0, 3], (a, b, c, d), half, window, height)
        own = region.copy()
        for i in range(len(own)):
            own[i, 4] = (own[i, 0] - a) * (d - c) + own[i, 1] - c
        top = top_of(own, height)[1]
        table = np.empty((len(height) + 1, RUN), np.int32)
        parts = around(table[: cut_runs(window, height, 0.5 * top, table)], middle)
        if len(parts) == 0:
            return out, found
        cut = parts[0, 0] == a > 0 or parts[len(parts) - 1, 0] == b - 1 < rows - 1
        for i in range(len(parts)):
            cut = cut or parts[i, 1] == c > 0 or parts[i, 2] == d < cols
        if not cut or growth == GROWTHS - 1:
            n = len(parts)
            holes = count_joined(parts, np.empty(n, np.int32), np.empty(n, np.int32))[1]
            if found == len(out):
                out = doubled(out)
            describe(parts, height, 0.5 * top, top, holes, out[found])
            found += 1
            break
    return out, found


@jit
def around(runs: Runs, middle: Runs) -> Runs:
    """Of a table of runs those of the set that meets another run; none if none does."""
    grouped, start = group_runs(runs)
    for k in range(len(start) - 1):
        for i in range(start[k], start[k + 1]):
            if grouped[i, 0] == middle[0] and grouped[i, 1] < middle[2] and grouped[i, 2] > middle[1]:
                return grouped[start[k] : start[k + 1]]
    return grouped[:0]


@jit
def measure_regions(
    frame: np.ndarray, regions: GroupedRuns, least: Map, ground: Map, span: tuple[int, int], least_area: int, ends: tuple[float, float]
) -> Array:
    """Targets of the regions ``span[0]`` to ``span[1]``, shape (n, FIELDS): what `describe` says, then flags, sign and region.

    ``least`` is the map of the threshold's height; a region counts if it has ``least_area`` pixels and its top is SEED times as high.
    ``ends``: grey values at which the scale ends.
    """
    (runs, start), (first, stop) = regions, span
    most_pixels = 0
    for g in range(first, stop):
        most_pixels = max(most_pixels, np.sum(runs[start[g] : start[g + 1], 2] - runs[start[g] : start[g + 1], 1]))
    height, table = np.empty(most_pixels, np.float32), np.empty((most_pixels + 1, RUN), np.int32)
    parent, touches = np.empty(most_pixels + 1, np.int32), np.empty(most_pixels + 1, np.int32)
    out, found = np.zeros((max(stop - first, 16), FIELDS)), 0
    for g in range(first, stop):
        region = runs[start[g] : start[g + 1]]
        area = 0
        for i in range(len(region)):
            area += region[i, 2] - region[i, 1]
        if area < least_area:
            continue
        n = heights(frame, ground, region, height)
        most, top = top_of(region, height)
        low = max(map_at(least, float(region[0, 1]), float(region[0, 0]))[0], LEAST_LEVEL)
        if most < SEED * low:
            continue
        born = found
        level = 0.5 * top
        if level < low:
            out, found = add_faint(frame, ground, region, 1, out, born)
        else:
            parts = table[: cut_runs(region, height, level, table)]
            separate, holes = count_joined(parts, parent, touches)
            if separate == 1:
                if found == len(out):
                    out = doubled(out)
                describe(parts, height, level, top, holes, out[found])
                found += 1
            if separate != 1 or not simple(region, out[born]):
                out, found = summits(region, height, n, low, SEED * low, least_area, out, born)
        for k in range(born, found):
            several = found - born > 1 or (level >= low and waisted(out[k]))
            out[k, 14] = state(frame, out[k], 2, ends[0], ends[1]) | (OVERLAPPING if several else 0)
            out[k, 15], out[k, 16] = region[0, 3], g
    return out[:found]


@jit
def waisted(target: Array) -> bool:
    """Whether a target's fill is that of two or three discs that touch: equal ones have 0.89 and 0.77."""
    return bool(target[13] == 0.0 and 0.7 < target[12] < 0.95 - 0.5 / target[11] and target[11] >= SOLID)


@jit
def simple(region: Runs, target: Array) -> bool:
    """Whether a region contains only its target: it is hardly larger, and the target has the shape of an ellipse."""
    margin = 2.0 + 3.0 * target[5]
    first_col, stop_col = region[0, 1], region[0, 2]
    for i in range(len(region)):
        first_col, stop_col = min(first_col, region[i, 1]), max(stop_col, region[i, 2])
    close = target[7] - region[0, 0] <= margin and region[len(region) - 1, 0] + 1 - target[8] <= margin
    close = close and target[9] - first_col <= margin and stop_col - target[10] <= margin
    return bool(close and (target[12] > 0.9 or target[11] < 20.0))


@jit
def spurious(targets: Outlines, start: Ints, index: Ints, ringing: float) -> NDArray[np.int8]:
    """Targets that are another one's doing: TWICE, the same one found again; GLARE, a sharpened edge's halo or a compressed one's ringing.

    ``start`` and ``index`` say which targets are near each other. A halo has the other sign, less than HALO of the height, and lies at the
    edge; ringing has less than ``ringing`` of the height and lies within REACH pixels, a block of the coder.
    """
    x, y, major, minor, angle, blur, amplitude, box = targets
    cause = np.zeros(len(x), np.int8)
    for i in range(len(x)):
        for k in range(start[i], start[i + 1]):
            j = index[k]
            dx, dy = x[i] - x[j], y[i] - y[j]
            ratio = amplitude[i] / amplitude[j]
            if abs(ratio) < HALO:
                turn = math.atan2(dy, dx) - math.radians(angle[j])
                edge = major[j] * minor[j] / math.hypot(minor[j] * math.cos(turn), major[j] * math.sin(turn))
                gap = math.hypot(dx, dy) - edge
                halo = ratio < 0.0 and gap < minor[i] + 2.0 + 3.0 * blur[j]
                if halo or (abs(ratio) < ringing and gap < REACH):
                    cause[i] = GLARE
            elif j < i and ratio > 0.0 and cause[j] == 0 and np.abs(box[i] - box[j]).max() <= 1:
                cause[i] = TWICE
    return cause
