"""Kernels of the random streams: Philox4x32-10, normal and uniform numbers, Poisson numbers by inversion.

Every number is computed with additions, multiplications, divisions and square roots only (correctly rounded, never fused), so that a
pixel has the same bits wherever it falls in a vector register, a window or a tile.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.arrays import Ints, Singles
from pixmetry.core.jit import jit

CHUNK = 512  # Philox blocks worked on at a time: the scratch stays in the first-level cache

_LOW = np.uint64(0xFFFFFFFF)
_32 = np.uint64(32)
_M0, _M1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0, _W1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)


@jit(forceinline=True)
def _round(
    c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64, k0: np.uint64, k1: np.uint64
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """One round on 32-bit words held in uint64. High halves of c1 and c3 may be invalid; they are masked before use."""
    p0 = _M0 * c0
    p1 = _M1 * c2
    return ((p1 >> _32) ^ c1 ^ k0) & _LOW, p1 & _LOW, ((p0 >> _32) ^ c3 ^ k1) & _LOW, p0 & _LOW


@jit(forceinline=True)
def philox4x32(
    c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64, k0: np.uint64, k1: np.uint64
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Philox4x32-10 of Salmon et al. (2011), "Parallel random numbers: as easy as 1, 2, 3"; 32-bit words held in uint64."""
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, (k0 + _W0) & _LOW, (k1 + _W1) & _LOW)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, (k0 + np.uint64(2) * _W0) & _LOW, (k1 + np.uint64(2) * _W1) & _LOW)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, (k0 + np.uint64(3) * _W0) & _LOW, (k1 + np.uint64(3) * _W1) & _LOW)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, (k0 + np.uint64(4) * _W0) & _LOW, (k1 + np.uint64(4) * _W1) & _LOW)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, (k0 + np.uint64(5) * _W0) & _LOW, (k1 + np.uint64(5) * _W1) & _LOW)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, (k0 + np.uint64(6) * _W0) & _LOW, (k1 + np.uint64(6) * _W1) & _LOW)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, (k0 + np.uint64(7) * _W0) & _LOW, (k1 + np.uint64(7) * _W1) & _LOW)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, (k0 + np.uint64(8) * _W0) & _LOW, (k1 + np.uint64(8) * _W1) & _LOW)
    return _round(c0, c1, c2, c3, (k0 + np.uint64(9) * _W0) & _LOW, (k1 + np.uint64(9) * _W1) & _LOW)


@jit
def _fill_blocks(words: NDArray[np.uint32], key: np.uint64, frame: int, row: int, rows: int, block: int, blocks: int) -> None:
    """Write the four output words of `rows` x `blocks` neighbouring blocks to ``words[0..3]``."""
    for r in range(rows):
        for b in range(blocks):
            words[r * blocks + b] = np.uint32((block + b) & 0xFFFFFFFF)
            words[CHUNK + r * blocks + b] = np.uint32((row + r) & 0xFFFFFFFF)
    k0, k1 = key & _LOW, key >> _32
    f0, f1 = np.uint64(frame) & _LOW, np.uint64(frame) >> _32
    for i in range(rows * blocks):
        c0, c1, c2, c3 = philox4x32(np.uint64(words[i]), np.uint64(words[CHUNK + i]), f0, f1, k0, k1)
        words[i] = np.uint32(c0)
        words[CHUNK + i] = np.uint32(c1)
        words[2 * CHUNK + i] = np.uint32(c2)
        words[3 * CHUNK + i] = np.uint32(c3)


_EXPONENT = np.uint32(23)
_MANTISSA, _ONE_BITS = np.uint32(0x7FFFFF), np.uint32(0x3F800000)
_F1, _HALF, _ROOT2 = np.float32(1.0), np.float32(0.5), np.float32(1.4142135)
_LN2_HIGH, _LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
_BIAS = np.float32(127.0)
# log(1 + f) = f - f^2/2 + f^3 P(f) on [sqrt(1/2) - 1, sqrt(2) - 1]: Cephes logf (S. L. Moshier), relative error 2^-24.
_L0, _L1, _L2 = np.float32(3.3333331174e-1), np.float32(-2.4999993993e-1), np.float32(2.0000714765e-1)
_L3, _L4, _L5 = np.float32(-1.6668057665e-1), np.float32(1.4249322787e-1), np.float32(-1.2420140846e-1)
_L6, _L7, _L8 = np.float32(1.1676998740e-1), np.float32(-1.1514610310e-1), np.float32(7.0376836292e-2)


