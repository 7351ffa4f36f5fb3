"""Kernels of moments of grey values: local background, window that follows the target, and the sums that position and variance need."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.arrays import Array, Flags, Ints
from pixmetry.core.jit import jit
from pixmetry.locate._noise_kernels import Noise, variance_at

CENTROID, SQUARED, SOFT, HARD, WINDOWED = 0, 1, 2, 3, 4
# columns of a target's record: rough centre, half axes and angle, reach of its light, margins of window and annulus, sign, threshold in DN,
# standard deviation of the Gaussian window, the plane of the background (level at the centre, slopes) with its covariance, and what the
# noise that passes a threshold adds to first order, (Σ (x − x̂)² (Var f − f'² σ²)) / σ² in px²; the height over the background
X, Y, MAJOR, MINOR, ANGLE, REACH, MARGIN, INNER, OUTER, SIGN, THRESHOLD, SPREAD, LEVEL, SLOPE_X, SLOPE_Y = range(15)
C00, C01, C02, C11, C12, C22 = range(15, 21)
EXCESS, AMPLITUDE = 21, 22
COLUMNS = 23
SHARP_PX = 0.6  # blur, pixel included, below which the pixel's square shape matters
SUMS = {"reassoc", "contract", "nsz"}  # sums may be taken in any order, so that they fill the vector registers


class Response(NamedTuple):
    """What a law makes of the grey values of one round target."""

    law: int
    threshold: float  # DN above the background
    amplitude: float  # height over the background, DN, above 0
    sign: float  # 1 bright, −1 dark
    level: float  # of the background, DN
    noise: Noise
    spread: float  # standard deviation of the Gaussian window, px


class Tables(NamedTuple):
    """What integrals over a round target, and over the phase within the pixel, have in common."""

    nodes: Array  # of a quadrature over −1 … 1, shape (q,)
    weights: Array
    step: float  # from radius to radius of a profile, px
    shells: Array  # moduli of the pixel lattice's frequencies, shape (m,), 1/px
    many: Array  # how many frequencies have each
    bessel2: Array  # J₂(2π · shell · radius), shape (m, radii)
    neumann2: Array  # Y₂ of the same


@jit(inline="always")
def quadratic_form(major: float, minor: float, angle: float) -> tuple[float, float, float]:
    """Return p, q, r of the ellipse p x² + 2 q x y + r y² = 1."""
    c, s = math.cos(angle), math.sin(angle)
    a, b = 1.0 / (major * major), 1.0 / (minor * minor)
    return c * c * a + s * s * b, c * s * (a - b), s * s * a + c * c * b


@jit(inline="always")
def chord(p: float, q: float, r: float, dy: float) -> tuple[float, float]:
    """Return middle and half length of the ellipse's chord at height dy; half is −1 where there is none."""
    root = q * q * dy * dy - p * (r * dy * dy - 1.0)
    if root <= 0.0:
        return 0.0, -1.0
    return -q * dy / p, math.sqrt(root) / p


@jit
def limit_margins(record: Array, start: Ints, index: Ints) -> Array:
    """Return how far a window may reach beyond each half-height edge: a little less than halfway to that of the nearest neighbour."""
    n = record.shape[0]
    free = np.full(n, np.inf)
    for i in range(n):
        for k in range(start[i], start[i + 1]):
            j = index[k]
            dx, dy = record[j, X] - record[i, X], record[j, Y] - record[i, Y]
            apart = math.sqrt(dx * dx + dy * dy)
            if apart > 0.0:
                p, q, r = quadratic_form(record[i, MAJOR], record[i, MINOR], record[i, ANGLE])
                own = apart / math.sqrt(p * dx * dx + 2 * q * dx * dy + r * dy * dy)
                p, q, r = quadratic_form(record[j, MAJOR], record[j, MINOR], record[j, ANGLE])
                other = apart / math.sqrt(p * dx * dx + 2 * q * dx * dy + r * dy * dy)
                free[i] = min(free[i], 0.42 * (apart - own - other))
    return free


