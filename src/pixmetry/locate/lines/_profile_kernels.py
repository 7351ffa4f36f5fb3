"""Kernels of straight profiles: steps, lines and bars, blurred by a Gaussian and averaged over the square pixel.

A straight structure depends on the distance d across it only. The pixel's square, projected on that direction, is a trapezoid: the
convolution of two boxes as wide as the pixel's sides times the direction's cosines. The average of a function over it is a second
difference of the function's second integral, so everything here is exact for every angle.
"""

from __future__ import annotations

import math

from pixmetry.core._normal_kernels import LIMIT, ROOT, both, cdf, pdf
from pixmetry.core.jit import jit

EDGE, GAUSSIAN, BAR = 0, 1, 2  # sections: a blurred step; a Gaussian; a bar of some width, blurred
THIN = 0.05  # a box narrower than this (px) acts as its variance (error below 1e-7 of the height)


@jit
def step(d: float, s: float, a: float, b: float) -> tuple[float, float, float, float]:
    """Return a blurred step, 0 at d = −∞ and 1 at ∞, averaged over boxes of widths a ≥ b, and its first three derivatives in d.

    Its derivative with respect to s is s times the second derivative in d (heat equation).
    """
    if b < THIN:
        s = math.sqrt(s * s + b * b / 12.0)
        if a < THIN:
            s = math.sqrt(s * s + a * a / 12.0)
            z = d / s
            f = pdf(z)
            return cdf(z), f / s, -z * f / (s * s), (z * z - 1.0) * f / (s * s * s)
        z, y = (d + 0.5 * a) / s, (d - 0.5 * a) / s
        if y > LIMIT:
            return 1.0, 0.0, 0.0, 0.0
        if z < -LIMIT:
            return 0.0, 0.0, 0.0, 0.0
        cz, fz = both(z)
        cy, fy = both(y)
        return s * (z * cz + fz - y * cy - fy) / a, (cz - cy) / a, (fz - fy) / (s * a), (y * fy - z * fz) / (s * s * a)
    if d - 0.5 * (a + b) > LIMIT * s:
        return 1.0, 0.0, 0.0, 0.0
    if d + 0.5 * (a + b) < -LIMIT * s:
        return 0.0, 0.0, 0.0, 0.0
    e0, e1, e2, e3 = 0.0, 0.0, 0.0, 0.0
    for k in range(4):
        sign = 1.0 if k == 0 or k == 3 else -1.0
        z = (d + (0.5 * a if k < 2 else -0.5 * a) + (0.5 * b if k % 2 == 0 else -0.5 * b)) / s
        c, f = both(z)
        e0 += sign * 0.5 * ((z * z + 1.0) * c + z * f)
        e1 += sign * (z * c + f)
        e2 += sign * c
        e3 += sign * f
    n = 1.0 / (a * b)
    return e0 * s * s * n, e1 * s * n, e2 * n, e3 * n / s


@jit
def profile(section: int, d: float, s: float, w: float, a: float, b: float) -> tuple[float, float, float, float]:
    """Return the height of a section, its slope in d, and its derivatives with respect to s and w.

    The step rises from 0 to 1; the Gaussian is 1 at its middle before the pixel's average, the bar before its blur.
    """
    if section == EDGE:
        e0, e1, e2, _ = step(d, s, a, b)
        return e0, e1, s * e2, 0.0
    if section == GAUSSIAN:
        _, e1, e2, e3 = step(d, s, a, b)
        k = s / ROOT
        return k * e1, k * e2, (e1 + s * s * e3) / ROOT, 0.0
    p0, p1, p2, _ = step(d + 0.5 * w, s, a, b)
    m0, m1, m2, _ = step(d - 0.5 * w, s, a, b)
    return p0 - m0, p1 - m1, s * (p2 - m2), 0.5 * (p1 + m1)
