"""Kernels of template fits: weighted least squares of one target after the other, by Gauss–Newton steps with Levenberg's damping.

The steps are not those of `descent_of`, which other models share: a drawn template is smooth to 2e-5 of its height only, a step may be
judged by an exact likelihood, moves along the curved valley of radius, blur and height, and what counts at the end is the place alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pixmetry.core._linear_algebra_kernels import Factor, factor_for, factorise, solve, substitute
from pixmetry.core.arrays import Array, Ints, Singles
from pixmetry.core.jit import jit
from pixmetry.locate._noise_kernels import CLIP, Noise, clipped, variance_of, variance_slope
from pixmetry.locate.template._contour_template_kernels import (
    ELLIPSE,
    PAD,
    RING,
    SHAPES,
    SPOT,
    Canvas,
    block_count,
    complete,
    draw,
    draw_plain,
    phase_count,
    point_count,
    reach_px,
)

MOST = 12  # parameters
STEPS = 40
AT_REST = 0.004  # fall of χ² that the next step would bring when a step is the last: no parameter would move by more than 0.06 of its u
PATIENCE = 6  # steps after which only the place must be at rest, and χ² hardly fall any more
HARDLY = 0.5
LEAST_BLUR_PX = 0.1
LEAST_RADIUS_PX = 0.2
LARGE = 2.5  # half axis over the edge's standard deviation from which the edge is as good as straight
CLEAR = 20.0  # height over the noise from which the sums tell more than a rough look
SMALL = 2.0  # half axis over blur below which they can hardly be told apart
VAGUE = 0.5  # relative standard deviation at which radius and blur are held where the image does not tell them apart
RIDGE = 1e-12  # damping that is always there
LEAST_BACKGROUND = 0.01  # electrons, where their likelihood is used: there are no negative ones
LEAST_ELECTRONS = 1e-3  # below it a pixel is as good as dark
MOST_ELECTRONS = 60.0  # of a reading, from which it is as good as a shifted Poisson number
PER_E = 8.0  # entries of the efficiency per unit of log(electrons)
MOST_LONE = 4  # pixels of a target that may be defective
CORE = 0.96  # of the height, from which a pixel counts as inside the target
LEAST_CORE = 5  # pixels there that tell a slope
ROWS = 32  # of a target, at most, that are asked whether rows are shifted against each other
ALIKE = math.exp(-1.0 / 5.0)  # correlation of the shifts of two lines of a field that follow each other, where a loop carries them on
DOT = {"fastmath": {"reassoc", "contract", "nsz"}}


class About(NamedTuple):
    """Where the windows of targets are."""

    home: Array  # shape (n, 2 or more): x, y, px
    half: Ints  # half sides of the windows
    outer: Array  # longest half axes, px
    inverse: Array  # shape (n, 3): xx, yy and xy of the symmetric matrix that makes the outline a circle of radius 1, 1/px
    reach: Array  # shape (n, 2): how far beyond them pixels are used, and are taken from a neighbour, px
    near_start: Ints  # the neighbours of target i are near_index[near_start[i]:near_start[i + 1]]
    near_index: Ints


class Packed(NamedTuple):
    """Windows of some targets, one after the other, rows filled up to a multiple of eight pixels."""

    place: Ints  # of each window
    data: Singles  # DN
    mask: Singles  # 0 where a pixel does not count


class Model(NamedTuple):
    """The template and the likelihood."""

    kind: int
    aperture: float  # side of the pixel's square, px
    surface: bool  # whether light falls off on the target's surface, before the blur
    noise: Noise
    efficiency: Array  # of the likelihood of few electrons; empty where it is not used


class Fits(NamedTuple):
    """Results of fits, NaN where there is none."""

    parameters: Array  # shape (n, parameters)
    variance: Array  # of each
    covariance: Array  # shape (n, 3): of x and y, xx, xy, yy, px²
    quality: Array  # shape (n, 10): 0 χ², 1 pixels used, 2 to 4 the expected falls of χ² with planes, 5 steps (negative: not at rest),
    # 6 whether the frame cuts the window, 7 and 8 pixels at the upper and lower end of the scale, 9 the larger variance of x and y by the
    # pixels' noise alone


class Window(NamedTuple):
    """One window in work."""

    images: Array  # shape (parameters + 1, rows, cols): the mean and its derivatives
    data: Singles
    mask: Singles
    weight: Array  # of the mean that was looked at last
    kept: Array  # of the mean that is kept
    residual: Array


class Pixels(NamedTuple):
    """Where the pixels of a window in work are, which are those of its spans, row after row; in work it has one row."""

    spans: Ints  # shape (rows, 2): first and stop column
    whole: Array  # shape (parameters + 1, rows, cols): where images are drawn that need their neighbours; else empty


class System(NamedTuple):
    """Normal equations and what is needed to solve them."""

    normal: Array  # shape (MOST, MOST)
    gradient: Array  # shape (MOST,)
    factor: Factor
    right: Array
    step: Array
    scratch: Array  # shape (2, pixels)


@jit
def system_for(pixels: int) -> System:
    """Room for the equations of a window."""
    return System(np.zeros((MOST, MOST)), np.zeros(MOST), factor_for(MOST), np.zeros(MOST), np.zeros(MOST), np.empty((2, pixels)))


@jit(**DOT)
def dot(a: Array, b: Array) -> float:
    """Sum of products."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@jit
def electrons_expected(d: float, mean: float, sigma: float) -> tuple[float, float]:
    """Expected number of electrons n behind a reading d = n + noise, where n is Poisson with this mean, and −2 ln likelihood of d."""
    first = max(0, int(math.floor(d - 6.0 * sigma)))
    last = max(first, int(math.ceil(d + 6.0 * sigma)))
    fall = 0.5 / (sigma * sigma)
    log_mean = math.log(mean)
    log_poisson = first * log_mean - mean - math.lgamma(first + 1.0)
    biggest, total, along = -math.inf, 0.0, 0.0
    for n in range(first, last + 1):
        log_weight = log_poisson - fall * (d - n) * (d - n)
        log_poisson += log_mean - math.log(n + 1.0)
        if log_weight > biggest:
            shrink = math.exp(biggest - log_weight) if n > first else 0.0
            total, along, biggest = total * shrink, along * shrink, log_weight
        w = math.exp(log_weight - biggest)
        total += w
        along += w * n
    return along / total, -2.0 * (biggest + math.log(total))


