"""The camera models point by point: an ideal projection, and Brown's polynomial with affinity and shear, in both directions, with its
derivatives; and the centre of area of the image of a flat target, by integrals along its outline.

Interior parameters are a row of `INTERIOR` numbers: c, xp, yp, b1, b2, p1, p2, k1 … k5, d1 … d3, s1 … s4. Length units are those of the
image plane: millimetres, or pixels where no pitch is known. The form of a lens is its direction, plus 2 for each projection.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pixmetry.core.arrays import Array, Ints
from pixmetry.core.jit import jit

INTERIOR = 19
DENOMINATOR, PRISM = 12, 15  # places of d1 and of s1
IMAGE_TO_OBJECT, OBJECT_TO_IMAGE = 0, 1
PERSPECTIVE, EQUIDISTANT, EQUISOLID, STEREOGRAPHIC, ORTHOGRAPHIC = range(5)
NEAR_AXIS = 1e-4  # tan θ below which projections are taken by their series
NEWTON_STEPS = 30


class Lens(NamedTuple):
    """Interior orientation of one camera."""

    values: Array  # (INTERIOR,)
    form: int  # of the distortion `IMAGE_TO_OBJECT` or `OBJECT_TO_IMAGE`, and twice the projection
    mx: float  # length units per pixel along x, and
    my: float  # along y


class Cameras(NamedTuple):
    """Interior orientations of all cameras."""

    values: Array  # (cameras, INTERIOR)
    form: Ints  # (cameras,)
    per_px: Array  # (cameras, 2): length units per pixel along x and y


class Views(NamedTuple):
    """Where the images stand: a point X is seen at R (X − X₀)."""

    rotation: Array  # (images, 3, 3)
    position: Array  # (images, 3)


class Targets(NamedTuple):
    """Flat targets, each as one image sees it."""

    image: Ints  # (n,)
    camera: Ints  # (n,): of this image
    xyz: Array  # (n, 3): their centres
    first: Array  # (n, 3): unit vectors in their planes
    second: Array  # (n, 3): across these
    size: Array  # (n,): what one unit of an outline is in the object


class Outline(NamedTuple):
    """Nodes of a quadrature along the outline of a target."""

    place: Array  # (m, 2)
    tangent: Array  # (m, 2): the weighted steps along it


@jit
def corrected(a: float, b: float, q: Array, slopes: Array) -> tuple[float, float]:
    """Brown's polynomial at (a, b), with affinity and shear; ``slopes`` takes d(a', b')/d(a, b), flat of 4.

    a' = a (1 + b1 + radial) + b2 b + p1 (r² + 2 a²) + 2 p2 a b + s1 r² + s2 r⁴;
    b' = b (1 + radial) + p2 (r² + 2 b²) + 2 p1 a b + s3 r² + s4 r⁴;  1 + radial = (1 + k1 r² + …)/(1 + d1 r² + d2 r⁴ + d3 r⁶).
    """
    b1, b2, p1, p2 = q[3], q[4], q[5], q[6]
    r2 = a * a + b * b
    radial, slope, _ = radial_part(r2, q)
    prism_a, prism_b = q[15] + 2.0 * r2 * q[16], q[17] + 2.0 * r2 * q[18]  # derivatives by r²
    slopes[0] = 1.0 + b1 + radial + 2.0 * a * a * slope + 6.0 * p1 * a + 2.0 * p2 * b + 2.0 * a * prism_a
    slopes[1] = b2 + 2.0 * a * b * slope + 2.0 * p1 * b + 2.0 * p2 * a + 2.0 * b * prism_a
    slopes[2] = 2.0 * a * b * slope + 2.0 * p2 * a + 2.0 * p1 * b + 2.0 * a * prism_b
    slopes[3] = 1.0 + radial + 2.0 * b * b * slope + 6.0 * p2 * b + 2.0 * p1 * a + 2.0 * b * prism_b
    ideal_a = a * (1.0 + b1 + radial) + b2 * b + p1 * (r2 + 2.0 * a * a) + 2.0 * p2 * a * b + r2 * (q[15] + r2 * q[16])
    ideal_b = b * (1.0 + radial) + p2 * (r2 + 2.0 * b * b) + 2.0 * p1 * a * b + r2 * (q[17] + r2 * q[18])
    return ideal_a, ideal_b


@jit
def radial_part(r2: float, q: Array) -> tuple[float, float, float]:
    """(1 + Σ k rⁿ)/(1 + Σ d rⁿ) − 1, its derivative by r², and 1 over its denominator; NaN where that is not above 0."""
    above = r2 * (q[7] + r2 * (q[8] + r2 * (q[9] + r2 * (q[10] + r2 * q[11]))))
    above_slope = q[7] + r2 * (2.0 * q[8] + r2 * (3.0 * q[9] + r2 * (4.0 * q[10] + r2 * 5.0 * q[11])))
    if q[12] == 0.0 and q[13] == 0.0 and q[14] == 0.0:
        return above, above_slope, 1.0
    below = 1.0 + r2 * (q[12] + r2 * (q[13] + r2 * q[14]))
    if not below > 0.0:
        return np.nan, np.nan, np.nan
    below_slope = q[12] + r2 * (2.0 * q[13] + r2 * 3.0 * q[14])
    return (1.0 + above) / below - 1.0, (above_slope - (1.0 + above) / below * below_slope) / below, 1.0 / below


@jit
def projected_radius(tangent: float, projection: int) -> tuple[float, float]:
    """Ideal distance from the principal point, for c = 1, of a ray of this tan θ, and its derivative by tan θ.

    tan θ perspective, θ equidistant, 2 sin θ/2 equisolid, 2 tan θ/2 stereographic, sin θ orthographic (C. Hughes et al., Applied Optics
    49 (2010) 3338–3347).
    """
    theta, turn = np.arctan(tangent), 1.0 / (1.0 + tangent * tangent)
    if projection == EQUIDISTANT:
        return theta, turn
    if projection == EQUISOLID:
        return 2.0 * np.sin(theta / 2.0), np.cos(theta / 2.0) * turn
    if projection == STEREOGRAPHIC:
        return 2.0 * np.tan(theta / 2.0), turn / np.cos(theta / 2.0) ** 2
    if projection == ORTHOGRAPHIC:
        return np.sin(theta), np.cos(theta) * turn
    return tangent, 1.0


@jit
def ray_tangent(radius: float, projection: int) -> float:
    """tan θ of an ideal distance for c = 1; NaN from θ = 90° on."""
    theta = np.nan
    if projection == PERSPECTIVE:
        return radius
    if projection == EQUIDISTANT:
        theta = radius
    elif projection == EQUISOLID and radius < 2.0:
        theta = 2.0 * np.arcsin(radius / 2.0)
    elif projection == STEREOGRAPHIC:
        theta = 2.0 * np.arctan(radius / 2.0)
    elif projection == ORTHOGRAPHIC and radius < 1.0:
        theta = np.arcsin(radius)
    return np.tan(theta) if theta < 0.5 * np.pi - 1e-9 else np.nan


@jit
def drawn(u: float, v: float, projection: int, by: Array) -> tuple[float, float]:
    """The ideal image, for c = 1, of the direction (u, v); ``by`` takes its derivatives, flat of 4."""
    if projection == PERSPECTIVE:
        by[0], by[1], by[2], by[3] = 1.0, 0.0, 0.0, 1.0
        return u, v
    r2 = u * u + v * v
    r = np.sqrt(r2)
    if r < NEAR_AXIS:  # ρ/r = 1 − k r²
        k = 1.0 / 3.0
        if projection == EQUISOLID:
            k = 3.0 / 8.0
        elif projection == STEREOGRAPHIC:
            k = 0.25
        elif projection == ORTHOGRAPHIC:
            k = 0.5
        share, bend = 1.0 - k * r2, -2.0 * k
    else:
        radius, slope = projected_radius(r, projection)
        share = radius / r
        bend = (slope - share) / r2
    by[0], by[1], by[2], by[3] = share + bend * u * u, bend * u * v, bend * u * v, share + bend * v * v
    return share * u, share * v


@jit
def uncorrected(ideal_a: float, ideal_b: float, a: float, b: float, q: Array, slopes: Array) -> tuple[float, float]:
    """The place (a, b) whose polynomial is (ideal_a, ideal_b), by Newton's method from a first guess; NaN where there is none."""
    scale = 1e-13 * (1.0 + abs(ideal_a) + abs(ideal_b))
    for _ in range(NEWTON_STEPS):
        fa, fb = corrected(a, b, q, slopes)
        fa -= ideal_a
        fb -= ideal_b
        det = slopes[0] * slopes[3] - slopes[1] * slopes[2]
        if not det > 1e-6:
            break
        da = (fa * slopes[3] - fb * slopes[1]) / det
        db = (fb * slopes[0] - fa * slopes[2]) / det
        a -= da
        b -= db
        if abs(da) + abs(db) < scale:
            corrected(a, b, q, slopes)
            return a, b
    return np.nan, np.nan