@jit
def list_holes(record: Array, i: int, start: Ints, index: Ints, holes: Array) -> int:
    """Write the ellipses that are not background around target i: its own light and its neighbours'; return how many."""
    holes[0, 0], holes[0, 1] = record[i, X], record[i, Y]
    reach = record[i, INNER]
    holes[0, 2], holes[0, 3], holes[0, 4] = quadratic_form(record[i, MAJOR] + reach, record[i, MINOR] + reach, record[i, ANGLE])
    count = 1
    for k in range(start[i], start[i + 1]):
        j = index[k]
        dx, dy, reach = record[j, X] - record[i, X], record[j, Y] - record[i, Y], record[j, REACH]
        near = record[i, MAJOR] + record[i, OUTER] + record[j, MAJOR] + reach
        if dx * dx + dy * dy < near * near and count < holes.shape[0]:
            holes[count, 0], holes[count, 1] = record[j, X], record[j, Y]
            p, q, r = quadratic_form(record[j, MAJOR] + reach, record[j, MINOR] + reach, record[j, ANGLE])
            holes[count, 2], holes[count, 3], holes[count, 4] = p, q, r
            count += 1
    return count


@jit
def cut_row(row: int, holes: Array, count: int, cuts: Ints) -> int:
    """Write the first and last column of each hole in a row, by their first; return how many there are."""
    found = 0
    for h in range(count):
        middle, half = chord(holes[h, 2], holes[h, 3], holes[h, 4], row - holes[h, 1])
        if half < 0.0:
            continue
        first, last = int(math.ceil(holes[h, 0] + middle - half)), int(math.floor(holes[h, 0] + middle + half))
        at = found
        while at > 0 and cuts[at - 1, 0] > first:
            cuts[at, 0], cuts[at, 1] = cuts[at - 1, 0], cuts[at - 1, 1]
            at -= 1
        cuts[at, 0], cuts[at, 1] = first, last
        found += 1
    return found


@jit(fastmath=SUMS)
def fit_ground(
    frame: np.ndarray, record: Array, i: int, holes: Array, count: int, cuts: Ints, noise: Noise, clip: float
) -> tuple[float, float]:
    """Fit a plane to the pixels about target i that are in none of the holes; write level, slopes and covariance into the record.

    Residuals are taken from the record's plane. With ``clip`` > 0 only those within that many standard deviations count.
    Return the number of pixels and their χ² per degree of freedom.
    """
    x0, y0 = record[i, X], record[i, Y]
    reach = record[i, OUTER]
    po, qo, ro = quadratic_form(record[i, MAJOR] + reach, record[i, MINOR] + reach, record[i, ANGLE])
    level, gx, gy = record[i, LEVEL], record[i, SLOPE_X], record[i, SLOPE_Y]
    variance = max(variance_at(level, noise), 1e-12)
    widest = clip * math.sqrt(variance) if clip > 0.0 else 1e300
    height = math.sqrt(max(po / (po * ro - qo * qo), 0.0))
    first, stop = max(int(math.ceil(y0 - height)), 0), min(int(math.floor(y0 + height)) + 1, frame.shape[0])
    n, su, sv, suu, suv, svv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    sd, sdu, sdv, sdd = 0.0, 0.0, 0.0, 0.0
    for row in range(first, stop):
        v = row - y0
        middle, half = chord(po, qo, ro, v)
        if half < 0.0:
            continue
        at, right = max(int(math.ceil(x0 + middle - half)), 0), min(int(math.floor(x0 + middle + half)), frame.shape[1] - 1)
        base = level + gy * v - gx * x0
        found = cut_row(row, holes, count, cuts)
        rn, ru, ruu, rd, rdu, rdd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for part in range(found + 1):
            end = right if part == found else min(cuts[part, 0] - 1, right)
            if clip <= 0.0 and end >= at:  # all count, and the sums without data are known
                many = float(end - at + 1)
                centre = 0.5 * (at + end) - x0
                rn += many
                ru += many * centre
                ruu += many * centre * centre + many * (many * many - 1.0) / 12.0
                for col in range(at, end + 1):
                    u = col - x0
                    d = frame[row, col] - base - gx * col
                    rd += d
                    rdu += d * u
                    rdd += d * d
                end = at - 1
            for col in range(at, end + 1):
                u = col - x0
                d = frame[row, col] - base - gx * col
                keep = 1.0 if abs(d) <= widest else 0.0
                rn += keep
                ru += keep * u
                ruu += keep * u * u
                d *= keep
                rd += d
                rdu += d * u
                rdd += d * d
            if part < found:
                at = max(at, cuts[part, 1] + 1)
        n += rn
        su += ru
        suu += ruu
        sv += rn * v
        svv += rn * v * v
        suv += ru * v
        sd += rd
        sdu += rdu
        sdv += rd * v
        sdd += rdd
    # one pseudo-pixel of the map's plane, sure to ten times the noise (and to a tenth of that per pixel), keeps the matrix regular
    m00, m11, m22 = n + 0.01, suu + 1.0, svv + 1.0
    k00, k01, k02 = m11 * m22 - suv * suv, suv * sv - su * m22, su * suv - m11 * sv
    det = m00 * k00 + su * k01 + sv * k02
    k11, k12, k22 = m00 * m22 - sv * sv, su * sv - m00 * suv, m00 * m11 - su * su
    d0 = (k00 * sd + k01 * sdu + k02 * sdv) / det
    d1 = (k01 * sd + k11 * sdu + k12 * sdv) / det
    d2 = (k02 * sd + k12 * sdu + k22 * sdv) / det
    chi2 = max(sdd - d0 * sd - d1 * sdu - d2 * sdv, 0.0) / variance / max(n - 3.0, 1.0)
    record[i, LEVEL], record[i, SLOPE_X], record[i, SLOPE_Y] = level + d0, gx + d1, gy + d2
    factor = variance * max(1.0, chi2 if n > 20.0 else 1.0) / det
    record[i, C00], record[i, C01], record[i, C02] = k00 * factor, k01 * factor, k02 * factor
    record[i, C11], record[i, C12], record[i, C22] = k11 * factor, k12 * factor, k22 * factor
    return n, chi2


