"""Kernels of whole lines and edges: their pixels, the model with its derivatives, and the weighted least-squares fit."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.jit import jit
from pixmetry.locate.lines._profile_kernels import BAR, GAUSSIAN, clipped, invert, profile

# Unknowns. Offset across the line and angle are against the candidate's; the slopes of the background run across and along it.
OFFSET, ANGLE, BACKGROUND, AMPLITUDE, SIGMA, WIDTH, ACROSS, ALONG, TAPER, CURVE, FLAT = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10
UNKNOWNS = 10  # FLAT is no unknown: it tests whether the section is a bar rather than a Gaussian
OFF, ON, AUTO = 0, 1, 2
LEAST_SIGMA, LEAST_WIDTH = 0.05, 0.1
SIGNIFICANT = 3.0  # standard deviations from which a slope, a taper or a curvature is taken in
MOST_PASSES = 40
PARALLEL = 0.05  # sine of the angle below which lines count as parallel
BORDERS, HIGH, LOW, SHARED, RESTLESS, SINGULAR = 1, 2, 4, 8, 16, 32  # what a fit came across


@jit
def covered(other, reach, angle, d, col, row):
    """Whether a pixel, at distance d from a line of some angle, belongs to another line, too near to it to tell of the first."""
    co, so = math.cos(other[2]), math.sin(other[2])
    u, v = col - other[0], row - other[1]
    t = co * u + so * v
    across = co * v - so * u - 0.5 * other[5] * t * t
    if t < other[3] - reach or t > other[4] + reach or abs(across) > reach:
        return False
    parallel = abs(math.sin(other[2] - angle)) < PARALLEL
    return abs(across) < abs(d) if parallel else True


@jit
def gather(frame, place, reach, mine, places, cores, near, first, stop, high, low, x, y, value):
    """Collect the pixels within reach of a line that other lines do not cover; return their number and what was met.

    ``place``: x, y, angle, least and greatest distance along the line, curvature. ``near[first:stop]`` are the indices of other lines.
    """
    x0, y0, angle, least, most, curve = place[0], place[1], place[2], place[3], place[4], place[5]
    c, s = math.cos(angle), math.sin(angle)
    rows, cols = frame.shape
    reach_x, reach_y = reach * abs(s), reach * abs(c)
    sag = 0.5 * abs(curve) * max(most, -least) ** 2
    left = x0 + min(least * c, most * c) - reach_x - sag * abs(s)
    right = x0 + max(least * c, most * c) + reach_x + sag * abs(s)
    top = y0 + min(least * s, most * s) - reach_y - sag * abs(c)
    bottom = y0 + max(least * s, most * s) + reach_y + sag * abs(c)
    met, n, room = 0, 0, len(value)
    if left < -0.5 or top < -0.5 or right > cols - 0.5 or bottom > rows - 0.5:
        met |= BORDERS
    for r in range(max(0, int(math.ceil(top))), min(rows, int(math.floor(bottom)) + 1)):
        dy = r - y0
        low_x, high_x = left, right
        if abs(s) > 1e-3:
            a, b = x0 + (c * dy - reach - sag) / s, x0 + (c * dy + reach + sag) / s
            low_x, high_x = max(left, min(a, b)), min(right, max(a, b))
        for k in range(max(0, int(math.ceil(low_x))), min(cols, int(math.floor(high_x)) + 1)):
            dx = k - x0
            t = c * dx + s * dy
            d = c * dy - s * dx - 0.5 * curve * t * t
            if t < least or t > most or abs(d) > reach:
                continue
            taken = False
            for m in range(first, stop):
                if near[m] != mine and covered(places[near[m]], cores[near[m]], angle, d, k, r):
                    taken = True
                    break
            if taken:
                met |= SHARED
                continue
            if n == room:
                return n, met
            grey = np.float64(frame[r, k])
            if grey >= high:
                met |= HIGH
            if grey <= low:
                met |= LOW
            x[n], y[n], value[n] = dx, dy, grey
            n += 1
    return n, met


@jit
def pixel(section, p, c, s, c0, s0, a, b, dx, dy, out):
    """Return the grey value of a pixel and put its derivatives into ``out`` (all but FLAT)."""
    t = c * dx + s * dy
    d = c * dy - s * dx - p[OFFSET] - 0.5 * p[CURVE] * t * t
    along, across = c0 * dx + s0 * dy, c0 * dy - s0 * dx
    height, slope, by_s, by_w = profile(section, d, p[SIGMA], p[WIDTH], a, b)
    full = p[AMPLITUDE] * (1.0 + p[TAPER] * along)
    out[OFFSET] = -full * slope
    out[ANGLE] = -full * slope * t
    out[BACKGROUND] = 1.0
    out[AMPLITUDE] = (1.0 + p[TAPER] * along) * height
    out[SIGMA] = full * by_s
    out[WIDTH] = full * by_w
    out[ACROSS] = across
    out[ALONG] = along
    out[TAPER] = p[AMPLITUDE] * along * height
    out[CURVE] = -0.5 * t * t * full * slope
    return p[BACKGROUND] + p[ACROSS] * across + p[ALONG] * along + full * height, d, height


@jit
def sums(section, p, angle, aperture, noise, x, y, value, n, weight, fresh, active, count, normal, right):
    """Set up the normal equations of the active unknowns; return chi² with the given weights and with fresh ones.

    ``noise``: constant, slope, pattern, black, low, high. The fresh weights go into ``fresh``.
    """
    turned = angle + p[ANGLE]
    c, s, c0, s0 = math.cos(turned), math.sin(turned), math.cos(angle), math.sin(angle)
    a, b = aperture * max(abs(c), abs(s)), aperture * min(abs(c), abs(s))
    normal[:, :] = 0.0
    right[:] = 0.0
    slopes = np.zeros(UNKNOWNS + 1)
    chi_old, chi_new = 0.0, 0.0
    flat = count > 0 and active[count - 1] == FLAT
    w_bar = 2.4 * p[SIGMA]
    s_bar = math.sqrt(p[SIGMA] ** 2 - w_bar * w_bar / 12.0)
    scale_bar = p[SIGMA] * math.sqrt(2.0 * math.pi) / w_bar  # the same area
    for i in range(n):
        mean, d, height = pixel(section, p, c, s, c0, s0, a, b, x[i], y[i], slopes)
        if flat:
            bar = profile(BAR, d, s_bar, w_bar, a, b)[0]
            slopes[FLAT] = p[AMPLITUDE] * (scale_bar * bar - height)
        stored, variance, gain = clipped(mean, noise[0], noise[1], noise[2], noise[3], noise[4], noise[5])
        rest = value[i] - stored
        fresh[i] = 1.0 / variance
        chi_old += rest * rest * weight[i]
        chi_new += rest * rest * fresh[i]
        pull, hold = gain * rest * fresh[i], gain * gain * fresh[i]
        for j in range(count):
            sj = slopes[active[j]]
            right[j] += sj * pull
            sj *= hold
            for k in range(j + 1):
                normal[j, k] += sj * slopes[active[k]]
    for j in range(count):
        for k in range(j):
            normal[k, j] = normal[j, k]
    return chi_old, chi_new


@jit
def limited(p, change, active, count, half, trial):
    """Put p + change into ``trial``, no further than the model can be trusted."""
    trial[:] = p
    size = 1.0
    reach = 0.5 * (p[SIGMA] + 0.5)
    for j in range(count):
        k, by = active[j], abs(change[j])
        most = np.inf
        if k == OFFSET:
            most = reach
        elif k == ANGLE:
            most = reach / max(half, 1.0)
        elif k == SIGMA:
            most = 0.5 * p[SIGMA]
        elif k == WIDTH:
            most = 0.5 * p[WIDTH]
        elif k == CURVE:
            most = 2.0 * reach / max(half * half, 1.0)
        if by > most:
            size = min(size, most / by)
    for j in range(count):
        trial[active[j]] += size * change[j]
    trial[SIGMA] = max(trial[SIGMA], LEAST_SIGMA)
    trial[WIDTH] = max(trial[WIDTH], LEAST_WIDTH)


@jit
def descend(section, p, angle, half, aperture, noise, x, y, value, n, weight, fresh, active, count, normal, right):
    """Levenberg–Marquardt from p, in place; return chi² and whether it came to rest. ``normal`` and ``right`` are those at p."""
    damped, inverse = np.empty((UNKNOWNS + 1, UNKNOWNS + 1)), np.empty((UNKNOWNS + 1, UNKNOWNS + 1))
    new_normal, new_right = np.empty_like(normal), np.empty_like(right)
    change, pull, trial = np.empty(UNKNOWNS + 1), np.empty(UNKNOWNS + 1), np.empty(UNKNOWNS)
    weight[:n] = 1.0
    _, chi = sums(section, p, angle, aperture, noise, x, y, value, n, weight, fresh, active, count, normal, right)
    weight[:n] = fresh[:n]
    damping = 1e-6
    for _ in range(MOST_PASSES):
        damped[:count, :count] = normal[:count, :count]
        for j in range(count):
            damped[j, j] *= 1.0 + damping
        for j in range(count):  # what is held at its least is no unknown as long as it is pressed there
            pull[j] = right[j]
            if ((active[j] == SIGMA and p[SIGMA] <= LEAST_SIGMA) or (active[j] == WIDTH and p[WIDTH] <= LEAST_WIDTH)) and right[j] < 0.0:
                damped[j, :count] = 0.0
                damped[:count, j] = 0.0
                damped[j, j], pull[j] = 1.0, 0.0
        if not invert(damped, count, inverse):
            damping = max(10.0 * damping, 1e-3)
            if damping > 1e8:
                return chi, False
            continue
        small = 0.0  # the predicted fall of chi²
        for j in range(count):
            total = 0.0
            for k in range(count):
                total += inverse[j, k] * pull[k]
            change[j] = total
            small += total * pull[j]
        limited(p, change, active, count, half, trial)
        if small < 1e-5:  # 0.003 standard deviations: the last step is taken unseen
            p[:] = trial
            return chi, True
        old, new = sums(section, trial, angle, aperture, noise, x, y, value, n, weight, fresh, active, count, new_normal, new_right)
        if old <= chi * (1.0 + 1e-12):
            p[:], normal[:, :], right[:], weight[:n] = trial, new_normal, new_right, fresh[:n]
            chi = new
            damping = max(0.1 * damping, 1e-9)
        else:
            if damping >= 1e8:
                return chi, small < 1e-2
            damping = max(10.0 * damping, 1e-4)
    return chi, False


@jit
def significance(normal, right, count, kept, chi_per_dof):
    """Rao's score test of the unknowns after the first ``kept`` of ``count``, one by one: their values in standard deviations."""
    inverse, out = np.empty((kept, kept)), np.zeros(count)
    if not invert(normal, kept, inverse):
        return out
    for j in range(kept, count):
        left, information = right[j], normal[j, j]
        for k in range(kept):
            held = 0.0
            for m in range(kept):
                held += inverse[k, m] * normal[m, j]
            left -= held * right[k]
            information -= held * normal[k, j]
        if information > 1e-9 * normal[j, j]:
            out[j] = left / math.sqrt(information * max(chi_per_dof, 1.0))
    return out


