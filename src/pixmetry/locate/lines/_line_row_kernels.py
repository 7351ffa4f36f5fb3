"""Kernels of lines row by row: where each row (or column, for a flat line) crosses the line, and the regression over them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pixmetry.core._linear_algebra_kernels import invert
from pixmetry.core._normal_kernels import cdf, pdf
from pixmetry.core.arrays import Array
from pixmetry.core.jit import jit
from pixmetry.locate._noise_kernels import Noise, stored, variance_of
from pixmetry.locate.lines._line_kernels import (
    ACROSS,
    ALONG,
    AMPLITUDE,
    ANGLE,
    BACKGROUND,
    CURVE,
    OFFSET,
    SIGMA,
    TAPER,
    WIDTH,
    Fits,
    Lines,
    covered,
)
from pixmetry.locate.lines._profile_kernels import BAR, EDGE, profile

CENTROID, SQUARED, SOFT, TEMPLATE = 0, 1, 2, 3
THRESHOLD = 3.0  # of the soft threshold, in standard deviations of the noise
PHASES = 32
FACTS = 6  # of a row: its number, position, variance of it, distance across from the fitted line, place along it, its slope by background
MOST_STEPS = 8


class Rows(NamedTuple):
    """How the rows of lines are measured."""

    law: int
    aperture: float  # side of the pixel's square, px
    noise: Noise


class Row(NamedTuple):
    """A row (column, for a flat line) of one line."""

    section: int
    p: Array  # of the whole line, shape (UNKNOWNS,)
    slope: float  # how the distance across grows along the row
    a: float  # sides of the pixel across the line, px
    b: float
    noise: Noise


class Regressions(NamedTuple):
    """Lines by regression over their rows."""

    results: Array  # shape (n, 3 + 9): offset, angle, curvature against the fit of the whole line, and their covariance
    told: Array  # shape (n, 3): chi², degrees of freedom, standard deviation of the offset by sub-pixel phase


@jit
def expected(law: int, q: float, v: float) -> tuple[float, float, float]:
    """Return mean and variance of the law's weight of a value with mean q and variance v, and its mean slope."""
    if law == CENTROID:
        return q, v, 1.0
    if law == SQUARED:
        return q * q, 4.0 * q * q * v + 2.0 * v * v, 2.0 * q
    s = math.sqrt(v)
    z = q / s - THRESHOLD
    c, f = cdf(z), pdf(z)
    mean = s * (z * c + f)
    return mean, max(v * ((z * z + 1.0) * c + z * f) - mean * mean, 0.0), c


@jit
def weigh(law: int, q: float, v: float) -> float:
    """The law's weight of a value q with variance v; the squares are freed of the noise's own."""
    if law == CENTROID:
        return q
    if law == SQUARED:
        return q * q - v
    return max(q - THRESHOLD * math.sqrt(v), 0.0)


@jit
def predicted_row(law: int, row: Row, at: float, first: int, sign: float, pedestal: float, out: Array) -> tuple[float, float]:
    """Fill ``out`` with what a row's pixels hold on average: value, variance, weight, its variance, its slope, and the pixel's variance.

    Return Σ weight and Σ weight·x. The line crosses the row at ``at``. For an edge the values are steps from one pixel to the next,
    ``sign`` times.
    """
    section, p, noise = row.section, row.p, row.noise
    total, moment = 0.0, 0.0
    before, v_before = 0.0, 0.0
    for k in range(len(out)):
        d = (first + k - at) * row.slope
        mean = p[AMPLITUDE] * profile(section, d, p[SIGMA], p[WIDTH], row.a, row.b)[0]
        v = variance_of(max(mean + pedestal - noise.black_dn, 0.0), noise)
        if section != EDGE:
            q, vq, x = sign * mean, v, 1.0 * (first + k)
        else:
            q, vq, x = sign * (mean - before), v + v_before, first + k - 0.5
            before, v_before = mean, v
            if k == 0:
                continue
        weight, var, by = expected(law, q, vq)
        out[k, 0], out[k, 1], out[k, 2], out[k, 3], out[k, 4], out[k, 5] = q, vq, weight, var, by, v
        total += weight
        moment += weight * x
    return total, moment


