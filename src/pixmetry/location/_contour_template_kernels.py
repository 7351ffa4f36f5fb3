"""Kernels of templates: what the pixels of a window see of a blurred shape, and how that changes with every parameter.

The box of a pixel and the Gaussian of the lens make a weight g(x) g(y). By Green's theorem the integral of the weight over a shape, and of
its derivative with respect to any parameter θ of the outline (u, v), is an integral along the outline,

    F(x, y) = −∮ g(u − x) G(v − y) du,      ∂F/∂θ = ∮ (∂u/∂θ dv − ∂v/∂θ du) g(u − x) g(v − y),

with G the integral of g. On a smooth closed outline equal steps converge exponentially, so that a few points of it, each of which reaches
a few rows and columns, give F and all its derivatives exactly. The blur follows from the heat equation, ∂F/∂σ = σ ∇²F.

Images of a shape: 0 is F, 1 and 2 its derivatives by the centre's x and y, then those by the parameters of the outline and by the blur;
where light that falls off over the shape is asked for, two more hold its first moments about the pixel (`draw`) or the centre.
"""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.jit import jit

DISC, ELLIPSE, RING, SPOT = 0, 1, 2, 3
SHAPES = np.array([1, 3, 2, 0])  # parameters of the outline
REACH = 4.25  # standard deviations of the blur beyond which it is taken as 0 (1.1e-5 of the height of an edge)
STEP = 1.2  # standard deviations of the blur between points of the outline: what is left is 2 exp(−2π²/STEP²) = 2e-6
LEAST_POINTS = 16
PHASES = 6.0  # entries of a table per standard deviation: cubic interpolation of g is good to 3e-6
THIN = 0.005  # a box narrower than this share of the blur is a point (error 1e-6)
LIMIT = 6.0  # of the normal distribution's table, in standard deviations
PER = 64  # entries of it per standard deviation: cubic interpolation is good to 2e-10
_Z = np.arange(-LIMIT * PER, LIMIT * PER + 2) / PER
CDF = np.array([0.5 * math.erfc(-z / math.sqrt(2.0)) for z in _Z])
PDF = np.exp(-0.5 * _Z**2) / math.sqrt(2.0 * math.pi)
ROOT = 1.0 / math.sqrt(2.0 * math.pi)
FUSED = {"fastmath": {"contract"}}


@jit
def cdf(z):
    """Distribution function of the normal distribution."""
    if z <= -LIMIT:
        return 0.0
    if z >= LIMIT:
        return 1.0
    at = (z + LIMIT) * PER
    j = int(at)
    f = at - j
    rise = CDF[j + 1] - CDF[j]
    return CDF[j] + f * rise + f * (1.0 - f) * ((1.0 - f) * (PDF[j] / PER - rise) - f * (PDF[j + 1] / PER - rise))


@jit
def pdf(z):
    """Density of the normal distribution."""
    return 0.0 if abs(z) > LIMIT else ROOT * math.exp(-0.5 * z * z)


@jit
def reach_px(blur, aperture):
    """Whole pixels to either side that a point of the outline reaches."""
    return int(math.ceil(0.5 * aperture + REACH * blur))


@jit
def fill_table(table, phases, half, blur, aperture):
    """Fill G, g, g', g'', first moment m of g below z, and m' = z g at z = phase − offset, offset −half + 1 … half.

    ``table`` has shape (at least phases + 1, 6, at least 2 half); it is filled up with 0 to a whole number of eight offsets, which is
    returned.
    """
    width = (2 * half + 7) // 8 * 8
    thin = aperture < THIN * blur
    for m in range(phases + 1):
        for j in range(2 * half):
            z = m / phases - (j - half + 1)
            if thin:
                t = z / blur
                g = pdf(t) / blur
                table[m, 0, j] = cdf(t)
                table[m, 1, j] = g
                table[m, 2, j] = -t / blur * g
                table[m, 3, j] = (t * t - 1.0) / (blur * blur) * g
                table[m, 4, j] = -blur * blur * g
                table[m, 5, j] = z * g
                continue
            a, b = (z + 0.5 * aperture) / blur, (z - 0.5 * aperture) / blur
            ca, cb, pa, pb = cdf(a), cdf(b), pdf(a), pdf(b)
            g = (ca - cb) / aperture
            total = blur / aperture * (a * ca + pa - b * cb - pb)
            bowl = 0.5 * blur * blur / aperture * ((a * a + 1.0) * ca + a * pa - (b * b + 1.0) * cb - b * pb)
            table[m, 0, j] = total
            table[m, 1, j] = g
            table[m, 2, j] = (pa - pb) / (aperture * blur)
            table[m, 3, j] = (b * pb - a * pa) / (aperture * blur * blur)
            table[m, 4, j] = z * total - bowl
            table[m, 5, j] = z * g
        for j in range(2 * half, width):
            for q in range(6):
                table[m, q, j] = 0.0
    return width


