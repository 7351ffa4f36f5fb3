"""Kernels of corners: the blurred crossing of two edges, averaged over the pixel, and its weighted least-squares fit.

A chessboard's corner is the product of two steps, sgn(u) · sgn(v), with u and v the distances from its two lines. Blurred with a
Gaussian it is the expectation of that product over a pair of normal variables whose correlation is the cosine between the normals, so

    s(u, v) = 4 Φ₂(u/σ, v/σ; ρ) − 2 Φ(u/σ) − 2 Φ(v/σ) + 1,        Φ₂ = Φ(h)Φ(k) + 1/2π ∫₀^asin ρ exp(−(h² + k² − 2hk sin t) / 2cos²t) dt

(Z. Drezner, G. O. Wesolowsky, J. Stat. Comput. Simul. 35, 101 (1990)). The pixel's square is replaced by normal densities, which only
widen the blur: two an axis have its moments up to the fifth and, to 9 %, its sixth cumulant; three, for sharp edges, up to the seventh.
"""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.jit import jit
from pixmetry.locate.lines._profile_kernels import clipped, invert

NODE, REST = 240.0**-0.25, 1.0 / 12.0 - 240.0**-0.5  # for an aperture of 1 px: ±NODE, NODE⁴ = 1/240, NODE² + REST = 1/12
SHARP_NODE, SHARP_WEIGHT, SHARP_REST = 0.345832000, 0.318902969, 0.007051891  # ±NODE with this weight and 0 with what is left
SHARP_PX = 0.5  # blur, in pixels of aperture, below which three are taken
FAR = 5.0  # in standard deviations: beyond, a step is ±1 to 6e-7
LEAST_BLUR_PX = 0.05
SMALL_STEP = 1e-5  # squared length of a step in standard errors at which a fit is at rest
MOST_STEPS = 60
LEAST_SINE = 0.1  # of the angle between the edges
PLAIN, ALL = 7, 11  # number of unknowns: x, y, two angles, blur, mean, contrast; with planes in mean and contrast
NODES = np.array([0.2386191860831969, 0.6612093864662645, 0.9324695142031521])  # Gauss–Legendre, 6 points: Φ₂ to 2e-6 up to ρ = 0.9
WEIGHTS = np.array([0.4679139345726910, 0.3607615730481386, 0.1713244923791704])


@jit
def _crossing(h, k, rho, root):
    """E[sgn sgn] and its derivatives by h, k, ρ (the same as by h and k), hh, kk; root = √(1 − ρ²)."""
    if abs(h) > FAR and abs(k) > FAR:
        return math.copysign(1.0, h * k), 0.0, 0.0, 0.0, 0.0, 0.0
    if abs(k) > FAR:
        side, slope = math.copysign(1.0, k), 0.7978845608028654 * math.exp(-0.5 * h * h)
        return side * math.erf(h * 0.7071067811865476), side * slope, 0.0, 0.0, -h * side * slope, 0.0
    if abs(h) > FAR:
        side, slope = math.copysign(1.0, h), 0.7978845608028654 * math.exp(-0.5 * k * k)
        return side * math.erf(k * 0.7071067811865476), 0.0, side * slope, 0.0, 0.0, -k * side * slope
    value = math.erf(h * 0.7071067811865476) * math.erf(k * 0.7071067811865476)
    if abs(rho) > 1e-12:
        half, squares, product, total = 0.5 * math.asin(rho), 0.5 * (h * h + k * k), h * k, 0.0
        for i in range(3):
            for sign in (-1.0, 1.0):
                sine = math.sin(half * (1.0 + sign * NODES[i]))
                total += WEIGHTS[i] * math.exp((sine * product - squares) / (1.0 - sine * sine))
        value += 4.0 * half * total / (2.0 * math.pi)
    a, b = (k - rho * h) / root, (h - rho * k) / root
    edge_h, edge_k = 0.7978845608028654 * math.exp(-0.5 * h * h), 0.7978845608028654 * math.exp(-0.5 * k * k)
    by_h, by_k = edge_h * math.erf(a * 0.7071067811865476), edge_k * math.erf(b * 0.7071067811865476)
    both = edge_h * 0.7978845608028654 * math.exp(-0.5 * a * a) / root  # 4 φ₂
    return value, by_h, by_k, both, -h * by_h - rho * both, -k * by_k - rho * both