@jit(**DOT)
def plain_weights(mean: Array, data: Singles, mask: Singles, weight: Array, residual: Array, w: float) -> float:
    """`weigh` where the variance is the same everywhere."""
    total = 0.0
    for i in range(len(mean)):
        d = data[i] - mean[i]
        weight[i], residual[i] = w * mask[i], d
        total += mask[i] * d * d
    return w * total


@jit
def weigh(window: Window, noise: Noise, efficiency: Array, least: float, most: float) -> tuple[float, float, float]:
    """Set the weights and residuals at the mean that the images hold; return χ², and what a better fit makes smaller, for now and for next.

    A weight is 1/variance of the mean. Where the scale ends, the mean and its derivatives become those of the clipped value. What shrinks
    is χ² with the ``kept`` weights. With an ``efficiency`` it is −2 ln likelihood; where a reading has few electrons its weight is then its
    exact information, and the residual its score over that. No mean is known to be outside ``least`` … ``most``.
    """
    images, data, mask = window.images, window.data, window.mask
    weight, kept, residual = window.weight, window.kept, window.residual
    constant, slope, black, low, high = noise.constant_dn2, noise.slope_dn, noise.black_dn, noise.low_dn, noise.high_dn
    chi2, before, after = 0.0, 0.0, 0.0
    level_free = slope == 0.0 and noise.pattern_rel == 0.0
    s = math.sqrt(constant)
    lowest, highest = (low + CLIP * s, high - CLIP * s) if level_free else (math.inf, -math.inf)
    ended = low > -math.inf or high < math.inf
    sigma_e = s / slope if slope > 0.0 else 0.0
    exact = len(efficiency) > 0 and slope > 0.0
    if level_free and (not ended or (lowest < least and most < highest)):
        size = data.size
        flat, w_flat, d_flat = images[0].reshape(size), weight.reshape(size), residual.reshape(size)
        chi2 = plain_weights(flat, data.reshape(size), mask.reshape(size), w_flat, d_flat, 1.0 / constant)
        return chi2, chi2, chi2
    for r in range(data.shape[0]):
        for c in range(data.shape[1]):
            if mask[r, c] == 0.0:
                weight[r, c], residual[r, c] = 0.0, 0.0
                continue
            mean = images[0, r, c]
            variance, rise, share = constant, 0.0, 1.0
            light = max(mean - black, 0.0)
            if not level_free:
                variance, rise = variance_of(light, noise), variance_slope(light, noise)
            if ended and not lowest < mean < highest:
                mean, variance, share = clipped(mean, variance, rise, low, high)
                images[0, r, c] = mean
                if share != 1.0:
                    for j in range(1, images.shape[0]):
                        images[j, r, c] *= share
            w = 1.0 / variance
            d = data[r, c] - mean
            chi2 += w * d * d
            if exact and share > 0.999:
                mean_e = max(light / slope, LEAST_ELECTRONS)
                reading = (data[r, c] - black) / slope
                if reading < MOST_ELECTRONS:
                    at = math.log(mean_e / LEAST_ELECTRONS) * PER_E
                    k = int(at)
                    if k + 1 < len(efficiency):
                        w *= efficiency[k] + (at - k) * (efficiency[k + 1] - efficiency[k])
                    expected, now = electrons_expected(reading, mean_e, sigma_e)
                    d = (expected / mean_e - 1.0) / (slope * w)
                else:
                    shifted = mean_e + sigma_e * sigma_e
                    now = 2.0 * (shifted - (reading + sigma_e * sigma_e) * math.log(shifted))
                before += now
                after += now
            else:
                before += kept[r, c] * d * d
                after += w * d * d
            weight[r, c], residual[r, c] = w, d
    return chi2, before, after


@jit
def mean_range(kind: int, p: Array) -> tuple[float, float]:
    """Least and greatest mean that a template without planes can have; with planes anything."""
    k = SHAPES[kind] + 3
    if p[k + 2] != 0.0 or p[k + 3] != 0.0 or p[k + 4] != 0.0 or p[k + 5] != 0.0:
        return -math.inf, math.inf
    margin = 1e-4 * abs(p[k])
    return min(p[k + 1], p[k + 1] + p[k]) - margin, max(p[k + 1], p[k + 1] + p[k]) + margin


@jit(**DOT)
def dots(a: Array, b: Array, c: Array, d: Array) -> tuple[float, float, float, float]:
    """Sums of the products a c, a d, b c, b d; each number is loaded once for two of them."""
    ac, ad, bc, bd = 0.0, 0.0, 0.0, 0.0
    for i in range(len(a)):
        ac += a[i] * c[i]
        ad += a[i] * d[i]
        bc += b[i] * c[i]
        bd += b[i] * d[i]
    return ac, ad, bc, bd


@jit
def normal_equations(images: Array, residual: Array, weight: Array, used: Ints, first: int, system: System) -> None:
    """Fill JᵀWJ and JᵀW · residual for the ``used`` parameters, from the ``first`` on; the images hold the derivatives."""
    size, count = weight.size, len(used)
    w, d = weight.reshape(size), residual.reshape(size)
    normal, gradient, scratch = system.normal, system.gradient, system.scratch
    one, two = scratch[0, :size], scratch[1, :size]
    for a in range(first, count, 2):
        e = min(a + 1, count - 1)
        here, next_one = images[1 + used[a]].reshape(size), images[1 + used[e]].reshape(size)
        for i in range(size):
            one[i], two[i] = w[i] * here[i], w[i] * next_one[i]
        for b in range(0, e + 1, 2):
            f = min(b + 1, e)
            products = dots(one, two, images[1 + used[b]].reshape(size), images[1 + used[f]].reshape(size))
            normal[a, b], normal[a, f], normal[e, b], normal[e, f] = products
            normal[b, a], normal[f, a], normal[b, e], normal[f, e] = products
        gradient[a], gradient[e] = dot(one, d), dot(two, d)