@jit(forceinline=True)
def _log(u: np.float32) -> np.float32:
    """Natural logarithm of a positive normal float32."""
    bits = np.float32(u).view(np.uint32)
    m = np.uint32((bits & _MANTISSA) | _ONE_BITS).view(np.float32)
    e = np.float32(np.uint32(bits >> _EXPONENT)) - _BIAS
    large = m > _ROOT2
    m = m * _HALF if large else m
    e = e + _F1 if large else e
    f = m - _F1
    f2 = f * f
    p = ((((((((_L8 * f + _L7) * f + _L6) * f + _L5) * f + _L4) * f + _L3) * f + _L2) * f + _L1) * f + _L0) * f * f2
    return f + (p + e * _LN2_LOW - _HALF * f2) + e * _LN2_HIGH


_TO_UNIT, _TO_UNIT_HALF = np.float32(2.0**-32), np.float32(2.0**-33)
_SIGN, _ANGLE = np.uint32(0x80000000), np.uint32(0x3FFFFFFF)
_1U, _ALL = np.uint32(1), np.uint32(0xFFFFFFFF)
_NEAR, _THIRD, _QUARTER = np.float32(2.0**-7), np.float32(1 / 3), np.float32(0.25)
_TO_ANGLE, _QUARTER_PI = np.float32(np.pi / 2 * 2.0**-30), np.float32(np.pi / 4)
# sin and cos on [-pi/4, pi/4]: Cephes sinf and cosf, absolute error 2^-24.
_S1, _S2, _S3 = np.float32(-1.6666654611e-1), np.float32(8.3321608736e-3), np.float32(-1.9515295891e-4)
_C1, _C2, _C3 = np.float32(4.166664568298827e-2), np.float32(-1.388731625493765e-3), np.float32(2.443315711809948e-5)


@jit(forceinline=True)
def _normal_pair(a: np.uint32, b: np.uint32) -> tuple[np.float32, np.float32]:
    """Box and Muller (1958): two standard normal numbers from two 32-bit words.

    The second word holds two signs and an angle in the first quadrant, taken as pi/4 + t: sqrt(2) cos = cos t - sin t, and so on.
    """
    u = np.float32(a) * _TO_UNIT + _TO_UNIT_HALF
    rest = np.float32(np.uint32(a ^ _ALL)) * _TO_UNIT + _TO_UNIT_HALF  # 1 - u, which u has lost by rounding where it is near 1
    near_one = rest * (_F1 + rest * (_HALF + rest * (_THIRD + rest * _QUARTER)))
    radius = np.sqrt(near_one if rest < _NEAR else -_log(u))
    t = np.float32(np.uint32(b & _ANGLE)) * _TO_ANGLE - _QUARTER_PI
    t2 = t * t
    sine = ((_S3 * t2 + _S2) * t2 + _S1) * t2 * t + t
    cosine = ((_C3 * t2 + _C2) * t2 + _C1) * t2 * t2 - _HALF * t2 + _F1
    x = radius * (cosine - sine)
    y = radius * (cosine + sine)
    first = np.uint32(np.float32(x).view(np.uint32) ^ (b & _SIGN))
    second = np.uint32(np.float32(y).view(np.uint32) ^ ((b << _1U) & _SIGN))
    return first.view(np.float32), second.view(np.float32)


@jit
def _normals(words: NDArray[np.uint32], count: int, values: Singles) -> None:
    """Turn `count` blocks of words into 4 * `count` normal numbers; pixel 4 i + j takes number j of block i."""
    for i in range(count):
        x, y = _normal_pair(words[i], words[CHUNK + i])
        z, w = _normal_pair(words[2 * CHUNK + i], words[3 * CHUNK + i])
        values[4 * i] = x
        values[4 * i + 1] = y
        values[4 * i + 2] = z
        values[4 * i + 3] = w


