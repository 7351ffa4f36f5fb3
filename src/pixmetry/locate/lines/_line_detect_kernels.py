"""Kernels that find lines and edges: points on ridges and steps, chains of them, and how far the lines through them reach."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.arrays import Array, Flags, Ints, Singles
from pixmetry.core.jit import jit
from pixmetry.locate.lines._line_kernels import Lines, Pixels, gather
from pixmetry.locate.lines._profile_kernels import BAR, EDGE, GAUSSIAN, profile

FIELDS = 5  # of a point: signal over noise, shift in x and in y from the pixel's centre, direction, strength
TURN = 0.5  # most change of direction from point to point, rad
HOP = 3  # most distance to the next point of a chain
LINE, STEP = 0, 1
GAP = 6  # samples along a line that may fail
LEAST_SHARE = 0.75  # of the samples along a line that must be its own
CROSSING = 60  # samples in which another line may hide where this one ends
SAMPLES = 25  # across a line
STATE = 11  # x, y, angle, curvature, least, greatest place along, background, amplitude, blur, width, noise


@jit
def ridge_points(
    gx: Singles,
    gy: Singles,
    gxx: Singles,
    gxy: Singles,
    gyy: Singles,
    noise: Singles,
    unit: float,
    scale: float,
    polarity: int,
    least: float,
    first: int,
    stop: int,
    points: Singles,
) -> None:
    """Keep the pixels that a ridge of the smoothed frame passes through, where it is stronger than what another scale found.

    C. Steger, IEEE Trans. PAMI 20(2), 113 (1998): the first derivative along the direction of greatest curvature vanishes within the
    pixel. ``unit``: standard deviation of the second derivative for white noise of 1. ``polarity``: 1 bright, −1 dark, 0 both.
    """
    weight = scale**1.5
    for r in range(first, stop):
        for c in range(gx.shape[1]):
            a, b, d = gxx[r, c], gxy[r, c], gyy[r, c]
            mean, spread = 0.5 * (a + d), math.sqrt(0.25 * (a - d) ** 2 + b * b)
            value = mean + spread if mean > 0.0 else mean - spread
            if (polarity > 0 and value > 0.0) or (polarity < 0 and value < 0.0):
                continue
            ratio = abs(value) / (unit * noise[r, c])
            if ratio < least or abs(value) * weight <= points[r, c, 4]:
                continue
            nx, ny = (b, value - a) if abs(value - a) > abs(value - d) else (value - d, b)
            size = math.hypot(nx, ny)
            if size == 0.0:
                nx, ny = 1.0, 0.0
            else:
                nx, ny = nx / size, ny / size
            t = -(gx[r, c] * nx + gy[r, c] * ny) / value
            if abs(t * nx) > 0.6 or abs(t * ny) > 0.6:
                continue
            points[r, c, 0], points[r, c, 1], points[r, c, 2] = ratio, t * nx, t * ny
            points[r, c, 3] = math.atan2(nx, -ny) if value < 0.0 else math.atan2(nx, -ny) + 4.0 * math.pi  # dark ones are told apart
            points[r, c, 4] = abs(value) * weight


@jit
def step_points(
    gx: Singles, gy: Singles, noise: Singles, unit: float, scale: float, least: float, first: int, stop: int, points: Singles
) -> None:
    """Keep the pixels at which the gradient is greatest along its own direction; the brighter side lies towards (−sin, cos)."""
    rows, cols = gx.shape
    weight = math.sqrt(scale)
    for r in range(max(first, 1), min(stop, rows - 1)):
        for c in range(1, cols - 1):
            size = math.hypot(gx[r, c], gy[r, c])
            ratio = size / (unit * noise[r, c])
            if ratio < least or size * weight <= points[r, c, 4]:
                continue
            nx, ny = gx[r, c] / size, gy[r, c] / size
            after, before = slope_at(gx, gy, c + nx, r + ny), slope_at(gx, gy, c - nx, r - ny)
            if after > size or before >= size:
                continue
            t = 0.5 * (after - before) / (2.0 * size - after - before)
            points[r, c, 0], points[r, c, 1], points[r, c, 2] = ratio, t * nx, t * ny
            points[r, c, 3] = math.atan2(-nx, ny)
            points[r, c, 4] = size * weight


@jit
def slope_at(gx: Singles, gy: Singles, x: float, y: float) -> float:
    """Size of the gradient between pixels."""
    c, r = min(int(x), gx.shape[1] - 2), min(int(y), gx.shape[0] - 2)
    f, g = x - c, y - r
    u = (1 - g) * ((1 - f) * gx[r, c] + f * gx[r, c + 1]) + g * ((1 - f) * gx[r + 1, c] + f * gx[r + 1, c + 1])
    v = (1 - g) * ((1 - f) * gy[r, c] + f * gy[r, c + 1]) + g * ((1 - f) * gy[r + 1, c] + f * gy[r + 1, c + 1])
    return math.hypot(u, v)


@jit
def turn_between(a: float, b: float, kind: int) -> float:
    """Angle between two directions; lines have no sense of direction, but a polarity; edges have one."""
    if kind == LINE:
        if (a > 6.0) != (b > 6.0):
            return 9.0
        d = (a - b) % math.pi
        return min(d, math.pi - d)
    d = (a - b) % (2.0 * math.pi)
    return min(d, 2.0 * math.pi - d)


@jit
def walk(points: Singles, used: Flags, kind: int, row: int, col: int, ahead: float, xs: Array, ys: Array, n: int) -> int:
    """Follow a chain from a point, along its direction or against it; return the number of points so far."""
    rows, cols = used.shape
    angle = points[row, col, 3]
    ux, uy = ahead * math.cos(angle), ahead * math.sin(angle)
    x, y = col + points[row, col, 1], row + points[row, col, 2]
    while n < len(xs):
        best, found_r, found_c = 1e9, -1, -1
        for r in range(max(0, row - HOP), min(rows, row + HOP + 1)):
            for c in range(max(0, col - HOP), min(cols, col + HOP + 1)):
                if points[r, c, 0] <= 0.0 or used[r, c]:
                    continue
                vx, vy = c + points[r, c, 1] - x, r + points[r, c, 2] - y
                forward = vx * ux + vy * uy
                if forward < 0.3:
                    continue
                aside = abs(vx * uy - vy * ux)
                turn = turn_between(points[r, c, 3], angle, kind)
                if aside > 0.5 + 0.35 * forward or turn > TURN:
                    continue
                cost = forward + 2.0 * aside + turn
                if cost < best:
                    best, found_r, found_c = cost, r, c
        if found_r < 0:
            return n
        row, col = found_r, found_c
        angle = points[row, col, 3]
        vx, vy = math.cos(angle), math.sin(angle)
        if vx * ux + vy * uy < 0.0:
            vx, vy = -vx, -vy
        ux, uy = 0.7 * ux + 0.3 * vx, 0.7 * uy + 0.3 * vy
        size = math.hypot(ux, uy)
        ux, uy = ux / size, uy / size
        x, y = col + points[row, col, 1], row + points[row, col, 2]
        xs[n], ys[n] = x, y
        n += 1
        take(points, used, kind, row, col)
    return n


@jit
def take(points: Singles, used: Flags, kind: int, row: int, col: int) -> None:
    """Mark a point, and neighbouring points of the same line."""
    rows, cols = used.shape
    for r in range(max(0, row - 1), min(rows, row + 2)):
        for c in range(max(0, col - 1), min(cols, col + 2)):
            if points[r, c, 0] > 0.0 and turn_between(points[r, c, 3], points[row, col, 3], kind) < TURN:
                used[r, c] = True
    used[row, col] = True


@jit
def chains(points: Singles, seeds: Ints, kind: int, least: int) -> tuple[Array, Array, Ints, Ints]:
    """Follow chains from seeds (indices into the frame, strongest first); return their points, where each starts, and their seeds."""
    rows, cols = points.shape[0], points.shape[1]
    used = np.zeros((rows, cols), np.bool_)
    room = 0
    for r in range(rows):
        for c in range(cols):
            room += points[r, c, 0] > 0.0
    x, y = np.empty(room), np.empty(room)
    start, origin = np.zeros(len(seeds) + 1, np.int64), np.empty(len(seeds), np.int64)
    ahead_x, ahead_y, back_x, back_y = np.empty(room), np.empty(room), np.empty(room), np.empty(room)
    count, filled = 0, 0
    for seed in seeds:
        row, col = seed // cols, seed % cols
        if used[row, col]:
            continue
        take(points, used, kind, row, col)
        a = walk(points, used, kind, row, col, 1.0, ahead_x, ahead_y, 0)
        b = walk(points, used, kind, row, col, -1.0, back_x, back_y, 0)
        if a + b + 1 < least:
            continue
        for i in range(b):
            x[filled], y[filled] = back_x[b - 1 - i], back_y[b - 1 - i]
            filled += 1
        x[filled], y[filled] = col + points[row, col, 1], row + points[row, col, 2]
        filled += 1
        for i in range(a):
            x[filled], y[filled] = ahead_x[i], ahead_y[i]
            filled += 1
        origin[count] = seed
        count += 1
        start[count] = filled
    return x[:filled], y[:filled], start[: count + 1], origin[:count]


@jit
def parabola(t: Array, d: Array, n: int, curved: bool, out: Array) -> None:
    """Fit d = a + b t + c t²/2 by least squares into ``out``; without c where not ``curved``."""
    out[:] = 0.0
    scale = max(abs(t[0]), abs(t[n - 1]), 1.0)
    s1, s2, s3, s4, r0, r1, r2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        u = t[i] / scale
        s1, s2, s3, s4 = s1 + u, s2 + u * u, s3 + u**3, s4 + u**4
        r0, r1, r2 = r0 + d[i], r1 + u * d[i], r2 + u * u * d[i]
    if not curved or n < 5:
        det = n * s2 - s1 * s1
        if det > 0.0:
            out[0], out[1] = (s2 * r0 - s1 * r1) / det, (n * r1 - s1 * r0) / (det * scale)
        return
    det = n * (s2 * s4 - s3 * s3) - s1 * (s1 * s4 - s3 * s2) + s2 * (s1 * s3 - s2 * s2)
    if abs(det) < 1e-12:
        return
    out[0] = (r0 * (s2 * s4 - s3 * s3) - s1 * (r1 * s4 - s3 * r2) + s2 * (r1 * s3 - s2 * r2)) / det
    out[1] = (n * (r1 * s4 - r2 * s3) - r0 * (s1 * s4 - s3 * s2) + s2 * (s1 * r2 - s2 * r1)) / (det * scale)
    out[2] = 2.0 * (n * (s2 * r2 - s3 * r1) - s1 * (s1 * r2 - s2 * r1) + r0 * (s1 * s3 - s2 * s2)) / (det * scale * scale)


@jit
def pieces(x: Array, y: Array, start: Ints, least: int, tolerance: float, most_turn: float, found: Array) -> int:
    """Cut chains into stretches that a parabola fits; return their number.

    Rows of ``found``: x, y, angle, curvature, least and greatest place along, chain.
    """
    count = 0
    first_of, last_of = np.empty(256, np.int64), np.empty(256, np.int64)
    fit = np.empty(3)
    for chain in range(len(start) - 1):
        depth = 1
        first_of[0], last_of[0] = start[chain], start[chain + 1]
        while depth > 0:
            depth -= 1
            a, b = first_of[depth], last_of[depth]
            n = b - a
            if n < least:
                continue
            x0, y0 = 0.5 * (x[a] + x[b - 1]), 0.5 * (y[a] + y[b - 1])
            length = math.hypot(x[b - 1] - x[a], y[b - 1] - y[a])
            if length < 1.0:
                continue
            c, s = (x[b - 1] - x[a]) / length, (y[b - 1] - y[a]) / length
            t, d = np.empty(n), np.empty(n)
            for i in range(n):
                t[i], d[i] = c * (x[a + i] - x0) + s * (y[a + i] - y0), c * (y[a + i] - y0) - s * (x[a + i] - x0)
            parabola(t, d, n, length >= 30.0, fit)
            worst, bulge, where = 0.0, -1.0, n // 2
            for i in range(n):
                worst = max(worst, abs(d[i] - fit[0] - fit[1] * t[i] - 0.5 * fit[2] * t[i] * t[i]))
                if abs(d[i]) > bulge and least // 2 <= i < n - least // 2:
                    bulge, where = abs(d[i]), i
            if worst > tolerance or abs(fit[2]) * length > most_turn:
                if depth < 250 and worst > tolerance:
                    first_of[depth], last_of[depth] = a, a + where
                    first_of[depth + 1], last_of[depth + 1] = a + where, b
                    depth += 2
                continue
            if count == len(found):
                return count
            found[count, 0], found[count, 1] = x0 - s * fit[0], y0 + c * fit[0]
            found[count, 2], found[count, 3] = math.atan2(s, c) + fit[1], fit[2]
            found[count, 4], found[count, 5], found[count, 6] = t[0], t[n - 1], chain
            count += 1
    return count


@jit
def grey(frame: np.ndarray, x: float, y: float) -> float:
    """Grey value between pixels (bilinear); NaN outside the frame."""
    rows, cols = frame.shape
    if not (-0.5 <= x <= cols - 0.5 and -0.5 <= y <= rows - 0.5):
        return np.nan
    x, y = min(max(x, 0.0), cols - 1.0), min(max(y, 0.0), rows - 1.0)
    c, r = min(int(x), max(cols - 2, 0)), min(int(y), max(rows - 2, 0))
    f, g = x - c, y - r
    c2, r2 = min(c + 1, cols - 1), min(r + 1, rows - 1)
    value: float = (1 - g) * ((1 - f) * frame[r, c] + f * frame[r, c2]) + g * ((1 - f) * frame[r2, c] + f * frame[r2, c2])
    return value


@jit
def section_of(frame: np.ndarray, state: Array, reach: float, total: Array, hits: Array) -> None:
    """Average the grey values across a line, at `SAMPLES` places from −reach to reach, over its length."""
    total[:] = 0.0
    hits[:] = 0.0
    c, s = math.cos(state[2]), math.sin(state[2])
    every = max(1.0, (state[5] - state[4]) / 200.0)
    t = state[4] + 1.0
    while t < state[5] - 0.5:
        sag = 0.5 * state[3] * t * t
        for k in range(SAMPLES):
            d = sag + reach * (2.0 * k / (SAMPLES - 1) - 1.0)
            value = grey(frame, state[0] + c * t - s * d, state[1] + s * t + c * d)
            if value == value:
                total[k] += value
                hits[k] += 1.0
        t += every
    for k in range(SAMPLES):
        total[k] = total[k] / hits[k] if hits[k] > 0.0 else np.nan


@jit
def width_at(total: Array, peak: float, base: float, share: float, step: float) -> float:
    """Width of a section at a share of its height, about its middle; ``step`` is the distance of its samples."""
    middle, level = SAMPLES // 2, base + share * (peak - base)
    up = 1.0 if peak > base else -1.0
    wide = 0.0
    for side in (-1, 1):
        k = middle
        while 0 < k < SAMPLES - 1 and up * (total[k] - level) > 0.0:
            k += side
        inner, outer = total[k - side], total[k]
        if k == middle or not up * (outer - level) <= 0.0:
            wide += step * abs(k - middle)
        else:
            wide += step * (abs(k - side - middle) + (inner - level) / (inner - outer))
    return wide


@jit
def describe(frame: np.ndarray, kind: int, state: Array, scale: float, total: Array, hits: Array) -> None:
    """Measure background, amplitude, blur and width of a line or edge from its mean section."""
    middle = SAMPLES // 2
    reach = (4.0 if kind == LINE else 4.5) * scale + 2.0
    for turn in range(3):
        section_of(frame, state, reach, total, hits)
        step = 2.0 * reach / (SAMPLES - 1)
        if kind == LINE:
            left, right = 0.5 * (total[0] + total[1]), 0.5 * (total[SAMPLES - 1] + total[SAMPLES - 2])
            peak = total[middle]
            base = left if right != right or abs(left - peak) < abs(right - peak) else right  # one side may reach another line
            if (left - peak) * (right - peak) < 0.0:  # a slope, no line
                state[7] = np.nan
                return
            half, top = width_at(total, peak, base, 0.5, step), width_at(total, peak, base, 0.8, step)
            foot = width_at(total, peak, base, 0.2, step)
            state[6], state[7] = base, peak - base
            if top > 0.72 * half:  # a flat top
                state[9] = half
                blur = max(0.5 * (foot - top) / 1.683, 0.2)
            else:
                state[9] = 0.0
                blur = half / 2.355
                state[7] *= math.hypot(1.0, 0.2887 / max(blur, 0.5))
            state[8] = math.sqrt(max(blur * blur - 1.0 / 12.0, 0.04))
            if half < 1.1 * reach or turn == 2:  # the whole line is in sight
                break
            reach *= 1.8
        else:
            first, last = middle, middle  # the grey value rises from first to last
            while first > 0 and total[first - 1] < total[first]:
                first -= 1
            while last < SAMPLES - 1 and total[last + 1] > total[last]:
                last += 1
            low, high = total[first], total[last]
            state[6], state[7], state[9] = low, high - low, 0.0
            steepest = 0.0
            for k in range(first, last):
                steepest = max(steepest, total[k + 1] - total[k])
            blur = abs(high - low) / max(steepest / step, 1e-9) * 0.3989
            state[8] = math.sqrt(max(min(blur, 0.5 * reach) ** 2 - 1.0 / 12.0 - step * step / 12.0, 0.04))
            break


@jit
def follow(frame: np.ndarray, kind: int, state: Array, most_turn: float) -> bool:
    """Follow a line or edge in both directions to its ends, and fit it again to its points, in place; False if it is not a line."""
    rows, cols = frame.shape
    room = int(2 * math.hypot(rows, cols)) + 64
    strong, middle, aside, smooth = np.empty(room), np.empty(room), np.empty(room), np.empty(room)
    ts, ds = np.empty(room), np.empty(room)
    fit = np.empty(3)
    for _ in range(12):
        length = state[5] - state[4]
        first, last = int(state[4] - max(12.0, 0.5 * length)), int(state[5] + max(12.0, 0.5 * length))
        n = min(last - first + 1, room)
        sample(frame, kind, state, first, n, strong, middle, aside)
        amplitude = abs(state[7])
        half = 1 if n > 0 and amplitude > 6.0 * state[10] else 3
        for i in range(n):
            total, count = 0.0, 0
            for j in range(max(0, i - half), min(n, i + half + 1)):
                if strong[j] == strong[j]:
                    total += strong[j]
                    count += 1
            smooth[i] = total / count if count > 0 and strong[i] == strong[i] else np.nan
        low = reach_of(smooth, middle, n, -first, -1, amplitude, kind)
        high = reach_of(smooth, middle, n, -first, 1, amplitude, kind)
        if high - low < 4:
            return False
        m = 0
        for i in range(low, high + 1):
            if smooth[i] > 0.5 * amplitude and abs(aside[i]) < 1.0 + state[8] + 0.25 * state[9]:
                ts[m], ds[m] = first + i, aside[i]
                m += 1
        if m < 5:
            return False
        parabola(ts, ds, m, high - low >= 40, fit)
        c, s = math.cos(state[2]), math.sin(state[2])
        state[0], state[1] = state[0] - s * fit[0], state[1] + c * fit[0]
        state[2] += fit[1]
        state[3] = state[3] + fit[2] if high - low >= 40 else 0.0
        if abs(state[3]) * (high - low) > most_turn:
            return False
        grown = abs(first + low - state[4]) + abs(first + high - state[5])
        state[4], state[5] = first + low, first + high
        middle_t = 0.5 * (state[4] + state[5])
        c, s = math.cos(state[2]), math.sin(state[2])
        sag = 0.5 * state[3] * middle_t * middle_t
        state[0], state[1] = state[0] + c * middle_t - s * sag, state[1] + s * middle_t + c * sag
        state[2] += state[3] * middle_t
        state[4], state[5] = state[4] - middle_t, state[5] - middle_t
        if grown < 2.5:
            break
    return True


@jit
def sample(frame: np.ndarray, kind: int, state: Array, first: int, n: int, strong: Array, middle: Array, aside: Array) -> None:
    """Sample a line every pixel along it: how it stands out, how its middle does, and its distance from where it was laid."""
    sign = 1.0 if state[7] > 0.0 else -1.0
    blur = math.hypot(state[8], 0.2887)
    c0, s0 = math.cos(state[2]), math.sin(state[2])
    core = 0.5 * state[9] + 2.5 * blur + 0.5
    flank = 0.5 * state[9] + 3.0 * blur + 1.0 if kind == LINE else 1.3 * blur + 0.5
    for i in range(n):
        t = 1.0 * (first + i)
        sag = 0.5 * state[3] * t * t
        x, y = state[0] + c0 * t - s0 * sag, state[1] + s0 * t + c0 * sag
        left, right = grey(frame, x + s0 * flank, y - c0 * flank), grey(frame, x - s0 * flank, y + c0 * flank)
        here = grey(frame, x, y)
        strong[i], middle[i], aside[i] = np.nan, np.nan, np.nan
        if here != here:
            continue
        left, right = (right if left != left else left), (left if right != right else right)
        total, moment = 0.0, 0.0
        if kind == LINE:
            middle[i] = sign * (here - state[6])
            strong[i] = min(sign * (here - left), sign * (here - right))
            for k in range(-8, 9):
                d = core * k / 8.0
                value = grey(frame, x - s0 * d, y + c0 * d)
                if value == value:
                    w = max(sign * (value - state[6]) - 0.3 * abs(state[7]), 0.0)
                    total += w
                    moment += w * d
        else:
            strong[i] = sign * (right - left)
            middle[i] = strong[i]
            for k in range(-8, 8):
                d, e = core * k / 8.0, core * (k + 1) / 8.0
                a, b = grey(frame, x - s0 * d, y + c0 * d), grey(frame, x - s0 * e, y + c0 * e)
                if a == a and b == b:
                    w = max(sign * (b - a), 0.0)
                    total += w
                    moment += w * 0.5 * (d + e)
        if total > 0.0:
            aside[i] = moment / total


@jit
def reach_of(smooth: Array, middle: Array, n: int, begin: int, ahead: int, amplitude: float, kind: int) -> int:
    """Return the last sample from the middle on that belongs to the line; a few that fail, or a crossing, are passed over."""
    i = min(max(begin, 0), n - 1)
    last, failed, crossing = i, 0, 0
    while 0 <= i < n and smooth[i] == smooth[i]:
        if smooth[i] > 0.5 * amplitude:
            last, failed, crossing = i, 0, 0
        elif kind == LINE and middle[i] > 0.5 * amplitude and crossing < CROSSING:
            crossing += 1  # another line passes here
        else:
            failed += 1
            if failed > GAP:
                break
        i += ahead
    return last


@jit
def good_share(frame: np.ndarray, kind: int, state: Array) -> float:
    """Return the share of samples along a line with the height of the line; samples with another line do not count."""
    n = int(state[5] - state[4]) + 1
    strong, middle, aside = np.empty(n), np.empty(n), np.empty(n)
    sample(frame, kind, state, int(math.ceil(state[4])), n, strong, middle, aside)
    good, bad = 0, 0
    amplitude = abs(state[7])
    for i in range(2, n - 2):
        mean, between = 0.0, 0.0
        for j in range(i - 2, i + 3):
            mean, between = mean + 0.2 * strong[j], between + 0.2 * middle[j]
        if mean > 0.4 * amplitude:
            good += 1
        elif not (kind == LINE and between > 0.5 * amplitude) and mean == mean:
            bad += 1
    return good / max(good + bad, 1)


@jit
def strength(frame: np.ndarray, kind: int, state: Array) -> float:
    """Return the amplitude that a least-squares fit of the line's section and a background gives, over its standard deviation."""
    c, s = math.cos(state[2]), math.sin(state[2])
    a, b = max(abs(c), abs(s)), min(abs(c), abs(s))
    blur = math.hypot(state[8], 0.2887)
    reach = 0.5 * state[9] + 3.0 * blur + 1.0 if kind == LINE else 2.0 * blur + 1.5
    section = EDGE if kind == STEP else BAR if state[9] > 0.0 else GAUSSIAN
    length = state[5] - state[4]
    room = int((2.0 * reach + 2.0) * (length + 2.0) * 1.5 + 8.0 * (reach + length)) + 64
    x, y, value = np.empty(room), np.empty(room), np.empty(room)
    place = np.array([state[0], state[1], state[2], state[4], state[5], state[3]])
    alone = Lines(np.zeros((1, 6)), np.zeros(1), np.zeros(2, np.int64), np.zeros(0, np.int64))
    n, _ = gather(frame, place, reach, 0, alone, (-math.inf, math.inf), Pixels(x, y, value))
    sums = np.zeros(4)
    for i in range(n):
        t = c * x[i] + s * y[i]
        p = profile(section, c * y[i] - s * x[i] - 0.5 * state[3] * t * t, state[8], max(state[9], 0.1), a, b)[0]
        sums[0] += p
        sums[1] += p * p
        sums[2] += value[i] - state[6]
        sums[3] += p * (value[i] - state[6])
    if n < 9:
        return 0.0
    energy = sums[1] - sums[0] * sums[0] / n
    found: float = (sums[3] - sums[0] * sums[2] / n) / math.sqrt(max(energy, 1e-12)) / max(state[10], 1e-9)
    return found


@jit
def refine(frame: np.ndarray, kind: int, states: Array, scales: Array, first: int, stop: int, most_turn: float, strengths: Array) -> None:
    """Describe and follow lines or edges; ``strengths``: their amplitudes over their standard deviations, 0 if it is not a line."""
    total, hits = np.empty(SAMPLES), np.empty(SAMPLES)
    for i in range(first, stop):
        describe(frame, kind, states[i], scales[i], total, hits)
        if math.isfinite(states[i, 7]) and states[i, 7] != 0.0 and follow(frame, kind, states[i], most_turn):
            describe(frame, kind, states[i], scales[i], total, hits)
            if math.isfinite(states[i, 7]) and good_share(frame, kind, states[i]) > LEAST_SHARE:
                found = strength(frame, kind, states[i])
                strengths[i] = abs(found) if found * states[i, 7] > 0.0 else 0.0
