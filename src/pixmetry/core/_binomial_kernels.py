"""Kernels for how many of a number of electrons go one way, each for itself with the same probability: binomial numbers by inversion."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pixmetry.core._random_kernels import (
    _K0,
    _K1,
    _K2,
    _K3,
    _K4,
    _K5,
    _K6,
    _K7,
    _K8,
    _K9,
    _K10,
    _K11,
    _K12,
    _K13,
    _W_SCALE,
    CHUNK,
    _fill_blocks,
    _log,
    _normal_quantile,
    philox4x32,
)  # fmt: skip
from pixmetry.core.arrays import Array, Ints, Singles
from pixmetry.core.jit import jit

_32, _16, _LOW = np.uint64(32), np.uint64(16), np.uint64(0xFFFFFFFF)
_2_31, _ALL = np.uint32(2**31), np.uint32(0xFFFFFFFF)
_F1, _F2, _F4, _FAR = np.float32(1.0), np.float32(2.0), np.float32(4.0), np.float32(5.0)
_TO_UNIT, _TO_UNIT_HALF = np.float32(2.0**-32), np.float32(2.0**-33)
EXPANDED = 12.0  # mean from which the quantile is expanded
_INVERSE = 1.0 / np.arange(1, 64)


@jit
def normals_of(words: NDArray[np.uint32], count: int, out: Singles) -> None:
    """Write standard normal quantiles at u = (word + 1/2) 2^-32, float32; error below 1e-6, beyond 5.1 by `_normal_quantile`."""
    for i in range(count):
        word = words[i]
        upper = word >= _2_31
        tail = (np.float32(_ALL - word) if upper else np.float32(word)) * _TO_UNIT + _TO_UNIT_HALF
        w = -_log(_F4 * tail * (_F1 - tail))
        t = w * _W_SCALE - _F1
        k = ((((((_K13 * t + _K12) * t + _K11) * t + _K10) * t + _K9) * t + _K8) * t + _K7) * t + _K6
        k = (((((k * t + _K5) * t + _K4) * t + _K3) * t + _K2) * t + _K1) * t + _K0
        z = (_F1 - _F2 * tail) * k
        out[i] = z if upper else -z
    for i in range(count):
        if out[i] > _FAR or out[i] < -_FAR:
            upper = words[i] >= _2_31
            far = (np.float64(_ALL - words[i]) if upper else np.float64(words[i])) * 2.0**-32 + 2.0**-33
            z = np.float32(_normal_quantile(far))
            out[i] = -z if upper else z


@jit
def binomial(n: float, p: float, log_stay: float, u: float, z: float) -> float:
    """Smallest k with P(K <= k) >= u for a binomial K of n trials (a whole number, float64); z is the normal quantile at u.

    ``log_stay`` is log(1 − p). Below a mean of 12 by adding up probabilities, to 1e-12; above by the expansion of the quantile in powers of
    1/σ (E. A. Cornish, R. A. Fisher, Rev. Inst. Int. Stat. 5, 1938, 307) with the continuity corrections ½ and σ² − 1/12: the cumulative
    probability is right to 3e-4, mean and variance to 2e-4 of the variance.
    """
    mean = n * p
    if n <= 0.0 or u < 1.0 - mean:  # the probability of none is more
        return 0.0
    if p > 0.5:
        return n if p >= 1.0 else n - fewer(n, 1.0 - p, math.log(p), 1.0 - u, -z)
    return fewer(n, p, log_stay, u, z)


@jit
def fewer(n: float, p: float, log_stay: float, u: float, z: float) -> float:
    """The same for p of at most 1/2."""
    mean = n * p
    if mean < EXPANDED:
        odds = p / (1.0 - p)
        k, term = 0, math.exp(n * log_stay)
        total = term
        while total < u and k < n and k < 63:
            term *= odds * (n - k) * _INVERSE[k]
            k += 1
            total += term
        return np.float64(k)
    sigma, z2, skew = math.sqrt(mean * (1.0 - p)), z * z, 1.0 - 2.0 * p
    curved = (1.0 - 6.0 * p * (1.0 - p)) * (z2 - 3.0) / 24.0 - skew * skew * (2.0 * z2 - 5.0) / 36.0 - 1.0 / 24.0
    k = math.floor(mean + sigma * z + 0.5 + skew * (z2 - 1.0) / 6.0 + curved * z / sigma)
    return min(max(k, 0.0), n)


@jit
def layer(frame: int, draw: int) -> int:
    """A frame number that stands for one of several draws of the same place; frames up to 2^48, draws up to 2^15."""
    return frame | (draw << 48)


@jit
def place_words(key: np.uint64, frame: int, row: int, block: int, words: NDArray[np.uint32]) -> None:
    """Write the four words of one block to ``words[0:4]``."""
    f = np.uint64(frame)
    w0, w1, w2, w3 = philox4x32(np.uint64(block) & _LOW, np.uint64(row) & _LOW, f & _LOW, f >> _32, key & _LOW, key >> _32)
    words[0], words[1], words[2], words[3] = np.uint32(w0), np.uint32(w1), np.uint32(w2), np.uint32(w3)


@jit
def normal_of_place(key: np.uint64, frame: int, row: int, col: int, words: NDArray[np.uint32], normal: Singles) -> tuple[float, float]:
    """The uniform number and its normal quantile that `normals_of_row` gives to one pixel; ``words`` and ``normal`` are room for four."""
    place_words(key, frame, row, col >> 2, words)
    normals_of(words, 4, normal)
    return (np.float64(words[col & 3]) + 0.5) * 2.0**-32, np.float64(normal[col & 3])


@jit
def normals_of_row(key: np.uint64, frame: int, row: int, col0: int, u: Array, z: Singles) -> None:
    """Write a uniform number (float64) and its normal quantile (float32) for every pixel of a row; four neighbours share a block."""
    cols = len(u)
    words, flat = np.empty(4 * CHUNK, np.uint32), np.empty(4 * CHUNK, np.uint32)
    normal = np.empty(4 * CHUNK, np.float32)
    first, last = col0 >> 2, (col0 + cols - 1) >> 2
    for block in range(first, last + 1, CHUNK):
        blocks = min(CHUNK, last + 1 - block)
        _fill_blocks(words, key, frame, row, 1, block, blocks)
        for i in range(blocks):
            for j in range(4):
                flat[4 * i + j] = words[j * CHUNK + i]
        normals_of(flat, 4 * blocks, normal)
        left, right = max(4 * block, col0), min(4 * (block + blocks), col0 + cols)
        for c in range(left, right):
            u[c - col0] = (np.float64(flat[c - 4 * block]) + 0.5) * 2.0**-32
            z[c - col0] = normal[c - 4 * block]


@jit
def binomial_windows(key: np.uint64, frame: Ints, row0: Ints, col0: Ints, count: Singles, share: Array, out: Singles) -> None:
    """Write binomial numbers for windows of absolute pixels.

    key : uint64; frame, row0, col0 : int64 (n,); count, out : float32 (n, rows, cols); share : float64 (n or 1, rows or 1, cols or 1). Of a
    count that is no whole number the rest goes by its share; one below zero does so as a whole.
    """
    n, rows, cols = out.shape
    u, z = np.empty(cols, np.float64), np.empty(cols, np.float32)
    one_n, one_row, one_col = share.shape[0] == 1, share.shape[1] == 1, share.shape[2] == 1
    p, log_stay = 0.0, 0.0
    for i in range(n):
        for r in range(rows):
            normals_of_row(key, frame[i], row0[i] + r, col0[i], u, z)
            for c in range(cols):
                new = share[0 if one_n else i, 0 if one_row else r, 0 if one_col else c]
                if new != p:
                    p = new
                    log_stay = math.log1p(-p) if p < 1.0 else 0.0
                x = np.float64(count[i, r, c])
                whole = math.floor(x) if x > 0.0 else 0.0
                out[i, r, c] = binomial(whole, p, log_stay, u[c], np.float64(z[c])) + p * (x - whole)