@jit
def fit_grounds(frame: np.ndarray, record: Array, first: int, stop: int, start: Ints, index: Ints, noise: Noise) -> None:
    """Fit the background of targets first … stop; once more without outliers where the residuals are larger than the noise."""
    holes, cuts = np.empty((64, 5)), np.empty((64, 2), np.int64)
    for i in range(first, stop):
        level, gx, gy = record[i, LEVEL], record[i, SLOPE_X], record[i, SLOPE_Y]
        count = list_holes(record, i, start, index, holes)
        n, chi2 = fit_ground(frame, record, i, holes, count, cuts, noise, 0.0)
        if chi2 > 1.0 + 5.0 * math.sqrt(2.0 / max(n, 1.0)):
            if n < 20.0:
                record[i, LEVEL], record[i, SLOPE_X], record[i, SLOPE_Y] = level, gx, gy
            fit_ground(frame, record, i, holes, count, cuts, noise, 4.0)
            fit_ground(frame, record, i, holes, count, cuts, noise, 4.0)


@jit(inline="always")
def weigh(value: float, level: float, law: int, threshold: float, sign: float, noise: Noise) -> tuple[float, float, float]:
    """Return f, f' and the variance of f of one pixel."""
    v = variance_at(level, noise)
    if law == SQUARED:
        # E[I²] = s² + v and Var[I²] = 4 s² v + 2 v² = 4 E[I²] v − 2 v²
        slope = 2.0 * value - sign * (noise.slope_dn + 2.0 * noise.pattern_rel * noise.pattern_rel * (level - noise.black_dn))
        return value * value - v, slope, slope * slope * v - 2.0 * v * v
    if law == SOFT:
        above = 1.0 if value > threshold else 0.0
        return above * (value - threshold), above, above * v
    if law == HARD:
        above = 1.0 if value > threshold else 0.0
        return above * value, above, above * v
    return value, 1.0, v