@jit
def beyond(inverse: Array, i: int, dx: float, dy: float) -> float:
    """Distance of a place from the outline of target i, to first order; negative inside it."""
    qx, qy = inverse[i, 0] * dx + inverse[i, 2] * dy, inverse[i, 2] * dx + inverse[i, 1] * dy
    rho = math.sqrt(qx * qx + qy * qy)
    gx, gy = inverse[i, 0] * qx + inverse[i, 2] * qy, inverse[i, 2] * qx + inverse[i, 1] * qy
    steep = math.sqrt(gx * gx + gy * gy)
    return (rho - 1.0) * rho / steep if steep > 0.0 else -1.0 / max(abs(inverse[i, 0]), abs(inverse[i, 1]))


@jit
def cut_out(frame: NDArray[np.generic], about: About, noise: Noise, which: Ints, packed: Packed, quality: Array) -> None:
    """Copy the windows of the targets ``which``.

    The mask is 0 outside the frame, beyond the reach of the target and where a neighbour is nearer. ``quality``: 1, 6, 7 and 8 of `Fits`.
    """
    start, half, outer, inverse, reach, near_start, near_index = about
    place, data, mask = packed
    low, high = noise.low_dn, noise.high_dn
    for w in range(len(which)):
        i = which[w]
        side = 2 * half[i] + 1
        wide = (side + 7) // 8 * 8
        x0, y0 = start[i, 0], start[i, 1]
        col0, row0 = int(round(x0)) - half[i], int(round(y0)) - half[i]
        far = outer[i] + reach[i, 0]
        used, cut, top, bottom = 0, 0.0, 0, 0
        near = near_index[near_start[i] : near_start[i + 1]]
        k = place[w]
        data[k : k + side * wide], mask[k : k + side * wide] = 0.0, 0.0
        for r in range(side):
            y = row0 + r
            dy = y - y0
            half_row = math.sqrt(max(far * far - dy * dy, 0.0)) + 1.0
            for c in range(max(int(x0 - half_row) - col0, 0), min(int(x0 + half_row) + 2 - col0, side)):
                x = col0 + c
                dx = x - x0
                if dx * dx + dy * dy > far * far:
                    continue
                if y < 0 or x < 0 or y >= frame.shape[0] or x >= frame.shape[1]:
                    cut = 1.0
                    continue
                own = True
                for j in near:
                    e = beyond(inverse, j, x - start[j, 0], y - start[j, 1])
                    if e < reach[j, 1] or e < beyond(inverse, i, dx, dy):
                        own = False
                        break
                if own:
                    value = frame[y, x]
                    if value != value:  # a pixel that is known to be defective
                        continue
                    data[k + c], mask[k + c] = value, 1.0
                    used += 1
                    top += value >= high
                    bottom += value <= low
            k += wide
        quality[i, 1], quality[i, 6], quality[i, 7], quality[i, 8] = used, cut, top, bottom


@jit
def allowed(kind: int, p: Array, start: Array, largest: float, broadest: float) -> bool:
    """Whether parameters are such that the template can be drawn and still belongs to this target."""
    s = SHAPES[kind]
    away = 1.0 + 0.5 * longest_px(kind, start) + start[2 + s]
    if not (abs(p[0] - start[0]) < away and abs(p[1] - start[1]) < away):
        return False
    if not (longest_px(kind, p) < largest and p[2 + s] < broadest):
        return False
    if s == 1:
        return bool(p[2] > 0.0)
    if s == 2:
        return bool(p[2] > p[3] > 0.0)
    return s == 0 or bool(p[2] > 0.0 and p[3] > 0.0 and p[2] * p[3] > p[4] * p[4])


@jit
def hold(kind: int, p: Array, start: Array, used: Ints, system: System) -> None:
    """Hold radii and blur weakly to their start values, which matters only where the image does not tell them apart."""
    s = SHAPES[kind]
    for a in range(len(used)):
        j = used[a]
        if 2 <= j <= 2 + s and not (s == 3 and j == 4):
            w = 1.0 / (VAGUE * math.hypot(start[j], 0.4)) ** 2
            system.normal[a, a] += w
            system.gradient[a] -= w * (p[j] - start[j])


@jit
def strain(kind: int, p: Array, start: Array) -> float:
    """What `hold` adds to χ²."""
    s = SHAPES[kind]
    total = 0.0
    for j in range(2, 3 + s):
        if not (s == 3 and j == 4):
            total += ((p[j] - start[j]) / (VAGUE * math.hypot(start[j], 0.4))) ** 2
    return total


@jit
def longest_px(kind: int, p: Array) -> float:
    """Longest half axis of a shape; of a spot 0."""
    if kind == SPOT:
        return 0.0
    if SHAPES[kind] == 3:
        return 0.5 * float(abs(p[2] + p[3]) + math.hypot(p[2] - p[3], 2.0 * p[4]))
    return float(p[2])


@jit
def moments(kind: int, p: Array, step: Array, out: Array) -> None:
    """Area over π and mean square half width of an outline, and their changes along a step."""
    if kind == ELLIPSE:
        a, b, c, da, db, dc = p[2], p[3], p[4], step[2], step[3], step[4]
        out[0], out[1] = a * b - c * c, da * b + a * db - 2.0 * c * dc
        out[2], out[3] = (a * a + b * b + 2.0 * c * c) / 8.0, (a * da + b * db + 2.0 * c * dc) / 4.0
    else:
        r, d = p[3] if kind == RING else 0.0, step[3] if kind == RING else 0.0
        out[0], out[1] = p[2] * p[2] - r * r, 2.0 * (p[2] * step[2] - r * d)
        out[2], out[3] = (p[2] * p[2] + r * r) / 4.0, (p[2] * step[2] + r * d) / 2.0


