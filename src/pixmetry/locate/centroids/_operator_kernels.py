"""Kernels of operators that find a target's centre from its outline or by a Gaussian: position, and how it answers to each pixel."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core._least_squares_kernels import FREE, Rest, descent_of
from pixmetry.core._linear_algebra_kernels import factor_for, factorise, invert_root, substitute
from pixmetry.core.arrays import Array, Flags, Ints, Singles
from pixmetry.core.jit import jit
from pixmetry.locate._noise_kernels import Noise, variance_at
from pixmetry.locate.centroids._moment_kernels import (
    AMPLITUDE,
    ANGLE,
    LEVEL,
    MAJOR,
    MARGIN,
    MINOR,
    REACH,
    SIGN,
    SLOPE_X,
    SLOPE_Y,
    SQUARED,
    X,
    Y,
    chord,
    disc_profile,
    ground_variance,
    moment_of,
    quadratic_form,
)

PERIMETER, FORSTNER, ELLIPSE_EDGES, GAUSSIAN = 0, 1, 2, 3
GRADIENT_NOISE = 2.0 * (9.0 + 100.0 + 9.0) / 1024.0  # variance of one component of Scharr's gradient per variance of a pixel
MOST_RAYS = 192
ROUND = 1.2  # ratio of the axes of an ellipse that is drawn as a disc is: the plateau in one go
SIZES = 4  # of a class, half a pixel together
FEW, HALF = 4, 8  # phases, of 16, of a rough look and of a better one
SMOOTH_PX = 0.6  # blur from which three places across a pixel do: 2e-5 of the height
SINGLE = 3e-8  # of the height, which single precision does not hold
GAUSSIAN_UNKNOWNS = 7
GAUSSIAN_REST = 1e-10  # of the squared residuals: fall at which the fit of a Gaussian is at rest


@jit
def cut_window(frame: np.ndarray, record: Array, i: int, cx: float, cy: float, noise: Noise, patch: Array, box: Ints) -> bool:
    """Copy the window about (cx, cy), less the background and positive towards the target, with a rim of 2; ``box`` is its place.

    ``patch`` (3, side, side): value, variance, and 1 inside the window's ellipse. Return False where it does not fit.
    """
    p, q, r = quadratic_form(record[i, MAJOR] + record[i, MARGIN], record[i, MINOR] + record[i, MARGIN], record[i, ANGLE])
    det = p * r - q * q
    wide, high = math.sqrt(r / det), math.sqrt(p / det)
    box[0], box[1] = int(math.ceil(cy - high)) - 2, int(math.floor(cy + high)) + 3
    box[2], box[3] = int(math.ceil(cx - wide)) - 2, int(math.floor(cx + wide)) + 3
    if box[0] < 0 or box[2] < 0 or box[1] > frame.shape[0] or box[3] > frame.shape[1]:
        return False
    if box[1] - box[0] > patch.shape[1] or box[3] - box[2] > patch.shape[2]:
        return False
    for row in range(box[0], box[1]):
        middle, half = chord(p, q, r, row - cy)
        base = record[i, LEVEL] + record[i, SLOPE_Y] * (row - record[i, Y]) - record[i, SLOPE_X] * record[i, X]
        for col in range(box[2], box[3]):
            a, b = row - box[0], col - box[2]
            level = np.float64(frame[row, col])
            patch[0, a, b] = record[i, SIGN] * (level - base - record[i, SLOPE_X] * col)
            patch[1, a, b] = variance_at(level, noise)
            patch[2, a, b] = 1.0 if half >= 0.0 and abs(col - cx - middle) <= half else 0.0
    return True


@jit
def perimeter_pixel(mask: Array, a: int, b: int) -> bool:
    """Tell whether a pixel above the threshold has a neighbour of four that is not."""
    if mask[a, b] == 0.0:
        return False
    return bool(mask[a - 1, b] == 0.0 or mask[a + 1, b] == 0.0 or mask[a, b - 1] == 0.0 or mask[a, b + 1] == 0.0)


@jit
def perimeter_sums(mask: Array, a: int, b: int, sums: Array) -> None:
    """Number and sums of the places of the perimeter's pixels among one pixel and its four neighbours."""
    sums[:] = 0.0
    for k in range(5):
        row, col = a, b
        if k == 1:
            row = a - 1
        elif k == 2:
            row = a + 1
        elif k == 3:
            col = b - 1
        elif k == 4:
            col = b + 1
        if row > 0 and col > 0 and row < mask.shape[0] - 1 and col < mask.shape[1] - 1 and perimeter_pixel(mask, row, col):
            sums[0] += 1.0
            sums[1] += col
            sums[2] += row