@jit
def pixel(x, y, p, unknowns, aperture, d):
    """Grey value of the pixel at (x, y) from the corner; its derivatives by the unknowns go into d."""
    c1, s1, c2, s2 = math.cos(p[2]), math.sin(p[2]), math.cos(p[3]), math.sin(p[3])
    rho, sine = math.cos(p[2] - p[3]), math.sin(p[2] - p[3])
    root = max(abs(sine), 1e-6)
    side, step, rest, outer = 2, 2.0 * NODE * aperture, REST, 0.5
    if p[4] < SHARP_PX * aperture:
        side, step, rest, outer = 3, SHARP_NODE * aperture, SHARP_REST, SHARP_WEIGHT
    variance = p[4] * p[4] + rest * aperture * aperture
    wide = math.sqrt(variance)
    contrast, cx, cy = p[6], p[9], p[10]
    for i in range(unknowns):
        d[i] = 0.0
    light = 0.0
    near = FAR * wide + step
    u, v = c1 * x + s1 * y, c2 * x + s2 * y
    if abs(u) > near and abs(v) > near and unknowns == PLAIN:
        d[5], d[6] = 1.0, math.copysign(1.0, u * v)
        return p[5] + contrast * d[6]
    for node in range(side * side):
        i, j = node // side, node % side
        weight = (1.0 - 2.0 * outer if side == 3 and i == 1 else outer) * (1.0 - 2.0 * outer if side == 3 and j == 1 else outer)
        px, py = x + (j - 0.5 * (side - 1)) * step, y + (i - 0.5 * (side - 1)) * step
        u, v = (c1 * px + s1 * py) / wide, (c2 * px + s2 * py) / wide
        s, su, sv, both, suu, svv = _crossing(u, v, rho, root)  # derivatives by u and v, the distances over the blur
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
    return value + light


@jit
def _solve(matrix, n, right, inverse, step):
    """Put matrix⁻¹ right into ``step`` and matrix⁻¹ into ``inverse``; False if the matrix is not positive definite."""
    if not invert(matrix, n, inverse):
        return False
    for i in range(n):
        total = 0.0
        for k in range(n):
            total += inverse[i, k] * right[k]
        step[i] = total
    return True


@jit
def normal_equations(values, xs, ys, count, p, unknowns, aperture, noise, kept, weights, matrix, right, d):
    """JᵀWJ and JᵀWr of the pixels of a window with the weights that belong to p, and χ² with them and with the ``kept`` ones.

    noise = constant, slope, pattern, black, low, high.
    """
    chi2, before = 0.0, 0.0
    matrix[:, :] = 0.0
    right[:] = 0.0
    for i in range(count):
        level = pixel(xs[i] - p[0], ys[i] - p[1], p, unknowns, aperture, d)
        mean, variance, slope = clipped(level, noise[0], noise[1], noise[2], noise[3], noise[4], noise[5])
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
    for a in range(unknowns):
        for b in range(a):
            matrix[b, a] = matrix[a, b]
    return chi2, before


@jit
def _start(values, xs, ys, count, p, profile, members):
    """Angles, mean and contrast of a window from the mean grey value against direction, which repeats after half a turn."""
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
def _descend(values, xs, ys, count, p, unknowns, aperture, noise, reach, inverse):
    """Levenberg–Marquardt from p, with weights that follow the model: χ² and whether it came to rest.

    A step is judged with the weights it starts from; then they are renewed. The inverse of JᵀWJ at the end goes into ``inverse``.
    """
    matrix, trial_matrix = np.zeros((ALL, ALL)), np.zeros((ALL, ALL))
    right, trial_right, step, trial, d = np.zeros(ALL), np.zeros(ALL), np.zeros(ALL), np.zeros(ALL), np.zeros(ALL)
    weights, trial_weights = np.zeros(count), np.zeros(count)
    damping, at_rest, x0, y0 = 1e-3, False, p[0], p[1]
    chi2, _ = normal_equations(values, xs, ys, count, p, unknowns, aperture, noise, weights, weights, matrix, right, d)
    for _turn in range(MOST_STEPS):
        for i in range(unknowns):
            matrix[i, i] *= 1.0 + damping
        solved = _solve(matrix, unknowns, right, inverse, step)
        length = 0.0
        for i in range(unknowns):
            matrix[i, i] /= 1.0 + damping
            length += step[i] * right[i]
        worse = not (solved and math.isfinite(length))
        if not worse:
            for i in range(ALL):
                trial[i] = p[i] + (step[i] if i < unknowns else 0.0)
            if length < SMALL_STEP and damping < 0.1:
                p[:] = trial
                at_rest = True
                break
            trial[4] = max(abs(trial[4]), LEAST_BLUR_PX)
            worse = abs(trial[0] - x0) > 0.7 * reach or abs(trial[1] - y0) > 0.7 * reach or trial[4] > 2.0 * reach
            worse = worse or abs(math.sin(trial[2] - trial[3])) < LEAST_SINE
        if not worse:
            new, before = normal_equations(
                values, xs, ys, count, trial, unknowns, aperture, noise, weights, trial_weights, trial_matrix, trial_right, d
            )
            worse = not before <= chi2 * (1.0 + 1e-9)
        if worse:
            damping = max(10.0 * damping, 1e-3)
            if damping > 1e8:
                break
            continue
        chi2 = new
        p[:] = trial
        weights[:] = trial_weights
        matrix[:, :] = trial_matrix
        right[:] = trial_right
        damping = 0.1 * damping if damping > 1e-7 else 0.0
    solved = invert(matrix, unknowns, inverse)
    return chi2, at_rest and solved


