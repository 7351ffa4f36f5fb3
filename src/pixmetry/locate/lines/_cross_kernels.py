"""Kernels of crosses: two lines that cross, fitted together."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pixmetry.core._least_squares_kernels import descent_of
from pixmetry.core._linear_algebra_kernels import invert
from pixmetry.core._normal_kernels import ROOT
from pixmetry.core.arrays import Array, Ints
from pixmetry.core.jit import jit
from pixmetry.locate._noise_kernels import Noise, stored
from pixmetry.locate.lines._line_kernels import (
    BORDERS,
    HIGH,
    LEAST_SIGMA,
    LEAST_WIDTH,
    LOW,
    REST,
    RESTLESS,
    SHARED,
    SINGULAR,
    Lines,
    covered,
)
from pixmetry.locate.lines._profile_kernels import BAR, step

# Unknowns: the crossing against the candidate's, the angles, background, heights, blurs, widths, what the overlap adds, and the slopes
# of the background.
X, Y, ANGLE_1, ANGLE_2, BACKGROUND, HEIGHT_1, HEIGHT_2, SIGMA_1, SIGMA_2, WIDTH_1, WIDTH_2, OVERLAP, SLOPE_X, SLOPE_Y = range(14)
UNKNOWNS = 14
MOST_ROOM = 1 << 24  # pixels


class Crosses(NamedTuple):
    """What fits of crosses start from, and the lines about them."""

    crossing: Array  # shape (n, 2): x, y, px
    angles: Array  # shape (n, 2), rad
    arms: Array  # shape (n, 4): least and greatest place along the first and along the second line, from the crossing, px
    reach: Array  # shape (n, 2): to either side of each line, px
    cores: Array  # shape (n, 2): how far to either side each line changes grey values, px
    pairs: Ints  # shape (n, 2): the lines that make each cross
    lines: Lines  # all of them, with those near each cross
    section: Ints  # shape (n,)
    start: Array  # shape (n, UNKNOWNS)


class Cross(NamedTuple):
    """One cross to be fitted."""

    section: int
    angles: Array  # shape (2,), rad
    arm: float  # greatest length of an arm, px
    aperture: float  # side of the pixel's square, px
    noise: Noise
    pixels: Array  # shape (pixels, 3): x, y from the candidate's crossing, grey value


class Fits(NamedTuple):
    """Results of fits."""

    found: Array  # shape (n, UNKNOWNS)
    covariances: Array  # shape (n, UNKNOWNS, UNKNOWNS)
    told: Array  # shape (n, 4): chi², pixels, unknowns, what was met


class Half(NamedTuple):
    """One line's height across, its first three derivatives (two for a Gaussian; the third is 0), and those by blur and width."""

    h: float
    f: float
    g: float
    k: float
    by_s: float
    by_w: float


@jit
def half_of(section: int, d: float, s: float, w: float, a: float, b: float) -> Half:
    """A line's section at a distance d across, with blur s and width w, averaged over boxes a and b."""
    if section == BAR:
        p0, p1, p2, p3 = step(d + 0.5 * w, s, a, b)
        m0, m1, m2, m3 = step(d - 0.5 * w, s, a, b)
        return Half(p0 - m0, p1 - m1, p2 - m2, p3 - m3, s * (p2 - m2), 0.5 * (p1 + m1))
    _, e1, e2, e3 = step(d, s, a, b)
    k = s / ROOT
    return Half(k * e1, k * e2, k * e3, 0.0, (e1 + s * s * e3) / ROOT, 0.0)


class Turn(NamedTuple):
    """Cosines and sines of the two directions; the sides of the pixel across them, and the variance of its square."""

    c1: float
    s1: float
    c2: float
    s2: float
    a1: float
    b1: float
    a2: float
    b2: float
    variance: float


@jit
def turn_of(p: Array, angles: Array, aperture: float) -> Turn:
    """The directions of a cross, and the width of the pixel across them."""
    c1, s1 = math.cos(angles[0] + p[ANGLE_1]), math.sin(angles[0] + p[ANGLE_1])
    c2, s2 = math.cos(angles[1] + p[ANGLE_2]), math.sin(angles[1] + p[ANGLE_2])
    a1, b1 = aperture * max(abs(c1), abs(s1)), aperture * min(abs(c1), abs(s1))
    a2, b2 = aperture * max(abs(c2), abs(s2)), aperture * min(abs(c2), abs(s2))
    return Turn(c1, s1, c2, s2, a1, b1, a2, b2, aperture * aperture / 12.0)


@jit
def cross_pixel(section: int, p: Array, dx: float, dy: float, turn: Turn, out: Array) -> float:
    """Return the grey value of a pixel and put its derivatives into ``out``.

    Where the lines overlap, their product joins in with a height of its own: 0 for lines whose light adds, minus the lesser height for a
    union. Pixel and blur make the distances from two oblique lines go together; the mean of the product follows by Mehler's series.
    """
    c1, s1, c2, s2 = turn.c1, turn.s1, turn.c2, turn.s2
    u, v = dx - p[X], dy - p[Y]
    t1, d1, t2, d2 = c1 * u + s1 * v, c1 * v - s1 * u, c2 * u + s2 * v, c2 * v - s2 * u
    h1, f1, g1, k1, by_s1, by_w1 = half_of(section, d1, p[SIGMA_1], p[WIDTH_1], turn.a1, turn.b1)
    h2, f2, g2, k2, by_s2, by_w2 = half_of(section, d2, p[SIGMA_2], p[WIDTH_2], turn.a2, turn.b2)
    joint = (c1 * c2 + s1 * s2) * (p[SIGMA_1] * p[SIGMA_2] + turn.variance)
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
    level: float = ground + p[HEIGHT_1] * h1 + p[HEIGHT_2] * h2 + p[OVERLAP] * both
    return level