@jit
def perimeter_of(patch: Array, box: Ints, threshold: float, result: Array) -> bool:
    """Mean place of the perimeter's pixels; the covariance is that of pixels which noise may take over the threshold."""
    rows, cols = box[1] - box[0], box[3] - box[2]
    mask = np.zeros((rows, cols))
    n, sx, sy = 0.0, 0.0, 0.0
    for a in range(1, rows - 1):
        for b in range(1, cols - 1):
            mask[a, b] = 1.0 if patch[2, a, b] > 0.0 and patch[0, a, b] > threshold else 0.0
    for a in range(1, rows - 1):
        for b in range(1, cols - 1):
            if perimeter_pixel(mask, a, b):
                n, sx, sy = n + 1.0, sx + b, sy + a
    if n < 1.0:
        return False
    mx, my = sx / n, sy / n
    before, after = np.empty(3), np.empty(3)
    xx, xy, yy = 0.0, 0.0, 0.0
    for a in range(2, rows - 2):
        for b in range(2, cols - 2):
            if patch[2, a, b] == 0.0:
                continue
            deviation = math.sqrt(max(patch[1, a, b], 1e-12))
            z = (patch[0, a, b] - threshold) / deviation
            if abs(z) > 5.0:
                continue
            share = 0.5 * math.erfc(-z * 0.7071067811865476)
            perimeter_sums(mask, a, b, before)
            mask[a, b] = 1.0 - mask[a, b]
            perimeter_sums(mask, a, b, after)
            mask[a, b] = 1.0 - mask[a, b]
            many = n - before[0] + after[0]
            if many < 1.0:
                continue
            dx, dy = (sx - before[1] + after[1]) / many - mx, (sy - before[2] + after[2]) / many - my
            flips = share * (1.0 - share)
            xx, xy, yy = xx + flips * dx * dx, xy + flips * dx * dy, yy + flips * dy * dy
    result[0], result[1], result[2], result[3], result[4] = box[2] + mx, box[0] + my, xx, xy, yy
    return True


@jit
def scharr(value: Array, a: int, b: int) -> tuple[float, float]:
    """Gradient of a pixel by Scharr's 3 × 3 masks."""
    gx = 3.0 * (value[a - 1, b + 1] - value[a - 1, b - 1] + value[a + 1, b + 1] - value[a + 1, b - 1])
    gx += 10.0 * (value[a, b + 1] - value[a, b - 1])
    gy = 3.0 * (value[a + 1, b - 1] - value[a - 1, b - 1] + value[a + 1, b + 1] - value[a - 1, b + 1])
    gy += 10.0 * (value[a + 1, b] - value[a - 1, b])
    return gx / 32.0, gy / 32.0


@jit
def forstner_of(patch: Array, box: Ints, inverse: Array) -> tuple[bool, float, float]:
    """Point nearest to all lines along the gradients, weighted by their squares; ``inverse``, xx, xy, yy, of the normal equations.

    Return found, x, y. The noise of the gradients adds a multiple of the unit matrix that would pull to the window's centre; it is
    taken off.
    """
    rows, cols = box[1] - box[0], box[3] - box[2]
    value = patch[0]
    nxx, nxy, nyy, bx, by = 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(1, rows - 1):
        for b in range(1, cols - 1):
            if patch[2, a, b] == 0.0:
                continue
            gx, gy = scharr(value, a, b)
            noise = GRADIENT_NOISE * patch[1, a, b]
            xx, xy, yy = gy * gy - noise, -gx * gy, gx * gx - noise
            nxx, nxy, nyy = nxx + xx, nxy + xy, nyy + yy
            bx += xx * b + xy * a
            by += xy * b + yy * a
    det = nxx * nyy - nxy * nxy
    if not (nxx > 0.0 and det > 0.0):
        return False, 0.0, 0.0
    ixx, ixy, iyy = nyy / det, -nxy / det, nxx / det
    inverse[0], inverse[1], inverse[2] = ixx, ixy, iyy
    return True, box[2] + ixx * bx + ixy * by, box[0] + ixy * bx + iyy * by


