"""Quantiser tables of JPEG (ITU-T T.81) and the cosine transform of its blocks."""

from __future__ import annotations

import numpy as np

from pixmetry.core.arrays import Array, Ints

BLOCK = 8
LUMINANCE = np.array(  # ITU-T T.81 (JPEG), Annex K, table K.1
    [
        [16, 11, 10, 16, 24, 40, 51, 61],
        [12, 12, 14, 19, 26, 58, 60, 55],
        [14, 13, 16, 24, 40, 57, 69, 56],
        [14, 17, 22, 29, 51, 87, 80, 62],
        [18, 22, 37, 56, 68, 109, 103, 77],
        [24, 35, 55, 64, 81, 104, 113, 92],
        [49, 64, 78, 87, 103, 121, 120, 101],
        [72, 92, 95, 98, 112, 100, 103, 99],
    ],
    dtype=float,
)


def steps(quality: int) -> np.ndarray:
    """Quantiser steps of the luminance coefficients, shape (8, 8): the standard table scaled by the Independent JPEG Group's rule."""
    scale = 5000 // quality if quality < 50 else 200 - 2 * quality
    quantisers: Ints = np.clip((LUMINANCE * scale + 50) // 100, 1, 255)
    return quantisers


def cosines() -> np.ndarray:
    """Orthonormal cosine transform of eight samples, shape (8, 8)."""
    k, x = np.meshgrid(np.arange(BLOCK), np.arange(BLOCK), indexing="ij")
    matrix: Array = np.sqrt(2 / BLOCK) * np.cos(np.pi * (2 * x + 1) * k / (2 * BLOCK))
    matrix[0] /= np.sqrt(2)
    return matrix


def tiles_of(image: np.ndarray) -> np.ndarray:
    """Whole blocks of an image from its first pixel on, shape (blocks, 8, 8)."""
    rows, cols = image.shape[0] // BLOCK, image.shape[1] // BLOCK
    tiles: Array = image[: rows * BLOCK, : cols * BLOCK].reshape(rows, BLOCK, cols, BLOCK).swapaxes(1, 2).reshape(-1, BLOCK, BLOCK)
    return tiles


def equivalent_quality(table: np.ndarray) -> tuple[float, float]:
    """Quality whose steps are those of a table on the average, and the scatter of that over the positions; whole.

    Positions whose step is not known are 0.
    """
    known = table > 0
    qualities = np.arange(1, 101)
    away = np.array([np.log(steps(int(q))[known] / table[known]) for q in qualities])
    squares = (away**2).mean(axis=1)
    best = int(squares.argmin())
    each = np.abs(away).argmin(axis=0)
    return float(qualities[best]), float(max(np.std(qualities[each]) / np.sqrt(max(known.sum(), 1)), 1.0))