@jit
def _promised_fall(values, xs, ys, count, p, aperture, noise):
    """Fall of χ² that one step with all unknowns promises from p."""
    matrix, right, step, d, weights = np.zeros((ALL, ALL)), np.zeros(ALL), np.zeros(ALL), np.zeros(ALL), np.zeros(count)
    normal_equations(values, xs, ys, count, p, ALL, aperture, noise, weights, weights, matrix, right, d)
    if not _solve(matrix, ALL, right, np.empty((ALL, ALL)), step):
        return math.inf
    return float((step * right).sum())


@jit
def fit_corners(frame, x, y, reach, planes, aperture, noise, start, stop, found, covariance, chi2, counts, states):
    """Fit corners start … stop; planes: 0 never, 1 always, 2 where χ² falls by more than ``noise[6]``.

    found (n, 11), covariance (n, 3) of x, xy, y; states: bit 1 at rest, bit 2 window cut, bit 4 planes used, bit 8 at the top, 16 at the
    bottom of the scale.
    """
    height, width = frame.shape
    profile, members = np.zeros(48), np.zeros(48)
    inverse = np.zeros((ALL, ALL))
    plain, plain_inverse = np.zeros(ALL), np.zeros((ALL, ALL))
    for n in range(start, stop):
        r = reach[n]
        room = int(2 * math.ceil(r) + 1) ** 2
        values, xs, ys = np.empty(room), np.empty(room), np.empty(room)
        p = found[n]
        p[0], p[1] = x[n], y[n]
        for turn in range(3):
            column, row = p[0], p[1]
            count, state = 0, 0
            for i in range(int(math.ceil(row - r)), int(math.floor(row + r)) + 1):
                for j in range(int(math.ceil(column - r)), int(math.floor(column + r)) + 1):
                    if (i - row) ** 2 + (j - column) ** 2 > r * r:
                        continue
                    if not (0 <= i < height and 0 <= j < width):
                        state |= 2
                        continue
                    values[count], xs[count], ys[count] = frame[i, j], j, i
                    state |= 8 if values[count] >= noise[5] else 0
                    state |= 16 if values[count] <= noise[4] else 0
                    count += 1
            if count < 4 * ALL:
                break
            if turn == 0:
                p[4] = min(0.8, 0.2 * r)
                _start(values, xs, ys, count, p, profile, members)
            unknowns = PLAIN
            p[PLAIN:] = 0.0
            value, rest = _descend(values, xs, ys, count, p, PLAIN, aperture, noise, r, inverse)
            tempting = planes == 1 or planes == 2 and 2.0 * _promised_fall(values, xs, ys, count, p, aperture, noise) > noise[6]
            if planes > 0 and rest and tempting:
                plain[:] = p
                plain_inverse[:, :] = inverse
                fuller, rested = _descend(values, xs, ys, count, p, ALL, aperture, noise, r, inverse)
                scatter = max(fuller / max(count - ALL, 1), 1.0)  # a model that fits badly makes every unknown look useful
                if planes == 1 or (rested and value - fuller > noise[6] * scatter):
                    value, rest, unknowns = fuller, rested, ALL
                else:
                    p[:] = plain
                    inverse[:, :] = plain_inverse
            counts[n] = count - unknowns
            chi2[n] = value
            state |= (1 if rest else 0) | (4 if unknowns == ALL else 0)
            covariance[n, 0], covariance[n, 1], covariance[n, 2] = inverse[0, 0], inverse[0, 1], inverse[1, 1]
            if not rest or max(abs(p[0] - column), abs(p[1] - row)) < 0.75:
                break
        states[n] = state