@jit
def look_up(out, row, table, quantity, slope, phases, f, width):
    """Interpolate a quantity of the table at phase f by cubics, all offsets at once."""
    at = f * phases
    m = min(int(at), phases - 1)
    t = at - m
    h = 1.0 / phases
    b = t * t * (3.0 - 2.0 * t)
    c, d = t * (1.0 - t) * (1.0 - t) * h, -t * t * (1.0 - t) * h
    for j in range(width):
        out[row, j] = (1.0 - b) * table[m, quantity, j] + b * table[m + 1, quantity, j] + c * table[m, slope, j] + d * table[m + 1, slope, j]


@jit
def outline(points, kind, inner, p):
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
def phase_count(blur):
    """Entries of the table per pixel."""
    return max(4, int(math.ceil(PHASES / blur)))


@jit
def point_count(longest, blur):
    """Points of an outline: the spacing that the blur asks for, at the longest half axis."""
    return max(LEAST_POINTS, int(math.ceil(2.0 * math.pi * longest / (STEP * blur))))


@jit
def eight(rows, k, first):
    """Eight values of row k, to be kept in registers."""
    return (
        rows[k, first], rows[k, first + 1], rows[k, first + 2], rows[k, first + 3], rows[k, first + 4], rows[k, first + 5],
        rows[k, first + 6], rows[k, first + 7],
    )  # fmt: skip


@jit(**FUSED)
def add_eight(flat, at, c, a):
    """Add c · a to eight neighbouring values."""
    at = np.uint64(at)  # an index that cannot be negative lets the compiler use its vector instructions
    flat[at] += c * a[0]
    flat[at + np.uint64(1)] += c * a[1]
    flat[at + np.uint64(2)] += c * a[2]
    flat[at + np.uint64(3)] += c * a[3]
    flat[at + np.uint64(4)] += c * a[4]
    flat[at + np.uint64(5)] += c * a[5]
    flat[at + np.uint64(6)] += c * a[6]
    flat[at + np.uint64(7)] += c * a[7]


@jit(**FUSED)
def add_two_eights(flat, at, c, a, d, b):
    """Add c · a + d · b to eight neighbouring values."""
    at = np.uint64(at)
    flat[at] += c * a[0] + d * b[0]
    flat[at + np.uint64(1)] += c * a[1] + d * b[1]
    flat[at + np.uint64(2)] += c * a[2] + d * b[2]
    flat[at + np.uint64(3)] += c * a[3] + d * b[3]
    flat[at + np.uint64(4)] += c * a[4] + d * b[4]
    flat[at + np.uint64(5)] += c * a[5] + d * b[5]
    flat[at + np.uint64(6)] += c * a[6] + d * b[6]
    flat[at + np.uint64(7)] += c * a[7] + d * b[7]


