"""Kernels of templates: what the pixels of a window see of a blurred shape, and how that changes with every parameter.

The box of a pixel and the Gaussian of the lens make a weight g(x) g(y). By Green's theorem the integral of the weight over a shape, and of
its derivative with respect to any parameter θ of the outline (u, v), is an integral along the outline,

    F(x, y) = −∮ g(u − x) G(v − y) du,      ∂F/∂θ = ∮ (∂u/∂θ dv − ∂v/∂θ du) g(u − x) g(v − y),

with G the integral of g. On a smooth closed outline equal steps converge exponentially, so that a few points of it, each of which reaches
a few rows and columns, give F and all its derivatives exactly. The blur follows from the heat equation, ∂F/∂σ = σ ∇²F.

Points are drawn in single precision, which is better than the tables.

Images of a shape: 0 is F, 1 and 2 its derivatives by the centre's x and y, then those by the parameters of the outline and by the blur;
where light that falls off over the shape is asked for, two more hold its first moments about the pixel (`draw`) or the centre.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pixmetry.core._normal_kernels import both, cdf, pdf
from pixmetry.core.arrays import Array, Ints, Singles
from pixmetry.core.jit import jit

DISC, ELLIPSE, RING, SPOT = 0, 1, 2, 3
SHAPES = np.array([1, 3, 2, 0])  # parameters of the outline
REACH = 4.25  # standard deviations of the blur beyond which it is taken as 0 (1.1e-5 of the height of an edge)
STEP = 1.3  # standard deviations of the blur between points of the outline: what is left is 2 exp(−2π²/STEP²) = 2e-5
LEAST_POINTS = 16
PAD = 4  # columns to either side of a window that may be drawn to
PHASES = 5.0  # entries of a table per standard deviation: cubic interpolation of g is good to 6e-6
THIN = 0.005  # a box narrower than this share of the blur is a point (error 1e-6)
FUSED = {"fastmath": {"contract"}}


class Canvas(NamedTuple):
    """What a shape is drawn on, and what is looked up for it."""

    planes: Singles  # shape (rows, (`PAD` + columns + `PAD`) · 8): F, x, y, outline …, blur of a pixel side by side
    points: Array  # shape (at least points + 1, 7): those of an outline, see `outline`; after them its centre
    table: Singles  # see `fill_table`
    across: Singles  # shape (blocks, 40): a point's g and its kin along the row
    down: Singles  # and along the column
    parts: Singles  # shape (3, 64): what a point adds to eight pixels, times g, g' and the fall of G


@jit
def reach_px(blur: float, aperture: float) -> int:
    """Whole pixels to either side that a point of the outline reaches."""
    return int(math.ceil(0.5 * aperture + REACH * blur))


@jit
def block_count(half: int) -> int:
    """Blocks of eight offsets that a reach takes."""
    return (2 * half + 7) // 8


@jit
def fill_table(table: Singles, phases: int, half: int, blur: float, aperture: float) -> None:
    """Fill G, g, g', g'', the first moment m of g below z, and m' = z g at z = phase − offset, offset −half + 1, −half + 2, ….

    ``table`` has shape (at least phases + 1, blocks · 48): block after block of eight offsets, in each these six, one after the other, so
    that a quantity's slope is the next one.
    """
    thin = aperture < THIN * blur
    inv, narrow = 1.0 / blur, 0.5 * aperture
    spread = 0.0 if thin else 1.0 / aperture
    for m in range(phases + 1):
        row = table[m]
        b = (m / phases + half - 1 + narrow) * inv
        cb, pb = both(b)
        for j in range(8 * block_count(half)):
            z = m / phases - (j - half + 1)
            at = (j >> 3) * 48 + (j & 7)
            if thin:
                t = z * inv
                g = pdf(t) * inv
                row[at], row[at + 8], row[at + 16] = cdf(t), g, -t * inv * g
                row[at + 24], row[at + 32], row[at + 40] = (t * t - 1.0) * inv * inv * g, -blur * blur * g, z * g
                continue
            if aperture == 1.0:
                a, ca, pa = b, cb, pb
            else:
                a = (z + narrow) * inv
                ca, pa = both(a)
            b = (z - narrow) * inv
            cb, pb = both(b)
            g = (ca - cb) * spread
            total = blur * spread * (a * ca + pa - b * cb - pb)
            bowl = 0.5 * blur * blur * spread * ((a * a + 1.0) * ca + a * pa - (b * b + 1.0) * cb - b * pb)
            row[at], row[at + 8], row[at + 16] = total, g, (pa - pb) * spread * inv
            row[at + 24], row[at + 32], row[at + 40] = (b * pb - a * pa) * spread * inv * inv, z * total - bowl, z * g


@jit
def cubic(phases: int, f: float) -> tuple[int, np.float32, np.float32, np.float32, np.float32]:
    """First of the two entries of a table about phase f, and the weights of both and of their slopes."""
    at = f * phases
    m = min(int(at), phases - 1)
    t = at - m
    b = t * t * (3.0 - 2.0 * t)
    return m, np.float32(1.0 - b), np.float32(b), np.float32(t * (1.0 - t) * (1.0 - t) / phases), np.float32(-t * t * (1.0 - t) / phases)


@jit
def outline(points: Array, kind: int, inner: bool, p: Array) -> int:
    """Fill the points of an outline and return how many: u, v, du, dv, and the weights ∂u/∂θ dv − ∂v/∂θ du of the shape's parameters."""
    if kind == ELLIPSE:
        a, b, c = p[2], p[3], p[4]
        blur, longest = p[5], 0.5 * (abs(a + b) + math.hypot(a - b, 2.0 * c))
    else:
        a = b = p[3] if inner else p[2]
        blur, longest, c = p[3 if kind == DISC else 4], a, 0.0
    count = point_count(longest, blur)
    step = 2.0 * math.pi / count
    cd, sd = math.cos(step), math.sin(step)
    cos, sin = 1.0, 0.0
    sign = -step if inner else step
    for k in range(count):
        points[k, 0], points[k, 1] = p[0] + a * cos + c * sin, p[1] + c * cos + b * sin
        du, dv = sign * (c * cos - a * sin), sign * (b * cos - c * sin)
        points[k, 2], points[k, 3] = du, dv
        if kind == DISC:
            points[k, 4] = sign * a
        elif kind == RING:
            points[k, 4], points[k, 5] = (0.0, sign * a) if inner else (sign * a, 0.0)
        else:
            points[k, 4], points[k, 5], points[k, 6] = cos * dv, -sin * du, sin * dv - cos * du
        cos, sin = cos * cd - sin * sd, sin * cd + cos * sd
    return count


