"""Kernels of whole lines and edges: their pixels, the model with its derivatives, and the weighted least-squares fit."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pixmetry.core._least_squares_kernels import Rest, descent_of
from pixmetry.core._linear_algebra_kernels import invert
from pixmetry.core.arrays import Array, Ints
from pixmetry.core.jit import jit
from pixmetry.locate._noise_kernels import Noise, stored
from pixmetry.locate.lines._profile_kernels import BAR, GAUSSIAN, profile

# Unknowns. Offset across the line and angle are against the candidate's; the slopes of the background run across and along it.
OFFSET, ANGLE, BACKGROUND, AMPLITUDE, SIGMA, WIDTH, ACROSS, ALONG, TAPER, CURVE, FLAT = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10
UNKNOWNS = 10  # FLAT is no unknown: it tests whether the section is a bar rather than a Gaussian
OFF, ON, AUTO = 0, 1, 2
LEAST_SIGMA, LEAST_WIDTH = 0.05, 0.1
SIGNIFICANT = 3.0  # standard deviations from which a slope, a taper or a curvature is taken in
REST = Rest(1e-5, 0.0, math.inf, 1e-2)  # falls of χ²: 0.003 and 0.1 standard deviations
PARALLEL = 0.05  # sine of the angle below which lines count as parallel
BORDERS, HIGH, LOW, SHARED, RESTLESS, SINGULAR = 1, 2, 4, 8, 16, 32  # what a fit came across


class Lines(NamedTuple):
    """Where lines were looked for, and which of them are near to each other."""

    places: Array  # shape (n, 6): x, y, angle, least and greatest distance along the line, curvature; px, rad
    cores: Array  # shape (n,): how far to either side a line spoils the pixels of others, px
    begin: Ints  # shape (n + 1,): the lines near line i are near[begin[i]:begin[i + 1]]
    near: Ints


class Pixels(NamedTuple):
    """Pixels of one line: places relative to the candidate's in px, and grey values in DN; shape (pixels,) each."""

    x: Array
    y: Array
    value: Array


class Candidates(NamedTuple):
    """What fits start from."""

    lines: Lines
    reach: Array  # shape (n,): of the pixels, to either side, px
    start: Array  # shape (n, 4): background, amplitude, sigma, width


class How(NamedTuple):
    """How lines are fitted."""

    section: int
    choose: bool  # whether a Gaussian may become a bar
    options: Ints  # OFF, ON or AUTO for the background's plane, the taper and the curvature
    aperture: float  # side of the pixel's square, px
    noise: Noise


class Fits(NamedTuple):
    """Results of fits."""

    values: Array  # shape (n, UNKNOWNS)
    covariances: Array  # shape (n, UNKNOWNS, UNKNOWNS)
    told: Array  # shape (n, 5): chi², pixels, unknowns, what was met, section


class Line(NamedTuple):
    """One line to be fitted."""

    section: int
    angle: float  # of the candidate, rad
    half: float  # greatest distance along it, px
    aperture: float
    noise: Noise
    pixels: Pixels


@jit
def covered(other: Array, reach: float, angle: float, d: float, col: float, row: float) -> bool:
    """Whether a pixel, at distance d from a line of some angle, belongs to another line that is too close."""
    co, so = math.cos(other[2]), math.sin(other[2])
    u, v = col - other[0], row - other[1]
    t = co * u + so * v
    across = co * v - so * u - 0.5 * other[5] * t * t
    if t < other[3] - reach or t > other[4] + reach or abs(across) > reach:
        return False
    parallel = abs(math.sin(other[2] - angle)) < PARALLEL
    return abs(across) < abs(d) if parallel else True


@jit
def gather(
    frame: NDArray[np.generic], place: Array, reach: float, mine: int, lines: Lines, ends: tuple[float, float], out: Pixels
) -> tuple[int, int]:
    """Collect the pixels within reach of a line that other lines do not cover; return their number and what was met.

    ``place``: x, y, angle, least and greatest distance along the line, curvature. ``mine``: its number among the ``lines``. ``ends``: of
    the scale, DN.
    """
    low, high = ends
    x, y, value = out.x, out.y, out.value
    places, cores, near, first, stop = lines.places, lines.cores, lines.near, lines.begin[mine], lines.begin[mine + 1]
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
def turned(p: Array, angle: float, aperture: float) -> tuple[tuple[float, float, float, float], tuple[float, float]]:
    """Cosine and sine of a line's direction and of its candidate's, and the sides of the pixel across it in px."""
    c, s = math.cos(angle + p[ANGLE]), math.sin(angle + p[ANGLE])
    return (c, s, math.cos(angle), math.sin(angle)), (aperture * max(abs(c), abs(s)), aperture * min(abs(c), abs(s)))


