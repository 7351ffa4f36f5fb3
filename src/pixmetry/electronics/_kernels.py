"""Kernels of the electronics: noise along the read-out."""

from __future__ import annotations

import numpy as np

from pixmetry.core.jit import jit


@jit
def add_interpolated(nodes, place, step, scale, out):
    """Add a line through random nodes to every row: out[i, c] += scale · (node at place[i] + c · step, straight between neighbours).

    nodes : float32 (n, m); place : float64 (n,), from the first node of the row; out : float32 (n, cols), changed.
    """
    n, cols = out.shape
    for i in range(n):
        for c in range(cols):
            at = place[i] + c * step
            j = int(at)
            part = at - j
            out[i, c] += np.float32(scale * (np.float64(nodes[i, j]) * (1.0 - part) + np.float64(nodes[i, j + 1]) * part))
