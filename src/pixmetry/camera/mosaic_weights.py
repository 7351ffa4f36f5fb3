"""Weights of linear demosaicking: which raw pixels make a colour at each of the four places of the mosaic."""

from __future__ import annotations

import numpy as np

LUMA = {"R": 0.299, "G": 0.587, "B": 0.114}  # ITU-R BT.601
REACH = 2
BILINEAR, MALVAR = "bilinear", "malvar"

# Weights × 8 of Malvar, He and Cutler (2004): the bilinear value plus 1/2, 5/8 or 3/4 of the Laplacian of the pixel's own colour.
GREEN_AT_OTHER = np.array([[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]]) / 8
BESIDE = np.array([[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]]) / 8  # in its row
ACROSS = np.array([[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]]) / 8  # at the corners


def channel_weights(method: str, pattern: str, row: int, col: int, colour: str) -> np.ndarray:
    """Weights, shape (5, 5), that give a colour at the place (row, col) of the pattern."""

    def at(r: int, c: int) -> str:
        return pattern[2 * (r % 2) + c % 2]

    here = at(row, col)
    out = np.zeros((5, 5))
    if here == colour:
        out[2, 2] = 1.0
        return out
    if method == "malvar":
        if colour == "G":
            return GREEN_AT_OTHER
        if here == "G":
            return BESIDE if at(row, col + 1) == colour else BESIDE.T
        return ACROSS
    near = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if at(row + r, col + c) == colour]
    for r, c in near:
        out[2 + r, 2 + c] = 1 / len(near)
    return out


def output_weights(method: str, pattern: str, shares: dict[str, float], balance: dict[str, float]) -> np.ndarray:
    """Weights of a mix of colours on the raw mosaic at its four places, shape (2, 2, 5, 5), with a factor on the pixels of each colour."""
    out = np.zeros((2, 2, 5, 5))
    for row in (0, 1):
        for col in (0, 1):
            colours = [pattern[2 * ((row + r) % 2) + (col + c) % 2] for r in range(-REACH, 3) for c in range(-REACH, 3)]
            gains = np.array([balance[c] for c in colours]).reshape(5, 5)
            total = sum(share * channel_weights(method, pattern, row, col, colour) for colour, share in shares.items())
            out[row, col] = total * gains
    return out
