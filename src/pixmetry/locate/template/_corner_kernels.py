"""Kernels of corners: the blurred crossing of two edges, averaged over the pixel, and its weighted least-squares fit.

A chessboard's corner is the product of two steps, sgn(u) · sgn(v), with u and v the distances from its two lines. Blurred with a
Gaussian it is the expectation of that product over a pair of normal variables whose correlation is the cosine between the normals, so

    s(u, v) = 4 Φ₂(u/σ, v/σ; ρ) − 2 Φ(u/σ) − 2 Φ(v/σ) + 1,        Φ₂ = Φ(h)Φ(k) + 1/2π ∫₀^asin ρ exp(−(h² + k² − 2hk sin t) / 2cos²t) dt

(Z. Drezner, G. O. Wesolowsky, J. Stat. Comput. Simul. 35, 101 (1990)). The pixel's square is replaced by normal densities, which only
widen the blur: two an axis have its moments up to the fifth and, to 9 %, its sixth cumulant; three, for sharp edges, up to the seventh.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pixmetry.core._least_squares_kernels import FREE, Rest, descent_of
from pixmetry.core._linear_algebra_kernels import factor_for, invert, solve
from pixmetry.core.arrays import Array, Ints
from pixmetry.core.jit import jit
from pixmetry.locate._noise_kernels import Noise, stored

NODE, REST = 240.0**-0.25, 1.0 / 12.0 - 240.0**-0.5  # for an aperture of 1 px: ±NODE, NODE⁴ = 1/240, NODE² + REST = 1/12
SHARP_NODE, SHARP_WEIGHT, SHARP_REST = 0.345832000, 0.318902969, 0.007051891  # ±NODE with this weight and 0 with what is left
SHARP_PX = 0.5  # blur, in pixels of aperture, below which three are taken
FAR = 5.0  # in standard deviations: beyond, a step is ±1 to 6e-7
LEAST_BLUR_PX = 0.05
REST_FALL = 1e-5  # of χ²: squared length of a step in standard errors at which a fit is at rest
LEAST_SINE = 0.1  # of the angle between the edges
PLAIN, ALL = 7, 11  # number of unknowns: x, y, two angles, blur, mean, contrast; with planes in mean and contrast
NODES = np.outer([0.2386191860831969, 0.6612093864662645, 0.9324695142031521], [-1.0, 1.0]).ravel()  # Gauss–Legendre, 6 points
WEIGHTS = np.repeat([0.4679139345726910, 0.3607615730481386, 0.1713244923791704], 2)  # Φ₂ to 2e-6 up to ρ = 0.9
NEVER, ALWAYS, AUTO = 0, 1, 2  # whether planes are among the unknowns

Six = tuple[float, float, float, float, float, float]


class Corner(NamedTuple):
    """One corner to be fitted."""

    x: Array  # places of pixels, shape (pixels,), px
    y: Array
    value: Array  # their grey values, DN
    about: tuple[float, float]  # middle of the window
    reach: float  # its radius, px
    aperture: float  # side of the pixel's square, px
    noise: Noise


class How(NamedTuple):
    """How corners are fitted."""

    planes: int  # NEVER, ALWAYS, or AUTO: where χ² falls by more than ``significant``
    significant: float
    aperture: float
    noise: Noise


class Fits(NamedTuple):
    """Results of fits."""

    found: Array  # shape (n, ALL)
    covariance: Array  # shape (n, 3), of x, xy, y, px²
    chi2: Array
    dof: Ints
    states: Ints  # bit 1 at rest, bit 2 window cut, bit 4 planes used, bit 8 at the top, 16 at the bottom of the scale


class Edges(NamedTuple):
    """What the pixels of a corner have in common."""

    normal_1: tuple[float, float]  # of the two edges: cos, sin
    normal_2: tuple[float, float]
    rho: float  # cosine of the angle between them
    sine: float
    root: float  # √(1 − ρ²)
    sines: Six  # sin t at the nodes of the integral of Φ₂
    falls: Six  # 1/cos² t there
    span: float  # ½ asin ρ; 0 where there is nothing to integrate
    side: int  # normal densities an axis that make up a pixel's square
    step: float  # from one to the next, px
    outer: float  # weight of the outer ones
    variance: float  # of the blur with them, px²
    wide: float  # its root, px


@jit
def _six(values: Array) -> Six:
    """Six numbers as a tuple: an array's users would be counted again for every pixel."""
    return values[0], values[1], values[2], values[3], values[4], values[5]