@jit
def take_in(active, count, extra, most):
    """Append the wanted unknowns; return the new count."""
    for j in range(most):
        found = False
        for k in range(count):
            found = found or active[k] == extra[j]
        if not found:
            active[count] = extra[j]
            count += 1
    return count


@jit
def fit_one(section, choose, options, p, angle, half, aperture, noise, x, y, value, n, active):
    """Fit one line and choose what it is made of; return section, count of unknowns, chi² and whether it rests.

    ``options``: OFF, ON or AUTO for the background's plane, the taper and the curvature. ``choose``: whether a Gaussian may become a bar.
    """
    size = UNKNOWNS + 1
    normal, right = np.zeros((size, size)), np.zeros(size)
    weight, fresh = np.empty(n), np.empty(n)
    wanted = np.empty(size, np.int64)
    count = 5
    for j in range(count):
        active[j] = j
    if section == BAR:
        active[count] = WIDTH
        count += 1
    for k in (ACROSS, ALONG, TAPER, CURVE):
        if options[0 if k <= ALONG else k - TAPER + 1] == ON:
            active[count] = k
            count += 1
    chi, rests = 0.0, False
    tried = False
    for _ in range(4):
        if n <= count + 2:
            return section, count, np.nan, False
        chi, rests = descend(section, p, angle, half, aperture, noise, x, y, value, n, weight, fresh, active, count, normal, right)
        if not rests:
            break
        kept, most = count, 0
        for k in (ACROSS, ALONG, TAPER, CURVE):
            if options[0 if k <= ALONG else k - TAPER + 1] == AUTO:
                wanted[most] = k
                most += 1
        full = take_in(active, kept, wanted, most)
        if choose and section == GAUSSIAN and not tried:
            active[full] = FLAT
            full += 1
        if full == kept:
            break
        sums(section, p, angle, aperture, noise, x, y, value, n, weight, fresh, active, full, normal, right)
        strong = significance(normal, right, full, kept, chi / (n - kept))
        if active[full - 1] == FLAT and strong[full - 1] > SIGNIFICANT:
            section, tried = BAR, True
            wide = 2.4 * p[SIGMA]
            p[AMPLITUDE] *= p[SIGMA] * math.sqrt(2.0 * math.pi) / wide
            p[SIGMA] = math.sqrt(p[SIGMA] ** 2 - wide * wide / 12.0)
            p[WIDTH] = wide
            active[kept] = WIDTH
            count = kept + 1
            continue
        count = kept
        for j in range(kept, full):
            if active[j] != FLAT and abs(strong[j]) > SIGNIFICANT:
                active[count] = active[j]
                count += 1
        if count == kept:
            break
    return section, count, chi, rests