_9U, _TO_UNIT_23, _HALF_STEP = np.uint32(9), np.float32(2.0**-23), np.float32(2.0**-24)


@jit
def _uniforms(words: NDArray[np.uint32], count: int, values: Singles) -> None:
    """Like `_normals`: numbers (k + 1/2) 2^-23, exact in float32, strictly between 0 and 1."""
    for i in range(count):
        for j in range(4):
            values[4 * i + j] = np.float32(np.uint32(words[j * CHUNK + i] >> _9U)) * _TO_UNIT_23 + _HALF_STEP


@jit
def draw_windows(key: np.uint64, frame: Ints, row0: Ints, col0: Ints, uniform: bool, out: Singles) -> None:
    """Write normal (or uniform) numbers for windows of absolute pixels; four horizontal neighbours share a block.

    key : uint64; frame, row0, col0 : int64 (n,); uniform : bool; out : float32 (n, rows, cols).
    """
    n, rows, cols = out.shape
    words = np.empty(4 * CHUNK, np.uint32)
    values = np.empty(4 * CHUNK, np.float32)
    for f in range(n):
        first, last = col0[f] >> 2, (col0[f] + cols - 1) >> 2
        for block in range(first, last + 1, CHUNK):
            blocks = min(CHUNK, last + 1 - block)
            left = max(4 * block, col0[f])
            width = min(4 * (block + blocks), col0[f] + cols) - left
            step = CHUNK // blocks
            for row in range(0, rows, step):
                height = min(step, rows - row)
                _fill_blocks(words, key, frame[f], row0[f] + row, height, block, blocks)
                if uniform:
                    _uniforms(words, height * blocks, values)
                else:
                    _normals(words, height * blocks, values)
                for r in range(height):
                    start = 4 * (r * blocks - block) + left
                    for c in range(width):
                        out[f, row + r, left - col0[f] + c] = values[start + c]


@jit
def add_windows(key: np.uint64, frame: Ints, row0: Ints, col0: Ints, data: Singles, scale: Singles, out: Singles) -> None:
    """Write data + scale * normal number; data, out : float32 (n, rows, cols); scale : float32, of size 1 or that of data, flat."""
    n, rows, cols = out.shape
    draw_windows(key, frame, row0, col0, False, out)
    z, x = out.reshape(n * rows * cols), data.reshape(n * rows * cols)
    if scale.size == 1:
        factor = scale[0]
        for i in range(x.size):
            z[i] = x[i] + factor * z[i]
    else:
        for i in range(x.size):
            z[i] = x[i] + scale[i] * z[i]


# The upper half-normal quantile is z = x k(w), with x = 1 - 2p and w = -log(4 p (1 - p)), p <= 1/2 (the variable of Giles, 2011). k is a
# Chebyshev fit on 0 <= w <= 14.6 (|z| < 5.1), written in powers of t = 2 w / 14.6 - 1; relative error 2.6e-7 in float32.
_W_SCALE, _W_MAX = np.float32(2 / 14.6), np.float32(14.5)
_K0, _K1, _K2 = np.float32(3.58563309), np.float32(1.89757894), np.float32(-0.42170774)
_K3, _K4, _K5 = np.float32(0.146902909), np.float32(-0.0222020821), np.float32(-0.0426531589)
_K6, _K7, _K8 = np.float32(0.0582208271), np.float32(-0.0495659048), np.float32(0.0441390829)
_K9, _K10, _K11 = np.float32(-0.0125885148), np.float32(-0.03700663), np.float32(0.0297358363)
_K12, _K13 = np.float32(0.00697209795), np.float32(-0.00867553957)