@jit
def pixel(
    section: int, p: Array, turn: tuple[float, float, float, float], box: tuple[float, float], dx: float, dy: float, out: Array
) -> tuple[float, float, float]:
    """Return the grey value of a pixel, its distance across and its height; put its derivatives into ``out`` (all but FLAT).

    ``turn`` and ``box`` are those of `turned`.
    """
    c, s, c0, s0 = turn
    a, b = box
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
def sums(line: Line, p: Array, weight: Array, fresh: Array, active: Ints, normal: Array, right: Array) -> tuple[float, float]:
    """Normal equations of the active unknowns, χ² with the given weights and with fresh ones; see `descent_of`."""
    turn, box = turned(p, line.angle, line.aperture)
    section, noise, x, y, value = line.section, line.noise, line.pixels.x, line.pixels.y, line.pixels.value
    count = len(active)
    normal[:, :] = 0.0
    right[:] = 0.0
    slopes = np.zeros(UNKNOWNS + 1)
    chi_old, chi_new = 0.0, 0.0
    flat = count > 0 and active[count - 1] == FLAT
    w_bar = 2.4 * p[SIGMA]
    s_bar = math.sqrt(p[SIGMA] ** 2 - w_bar * w_bar / 12.0)
    scale_bar = p[SIGMA] * math.sqrt(2.0 * math.pi) / w_bar  # the same area
    for i in range(len(value)):
        mean, d, height = pixel(section, p, turn, box, x[i], y[i], slopes)
        if flat:
            bar = profile(BAR, d, s_bar, w_bar, box[0], box[1])[0]
            slopes[FLAT] = p[AMPLITUDE] * (scale_bar * bar - height)
        expected, variance, gain = stored(mean, noise)
        rest = value[i] - expected
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
def limited(line: Line, p: Array, change: Array, active: Ints, trial: Array) -> bool:
    """Put p + change into ``trial``, no further than the model can be trusted; see `descent_of`."""
    trial[:] = p
    size, half = 1.0, line.half
    reach = 0.5 * (p[SIGMA] + 0.5)
    for j in range(len(active)):
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
    for j in range(len(active)):
        trial[active[j]] += size * change[j]
    trial[SIGMA] = max(trial[SIGMA], LEAST_SIGMA)
    trial[WIDTH] = max(trial[WIDTH], LEAST_WIDTH)
    return True


descend_line = descent_of(sums, limited)


@jit
def significance(normal: Array, right: Array, count: int, kept: int, chi_per_dof: float) -> Array:
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
def take_in(active: Ints, count: int, extra: Ints, most: int) -> int:
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
def fit_one(line: Line, choose: bool, options: Ints, p: Array, active: Ints) -> tuple[int, int, bool]:
    """Fit one line and choose its section; return section, number of unknowns, and whether it converged.

    ``options`` and ``choose`` as in `How`.
    """
    size, n, section = UNKNOWNS + 1, len(line.pixels.value), line.section
    normal, right = np.zeros((size, size)), np.zeros(size)
    weight, fresh = np.ones(n), np.empty(n)
    wanted = np.empty(size, np.int64)
    least = np.full(UNKNOWNS, -np.inf)
    least[SIGMA], least[WIDTH] = LEAST_SIGMA, LEAST_WIDTH
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
    rests, tried = False, False
    for _ in range(4):
        if n <= count + 2:
            return section, count, False
        here = Line(section, line.angle, line.half, line.aperture, line.noise, line.pixels)
        chi, rests, _ = descend_line(here, p, least, active[:count], n, REST)
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
        sums(here, p, weight, fresh, active[:full], normal, right)
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
    return section, count, rests


@jit
def fit_lines(frame: NDArray[np.generic], first: int, stop: int, how: How, candidates: Candidates, fits: Fits) -> None:
    """Fit candidates ``first`` to ``stop``."""
    size = UNKNOWNS + 1
    normal, right, inverse = np.zeros((size, size)), np.zeros(size), np.zeros((size, size))
    active, p = np.empty(size, np.int64), np.empty(UNKNOWNS)
    own = np.empty_like(how.options)
    lines, noise = candidates.lines, how.noise
    values, covariances, told = fits.values, fits.covariances, fits.told
    for i in range(first, stop):
        place, start, reach = lines.places[i], candidates.start[i], candidates.reach[i]
        half, curve = max(place[4], -place[3]), place[5]
        tall, wide = 2.0 * reach + 2.0, place[4] - place[3] + 2.0
        area = tall * wide * (1.0 + 0.5 * (curve * half) ** 2) + 4.0 * (tall + wide)
        room = int(min(max(area, 0.0), 1.0 * frame.size)) + 16  # a line that lies outside the frame has a negative length there
        all_pixels = Pixels(np.empty(room), np.empty(room), np.empty(room))
        n, met = gather(frame, place, reach, i, lines, (noise.low_dn, noise.high_dn), all_pixels)
        pixels = Pixels(all_pixels.x[:n], all_pixels.y[:n], all_pixels.value[:n])
        p[:] = 0.0
        p[BACKGROUND], p[AMPLITUDE], p[SIGMA], p[WIDTH] = start[0], start[1], start[2], start[3]
        own[:] = how.options
        if own[2] != OFF and 0.5 * abs(curve) * half * half > 0.5 * start[2]:
            own[2], p[CURVE] = ON, curve  # plainly curved
        mine = how.section
        if how.choose and mine == GAUSSIAN and start[3] > 3.0 * start[2]:
            mine = BAR  # plainly one
        mine, count, rests = fit_one(Line(mine, place[2], half, how.aperture, noise, pixels), how.choose, own, p, active)
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
        line = Line(mine, place[2], half, how.aperture, noise, pixels)
        told[i, 0] = sums(line, p, np.ones(n), np.empty(n), active[:count], normal, right)[1]
        if not invert(normal, count, inverse):
            continue
        told[i, 3], values[i] = met, p
        for j in range(count):
            for k in range(count):
                covariances[i, active[j], active[k]] = inverse[j, k]


@jit
def render(section: int, p: Array, angle: float, aperture: float, x: Array, y: Array, mean: Array, jacobian: Array) -> None:
    """Put the grey values at pixels x, y (relative to the candidate's place) and their derivatives into ``mean`` and ``jacobian``."""
    turn, box = turned(p, angle, aperture)
    for i in range(len(x)):
        mean[i] = pixel(section, p, turn, box, x[i], y[i], jacobian[i])[0]
