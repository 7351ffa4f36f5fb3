"""Kernels of contours: how much of a blurred shape a box sees, as an integral along the shape's outline.

The box and the Gaussian make a weight that is a product, k_w(x) k_h(y). With F the integral of k_w, Green's theorem turns the weight's
integral over the shape into ∮ F(x − x0) k_h(y − y0) dy along its outline: exact for every shape, blur and size of the box, at the cost of
a short integral over the few pieces of the outline that pass near the box. What passes to the right of it is known in closed form.

A segment is a row of ``SEGMENT`` numbers: kind (0 straight, 1 elliptic arc), cx, cy, ux, uy, vx, vy, t1, t2, and its ends x1, y1, x2, y2.
A point of it is c + u t, or c + u cos t + v sin t; along it, x and y rise or fall throughout.
"""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core._normal_kernels import bowl, cdf, pdf, ramp
from pixmetry.core.arrays import Array, Flags, Ints
from pixmetry.core.jit import jit

SEGMENT = 13
REACH = 5.0  # standard deviations of the blur beyond which it is taken as 0 (2.9e-7 of the height)
THIN = 0.005  # a box narrower than this share of the blur is a point (error 1e-6)
PANEL = 2.5  # standard deviations of blur along the outline for one panel of five nodes
MOST_PANELS = 16
NODES = np.array([0.04691007703066802, 0.23076534494715845, 0.5, 0.7692346550528415, 0.953089922969332])  # Gauss–Legendre on (0, 1)
WEIGHTS = np.array([0.11846344252809454, 0.23931433524968324, 0.28444444444444444, 0.23931433524968324, 0.11846344252809454])
STEPS = np.array([-5.0, -2.5, 0.0, 2.5, 5.0])  # break points about a side of the box, in standard deviations


@jit
def weight(d: float, w: float, s: float) -> float:
    """Weight at a distance d from the middle of a box of width w, blurred by s: k_w(d)."""
    if w < THIN * s:
        return pdf(d / s) / s
    return (cdf((d + 0.5 * w) / s) - cdf((d - 0.5 * w) / s)) / w


@jit
def share(d: float, w: float, s: float) -> float:
    """Share of the weight below d: F(d) = ∫ k_w."""
    if w < THIN * s:
        return cdf(d / s)
    return (ramp((d + 0.5 * w) / s) - ramp((d - 0.5 * w) / s)) * (s / w)


@jit
def moment(d: float, w: float, s: float) -> float:
    """First moment of the weight below d: ∫ u k_w(u) du."""
    if w < THIN * s:
        return -s * pdf(d / s)
    return d * share(d, w, s) - (bowl((d + 0.5 * w) / s) - bowl((d - 0.5 * w) / s)) * (s * s / w)


@jit
def place(seg: Array, axis: int, t: float) -> float:
    """Coordinate of a point of a segment."""
    if seg[0] == 0.0:
        return float(seg[1 + axis] + seg[3 + axis] * t)
    return float(seg[1 + axis] + seg[3 + axis] * math.cos(t) + seg[5 + axis] * math.sin(t))


@jit
def when(seg: Array, axis: int, value: float) -> float:
    """Parameter at which a segment has this coordinate, kept within its ends."""
    low, high = float(min(seg[7], seg[8])), float(max(seg[7], seg[8]))
    if seg[0] == 0.0:
        if seg[3 + axis] == 0.0:
            return low
        t = (value - seg[1 + axis]) / seg[3 + axis]
    else:
        u, v = seg[3 + axis], seg[5 + axis]
        turn, half = math.atan2(v, u), math.acos(min(1.0, max(-1.0, (value - seg[1 + axis]) / math.hypot(u, v))))
        middle = 0.5 * (low + high)
        a = (turn + half - middle + math.pi) % (2 * math.pi) - math.pi
        b = (turn - half - middle + math.pi) % (2 * math.pi) - math.pi
        t = middle + (a if abs(a) < abs(b) else b)
    return float(min(high, max(low, t)))