@jit
def image_point(
    u: float, v: float, lens: Lens, guess_x: float, guess_y: float, by_direction: Array, by_interior: Array
) -> tuple[float, float]:
    """Image of the direction (u, v) = (X/Z, Y/Z), in pixels.

    ``guess_x``, ``guess_y``: pixels near which it lies (NaN if not known). ``by_direction`` takes d(x, y)/d(u, v), shape (2, 2);
    ``by_interior`` takes d(x, y)/d q, shape (2, INTERIOR).
    """
    q, form, mx, my = lens
    c, b1, b2, p1, p2 = q[0], q[3], q[4], q[5], q[6]
    slopes, by_ray = np.empty(4), np.empty(4)
    u, v = drawn(u, v, form // 2, by_ray)
    if form % 2 == IMAGE_TO_OBJECT:
        ideal_a, ideal_b = c * u, c * v
        a = ideal_a if np.isnan(guess_x) else (guess_x - q[1]) * mx
        b = ideal_b if np.isnan(guess_y) else (guess_y - q[2]) * my
        a, b = uncorrected(ideal_a, ideal_b, a, b, q, slopes)
        det = slopes[0] * slopes[3] - slopes[1] * slopes[2]
        # inverse of d ideal / d image, in pixels
        i00, i01, i10, i11 = slopes[3] / det / mx, -slopes[1] / det / mx, -slopes[2] / det / my, slopes[0] / det / my
        chained(c * i00, c * i01, c * i10, c * i11, by_ray, by_direction)
        by_interior[0, 0], by_interior[1, 0] = i00 * u + i01 * v, i10 * u + i11 * v
        by_interior[0, 1], by_interior[1, 1] = 1.0, 0.0
        by_interior[0, 2], by_interior[1, 2] = 0.0, 1.0
        by_interior[0, 3], by_interior[1, 3] = -i00 * a, -i10 * a
        by_interior[0, 4], by_interior[1, 4] = -i00 * b, -i10 * b
        r2 = a * a + b * b
        da, db = r2 + 2.0 * a * a, 2.0 * a * b
        by_interior[0, 5], by_interior[1, 5] = -(i00 * da + i01 * db), -(i10 * da + i11 * db)
        da, db = 2.0 * a * b, r2 + 2.0 * b * b
        by_interior[0, 6], by_interior[1, 6] = -(i00 * da + i01 * db), -(i10 * da + i11 * db)
        radial, _, share = radial_part(r2, q)
        power = r2 * share
        for k in range(7, DENOMINATOR):
            by_interior[0, k], by_interior[1, k] = -power * (i00 * a + i01 * b), -power * (i10 * a + i11 * b)
            power *= r2
        power = -r2 * share * (1.0 + radial)
        for k in range(DENOMINATOR, PRISM):
            by_interior[0, k], by_interior[1, k] = -power * (i00 * a + i01 * b), -power * (i10 * a + i11 * b)
            power *= r2
        by_interior[0, 15], by_interior[1, 15] = -i00 * r2, -i10 * r2
        by_interior[0, 16], by_interior[1, 16] = -i00 * r2 * r2, -i10 * r2 * r2
        by_interior[0, 17], by_interior[1, 17] = -i01 * r2, -i11 * r2
        by_interior[0, 18], by_interior[1, 18] = -i01 * r2 * r2, -i11 * r2 * r2
        return q[1] + a / mx, q[2] + b / my

    r2 = u * u + v * v
    radial, slope, share = radial_part(r2, q)
    prism_a, prism_b = q[15] + 2.0 * r2 * q[16], q[17] + 2.0 * r2 * q[18]
    a = u * (1.0 + radial) + p1 * (r2 + 2.0 * u * u) + 2.0 * p2 * u * v + r2 * (q[15] + r2 * q[16])
    b = v * (1.0 + radial) + p2 * (r2 + 2.0 * v * v) + 2.0 * p1 * u * v + r2 * (q[17] + r2 * q[18])
    au = 1.0 + radial + 2.0 * u * u * slope + 6.0 * p1 * u + 2.0 * p2 * v + 2.0 * u * prism_a
    av = 2.0 * u * v * slope + 2.0 * p1 * v + 2.0 * p2 * u + 2.0 * v * prism_a
    bu = 2.0 * u * v * slope + 2.0 * p2 * u + 2.0 * p1 * v + 2.0 * u * prism_b
    bv = 1.0 + radial + 2.0 * v * v * slope + 6.0 * p2 * v + 2.0 * p1 * u + 2.0 * v * prism_b
    fx, fy, skew = c * (1.0 + b1) / mx, c / my, c * b2 / mx
    chained(fx * au + skew * bu, fx * av + skew * bv, fy * bu, fy * bv, by_ray, by_direction)
    by_interior[0, 0], by_interior[1, 0] = ((1.0 + b1) * a + b2 * b) / mx, b / my
    by_interior[0, 1], by_interior[1, 1] = 1.0, 0.0
    by_interior[0, 2], by_interior[1, 2] = 0.0, 1.0
    by_interior[0, 3], by_interior[1, 3] = c * a / mx, 0.0
    by_interior[0, 4], by_interior[1, 4] = c * b / mx, 0.0
    da, db = r2 + 2.0 * u * u, 2.0 * u * v
    by_interior[0, 5], by_interior[1, 5] = fx * da + skew * db, fy * db
    da, db = 2.0 * u * v, r2 + 2.0 * v * v
    by_interior[0, 6], by_interior[1, 6] = fx * da + skew * db, fy * db
    power = r2 * share
    for k in range(7, DENOMINATOR):
        by_interior[0, k], by_interior[1, k] = power * (fx * u + skew * v), power * fy * v
        power *= r2
    power = -r2 * share * (1.0 + radial)
    for k in range(DENOMINATOR, PRISM):
        by_interior[0, k], by_interior[1, k] = power * (fx * u + skew * v), power * fy * v
        power *= r2
    by_interior[0, 15], by_interior[1, 15], by_interior[0, 16], by_interior[1, 16] = fx * r2, 0.0, fx * r2 * r2, 0.0
    by_interior[0, 17], by_interior[1, 17], by_interior[0, 18], by_interior[1, 18] = skew * r2, fy * r2, skew * r2 * r2, fy * r2 * r2
    return q[1] + fx * a + skew * b, q[2] + fy * b


@jit
def chained(m00: float, m01: float, m10: float, m11: float, by_ray: Array, out: Array) -> None:
    """A matrix times the derivatives of `drawn`."""
    out[0, 0], out[0, 1] = m00 * by_ray[0] + m01 * by_ray[2], m00 * by_ray[1] + m01 * by_ray[3]
    out[1, 0], out[1, 1] = m10 * by_ray[0] + m11 * by_ray[2], m10 * by_ray[1] + m11 * by_ray[3]


@jit
def image_points(u: Array, v: Array, lens: Lens) -> tuple[Array, Array, Array, Array]:
    """Images of many directions, with derivatives: x, y of shape (n,), (n, 2, 2) by direction, (n, 2, INTERIOR) by interior."""
    n = len(u)
    x, y = np.empty(n), np.empty(n)
    by_direction, by_interior = np.empty((n, 2, 2)), np.empty((n, 2, INTERIOR))
    for i in range(n):
        x[i], y[i] = image_point(u[i], v[i], lens, np.nan, np.nan, by_direction[i], by_interior[i])
    return x, y, by_direction, by_interior


@jit
def directions(x: Array, y: Array, lens: Lens) -> tuple[Array, Array, Array]:
    """Directions (X/Z, Y/Z) in which pixels look, with derivatives: u, v of shape (n,), (n, 2, 2) by the pixel; NaN where there is none."""
    q, form, mx, my = lens
    n, projection = len(x), form // 2
    u, v, by_pixel = np.empty(n), np.empty(n), np.empty((n, 2, 2))
    slopes, by_ray, plain = np.empty(4), np.empty(4), q.copy()
    plain[3] = plain[4] = 0.0  # affinity and shear act after the polynomial where it goes from object to image
    for i in range(n):
        a, b = (x[i] - q[1]) * mx / q[0], (y[i] - q[2]) * my / q[0]
        if form % 2 == IMAGE_TO_OBJECT:
            u[i], v[i] = corrected(a * q[0], b * q[0], q, slopes)
            u[i] /= q[0]
            v[i] /= q[0]
            by_pixel[i, 0, 0], by_pixel[i, 0, 1] = slopes[0] * mx / q[0], slopes[1] * my / q[0]
            by_pixel[i, 1, 0], by_pixel[i, 1, 1] = slopes[2] * mx / q[0], slopes[3] * my / q[0]
        else:
            a = (a - q[4] * b) / (1.0 + q[3])
            u[i], v[i] = uncorrected(a, b, a, b, plain, slopes)
            det = slopes[0] * slopes[3] - slopes[1] * slopes[2]
            ax, ay, by = mx / q[0] / (1.0 + q[3]), -q[4] * my / q[0] / (1.0 + q[3]), my / q[0]
            by_pixel[i, 0, 0], by_pixel[i, 0, 1] = slopes[3] / det * ax, (slopes[3] * ay - slopes[1] * by) / det
            by_pixel[i, 1, 0], by_pixel[i, 1, 1] = -slopes[2] / det * ax, (slopes[0] * by - slopes[2] * ay) / det
        if projection != PERSPECTIVE:
            radius = np.sqrt(u[i] * u[i] + v[i] * v[i])
            share = ray_tangent(radius, projection) / radius if radius > 0.0 else 1.0
            u[i] *= share
            v[i] *= share
            drawn(u[i], v[i], projection, by_ray)
            det = by_ray[0] * by_ray[3] - by_ray[1] * by_ray[2]
            s00, s01, s10, s11 = by_pixel[i, 0, 0], by_pixel[i, 0, 1], by_pixel[i, 1, 0], by_pixel[i, 1, 1]
            by_pixel[i, 0, 0], by_pixel[i, 0, 1] = (by_ray[3] * s00 - by_ray[1] * s10) / det, (by_ray[3] * s01 - by_ray[1] * s11) / det
            by_pixel[i, 1, 0], by_pixel[i, 1, 1] = (by_ray[0] * s10 - by_ray[2] * s00) / det, (by_ray[0] * s11 - by_ray[2] * s01) / det
    return u, v, by_pixel


@jit
def area_centres(targets: Targets, views: Views, cameras: Cameras, outline: Outline) -> Array:
    """Shift of the centre of area against the image of the centre, px, shape (n, 2); NaN where the outline has no image.

    By Green's theorem the area is ½ ∮ (x dy − y dx) and its moments are ½ ∮ x² dy and −½ ∮ y² dx, here about the image of the centre.
    """
    image, camera, xyz, first, second, size = targets
    rotation, position = views
    place, tangent = outline
    n, m = len(size), len(place)
    shift = np.full((n, 2), np.nan)
    by_direction, by_interior = np.empty((2, 2)), np.empty((2, INTERIOR))
    centre, e, f, p, t = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(n):
        j, k = image[i], camera[i]
        lens = Lens(cameras.values[k], cameras.form[k], cameras.per_px[k, 0], cameras.per_px[k, 1])
        for a in range(3):
            centre[a] = e[a] = f[a] = 0.0
            for b in range(3):
                centre[a] += rotation[j, a, b] * (xyz[i, b] - position[j, b])
                e[a] += rotation[j, a, b] * first[i, b] * size[i]
                f[a] += rotation[j, a, b] * second[i, b] * size[i]
        if not centre[2] > 0:
            continue
        x0, y0 = image_point(centre[0] / centre[2], centre[1] / centre[2], lens, np.nan, np.nan, by_direction, by_interior)
        area = moment_x = moment_y = 0.0
        for o in range(m):
            for a in range(3):
                p[a] = centre[a] + place[o, 0] * e[a] + place[o, 1] * f[a]
                t[a] = tangent[o, 0] * e[a] + tangent[o, 1] * f[a]
            if not p[2] > 0:
                area = np.nan
                break
            u, v = p[0] / p[2], p[1] / p[2]
            du, dv = (t[0] - u * t[2]) / p[2], (t[1] - v * t[2]) / p[2]
            x, y = image_point(u, v, lens, x0, y0, by_direction, by_interior)
            dx = by_direction[0, 0] * du + by_direction[0, 1] * dv
            dy = by_direction[1, 0] * du + by_direction[1, 1] * dv
            x -= x0
            y -= y0
            area += 0.5 * (x * dy - y * dx)
            moment_x += 0.5 * x * x * dy
            moment_y -= 0.5 * y * y * dx
        shift[i, 0], shift[i, 1] = moment_x / area, moment_y / area
    return shift