@jit(fastmath=SUMS)
def window_sums(frame: np.ndarray, record: Array, i: int, law: int, cx: float, cy: float, noise: Noise, out: Array) -> None:
    """Sums over an elliptic window about (cx, cy), its edge pixels counted by the part of their width that lies inside.

    ``out``: Σf, Σfx, Σfy | Σf', Σf'x, Σf'y, Σf'xx, Σf'xy, Σf'yy | the same six of w² Var f; x and y from (cx, cy).
    """
    margin, sign, threshold = record[i, MARGIN], record[i, SIGN], record[i, THRESHOLD]
    p, q, r = quadratic_form(record[i, MAJOR] + margin, record[i, MINOR] + margin, record[i, ANGLE])
    height = math.sqrt(max(p / (p * r - q * q), 0.0))
    first, stop = max(int(math.ceil(cy - height)), 0), min(int(math.floor(cy + height)) + 1, frame.shape[0])
    gx = record[i, SLOPE_X]
    out[:] = 0.0
    for row in range(first, stop):
        dy = row - cy
        middle, half = chord(p, q, r, dy)
        if half <= 0.0:
            continue
        low, high = cx + middle - half, cx + middle + half
        left, right = max(int(math.floor(low + 0.5)), 0), min(int(math.ceil(high - 0.5)), frame.shape[1] - 1)
        base = record[i, LEVEL] + record[i, SLOPE_Y] * (row - record[i, Y]) - gx * record[i, X]
        f0, f1, d0, d1, d2, v0, v1, v2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for col in range(left + 1, right):
            level = np.float64(frame[row, col])
            f, d, v = weigh(sign * (level - base - gx * col), level, law, threshold, sign, noise)
            x = col - cx
            f0 += f
            f1 += f * x
            d0 += d
            d1 += d * x
            d2 += d * x * x
            v0 += v
            v1 += v * x
            v2 += v * x * x
        for side in range(2):
            col = left if side == 0 else right
            if side == 1 and right <= left:
                break
            w = min(min(high, col + 0.5) - max(low, col - 0.5), 1.0)
            if w <= 0.0:
                continue
            level = np.float64(frame[row, col])
            f, d, v = weigh(sign * (level - base - gx * col), level, law, threshold, sign, noise)
            x = col - cx
            f0 += w * f
            f1 += w * f * x
            d0 += w * d
            d1 += w * d * x
            d2 += w * d * x * x
            v0 += w * w * v
            v1 += w * w * v * x
            v2 += w * w * v * x * x
        out[0] += f0
        out[1] += f1
        out[2] += f0 * dy
        out[3] += d0
        out[4] += d1
        out[5] += d0 * dy
        out[6] += d2
        out[7] += d1 * dy
        out[8] += d0 * dy * dy
        out[9] += v0
        out[10] += v1
        out[11] += v0 * dy
        out[12] += v2
        out[13] += v1 * dy
        out[14] += v0 * dy * dy


@jit
def ground_variance(record: Array, i: int, ax: Array, ay: Array, result: Array) -> None:
    """Add the variance from the background's plane, with the position's slopes by level and the two inclinations, to a covariance."""
    c00, c01, c02 = record[i, C00], record[i, C01], record[i, C02]
    c11, c12, c22 = record[i, C11], record[i, C12], record[i, C22]
    for k in range(3):
        left, right = (ax if k < 2 else ay), (ax if k == 0 else ay)
        total = left[0] * right[0] * c00 + left[1] * right[1] * c11 + left[2] * right[2] * c22
        total += (left[0] * right[1] + left[1] * right[0]) * c01 + (left[0] * right[2] + left[2] * right[0]) * c02
        total += (left[1] * right[2] + left[2] * right[1]) * c12
        result[2 + k] += total


@jit
def moment_of(frame: np.ndarray, record: Array, i: int, law: int, noise: Noise, sums: Array, result: Array) -> bool:
    """Position and covariance of one target by Σ f x / Σ f, the window following the estimate; return whether it came to rest.

    ``result``: x, y, var x, cov, var y, relative standard deviation of Σ f.
    """
    cx, cy = record[i, X], record[i, Y]
    furthest = record[i, MINOR] + record[i, MARGIN]
    at_rest = False
    result[:] = np.nan
    for turn in range(16):
        window_sums(frame, record, i, law, cx, cy, noise, sums)
        if not sums[0] > 0.0:
            return False
        mx, my = sums[1] / sums[0], sums[2] / sums[0]
        if abs(cx + mx - record[i, X]) + abs(cy + my - record[i, Y]) > furthest:
            return False
        # pixels that enter and leave the window with their noise let the estimate tremble by a small part of its uncertainty
        if abs(mx) + abs(my) < 1e-3 or (abs(mx) + abs(my)) * sums[0] < 0.05 * math.sqrt(sums[12] + sums[14]):
            at_rest = True
            break
        if turn < 15:
            step = 1.0 if turn < 4 else 0.5
            cx, cy = cx + step * mx, cy + step * my
    # a centroid of a window that lies off by less than the noise is still one
    at_rest = at_rest or (abs(mx) + abs(my)) * sums[0] < math.sqrt(sums[12] + sums[14])
    total = sums[0]
    result[0], result[1] = cx + mx, cy + my
    result[2] = (sums[12] - 2 * mx * sums[10] + mx * mx * sums[9]) / total**2
    result[3] = (sums[13] - mx * sums[11] - my * sums[10] + mx * my * sums[9]) / total**2
    result[4] = (sums[14] - 2 * my * sums[11] + my * my * sums[9]) / total**2
    excess = record[i, EXCESS] * variance_at(record[i, LEVEL], noise) / total**2
    result[2] = max(result[2] + excess, 0.5 * result[2])
    result[4] = max(result[4] + excess, 0.5 * result[4])
    result[5] = math.sqrt(max(sums[9], 0.0)) / total
    # a level e of the background adds −Σ f' (x − x̂) e / Σ f, a slope g −Σ f' (x − x̂)(x − x0) g / Σ f
    ux, uy = cx - record[i, X], cy - record[i, Y]
    d0, d1, d2, dxx, dxy, dyy = sums[3], sums[4], sums[5], sums[6], sums[7], sums[8]
    lx, ly = (d1 - mx * d0) / total, (d2 - my * d0) / total
    ax = np.array([lx, (dxx - mx * d1) / total + ux * lx, (dxy - mx * d2) / total + uy * lx])
    ay = np.array([ly, (dxy - my * d1) / total + ux * ly, (dyy - my * d2) / total + uy * ly])
    ground_variance(record, i, ax, ay, result)
    return at_rest


