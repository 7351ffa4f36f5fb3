"""Kernels of tracking: the region near an expected place, its window and position, the motion from frame to frame."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.arrays import Array, Flags, Ints, Singles
from pixmetry.core.jit import jit
from pixmetry.locate._noise_kernels import Noise, variance_at
from pixmetry.locate.centroids._moment_kernels import (
    INNER,
    LEVEL,
    MAJOR,
    SLOPE_X,
    SLOPE_Y,
    X,
    Y,
    fit_grounds,
    moments,
)
from pixmetry.locate.centroids._window_kernels import SIZES, Shapes, conclude, lay_out, limit_windows, set_thresholds
from pixmetry.locate.detect._detect_kernels import RUN, Runs, group_runs
from pixmetry.locate.detect._region_kernels import (
    FIELDS,
    OVERLAPPING,
    SEED,
    count_joined,
    cut_runs,
    describe,
    simple,
    state,
    summits,
    top_of,
    waisted,
)

LOST, SEEN, FAINT, MERGED = 0, 1, 2, 3
"""Not there; seen as a region; too faint for a region, and taken to be where it is expected; one region with another target."""
RING = 24  # samples of the background around a target
SKIRT = 3.5  # standard deviations of the blur beyond the half-height contour that belong to a target
SLACK_PX = 2.0  # about the expected place, for a first look
WIDER = 3.0  # ratio of one look to the next
LEAST_AREA = 3  # pixels, as in detection
AREA_RATIO, HEIGHT_RATIO = 2.0, 2.5  # by which a target may change from frame to frame
MERGED_RATIO = 1.25  # of the area, from which a region that is no single disc is that of two
SHARED_RATIO = 1.1  # the same, of a region in which another target is expected that was not met
COMMON_PX = 0.5  # a common step from which on lost targets are looked for again
SAME = 0.3  # of the half axis: two targets that are nearer to each other are one
USUAL_CHANGE, MOST_CHANGE = 0.1, 0.7  # of the logarithm of sizes and blurs: all of them, or one, for other thresholds
NEW = 0.5  # weight of the latest step in a target's velocity


class Law(NamedTuple):
    """How the grey values of a region make a position."""

    code: int  # of the moment, see `_moment_kernels`
    margin: float  # of the window, in standard deviations of the edge
    whole: bool  # whether thresholds lie between whole numbers
    shapes: Shapes


class Kept(NamedTuple):
    """What is kept of each target from frame to frame, arrays of n rows."""

    region: Array  # shape (n, FIELDS), as it was last seen
    record: Array  # shape (n, COLUMNS)
    disc: Array  # shape (n, 3): radius and blur of the equivalent disc, usability
    chosen: Array  # shape (n, 3): the same when thresholds were chosen
    at: Array  # shape (n, 2): last position, px
    velocity: Array  # shape (n, 2), px per frame
    gap: Ints  # frames since it was last found
    seen: Ints  # in how many frames it was found
    gate: Array  # px
    multiple: Array  # threshold, variance over the phase, excess: see `choose_thresholds`
    s_curve: Array
    excess: Array
    row_shift: Array
    shared: (
        Array  # shape (n, 3): factors of the variances along x and y, and the correlation, that noise shared by neighbouring pixels brings
    )


@jit
def expect(kept: Kept, expected: Array) -> None:
    """Places of the next frame: straight on from the last ones."""
    for i in range(len(expected)):
        steps = kept.gap[i] + 1.0
        expected[i, 0] = kept.at[i, 0] + kept.velocity[i, 0] * steps
        expected[i, 1] = kept.at[i, 1] + kept.velocity[i, 1] * steps


@jit
def lift_of(frame: np.ndarray, x: float, y: float, radius: float, level: float, slope_x: float, slope_y: float) -> float:
    """Median of what grey values on a circle are above a plane."""
    above, n = np.empty(RING), 0
    for k in range(RING):
        turn = 2.0 * math.pi * k / RING
        dx, dy = radius * math.cos(turn), radius * math.sin(turn)
        row, col = int(round(y + dy)), int(round(x + dx))
        if 0 <= row < frame.shape[0] and 0 <= col < frame.shape[1]:
            above[n] = float(frame[row, col]) - level - slope_x * (col - x) - slope_y * (row - y)
            n += 1
    return float(np.median(above[:n])) if n >= RING // 2 else 0.0


@jit
def heights_over_plane(
    frame: np.ndarray, sign: float, plane: tuple[float, float, float], box: tuple[int, int, int, int], runs: Runs, out: Singles
) -> None:
    """Heights of the pixels of a box over the plane (level at row 0 and column 0, slopes), and its rows as runs."""
    first_row, stop_row, first_col, stop_col = box
    wide = stop_col - first_col
    level, slope_x, slope_y = plane
    side, step = np.float32(sign), np.float32(slope_x)
    for r in range(first_row, stop_row):
        i = r - first_row
        runs[i, 0], runs[i, 1], runs[i, 2], runs[i, 3], runs[i, 4] = r, first_col, stop_col, int(sign), i * wide
        row, height = frame[r, first_col:stop_col], out[i * wide : i * wide + wide]
        base = np.float32(level + slope_y * r + slope_x * first_col)
        for c in range(wide):
            height[c] = side * (np.float32(row[c]) - (base + step * np.float32(c)))


@jit
def nearest_region(
    frame: np.ndarray, box: tuple[int, int, int, int], window: Runs, height: Singles, least: float, ends: tuple[float, float],
    x: float, y: float, reach: float, known: Array, out: Array,
) -> bool:  # fmt: skip
    """Write the target of a box that is nearest to a place and like the known one; return whether there is one within reach."""
    rows, cols = frame.shape
    table = np.empty((len(height) + 1, RUN), np.int32)
    grouped, start = group_runs(table[: cut_runs(window, height, least, table)])
    nearest = reach
    met = False
    found_here = np.empty((16, FIELDS))
    for g in range(len(start) - 1):
        region = grouped[start[g] : start[g + 1]]
        area, first_col, stop_col = 0, region[0, 1], region[0, 2]
        for i in range(len(region)):
            area += region[i, 2] - region[i, 1]
            first_col, stop_col = min(first_col, region[i, 1]), max(stop_col, region[i, 2])
        first_row, stop_row = region[0, 0], region[len(region) - 1, 0] + 1
        away_x = max(first_col - x, x - stop_col + 1, 0.0)
        away_y = max(first_row - y, y - stop_row + 1, 0.0)
        if area < LEAST_AREA or away_x * away_x + away_y * away_y > reach * reach:
            continue
        most, top = top_of(region, height)
        level = 0.5 * top
        if most < SEED * least or level < least:
            continue
        parts = np.empty((area + 1, RUN), np.int32)
        parts = parts[: cut_runs(region, height, level, parts)]
        separate, holes = count_joined(parts, np.empty(len(parts), np.int32), np.empty(len(parts), np.int32))
        count = 0
        if separate == 1:
            describe(parts, height, level, top, holes, found_here[0])
            count = 1
        if separate != 1 or not simple(region, found_here[0]):
            found_here, count = summits(region, height, len(height), least, SEED * least, LEAST_AREA, found_here, 0)
        for k in range(count):
            one = found_here[k]
            cut = (one[7] <= box[0] and box[0] > 0) or (one[8] >= box[1] and box[1] < rows)
            cut = cut or (one[9] <= box[2] and box[2] > 0) or (one[10] >= box[3] and box[3] < cols)
            area_ratio, height_ratio = one[11] / known[11], one[6] / known[6]
            alike = area_ratio * AREA_RATIO > 1.0 and area_ratio < AREA_RATIO or abs(one[11] - known[11]) < 6.0
            alike = alike and height_ratio * HEIGHT_RATIO > 1.0 and height_ratio < HEIGHT_RATIO
            away = math.hypot(one[0] - x, one[1] - y)
            if alike and not cut and away < nearest:
                nearest, met = away, True
                out[:] = one
                out[14] = state(frame, one, 2, ends[0], ends[1]) | (OVERLAPPING if count > 1 or waisted(one) else 0)
                out[15], out[16] = known[15], known[16]
    return met


@jit
def seek(
    frame: np.ndarray, kept: Kept, expected: Array, first: int, stop: int, grain: float, sigma: float, ends: tuple[float, float],
    noise: Noise, found: Array, planes: Array, met: Ints,
) -> None:  # fmt: skip
    """Look for targets first … stop, which are not met yet, near their expected places: regions, and the planes of their backgrounds.

    ``sigma``: threshold in standard deviations of the noise. ``planes`` (n, 3): level at the found place, slopes.
    """
    for i in range(first, stop):
        if met[i] != LOST:
            continue
        known, record = kept.region[i], kept.record[i]
        x, y = expected[i, 0], expected[i, 1]
        slope_x, slope_y = record[SLOPE_X], record[SLOPE_Y]
        level = record[LEVEL] + slope_x * (x - record[X]) + slope_y * (y - record[Y])
        deviation = math.sqrt(max(variance_at(level, noise), 1e-12))
        lift = lift_of(frame, x, y, record[MAJOR] + record[INNER] + 1.5, level, slope_x, slope_y)
        if abs(lift) > deviation:  # the light has changed
            level += lift
        least = sigma * deviation + 0.5 * grain
        if 0.5 * known[6] < least:
            found[i] = known
            found[i, 0], found[i, 1] = x, y
            planes[i, 0], planes[i, 1], planes[i, 2] = level, slope_x, slope_y
            met[i] = FAINT
            continue
        plane = (level - slope_x * x - slope_y * y, slope_x, slope_y)
        reach, furthest = SLACK_PX + 0.5 * math.hypot(kept.velocity[i, 0], kept.velocity[i, 1]), kept.gate[i]
        if kept.gap[i] > 0:
            reach = furthest
        while True:
            reach = min(reach, furthest)
            half = known[2] + SKIRT * known[5] + 2.0 + reach
            box = (
                max(int(math.floor(y - half)), 0), min(int(math.ceil(y + half)) + 1, frame.shape[0]),
                max(int(math.floor(x - half)), 0), min(int(math.ceil(x + half)) + 1, frame.shape[1]),
            )  # fmt: skip
            if box[0] >= box[1] or box[2] >= box[3]:
                break
            window = np.empty((box[1] - box[0], RUN), np.int32)
            height = np.empty((box[1] - box[0]) * (box[3] - box[2]), np.float32)
            heights_over_plane(frame, known[15], plane, box, window, height)
            if nearest_region(frame, box, window, height, least, ends, x, y, reach, known, found[i]):
                planes[i, 0] = level + slope_x * (found[i, 0] - x) + slope_y * (found[i, 1] - y)
                planes[i, 1], planes[i, 2] = slope_x, slope_y
                met[i] = SEEN
                break
            if reach >= furthest:
                break
            reach *= WIDER


@jit
def common_step(expected: Array, found: Array, met: Ints) -> tuple[int, float, float]:
    """How many targets are not met, and the median of how far the others are from where they were expected."""
    n = 0
    step = np.empty((2, len(met)))
    for i in range(len(met)):
        if met[i] == SEEN:
            step[0, n], step[1, n] = found[i, 0] - expected[i, 0], found[i, 1] - expected[i, 1]
            n += 1
    lost = np.sum(met == LOST)
    return lost, float(np.median(step[0, :n])) if n else 0.0, float(np.median(step[1, :n])) if n else 0.0


@jit
def part_claims(expected: Array, found: Array, known: Array, start: Ints, index: Ints, met: Ints) -> None:
    """Where two targets were met at one place, leave it to the one that was expected nearer.

    A region that has another area than its target had, and in which one is expected that was not met, is that of both.
    """
    for i in range(len(met)):
        for k in range(start[i], start[i + 1]):
            j = index[k]
            if met[i] == SEEN and met[j] == SEEN and j > i:
                apart = math.hypot(found[i, 0] - found[j, 0], found[i, 1] - found[j, 1])
                if apart < SAME * min(found[i, 3], found[j, 3]):
                    one = math.hypot(found[i, 0] - expected[i, 0], found[i, 1] - expected[i, 1])
                    other = math.hypot(found[j, 0] - expected[j, 0], found[j, 1] - expected[j, 1])
                    met[j if one <= other else i] = LOST
    for i in range(len(met)):
        for k in range(start[i], start[i + 1]):
            j = index[k]
            if met[i] == SEEN and met[j] == LOST:
                apart = math.hypot(found[i, 0] - expected[j, 0], found[i, 1] - expected[j, 1])
                alike = known[i, 11] / SHARED_RATIO < found[i, 11] < known[i, 11] * SHARED_RATIO
                if apart < found[i, 2] + known[j, 2] and not alike:
                    found[i, 14] = int(found[i, 14]) | OVERLAPPING
                    met[i] = MERGED


@jit
def boxes_moved(region: Array, box: Ints) -> bool:
    """Whether a target has moved so far from its box that its neighbours are to be looked for again."""
    for i in range(len(region)):
        for k in range(4):
            if abs(region[i, 7 + k] - box[i, k]) > SLACK_PX:
                return True
    return False


@jit
def take_regions(kept: Kept, expected: Array, found: Array, planes: Array, met: Ints) -> None:
    """Put what was found in the place of what was known; what was not found goes on as it was expected.

    A region that has grown and is no single disc is two targets in one: its place says nothing of the motion of either.
    """
    for i in range(len(met)):
        region = kept.region[i]
        if met[i] == SEEN or met[i] == MERGED:
            area = region[11]
            region[:] = found[i]
            if int(region[14]) & OVERLAPPING and region[11] > MERGED_RATIO * area:
                met[i] = MERGED
            if met[i] == MERGED:
                region[11] = area
        else:
            dx, dy = expected[i, 0] - region[0], expected[i, 1] - region[1]
            region[0], region[1] = expected[i, 0], expected[i, 1]
            region[7] += round(dy)
            region[8] += round(dy)
            region[9] += round(dx)
            region[10] += round(dx)
            if met[i] == LOST:
                planes[i, 0] = kept.record[i, LEVEL] + kept.record[i, SLOPE_X] * (expected[i, 0] - kept.record[i, X])
                planes[i, 0] += kept.record[i, SLOPE_Y] * (expected[i, 1] - kept.record[i, Y])
                planes[i, 1], planes[i, 2] = kept.record[i, SLOPE_X], kept.record[i, SLOPE_Y]


@jit
def arrange(shape: tuple[int, int], kept: Kept, planes: Array, start: Ints, index: Ints, law: Law, flags: NDArray[np.uint32]) -> bool:
    """Lay out the windows of all targets; return whether sizes or blurs have changed so much that other thresholds are to be chosen."""
    n = len(planes)
    sizes = np.empty((n, SIZES))
    for i in range(n):
        region = kept.region[i]
        sizes[i, :6] = region[:6]
        sizes[i, 6] = region[6] * region[15]
        sizes[i, 7:10] = planes[i]
        flags[i] = np.uint32(region[14])
    lay_out(sizes, law.margin, law.shapes, kept.record, kept.disc)
    limit_windows(kept.record, start, index, shape[0], shape[1], 0.0, flags)
    for k in range(2):
        change = np.log(np.maximum(kept.disc[:, k], 1e-3) / np.maximum(kept.chosen[:, k], 1e-3))
        if abs(np.median(change)) > USUAL_CHANGE or np.abs(change).max() > MOST_CHANGE:
            return True
    return False


@jit
def measure(
    frame: np.ndarray, kept: Kept, start: Ints, index: Ints, law: Law, noise: Noise, first: int, stop: int, result: Array, at_rest: Flags
) -> None:
    """Backgrounds, thresholds and moments of targets first … stop, as `moment_positions` has them."""
    fit_grounds(frame, kept.record, first, stop, start, index, noise)
    set_thresholds(kept.record, first, stop, kept.multiple, kept.excess, law.whole, noise)
    moments(frame, kept.record, first, stop, law.code, noise, result, at_rest)


@jit
def widen(kept: Kept, result: Array) -> None:
    """Let variances hold the noise that neighbouring pixels share, as `with_correlation` does; that over the phase stays."""
    for i in range(len(result)):
        fx, fy, cross = kept.shared[i, 0], kept.shared[i, 1], kept.shared[i, 2]
        if (fx == 1.0 and fy == 1.0 and cross == 0.0) or not result[i, 2] > 0.0:
            continue
        phase = kept.s_curve[i] * kept.s_curve[i]
        vx, vy = result[i, 2] - phase, result[i, 4] - phase
        both, limit = result[i, 3] * math.sqrt(fx * fy) + cross * math.sqrt(vx * vy), 0.99 * math.sqrt(vx * fx * vy * fy)
        result[i, 2], result[i, 3], result[i, 4] = vx * fx + phase, min(max(both, -limit), limit), vy * fy + phase


@jit
def settle(kept: Kept, expected: Array, met: Ints, result: Array, at_rest: Flags, flags: NDArray[np.uint32]) -> None:
    """Results with their whole variance, NaN for what was not found; last positions and velocities."""
    for i in range(len(met)):
        away = math.hypot(result[i, 0] - expected[i, 0], result[i, 1] - expected[i, 1])
        at_rest[i] = at_rest[i] and met[i] != LOST and away < kept.gate[i] + SLACK_PX
    conclude(result, at_rest, kept.disc[:, 2], kept.s_curve, kept.row_shift, flags)
    widen(kept, result)
    for i in range(len(met)):
        if not at_rest[i] or met[i] == MERGED:
            kept.gap[i] += 1
            continue
        steps, share = kept.gap[i] + 1.0, 1.0 if kept.seen[i] <= 1 else NEW
        for axis in range(2):
            step = (result[i, axis] - kept.at[i, axis]) / steps
            kept.velocity[i, axis] += share * (step - kept.velocity[i, axis])
            kept.at[i, axis] = result[i, axis]
        kept.gap[i] = 0
        kept.seen[i] += 1


@jit
def find_all(
    frame: np.ndarray, kept: Kept, grain: float, sigma: float, ends: tuple[float, float], noise: Noise, start: Ints, index: Ints,
    expected: Array, found: Array, planes: Array, met: Ints,
) -> None:  # fmt: skip
    """Look for all targets: where each is expected, then where it is if all have moved alike."""
    expect(kept, expected)
    met[:] = LOST
    seek(frame, kept, expected, 0, len(met), grain, sigma, ends, noise, found, planes, met)
    if shift_lost(expected, found, met):
        seek(frame, kept, expected, 0, len(met), grain, sigma, ends, noise, found, planes, met)
    take_all(kept, expected, found, planes, start, index, met)


@jit
def shift_lost(expected: Array, found: Array, met: Ints) -> bool:
    """Expect targets that are not met where they are if they moved as the others did; return whether that is elsewhere."""
    lost, dx, dy = common_step(expected, found, met)
    if lost == 0 or math.hypot(dx, dy) < COMMON_PX:
        return False
    for i in range(len(met)):
        if met[i] == LOST:
            expected[i, 0] += dx
            expected[i, 1] += dy
    return True


@jit
def take_all(kept: Kept, expected: Array, found: Array, planes: Array, start: Ints, index: Ints, met: Ints) -> None:
    """Settle to whom the found regions belong, and take them."""
    part_claims(expected, found, kept.region, start, index, met)
    take_regions(kept, expected, found, planes, met)


@jit
def measure_all(
    frame: np.ndarray, kept: Kept, start: Ints, index: Ints, law: Law, noise: Noise, expected: Array, met: Ints, result: Array,
    at_rest: Flags, flags: NDArray[np.uint32],
) -> None:  # fmt: skip
    """Measure all targets that are laid out."""
    measure(frame, kept, start, index, law, noise, 0, len(met), result, at_rest)
    settle(kept, expected, met, result, at_rest, flags)