@jit
def panel(seg: Array, ta: float, tb: float, x0: float, y0: float, w: float, h: float, s: float, lit: bool, sums: Array) -> None:
    """Add ∫ F k dy over a panel to ``sums[0]``; where ``lit``, the same with the weights (x − x0) and (y − y0) to the other two."""
    length = tb - ta
    for j in range(5):
        t = ta + NODES[j] * length
        if seg[0] == 0.0:
            x, y, dy = seg[1] + seg[3] * t, seg[2] + seg[4] * t, seg[4]
        else:
            c, n = math.cos(t), math.sin(t)
            x, y, dy = seg[1] + seg[3] * c + seg[5] * n, seg[2] + seg[4] * c + seg[6] * n, seg[6] * c - seg[4] * n
        k = WEIGHTS[j] * length * dy * weight(y - y0, h, s)
        if k != 0.0:
            f = k * share(x - x0, w, s)
            sums[0] += f
            if lit:
                sums[1] += k * moment(x - x0, w, s)
                sums[2] += f * (y - y0)


@jit
def beyond(seg: Array, ta: float, tb: float, y0: float, h: float, s: float, lit: bool, sums: Array) -> None:
    """Add what passes to the right of the box. At the reach all is seen, so that an inside is 1 and an outside 0."""
    reach = 0.5 * h + REACH * s
    limit = reach * (1.0 - 1e-9)
    ya, yb = place(seg, 1, ta) - y0, place(seg, 1, tb) - y0
    above = 1.0 if yb >= limit else (0.0 if yb <= -limit else share(yb, h, s))
    below = 1.0 if ya >= limit else (0.0 if ya <= -limit else share(ya, h, s))
    sums[0] += above - below
    if lit:
        sums[2] += moment(min(reach, max(-reach, yb)), h, s) - moment(min(reach, max(-reach, ya)), h, s)


@jit
def along(seg: Array, x0: float, y0: float, w: float, h: float, s: float, lit: bool, sums: Array, breaks: Array) -> None:
    """Add a segment's part of the outline integral for the box at (x0, y0)."""
    reach = 0.5 * h + REACH * s
    y1, y2 = seg[10] - y0, seg[12] - y0
    if (y1 <= -reach and y2 <= -reach) or (y1 >= reach and y2 >= reach) or y1 == y2 and seg[0] == 0.0:
        return
    left, right = x0 - 0.5 * w - REACH * s, x0 + 0.5 * w + REACH * s
    x1, x2 = seg[9], seg[11]
    if x1 <= left and x2 <= left:
        return
    ta, tb = seg[7], seg[8]
    if x1 >= right and x2 >= right:
        beyond(seg, ta, tb, y0, h, s, lit, sums)
        return
    if abs(y1) > reach:
        ta = when(seg, 1, y0 + math.copysign(reach, y1))
        x1 = place(seg, 0, ta)
    if abs(y2) > reach:
        tb = when(seg, 1, y0 + math.copysign(reach, y2))
        x2 = place(seg, 0, tb)
    if x1 <= left and x2 <= left:
        return
    if x1 >= right and x2 >= right:
        beyond(seg, ta, tb, y0, h, s, lit, sums)
        return
    if x1 < left:
        ta = when(seg, 0, left)
    elif x1 > right:
        cut = when(seg, 0, right)
        beyond(seg, ta, cut, y0, h, s, lit, sums)
        ta = cut
    if x2 < left:
        tb = when(seg, 0, left)
    elif x2 > right:
        cut = when(seg, 0, right)
        beyond(seg, cut, tb, y0, h, s, lit, sums)
        tb = cut
    between(seg, ta, tb, x0, y0, w, h, s, lit, sums, breaks)


