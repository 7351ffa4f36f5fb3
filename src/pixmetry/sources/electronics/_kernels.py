"""Kernels of the electronics: noise along the read-out."""

from __future__ import annotations

import numpy as np

from pixmetry.core.arrays import Array, Singles
from pixmetry.core.jit import jit


@jit
def add_interpolated(nodes: Singles, place: Array, step: float, scale: float, out: Singles) -> None:
    """Add a line through random nodes to every row: out[i, c] += scale · (node at place[i] + c · step, straight between neighbours).

    nodes : float32 (n, m); place : float64 (n,), from the first node of the row; out : float32 (n, cols), changed.
    """
    n, cols = out.shape
    for i in range(n):
        c = 0
        while c < cols:  # from node to node
            j = int(place[i] + c * step)
            end = min(cols, max(c + 1, int((j + 1 - place[i]) / step)))
            while end > c + 1 and int(place[i] + (end - 1) * step) > j:
                end -= 1
            while end < cols and int(place[i] + end * step) == j:
                end += 1
            low, high = np.float64(nodes[i, j]), np.float64(nodes[i, j + 1])
            for k in range(c, end):
                part = place[i] + k * step - j
                out[i, k] += np.float32(scale * (low * (1.0 - part) + high * part))
            c = end