@jit
def windowed_of(frame: np.ndarray, record: Array, i: int, noise: Noise, weights: Array, result: Array) -> bool:
    """Position and covariance of one target by the iterated Gaussian window Σ w(x − x̂) I (x − x̂) = 0; return whether it came to rest."""
    spread, sign = record[i, SPREAD], record[i, SIGN]
    reach = record[i, MAJOR] + record[i, MARGIN]
    furthest = record[i, MINOR] + record[i, MARGIN]
    reach = min(reach, 4.0 * spread)
    cx, cy = record[i, X], record[i, Y]
    gx = record[i, SLOPE_X]
    result[:] = np.nan
    at_rest = False
    for _ in range(20):
        first, stop = max(int(math.ceil(cy - reach)), 0), min(int(math.floor(cy + reach)) + 1, frame.shape[0])
        left, right = max(int(math.ceil(cx - reach)), 0), min(int(math.floor(cx + reach)) + 1, frame.shape[1])
        for col in range(left, right):
            weights[col - left] = math.exp(-0.5 * ((col - cx) / spread) ** 2)
        s0, s1, s2, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        w0, w1, w2, wxx, wxy, wyy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        n0, nxx, nxy, nyy = 0.0, 0.0, 0.0, 0.0
        for row in range(first, stop):
            dy = row - cy
            down = math.exp(-0.5 * (dy / spread) ** 2)
            half = math.sqrt(max(reach * reach - dy * dy, 0.0))
            base = record[i, LEVEL] + record[i, SLOPE_Y] * (row - record[i, Y]) - gx * record[i, X]
            r0, r1, r2, u0, u1, u2, v0, v1, v2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for col in range(max(left, int(math.ceil(cx - half))), min(right, int(math.floor(cx + half)) + 1)):
                x = col - cx
                w = weights[col - left] * down
                level = np.float64(frame[row, col])
                f = w * sign * (level - base - gx * col)
                v = w * w * variance_at(level, noise)
                r0 += f
                r1 += f * x
                r2 += f * x * x
                u0 += w
                u1 += w * x
                u2 += w * x * x
                v0 += v
                v1 += v * x
                v2 += v * x * x
            s0 += r0
            s1 += r1
            s2 += r0 * dy
            sxx += r2
            sxy += r1 * dy
            syy += r0 * dy * dy
            w0 += u0
            w1 += u1
            w2 += u0 * dy
            wxx += u2
            wxy += u1 * dy
            wyy += u0 * dy * dy
            n0 += v0
            nxx += v2
            nxy += v1 * dy
            nyy += v0 * dy * dy
        # minus the derivative of Σ w I (x − c) by c
        jxx, jxy, jyy = s0 - sxx / spread**2, -sxy / spread**2, s0 - syy / spread**2
        det = jxx * jyy - jxy * jxy
        if not (s0 > 0.0 and jxx > 0.0 and det > 0.0):
            return False
        mx, my = (jyy * s1 - jxy * s2) / det, (jxx * s2 - jxy * s1) / det
        cx, cy = cx + mx, cy + my
        if abs(cx - record[i, X]) + abs(cy - record[i, Y]) > furthest:
            return False
        if abs(mx) + abs(my) < 2e-4 or (abs(mx) + abs(my)) * min(jxx, jyy) < 0.02 * math.sqrt(nxx + nyy):
            at_rest = True
            break
    at_rest = at_rest or (abs(mx) + abs(my)) * min(jxx, jyy) < math.sqrt(nxx + nyy)
    ixx, ixy, iyy = jyy / det, -jxy / det, jxx / det
    result[0], result[1] = cx, cy
    result[2] = ixx * ixx * nxx + 2 * ixx * ixy * nxy + ixy * ixy * nyy
    result[3] = ixx * ixy * nxx + (ixx * iyy + ixy * ixy) * nxy + ixy * iyy * nyy
    result[4] = ixy * ixy * nxx + 2 * ixy * iyy * nxy + iyy * iyy * nyy
    result[5] = math.sqrt(n0) / s0
    ux, uy = cx - record[i, X], cy - record[i, Y]
    bx = np.array([w1, wxx + ux * w1, wxy + uy * w1])
    by = np.array([w2, wxy + ux * w2, wyy + uy * w2])
    ground_variance(record, i, ixx * bx + ixy * by, ixy * bx + iyy * by, result)
    return at_rest


