"""Kernel of the high-pass filter."""

from __future__ import annotations

from pixmetry.core.arrays import Array
from pixmetry.core.jit import jit


@jit
def subtract_low_pass(image: Array, weights: Array, line: Array, out: Array) -> None:
    """out = image less its separable convolution with ``weights`` (odd, symmetric) along both axes, where that lies in the image.

    ``line`` is room for one row of the image.
    """
    half = weights.size // 2
    for row in range(out.shape[0]):
        line[:] = 0.0
        for k in range(weights.size):
            weight = weights[k]
            for col in range(line.size):
                line[col] += weight * image[row + k, col]
        for col in range(out.shape[1]):
            out[row, col] = image[row + half, col + half]
        for k in range(weights.size):
            weight = weights[k]
            for col in range(out.shape[1]):
                out[row, col] -= weight * line[col + k]