@jit
def between(
    seg: Array, ta: float, tb: float, x0: float, y0: float, w: float, h: float, s: float, lit: bool, sums: Array, breaks: Array
) -> None:
    """Integrate the piece of a segment near the box: panels of equal length, or broken at the sides of the box where the blur is small."""
    size = math.hypot(seg[3], seg[4])
    if seg[0] == 1.0:
        size = max(size, math.hypot(seg[5], seg[6]))
    panels = abs(tb - ta) * size / (PANEL * s)
    if panels <= MOST_PANELS:
        count = max(1, int(math.ceil(panels)))
        for j in range(count):
            panel(seg, ta + (tb - ta) * j / count, ta + (tb - ta) * (j + 1) / count, x0, y0, w, h, s, lit, sums)
        return
    low, high = min(ta, tb), max(ta, tb)
    count = 0
    for axis in range(2):
        middle, half = (x0, 0.5 * w) if axis == 0 else (y0, 0.5 * h)
        for side in (-half, half):
            for step in STEPS:
                t = when(seg, axis, middle + side + step * s)
                if low < t < high:
                    j = count
                    while j > 0 and breaks[j - 1] > t:
                        breaks[j] = breaks[j - 1]
                        j -= 1
                    breaks[j] = t
                    count += 1
    before, sign = low, 1.0 if tb > ta else -1.0
    for j in range(count + 1):
        after = breaks[j] if j < count else high
        if after > before:
            if sign > 0:
                panel(seg, before, after, x0, y0, w, h, s, lit, sums)
            else:
                panel(seg, after, before, x0, y0, w, h, s, lit, sums)
        before = after


@jit
def around(oval: Array, count: int, x0: float, y0: float, w: float, h: float, s: float, lit: bool, sums: Array) -> None:
    """The outline integral over a whole ellipse c + u cos t + v sin t by ``count`` equal steps, which converge exponentially."""
    step = 2 * math.pi / count
    cd, sd = math.cos(step), math.sin(step)
    c, n = 1.0, 0.0
    for _ in range(count):
        y = oval[1] + oval[3] * c + oval[5] * n - y0
        k = step * (oval[5] * c - oval[3] * n) * weight(y, h, s)
        if k != 0.0:
            x = oval[0] + oval[2] * c + oval[4] * n - x0
            f = k * share(x, w, s)
            sums[0] += f
            if lit:
                sums[1] += k * moment(x, w, s)
                sums[2] += f * y
        c, n = c * cd - n * sd, n * cd + c * sd


@jit
def add_oval(
    out: Array,
    oval: Array,
    count: int,
    height: float,
    row0: int,
    col0: int,
    dx: float,
    dy: float,
    r1: int,
    r2: int,
    c1: int,
    c2: int,
    s: float,
) -> None:
    """Add an ellipse to pixels (r1 … r2, c1 … c2) of a window; a weight is the product of one of the row and one of the column."""
    across = np.empty((2, count, c2 - c1 + 1))
    down = np.empty((count, 2))
    lit = out.shape[0] > 1
    step = 2 * math.pi / count
    cd, sd = math.cos(step), math.sin(step)
    c, n = 1.0, 0.0
    for j in range(count):
        x = oval[0] + oval[2] * c + oval[4] * n
        down[j, 0] = oval[1] + oval[3] * c + oval[5] * n
        down[j, 1] = step * (oval[5] * c - oval[3] * n) * height
        for col in range(c1, c2 + 1):
            d = x - (float(col0 + col) - dx)
            across[0, j, col - c1] = share(d, 1.0, s)
            if lit:
                across[1, j, col - c1] = moment(d, 1.0, s)
        c, n = c * cd - n * sd, n * cd + c * sd
    for r in range(r1, r2 + 1):
        y0 = float(row0 + r) - dy
        for j in range(count):
            d = down[j, 0] - y0
            k = down[j, 1] * weight(d, 1.0, s)
            if k == 0.0:
                continue
            for col in range(c1, c2 + 1):
                f = k * across[0, j, col - c1]
                out[0, r, col] += f
                if lit:
                    out[1, r, col] += k * across[1, j, col - c1]
                    out[2, r, col] += f * d