@jit
def move(kind: int, p: Array, step: Array, used: Ints, darkest: float, out: Array) -> None:
    """Take a step; blur and radii stay above what can be drawn, and change by at most a third, the background not below the ``darkest``.

    Of a shape smaller than its blur the image tells little more than the light and the second moment. A step then changes these by what it
    says to first order, so that it follows the curved valley along which radius, blur and amplitude make up for each other.
    """
    s = SHAPES[kind]
    share = 1.0
    full, figures = np.zeros(len(p)), np.empty(4)
    for a in range(len(used)):
        j = used[a]
        full[j] = step[a]
        if j == 2 + s or (2 <= j < 2 + s and j != 4):
            share = min(share, p[j] / 3.0 / max(abs(step[a]), 1e-300))
    for j in range(len(p)):
        full[j] = min(0.5, max(-0.5, full[j])) if j < 2 else share * full[j]
        out[j] = p[j] + full[j]
    for j in range(2, 2 + min(s, 2)):
        out[j] = max(out[j], LEAST_RADIUS_PX)
    if s > 0 and longest_px(kind, p) < SMALL * math.hypot(p[2 + s], 0.3):
        moments(kind, p, full, figures)
        area, light = figures[0], p[3 + s] * figures[0] + full[3 + s] * figures[0] + p[3 + s] * figures[1]
        square = p[2 + s] ** 2 + 2.0 * p[2 + s] * full[2 + s] + figures[2] + figures[3]
        moments(kind, out, full, figures)
        out[2 + s] = math.sqrt(max(square - figures[2], 0.25 * p[2 + s] ** 2))
        if figures[0] > 0.25 * area:
            out[3 + s] = light / figures[0]
    out[2 + s] = max(out[2 + s], LEAST_BLUR_PX)
    out[4 + s] = max(out[4 + s], darkest)


@jit
def pin(kind: int, p: Array, used: Ints, darkest: float, system: System) -> bool:
    """Take blur, radii and background that would fall below their least values out of the equations; True if there are such."""
    s = SHAPES[kind]
    normal, gradient, step = system.normal, system.gradient, system.step
    found = False
    for a in range(len(used)):
        j = used[a]
        least = -math.inf
        if j == 4 + s:
            least = darkest
        elif j == 2 + s:
            least = LEAST_BLUR_PX
        elif 2 <= j < 2 + min(s, 2):
            least = LEAST_RADIUS_PX
        if p[j] <= least and step[a] < 0.0:
            for b in range(normal.shape[0]):
                normal[a, b] = normal[b, a] = 0.0
            normal[a, a], gradient[a] = 1e18, 0.0
            found = True
    return found


@jit
def place_covariance(count: int, system: System, out: Array) -> bool:
    """Covariance of x and y from the normal equations: xx, xy, yy; False if these are singular."""
    if not factorise(system.normal, count, RIDGE, system.factor):
        return False
    for a in range(2):
        system.right[:count] = 0.0
        system.right[a] = 1.0
        substitute(system.factor, count, system.right, system.right)
        out[a], out[1 + a] = system.right[0], system.right[1]
    return True


@jit
def place_at_rest(step: Array, c: Array) -> bool:
    """Whether a step in x and y is small against their covariance c."""
    det = c[0] * c[2] - c[1] * c[1]
    return bool(step[0] * step[0] * c[2] - 2.0 * step[0] * step[1] * c[1] + step[1] * step[1] * c[0] < AT_REST * det)


@jit
def falls_with(system: System, chosen: Ints, small: Array) -> float:
    """Expected fall of χ² when the chosen parameters are set free."""
    m = len(chosen)
    for a in range(m):
        system.right[a] = system.gradient[chosen[a]]
        for b in range(m):
            small[a, b] = system.normal[chosen[a], chosen[b]]
    found = solve(small, m, system.right, RIDGE, system.factor, system.step)
    return dot(system.step[:m], system.right[:m]) if found else 0.0


@jit
def add_planes(images: Array, spans: Ints, p: Array, count: int) -> None:
    """Derivatives by the slopes of background and light, where these are 0; ``images`` of the pixels in the spans, in one row.

    Light on the surface differs from light on the image, which this is, by a shift, which is among the unknowns.
    """
    n = 0
    for r in range(len(spans)):
        dy, left, wide = r - p[1], spans[r, 0] - p[0], spans[r, 1] - spans[r, 0]
        part = images[:, 0, n : n + wide]
        for c in range(wide):
            dx, light = left + c, p[count - 2] * part[count - 1, c]
            part[count + 1, c], part[count + 2, c] = dx * part[count, c], dy * part[count, c]
            part[count + 3, c], part[count + 4, c] = dx * light, dy * light
        n += wide


@jit
def test_planes(system: System, count: int, quality: Array) -> None:
    """Expected falls of χ² with a plane of the background (2), of the light (3) and with both (4)."""
    chosen, small = np.arange(count + 4), np.empty((MOST, MOST))
    none = falls_with(system, chosen[:count], small)
    quality[4] = falls_with(system, chosen, small) - none
    quality[2] = falls_with(system, chosen[: count + 2], small) - none
    chosen[count], chosen[count + 1] = count + 2, count + 3
    quality[3] = falls_with(system, chosen[: count + 2], small) - none


class Course(NamedTuple):
    """How the fit of one target went."""

    chi2: float  # infinite where there was none
    falls: float  # expected of the step after the last one
    steps: int
    at_rest: bool


@jit
def draw_mean(images: Array, pixels: Pixels, canvas: Canvas, model: Model, p: Array, planes: tuple[bool, bool]) -> None:
    """Draw the mean and its derivatives; ``planes``: whether those of background and light are unknown."""
    spans, whole = pixels
    if whole.size == 0:
        draw_plain(images, spans, canvas, model.kind, p, model.aperture)
        return
    draw(whole, canvas, model.kind, p, model.aperture, planes[1], model.surface)
    complete(whole, model.kind, p, planes[1], model.surface)
    n = 0
    for r in range(len(spans)):
        wide = spans[r, 1] - spans[r, 0]
        images[:, 0, n : n + wide] = whole[:, r, spans[r, 0] : spans[r, 1]]
        n += wide


@jit
def span_rows(mask: Singles, spans: Ints) -> int:
    """Write the columns from the first to behind the last that is used, for every row; return how many pixels that makes."""
    total = 0
    for r in range(len(mask)):
        first, stop = 0, 0
        for c in range(mask.shape[1]):
            if mask[r, c] != 0.0:
                if stop == 0:
                    first = c
                stop = c + 1
        spans[r, 0], spans[r, 1] = first, stop
        total += stop - first
    return total


@jit
def in_one_row(image: Singles, spans: Ints) -> None:
    """Move the pixels of the spans to the beginning of an image, row after row."""
    flat, n = image.reshape(image.size), 0
    for r in range(len(spans)):
        for c in range(spans[r, 0], spans[r, 1]):
            flat[n] = image[r, c]
            n += 1