@jit
def moments(frame: np.ndarray, record: Array, first: int, stop: int, law: int, noise: Noise, result: Array, at_rest: Flags) -> None:
    """Positions of targets first … stop; `result` (n, 6), `at_rest` (n,)."""
    sums = np.empty(15)
    widest = 0.0
    for i in range(first, stop):
        widest = max(widest, record[i, MAJOR] + record[i, MARGIN])
    weights = np.empty(2 * int(widest + 2) + 3)
    for i in range(first, stop):
        if law == WINDOWED:
            at_rest[i] = windowed_of(frame, record, i, noise, weights, result[i])
        else:
            at_rest[i] = moment_of(frame, record, i, law, noise, sums, result[i])


@jit(inline="always")
def scaled_bessel(x: float) -> float:
    """I0(x) e^−x: Abramowitz & Stegun 9.8.1 and 9.8.2, relative error below 2e-7."""
    if x < 3.75:
        t = (x / 3.75) ** 2
        series = 1.0 + t * (3.5156229 + t * (3.0899424 + t * (1.2067492 + t * (0.2659732 + t * (0.0360768 + t * 0.0045813)))))
        return series * math.exp(-x)
    t = 3.75 / x
    tail = 0.00916281 + t * (-0.02057706 + t * (0.02635537 + t * (-0.01647633 + t * 0.00392377)))
    return (0.39894228 + t * (0.01328592 + t * (0.00225319 + t * (-0.00157565 + t * tail)))) / math.sqrt(x)


@jit
def disc_profile(radius: float, blur: float, nodes: Array, weights: Array, step: float, profile: Array) -> None:
    """Write a disc blurred by a Gaussian at the radii (j + ½)·step: ∫ (r'/s²) exp(−(r − r')²/2s²) I0e(r r'/s²) dr' from 0 to R."""
    for j in range(profile.shape[0]):
        r = (j + 0.5) * step
        low, high = max(0.0, r - 6.0 * blur), min(radius, r + 6.0 * blur)
        if high <= low:
            profile[j] = 0.0
            continue
        if r + 6.0 * blur <= radius:
            profile[j] = 1.0
            continue
        total = 0.0
        for k in range(nodes.shape[0]):
            at = 0.5 * (low + high) + 0.5 * (high - low) * nodes[k]
            total += weights[k] * at * math.exp(-0.5 * ((r - at) / blur) ** 2) * scaled_bessel(r * at / blur**2)
        profile[j] = total * 0.5 * (high - low) / blur**2


@jit
def best_thresholds(shape: Array, first: int, stop: int, law: int, multiples: Array, noise: Noise, tables: Tables, out: Array) -> None:
    """Choose for classes first … stop of targets the threshold with the least variance from noise and sub-pixel phase together.

    ``shape`` (classes, 7): radius, blur, amplitude, sign, background, window, spread of the Gaussian window. ``multiples``: thresholds in
    standard deviations of the background's noise. ``out`` (classes, 3): the best of them, its variance over the phase in px², and the
    excess of its noise over that of first order as in the record.
    """
    for i in range(first, stop):
        amplitude, sign, level = shape[i, 2], shape[i, 3], shape[i, 4]
        n = min(max(int(shape[i, 5] / tables.step), 8), tables.bessel2.shape[1])
        profile = np.empty(n)
        disc_profile(shape[i, 0], shape[i, 1], tables.nodes, tables.weights, tables.step, profile)
        top = profile[0]
        for j in range(n):
            profile[j] /= top
        deviation = math.sqrt(max(variance_at(level, noise), 1e-12))
        least = np.inf
        for m in range(multiples.shape[0]):
            threshold = multiples[m] * deviation
            if m > 0 and threshold > 0.5 * amplitude:
                break
            response = Response(law, threshold, amplitude, sign, level, noise, shape[i, 6])
            phase, excess, random = phase_and_noise(profile, response, tables)
            if phase + random < least:
                least = phase + random
                out[i, 0], out[i, 1], out[i, 2] = multiples[m], phase, excess / deviation**2
        if shape[i, 1] < SHARP_PX:
            # the square pixel counts: the phases of a radius and of one a quarter of a pixel larger, where S-curves of one cycle swing over
            pair = 0.0
            best = Response(law, out[i, 0] * deviation, amplitude, sign, level, noise, shape[i, 6])
            for size in range(2):
                pair += square_pixel_variance(shape[i, 0] + 0.25 * size, shape[i, 1], best, shape[i, 5], tables)
            out[i, 1] = pair
        if law in (SQUARED, WINDOWED):
            out[i, 1] *= 0.5  # the mean over radii; a threshold's depends on the outline so finely that the most is taken