@jit
def cross_sums(cross: Cross, p: Array, weight: Array, fresh: Array, active: Ints, normal: Array, right: Array) -> tuple[float, float]:
    """Normal equations of the active unknowns, χ² with the given weights and with fresh ones; see `descent_of`."""
    slopes, turn = np.empty(UNKNOWNS), turn_of(p, cross.angles, cross.aperture)
    section, noise, pixels, count = cross.section, cross.noise, cross.pixels, len(active)
    normal[:, :] = 0.0
    right[:] = 0.0
    chi_old, chi_new = 0.0, 0.0
    for i in range(len(pixels)):
        mean = cross_pixel(section, p, pixels[i, 0], pixels[i, 1], turn, slopes)
        expected, variance, gain = stored(mean, noise)
        rest = pixels[i, 2] - expected
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
def cross_gather(frame: NDArray[np.generic], crosses: Crosses, i: int, noise: Noise, pixels: Array) -> tuple[int, int]:
    """Collect the pixels within reach of either line of a cross, on its arms, that no third line covers.

    Return their number and what was met.
    """
    place, angles, arms = crosses.crossing[i], crosses.angles[i], crosses.arms[i]
    reach, cores, pair, lines = crosses.reach[i], crosses.cores[i], crosses.pairs[i], crosses.lines
    far = max(max(arms[1], -arms[0]), max(arms[3], -arms[2])) + max(reach[0], reach[1])
    c1, s1, c2, s2 = math.cos(angles[0]), math.sin(angles[0]), math.cos(angles[1]), math.sin(angles[1])
    rows, cols = frame.shape
    met, n = 0, 0
    if place[0] - far < 0 or place[1] - far < 0 or place[0] + far > cols - 1 or place[1] + far > rows - 1:
        met |= BORDERS
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
            for m in range(lines.begin[i], lines.begin[i + 1]):
                other = lines.near[m]
                if other != pair[0] and other != pair[1] and covered(lines.places[other], lines.cores[other], angles[0], 1e9, k, r):
                    taken = True
                    break
            if taken:
                met |= SHARED
                continue
            if n == len(pixels):
                return n, met
            grey = np.float64(frame[r, k])
            met |= (HIGH if grey >= noise.high_dn else 0) | (LOW if grey <= noise.low_dn else 0)
            pixels[n, 0], pixels[n, 1], pixels[n, 2] = u, v, grey
            n += 1
    return n, met


@jit
def cross_trial(cross: Cross, p: Array, change: Array, active: Ints, trial: Array) -> bool:
    """Put p + change into ``trial``, no further than the model can be trusted; see `descent_of`."""
    trial[:] = p
    count = len(active)
    size, reach = 1.0, 0.5 * (min(p[SIGMA_1], p[SIGMA_2]) + 0.5)
    for j in range(count):
        k, most = active[j], np.inf
        if k in (X, Y):
            most = reach
        elif k in (ANGLE_1, ANGLE_2):
            most = reach / max(cross.arm, 1.0)
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
    return True


descend_cross = descent_of(cross_sums, cross_trial)


@jit
def fit_crosses(
    frame: NDArray[np.generic], span: tuple[int, int], slopes: bool, aperture: float, noise: Noise, crosses: Crosses, fits: Fits
) -> None:
    """Fit crosses ``span[0]`` to ``span[1]``; ``slopes``: whether the background may slope."""
    normal, right, inverse = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS), np.zeros((UNKNOWNS, UNKNOWNS))
    active = np.empty(UNKNOWNS, np.int64)
    least = np.full(UNKNOWNS, -np.inf)
    least[SIGMA_1] = least[SIGMA_2] = LEAST_SIGMA
    least[WIDTH_1] = least[WIDTH_2] = LEAST_WIDTH
    found, covariances, told = fits.found, fits.covariances, fits.told
    for i in range(span[0], span[1]):
        found[i], covariances[i], told[i] = np.nan, np.nan, np.nan
        arms, reach, section = crosses.arms[i], crosses.reach[i], crosses.section[i]
        first_arm, second_arm = max(arms[1] - arms[0], 0.0), max(arms[3] - arms[2], 0.0)
        room = int(2.2 * (reach[0] + 1) * (first_arm + 4) + 2.2 * (reach[1] + 1) * (second_arm + 4)) + 64
        if not 0 < room < MOST_ROOM:  # a line of the two was lost in its own fit
            continue
        pixels = np.empty((room, 3))
        n, met = cross_gather(frame, crosses, i, noise, pixels)
        p = crosses.start[i].copy()
        count = 0
        for k in range(UNKNOWNS):
            if (k in (WIDTH_1, WIDTH_2) and section != BAR) or (k >= SLOPE_X and not slopes):
                continue
            active[count] = k
            count += 1
        told[i, 1], told[i, 2], told[i, 3] = n, count, met | SINGULAR
        if n <= count + 2:
            continue
        cross = Cross(section, crosses.angles[i], max(arms[1], arms[3]), aperture, noise, pixels[:n])
        _, rests, _ = descend_cross(cross, p, least, active[:count], n, REST)
        kept = 0
        for j in range(count):  # what is held at its least is no unknown
            k = active[j]
            if p[k] > least[k]:
                active[kept] = k
                kept += 1
        told[i, 0] = cross_sums(cross, p, np.ones(n), np.empty(n), active[:kept], normal, right)[1]
        told[i, 2] = kept
        if not invert(normal, kept, inverse):
            continue
        found[i] = p
        told[i, 3] = met | (0 if rests else RESTLESS)
        for j in range(kept):
            for k in range(kept):
                covariances[i, active[j], active[k]] = inverse[j, k]