@jit
def _edges_of(p: Array, aperture: float) -> Edges:
    """Prepare the edges of a corner."""
    rho, sine = math.cos(p[2] - p[3]), math.sin(p[2] - p[3])
    side, step, rest, outer = 2, 2.0 * NODE * aperture, REST, 0.5
    if p[4] < SHARP_PX * aperture:
        side, step, rest, outer = 3, SHARP_NODE * aperture, SHARP_REST, SHARP_WEIGHT
    variance = p[4] * p[4] + rest * aperture * aperture
    span = 0.5 * math.asin(rho) if abs(rho) > 1e-12 else 0.0
    first, second = (math.cos(p[2]), math.sin(p[2])), (math.cos(p[3]), math.sin(p[3]))
    sines = np.sin(span * (1.0 + NODES))
    root, falls = max(abs(sine), 1e-6), 1.0 / (1.0 - sines * sines)
    return Edges(first, second, rho, sine, root, _six(sines), _six(falls), span, side, step, outer, variance, math.sqrt(variance))


@jit
def _crossing(h: float, k: float, edges: Edges) -> tuple[float, float, float, float, float, float]:
    """E[sgn sgn] and its derivatives by h, k, ρ (the same as by h and k), hh, kk."""
    if abs(h) > FAR and abs(k) > FAR:
        return math.copysign(1.0, h * k), 0.0, 0.0, 0.0, 0.0, 0.0
    if abs(k) > FAR:
        side, slope = math.copysign(1.0, k), 0.7978845608028654 * math.exp(-0.5 * h * h)
        return side * math.erf(h * 0.7071067811865476), side * slope, 0.0, 0.0, -h * side * slope, 0.0
    if abs(h) > FAR:
        side, slope = math.copysign(1.0, h), 0.7978845608028654 * math.exp(-0.5 * k * k)
        return side * math.erf(k * 0.7071067811865476), 0.0, side * slope, 0.0, 0.0, -k * side * slope
    rho, root = edges.rho, edges.root
    value = math.erf(h * 0.7071067811865476) * math.erf(k * 0.7071067811865476)
    if edges.span != 0.0:
        squares, product, total = 0.5 * (h * h + k * k), h * k, 0.0
        for i in range(6):
            total += WEIGHTS[i] * math.exp((edges.sines[i] * product - squares) * edges.falls[i])
        value += 4.0 * edges.span * total / (2.0 * math.pi)
    a, b = (k - rho * h) / root, (h - rho * k) / root
    edge_h, edge_k = 0.7978845608028654 * math.exp(-0.5 * h * h), 0.7978845608028654 * math.exp(-0.5 * k * k)
    by_h, by_k = edge_h * math.erf(a * 0.7071067811865476), edge_k * math.erf(b * 0.7071067811865476)
    both = edge_h * 0.7978845608028654 * math.exp(-0.5 * a * a) / root  # 4 φ₂
    return value, by_h, by_k, both, -h * by_h - rho * both, -k * by_k - rho * both


@jit
def pixel(x: float, y: float, p: Array, edges: Edges, unknowns: int, d: Array) -> float:
    """Grey value of the pixel at (x, y) from the corner; its derivatives by the unknowns go into d."""
    (c1, s1), (c2, s2) = edges.normal_1, edges.normal_2
    rho, sine, root = edges.rho, edges.sine, edges.root
    side, step, outer, variance, wide = edges.side, edges.step, edges.outer, edges.variance, edges.wide
    contrast, cx, cy = p[6], p[9], p[10]
    for i in range(unknowns):
        d[i] = 0.0
    light = 0.0
    near = FAR * wide + step
    u, v = c1 * x + s1 * y, c2 * x + s2 * y
    if abs(u) > near and abs(v) > near and unknowns == PLAIN:
        d[5], d[6] = 1.0, math.copysign(1.0, u * v)
        far: float = p[5] + contrast * d[6]
        return far
    for node in range(side * side):
        i, j = node // side, node % side
        weight = (1.0 - 2.0 * outer if side == 3 and i == 1 else outer) * (1.0 - 2.0 * outer if side == 3 and j == 1 else outer)
        px, py = x + (j - 0.5 * (side - 1)) * step, y + (i - 0.5 * (side - 1)) * step
        u, v = (c1 * px + s1 * py) / wide, (c2 * px + s2 * py) / wide
        s, su, sv, both, suu, svv = _crossing(u, v, edges)  # derivatives by u and v, the distances over the blur
        q1, q2 = (c1 * py - s1 * px) / wide, (c2 * py - s2 * px) / wide
        sx, sy = (c1 * su + c2 * sv) / wide, (s1 * su + s2 * sv) / wide
        local = weight * (contrast + cx * px + cy * py)
        d[0] -= local * sx
        d[1] -= local * sy
        d[2] += local * (su * q1 - both * sine)
        d[3] += local * (sv * q2 + both * sine)
        d[4] -= local * (u * su + v * sv) * p[4] / variance
        d[6] += weight * s
        if unknowns == ALL:
            # light falls on the surface, before the blur: x s becomes x s + σ² ∂s/∂x
            suv = both
            sxx, sxy = c1 * c1 * suu + 2 * c1 * c2 * suv + c2 * c2 * svv, c1 * s1 * suu + (c1 * s2 + c2 * s1) * suv + c2 * s2 * svv
            syy = s1 * s1 * suu + 2 * s1 * s2 * suv + s2 * s2 * svv
            g1, g2 = weight * (cx * c1 + cy * s1), weight * (cx * c2 + cy * s2)
            by_rho = -both * (g1 * (u - rho * v) + g2 * (v - rho * u)) / (root * root)
            d[0] -= weight * (cx * (s + sxx) + cy * sxy)
            d[1] -= weight * (cy * (s + syy) + cx * sxy)
            d[2] += wide * (weight * (cy * c1 - cx * s1) * su + (g1 * suu + g2 * suv) * q1 - by_rho * sine)
            d[3] += wide * (weight * (cy * c2 - cx * s2) * sv + (g1 * suv + g2 * svv) * q2 + by_rho * sine)
            d[4] += (g1 * (su - u * suu - v * suv) + g2 * (sv - u * suv - v * svv)) * p[4] / wide
            d[9] += weight * (px * s + variance * sx)
            d[10] += weight * (py * s + variance * sy)
    d[5] = 1.0
    value = p[5] + contrast * d[6]
    if unknowns == ALL:
        d[0] -= p[7]
        d[1] -= p[8]
        d[7], d[8] = x, y
        light = p[7] * x + p[8] * y + cx * d[9] + cy * d[10]
    level: float = value + light
    return level