@jit
def extent(segments: Array, first: int, last: int, y0: float, reach: float) -> tuple[float, float]:
    """Least and greatest x of an outline within ``reach`` of a row."""
    low, high = math.inf, -math.inf
    for j in range(first, last):
        seg = segments[j]
        ya, yb = seg[10] - y0, seg[12] - y0
        if (ya < -reach and yb < -reach) or (ya > reach and yb > reach):
            continue
        xa, xb = seg[9], seg[11]
        if seg[0] == 0.0:
            if abs(ya) > reach:
                xa = place(seg, 0, when(seg, 1, y0 + math.copysign(reach, ya)))
            if abs(yb) > reach:
                xb = place(seg, 0, when(seg, 1, y0 + math.copysign(reach, yb)))
        low, high = min(low, xa, xb), max(high, xa, xb)
    return low, high


@jit
def add_shapes(
    out: Array,
    row0: Ints,
    col0: Ints,
    dx: Array,
    dy: Array,
    segments: Array,
    start: Ints,
    height: Array,
    box: Array,
    oval: Array,
    count: Ints,
    s: float,
) -> None:
    """Add shapes to full pixels of windows: ``out`` has shape (n, 1, rows, cols), or (n, 3, …) with the first moments along x and y.

    Shape k has the segments ``start[k]`` to ``start[k + 1]``, the height ``height[k]`` and lies within ``box[k]``; where ``count[k]`` is
    not 0 it is the ellipse ``oval[k]``. The shapes of window i are displaced by ``dx[i], dy[i]``.
    """
    rows, cols = out.shape[2], out.shape[3]
    lit = out.shape[1] > 1
    reach = 0.5 + REACH * s
    sums, breaks = np.zeros(3), np.empty(20)
    for i in range(len(row0)):
        top, left = float(row0[i]) - dy[i], float(col0[i]) - dx[i]
        for k in range(len(height)):
            if box[k, 0] - reach > left + cols or box[k, 2] + reach < left or box[k, 1] - reach > top + rows or box[k, 3] + reach < top:
                continue
            r1 = max(0, int(math.floor(box[k, 1] - reach - top)))
            r2 = min(rows - 1, int(math.ceil(box[k, 3] + reach - top)))
            c1 = max(0, int(math.floor(box[k, 0] - reach - left)))
            c2 = min(cols - 1, int(math.ceil(box[k, 2] + reach - left)))
            if count[k] > 0:
                add_oval(out[i], oval[k], count[k], height[k], row0[i], col0[i], dx[i], dy[i], r1, r2, c1, c2, s)
                continue
            for r in range(r1, r2 + 1):
                y0 = float(row0[i] + r) - dy[i]
                low, high = extent(segments, start[k], start[k + 1], y0, reach)
                for c in range(max(c1, int(math.floor(max(low - reach - left, -1.0)))), c2 + 1):
                    x0 = float(col0[i] + c) - dx[i]
                    if x0 < low - reach:
                        continue
                    if x0 > high + reach:
                        break
                    sums[:] = 0.0
                    for j in range(start[k], start[k + 1]):
                        along(segments[j], x0, y0, 1.0, 1.0, s, lit, sums, breaks)
                    out[i, 0, r, c] += height[k] * sums[0]
                    if lit:
                        out[i, 1, r, c] += height[k] * sums[1]
                        out[i, 2, r, c] += height[k] * sums[2]


@jit
def bins(x: Array, y: Array, box: Array, reach: float, side: float) -> tuple[float, float, int, Ints, Ints]:
    """Sort boxes, widened by ``reach``, into square bins over the points: corner, bins along x, first entry of each bin, entries."""
    x0, y0 = x.min(), y.min()
    nx, ny = int((x.max() - x0) / side) + 1, int((y.max() - y0) / side) + 1
    first = np.zeros(nx * ny + 1, np.int64)
    entries = np.zeros(0, np.int64)
    fill = first
    for turn in range(2):
        for k in range(len(box)):
            xa = max(0.0, math.floor((box[k, 0] - reach - x0) / side))
            xb = min(nx - 1.0, math.floor((box[k, 2] + reach - x0) / side))
            ya = max(0.0, math.floor((box[k, 1] - reach - y0) / side))
            yb = min(ny - 1.0, math.floor((box[k, 3] + reach - y0) / side))
            if xa > xb or ya > yb:
                continue
            for b in range(int(ya), int(yb) + 1):
                for a in range(int(xa), int(xb) + 1):
                    if turn == 0:
                        first[b * nx + a + 1] += 1
                    else:
                        entries[fill[b * nx + a]] = k
                        fill[b * nx + a] += 1
        if turn == 0:
            first = np.cumsum(first)
            entries = np.zeros(first[-1], np.int64)
            fill = first.copy()
    return x0, y0, nx, first, entries