@jit
def draw_outline(images, points, count, shapes, blur, aperture, light, gx, gy, table, across, down):
    """Add an outline to the images; image 0 gets the difference of F from row to row. (gx, gy) is the light's slope per pixel."""
    half = reach_px(blur, aperture)
    phases = phase_count(blur)
    width = fill_table(table, phases, half, blur, aperture)
    n = 2 * half
    rows, cols = images.shape[1], images.shape[2]
    plane = rows * cols
    flat = images.reshape(images.size)
    for k in range(count):
        u, v, du, dv = points[k, 0], points[k, 1], points[k, 2], points[k, 3]
        left, top = int(math.floor(u)) - half + 1, int(math.floor(v)) - half + 1
        if left >= cols or left + width <= 0 or top >= rows:
            continue
        fu, fv = u - math.floor(u), v - math.floor(v)
        look_up(across, 0, table, 1, 2, phases, fu, width)
        look_up(across, 1, table, 2, 3, phases, fu, width)
        look_up(down, 0, table, 1, 2, phases, fv, width)
        look_up(down, 1, table, 2, 3, phases, fv, width)
        look_up(down, 2, table, 0, 1, phases, fv, width)
        if light:
            look_up(across, 2, table, 4, 5, phases, fu, width)
            look_up(down, 3, table, 4, 5, phases, fv, width)
        shine = 1.0 + gx * (u - points[count, 0]) + gy * (v - points[count, 1])
        for first in range(0, width, 8):
            column = left + first
            if column >= cols or column + 8 <= 0:
                continue
            shift = 0  # where the window ends, the eight are moved and filled up with 0
            if column < 0 or column + 8 > cols:
                shift = -column if column < 0 else cols - 8 - column
            a, b = shifted(across, 0, first, shift), shifted(across, 1, first, shift)
            m = shifted(across, 2, first, shift) if light else a
            column += shift
            above = 1.0
            for j in range(n + 1):
                below = down[2, j] if j < n else 0.0
                fall = du * (above - below)
                above = below
                r = top + j
                if r >= rows:
                    break
                add_eight(flat, max(r, 0) * cols + column, fall, a)  # F of row 0 is the sum of all differences above it
                if j == n or r < 0:
                    continue
                at = plane + r * cols + column
                g, g1 = down[0, j], down[1, j]
                add_eight(flat, at, shine * g * dv, a)
                add_eight(flat, at + plane, -shine * g * du, a)
                for s in range(shapes):
                    add_eight(flat, at + (2 + s) * plane, shine * g * points[k, 4 + s], a)
                c0, c1 = blur * (-shine * g1 * du - g * (gx * dv - gy * du)), blur * shine * g * dv
                add_two_eights(flat, at + (2 + shapes) * plane, c0, a, c1, b)
                if light:
                    add_eight(flat, at + (7 + shapes) * plane, g * dv, m)
                    add_eight(flat, at + (8 + shapes) * plane, -down[3, j] * du, a)


@jit
def shifted(rows, k, first, shift):
    """Eight values of row k such that, written ``shift`` further on, each stays where it was; those that fall out are left out."""
    if shift == 0:
        return eight(rows, k, first)
    return (
        one(rows, k, first, shift, 0), one(rows, k, first, shift, 1), one(rows, k, first, shift, 2), one(rows, k, first, shift, 3),
        one(rows, k, first, shift, 4), one(rows, k, first, shift, 5), one(rows, k, first, shift, 6), one(rows, k, first, shift, 7),
    )  # fmt: skip


@jit
def one(rows, k, first, shift, j):
    """Value j of eight that have been shifted."""
    i = j + shift
    return rows[k, first + i] if 0 <= i < 8 else 0.0


@jit
def draw_spot(images, p, aperture):
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
def spot_profile(out, centre, s, aperture):
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
def draw(images, kind, p, aperture, light, surface, points, table, across, down):
    """Fill the images of a shape with centre (p[0], p[1]) in their own pixels; the last 4 of ``p`` are the planes of background and light.

    ``surface``: the light falls off over the shape, before the blur; its slopes then enter the derivatives by the outline and the blur.
    """
    shapes = SHAPES[kind]
    images[: 4 + shapes] = 0.0
    if light:
        images[8 + shapes : 10 + shapes] = 0.0
    if kind == SPOT:
        draw_spot(images, p, aperture)
    else:
        gx, gy = (p[shapes + 7], p[shapes + 8]) if light and surface else (0.0, 0.0)
        for inner in range(2 if kind == RING else 1):
            count = outline(points, kind, inner == 1, p)
            points[count, 0], points[count, 1] = p[0], p[1]
            draw_outline(images, points, count, shapes, p[2 + shapes], aperture, light and surface, gx, gy, table, across, down)
        for r in range(1, images.shape[1]):
            for c in range(images.shape[2]):
                images[0, r, c] += images[0, r - 1, c]


@jit
def complete(images, kind, p, light, surface):
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