@jit
def approach(
    window: Window,
    pixels: Pixels,
    canvas: Canvas,
    model: Model,
    p: Array,
    found: Array,
    used: Ints,
    limits: tuple[float, float, float],
    system: System,
) -> Course:
    """Fit one target from p, which becomes the parameters that were looked at last, those of the images and kept weights.

    ``found`` gets the result, which the last step leads to. ``limits``: longest half axis and broadest blur that are tried, in px, and the
    darkest background, in DN.
    """
    kind, noise, count, parameters = model.kind, model.noise, len(used), len(p)
    largest, broadest, darkest = limits
    begin, trial, figures = p.copy(), p.copy(), np.empty(3)
    ground, light = False, False
    for a in range(count):
        ground, light = ground or used[a] == parameters - 4, light or used[a] == parameters - 1
    kept, weight = window.kept, window.weight
    kept[:] = 0.0
    chi2, merit, strained, damping, falls, steps = math.inf, math.inf, 0.0, 0.0, 0.0, 0
    at_rest = False
    while steps < STEPS:
        steps += 1
        good = allowed(kind, trial, begin, largest, broadest)
        if good:
            now = Window(window.images, window.data, window.mask, weight, kept, window.residual)
            draw_mean(now.images, pixels, canvas, model, trial, (ground, light))
            squares, before, after = weigh(now, noise, model.efficiency, *mean_range(kind, trial))
            held = strain(kind, trial, begin)
            good = before + held <= merit + strained + 1e-4 * chi2 + 0.02  # the template is not smoother than this
        if good:
            p[:] = trial
            chi2, merit, strained = squares, after, held
            kept, weight = weight, kept
            normal_equations(window.images, window.residual, kept, used, 0, system)
            hold(kind, p, begin, used, system)
            damping = 0.0 if damping < 1e-3 else 0.1 * damping
        else:
            damping = max(10.0 * damping, 1e-2)
            if damping > 1e8:
                break
        if not solve(system.normal, count, system.gradient, damping + RIDGE, system.factor, system.step):
            break
        if pin(kind, p, used, darkest, system) and not solve(
            system.normal, count, system.gradient, damping + RIDGE, system.factor, system.step
        ):
            break
        fell, falls = falls, dot(system.step[:count], system.gradient[:count])
        if steps > PATIENCE and falls > 0.25 * fell:  # to and fro: half a step lands between
            system.step[:count] *= 0.5
        move(kind, p, system.step, used, darkest, trial)
        if good and (damping == 0.0 or (steps > PATIENCE and damping < 0.05)):
            # steps shrink by a like factor each time, or faster: what the next one will bring is known before it is made
            next_falls = falls * min(1.0, falls / fell)
            at_rest = next_falls < AT_REST
            if steps > PATIENCE and falls < HARDLY and not at_rest:
                at_rest = place_covariance(count, system, figures) and place_at_rest(system.step, figures)
            if at_rest:
                break
    window.kept[:] = kept
    # only the place need be at rest: a shape of which the image tells nothing may leap where it encloses nothing
    found[:] = trial if at_rest and allowed(kind, trial, begin, largest, broadest) else p
    return Course(chi2, falls, steps, at_rest)


@jit
def spread_of(window: Window, spans: Ints, used: Ints, noise: Noise, system: System, fits: Fits, i: int) -> None:
    """Variances and covariance of target i from its normal equations, and what rows do that are shifted."""
    count, variance, covariance = len(used), fits.variance[i], fits.covariance[i]
    if factorise(system.normal, count, RIDGE, system.factor):
        for a in range(count):
            system.right[:count] = 0.0
            system.right[a] = 1.0
            substitute(system.factor, count, system.right, system.right)
            variance[used[a]] = system.right[a]
            if a < 2:
                covariance[a], covariance[1 + a] = system.right[0], system.right[1]
    fits.quality[i, 9] = max(covariance[0], covariance[2])
    if noise.row_shift_px2 > 0.0 or noise.field_shift_px2 > 0.0:
        answers, n = np.zeros((len(spans), MOST)), 0
        if factorise(system.normal, count, RIDGE, system.factor):
            for r in range(len(spans)):
                wide = spans[r, 1] - spans[r, 0]
                row_answer(window.images[:, 0, n : n + wide], window.kept[0, n : n + wide], used, system, answers[r])
                n += wide
            add_row_shifts(answers, used, noise, variance, covariance)


@jit
def better_start(kind: int, window: Window, noise: Noise, aperture: float, p: Array) -> None:
    """Put size, blur and height that the sums of the heights, of their squares and cubes tell in place of rough ones.

    With f the share of the light, Σ f = F, the area; Σ f² = F − q and Σ f³ = F − 3q/2 with q = σL/√π, L the outline's length and σ the
    edge's standard deviation, for ∫ Φ (1 − Φ) = 1/√π. Of discs and ellipses that are much larger than their blur and
    stand clear of the noise.
    """
    s = SHAPES[kind]
    if s != 1 and s != 3:
        return
    area = p[2] * p[2] if s == 1 else p[2] * p[3] - p[4] * p[4]
    long = longest_px(kind, p)
    short = area / long
    if short < LARGE * math.hypot(p[2 + s], 0.3 * aperture):
        return
    sign, height, ground = math.copysign(1.0, p[3 + s]), abs(p[3 + s]), p[4 + s]
    data, mask = window.data[0], window.mask[0]
    n, first, second, third = 0.0, 0.0, 0.0, 0.0
    for i in range(len(data)):
        h = sign * mask[i] * (data[i] - ground)
        n += mask[i]
        first += h
        second += h * h
        third += h * h * h
    variance, rise = variance_of(max(ground - noise.black_dn, 0.0), noise), sign * noise.slope_dn
    if height * height < CLEAR * CLEAR * variance:
        return
    third -= 3.0 * (variance * first + rise * second)
    second -= n * variance + rise * first
    root = 2.25 * second * second - 2.0 * first * third
    if not (first > 0.0 and root > 0.0):
        return
    top = (1.5 * second - math.sqrt(root)) / first
    if not 0.7 * height < top < 1.4 * height:
        return
    grown, deficit = math.sqrt(first / (top * math.pi * area)), first / top - second / (top * top)
    around = math.pi * grown * (3.0 * (long + short) - math.sqrt((3.0 * long + short) * (long + 3.0 * short)))
    edge = deficit * math.sqrt(math.pi) / around
    if not (0.8 < grown < 1.25 and edge > 0.3 and LARGE * edge < short):
        return
    p[2 : 2 + s] *= grown
    p[2 + s], p[3 + s] = math.sqrt(max(edge * edge - aperture * aperture / 12.0, 0.04)), sign * top