@jit
def phase_and_noise(profile: Array, response: Response, tables: Tables) -> tuple[float, float, float]:
    """Return the variance over the sub-pixel phase, the noise sum Σ (x − x̂)² (Var f − f'² σ²), and the noise variance of a round target.

    With h(r) the mean of f at a radius, noise included, Poisson's sum gives an error of 2 S(q) sin(2π k·c) k/|k| / ∫h for each pair ±k of
    the lattice's frequencies, q = |k|, S(q) = ∫ x h sin(2πqx) = −(1/q) ∫ h'(r) r² J2(2πqr) dr. S swings with the radius like a cosine; the
    modulus of J2 + iY2 in its place is the most that it can be near this radius. The pixel counts as a part of a Gaussian blur.
    """
    law, threshold, amplitude, sign, level, noise, spread = response
    step, shells, many, bessel2, neumann2 = tables.step, tables.shells, tables.many, tables.bessel2, tables.neumann2
    n = profile.shape[0]
    mean = np.empty(n)
    total, exact, linear, pull = 0.0, 0.0, 0.0, 0.0
    for j in range(n):
        r = (j + 0.5) * step
        ring = r * step
        value = amplitude * profile[j]
        if law in (SOFT, HARD):
            v = max(variance_at(level + sign * value, noise), 1e-12)
            s = math.sqrt(v)
            z = (value - threshold) / s
            if z > 8.0:
                share, density = 1.0, 0.0
            elif z < -8.0:
                share, density = 0.0, 0.0
            else:
                share, density = 0.5 * math.erfc(-z * 0.7071067811865476), 0.3989422804014327 * math.exp(-0.5 * z * z)
            h = s * (z * share + density)
            second = v * ((1.0 + z * z) * share + z * density)
            if law == HARD:
                second += 2.0 * threshold * h + threshold * threshold * share
                h += threshold * share
            exact += (second - h * h) * r * r * ring
            linear += share * v * r * r * ring
        elif law == SQUARED:
            h = value * value
        else:
            h = value * math.exp(-0.5 * (r / spread) ** 2)
            pull += h * r * r / (2.0 * spread * spread) * ring
        mean[j] = h
        total += h * ring
    variance = 0.0
    for k in range(shells.shape[0]):
        re, im = 0.0, 0.0
        for j in range(n - 1):
            drop = (mean[j + 1] - mean[j]) * ((j + 1.0) * step) ** 2
            re += drop * bessel2[k, j]
            im += drop * neumann2[k, j]
        # the sum over k of ½ (k_x/|k|)² over the half plane is ⅛ of the number of frequencies at this distance
        variance += 0.125 * many[k] * (re * re + im * im) / (math.pi * shells[k] * max(total - pull, 1e-300)) ** 2
    random = exact / (4.0 * math.pi * total * total) if total > 0.0 else np.inf
    return variance, math.pi * (exact - linear), random


@jit(inline="always")
def mean_response(value: float, radius2: float, response: Response) -> float:
    """Mean of f over the noise at a mean grey value; for the Gaussian window times its weight."""
    law, threshold = response.law, response.threshold
    if law == SQUARED:
        return value * value
    if law == WINDOWED:
        return value * math.exp(-0.5 * radius2 / (response.spread * response.spread))
    s = math.sqrt(max(variance_at(response.level + response.sign * value, response.noise), 1e-12))
    z = (value - threshold) / s
    if z > 8.0:
        share, density = 1.0, 0.0
    elif z < -8.0:
        return 0.0
    else:
        share, density = 0.5 * math.erfc(-z * 0.7071067811865476), 0.3989422804014327 * math.exp(-0.5 * z * z)
    h = s * (z * share + density)
    return h + threshold * share if law == HARD else h


