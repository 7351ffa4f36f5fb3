"""Kernels of crosses: two lines that cross, fitted together."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.jit import jit
from pixmetry.locate.lines._line_kernels import LEAST_SIGMA, LEAST_WIDTH, RESTLESS, SHARED, SINGULAR, covered
from pixmetry.locate.lines._profile_kernels import BAR, clipped, invert, step
from pixmetry.locate.template._normal_kernels import ROOT

# Unknowns: the crossing against the candidate's, the angles, background, heights, blurs, widths, what the overlap adds, and the slopes
# of the background.
X, Y, ANGLE_1, ANGLE_2, BACKGROUND, HEIGHT_1, HEIGHT_2, SIGMA_1, SIGMA_2, WIDTH_1, WIDTH_2, OVERLAP, SLOPE_X, SLOPE_Y = range(14)
UNKNOWNS = 14
MOST_PASSES = 40
MOST_ROOM = 1 << 24  # pixels


@jit
def curves(section, d, s, w, a, b):
    """Return a section's height, its first three derivatives (two for a Gaussian; the third is 0), and those for s and w."""
    if section == BAR:
        p0, p1, p2, p3 = step(d + 0.5 * w, s, a, b)
        m0, m1, m2, m3 = step(d - 0.5 * w, s, a, b)
        return p0 - m0, p1 - m1, p2 - m2, p3 - m3, s * (p2 - m2), 0.5 * (p1 + m1)
    _, e1, e2, e3 = step(d, s, a, b)
    k = s / ROOT
    return k * e1, k * e2, k * e3, 0.0, (e1 + s * s * e3) / ROOT, 0.0


@jit
def cross_pixel(section, p, dx, dy, c1, s1, c2, s2, boxes, out):
    """Return the grey value of a pixel and put its derivatives into ``out``.

    Where the lines overlap, their product joins in with a height of its own: 0 for lines whose light adds, minus the lesser height for a
    union. Pixel and blur make the distances from two oblique lines go together; the mean of the product follows by Mehler's series.
    """
    u, v = dx - p[X], dy - p[Y]
    t1, d1, t2, d2 = c1 * u + s1 * v, c1 * v - s1 * u, c2 * u + s2 * v, c2 * v - s2 * u
    h1, f1, g1, k1, by_s1, by_w1 = curves(section, d1, p[SIGMA_1], p[WIDTH_1], boxes[0], boxes[1])
    h2, f2, g2, k2, by_s2, by_w2 = curves(section, d2, p[SIGMA_2], p[WIDTH_2], boxes[2], boxes[3])
    joint = (c1 * c2 + s1 * s2) * (p[SIGMA_1] * p[SIGMA_2] + boxes[4])
    both = h1 * h2 + joint * f1 * f2 + 0.5 * joint * joint * g1 * g2
    on_1 = p[HEIGHT_1] * f1 + p[OVERLAP] * (f1 * h2 + joint * g1 * f2 + 0.5 * joint * joint * k1 * g2)
    on_2 = p[HEIGHT_2] * f2 + p[OVERLAP] * (h1 * f2 + joint * f1 * g2 + 0.5 * joint * joint * g1 * k2)
    out[X], out[Y] = s1 * on_1 + s2 * on_2, -c1 * on_1 - c2 * on_2
    out[ANGLE_1], out[ANGLE_2] = -t1 * on_1, -t2 * on_2
    out[BACKGROUND], out[HEIGHT_1], out[HEIGHT_2] = 1.0, h1, h2
    out[SIGMA_1], out[WIDTH_1] = (p[HEIGHT_1] + p[OVERLAP] * h2) * by_s1, (p[HEIGHT_1] + p[OVERLAP] * h2) * by_w1
    out[SIGMA_2], out[WIDTH_2] = (p[HEIGHT_2] + p[OVERLAP] * h1) * by_s2, (p[HEIGHT_2] + p[OVERLAP] * h1) * by_w2
    out[OVERLAP], out[SLOPE_X], out[SLOPE_Y] = both, dx, dy
    ground = p[BACKGROUND] + p[SLOPE_X] * dx + p[SLOPE_Y] * dy
    return ground + p[HEIGHT_1] * h1 + p[HEIGHT_2] * h2 + p[OVERLAP] * both


@jit
def turned(p, angles, aperture, boxes):
    """Cosines and sines of the two directions; the sides of the pixel across them, and its variance, into ``boxes``."""
    c1, s1 = math.cos(angles[0] + p[ANGLE_1]), math.sin(angles[0] + p[ANGLE_1])
    c2, s2 = math.cos(angles[1] + p[ANGLE_2]), math.sin(angles[1] + p[ANGLE_2])
    boxes[0], boxes[1] = aperture * max(abs(c1), abs(s1)), aperture * min(abs(c1), abs(s1))
    boxes[2], boxes[3] = aperture * max(abs(c2), abs(s2)), aperture * min(abs(c2), abs(s2))
    boxes[4] = aperture * aperture / 12.0
    return c1, s1, c2, s2