@jit
def forstner_slopes(patch: Array, box: Ints, inverse: Array, x: float, y: float, answer: Array) -> None:
    """Slopes by pixel of what `forstner_of` returned, into ``answer`` (2, side, side)."""
    rows, cols = box[1] - box[0], box[3] - box[2]
    value, x, y = patch[0], x - box[2], y - box[0]
    ixx, ixy, iyy = inverse[0], inverse[1], inverse[2]
    answer[:, :rows, :cols] = 0.0
    for a in range(1, rows - 1):
        for b in range(1, cols - 1):
            if patch[2, a, b] == 0.0:
                continue
            gx, gy = scharr(value, a, b)
            dx, dy = x - b, y - a
            e = -gy * dx + gx * dy
            # of u e with u = (−gy, gx) and e = u·d, by gx and by gy
            ax, ay = -gy * dy, e + gx * dy
            cx, cy = -e + gy * dx, -gx * dx
            px, py = -(ixx * ax + ixy * ay), -(ixy * ax + iyy * ay)
            qx, qy = -(ixx * cx + ixy * cy), -(ixy * cx + iyy * cy)
            for k in range(-1, 2):
                w = (10.0 if k == 0 else 3.0) / 32.0
                answer[0, a + k, b + 1] += w * px
                answer[1, a + k, b + 1] += w * py
                answer[0, a + k, b - 1] -= w * px
                answer[1, a + k, b - 1] -= w * py
                answer[0, a + 1, b + k] += w * qx
                answer[1, a + 1, b + k] += w * qy
                answer[0, a - 1, b + k] -= w * qx
                answer[1, a - 1, b + k] -= w * qy


@jit
def largest_eigenvector(m: Array, vector: Array) -> None:
    """Write the eigenvector of the largest eigenvalue of a symmetric 3 × 3 matrix: the roots of the cubic by their cosines."""
    mean = (m[0, 0] + m[1, 1] + m[2, 2]) / 3.0
    off = m[0, 1] ** 2 + m[0, 2] ** 2 + m[1, 2] ** 2
    spread = math.sqrt(((m[0, 0] - mean) ** 2 + (m[1, 1] - mean) ** 2 + (m[2, 2] - mean) ** 2 + 2 * off) / 6.0)
    a, b, c = (m[0, 0] - mean) / spread, (m[1, 1] - mean) / spread, (m[2, 2] - mean) / spread
    d, e, f = m[0, 1] / spread, m[0, 2] / spread, m[1, 2] / spread
    half = 0.5 * (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e))
    value = 2.0 * math.cos(math.acos(min(max(half, -1.0), 1.0)) / 3.0)
    a, b, c = a - value, b - value, c - value
    # a row of the adjugate, that with the largest norm
    first = (b * c - f * f, e * f - d * c, d * f - e * b)
    second = (e * f - d * c, a * c - e * e, d * e - a * f)
    third = (d * f - e * b, d * e - a * f, a * b - d * d)
    best = first
    if abs(second[1]) > abs(best[0]):
        best = second
    if abs(third[2]) > max(abs(first[0]), abs(second[1])):
        best = third
    vector[0], vector[1], vector[2] = best


@jit
def fit_conic(px: Array, py: Array, count: int) -> Array:
    """Direct least-squares ellipse through points: the conic a x² + b xy + c y² + d x + e y + f with 4ac − b² > 0.

    Fitzgibbon, Pilu, Fisher 1999, with the linear part eliminated first (Halíř, Flusser 1998). The reduced scatter matrix is positive
    definite and the constraint has one positive eigenvalue, so that of L⁻¹ C L⁻ᵀ the largest is the ellipse.
    """
    s1, s2, s3 = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    quad, line = np.empty(3), np.empty(3)
    for k in range(count):
        quad[0], quad[1], quad[2] = px[k] * px[k], px[k] * py[k], py[k] * py[k]
        line[0], line[1], line[2] = px[k], py[k], 1.0
        for i in range(3):
            for j in range(3):
                s1[i, j] += quad[i] * quad[j]
                s2[i, j] += quad[i] * line[j]
                s3[i, j] += line[i] * line[j]
    conic, back, factor = np.zeros(6), np.zeros((3, 3)), factor_for(3)
    if not factorise(s3, 3, 0.0, factor):
        return conic
    for j in range(3):  # of the linear part by the quadratic one, with the sign turned
        substitute(factor, 3, s2[j], line)
        back[:, j] = line
    lower = s1.copy()
    for i in range(3):
        for j in range(3):
            for m in range(3):
                lower[i, j] -= s2[i, m] * back[m, j]
    small = 1e-13 * (s1[0, 0] + s1[1, 1] + s1[2, 2])
    for i in range(3):
        lower[i, i] += small
    inverse, symmetric = np.zeros((3, 3)), np.zeros((3, 3))
    if not factorise(lower, 3, 0.0, factor):
        return conic
    invert_root(factor, 3, inverse)
    for i in range(3):
        for j in range(3):
            symmetric[i, j] = 2.0 * (inverse[i, 0] * inverse[j, 2] + inverse[i, 2] * inverse[j, 0]) - inverse[i, 1] * inverse[j, 1]
    largest_eigenvector(symmetric, line)
    for i in range(3):
        for j in range(3):
            conic[i] += inverse[j, i] * line[j]
    for i in range(3):
        for j in range(3):
            conic[3 + i] -= back[i, j] * conic[j]
    return conic