@jit
def predicted_variance(law: int, section: int, at: float, first: int, out: Array, total: float) -> tuple[float, float]:
    """Return the variance of a row's position and its change per DN of background (propagator P1 about the line's own place)."""
    var, by_background, count = 0.0, 0.0, len(out)
    begin, middle = (1, 0.5) if section == EDGE else (0, 0.0)
    for k in range(begin, count):
        x = first + k - middle - at
        var += out[k, 3] * x * x
        by_background -= out[k, 4] * x
        if section == EDGE and k < count - 1:  # two steps share a pixel
            shared = -out[k, 5] * out[k, 4] * out[k + 1, 4] + (2.0 * out[k, 5] ** 2 if law == SQUARED else 0.0)
            var += 2.0 * x * (x + 1.0) * shared
    return max(var, 0.0) / (total * total), 0.0 if section == EDGE else by_background / total


@jit
def first_of(section: int, at: float, half: int) -> int:
    """First pixel of a row's window: the pixels, or the steps between them, lie about the one nearest to the line."""
    return int(math.floor(at + 0.5)) - half if section != EDGE else int(math.floor(at)) - half


@jit
def fit_row(row: Row, at: float, first: int, values: Array, pedestal: float) -> tuple[float, float]:
    """Fit place, height and background of one row; return the place and its variance, NaN if that fails."""
    p, slope = row.p, row.slope
    shift, height, ground = 0.0, p[AMPLITUDE], 0.0
    normal, inverse, right = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    j = np.empty(3)
    for _ in range(MOST_STEPS):
        normal[:, :] = 0.0
        right[:] = 0.0
        for k in range(len(values)):
            shape, by_d, _, _ = profile(row.section, (first + k - at - shift) * slope, p[SIGMA], p[WIDTH], row.a, row.b)
            j[0], j[1], j[2] = -height * by_d * slope, shape, 1.0
            mean = pedestal + ground + height * shape
            kept, v, gain = stored(mean, row.noise)
            rest = values[k] - kept
            for m in range(3):
                right[m] += j[m] * gain * rest / v
                for n in range(3):
                    normal[m, n] += j[m] * j[n] * gain * gain / v
        if not invert(normal, 3, inverse):
            return np.nan, np.nan
        by = inverse[0, 0] * right[0] + inverse[0, 1] * right[1] + inverse[0, 2] * right[2]
        most = 0.7 * (p[SIGMA] + 0.5)
        by = min(max(by, -most), most)
        shift += by
        height += inverse[1, 0] * right[0] + inverse[1, 1] * right[1] + inverse[1, 2] * right[2]
        ground += inverse[2, 0] * right[0] + inverse[2, 1] * right[1] + inverse[2, 2] * right[2]
        if by * by < 1e-6 * inverse[0, 0]:
            return (at + shift, inverse[0, 0]) if height * p[AMPLITUDE] > 0.0 else (np.nan, np.nan)
    return np.nan, np.nan