@jit
def fit(
    model: Model, start: Array, rough: bool, free: NDArray[np.bool_], test: bool, about: About, which: Ints, packed: Packed, fits: Fits
) -> None:
    """Fit the template to the targets ``which``, whose windows `cut_out` has packed.

    ``start``, shape (n, parameters); ``rough``: whether it is as detected. ``free``: which parameters are unknown, the base and perhaps
    planes. ``test``: whether to test planes, none of which is free then.
    """
    kind, parameters = model.kind, start.shape[1]
    s = SHAPES[kind]
    side = 2 * about.half[which].max() + 1
    most = side * ((side + 7) // 8 * 8)
    longest, broadest = 0.0, 0.3
    for i in which:
        longest = max(longest, longest_px(kind, start[i]))
        broadest = max(broadest, start[i, 2 + s])
    largest, broadest = 2.0 * longest + 2.0, 2.5 * broadest + 0.5
    blocks = block_count(reach_px(broadest, model.aperture))
    in_whole = kind == SPOT or parameters - np.count_nonzero(free) != 4  # of which draw_plain draws nothing
    store_whole, store_spans = np.zeros((parameters + 1) * most if in_whole else 0), np.empty((side, 2), np.int64)
    store_planes = np.empty(side * 8 * ((side + 7) // 8 * 8 + 2 * PAD), np.float32)
    store, store_residual = np.empty((parameters + 1) * most), np.empty(most)
    store_weight, store_kept = np.empty(most), np.empty(most)
    points = np.empty((point_count(largest, LEAST_BLUR_PX) + 1, 7))
    table = np.empty((phase_count(LEAST_BLUR_PX) + 2, 48 * blocks), np.float32)
    across, down, parts = np.empty((blocks, 40), np.float32), np.empty((blocks, 40), np.float32), np.empty((3, 64), np.float32)
    system, p = system_for(most), np.empty(parameters)
    used, every = np.flatnonzero(free), np.arange(parameters)
    count = len(used)
    darkest = model.noise.black_dn + LEAST_BACKGROUND * model.noise.slope_dn if len(model.efficiency) > 0 else -math.inf
    quality = fits.quality
    for w in range(len(which)):
        i = which[w]
        half = about.half[i]
        side = 2 * half + 1
        wide = (side + 7) // 8 * 8
        size, first = side * wide, packed.place[w]
        data, mask = packed.data[first : first + size], packed.mask[first : first + size]
        whole = store_whole[: (parameters + 1) * size].reshape(parameters + 1, side, wide) if in_whole else store_whole.reshape(0, 0, 0)
        pixels = Pixels(store_spans[:side], whole)
        n = span_rows(mask.reshape(side, wide), pixels.spans)
        in_one_row(data.reshape(side, wide), pixels.spans)
        in_one_row(mask.reshape(side, wide), pixels.spans)
        window = Window(
            store[: (parameters + 1) * n].reshape(parameters + 1, 1, n),
            data[:n].reshape(1, n),
            mask[:n].reshape(1, n),
            store_weight[:n].reshape(1, n),
            store_kept[:n].reshape(1, n),
            store_residual[:n].reshape(1, n),
        )
        canvas = Canvas(store_planes[: side * 8 * (wide + 2 * PAD)].reshape(side, 8 * (wide + 2 * PAD)), points, table, across, down, parts)
        col0, row0 = int(round(about.home[i, 0])) - half, int(round(about.home[i, 1])) - half
        p[:] = start[i]
        p[0] -= col0
        p[1] -= row0
        fits.parameters[i], fits.variance[i], fits.covariance[i] = math.nan, math.nan, math.nan
        quality[i, 0], quality[i, 2:5], quality[i, 5] = math.nan, 0.0, -1.0
        if quality[i, 1] <= count:
            continue
        if rough and quality[i, 6] == 0.0 and quality[i, 7] == 0.0 and quality[i, 8] == 0.0:
            better_start(kind, window, model.noise, model.aperture, p)
        chi2, falls, steps, at_rest = approach(
            window, pixels, canvas, model, p, fits.parameters[i], used, (largest, broadest, darkest), system
        )
        if math.isinf(chi2):
            fits.parameters[i] = math.nan
            continue
        fits.parameters[i, 0] += col0
        fits.parameters[i, 1] += row0
        quality[i, 0], quality[i, 5] = chi2 - max(falls, 0.0), steps if at_rest else -steps
        if not at_rest:
            continue
        spread_of(window, pixels.spans, used, model.noise, system, fits, i)
        if test:
            add_planes(window.images, pixels.spans, p, count)
            normal_equations(window.images, window.residual, window.kept, every, count, system)
            test_planes(system, count, quality[i])


@jit
def row_answer(images: Array, weight: Array, used: Ints, system: System, out: Array) -> None:
    """How the unknowns answer to a shift of a row along x: N⁻¹ Jᵀ W ∂µ/∂x over the row; the system holds the factor of N."""
    for a in range(len(used)):
        total = 0.0
        for c in range(len(weight)):
            total += weight[c] * images[1, c] * images[1 + used[a], c]
        out[a] = total
    substitute(system.factor, len(used), out, out)


@jit
def add_row_shifts(answers: Array, used: Ints, noise: Noise, variance: Array, covariance: Array) -> None:
    """Add to the covariance what rows do that are shifted by themselves, or alike in a field of every other row."""
    lone, field, count = noise.row_shift_px2, noise.field_shift_px2, len(used)
    carried = np.zeros((2, MOST))
    for r in range(len(answers)):
        own, before = answers[r], carried[r % 2]
        for a in range(count):
            variance[used[a]] += lone * own[a] * own[a] + field * (own[a] * own[a] + 2.0 * own[a] * before[a])
        for k in range(3):
            a, b = (0, 0) if k == 0 else (0, 1) if k == 1 else (1, 1)
            covariance[k] += lone * own[a] * own[b] + field * (own[a] * own[b] + own[a] * before[b] + before[a] * own[b])
        for a in range(count):
            before[a] = ALIKE * (before[a] + own[a])


@jit(**DOT)
def leverages(images: Array, weight: Array, inverse: Array, count: int, scratch: Array, out: Array) -> None:
    """Write w Jᵀ (JᵀWJ)⁻¹ J of every pixel, for the first ``count`` derivatives; pixels in the innermost loop fill the registers."""
    size = weight.size
    w, total, along = weight.reshape(size), out.reshape(size), scratch[:size]
    total[:] = 0.0
    for a in range(count):
        column = images[1 + a].reshape(size)
        for i in range(size):
            along[i] = inverse[a, a] * column[i]
        for b in range(a):
            other, twice = images[1 + b].reshape(size), 2.0 * inverse[a, b]
            for i in range(size):
                along[i] += twice * other[i]
        for i in range(size):
            total[i] += column[i] * along[i]
    for i in range(size):
        total[i] *= w[i]


@jit
def residuals(
    frame: NDArray[np.generic], model: Model, parameters: Array, slopes: int, which: Ints, about: About, rows: bool
) -> tuple[Array, Array, Array, Array, Array]:
    """Return what the pixels of fitted targets leave: levels, residuals/√(1 − leverage), slopes of the mean in DN per pixel; or, with
    ``rows``, of their rows (at most `ROWS` a target) the scores Σ w µ_x (d − µ), and the covariance of these under white noise.

    The first ``slopes`` parameters of the planes were among the unknowns. What is not asked for is empty, or 0.
    """
    kind = model.kind
    count = SHAPES[kind] + 5 + slopes
    used = np.arange(count)
    most, widest = 0, 0
    for w in range(len(which)):
        side = 2 * about.half[which[w]] + 1
        widest = max(widest, side * ((side + 7) // 8 * 8))
        most += side * ((side + 7) // 8 * 8)
    levels, found, steep = np.empty(most), np.empty(most), np.empty(most)
    scores, spread = np.zeros((len(which), ROWS)), np.zeros((len(which), ROWS, ROWS))
    total = 0
    quality = np.empty((len(about.home), 10))
    system, inverse, unit = system_for(widest), np.zeros((MOST, MOST)), np.zeros(MOST)
    for w in range(len(which)):
        i = which[w]
        side = 2 * about.half[i] + 1
        wide = (side + 7) // 8 * 8
        data, mask = np.empty(side * wide, np.float32), np.empty(side * wide, np.float32)
        cut_out(frame, about, model.noise, which[w : w + 1], Packed(np.zeros(1, np.int64), data, mask), quality)
        p = parameters[i].copy()
        p[0] -= int(round(about.home[i, 0])) - about.half[i]
        p[1] -= int(round(about.home[i, 1])) - about.half[i]
        images = mean_images(kind, p, side, side, model.aperture, True)
        weight, residual, kept = np.empty((side, wide)), np.empty((side, wide)), np.zeros((side, wide))
        window = Window(images, data.reshape(side, wide), mask.reshape(side, wide), weight, kept, residual)
        weigh(window, model.noise, np.empty(0), *mean_range(kind, p))
        normal_equations(images, residual, weight, used, 0, system)
        inverse[:] = 0.0
        if factorise(system.normal, count, RIDGE, system.factor):
            for a in range(count):
                unit[:count] = 0.0
                unit[a] = 1.0
                substitute(system.factor, count, unit, inverse[a])
        if rows:
            row_scores(window, used, system, scores[w], spread[w])
            continue
        leverages(images, weight, inverse, count, system.scratch[0], kept)
        for r in range(side):
            for c in range(side):
                if window.mask[r, c] == 0.0:
                    continue
                left = 1.0 - kept[r, c]
                if left > 0.1:
                    levels[total], found[total] = images[0, r, c], residual[r, c] / math.sqrt(left)
                    steep[total] = math.hypot(images[1, r, c], images[2, r, c])
                    total += 1
    return levels[:total], found[:total], steep[:total], scores, spread


@jit
def held_back(
    frame: NDArray[np.generic], model: Model, parameters: Array, planes: tuple[bool, bool], which: Ints, about: About
) -> tuple[Array, Array, Array]:
    """Which planes parts of a target's pixels ask for, to be compared with the pixels that were held back; NaN where they tell nothing.

    Returned are, for both halves of the window, the shift of the place that the planes bring, shape (2, n, 2), px, and their slopes, shape
    (2, n, 4); and the slopes of grey values inside the target, shape (2, n, 2), DN per pixel: those that the pixels outside of its flat
    core ask for, and those of the core. The halves are opposite quadrants, so that both reach to all sides and share no pixel. ``planes``:
    whether those of the background and of the light are asked for. Fits without planes are at their end in ``parameters``.
    """
    kind, base = model.kind, SHAPES[model.kind] + 5
    amplitude = base - 2
    count = base + 2 * planes[0] + 2 * planes[1]
    used = np.arange(count)
    if not planes[0]:
        used[base:] += 2
    n = len(which)
    moved, slopes, inside = np.full((2, n, 2), math.nan), np.full((2, n, 4), math.nan), np.full((2, n, 2), math.nan)
    quality = np.empty((len(about.home), 10))
    side = 2 * about.half[which].max() + 1
    most = side * ((side + 7) // 8 * 8)
    whole, part, step, reply = system_for(most), system_for(most), np.zeros(MOST), np.zeros(MOST)
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for w in range(n):
        i = which[w]
        side = 2 * about.half[i] + 1
        wide = (side + 7) // 8 * 8
        data, mask = np.empty(side * wide, np.float32), np.empty(side * wide, np.float32)
        cut_out(frame, about, model.noise, which[w : w + 1], Packed(np.zeros(1, np.int64), data, mask), quality)
        p = parameters[i].copy()
        p[0] -= int(round(about.home[i, 0])) - about.half[i]
        p[1] -= int(round(about.home[i, 1])) - about.half[i]
        images = mean_images(kind, p, side, side, model.aperture, model.surface)
        weight, residual, kept = np.empty((side, wide)), np.empty((side, wide)), np.zeros((side, wide))
        window = Window(images, data.reshape(side, wide), mask.reshape(side, wide), weight, kept, residual)
        weigh(window, model.noise, np.empty(0), *mean_range(kind, p))
        normal_equations(images, residual, weight, used, 0, whole)
        if not factorise(whole.normal, base, RIDGE, whole.factor):
            continue
        for h in range(3):
            for r in range(side):
                for c in range(side):
                    own = images[1 + amplitude, r, c] < CORE if h == 2 else ((r > p[1]) == (c > p[0])) == (h == 0)
                    kept[r, c] = weight[r, c] if own else 0.0
            normal_equations(images, residual, kept, used, 0, part)
            if not solve(part.normal, count, part.gradient, RIDGE, part.factor, step):
                continue
            if h < 2:
                for a in range(base):  # what the planes leave to the place, in the whole window
                    reply[a] = dot(whole.normal[a, base:count], step[base:count])
                substitute(whole.factor, base, reply, reply)
                moved[h, w] = -reply[:2]
                slopes[h, w] = 0.0
                for a in range(base, count):
                    slopes[h, w, used[a] - base] = step[a]
                continue
            normal[:], right[:], seen = 0.0, 0.0, 0
            for r in range(side):
                for c in range(side):
                    if weight[r, c] == 0.0 or images[1 + amplitude, r, c] < CORE:
                        continue
                    rest = residual[r, c]
                    for a in range(base):
                        rest -= images[1 + a, r, c] * step[a]
                    lever = (1.0, c - p[0], r - p[1])
                    seen += 1
                    for a in range(3):
                        right[a] += weight[r, c] * lever[a] * rest
                        for b in range(3):
                            normal[a, b] += weight[r, c] * lever[a] * lever[b]
            if seen >= LEAST_CORE and solve(normal, 3, right, RIDGE, part.factor, reply):
                for k in range(2):
                    inside[1, w, k] = reply[1 + k]
                    inside[0, w, k] = 0.0
                    for a in range(base, count):
                        if used[a] == base + k or used[a] == base + 2 + k:
                            inside[0, w, k] += step[a] * (1.0 if used[a] < base + 2 else p[amplitude])
    return moved, slopes, inside


@jit
def lone_outliers(frame: NDArray[np.generic], model: Model, parameters: Array, which: Ints, about: About, limit: float) -> Ints:
    """Pixels that stand out from a fitted target alone, rows of (target, row, column): the residual is more than ``limit`` standard
    deviations, and more than twice those of the four neighbours on its side. Where there are more than `MOST_LONE`, it is the shape.
    """
    found, total = np.empty((MOST_LONE * len(which), 3), np.int64), 0
    quality = np.empty((len(about.home), 10))
    for w in range(len(which)):
        i = which[w]
        side = 2 * about.half[i] + 1
        wide = (side + 7) // 8 * 8
        data, mask = np.empty(side * wide, np.float32), np.empty(side * wide, np.float32)
        cut_out(frame, about, model.noise, which[w : w + 1], Packed(np.zeros(1, np.int64), data, mask), quality)
        row0, col0 = int(round(about.home[i, 1])) - about.half[i], int(round(about.home[i, 0])) - about.half[i]
        p = parameters[i].copy()
        p[0] -= col0
        p[1] -= row0
        images = mean_images(model.kind, p, side, side, model.aperture, model.surface)
        weight, residual, kept = np.empty((side, wide)), np.empty((side, wide)), np.zeros((side, wide))
        weigh(
            Window(images, data.reshape(side, wide), mask.reshape(side, wide), weight, kept, residual), model.noise, np.empty(0), 0.0, 0.0
        )
        count = 0
        for r in range(side):
            for c in range(side):
                own = residual[r, c]
                if weight[r, c] * own * own <= limit * limit:
                    continue
                sign, beside = math.copysign(1.0, own), 0.0
                for dr, dc in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                    if 0 <= r + dr < side and 0 <= c + dc < side:
                        beside = max(beside, sign * residual[r + dr, c + dc])
                if 2.0 * beside < abs(own):
                    count += 1
                    if count <= MOST_LONE:
                        found[total, 0], found[total, 1], found[total, 2] = i, row0 + r, col0 + c
                        total += 1
        if count > MOST_LONE:
            total -= MOST_LONE
    return found[:total]


@jit
def row_scores(window: Window, used: Ints, system: System, scores: Array, spread: Array) -> None:
    """Scores of shifts of the middle rows of a window along x, and their covariance under white noise."""
    images, weight, residual = window.images, window.weight, window.residual
    side = weight.shape[0]
    first = max(0, (side - ROWS) // 2)
    stop = min(side, first + ROWS)
    answers = np.zeros((side, MOST))
    if not factorise(system.normal, len(used), RIDGE, system.factor):
        return
    for r in range(first, stop):
        row_answer(images[:, r], weight[r], used, system, answers[r])
    for r in range(first, stop):
        for c in range(side):
            scores[r - first] += weight[r, c] * images[1, r, c] * residual[r, c]
            spread[r - first, r - first] += weight[r, c] * images[1, r, c] * images[1, r, c]
    for r in range(first, stop):
        for a in range(len(used)):
            told = 0.0
            for c in range(side):
                told += weight[r, c] * images[1, r, c] * images[1 + used[a], r, c]
            for q in range(first, stop):
                spread[q - first, r - first] -= told * answers[q, a]


@jit
def mean_images(kind: int, p: Array, rows: int, cols: int, aperture: float, surface: bool) -> Array:
    """Mean and derivatives by all parameters of a window whose first pixel is (0, 0); shape (parameters + 1, rows, cols + padding)."""
    s = SHAPES[kind]
    wide = (cols + 7) // 8 * 8
    images = np.zeros((s + 10, rows, wide))
    planes = np.empty((rows, 8 * (wide + 2 * PAD)), np.float32)
    points = np.empty((point_count(longest_px(kind, p), p[2 + s]) + 1, 7))
    blocks = block_count(reach_px(p[2 + s], aperture))
    table = np.empty((phase_count(p[2 + s]) + 1, 48 * blocks), np.float32)
    across, down, parts = np.empty((blocks, 40), np.float32), np.empty((blocks, 40), np.float32), np.empty((3, 64), np.float32)
    draw(images, Canvas(planes, points, table, across, down, parts), kind, p, aperture, True, surface)
    complete(images, kind, p, True, surface)
    return images
