"""The bundle adjustment observation by observation and point by point.

Image coordinates stand sorted by point, then image; ``first[j] : first[j + 1]`` are those of point j. The columns of a row of the Jacobian
are the free interior parameters of its camera, then those of its image, then X, Y, Z of its point. The reduced unknowns are in the order
cameras, images, points that stay in the reduced system (``point_col[j] >= 0``); of symmetric matrices the lower triangle is kept.
The rows of an eliminated point in the normal equations are W (unknowns × 3); with V = L Lᵀ its own 3 × 3 block, Z = W L⁻ᵀ, and the reduced
matrix is U − Σ Z Zᵀ (the Schur complement).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pixmetry.calibrate.bundle._model_kernels import INTERIOR, Cameras, Lens, Views, image_point
from pixmetry.core.arrays import Array, Flags, Ints
from pixmetry.core.jit import jit

ELIMINATED, HELD = -1, -2  # values of ``point_col``: eliminated; no unknown, or not determined
SUMS = {"contract", "reassoc", "nsz"}  # sums in any order


class Measured(NamedTuple):
    """Image coordinates, px."""

    x: Array  # (n,)
    y: Array  # (n,)
    whiten: Array  # (n, 3): lower triangle of the inverse Cholesky factor of each covariance, 1/px


class Incidence(NamedTuple):
    """Which image shows which point, and which unknowns these have."""

    image: Ints  # (n,)
    point: Ints  # (n,)
    first: Ints  # (points + 1,): image coordinates of each point
    camera_of: Ints  # (images,)
    free: Ints  # (cameras, f): free interior parameters, −1 after the last
    extra: Ints  # (2,): places of x-scale and x-shift behind the pose, −1 if not estimated
    camera_col: Ints  # (cameras,): first reduced unknown of each camera, and
    camera_count: Ints  # (cameras,): how many it has
    image_col: Ints  # (images,): first reduced unknown, −1 if there is none
    point_col: Ints  # (points,): likewise, or `ELIMINATED` or `HELD`


class Stretch(NamedTuple):
    """What the grabber does to each image along x: x = x₀ + (1 + scale)(x_model − x₀) + shift."""

    scale: Array  # (images,)
    shift_px: Array  # (images,)
    origin_px: float  # x₀


class Points(NamedTuple):
    """Object points."""

    xyz: Array  # (points, 3)
    held: Flags  # (points, 3): coordinates that are fixed


class Linear(NamedTuple):
    """The observation equations, linearised and whitened."""

    jacobian: Array  # (n, 2, q)
    weight: Array  # (n,): 0 where an image coordinate takes no part


class Eliminated(NamedTuple):
    """Z of the eliminated points."""

    of_images: Array  # (n, 3, p): image point by image point, by the p unknowns of an image
    of_cameras: Array  # (points, 3, interior): by the unknowns of all cameras


@jit
def linearise(
    measured: Measured, at: Incidence, cameras: Cameras, views: Views, stretches: Stretch, points: Points, residual: Array, jacobian: Array
) -> None:
    """Whitened residuals (n, 2) and Jacobian (n, 2, q) at a state; NaN and 0 where a point has no image."""
    x, y, whiten = measured
    image, point, camera_of, free, extra = at.image, at.point, at.camera_of, at.free, at.extra
    interior, form, per_px = cameras
    rotation, position = views
    x_scale, x_shift, origin = stretches
    xyz, held = points
    f = free.shape[1]
    wide = jacobian.shape[2]
    by_direction, by_interior = np.empty((2, 2)), np.empty((2, INTERIOR))
    for i in range(len(x)):
        m, j = image[i], point[i]
        k = camera_of[m]
        r = rotation[m]
        ex, ey, ez = xyz[j, 0] - position[m, 0], xyz[j, 1] - position[m, 1], xyz[j, 2] - position[m, 2]
        xc = r[0, 0] * ex + r[0, 1] * ey + r[0, 2] * ez
        yc = r[1, 0] * ex + r[1, 1] * ey + r[1, 2] * ez
        zc = r[2, 0] * ex + r[2, 1] * ey + r[2, 2] * ez
        px, py = np.nan, np.nan
        stretch = 1.0 + x_scale[m]
        if zc > 1e-9 * (abs(xc) + abs(yc)):
            u, v = xc / zc, yc / zc
            guess = origin + (x[i] - x_shift[m] - origin) / stretch
            lens = Lens(interior[k], form[k], per_px[k, 0], per_px[k, 1])
            px, py = image_point(u, v, lens, guess, y[i], by_direction, by_interior)
            if np.isnan(px):
                px, py = image_point(u, v, lens, np.nan, np.nan, by_direction, by_interior)
        rows = jacobian[i]
        if np.isnan(px) or np.isnan(py):
            residual[i, 0], residual[i, 1] = np.nan, np.nan
            rows[:, :] = 0.0
            continue
        w0, w1, w2 = whiten[i, 0], whiten[i, 1], whiten[i, 2]
        dx = x[i] - (origin + stretch * (px - origin) + x_shift[m])
        dy = y[i] - py
        residual[i, 0], residual[i, 1] = w0 * dx, w1 * dx + w2 * dy
        for a in range(f):
            which = free[k, a]
            if which < 0:
                rows[0, a], rows[1, a] = 0.0, 0.0
            else:
                rows[0, a], rows[1, a] = stretch * by_interior[0, which], by_interior[1, which]
        for a in range(2):
            gain = stretch if a == 0 else 1.0
            e0, e1 = gain * by_direction[a, 0] / zc, gain * by_direction[a, 1] / zc
            e2 = -(e0 * u + e1 * v)
            rows[a, f] = yc * e2 - zc * e1
            rows[a, f + 1] = zc * e0 - xc * e2
            rows[a, f + 2] = xc * e1 - yc * e0
            for b in range(3):
                along = e0 * r[0, b] + e1 * r[1, b] + e2 * r[2, b]
                rows[a, f + 3 + b] = -along
                rows[a, wide - 3 + b] = 0.0 if held[j, b] else along
        if extra[0] >= 0:
            rows[0, f + extra[0]], rows[1, f + extra[0]] = px - origin, 0.0
        if extra[1] >= 0:
            rows[0, f + extra[1]], rows[1, f + extra[1]] = 1.0, 0.0
        for a in range(wide):
            rows[1, a] = w1 * rows[0, a] + w2 * rows[1, a]
            rows[0, a] *= w0


@jit
def normals(residual: Array, linear: Linear, at: Incidence, U: Array, g: Array, V: Array, h: Array) -> None:
    """Add the normal equations of all image coordinates: U, g of the reduced unknowns, V (points, 3, 3), h (points, 3) of the points."""
    jacobian, weight = linear
    image, first, camera_of, camera_col, camera_count = at.image, at.first, at.camera_of, at.camera_col, at.camera_count
    image_col, point_col = at.image_col, at.point_col
    wide = jacobian.shape[2]
    each = camera_count.max()
    poses = wide - 3 - each
    p = wide - 3
    for j in range(len(first) - 1):
        pc = point_col[j]
        for i in range(first[j], first[j + 1]):
            w = weight[i]
            if w == 0.0:
                continue
            k = camera_of[image[i]]
            cc, n, ic = camera_col[k], camera_count[k], image_col[image[i]]
            row0, row1 = jacobian[i, 0], jacobian[i, 1]
            r0, r1 = w * residual[i, 0], w * residual[i, 1]
            for a in range(n):
                s0, s1 = w * row0[a], w * row1[a]
                g[cc + a] += row0[a] * r0 + row1[a] * r1
                to = U[cc + a]
                for b in range(a + 1):
                    to[cc + b] += s0 * row0[b] + s1 * row1[b]
            for a in range(poses):
                s0, s1 = w * row0[each + a], w * row1[each + a]
                g[ic + a] += row0[each + a] * r0 + row1[each + a] * r1
                to = U[ic + a]
                for b in range(n):
                    to[cc + b] += s0 * row0[b] + s1 * row1[b]
                for b in range(a + 1):
                    to[ic + b] += s0 * row0[each + b] + s1 * row1[each + b]
            if pc >= 0:
                for a in range(3):
                    s0, s1 = w * row0[p + a], w * row1[p + a]
                    g[pc + a] += row0[p + a] * r0 + row1[p + a] * r1
                    to = U[pc + a]
                    for b in range(n):
                        to[cc + b] += s0 * row0[b] + s1 * row1[b]
                    for b in range(poses):
                        to[ic + b] += s0 * row0[each + b] + s1 * row1[each + b]
                    for b in range(a + 1):
                        to[pc + b] += s0 * row0[p + b] + s1 * row1[p + b]
            elif pc == ELIMINATED:
                for a in range(3):
                    s0, s1 = w * row0[p + a], w * row1[p + a]
                    h[j, a] += row0[p + a] * r0 + row1[p + a] * r1
                    for b in range(3):
                        V[j, a, b] += s0 * row0[p + b] + s1 * row1[p + b]


@jit
def gradients(residual: Array, linear: Linear, at: Incidence, g: Array, h: Array) -> None:
    """Add the right sides alone: g of the reduced unknowns, h (points, 3) of the eliminated points."""
    jacobian, weight = linear
    image, first, camera_of, camera_col, camera_count = at.image, at.first, at.camera_of, at.camera_col, at.camera_count
    image_col, point_col = at.image_col, at.point_col
    each = camera_count.max()
    p = jacobian.shape[2] - 3
    for j in range(len(first) - 1):
        for i in range(first[j], first[j + 1]):
            r0, r1 = weight[i] * residual[i, 0], weight[i] * residual[i, 1]
            k = camera_of[image[i]]
            row0, row1 = jacobian[i, 0], jacobian[i, 1]
            for a in range(camera_count[k]):
                g[camera_col[k] + a] += row0[a] * r0 + row1[a] * r1
            for a in range(each, p):
                g[image_col[image[i]] + a - each] += row0[a] * r0 + row1[a] * r1
            for a in range(3):
                value = row0[p + a] * r0 + row1[p + a] * r1
                if point_col[j] >= 0:
                    g[point_col[j] + a] += value
                elif point_col[j] == ELIMINATED:
                    h[j, a] += value


@jit
def roots(V: Array, point_col: Ints, root: Array) -> Array:
    """L⁻¹ of V = L Lᵀ for the eliminated points; returns for each the smallest ratio of a pivot to its diagonal."""
    pivot = np.ones(len(V))
    for j in range(len(V)):
        if point_col[j] != ELIMINATED:
            continue
        a00, a10, a20, a11, a21, a22 = V[j, 0, 0], V[j, 1, 0], V[j, 2, 0], V[j, 1, 1], V[j, 2, 1], V[j, 2, 2]
        if not (a00 > 0.0 and a11 > 0.0 and a22 > 0.0):
            pivot[j] = 0.0
            continue
        l00 = np.sqrt(a00)
        l10, l20 = a10 / l00, a20 / l00
        p1 = a11 - l10 * l10
        if not p1 > 0.0:
            pivot[j] = 0.0
            continue
        l11 = np.sqrt(p1)
        l21 = (a21 - l20 * l10) / l11
        p2 = a22 - l20 * l20 - l21 * l21
        pivot[j] = min(p1 / a11, p2 / a22)
        if not p2 > 0.0:
            pivot[j] = 0.0
            continue
        l22 = np.sqrt(p2)
        root[j, 0, 0], root[j, 1, 1], root[j, 2, 2] = 1.0 / l00, 1.0 / l11, 1.0 / l22
        root[j, 1, 0] = -l10 / (l00 * l11)
        root[j, 2, 1] = -l21 / (l11 * l22)
        root[j, 2, 0] = (l10 * l21 / l11 - l20) / (l00 * l22)
    return pivot


@jit
def condense(linear: Linear, at: Incidence, root: Array, Z: Eliminated) -> None:
    """Write Z of the eliminated points."""
    jacobian, weight = linear
    of_images, of_cameras = Z
    image, first, camera_of, camera_col, camera_count = at.image, at.first, at.camera_of, at.camera_col, at.camera_count
    point_col = at.point_col
    each = camera_count.max()
    poses = of_images.shape[2]
    p = each + poses
    for j in range(len(first) - 1):
        if point_col[j] != ELIMINATED:
            continue
        r = root[j]
        cameras = of_cameras[j]
        for i in range(first[j], first[j + 1]):
            w = weight[i]
            if w == 0.0:
                continue
            row0, row1 = jacobian[i, 0], jacobian[i, 1]
            u0, u1, u2 = w * row0[p], w * row0[p + 1], w * row0[p + 2]
            v0, v1, v2 = w * row1[p], w * row1[p + 1], w * row1[p + 2]
            a0, b0 = r[0, 0] * u0, r[0, 0] * v0
            a1, b1 = r[1, 0] * u0 + r[1, 1] * u1, r[1, 0] * v0 + r[1, 1] * v1
            a2 = r[2, 0] * u0 + r[2, 1] * u1 + r[2, 2] * u2
            b2 = r[2, 0] * v0 + r[2, 1] * v1 + r[2, 2] * v2
            k = camera_of[image[i]]
            cc = camera_col[k]
            for a in range(camera_count[k]):
                cameras[0, cc + a] += row0[a] * a0 + row1[a] * b0
                cameras[1, cc + a] += row0[a] * a1 + row1[a] * b1
                cameras[2, cc + a] += row0[a] * a2 + row1[a] * b2
            own = of_images[i]
            for a in range(poses):
                own[0, a] = row0[each + a] * a0 + row1[each + a] * b0
                own[1, a] = row0[each + a] * a1 + row1[each + a] * b1
                own[2, a] = row0[each + a] * a2 + row1[each + a] * b2


@jit
def reduce_pairs(Z: Eliminated, by_image: Ints, at: Incidence, S: Array) -> None:
    """Subtract Z Zᵀ from the rows of the images, pair of image points by pair; image after image, so that its rows stay at hand."""
    of_images, of_cameras = Z
    image, point, first, image_col = at.image, at.point, at.first, at.image_col
    poses, interior = of_images.shape[2], of_cameras.shape[2]
    for i in by_image:
        row, j = image_col[image[i]], point[i]
        for a in range(poses):
            z0, z1, z2 = of_images[i, 0, a], of_images[i, 1, a], of_images[i, 2, a]
            for b in range(interior):
                S[row + a, b] -= z0 * of_cameras[j, 0, b] + z1 * of_cameras[j, 1, b] + z2 * of_cameras[j, 2, b]
        for k in range(first[j], first[j + 1]):
            if image[k] > image[i]:
                break
            col = image_col[image[k]]
            if poses == 6:  # loops of a length that the compiler knows take half the time
                for a in range(6):
                    z0, z1, z2 = of_images[i, 0, a], of_images[i, 1, a], of_images[i, 2, a]
                    for b in range(6):
                        S[row + a, col + b] -= z0 * of_images[k, 0, b] + z1 * of_images[k, 1, b] + z2 * of_images[k, 2, b]
            else:
                for a in range(poses):
                    z0, z1, z2 = of_images[i, 0, a], of_images[i, 1, a], of_images[i, 2, a]
                    for b in range(poses):
                        S[row + a, col + b] -= z0 * of_images[k, 0, b] + z1 * of_images[k, 1, b] + z2 * of_images[k, 2, b]


@jit
def spread(which: Ints, Z: Eliminated, at: Incidence, out: Array) -> None:
    """Write Z of the points ``which`` into the zeroed rows of ``out`` (3 points, unknowns)."""
    of_images, of_cameras = Z
    image, first, image_col = at.image, at.first, at.image_col
    for n in range(len(which)):
        j = which[n]
        for c in range(3):
            row = out[3 * n + c]
            for a in range(of_cameras.shape[2]):
                row[a] = of_cameras[j, c, a]
            for i in range(first[j], first[j + 1]):
                col = image_col[image[i]]
                for a in range(of_images.shape[2]):
                    row[col + a] += of_images[i, c, a]


@jit
def point_steps(linear: Linear, at: Incidence, root: Array, h: Array, step: Array, out: Array) -> None:
    """Unknowns of the eliminated points from those of the reduced system, for several right-hand sides: V⁻¹ (h − Wᵀ step).

    ``h`` (points, 3, s), ``step`` (unknowns, s), ``out`` (points, 3, s).
    """
    jacobian, weight = linear
    image, first, camera_of, camera_col, camera_count = at.image, at.first, at.camera_of, at.camera_col, at.camera_count
    image_col, point_col = at.image_col, at.point_col
    each = camera_count.max()
    p = jacobian.shape[2] - 3
    rest = np.empty(3)
    for j in range(len(first) - 1):
        if point_col[j] != ELIMINATED:
            continue
        r = root[j]
        for s in range(step.shape[1]):
            for c in range(3):
                rest[c] = h[j, c, s]
            for i in range(first[j], first[j + 1]):
                w = weight[i]
                if w == 0.0:
                    continue
                k = camera_of[image[i]]
                cc, ic = camera_col[k], image_col[image[i]]
                row0, row1 = jacobian[i, 0], jacobian[i, 1]
                t0, t1 = 0.0, 0.0
                for a in range(camera_count[k]):
                    t0 += row0[a] * step[cc + a, s]
                    t1 += row1[a] * step[cc + a, s]
                for a in range(p - each):
                    t0 += row0[each + a] * step[ic + a, s]
                    t1 += row1[each + a] * step[ic + a, s]
                for c in range(3):
                    rest[c] -= w * (row0[p + c] * t0 + row1[p + c] * t1)
            t0, t1 = r[0, 0] * rest[0], r[1, 0] * rest[0] + r[1, 1] * rest[1]
            t2 = r[2, 0] * rest[0] + r[2, 1] * rest[1] + r[2, 2] * rest[2]
            out[j, 0, s] = r[0, 0] * t0 + r[1, 0] * t1 + r[2, 0] * t2
            out[j, 1, s] = r[1, 1] * t1 + r[2, 1] * t2
            out[j, 2, s] = r[2, 2] * t2


@jit(fastmath=SUMS)
def quadratic(Z: Eliminated, by_image: Ints, at: Incidence, Q: Array, T: Array) -> None:
    """Add Z Q Zᵀ (points, 3, 3) to T as half of a sum with its own transpose, from the rows of the images in Q.

    What lies between cameras is left to the caller.
    """
    of_images, of_cameras = Z
    image, point, first, image_col = at.image, at.point, at.first, at.image_col
    poses, interior = of_images.shape[2], of_cameras.shape[2]
    g = np.empty((3, poses))
    for i in by_image:
        row, j = image_col[image[i]], point[i]
        for a in range(poses):
            s0, s1, s2 = 0.0, 0.0, 0.0
            for b in range(interior):
                q = Q[row + a, b]
                s0 += q * of_cameras[j, 0, b]
                s1 += q * of_cameras[j, 1, b]
                s2 += q * of_cameras[j, 2, b]
            g[0, a], g[1, a], g[2, a] = s0, s1, s2
        for k in range(first[j], first[j + 1]):
            if image[k] > image[i]:
                break
            col, share = image_col[image[k]], (0.5 if image[k] == image[i] else 1.0)
            for a in range(poses):
                s0, s1, s2 = 0.0, 0.0, 0.0
                for b in range(poses):
                    q = share * Q[row + a, col + b]
                    s0 += q * of_images[k, 0, b]
                    s1 += q * of_images[k, 1, b]
                    s2 += q * of_images[k, 2, b]
                g[0, a] += s0
                g[1, a] += s1
                g[2, a] += s2
        for c in range(3):
            for d in range(3):
                total = 0.0
                for a in range(poses):
                    total += of_images[i, c, a] * g[d, a]
                T[j, c, d] += total


@jit(fastmath=SUMS)
def products(which: Ints, Z: Eliminated, at: Incidence, Q: Array, G: Array) -> None:
    """Write Zᵀ Q of the points ``which`` into ``G`` (3 points, unknowns), for the unknowns of cameras and of images that see the point."""
    of_images, of_cameras = Z
    image, first, image_col = at.image, at.first, at.image_col
    poses, interior = of_images.shape[2], of_cameras.shape[2]
    for n in range(len(which)):
        j = which[n]
        for i in range(first[j] - 1, first[j + 1]):
            begin, rows = (0, interior) if i < first[j] else (image_col[image[i]], poses)
            for a in range(rows):
                row = Q[begin + a]
                s0, s1, s2 = 0.0, 0.0, 0.0
                for b in range(interior):
                    s0 += row[b] * of_cameras[j, 0, b]
                    s1 += row[b] * of_cameras[j, 1, b]
                    s2 += row[b] * of_cameras[j, 2, b]
                for k in range(first[j], first[j + 1]):
                    col = image_col[image[k]]
                    for b in range(poses):
                        q = row[col + b]
                        s0 += q * of_images[k, 0, b]
                        s1 += q * of_images[k, 1, b]
                        s2 += q * of_images[k, 2, b]
                G[3 * n, begin + a], G[3 * n + 1, begin + a], G[3 * n + 2, begin + a] = s0, s1, s2


@jit
def residual_cofactors(linear: Linear, at: Incidence, place: Ints, root: Array, cofactor: Array, Q: Array, G: Array, own: Array) -> None:
    """2 × 2 matrices J Qxx Jᵀ of whitened image coordinates, shape (n, 3) for xx, xy, yy, in units of their own weight.

    ``place[i]``: row block of its point in ``G`` = Zᵀ Q (3 points, unknowns), −1 where the point is not eliminated and −2 to pass it over.
    """
    jacobian, weight = linear
    image, point, camera_of, camera_col, camera_count = at.image, at.point, at.camera_of, at.camera_col, at.camera_count
    image_col, point_col = at.image_col, at.point_col
    each = camera_count.max()
    p = jacobian.shape[2] - 3
    poses = p - each
    columns = np.empty(each + poses + 3, np.int64)
    values = np.empty((2, each + poses + 3))
    for i in range(len(image)):
        if place[i] == -2:
            continue
        j, k = point[i], camera_of[image[i]]
        root_w = np.sqrt(weight[i]) if weight[i] > 0.0 else 1.0
        count = 0
        for a in range(camera_count[k]):
            columns[count] = camera_col[k] + a
            values[0, count], values[1, count] = root_w * jacobian[i, 0, a], root_w * jacobian[i, 1, a]
            count += 1
        for a in range(poses):
            columns[count] = image_col[image[i]] + a
            values[0, count], values[1, count] = root_w * jacobian[i, 0, each + a], root_w * jacobian[i, 1, each + a]
            count += 1
        if point_col[j] >= 0:
            for a in range(3):
                columns[count] = point_col[j] + a
                values[0, count], values[1, count] = root_w * jacobian[i, 0, p + a], root_w * jacobian[i, 1, p + a]
                count += 1
        xx, xy, yy = 0.0, 0.0, 0.0
        for a in range(count):
            row = Q[columns[a]]
            s0, s1 = 0.0, 0.0
            for b in range(count):
                q = row[columns[b]]
                s0 += q * values[0, b]
                s1 += q * values[1, b]
            xx += values[0, a] * s0
            xy += values[0, a] * s1
            yy += values[1, a] * s1
        if place[i] >= 0:
            r, block = root[j], place[i]
            for c in range(3):
                s0, s1 = 0.0, 0.0  # rows of A (Q Z), of the image coordinate's reduced unknowns
                for a in range(count):
                    s0 += values[0, a] * G[3 * block + c, columns[a]]
                    s1 += values[1, a] * G[3 * block + c, columns[a]]
                e0, e1 = 0.0, 0.0  # L⁻¹ Jpᵀ
                for b in range(c + 1):
                    e0 += r[c, b] * root_w * jacobian[i, 0, p + b]
                    e1 += r[c, b] * root_w * jacobian[i, 1, p + b]
                xx -= 2.0 * s0 * e0
                xy -= s0 * e1 + s1 * e0
                yy -= 2.0 * s1 * e1
            w = root_w * root_w
            for a in range(3):
                for b in range(3):
                    q = w * cofactor[j, a, b]
                    xx += q * jacobian[i, 0, p + a] * jacobian[i, 0, p + b]
                    xy += q * jacobian[i, 0, p + a] * jacobian[i, 1, p + b]
                    yy += q * jacobian[i, 1, p + a] * jacobian[i, 1, p + b]
        own[i, 0], own[i, 1], own[i, 2] = xx, xy, yy


@jit
def from_points(linear: Linear, at: Incidence, values: Array, out: Array) -> None:
    """Subtract W ``values`` from ``out`` (unknowns, s), for ``values`` (points, 3, s) of the eliminated points."""
    jacobian, weight = linear
    image, first, camera_of, camera_col, camera_count = at.image, at.first, at.camera_of, at.camera_col, at.camera_count
    image_col, point_col = at.image_col, at.point_col
    each = camera_count.max()
    p = jacobian.shape[2] - 3
    for j in range(len(first) - 1):
        if point_col[j] != ELIMINATED:
            continue
        for i in range(first[j], first[j + 1]):
            w = weight[i]
            if w == 0.0:
                continue
            k = camera_of[image[i]]
            cc, ic = camera_col[k], image_col[image[i]]
            row0, row1 = jacobian[i, 0], jacobian[i, 1]
            for s in range(values.shape[2]):
                t0, t1 = 0.0, 0.0
                for c in range(3):
                    t0 += w * row0[p + c] * values[j, c, s]
                    t1 += w * row1[p + c] * values[j, c, s]
                for a in range(camera_count[k]):
                    out[cc + a, s] -= row0[a] * t0 + row1[a] * t1
                for a in range(p - each):
                    out[ic + a, s] -= row0[each + a] * t0 + row1[each + a] * t1


@jit
def scaled_whole(lower: Array, scale: Array) -> None:
    """Scale rows and columns of a symmetric matrix and write its lower triangle into the upper, in place, tile by tile."""
    n, tile = len(lower), 64
    for i0 in range(0, n, tile):
        for j0 in range(0, i0 + 1, tile):
            for i in range(i0, min(i0 + tile, n)):
                for j in range(j0, min(j0 + tile, i + 1)):
                    value = lower[i, j] * scale[i] * scale[j]
                    lower[i, j] = value
                    lower[j, i] = value


@jit
def scaled_lower(lower: Array, scale: Array) -> None:
    """Scale rows and columns of the lower triangle of a matrix, in place."""
    for i in range(len(lower)):
        row, own = lower[i], scale[i]
        for j in range(i + 1):
            row[j] *= own * scale[j]