_1L, _12L, _20L = np.uint64(1), np.uint64(12), np.uint64(20)
_2_52, _2_53 = np.uint64(2**52), np.uint64(2**53)
_F2_52, _F2_53 = np.float32(2.0**-52), np.float32(2.0**-53)
_SIXTH, _36TH, _72ND = np.float32(1 / 6), np.float32(1 / 36), np.float32(1 / 72)
_E0, _E2, _E4 = np.float32(-8 / 405), np.float32(7 / 810), np.float32(1 / 270)
_NAN = np.float32(np.nan)
# How far the float32 quantile may be off: (_T0 + _T4 z^4) / mean^1.5 by truncation (1.7 times the largest seen for |z| < 5.1 and
# z^2 < _Z0 + _Z1 mean), sqrt(mean) (_R0 + _R1 |z|) + _R2 by rounding (5 times the largest seen).
_MEAN_MIN, _MEAN_MAX = np.float32(4.0), np.float32(1e7)
_T0, _T4 = np.float32(0.03), np.float32(0.02)
_Z0, _Z1 = np.float32(1.0), np.float32(0.7)
_R0, _R1, _R2 = np.float32(3e-7), np.float32(2e-6), np.float32(1e-6)


@jit
def _numerators(words: NDArray[np.uint32], count: int, numerators: NDArray[np.uint64]) -> None:
    """Two uniform numbers of 52 bits a block, (k + 1/2) 2^-52, as odd numerators over 2^53: exact, and so is their complement."""
    for i in range(count):
        for j in range(2):
            k = (np.uint64(words[2 * j * CHUNK + i]) << _20L) | (np.uint64(words[(2 * j + 1) * CHUNK + i]) >> _12L)
            numerators[2 * i + j] = (k << _1L) | _1L


@jit(forceinline=True)
def fold(numerator: np.uint64) -> tuple[np.float32, np.float32]:
    """Return min(u, 1 - u) and 2 u - 1 in float32, both to 24 bits, for u = numerator / 2^53."""
    upper = numerator > _2_52
    folded = _2_53 - numerator if upper else numerator
    distance = np.float32(_2_52 - folded) * _F2_52
    return np.float32(folded) * _F2_53, distance if upper else -distance


@jit(forceinline=True)
def poisson_fast(mean: np.float32, p: np.float32, x: np.float32) -> np.float32:
    """Poisson quantile in float32 at u with (p, x) = fold(u), or NaN if its error bound cannot decide between two integers.

    Expansion of the quantile in powers of 1 / sqrt(mean): Giles (2016), ACM TOMS 42(1), Algorithm 955, carried to 1 / mean.
    """
    w = -_log(np.float32(4.0) * p * (_F1 - p))
    t = w * _W_SCALE - _F1
    k = ((((((_K13 * t + _K12) * t + _K11) * t + _K10) * t + _K9) * t + _K8) * t + _K7) * t + _K6
    k = (((((k * t + _K5) * t + _K4) * t + _K3) * t + _K2) * t + _K1) * t + _K0
    z = x * k
    z2 = z * z
    root = np.sqrt(mean if mean > _MEAN_MIN else _MEAN_MIN)
    inverse = _F1 / root
    whole = np.floor(mean)
    offset = (mean - whole) + root * z + (_THIRD + _SIXTH * z2)
    offset = offset - inverse * z * (_36TH + _72ND * z2) + inverse * inverse * (_E0 + z2 * (_E2 + z2 * _E4))
    error = inverse * inverse * inverse * (_T0 + _T4 * z2 * z2) + root * (_R0 + _R1 * np.abs(z)) + _R2
    floor = np.floor(offset)
    above = offset - floor
    # Bitwise, not "and": a chain of branches would keep the loop from being vectorised.
    sure = (above > error) & (_F1 - above > error) & (z2 < _Z0 + _Z1 * mean) & (mean >= _MEAN_MIN)
    return whole + floor if (sure | (mean > _MEAN_MAX)) & (w < _W_MAX) else _NAN


_8TH, _F0 = np.float32(0.125), np.float32(0.0)
_INVERSE = (1 / np.arange(1, 16)).astype(np.float32)
_FACTORIAL = np.array([1 / math.factorial(j) for j in range(7, -1, -1)], np.float32)
_STEP = np.float32(4e-6)