@jit
def cross_sums(section, p, angles, aperture, noise, pixels, n, weight, fresh, active, count, normal, right):
    """As the one of single lines: normal equations, and chi² with the given and with fresh weights. ``pixels``: x, y, value."""
    boxes, slopes = np.empty(5), np.empty(UNKNOWNS)
    c1, s1, c2, s2 = turned(p, angles, aperture, boxes)
    normal[:, :] = 0.0
    right[:] = 0.0
    chi_old, chi_new = 0.0, 0.0
    for i in range(n):
        mean = cross_pixel(section, p, pixels[i, 0], pixels[i, 1], c1, s1, c2, s2, boxes, slopes)
        stored, variance, gain = clipped(mean, noise[0], noise[1], noise[2], noise[3], noise[4], noise[5])
        rest = pixels[i, 2] - stored
        fresh[i] = 1.0 / variance
        chi_old += rest * rest * weight[i]
        chi_new += rest * rest * fresh[i]
        for j in range(count):
            sj = slopes[active[j]] * gain * fresh[i]
            right[j] += sj * rest
            for k in range(j + 1):
                normal[j, k] += sj * gain * slopes[active[k]]
    for j in range(count):
        for k in range(j):
            normal[k, j] = normal[j, k]
    return chi_old, chi_new


@jit
def cross_gather(frame, place, angles, arms, reach, cores, places, spoil, near, first, stop, pair, high, low, pixels):
    """Collect the pixels within reach of either line, on its arms, that no third line covers; return their number and what was met."""
    far = max(max(arms[1], -arms[0]), max(arms[3], -arms[2])) + max(reach[0], reach[1])
    c1, s1, c2, s2 = math.cos(angles[0]), math.sin(angles[0]), math.cos(angles[1]), math.sin(angles[1])
    rows, cols = frame.shape
    met, n = 0, 0
    if place[0] - far < 0 or place[1] - far < 0 or place[0] + far > cols - 1 or place[1] + far > rows - 1:
        met |= 1
    for r in range(max(0, int(place[1] - far)), min(rows, int(place[1] + far) + 2)):
        for k in range(max(0, int(place[0] - far)), min(cols, int(place[0] + far) + 2)):
            u, v = k - place[0], r - place[1]
            t1, d1, t2, d2 = c1 * u + s1 * v, c1 * v - s1 * u, c2 * u + s2 * v, c2 * v - s2 * u
            on_1, on_2 = arms[0] <= t1 <= arms[1], arms[2] <= t2 <= arms[3]
            if not ((on_1 and abs(d1) <= reach[0]) or (on_2 and abs(d2) <= reach[1])):
                continue
            if (not on_1 and abs(d1) < cores[0]) or (not on_2 and abs(d2) < cores[1]):
                continue  # beyond the end of an arm
            taken = False
            for m in range(first, stop):
                if near[m] != pair[0] and near[m] != pair[1] and covered(places[near[m]], spoil[near[m]], angles[0], 1e9, k, r):
                    taken = True
                    break
            if taken:
                met |= SHARED
                continue
            if n == len(pixels):
                return n, met
            grey = np.float64(frame[r, k])
            met |= (2 if grey >= high else 0) | (4 if grey <= low else 0)
            pixels[n, 0], pixels[n, 1], pixels[n, 2] = u, v, grey
            n += 1
    return n, met


@jit
def cross_trial(p, change, active, count, arm, trial):
    """Put p + change into ``trial``, no further than the model can be trusted."""
    trial[:] = p
    size, reach = 1.0, 0.5 * (min(p[SIGMA_1], p[SIGMA_2]) + 0.5)
    for j in range(count):
        k, most = active[j], np.inf
        if k in (X, Y):
            most = reach
        elif k in (ANGLE_1, ANGLE_2):
            most = reach / max(arm, 1.0)
        elif SIGMA_1 <= k <= WIDTH_2:
            most = 0.5 * p[k]
        if abs(change[j]) > most:
            size = min(size, most / abs(change[j]))
    for j in range(count):
        trial[active[j]] += size * change[j]
    for k in (SIGMA_1, SIGMA_2):
        trial[k] = max(trial[k], LEAST_SIGMA)
    for k in (WIDTH_1, WIDTH_2):
        trial[k] = max(trial[k], LEAST_WIDTH)