@jit
def square_pixel_variance(radius: float, blur: float, response: Response, window: float, tables: Tables) -> float:
    """Variance over the phase along x of a disc averaged over square pixels: S(k) = ∬ x h sin(2πk x) cos(2πl y) on a grid of eighths."""
    law, amplitude, spread, step = response.law, response.amplitude, response.spread, tables.step
    optical = math.sqrt(max(blur * blur - 1.0 / 12.0, 0.01))
    n = int(window / step) + 1
    wide = n + 4
    profile = np.empty(int(1.5 * wide) + 2)
    disc_profile(radius, optical, tables.nodes, tables.weights, step, profile)
    sharp, flat = np.empty((wide, wide)), np.empty((wide, n))
    for a in range(wide):
        for b in range(wide):
            place = math.sqrt(float(a * a + b * b)) - 0.5
            j = int(max(place, 0.0))
            part = max(place, 0.0) - j
            sharp[a, b] = profile[j] + part * (profile[j + 1] - profile[j])
    for a in range(wide):
        for b in range(n):
            total = 0.5 * (sharp[a, abs(b - 4)] + sharp[a, b + 4])
            for m in range(-3, 4):
                total += sharp[a, abs(b + m)]
            flat[a, b] = 0.125 * total
    top = 0.0
    area, sums = 0.0, np.zeros((3, 4))
    waves = np.empty((4, 8, 2))
    for k in range(4):
        for j in range(8):
            waves[k, j, 0], waves[k, j, 1] = math.sin(0.25 * math.pi * k * j), math.cos(0.25 * math.pi * k * j)
    for a in range(n):
        r1, r2, r3, line = 0.0, 0.0, 0.0, 0.0
        for b in range(n):
            value = 0.5 * (flat[abs(a - 4), b] + flat[a + 4, b])
            for m in range(-3, 4):
                value += flat[abs(a + m), b]
            value *= 0.125
            if a == 0 and b == 0:
                top = value
            radius2 = float(a * a + b * b) * step * step
            if radius2 > window * window:
                break
            h = mean_response(amplitude * value / top, radius2, response)
            times = 1.0 if b == 0 else 2.0
            line += times * h * (1.0 - radius2 / (2.0 * spread * spread) if law == WINDOWED else 1.0)
            x = 2.0 * b * step * h
            r1 += x * waves[1, b % 8, 0]
            r2 += x * waves[2, b % 8, 0]
            r3 += x * waves[3, b % 8, 0]
        times = 1.0 if a == 0 else 2.0
        area += times * line
        for ky in range(4):
            w = times * waves[ky, a % 8, 1]
            sums[0, ky] += w * r1
            sums[1, ky] += w * r2
            sums[2, ky] += w * r3
    variance = 0.0
    for kx in range(3):
        for ky in range(4):
            variance += (0.5 if ky == 0 else 1.0) * (2.0 * sums[kx, ky] / area) ** 2
    return variance


@jit
def locate_windows(
    windows: NDArray[np.floating], law: int, background_dn: float, threshold_dn: float, rows: tuple[int, int], cols: tuple[int, int]
) -> tuple[Array, Array]:
    """Return x, y, shape (n,), of Σ f(I) x / Σ f(I) over the given rows and columns; NaN where Σ f is not positive."""
    n = windows.shape[0]
    x, y = np.empty(n, np.float64), np.empty(n, np.float64)
    for i in range(n):
        total, along_x, along_y = 0.0, 0.0, 0.0
        for r in range(rows[0], rows[1]):
            row_total, row_x = 0.0, 0.0
            for c in range(cols[0], cols[1]):
                value = float(windows[i, r, c]) - background_dn
                if law == SOFT:
                    value = max(value - threshold_dn, 0.0)
                elif law == HARD:
                    value = value if value > threshold_dn else 0.0
                elif law == SQUARED:
                    value = value * value
                row_total += value
                row_x += value * c
            total += row_total
            along_x += row_x
            along_y += row_total * r
        x[i] = along_x / total if total > 0.0 else np.nan
        y[i] = along_y / total if total > 0.0 else np.nan
    return x, y