@jit(forceinline=True)
def poisson_small(mean: np.float32, x: np.float32) -> np.float32:
    """Poisson quantile in float32 for a mean below 4, by counting the steps below u; NaN within 4e-6 of one, or above 15.

    The distribution function is good to 1.5e-6 here: exp(-mean) is the eighth power of a series.
    """
    y = -_8TH * mean
    term = np.float32(1 / 40320)
    for j in range(8):
        term = term * y + _FACTORIAL[j]
    term = term * term
    term = term * term
    term = term * term
    u = _HALF + _HALF * x
    total = term
    count = _F1 if u > total else _F0
    nearest = np.abs(u - total)
    for j in range(15):
        term = term * (mean * _INVERSE[j])
        total = total + term
        count = count + (_F1 if u > total else _F0)
        distance = np.abs(u - total)
        nearest = distance if distance < nearest else nearest
    return count if (nearest > _STEP) & (count < np.float32(15.5)) & (mean >= _F0) else _NAN


@jit
def _normal_quantile(p: float) -> float:
    """Standard normal quantile for 0 < p <= 1/2: Abramowitz and Stegun 26.2.23 and two steps of Halley."""
    t = math.sqrt(-2.0 * math.log(p))
    z = (2.515517 + t * (0.802853 + t * 0.010328)) / (1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308))) - t
    for _ in range(2):
        step = (0.5 * math.erfc(-z * math.sqrt(0.5)) - p) * math.sqrt(2.0 * math.pi) * math.exp(0.5 * z * z)
        z -= step / (1.0 + 0.5 * z * step)
    return z


@jit
def _poisson_density(n: float, mean: float) -> float:
    """Poisson probability of n by the saddle point, to about 1e-15.

    C. Loader (2000), "Fast and accurate computation of binomial probabilities".
    """
    if n == 0.0:
        return math.exp(-mean)
    if n < 16.0:
        stirling = math.lgamma(n + 1.0) - (n + 0.5) * math.log(n) + n - 0.5 * math.log(2.0 * math.pi)
    else:
        r = 1.0 / (n * n)
        stirling = (1 / 12 - r * (1 / 360 - r * (1 / 1260 - r * (1 / 1680 - r / 1188)))) / n
    difference = n - mean
    if abs(difference) < 0.1 * (n + mean):
        v = difference / (n + mean)
        deviance = difference * v
        term = 2.0 * n * v
        for j in range(1, 1000):
            term *= v * v
            before = deviance
            deviance += term / (2 * j + 1)
            if deviance == before:
                break
    else:
        deviance = n * math.log(n / mean) - difference
    return math.exp(-stirling - deviance) / math.sqrt(2.0 * math.pi * n)


@jit
def _tail(n: float, mean: float, upper: bool) -> float:
    """P(N > n) if upper, else P(N <= n), for n on the tail's own side of the mean or not far from it."""
    total, term = 1.0, 1.0
    if upper:
        j = n + 1.0
        while True:
            term *= mean / (j + 1.0)
            total += term
            j += 1.0
            if term < 1e-17 * total:
                return total * _poisson_density(n + 1.0, mean)
    j, inverse = n, 1.0 / mean
    while j > 0.0 and term > 1e-17 * total:
        term *= j * inverse
        total += term
        j -= 1.0
    return total * _poisson_density(n, mean)


@jit
def _settle(n: float, mean: float, p: float, upper: bool) -> float:
    """Move from a guess to the smallest n with P(N <= n) >= u, counted from the tail: p = u, or 1 - u if upper."""
    if upper:
        while _tail(n, mean, True) > p:
            n += 1.0
        while n > 0.0 and _tail(n - 1.0, mean, True) <= p:
            n -= 1.0
        return n
    while _tail(n, mean, False) < p:
        n += 1.0
    while n > 0.0 and _tail(n - 1.0, mean, False) >= p:
        n -= 1.0
    return n