@jit
def normal_equations(
    corner: Corner, p: Array, kept: Array, weights: Array, active: Ints, matrix: Array, right: Array
) -> tuple[float, float]:
    """Normal equations of the active unknowns, χ² with the kept weights and with those at p; see `descent_of`."""
    xs, ys, values, noise, unknowns = corner.x, corner.y, corner.value, corner.noise, len(active)
    chi2, before = 0.0, 0.0
    d, edges = np.zeros(ALL), _edges_of(p, corner.aperture)
    matrix[:, :] = 0.0
    right[:] = 0.0
    for i in range(len(values)):
        level = pixel(xs[i] - p[0], ys[i] - p[1], p, edges, unknowns, d)
        mean, variance, slope = stored(level, noise)
        weight, residual = 1.0 / variance, values[i] - mean
        weights[i] = weight
        chi2 += residual * residual * weight
        before += residual * residual * kept[i]
        weight *= slope
        for a in range(unknowns):
            weighted = weight * d[a]
            right[a] += weighted * residual
            weighted *= slope
            for b in range(a + 1):
                matrix[a, b] += weighted * d[b]
    return before, chi2


@jit
def trusted(corner: Corner, p: Array, change: Array, active: Ints, trial: Array) -> bool:
    """Put p + change into ``trial``; False where that is no corner of this window; see `descent_of`."""
    trial[:] = p
    for j in range(len(active)):
        trial[active[j]] += change[j]
    trial[4] = max(abs(trial[4]), LEAST_BLUR_PX)
    reach = corner.reach
    outside = abs(trial[0] - corner.about[0]) > 0.7 * reach or abs(trial[1] - corner.about[1]) > 0.7 * reach or trial[4] > 2.0 * reach
    return not outside and abs(math.sin(trial[2] - trial[3])) >= LEAST_SINE


descend_corner = descent_of(normal_equations, trusted)


@jit
def _start(corner: Corner, p: Array, profile: Array, members: Array) -> None:
    """Angles, mean and contrast of a window from the mean grey value against direction, which repeats after half a turn."""
    values, xs, ys, count = corner.value, corner.x, corner.y, len(corner.value)
    bins = profile.shape[0]
    profile[:] = 0.0
    members[:] = 0.0
    mean, used = 0.0, 0
    for i in range(count):
        x, y = xs[i] - p[0], ys[i] - p[1]
        if x * x + y * y < 2.25:
            continue
        place = int(math.floor(math.atan2(y, x) / math.pi * bins)) % bins
        profile[place] += values[i]
        members[place] += 1.0
        mean += values[i]
        used += 1
    mean /= max(used, 1)
    for i in range(bins):
        profile[i] -= mean * members[i]
    best, first, stop = 0.0, 0, bins // 2
    for i in range(bins):
        total = 0.0
        for j in range(i, bins):
            total += profile[j]
            if abs(total) > abs(best):
                best, first, stop = total, i, j + 1
    inside, outside, n_in, n_out = 0.0, 0.0, 0.0, 0.0
    for i in range(bins):
        if first <= i < stop:
            inside += profile[i]
            n_in += members[i]
        else:
            outside += profile[i]
            n_out += members[i]
    inside, outside = inside / max(n_in, 1.0), outside / max(n_out, 1.0)
    # edges in the directions first and stop, normals a quarter turn on: from the one to the other the two distances differ in sign
    p[2], p[3] = math.pi * first / bins + 0.5 * math.pi, math.pi * stop / bins + 0.5 * math.pi
    p[5], p[6] = mean + 0.5 * (inside + outside), 0.5 * (outside - inside)