@jit
def at_points(
    out: Array,
    x: Array,
    y: Array,
    w: Array,
    h: Array,
    side: float,
    segments: Array,
    start: Ints,
    height: Array,
    box: Array,
    oval: Array,
    count: Ints,
    s: float,
) -> None:
    """Light of shapes averaged over a box of size w × h about each point (0: the point); ``out`` has shape (1 or 3, points)."""
    if len(x) == 0 or len(height) == 0:
        return
    widest = 0.5 * max(w.max(), h.max()) + REACH * s
    bx, by, nx, first, entries = bins(x, y, box, widest, side)
    lit = out.shape[0] > 1
    sums, breaks = np.zeros(3), np.empty(20)
    for i in range(len(x)):
        bin = int((y[i] - by) / side) * nx + int((x[i] - bx) / side)
        rx, ry = 0.5 * w[i] + REACH * s, 0.5 * h[i] + REACH * s
        for e in range(first[bin], first[bin + 1]):
            k = entries[e]
            if x[i] < box[k, 0] - rx or x[i] > box[k, 2] + rx or y[i] < box[k, 1] - ry or y[i] > box[k, 3] + ry:
                continue
            sums[:] = 0.0
            if count[k] > 0:
                around(oval[k], count[k], x[i], y[i], w[i], h[i], s, lit, sums)
            else:
                for j in range(start[k], start[k + 1]):
                    along(segments[j], x[i], y[i], w[i], h[i], s, lit, sums, breaks)
            for m in range(out.shape[0]):
                out[m, i] += height[k] * sums[m]


@jit
def outline_near(out: Flags, x: Array, y: Array, reach: Array, side: float, segments: Array, start: Ints, box: Array) -> None:
    """Mark the points that may have an outline within ``reach``."""
    if len(x) == 0 or len(box) == 0:
        return
    bx, by, nx, first, entries = bins(x, y, box, reach.max(), side)
    for i in range(len(x)):
        bin = int((y[i] - by) / side) * nx + int((x[i] - bx) / side)
        d = reach[i]
        for e in range(first[bin], first[bin + 1]):
            k = entries[e]
            if x[i] < box[k, 0] - d or x[i] > box[k, 2] + d or y[i] < box[k, 1] - d or y[i] > box[k, 3] + d:
                continue
            for j in range(start[k], start[k + 1]):
                if close(segments[j], x[i], y[i], d):
                    out[i] = True
                    break
            if out[i]:
                break


@jit
def close(seg: Array, x: float, y: float, reach: float) -> bool:
    """Whether a segment may pass within ``reach`` of a point."""
    if max(seg[9], seg[11]) < x - reach or min(seg[9], seg[11]) > x + reach:
        return False
    if max(seg[10], seg[12]) < y - reach or min(seg[10], seg[12]) > y + reach:
        return False
    px, py = x - seg[1], y - seg[2]
    cross = seg[3] * seg[6] - seg[4] * seg[5]
    if seg[0] == 0.0:
        return bool(abs(px * seg[4] - py * seg[3]) <= reach * math.hypot(seg[3], seg[4]))
    # distance from an ellipse is at least |ρ − 1| times its smaller half axis, ρ being the radius where it is the unit circle
    a, b = (px * seg[6] - py * seg[5]) / cross, (py * seg[3] - px * seg[4]) / cross
    total = seg[3] ** 2 + seg[4] ** 2 + seg[5] ** 2 + seg[6] ** 2
    smaller = math.sqrt(max(0.0, 0.5 * (total - math.sqrt(max(0.0, total * total - 4.0 * cross * cross)))))
    return abs(math.hypot(a, b) - 1.0) * smaller <= reach
