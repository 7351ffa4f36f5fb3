"""Kernels of a pixel's noise: the law of its variance, and mean and variance at the ends of the scale."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pixmetry.core._linear_algebra_kernels import factor_for, solve
from pixmetry.core._normal_kernels import cdf, pdf
from pixmetry.core.arrays import Array, Flags
from pixmetry.core.jit import jit

CLIP = 6.0  # standard deviations from the scale's ends within which clipping is looked at
LEAST_SHARE = 0.05  # of the variance that clipping leaves: pixels far beyond the end, which say nothing, must not gain weight
LEAST_GROUND = 0.25  # of a block's pixels, without targets, for its noise to be looked at
OUTLIER_SIGMA = 4.0  # beyond which its pixels are left out


class Noise(NamedTuple):
    """A noise model as kernels read it; made by `NoiseModel.numbers`."""

    constant_dn2: float  # variance without light, rounding included
    slope_dn: float  # variance per DN of light
    pattern_rel: float  # standard deviation of the pixels' sensitivity
    black_dn: float
    low_dn: float  # where the scale ends
    high_dn: float
    row_shift_px2: float  # variance of the shift of each row along x by itself
    field_shift_px2: float  # and of what neighbouring rows of a field share


@jit(inline="always")
def variance_of(light: float, noise: Noise) -> float:
    """Variance in DN² of a pixel with so much light above black, in DN: read noise and rounding, shot noise, pattern (EMVA 1288)."""
    pattern = noise.pattern_rel * light
    return noise.constant_dn2 + noise.slope_dn * light + pattern * pattern


@jit(inline="always")
def variance_slope(light: float, noise: Noise) -> float:
    """Derivative of `variance_of` by the light, DN; 0 where there is none."""
    return noise.slope_dn + 2.0 * noise.pattern_rel * noise.pattern_rel * light if light > 0.0 else 0.0


@jit(inline="always")
def variance_at(level: float, noise: Noise) -> float:
    """Variance of a pixel from its own grey value: linear below black too, so that the mean over noisy values has no bias."""
    return max(variance_of(level - noise.black_dn, noise), 0.0)


@jit
def clipped(level: float, variance: float, slope: float, low: float, high: float) -> tuple[float, float, float]:
    """Mean and variance of min(max(level + n, low), high) with normal n, and the mean's derivative; ``slope``: d variance / d level."""
    s = math.sqrt(variance)
    a, b = (low - level) / s, (high - level) / s
    if a < -CLIP and b > CLIP:
        return level, variance, 1.0
    a, b = max(a, -1e6), min(b, 1e6)  # where the scale has no end
    ca, cb, pa, pb = cdf(a), cdf(b), pdf(a), pdf(b)
    below = s * (a * ca + pa)  # E max(low − value, 0)
    above = s * (pb - b * (1.0 - cb))  # E max(value − high, 0)
    mean = level + below - above
    inside = cb - ca
    # second moment of (value − level) after clipping
    second = variance * (inside - (b * pb if b < CLIP else 0.0) + (a * pa if a > -CLIP else 0.0))
    if a > -CLIP:
        second += variance * a * a * ca
    if b < CLIP:
        second += variance * b * b * (1.0 - cb)
    shift = mean - level
    return mean, max(second - shift * shift, LEAST_SHARE * variance), inside + (pa - pb) * slope / (2.0 * s)


@jit
def stored(mean: float, noise: Noise) -> tuple[float, float, float]:
    """Mean and variance of the stored value of a pixel with this mean before the scale's ends, and the slope of the former."""
    light = max(mean - noise.black_dn, 0.0)
    return clipped(mean, variance_of(light, noise), variance_slope(light, noise), noise.low_dn, noise.high_dn)


def variances_dn2(light_dn: NDArray[np.float64], noise: Any) -> NDArray[np.float64]:
    """`variance_of` for an array; ``noise`` is a `Noise` or has its names."""
    law: Callable[..., NDArray[np.float64]] = variance_of.py_func
    return law(light_dn, noise)


@jit
def noise_in_block(block: Array, mask: Flags, low_dn: float, high_dn: float, grain_dn: float) -> bool:
    """Take its plane off a square block, and put 0 outside of the mask, from which outliers are taken; False where it is no ground."""
    side = len(block)
    normal, right, plane, factor = np.zeros((3, 3)), np.zeros(3), np.zeros(3), factor_for(3)
    size, step = np.empty(side * side), 2.0 / (side - 1)
    for _ in range(2):
        normal[:], right[:] = 0.0, 0.0
        n = 0
        for r in range(side):
            y = r * step - 1.0
            for c in range(side):
                if mask[r, c]:
                    x, v = c * step - 1.0, block[r, c]
                    n += 1
                    normal[1, 0] += x
                    normal[2, 0] += y
                    normal[1, 1] += x * x
                    normal[2, 1] += x * y
                    normal[2, 2] += y * y
                    right[0] += v
                    right[1] += v * x
                    right[2] += v * y
        normal[0, 0] = n
        if n < LEAST_GROUND * side * side or not solve(normal, 3, right, 0.0, factor, plane):
            return False
        k = 0
        for r in range(side):
            for c in range(side):
                if mask[r, c]:
                    size[k] = abs(block[r, c] - plane[0] - plane[1] * (c * step - 1.0) - plane[2] * (r * step - 1.0))
                    k += 1
        spread = max(1.4826 * np.median(size[:n]), grain_dn)  # of rounded values the median may be 0
        if spread <= 0.0 or plane[0] - 3.0 * spread < low_dn or plane[0] + 3.0 * spread > high_dn:
            return False
        k = 0
        for r in range(side):
            for c in range(side):
                if mask[r, c]:
                    mask[r, c] = size[k] < OUTLIER_SIGMA * spread
                    k += 1
    for r in range(side):
        for c in range(side):
            off = plane[0] + plane[1] * (c * step - 1.0) + plane[2] * (r * step - 1.0)
            block[r, c] = block[r, c] - off if mask[r, c] else 0.0
    return bool(np.count_nonzero(mask) >= LEAST_GROUND * side * side)