@jit
def cross_descend(section, p, angles, arm, aperture, noise, pixels, n, weight, fresh, active, count, normal, right):
    """Levenberg–Marquardt from p, in place; return chi² and whether it came to rest."""
    damped, inverse = np.empty((UNKNOWNS, UNKNOWNS)), np.empty((UNKNOWNS, UNKNOWNS))
    new_normal, new_right = np.empty_like(normal), np.empty_like(right)
    change, pull, trial = np.empty(UNKNOWNS), np.empty(UNKNOWNS), np.empty(UNKNOWNS)
    weight[:] = 1.0
    _, chi = cross_sums(section, p, angles, aperture, noise, pixels, n, weight, fresh, active, count, normal, right)
    weight[:] = fresh
    damping = 1e-6
    for _ in range(MOST_PASSES):
        damped[:, :] = normal
        for j in range(count):
            k = active[j]
            damped[j, j] *= 1.0 + damping
            pull[j] = right[j]
            least = LEAST_SIGMA if k in (SIGMA_1, SIGMA_2) else LEAST_WIDTH if k in (WIDTH_1, WIDTH_2) else -np.inf
            if p[k] <= least and right[j] < 0.0:
                damped[j, :] = 0.0
                damped[:, j] = 0.0
                damped[j, j], pull[j] = 1.0, 0.0
        if not invert(damped, count, inverse):
            damping = max(10.0 * damping, 1e-3)
            if damping > 1e8:
                return chi, False
            continue
        small = 0.0
        for j in range(count):
            total = 0.0
            for k in range(count):
                total += inverse[j, k] * pull[k]
            change[j] = total
            small += total * pull[j]
        cross_trial(p, change, active, count, arm, trial)
        if small < 1e-5:
            p[:] = trial
            return chi, True
        old, new = cross_sums(section, trial, angles, aperture, noise, pixels, n, weight, fresh, active, count, new_normal, new_right)
        if old <= chi * (1.0 + 1e-12):
            p[:], normal[:, :], right[:], weight[:] = trial, new_normal, new_right, fresh
            chi, damping = new, max(0.1 * damping, 1e-9)
        else:
            if damping >= 1e8:
                return chi, small < 1e-2
            damping = max(10.0 * damping, 1e-4)
    return chi, False


@jit
def fit_crosses(
    frame, first, stop, section, slopes, aperture, noise, crossing, angles, arms, reach, cores, lines, begin, start, found, covariances,
    told,
):
    """Fit crosses ``first`` to ``stop``.

    ``lines``: places and cores of all lines, indices of those near each cross, and the two that make it. ``section``, shape (n,).
    Into ``found`` (n, 14), ``covariances`` (n, 14, 14), ``told`` (n, 4): chi², pixels, unknowns, what was met.
    """
    places, spoil, near, pairs = lines
    normal, right, inverse = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS), np.zeros((UNKNOWNS, UNKNOWNS))
    active = np.empty(UNKNOWNS, np.int64)
    for i in range(first, stop):
        found[i], covariances[i], told[i] = np.nan, np.nan, np.nan
        first_arm, second_arm = max(arms[i, 1] - arms[i, 0], 0.0), max(arms[i, 3] - arms[i, 2], 0.0)
        room = int(2.2 * (reach[i, 0] + 1) * (first_arm + 4) + 2.2 * (reach[i, 1] + 1) * (second_arm + 4)) + 64
        if not 0 < room < MOST_ROOM:  # a line of the two was lost in its own fit
            continue
        pixels = np.empty((room, 3))
        a, b = begin[i], begin[i + 1]
        n, met = cross_gather(
            frame, crossing[i], angles[i], arms[i], reach[i], cores[i], places, spoil, near, a, b, pairs[i], noise[5], noise[4], pixels
        )
        p = start[i].copy()
        count = 0
        for k in range(UNKNOWNS):
            if (k in (WIDTH_1, WIDTH_2) and section[i] != BAR) or (k >= SLOPE_X and not slopes):
                continue
            active[count] = k
            count += 1
        told[i, 1], told[i, 2], told[i, 3] = n, count, met | SINGULAR
        if n <= count + 2:
            continue
        weight, fresh = np.empty(n), np.empty(n)
        arm = max(arms[i, 1], arms[i, 3])
        _, rests = cross_descend(
            section[i], p, angles[i], arm, aperture, noise, pixels, n, weight, fresh, active, count, normal, right
        )
        kept = 0
        for j in range(count):  # what is held at its least is no unknown
            k = active[j]
            held = (k in (SIGMA_1, SIGMA_2) and p[k] <= LEAST_SIGMA) or (k in (WIDTH_1, WIDTH_2) and p[k] <= LEAST_WIDTH)
            if not held:
                active[kept] = k
                kept += 1
        weight[:] = 1.0
        told[i, 0] = cross_sums(section[i], p, angles[i], aperture, noise, pixels, n, weight, fresh, active, kept, normal, right)[1]
        told[i, 2] = kept
        if not invert(normal, kept, inverse):
            continue
        found[i] = p
        told[i, 3] = met | (0 if rests else RESTLESS)
        for j in range(kept):
            for k in range(kept):
                covariances[i, active[j], active[k]] = inverse[j, k]