@jit
def rows_of(frame: NDArray[np.generic], how: Rows, section: int, p: Array, mine: int, others: Lines, rows: Array) -> int:
    """Measure the rows of one line (columns, where the line is flat) into ``rows``, shape (most, FACTS); return their number.

    Rows whose window leaves the frame or meets another line are left out.
    """
    law, aperture, place = how.law, how.aperture, others.places[mine]
    begin, end = others.begin[mine], others.begin[mine + 1]
    angle = place[2] + p[ANGLE]
    c, s = math.cos(angle), math.sin(angle)
    c0, s0 = math.cos(place[2]), math.sin(place[2])
    a, b = aperture * max(abs(c), abs(s)), aperture * min(abs(c), abs(s))
    steep = abs(s) >= abs(c)
    slope = -s if steep else c  # of the distance across, along a row
    run = s if steep else c  # of the row's number, along the line
    x0, y0 = place[0] - s * p[OFFSET], place[1] + c * p[OFFSET]
    scan0, cross0 = (y0, x0) if steep else (x0, y0)
    drift = c if steep else s
    blur = math.sqrt(p[SIGMA] ** 2 + 1.0 / 12.0)
    wide = 0.5 * (p[WIDTH] if section == BAR else 0.0) + (6.0 if law == TEMPLATE else 4.0) * blur + (1.0 if law == TEMPLATE else 0.0)
    half = int(math.ceil(wide / abs(slope)))
    count = 2 * half + (2 if section == EDGE else 1)
    lines, across = (frame.shape[0], frame.shape[1]) if steep else (frame.shape[1], frame.shape[0])
    values, out = np.empty(count), np.zeros((count, 6))
    ends = (scan0 + run * place[3], scan0 + run * place[4])
    n = 0
    for r in range(max(0, int(math.ceil(min(ends)))), min(lines, int(math.floor(max(ends))) + 1)):
        t = (r - scan0) / run
        for _ in range(2 if p[CURVE] != 0.0 else 0):  # the curve's sagitta moves the row's crossing along the line
            t = (r - scan0 - (c if steep else -s) * 0.5 * p[CURVE] * t * t) / run
        at = cross0 + drift * t + slope * 0.5 * p[CURVE] * t * t
        first = first_of(section, at, half)
        if first < 0 or first + count > across:
            continue
        spoilt = False
        for k in range(count):
            col, row = (first + k, r) if steep else (r, first + k)
            values[k] = frame[row, col]
            for m in range(begin, end):
                other = others.near[m]
                if other != mine and covered(others.places[other], others.cores[other], angle, 0.5 * wide, col, row):
                    spoilt = True
        if spoilt:
            continue
        dx, dy = (at - place[0], r - place[1]) if steep else (r - place[0], at - place[1])
        along, cross = c0 * dx + s0 * dy, c0 * dy - s0 * dx
        pedestal = p[BACKGROUND] + p[ALONG] * along + p[ACROSS] * cross
        by_row = p[ACROSS] * (-s0 if steep else c0) + p[ALONG] * (c0 if steep else s0)
        full = p.copy()
        full[AMPLITUDE] *= 1.0 + p[TAPER] * along
        for k in range(count):
            values[k] -= by_row * (first + k - at)
        by_background, here = 0.0, Row(section, full, slope, a, b, how.noise)
        if law == TEMPLATE:
            position, var = fit_row(here, at, first, values, pedestal)
        else:
            sign = 1.0 if full[AMPLITUDE] * (slope if section == EDGE else 1.0) > 0.0 else -1.0
            total, _ = predicted_row(law, here, at, first, sign, pedestal, out)
            var, by_background = predicted_variance(law, section, at, first, out, total)
            by_background *= sign
            weight, moment = 0.0, 0.0
            for k in range(1 if section == EDGE else 0, count):
                q, x = (values[k] - values[k - 1], first + k - 0.5) if section == EDGE else (values[k] - pedestal, 1.0 * (first + k))
                f = weigh(law, sign * q, out[k, 1])
                weight += f
                moment += f * x
            position = moment / weight if weight > 0.2 * total else np.nan
        if not (math.isfinite(position) and abs(position - at) <= half and var > 0.0):
            continue
        rows[n, 0], rows[n, 1], rows[n, 2] = r, position, var
        rows[n, 3], rows[n, 4], rows[n, 5] = (position - at) * slope, t, by_background * slope
        n += 1
    return n


@jit
def phase_errors(how: Rows, section: int, p: Array, angle: float, errors: Array) -> None:
    """Put the noise-free errors of a row's position into ``errors`` for `PHASES` sub-pixel phases: distances across the line."""
    law, aperture = how.law, how.aperture
    c, s = math.cos(angle), math.sin(angle)
    a, b = aperture * max(abs(c), abs(s)), aperture * min(abs(c), abs(s))
    slope = -s if abs(s) >= abs(c) else c
    wide = 0.5 * (p[WIDTH] if section == BAR else 0.0) + 4.0 * math.sqrt(p[SIGMA] ** 2 + 1.0 / 12.0)
    half = int(math.ceil(wide / abs(slope)))
    count = 2 * half + (2 if section == EDGE else 1)
    out = np.zeros((count, 6))
    sign = 1.0 if p[AMPLITUDE] * (slope if section == EDGE else 1.0) > 0.0 else -1.0
    for j in range(PHASES):
        at = (j + 0.5) / PHASES
        first = first_of(section, at, half)
        total, moment = predicted_row(law, Row(section, p, slope, a, b, how.noise), at, first, sign, p[BACKGROUND], out)
        errors[j] = (moment / total - at) * slope