@jit
def poisson_exact(mean: float, numerator: np.uint64) -> float:
    """Smallest n with P(N <= n) >= numerator / 2^53, in float64. Above a mean of 1e7 its expansion alone, good to 1e-6 electrons."""
    if mean == 0.0:
        return 0.0
    upper = bool(numerator > _2_52)
    p = np.float64(_2_53 - numerator if upper else numerator) * 2.0**-53
    if mean < 30.0:
        if upper and p < 1e-3:
            return _settle(np.floor(mean + 3.0 * math.sqrt(mean)), mean, p, True)
        u = 1.0 - p if upper else p
        n, term = 0.0, math.exp(-mean)
        total = term
        while total < u:
            n += 1.0
            term *= mean / n
            total += term
        return n
    z = -_normal_quantile(p) if upper else _normal_quantile(p)
    z2, root = z * z, math.sqrt(mean)
    x = mean + root * z + (1 / 3 + z2 / 6) - z * (1 / 36 + z2 / 72) / root + (-8 / 405 + z2 * (7 / 810 + z2 / 270)) / mean
    error = (0.03 + 0.02 * z2 * z2) / (mean * root) + 1e-13 * mean
    n = max(0.0, np.floor(x))
    if mean > 1e7 or (z2 < min(26.0, 1.0 + 0.7 * mean) and abs(x - np.rint(x)) > error):
        return float(n)
    return _settle(n, mean, p, upper)


@jit
def _poissons(means: Singles, numerators: NDArray[np.uint64], count: int, folded: Singles, values: Singles) -> None:
    for i in range(count):
        folded[i], values[i] = fold(numerators[i])
    least = means[0]
    for i in range(count):
        least = min(least, means[i])
    if least < _MEAN_MIN:
        for i in range(count):
            small = poisson_small(means[i], values[i])
            large = poisson_fast(means[i], folded[i], values[i])
            values[i] = small if means[i] < _MEAN_MIN else large
    else:
        for i in range(count):
            values[i] = poisson_fast(means[i], folded[i], values[i])


@jit
def poisson_windows(key: np.uint64, frame: Ints, row0: Ints, col0: Ints, mean: Singles, out: Singles) -> int:
    """Write Poisson numbers for windows of absolute pixels; two horizontal neighbours share a block.

    key : uint64; frame, row0, col0 : int64 (n,); mean, out : float32 (n, rows, cols). Returns the number of pixels whose mean is
    negative, infinite or NaN.
    """
    n, rows, cols = out.shape
    words = np.empty(4 * CHUNK, np.uint32)
    numerators = np.empty(2 * CHUNK, np.uint64)
    means = np.full(2 * CHUNK, 100.0, np.float32)  # also where a block reaches beyond the window
    folded, values = np.empty(2 * CHUNK, np.float32), np.empty(2 * CHUNK, np.float32)
    refused = 0
    for f in range(n):
        first, last = col0[f] >> 1, (col0[f] + cols - 1) >> 1
        for block in range(first, last + 1, CHUNK):
            blocks = min(CHUNK, last + 1 - block)
            left = max(2 * block, col0[f])
            width = min(2 * (block + blocks), col0[f] + cols) - left
            step = CHUNK // blocks
            for row in range(0, rows, step):
                height = min(step, rows - row)
                _fill_blocks(words, key, frame[f], row0[f] + row, height, block, blocks)
                _numerators(words, height * blocks, numerators)
                for r in range(height):
                    start = 2 * (r * blocks - block) + left
                    for c in range(width):
                        means[start + c] = mean[f, row + r, left - col0[f] + c]
                _poissons(means, numerators, 2 * height * blocks, folded, values)
                for r in range(height):
                    start = 2 * (r * blocks - block) + left
                    for c in range(width):
                        value = values[start + c]
                        if not value >= 0.0:
                            m = means[start + c]
                            if 0.0 <= m < np.inf:
                                value = np.float32(poisson_exact(np.float64(m), numerators[start + c]))
                            else:
                                refused += 1
                        out[f, row + r, left - col0[f] + c] = value
    return refused
