"""Kernels of template fits: weighted least squares of one target after the other, by Gauss–Newton steps with Levenberg's damping."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.jit import jit
from pixmetry.locate.template._contour_template_kernels import (
    ELLIPSE,
    PAD,
    RING,
    SHAPES,
    SPOT,
    block_count,
    cdf,
    complete,
    draw,
    draw_plain,
    pdf,
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
SMALL = 2.0  # half axis over blur below which they can hardly be told apart
VAGUE = 0.5  # relative standard deviation at which radius and blur are held where the image does not tell them apart
LEAST_SHARE = 0.05  # of the variance that clipping leaves: pixels far beyond the end, which say nothing, must not gain weight
CLIP = 6.0  # standard deviations from the scale's ends within which clipping is looked at
LEAST_BACKGROUND = 0.01  # electrons, where their likelihood is used: there are no negative ones
LEAST_ELECTRONS = 1e-3  # below it a pixel is as good as dark
MOST_ELECTRONS = 60.0  # of a reading, from which it is as good as a shifted Poisson number
PER_E = 8.0  # entries of the efficiency per unit of log(electrons)
ROWS = 32  # of a target, at most, that are asked whether rows are shifted against each other
ALIKE = math.exp(-1.0 / 5.0)  # correlation of the shifts of two lines of a field that follow each other, where a loop carries them on
DOT = {"fastmath": {"reassoc", "contract", "nsz"}}


@jit(**DOT)
def dot(a, b):
    """Sum of products."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@jit