@jit
def phase_count(blur: float) -> int:
    """Entries of the table per pixel."""
    return max(4, int(math.ceil(PHASES / blur)))


@jit
def point_count(longest: float, blur: float) -> int:
    """Points of an outline: the spacing that the blur asks for, at the longest half axis."""
    return max(LEAST_POINTS, int(math.ceil(2.0 * math.pi * longest / (STEP * blur))))


@jit(**FUSED)
def draw_outline(
    images: Array, canvas: Canvas, count: int, shapes: int, blur: float, aperture: float, light: bool, slope: tuple[float, float]
) -> None:
    """Add an outline to the planes; plane 0 gets the difference of F from row to row. ``slope`` is the light's per pixel.

    With ``light`` the first moments about the pixel go to the last two images.
    """
    planes, points, table = canvas.planes, canvas.points, canvas.table
    across, down, parts = canvas.across, canvas.down, canvas.parts
    gx, gy = slope
    half = reach_px(blur, aperture)
    phases = phase_count(blur)
    blocks = block_count(half)
    fill_table(table, phases, half, blur, aperture)
    n = 2 * half
    rows, cols = planes.shape[0], planes.shape[1] // 8
    zero = np.float32(0.0)
    one, two, three = parts[0], parts[1], parts[2]
    last = np.uint64(3 + shapes)
    parts[:] = zero
    for k in range(count):
        u, v, du, dv = points[k, 0], points[k, 1], points[k, 2], points[k, 3]
        left, top = int(math.floor(u)) - half + 1 + PAD, int(math.floor(v)) - half + 1
        if left >= cols or left + 8 * blocks <= 0 or top >= rows:
            continue
        fu, fv = u - math.floor(u), v - math.floor(v)
        # constant numbers of turns, and indices that cannot be negative, let the compiler use its vector instructions
        mu, ua, ub, uc, ud = cubic(phases, fu)
        mv, va, vb, vc, vd = cubic(phases, fv)
        ku, kv = np.uint64(mu), np.uint64(mv)
        lu, lv = ku + np.uint64(1), kv + np.uint64(1)
        for block in range(blocks):
            k1, at = np.uint64(block), np.uint64(48 * block)
            for i in range(40):
                q = at + np.uint64(i)
                d = q + np.uint64(8)
                across[k1, np.uint64(i)] = ua * table[ku, q] + ub * table[lu, q] + uc * table[ku, d] + ud * table[lu, d]
            for i in range(40):
                q = at + np.uint64(i)
                d = q + np.uint64(8)
                down[k1, np.uint64(i)] = va * table[kv, q] + vb * table[lv, q] + vc * table[kv, d] + vd * table[lv, d]
        shine = 1.0 + gx * (u - points[count, 0]) + gy * (v - points[count, 1])
        x1, y1 = np.float32(shine * dv), np.float32(-shine * du)
        s1, s2, s3 = np.float32(shine * points[k, 4]), np.float32(shine * points[k, 5]), np.float32(shine * points[k, 6])
        b0, b1, b2 = np.float32(-blur * (gx * dv - gy * du)), np.float32(blur * shine * dv), np.float32(-blur * shine * du)
        f3 = np.float32(du)
        for block in range(blocks):
            first = left + 8 * block
            if first >= cols or first + 8 <= 0:
                continue
            row = np.uint64(block)
            if first < 0 or first + 8 > cols:
                for i in range(8):
                    if not 0 <= first + i < cols:
                        across[row, 8 + i] = across[row, 16 + i] = zero
            if shapes == 1:
                for i in range(8):
                    g, rise, at = across[row, np.uint64(8 + i)], across[row, np.uint64(16 + i)], np.uint64(8 * i)
                    one[at + np.uint64(1)], one[at + np.uint64(2)], one[at + np.uint64(3)], three[at] = x1 * g, y1 * g, s1 * g, f3 * g
                    one[at + np.uint64(4)], two[at + np.uint64(4)] = b0 * g + b1 * rise, b2 * g
            else:
                for i in range(8):
                    g, rise, at = across[row, np.uint64(8 + i)], across[row, np.uint64(16 + i)], np.uint64(8 * i)
                    one[at + np.uint64(1)], one[at + np.uint64(2)], three[at] = x1 * g, y1 * g, f3 * g
                    one[at + np.uint64(3)], one[at + np.uint64(4)] = s1 * g, s2 * g
                    if shapes == 3:
                        one[at + np.uint64(5)] = s3 * g
                    one[at + last], two[at + last] = b0 * g + b1 * rise, b2 * g
            start = 8 * min(max(first, 0), cols - 8)
            if start != 8 * first:
                slide(parts, start // 8 - first)
            above = np.float32(1.0)
            for j in range(n + 1):
                r = top + j
                if r >= rows:
                    break
                below = down[j >> 3, j & 7] if j < n else zero
                fall = above - below
                above = below
                g, rise = zero, zero
                if j < n and r >= 0:
                    g, rise = down[j >> 3, 8 + (j & 7)], down[j >> 3, 16 + (j & 7)]
                # F of row 0 sums what is above it
                to, at = np.uint64(max(r, 0)), np.uint64(start)
                for i in range(64):
                    planes[to, at + np.uint64(i)] += g * one[i] + rise * two[i] + fall * three[i]
                if light and j < n and r >= 0:
                    moment = down[j >> 3, 32 + (j & 7)]
                    for i in range(8):
                        c = first + i - PAD
                        if 0 <= c < images.shape[2]:
                            images[8 + shapes, r, c] += g * dv * across[block, 32 + i]
                            images[9 + shapes, r, c] -= moment * du * across[block, 8 + i]


@jit
def slide(parts: Singles, by: int) -> None:
    """Move eight pixels of the parts, so that each stays where it was when they are written ``by`` pixels further on."""
    for k in range(3):
        for i in range(64) if by > 0 else range(63, -1, -1):
            parts[k, i] = parts[k, i + 8 * by] if 0 <= i + 8 * by < 64 else np.float32(0.0)


@jit
def spread_planes(planes: Singles, images: Array, count: int) -> None:
    """Write the planes as images, F summed over the rows."""
    for r in range(images.shape[1]):
        for c in range(images.shape[2]):
            at = 8 * (c + PAD)
            before = images[0, r - 1, c] if r > 0 else 0.0
            images[0, r, c] = before + planes[r, at]
            for j in range(1, count):
                images[j, r, c] = planes[r, at + j]


@jit
def draw_spot(images: Array, p: Array, aperture: float) -> None:
    """Draw a Gaussian spot of height 1, averaged over the pixels, and its derivatives."""
    x, y, s = p[0], p[1], p[2]
    rows, cols = images.shape[1], images.shape[2]
    across, down = np.empty((3, cols)), np.empty((3, rows))
    spot_profile(across, x, s, aperture)
    spot_profile(down, y, s, aperture)
    for r in range(rows):
        for c in range(cols):
            images[0, r, c] = across[0, c] * down[0, r]
            images[1, r, c] = across[1, c] * down[0, r]
            images[2, r, c] = across[0, c] * down[1, r]
            images[3, r, c] = across[2, c] * down[0, r] + across[0, c] * down[2, r]


@jit
def spot_profile(out: Array, centre: float, s: float, aperture: float) -> None:
    """A Gaussian of height 1 averaged over the aperture, its derivative by the centre and by its standard deviation."""
    area = math.sqrt(2.0 * math.pi) * s
    for i in range(out.shape[1]):
        z = centre - i
        if aperture < THIN * s:
            t = z / s
            g = area * pdf(t) / s
            out[0, i], out[1, i], out[2, i] = g, -t / s * g, t * t / s * g
        else:
            a, b = (z + 0.5 * aperture) / s, (z - 0.5 * aperture) / s
            pa, pb = pdf(a), pdf(b)
            out[0, i] = area * (cdf(a) - cdf(b)) / aperture
            out[1, i] = area * (pa - pb) / (aperture * s)
            out[2, i] = out[0, i] / s + area * (b * pb - a * pa) / (aperture * s)


@jit
def draw(images: Array, canvas: Canvas, kind: int, p: Array, aperture: float, light: bool, surface: bool) -> None:
    """Fill the images of a shape with centre (p[0], p[1]) in their own pixels; the last 4 of ``p`` are the planes of background and light.

    ``surface``: the light falls off over the shape, before the blur; its slopes then enter the derivatives by the outline and the blur.
    """
    shapes = SHAPES[kind]
    if light:
        images[8 + shapes : 10 + shapes] = 0.0
    if kind == SPOT:
        draw_spot(images, p, aperture)
        return
    draw_planes(images, canvas, kind, p, aperture, light and surface)
    spread_planes(canvas.planes, images, 4 + shapes)


@jit
def draw_planes(images: Array, canvas: Canvas, kind: int, p: Array, aperture: float, light: bool) -> None:
    """Draw all outlines of a shape; see `draw_outline`."""
    shapes = SHAPES[kind]
    points = canvas.points
    canvas.planes[:] = np.float32(0.0)
    slope = (p[shapes + 7], p[shapes + 8]) if light else (0.0, 0.0)
    for inner in range(2 if kind == RING else 1):
        count = outline(points, kind, inner == 1, p)
        points[count, 0], points[count, 1] = p[0], p[1]
        draw_outline(images, canvas, count, shapes, p[2 + shapes], aperture, light, slope)


@jit
def draw_plain(images: Array, spans: Ints, canvas: Canvas, kind: int, p: Array, aperture: float) -> None:
    """`draw` and `complete` in one, of the pixels in the spans, row after row, where no slopes are among the unknowns; not of a spot.

    ``images``, shape (parameters + 1, 1, pixels); ``spans``, shape (rows, 2): first and stop column.
    """
    k = SHAPES[kind] + 3
    draw_planes(images, canvas, kind, p, aperture, False)
    planes, amplitude, background = canvas.planes, p[k], p[k + 1]
    f, n = np.zeros(planes.shape[1] // 8 - 2 * PAD), 0
    for r in range(len(spans)):
        row, first, wide = planes[r], spans[r, 0], spans[r, 1] - spans[r, 0]
        for c in range(len(f)):
            f[c] += row[8 * (c + PAD)]
        mean, seen, level = images[0, 0, n : n + wide], images[k + 1, 0, n : n + wide], images[k + 2, 0, n : n + wide]
        for c in range(wide):
            seen[c], mean[c], level[c] = f[first + c], background + amplitude * f[first + c], 1.0
        for j in range(1, k + 1):
            out, at = images[j, 0, n : n + wide], 8 * (first + PAD) + j
            for c in range(wide):
                out[c] = amplitude * row[at + 8 * c]
        n += wide


@jit
def complete(images: Array, kind: int, p: Array, light: bool, surface: bool) -> None:
    """Turn the images of `draw` into the mean (0) and its derivatives by all parameters, in their order.

    ``p``: x, y, outline …, blur, amplitude, background, background's slopes x and y, light's slopes x and y.
    """
    k = SHAPES[kind] + 3  # of the amplitude
    amplitude, background, bx, by, gx, gy = p[k], p[k + 1], p[k + 2], p[k + 3], p[k + 4], p[k + 5]
    on_surface = surface and kind != SPOT
    for r in range(images.shape[1]):
        dy = r - p[1]
        for c in range(images.shape[2]):
            dx = c - p[0]
            f, fx, fy = images[0, r, c], 0.0, 0.0
            seen, gain = f, amplitude
            if light:
                fx, fy = dx * f, dy * f
                if on_surface:
                    fx += images[k + 5, r, c]
                    fy += images[k + 6, r, c]
                else:
                    gain *= 1.0 + gx * dx + gy * dy
                seen += gx * fx + gy * fy
                images[k + 5, r, c], images[k + 6, r, c] = amplitude * fx, amplitude * fy
            images[0, r, c] = background + bx * dx + by * dy + amplitude * seen
            images[1, r, c] = gain * images[1, r, c] - amplitude * gx * f - bx
            images[2, r, c] = gain * images[2, r, c] - amplitude * gy * f - by
            for j in range(3, k + 1):
                images[j, r, c] *= gain
            images[k + 1, r, c], images[k + 2, r, c] = seen, 1.0
            images[k + 3, r, c], images[k + 4, r, c] = dx, dy