@jit
def regress(rows: Array, unknowns: int, var_background: float, slope: float, errors: Array, out: Array, cov: Array) -> tuple[float, float]:
    """Fit offset, turn (and curvature) to the distances of rows from the template; return chi² and the standard deviation by phase.

    The covariance holds the rows' noise, the background they share, and the rows' errors by phase for any common phase.
    """
    n = len(rows)
    normal, inverse, right, shared = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    g = np.empty(3)
    for i in range(n):
        w = slope * slope * rows[i, 2]
        g[0], g[1], g[2] = 1.0, rows[i, 4], 0.5 * rows[i, 4] ** 2
        for j in range(unknowns):
            right[j] += g[j] * rows[i, 3] / w
            shared[j] += g[j] * rows[i, 5] / w
            for k in range(unknowns):
                normal[j, k] += g[j] * g[k] / w
    if not invert(normal, unknowns, inverse):
        return np.nan, np.nan
    pulled = np.zeros(3)
    for j in range(unknowns):
        out[j] = 0.0
        for k in range(unknowns):
            out[j] += inverse[j, k] * right[k]
            pulled[j] += inverse[j, k] * shared[k]
    by_phase = np.zeros((3, 3))
    for turn in range(PHASES):
        force = np.zeros(3)
        for i in range(n):
            at = rows[i, 1] - rows[i, 3] / slope
            e = errors[int((at - math.floor(at)) * PHASES + turn) % PHASES] / (slope * slope * rows[i, 2])
            force[0] += e
            force[1] += e * rows[i, 4]
            force[2] += e * 0.5 * rows[i, 4] ** 2
        moved = inverse @ force
        for j in range(unknowns):
            for k in range(unknowns):
                by_phase[j, k] += moved[j] * moved[k] / PHASES
    chi = 0.0
    for i in range(n):
        rest = rows[i, 3] - out[0] - out[1] * rows[i, 4]
        if unknowns > 2:
            rest -= out[2] * 0.5 * rows[i, 4] ** 2
        chi += rest * rest / (slope * slope * rows[i, 2])
    for j in range(unknowns):
        for k in range(unknowns):
            cov[j, k] = inverse[j, k] + var_background * pulled[j] * pulled[k] + by_phase[j, k]
    return chi, math.sqrt(by_phase[0, 0])


@jit
def regress_lines(
    frame: NDArray[np.generic], span: tuple[int, int], how: Rows, section: Array, fits: Fits, lines: Lines, out: Regressions
) -> None:
    """Replace offset, angle and curvature of fitted lines, number ``span[0]`` to ``span[1]``, by those from their rows.

    ``section``, shape (n,), is the one that was fitted.
    """
    rows = np.empty((max(frame.shape[0], frame.shape[1]), FACTS))
    errors, found, cov = np.zeros(PHASES), np.zeros(3), np.zeros((3, 3))
    for i in range(span[0], span[1]):
        out.results[i] = np.nan
        out.told[i] = np.nan
        if not math.isfinite(fits.values[i, 0]):
            continue
        p, kind, covariance = fits.values[i], int(section[i]), fits.covariances[i]
        angle = lines.places[i, 2] + p[ANGLE]
        n = rows_of(frame, how, kind, p, i, lines, rows)
        unknowns = 3 if covariance[CURVE, CURVE] > 0.0 else 2
        if n <= unknowns:
            continue
        errors[:] = 0.0
        if how.law != TEMPLATE:
            phase_errors(how, kind, p, angle, errors)
        slope = -math.sin(angle) if abs(math.sin(angle)) >= abs(math.cos(angle)) else math.cos(angle)
        found[:] = 0.0
        cov[:, :] = 0.0
        chi, phase = regress(rows[:n], unknowns, covariance[BACKGROUND, BACKGROUND], slope, errors, found, cov)
        if not math.isfinite(chi):
            continue
        out.results[i, :3] = found
        out.results[i, 3:] = cov.ravel()
        out.told[i, 0], out.told[i, 1], out.told[i, 2] = chi, n - unknowns, phase