def solve(n, normal, gradient, damping, step, factor):
    """Solve (N + damping · diag N) step = gradient by Cholesky's factor of the scaled matrix; False if it is singular."""
    for i in range(n):
        for j in range(i + 1):
            total = normal[i, j] / math.sqrt(normal[i, i] * normal[j, j])
            if i == j:
                total += damping + 1e-12
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 1e-14:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    for i in range(n):
        total = gradient[i] / math.sqrt(normal[i, i])
        for k in range(i):
            total -= factor[i, k] * step[k]
        step[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * step[k]
        step[i] = total / factor[i, i]
    for i in range(n):
        step[i] /= math.sqrt(normal[i, i])
    return True


@jit
def clipped(level, variance, slope, low, high):
    """Mean and variance of min(max(level + n, low), high) with normal n, and the mean's derivative; ``slope``: d variance / d level."""
    s = math.sqrt(variance)
    a, b = (low - level) / s, (high - level) / s
    if a < -CLIP and b > CLIP:
        return level, variance, 1.0
    a, b = max(a, -1e6), min(b, 1e6)  # where the scale has no end
    ca, cb, pa, pb = cdf(a), cdf(b), pdf(a), pdf(b)
    below = s * (a * ca + pa)  # E max(low − value, 0)
    above = s * (pb - b * (1.0 - cb))  # E max(value − high, 0)
    mean = level + below - above
    inside = cb - ca
    # second moment of (value − level) after clipping
    second = variance * (inside - (b * pb if b < CLIP else 0.0) + (a * pa if a > -CLIP else 0.0))
    if a > -CLIP:
        second += variance * a * a * ca
    if b < CLIP:
        second += variance * b * b * (1.0 - cb)
    shift = mean - level
    return mean, max(second - shift * shift, LEAST_SHARE * variance), inside + (pa - pb) * slope / (2.0 * s)


@jit
def electrons_expected(d, mean, sigma):
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
def plain_weights(mean, data, mask, weight, residual, w):
    """`weigh` where the variance is the same everywhere."""
    total = 0.0
    for i in range(len(mean)):
        d = data[i] - mean[i]
        weight[i], residual[i] = w * mask[i], d
        total += mask[i] * d * d
    return w * total


@jit
def weigh(images, data, mask, weight, kept, residual, noise, efficiency, least, most):
    """Set the weights and residuals at the mean that the images hold; return χ², and what a better fit makes smaller, for now and for next.

    A weight is 1/variance of the mean. Where the scale ends, the mean and its derivatives become those of the clipped value. What shrinks
    is χ² with the ``kept`` weights. With an ``efficiency`` it is −2 ln likelihood; where a reading has few electrons its weight is then its
    exact information, and the residual its score over that. No mean is known to be outside ``least`` … ``most``.
    """
    constant, slope, pattern, black, low, high = noise[0], noise[1], noise[2], noise[3], noise[4], noise[5]
    chi2, before, after = 0.0, 0.0, 0.0
    level_free = slope == 0.0 and pattern == 0.0
    s = math.sqrt(constant)
    lowest, highest = (low + CLIP * s, high - CLIP * s) if level_free else (math.inf, -math.inf)
    ended = low > -math.inf or high < math.inf
    sigma_e = s / slope if slope > 0.0 else 0.0
    exact = len(efficiency) > 0 and slope > 0.0
    if level_free and (not ended or (lowest < least and most < highest)):
        size = data.size
        mean, w, d = images[0].reshape(size), weight.reshape(size), residual.reshape(size)
        chi2 = plain_weights(mean, data.reshape(size), mask.reshape(size), w, d, 1.0 / constant)
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
                variance += slope * light + pattern * pattern * light * light
                if light > 0.0:
                    rise = slope + 2.0 * pattern * pattern * light
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
def mean_range(kind, p):
    """Least and greatest mean that a template without planes can have; with planes anything."""
    k = SHAPES[kind] + 3
    if p[k + 2] != 0.0 or p[k + 3] != 0.0 or p[k + 4] != 0.0 or p[k + 5] != 0.0:
        return -math.inf, math.inf
    margin = 1e-4 * abs(p[k])
    return min(p[k + 1], p[k + 1] + p[k]) - margin, max(p[k + 1], p[k + 1] + p[k]) + margin


@jit
def normal_equations(images, residual, weight, used, first, count, normal, gradient, scratch):
    """Fill JᵀWJ and JᵀW · residual for the ``used`` parameters, from the ``first`` on; the images hold the derivatives."""
    size = weight.size
    w, d = weight.reshape(size), residual.reshape(size)
    for a in range(first, count):
        column = images[1 + used[a]].reshape(size)
        for i in range(size):
            scratch[i] = w[i] * column[i]
        for b in range(a + 1):
            normal[a, b] = normal[b, a] = dot(scratch[:size], images[1 + used[b]].reshape(size))
        gradient[a] = dot(scratch[:size], d)


@jit
def cut_out(frame, start, half, outer, reach, near_start, near_index, low, high, which, place, data, mask, quality):
    """Copy the windows of the targets ``which``, packed at ``place``, rows filled up to a multiple of eight.

    The mask is 0 outside the frame, beyond the reach of the target and where a neighbour is nearer. ``quality`` gets: 1 pixels used,
    6 whether the frame cuts the window, 7 and 8 pixels at the upper and lower end of the scale.
    """
    for w in range(len(which)):
        i = which[w]
        side = 2 * half[i] + 1
        wide = (side + 7) // 8 * 8
        x0, y0 = start[i, 0], start[i, 1]
        col0, row0 = int(round(x0)) - half[i], int(round(y0)) - half[i]
        far = outer[i] + reach[i, 0]
        used, cut, top, bottom = 0, 0.0, 0, 0
        k = place[w]
        for r in range(side):
            y = row0 + r
            for c in range(wide):
                x = col0 + c
                data[k + c], mask[k + c] = 0.0, 0.0
                dx, dy = x - x0, y - y0
                if c >= side or dx * dx + dy * dy > far * far:
                    continue
                if y < 0 or x < 0 or y >= frame.shape[0] or x >= frame.shape[1]:
                    cut = 1.0
                    continue
                own = True
                for n in range(near_start[i], near_start[i + 1]):
                    j = near_index[n]
                    e = math.hypot(x - start[j, 0], y - start[j, 1]) - outer[j]
                    if e < reach[j, 1] or e < math.hypot(dx, dy) - outer[i]:
                        own = False
                        break
                if own:
                    value = frame[y, x]
                    data[k + c], mask[k + c] = value, 1.0
                    used += 1
                    top += value >= high
                    bottom += value <= low
            k += wide
        quality[i, 1], quality[i, 6], quality[i, 7], quality[i, 8] = used, cut, top, bottom


@jit
def allowed(kind, p, start, largest, broadest):
    """Whether parameters are such that the template can be drawn and still belongs to this target."""
    s = SHAPES[kind]
    away = 1.0 + 0.5 * longest_px(kind, start) + start[2 + s]
    if not (abs(p[0] - start[0]) < away and abs(p[1] - start[1]) < away):
        return False
    if not (longest_px(kind, p) < largest and p[2 + s] < broadest):
        return False
    if s == 1:
        return p[2] > 0.0
    if s == 2:
        return p[2] > p[3] > 0.0
    return s == 0 or (p[2] > 0.0 and p[3] > 0.0 and p[2] * p[3] > p[4] * p[4])


@jit
def hold(kind, p, start, used, count, normal, gradient):
    """Hold radii and blur weakly to their start values, which matters only where the image does not tell them apart."""
    s = SHAPES[kind]
    for a in range(count):
        j = used[a]
        if 2 <= j <= 2 + s and not (s == 3 and j == 4):
            w = 1.0 / (VAGUE * math.hypot(start[j], 0.4)) ** 2
            normal[a, a] += w
            gradient[a] -= w * (p[j] - start[j])


@jit
def strain(kind, p, start):
    """What `hold` adds to χ²."""
    s = SHAPES[kind]
    total = 0.0
    for j in range(2, 3 + s):
        if not (s == 3 and j == 4):
            total += ((p[j] - start[j]) / (VAGUE * math.hypot(start[j], 0.4))) ** 2
    return total


@jit
def longest_px(kind, p):
    """Longest half axis of a shape; of a spot 0."""
    if kind == SPOT:
        return 0.0
    if SHAPES[kind] == 3:
        return 0.5 * (abs(p[2] + p[3]) + math.hypot(p[2] - p[3], 2.0 * p[4]))
    return p[2]


@jit
def moments(kind, p, step, out):
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
def move(kind, p, step, used, count, darkest, full, figures, out):
    """Take a step; blur and radii stay above what can be drawn, and change by at most a third, the background not below the ``darkest``.

    Of a shape smaller than its blur the image tells little more than the light and the second moment. A step then changes these by what it
    says to first order, so that it follows the curved valley along which radius, blur and amplitude make up for each other.
    """
    s = SHAPES[kind]
    share = 1.0
    full[: len(p)] = 0.0
    for a in range(count):
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
def pin(kind, p, step, used, count, darkest, normal, gradient):
    """Take blur, radii and background that would fall below their least values out of the equations; True if there are such."""
    s = SHAPES[kind]
    found = False
    for a in range(count):
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
def place_covariance(count, normal, right, column, factor, out):
    """Covariance of x and y from the normal equations: xx, xy, yy; False if these are singular."""
    for a in range(2):
        right[:count] = 0.0
        right[a] = 1.0
        if not solve(count, normal, right, 0.0, column, factor):
            return False
        out[a], out[1 + a] = column[0], column[1]
    return True


@jit
def place_at_rest(step, c):
    """Whether a step in x and y is small against their covariance c."""
    det = c[0] * c[2] - c[1] * c[1]
    return step[0] * step[0] * c[2] - 2.0 * step[0] * step[1] * c[1] + step[1] * step[1] * c[0] < AT_REST * det


@jit
def falls_with(normal, gradient, chosen, small, right, step, factor):
    """Expected fall of χ² when the chosen parameters are set free."""
    m = len(chosen)
    for a in range(m):
        right[a] = gradient[chosen[a]]
        for b in range(m):
            small[a, b] = normal[chosen[a], chosen[b]]
    return dot(step[:m], right[:m]) if solve(m, small, right, 0.0, step, factor) else 0.0


@jit
def add_planes(images, p, count):
    """Derivatives by the slopes of background and light, where these are 0.

    Light on the surface differs from light on the image, which this is, by a shift, which is among the unknowns.
    """
    for r in range(images.shape[1]):
        dy = r - p[1]
        for c in range(images.shape[2]):
            dx = c - p[0]
            light = p[count - 2] * images[count - 1, r, c]
            images[count + 1, r, c], images[count + 2, r, c] = dx * images[count, r, c], dy * images[count, r, c]
            images[count + 3, r, c], images[count + 4, r, c] = dx * light, dy * light


@jit
def test_planes(normal, gradient, count, small, right, step, factor, quality):
    """Expected falls of χ² with a plane of the background (2), of the light (3) and with both (4)."""
    chosen = np.arange(count + 4)
    none = falls_with(normal, gradient, chosen[:count], small, right, step, factor)
    quality[4] = falls_with(normal, gradient, chosen, small, right, step, factor) - none
    quality[2] = falls_with(normal, gradient, chosen[: count + 2], small, right, step, factor) - none
    chosen[count], chosen[count + 1] = count + 2, count + 3
    quality[3] = falls_with(normal, gradient, chosen[: count + 2], small, right, step, factor) - none


@jit
def fit(
    kind, start, free, test, home, half, which, place, data, mask, noise, efficiency, aperture, surface, out, variance, covariance, quality
):
    """Fit the template to the targets ``which``, whose windows `cut_out` has packed.

    ``start``: n × parameters; ``home``: n × 2 or more, the places that the windows are about. ``free``: which parameters are unknown, the
    base and perhaps planes. ``test``: whether to test planes, none of which is free then. Results: ``out`` (parameters), ``variance`` of
    each, ``covariance`` of x and y, and ``quality``: 0 χ², 2 to 4 the expected falls of χ² with planes, 5 steps (negative: not at rest),
    9 the larger variance of x and y by the pixels' noise alone.
    """
    parameters = start.shape[1]
    s = SHAPES[kind]
    side = 2 * half[which].max() + 1
    most = side * ((side + 7) // 8 * 8)
    longest, broadest = 0.0, 0.3
    for i in which:
        longest = max(longest, longest_px(kind, start[i]))
        broadest = max(broadest, start[i, 2 + s])
    largest, broadest = 2.0 * longest + 2.0, 2.5 * broadest + 0.5
    blocks = block_count(reach_px(broadest, aperture))
    store_planes = np.empty(side * 8 * ((side + 7) // 8 * 8 + 2 * PAD), np.float32)
    store, store_residual, scratch = np.empty((parameters + 1) * most), np.empty(most), np.empty(most)
    store_weight, store_kept = np.empty(most), np.empty(most)
    points = np.empty((point_count(largest, LEAST_BLUR_PX) + 1, 7))
    table = np.empty((phase_count(LEAST_BLUR_PX) + 2, 48 * blocks), np.float32)
    across, down, parts = np.empty((blocks, 40), np.float32), np.empty((blocks, 40), np.float32), np.empty((3, 64), np.float32)
    normal, small, factor = np.empty((MOST, MOST)), np.empty((MOST, MOST)), np.empty((MOST, MOST))
    gradient, step, right, column = np.empty(MOST), np.empty(MOST), np.empty(MOST), np.empty(MOST)
    p, trial, begin = np.empty(parameters), np.empty(parameters), np.empty(parameters)
    full, figures = np.empty(parameters), np.empty(4)
    answers, carried = np.empty((side, MOST)), np.empty((2, MOST))
    used = np.flatnonzero(free)
    count = len(used)
    every = np.arange(parameters)
    light = free[parameters - 1]
    darkest = noise[3] + LEAST_BACKGROUND * noise[1] if len(efficiency) > 0 else -math.inf
    for w in range(len(which)):
        i = which[w]
        side = 2 * half[i] + 1
        wide = (side + 7) // 8 * 8
        size = side * wide
        images = store[: (parameters + 1) * size].reshape(parameters + 1, side, wide)
        values = data[place[w] : place[w] + size].reshape(side, wide)
        seen = mask[place[w] : place[w] + size].reshape(side, wide)
        weight, kept = store_weight[:size].reshape(side, wide), store_kept[:size].reshape(side, wide)
        residual = store_residual[:size].reshape(side, wide)
        begin[:] = start[i]
        col0, row0 = int(round(home[i, 0])) - half[i], int(round(home[i, 1])) - half[i]
        begin[0] -= col0
        begin[1] -= row0
        p[:] = begin
        trial[:] = begin
        chi2, merit, strained, damping, falls, steps = math.inf, math.inf, 0.0, 0.0, 0.0, 0
        at_rest = False
        kept[:] = 0.0
        out[i], variance[i], covariance[i] = math.nan, math.nan, math.nan
        quality[i, 0], quality[i, 2:5], quality[i, 5] = math.nan, 0.0, -1.0
        if quality[i, 1] <= count:
            continue
        while steps < STEPS:
            steps += 1
            good = allowed(kind, trial, begin, largest, broadest)
            if good:
                planes = store_planes[: side * 8 * (wide + 2 * PAD)].reshape(side, 8 * (wide + 2 * PAD))
                if light or free[parameters - 4]:
                    draw(images, planes, kind, trial, aperture, light, surface, points, table, across, down, parts)
                    complete(images, kind, trial, light, surface)
                else:
                    draw_plain(images, planes, kind, trial, aperture, points, table, across, down, parts)
                squares, before, after = weigh(images, values, seen, weight, kept, residual, noise, efficiency, *mean_range(kind, trial))
                held = strain(kind, trial, begin)
                good = before + held <= merit + strained + 1e-4 * chi2 + 0.02  # the template is not smoother than this
            if good:
                p[:] = trial
                chi2, merit, strained = squares, after, held
                kept, weight = weight, kept
                normal_equations(images, residual, kept, used, 0, count, normal, gradient, scratch)
                hold(kind, p, begin, used, count, normal, gradient)
                damping = 0.0 if damping < 1e-3 else 0.1 * damping
            else:
                damping = max(10.0 * damping, 1e-2)
                if damping > 1e8:
                    break
            if not solve(count, normal, gradient, damping, step, factor):
                break
            if pin(kind, p, step, used, count, darkest, normal, gradient) and not solve(count, normal, gradient, damping, step, factor):
                break
            fell, falls = falls, dot(step[:count], gradient[:count])
            if steps > PATIENCE and falls > 0.25 * fell:  # to and fro: half a step lands between
                for a in range(count):
                    step[a] *= 0.5
            move(kind, p, step, used, count, darkest, full, figures, trial)
            if good and (damping == 0.0 or (steps > PATIENCE and damping < 0.05)):
                # steps shrink by a like factor each time, or faster: what the next one will bring is known before it is made
                next_falls = falls * min(1.0, falls / fell)
                at_rest = next_falls < AT_REST
                if steps > PATIENCE and falls < HARDLY and not at_rest:
                    at_rest = place_covariance(count, normal, right, column, factor, figures) and place_at_rest(step, figures)
                if at_rest:
                    break
        if math.isinf(chi2):
            continue
        # only the place need be at rest: a shape of which the image tells nothing may leap where it encloses nothing
        out[i] = trial if at_rest and allowed(kind, trial, begin, largest, broadest) else p
        out[i, 0] += col0
        out[i, 1] += row0
        quality[i, 0], quality[i, 5] = chi2 - max(falls, 0.0), steps if at_rest else -steps
        if not at_rest:
            continue
        for a in range(count):
            right[:count] = 0.0
            right[a] = 1.0
            if solve(count, normal, right, 0.0, step, factor):
                variance[i, used[a]] = step[a]
                if a < 2:
                    covariance[i, a], covariance[i, 1 + a] = step[0], step[1]
        quality[i, 9] = max(covariance[i, 0], covariance[i, 2])
        shifted = noise[6] > 0.0 or noise[7] > 0.0
        if shifted and row_answers(images, kept, used, count, normal, 0, side, right, step, factor, answers):
            add_row_shifts(answers[:side], used, count, noise[6], noise[7], carried, variance[i], covariance[i])
        if test:
            add_planes(images, p, count)
            normal_equations(images, residual, kept, every, count, parameters, normal, gradient, scratch)
            test_planes(normal, gradient, count, small, right, step, factor, quality[i])


@jit
def row_answers(images, weight, used, count, normal, first, stop, right, step, factor, out):
    """How the unknowns answer to a shift of each row along x: N⁻¹ Jᵀ W ∂µ/∂x over the row; rows ``first`` … ``stop`` of ``out``."""
    for r in range(first, stop):
        for a in range(count):
            total = 0.0
            for c in range(weight.shape[1]):
                total += weight[r, c] * images[1, r, c] * images[1 + used[a], r, c]
            right[a] = total
        if not solve(count, normal, right, 0.0, step, factor):
            return False
        out[r, :count] = step[:count]
    return True


@jit
def add_row_shifts(answers, used, count, lone, field, carried, variance, covariance):
    """Add to the covariance what rows do that are shifted by themselves (variance ``lone``), or alike in a ``field`` of every other row."""
    carried[:] = 0.0
    for r in range(len(answers)):
        own, before = answers[r], carried[r % 2]
        for a in range(count):
            variance[used[a]] += lone * own[a] * own[a] + field * (own[a] * own[a] + 2.0 * own[a] * before[a])
        for k in range(3):
            a, b = (0, 0) if k == 0 else (0, 1) if k == 1 else (1, 1)
            covariance[k] += lone * own[a] * own[b] + field * (own[a] * own[b] + own[a] * before[b] + before[a] * own[b])
        for a in range(count):
            before[a] = ALIKE * (before[a] + own[a])


@jit
def residuals(frame, kind, parameters, slopes, which, home, half, outer, reach, near_start, near_index, noise, aperture):
    """Return what the pixels of fitted targets leave: levels, residuals/√(1 − leverage), slopes of the mean in DN per pixel; of their rows
    (at most `ROWS` a target) the scores Σ w µ_x (d − µ), and the covariance of these under white noise.

    The first ``slopes`` parameters of the planes were among the unknowns.
    """
    count = SHAPES[kind] + 5 + slopes
    used = np.arange(count)
    most = 0
    for w in range(len(which)):
        side = 2 * half[which[w]] + 1
        most += side * ((side + 7) // 8 * 8)
    levels, found, steep = np.empty(most), np.empty(most), np.empty(most)
    scores, spread = np.zeros((len(which), ROWS)), np.zeros((len(which), ROWS, ROWS))
    total = 0
    quality = np.empty((len(home), 10))
    normal, inverse, factor = np.zeros((MOST, MOST)), np.zeros((MOST, MOST)), np.empty((MOST, MOST))
    gradient, column = np.empty(MOST), np.zeros(MOST)
    for w in range(len(which)):
        i = which[w]
        side = 2 * half[i] + 1
        wide = (side + 7) // 8 * 8
        data, mask = np.empty(side * wide, np.float32), np.empty(side * wide, np.float32)
        one = which[w : w + 1]
        place = np.zeros(1, np.int64)
        cut_out(frame, home, half, outer, reach, near_start, near_index, noise[4], noise[5], one, place, data, mask, quality)
        p = parameters[i].copy()
        p[0] -= int(round(home[i, 0])) - half[i]
        p[1] -= int(round(home[i, 1])) - half[i]
        images = mean_images(kind, p, side, side, aperture, True)
        weight, residual, kept = np.empty((side, wide)), np.empty((side, wide)), np.zeros((side, wide))
        values, seen = data.reshape(side, wide), mask.reshape(side, wide)
        weigh(images, values, seen, weight, kept, residual, noise, np.empty(0), *mean_range(kind, p))
        normal_equations(images, residual, weight, used, 0, count, normal, gradient, np.empty(side * wide))
        inverse[:] = 0.0
        for a in range(count):
            gradient[:count] = 0.0
            gradient[a] = 1.0
            if solve(count, normal, gradient, 0.0, column, factor):
                inverse[a] = column
        for r in range(side):
            for c in range(side):
                if seen[r, c] == 0.0:
                    continue
                left = 1.0
                for a in range(count):
                    for b in range(count):
                        left -= weight[r, c] * inverse[a, b] * images[1 + a, r, c] * images[1 + b, r, c]
                if left > 0.1:
                    levels[total], found[total] = images[0, r, c], residual[r, c] / math.sqrt(left)
                    steep[total] = math.hypot(images[1, r, c], images[2, r, c])
                    total += 1
        first = max(0, (side - ROWS) // 2)
        stop = min(side, first + ROWS)
        answers = np.zeros((side, MOST))
        if not row_answers(images, weight, used, count, normal, first, stop, gradient, column, factor, answers):
            continue
        for r in range(first, stop):
            for c in range(side):
                scores[w, r - first] += weight[r, c] * images[1, r, c] * residual[r, c]
                spread[w, r - first, r - first] += weight[r, c] * images[1, r, c] * images[1, r, c]
        for r in range(first, stop):
            for a in range(count):
                told = 0.0
                for c in range(side):
                    told += weight[r, c] * images[1, r, c] * images[1 + a, r, c]
                for q in range(first, stop):
                    spread[w, q - first, r - first] -= told * answers[q, a]
    return levels[:total], found[:total], steep[:total], scores, spread


@jit
def mean_images(kind, p, rows, cols, aperture, surface):
    """Mean and derivatives by all parameters of a window whose first pixel is (0, 0); shape (parameters + 1, rows, cols + padding)."""
    s = SHAPES[kind]
    wide = (cols + 7) // 8 * 8
    images = np.zeros((s + 10, rows, wide))
    planes = np.empty((rows, 8 * (wide + 2 * PAD)), np.float32)
    points = np.empty((point_count(longest_px(kind, p), p[2 + s]) + 1, 7))
    blocks = block_count(reach_px(p[2 + s], aperture))
    table = np.empty((phase_count(p[2 + s]) + 1, 48 * blocks), np.float32)
    across, down, parts = np.empty((blocks, 40), np.float32), np.empty((blocks, 40), np.float32), np.empty((3, 64), np.float32)
    draw(images, planes, kind, p, aperture, True, surface, points, table, across, down, parts)
    complete(images, kind, p, True, surface)
    return images