@jit
def fit_lines(
    frame, first, stop, section, choose, options, aperture, noise, places, reach, start, cores, near, begin, values, covariances, told
):
    """Fit candidates ``first`` to ``stop``.

    ``places``, shape (n, 6): x, y, angle, least and greatest distance along, curvature. ``start``, shape (n, 4): background, amplitude,
    sigma, width. ``cores``: how far to either side a line spoils the pixels of others, ``near[begin[i]:begin[i + 1]]`` the others.
    Into ``values`` (n, 10), ``covariances`` (n, 10, 10), ``told`` (n, 5): chi², pixels, unknowns, what was met, section.
    """
    size = UNKNOWNS + 1
    normal, right, inverse = np.zeros((size, size)), np.zeros(size), np.zeros((size, size))
    active, p = np.empty(size, np.int64), np.empty(UNKNOWNS)
    own = np.empty_like(options)
    for i in range(first, stop):
        half, curve = max(places[i, 4], -places[i, 3]), places[i, 5]
        tall, wide = 2.0 * reach[i] + 2.0, places[i, 4] - places[i, 3] + 2.0
        room = int(min(tall * wide * (1.0 + 0.5 * (curve * half) ** 2) + 4.0 * (tall + wide), 1.0 * frame.size)) + 16
        x, y, value = np.empty(room), np.empty(room), np.empty(room)
        n, met = gather(
            frame, places[i], reach[i], i, places, cores, near, begin[i], begin[i + 1], noise[5], noise[4], x, y, value
        )
        p[:] = 0.0
        p[BACKGROUND], p[AMPLITUDE], p[SIGMA], p[WIDTH] = start[i, 0], start[i, 1], start[i, 2], start[i, 3]
        own[:] = options
        if own[2] != OFF and 0.5 * abs(curve) * half * half > 0.5 * start[i, 2]:
            own[2], p[CURVE] = ON, curve  # plainly curved
        mine = section
        if choose and section == GAUSSIAN and start[i, 3] > 3.0 * start[i, 2]:
            mine = BAR  # plainly one
        mine, count, chi, rests = fit_one(mine, choose, own, p, places[i, 2], half, aperture, noise, x, y, value, n, active)
        if not rests:
            met |= RESTLESS
        if p[SIGMA] <= LEAST_SIGMA:  # held at the least: no unknown
            for j in range(count):
                if active[j] == SIGMA:
                    active[j] = active[count - 1]
            count -= 1
        told[i, 1], told[i, 2], told[i, 3], told[i, 4] = n, count, met | SINGULAR, mine
        covariances[i], values[i], told[i, 0] = np.nan, np.nan, np.nan
        if n <= count + 2:
            continue
        weight, fresh = np.ones(n), np.empty(n)
        told[i, 0] = sums(mine, p, places[i, 2], aperture, noise, x, y, value, n, weight, fresh, active, count, normal, right)[1]
        if not invert(normal, count, inverse):
            continue
        told[i, 3], values[i] = met, p
        for j in range(count):
            for k in range(count):
                covariances[i, active[j], active[k]] = inverse[j, k]


@jit
def render(section, p, angle, aperture, x, y, mean, jacobian):
    """Put the grey values at pixels x, y (relative to the candidate's place) and their derivatives into ``mean`` and ``jacobian``."""
    turned = angle + p[ANGLE]
    c, s, c0, s0 = math.cos(turned), math.sin(turned), math.cos(angle), math.sin(angle)
    a, b = aperture * max(abs(c), abs(s)), aperture * min(abs(c), abs(s))
    for i in range(len(x)):
        mean[i] = pixel(section, p, c, s, c0, s0, a, b, x[i], y[i], jacobian[i])[0]