@jit
def edges_of(patch: Array, box: Ints, record: Array, i: int, cx: float, cy: float, answer: Array) -> tuple[bool, float, float]:
    """Ellipse through the edges on rays from (cx, cy); an edge lies where a step of full height would hold the ray's light.

    Return found, x, y; ``answer`` gets the slopes by pixel, for rays that follow the estimate.
    """
    rows, cols = box[1] - box[0], box[3] - box[2]
    value = patch[0]
    major, minor, angle = record[i, MAJOR], record[i, MINOR], record[i, ANGLE]
    blur, height = 0.25 * record[i, REACH], record[i, AMPLITUDE]
    mean_radius = math.sqrt(major * minor)
    count = min(max(int(8 * mean_radius), 32), MOST_RAYS)
    px, py, pr = np.empty(count), np.empty(count), np.empty(count)
    p, q, r = quadratic_form(major, minor, angle)
    margin = min(3.0 * blur, record[i, MARGIN])
    x0, y0 = cx - box[2], cy - box[0]
    for k in range(count):
        c, s = math.cos(2 * math.pi * (k + 0.5) / count), math.sin(2 * math.pi * (k + 0.5) / count)
        edge = 1.0 / math.sqrt(p * c * c + 2 * q * c * s + r * s * s)
        low = max(0.0, edge - 3.0 * blur)
        steps = max(int(math.ceil((edge + margin - low) / 0.5)), 2)
        width = (edge + margin - low) / steps
        light = 0.0
        for j in range(steps):
            at = low + (j + 0.5) * width
            x, y = x0 + at * c, y0 + at * s
            b, a = int(math.floor(x)), int(math.floor(y))
            fx, fy = x - b, y - a
            top = (1 - fx) * value[a, b] + fx * value[a, b + 1]
            light += width * ((1 - fy) * top + fy * ((1 - fx) * value[a + 1, b] + fx * value[a + 1, b + 1]))
        pr[k] = low + light / height
        px[k], py[k] = pr[k] * c / mean_radius, pr[k] * s / mean_radius
    conic = fit_conic(px, py, count)
    a, b, c, d, e, f = conic[0], conic[1], conic[2], conic[3], conic[4], conic[5]
    det = 4 * a * c - b * b
    if not (det > 0.0 and abs(f) > 0.0):
        return False, 0.0, 0.0
    ex, ey = (b * e - 2 * c * d) / det, (b * d - 2 * a * e) / det
    # of the centre by the conic's first five coefficients where the sixth is −1: 2a x + b y + d = 0, b x + 2c y + e = 0
    a, b, c, d, e = -a / f, -b / f, -c / f, -d / f, -e / f
    normal = np.zeros((5, 5))
    row = np.empty(5)
    for k in range(count):
        row[0], row[1], row[2], row[3], row[4] = px[k] * px[k], px[k] * py[k], py[k] * py[k], px[k], py[k]
        for m in range(5):
            for n in range(5):
                normal[m, n] += row[m] * row[n]
    # of the centre by the coefficients, −[[2a, b], [b, 2c]]⁻¹ [[2x, y, 0, 1, 0], [0, x, 2y, 0, 1]], times the inverse of the normal matrix
    det = 4 * a * c - b * b
    by_sums, factor = np.zeros((2, 5)), factor_for(5)
    if not factorise(normal, 5, 0.0, factor):
        return False, 0.0, 0.0
    for k in range(2):
        mx, my = (-2 * c / det, b / det) if k == 0 else (b / det, -2 * a / det)
        by_sums[k, 0], by_sums[k, 1], by_sums[k, 2], by_sums[k, 3], by_sums[k, 4] = 2 * ex * mx, ey * mx + ex * my, 2 * ey * my, mx, my
        substitute(factor, 5, by_sums[k], by_sums[k])
    answer[:, :rows, :cols] = 0.0
    for k in range(count):
        cosine, sine = math.cos(2 * math.pi * (k + 0.5) / count), math.sin(2 * math.pi * (k + 0.5) / count)
        row[0], row[1], row[2], row[3], row[4] = px[k] * px[k], px[k] * py[k], py[k] * py[k], px[k], py[k]
        out = (2 * a * px[k] + b * py[k] + d) * cosine + (b * px[k] + 2 * c * py[k] + e) * sine
        gx, gy = 0.0, 0.0
        for m in range(5):
            gx -= by_sums[0, m] * row[m] * out
            gy -= by_sums[1, m] * row[m] * out
        edge = 1.0 / math.sqrt(p * cosine * cosine + 2 * q * cosine * sine + r * sine * sine)
        low = max(0.0, edge - 3.0 * blur)
        steps = max(int(math.ceil((edge + margin - low) / 0.5)), 2)
        width = (edge + margin - low) / steps
        for j in range(steps):
            at = low + (j + 0.5) * width
            x, y = x0 + at * cosine, y0 + at * sine
            col, line = int(math.floor(x)), int(math.floor(y))
            fx, fy = x - col, y - line
            for s in range(4):
                w = (fx if s % 2 else 1 - fx) * (fy if s > 1 else 1 - fy) * width / height
                answer[0, line + s // 2, col + s % 2] += w * gx
                answer[1, line + s // 2, col + s % 2] += w * gy
    # rays from a fixed centre would answer to a shift of the target by this matrix; those that follow answer fully
    xx, xy, yx, yy = 0.0, 0.0, 0.0, 0.0
    for m in range(1, rows - 1):
        for n in range(1, cols - 1):
            ix, iy = 0.5 * (value[m, n - 1] - value[m, n + 1]), 0.5 * (value[m - 1, n] - value[m + 1, n])
            xx += answer[0, m, n] * ix
            xy += answer[0, m, n] * iy
            yx += answer[1, m, n] * ix
            yy += answer[1, m, n] * iy
    det = xx * yy - xy * yx
    if not (xx > 0.05 and det > 0.01):
        return False, 0.0, 0.0
    for m in range(rows):
        for n in range(cols):
            gx, gy = answer[0, m, n], answer[1, m, n]
            answer[0, m, n], answer[1, m, n] = (yy * gx - xy * gy) / det, (xx * gy - yx * gx) / det
    sx, sy = ex * mean_radius, ey * mean_radius
    return True, cx + (yy * sx - xy * sy) / det, cy + (xx * sy - yx * sx) / det


@jit
def gaussian_sums(window: Array, p: Array, weight: Array, fresh: Array, active: Ints, normal: Array, right: Array) -> tuple[float, float]:
    """Normal equations of b + A exp(−½ dᵀPd), each pixel by its share in the window; see `descent_of`.

    ``window``, shape (2, rows, cols): grey value and share; ``p``: A, b, x, y, and P's xx, xy, yy.
    """
    normal[:, :] = 0.0
    right[:] = 0.0
    row, total = np.empty(GAUSSIAN_UNKNOWNS), 0.0
    for a in range(window.shape[1]):
        for b in range(window.shape[2]):
            share = window[1, a, b]
            if share == 0.0:
                continue
            dx, dy = b - p[2], a - p[3]
            ux, uy = p[4] * dx + p[5] * dy, p[5] * dx + p[6] * dy
            g = math.exp(-0.5 * (ux * dx + uy * dy))
            f = p[0] * g
            row[0], row[1], row[2], row[3] = g, 1.0, f * ux, f * uy
            row[4], row[5], row[6] = -0.5 * f * dx * dx, -f * dx * dy, -0.5 * f * dy * dy
            residual = window[0, a, b] - p[1] - f
            total += share * residual * residual
            for m in range(GAUSSIAN_UNKNOWNS):
                weighted = share * row[m]
                right[m] += weighted * residual
                for n in range(m + 1):
                    normal[m, n] += weighted * row[n]
    fresh[:] = 1.0
    return total, total


@jit
def gaussian_trial(window: Array, p: Array, change: Array, active: Ints, trial: Array) -> bool:
    """Put p + change into ``trial``, with a P that stays positive definite; see `descent_of`."""
    trial[:] = p + change
    trial[4], trial[6] = max(trial[4], 0.2 * p[4]), max(trial[6], 0.2 * p[6])
    most = 0.95 * math.sqrt(trial[4] * trial[6])
    trial[5] = min(max(trial[5], -most), most)
    return True


descend_gaussian = descent_of(gaussian_sums, gaussian_trial)


@jit
def share_of(p: float, q: float, r: float, dx: float, dy: float) -> tuple[float, float, float]:
    """Share of a pixel in a window about the origin of form p x² + 2 q x y + r y² = 1, which cuts it, and its slopes by the centre."""
    form = p * dx * dx + 2.0 * q * dx * dy + r * dy * dy
    gx, gy = p * dx + q * dy, q * dx + r * dy
    steep = math.hypot(gx, gy)
    if steep == 0.0:
        return 1.0, 0.0, 0.0
    # distance to the outline along its normal, in pixels
    share = 0.5 + (math.sqrt(form) - form) / steep
    if share >= 1.0 or share <= 0.0:
        return min(max(share, 0.0), 1.0), 0.0, 0.0
    return share, gx / steep, gy / steep


@jit
def gaussian_of(patch: Array, box: Ints, record: Array, i: int, cx: float, cy: float, answer: Array) -> tuple[bool, float, float]:
    """Least-squares b + A exp(−½ dᵀPd) in the window about (cx, cy), which cuts pixels at its rim; slopes by pixel in ``answer``.

    Return found, x, y. A target is no Gaussian. So the slopes hold the residuals' part of the second derivatives; and pixels at the rim
    pull the estimate along when the window moves. Where the window is at rest at the estimate x̂(I, c), x̂ = c, the slopes are
    (1 − ∂x̂/∂c)⁻¹ ∂x̂/∂I. With M the matrix of second derivatives, ∂x̂/∂c = M⁻¹ B, B = Σ ∂share/∂c residual ∂f/∂x̂; so M − B takes M's place.
    """
    rows, cols = box[1] - box[0], box[3] - box[2]
    wide, high, angle = record[i, MAJOR] + record[i, MARGIN], record[i, MINOR] + record[i, MARGIN], record[i, ANGLE]
    wp, wq, wr = quadratic_form(wide, high, angle)
    value = patch[0]
    p, q, r = quadratic_form(record[i, MAJOR] / 1.1774, record[i, MINOR] / 1.1774, record[i, ANGLE])
    at = np.array([record[i, AMPLITUDE], 0.0, cx - box[2], cy - box[0], p, q, r])
    window = np.empty((2, rows, cols))
    window[0] = patch[0, :rows, :cols]
    normal = np.empty((2, rows, cols))
    for a in range(rows):
        for b in range(cols):
            window[1, a, b], normal[0, a, b], normal[1, a, b] = share_of(wp, wq, wr, box[2] + b - cx, box[0] + a - cy)
    least, active = np.full(GAUSSIAN_UNKNOWNS, -np.inf), np.arange(GAUSSIAN_UNKNOWNS)
    descend_gaussian(window, at, least, active, 1, Rest(0.0, GAUSSIAN_REST, FREE, 0.0))
    xx, xy, yx, yy = 0.0, 0.0, 0.0, 0.0
    answer[:, :rows, :cols] = 0.0
    for a in range(rows):
        for b in range(cols):
            share = window[1, a, b]
            if share == 0.0:
                continue
            dx, dy = b - at[2], a - at[3]
            ux, uy = at[4] * dx + at[5] * dy, at[5] * dx + at[6] * dy
            f = at[0] * math.exp(-0.5 * (ux * dx + uy * dy))
            residual = value[a, b] - at[1] - f
            xx += share * (f * ux * f * ux - residual * f * (ux * ux - at[4])) - normal[0, a, b] * residual * f * ux
            xy += share * (f * ux * f * uy - residual * f * (ux * uy - at[5])) - normal[1, a, b] * residual * f * ux
            yx += share * (f * ux * f * uy - residual * f * (ux * uy - at[5])) - normal[0, a, b] * residual * f * uy
            yy += share * (f * uy * f * uy - residual * f * (uy * uy - at[6])) - normal[1, a, b] * residual * f * uy
            answer[0, a, b], answer[1, a, b] = share * f * ux, share * f * uy
    det = xx * yy - xy * yx
    if not (at[0] > 0.0 and xx > 0.0 and det > 0.0):
        return False, 0.0, 0.0
    for a in range(rows):
        for b in range(cols):
            gx, gy = answer[0, a, b], answer[1, a, b]
            answer[0, a, b], answer[1, a, b] = (yy * gx - xy * gy) / det, (xx * gy - yx * gx) / det
    return True, box[2] + at[2], box[0] + at[3]


@jit
def propagate(answer: Array, patch: Array, record: Array, i: int, box: Ints, result: Array) -> None:
    """Covariance from the slopes by pixel: the pixels' own variance and that of the background's plane."""
    xx, xy, yy = 0.0, 0.0, 0.0
    ax, ay = np.zeros(3), np.zeros(3)
    for a in range(box[1] - box[0]):
        for b in range(box[3] - box[2]):
            gx, gy = answer[0, a, b], answer[1, a, b]
            v = patch[1, a, b]
            xx, xy, yy = xx + gx * gx * v, xy + gx * gy * v, yy + gy * gy * v
            u, w = box[2] + b - record[i, X], box[0] + a - record[i, Y]
            ax[0] += gx
            ax[1] += gx * u
            ax[2] += gx * w
            ay[0] += gy
            ay[1] += gy * u
            ay[2] += gy * w
    result[2], result[3], result[4] = xx, xy, yy
    ground_variance(record, i, ax, ay, result)


@jit
def operator_of(
    frame: np.ndarray,
    record: Array,
    i: int,
    operator: int,
    noise: Noise,
    patch: Array,
    answer: Array,
    box: Ints,
    sums: Array,
    result: Array,
) -> bool:
    """Position and covariance of one target by an operator; its window follows the squared centroid, then the estimate.

    Without noise there is no covariance.
    """
    moment_of(frame, record, i, SQUARED, noise, sums, result)
    cx, cy = result[0], result[1]
    if not (math.isfinite(cx) and math.hypot(cx - record[i, X], cy - record[i, Y]) < record[i, MINOR] + record[i, MARGIN]):
        cx, cy = record[i, X], record[i, Y]
    faint = result[5]
    result[:] = np.nan
    at_rest, inverse, x, y = False, np.empty(3), cx, cy
    for turn in range(12):
        if not cut_window(frame, record, i, cx, cy, noise, patch, box):
            return False
        if operator == PERIMETER:
            result[5] = faint
            return perimeter_of(patch, box, 0.5 * record[i, AMPLITUDE], result)
        if operator == FORSTNER:
            found, x, y = forstner_of(patch, box, inverse)
        elif operator == ELLIPSE_EDGES:
            found, x, y = edges_of(patch, box, record, i, cx, cy, answer)
        else:
            found, x, y = gaussian_of(patch, box, record, i, cx, cy, answer)
        if not found or math.hypot(x - record[i, X], y - record[i, Y]) > record[i, MINOR] + record[i, MARGIN]:
            return False
        moved = math.hypot(x - cx, y - cy)
        # half steps where full ones swing to and fro
        step = 1.0 if turn < 4 else 0.5
        cx, cy = cx + step * (x - cx), cy + step * (y - cy)
        if moved < 1e-3:
            at_rest = True
            break
    if noise.constant_dn2 > 0.0:
        if operator == FORSTNER:
            forstner_slopes(patch, box, inverse, x, y, answer)
        propagate(answer, patch, record, i, box, result)
    else:
        result[2:5] = 0.0
    result[0], result[1], result[5] = cx, cy, faint
    return at_rest or moved < max(0.3 * math.sqrt(result[2] + result[4]), 0.02)


@jit
def operators(frame: np.ndarray, record: Array, first: int, stop: int, operator: int, noise: Noise, result: Array, at_rest: Flags) -> None:
    """Positions of targets first … stop; `result` (n, 6), `at_rest` (n,)."""
    widest = 0.0
    for i in range(first, stop):
        widest = max(widest, record[i, MAJOR] + record[i, MARGIN])
    side = 2 * int(widest + 2) + 7
    patch, answer = np.zeros((3, side, side)), np.zeros((2, side, side))
    box, sums = np.zeros(4, np.int64), np.empty(15)
    for i in range(first, stop):
        at_rest[i] = operator_of(frame, record, i, operator, noise, patch, answer, box, sums, result[i])


@jit(inline="always")
def radial_place(p: float, q: float, r: float, dx: float, dy: float, edge: float, step: float) -> float:
    """Place in a radial profile of what is at (dx, dy) from the centre of an ellipse, by the distance along the outline's normal."""
    gx, gy = p * dx + q * dy, q * dx + r * dy
    form = math.sqrt(max(gx * dx + gy * dy, 1e-12))
    return (edge + (form - 1.0) * form / max(math.sqrt(gx * gx + gy * gy), 1e-12)) / step - 0.5


@jit
def draw_target(
    image: Singles, x: float, y: float, major: float, minor: float, angle: float, edge: float, profile: Array, step: float, blur: float
) -> None:
    """Draw a target by its radial profile, averaged over 5 × 5 places in each pixel, or 3 × 3 where the ``blur`` leaves nothing finer.

    ``edge`` is the profile's own radius; an ellipse has it along the normals to its outline.
    """
    p, q, r = quadratic_form(major, minor, angle)
    at = np.array([-0.453089922969332, -0.26923465505284155, 0.0, 0.26923465505284155, 0.453089922969332])
    weight = np.array([0.11846344252809454, 0.23931433524968324, 0.28444444444444444, 0.23931433524968324, 0.11846344252809454])
    if blur > SMOOTH_PX:
        at, weight = (
            np.array([-0.3872983346207417, 0.0, 0.3872983346207417]),
            np.array([0.2777777777777778, 0.4444444444444444, 0.2777777777777778]),
        )
    last = profile.shape[0] - 1
    flat, dark = -1, last  # up to where the profile is 1, and from where it is 0: all of a pixel is alike there
    while flat < last and profile[flat + 1] >= 1.0 - SINGLE:
        flat += 1
    while dark > 0 and profile[dark - 1] <= SINGLE:
        dark -= 1
    even = flat >= 0 and major < ROUND * minor  # inside of a slim ellipse, distances from the outline do not grow evenly
    room = 0.7 * (major / minor) ** 2 / step + 1.0  # from a pixel's middle to its corners
    for row in range(image.shape[0]):
        for col in range(image.shape[1]):
            place = radial_place(p, q, r, col - x, row - y, edge, step)
            if even and place + room < flat:
                image[row, col] = 1.0
                continue
            if place - room > dark:
                image[row, col] = 0.0
                continue
            total = 0.0
            for a in range(len(at)):
                for b in range(len(at)):
                    place = radial_place(p, q, r, col + at[b] - x, row + at[a] - y, edge, step)
                    if place <= 0.0:
                        light = profile[0]
                    elif place >= last:
                        light = 0.0
                    else:
                        j = int(place)
                        light = profile[j] + (place - j) * (profile[j + 1] - profile[j])
                    total += weight[a] * weight[b] * light
            image[row, col] = total


@jit
def phase_variances(
    shape: Array,
    first: int,
    stop: int,
    operator: int,
    phases: Array,
    nodes: Array,
    weights: Array,
    columns: int,
    negligible: Array,
    small: Array,
    out: Array,
) -> None:
    """Variance over the sub-pixel phase of an operator for classes first … stop of targets, noise-free.

    ``shape`` (classes, 8): radius and blur (without the pixel) of the profile, half axes and angle at half height, blur with the pixel,
    margin of the window, and radius at half height. An S-curve swings with the size, over half a pixel or less: the largest of
    four sizes over that counts. Where the first few phases of two sizes, a quarter of a pixel apart, make less than is ``negligible``,
    twice what they make on average stands for it; where they make less than is ``small``, half of the phases do. That is 0.5 to 2.5 times
    the whole, and 0.7 to 1.4, of nine classes in ten.
    """
    for i in range(first, stop):
        rough = 0.0
        for size in range(0, SIZES, 2):
            rough += phase_variance(shape[i], 0.125 * size - 0.1875, operator, phases[:FEW], nodes, weights, columns)
        out[i] = rough
        if not rough < negligible[i]:
            some = phases[:HALF] if rough < small[i] else phases
            out[i] = 0.0
            for size in range(SIZES):
                out[i] = max(out[i], phase_variance(shape[i], 0.125 * size - 0.1875, operator, some, nodes, weights, columns))


@jit
def phase_variance(shape: Array, change: float, operator: int, phases: Array, nodes: Array, weights: Array, columns: int) -> float:
    """Variance over phases of one class whose size is changed."""
    noise = Noise(0.0, 0.0, 0.0, 0.0, -np.inf, np.inf, 0.0, 0.0)
    box, sums, result = np.zeros(4, np.int64), np.empty(15), np.empty(6)
    major, minor = shape[2] + change, shape[3] + change
    half = int(major + shape[6] + 4.0)
    side = 2 * half + 1
    step = 0.05
    profile = np.empty(int((major + shape[6] + 6.0) * 1.5 / step))
    disc_profile(max(shape[0] + change, 0.05), shape[1], nodes, weights, step, profile)
    record = np.zeros((1, columns))
    record[0, MAJOR], record[0, MINOR], record[0, ANGLE], record[0, MARGIN] = major, minor, shape[4], shape[6]
    record[0, REACH], record[0, SIGN] = 4.0 * shape[5], 1.0
    image = np.empty((side, side), np.float32)
    patch, answer = np.zeros((3, side + 9, side + 9)), np.zeros((2, side + 9, side + 9))
    total, count = 0.0, 0
    for phase in range(phases.shape[0]):
        record[0, X], record[0, Y] = half + phases[phase, 0], half + phases[phase, 1]
        draw_target(image, record[0, X], record[0, Y], major, minor, shape[4], shape[7] + change, profile, step, shape[1])
        record[0, AMPLITUDE] = image[half, half]
        if operator_of(image, record, 0, operator, noise, patch, answer, box, sums, result):
            total += (result[0] - record[0, X]) ** 2 + (result[1] - record[0, Y]) ** 2
            count += 1
    return 0.5 * total / count if count > 0 else 0.0