@jit
def _descend(corner: Corner, p: Array, unknowns: int, inverse: Array) -> tuple[float, bool]:
    """Fit one corner from p, in place: χ² and whether it came to rest. The inverse of JᵀWJ at the end goes into ``inverse``."""
    n, active = len(corner.value), np.arange(unknowns)
    chi2, at_rest, normal = descend_corner(corner, p, np.full(ALL, -np.inf), active, n, Rest(REST_FALL, 0.0, FREE, 0.0))
    solved = invert(normal, unknowns, inverse)
    return chi2, at_rest and solved


@jit
def _promised_fall(corner: Corner, p: Array) -> float:
    """Fall of χ² that one step with all unknowns promises from p."""
    n, matrix, right, step = len(corner.value), np.zeros((ALL, ALL)), np.zeros(ALL), np.zeros(ALL)
    normal_equations(corner, p, np.zeros(n), np.empty(n), np.arange(ALL), matrix, right)
    if not solve(matrix, ALL, right, 0.0, factor_for(ALL), step):
        return math.inf
    return float((step * right).sum())


@jit
def _window(frame: NDArray[np.generic], about: tuple[float, float], reach: float, noise: Noise, out: Array) -> tuple[int, int]:
    """Collect the pixels of a round window into ``out``, shape (room, 3): x, y, value; return their number and what was met."""
    column, row = about
    height, width = frame.shape
    count, state = 0, 0
    for i in range(int(math.ceil(row - reach)), int(math.floor(row + reach)) + 1):
        for j in range(int(math.ceil(column - reach)), int(math.floor(column + reach)) + 1):
            if (i - row) ** 2 + (j - column) ** 2 > reach * reach:
                continue
            if not (0 <= i < height and 0 <= j < width):
                state |= 2
                continue
            value = np.float64(frame[i, j])
            out[0, count], out[1, count], out[2, count] = j, i, value
            state |= (8 if value >= noise.high_dn else 0) | (16 if value <= noise.low_dn else 0)
            count += 1
    return count, state


@jit
def fit_corners(frame: NDArray[np.generic], x: Array, y: Array, reach: Array, how: How, fits: Fits) -> None:
    """Fit corners from rough places, shape (n,) each, in windows of the radii ``reach``, px."""
    profile, members = np.zeros(48), np.zeros(48)
    inverse = np.zeros((ALL, ALL))
    plain, plain_inverse = np.zeros(ALL), np.zeros((ALL, ALL))
    for n in range(len(x)):
        r = reach[n]
        pixels = np.empty((3, int(2 * math.ceil(r) + 1) ** 2))
        p = fits.found[n]
        p[0], p[1] = x[n], y[n]
        for turn in range(3):
            about = (p[0], p[1])
            count, state = _window(frame, about, r, how.noise, pixels)
            if count < 4 * ALL:
                break
            corner = Corner(pixels[0, :count], pixels[1, :count], pixels[2, :count], about, r, how.aperture, how.noise)
            if turn == 0:
                p[4] = min(0.8, 0.2 * r)
                _start(corner, p, profile, members)
            unknowns = PLAIN
            p[PLAIN:] = 0.0
            value, rest = _descend(corner, p, PLAIN, inverse)
            tempting = how.planes == ALWAYS or how.planes == AUTO and 2.0 * _promised_fall(corner, p) > how.significant
            if how.planes > NEVER and rest and tempting:
                plain[:] = p
                plain_inverse[:, :] = inverse
                fuller, rested = _descend(corner, p, ALL, inverse)
                scatter = max(fuller / max(count - ALL, 1), 1.0)  # a model that fits badly makes every unknown look useful
                if how.planes == ALWAYS or (rested and value - fuller > how.significant * scatter):
                    value, rest, unknowns = fuller, rested, ALL
                else:
                    p[:] = plain
                    inverse[:, :] = plain_inverse
            fits.dof[n] = count - unknowns
            fits.chi2[n] = value
            state |= (1 if rest else 0) | (4 if unknowns == ALL else 0)
            fits.covariance[n, 0], fits.covariance[n, 1], fits.covariance[n, 2] = inverse[0, 0], inverse[0, 1], inverse[1, 1]
            if not rest or max(abs(p[0] - about[0]), abs(p[1] - about[1])) < 0.75:
                break
        fits.states[n] = state
