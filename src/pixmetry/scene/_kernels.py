"""Kernels of the scene: blurred discs integrated over pixels."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.arrays import Array, Ints, Singles
from pixmetry.core.jit import jit

# Gauss–Legendre nodes and weights on (-1/2, 1/2)
NODES = (0.5 * np.array([-0.7745966692414834, 0.0, 0.7745966692414834])).astype(np.float64)
WEIGHTS = 0.5 * np.array([5.0 / 9.0, 8.0 / 9.0, 5.0 / 9.0])


@jit
def add_discs(
    out: Singles,
    x: Array,
    y: Array,
    entry: Ints,
    row0: Ints,
    col0: Ints,
    profile: Array,
    step: float,
    inner: float,
    outer: float,
    peak: Array,
    split: int,
) -> None:
    """Add discs to windows in place.

    ``entry[k]`` is the window that disc ``k`` falls into, ``(x[k], y[k])`` its centre in absolute pixels, ``peak[k]`` its height.
    ``profile`` is the blurred disc against radius, at spacing ``step``; it is 1 inside ``inner`` and 0 outside ``outer``. A pixel is
    integrated on ``split`` × ``split`` cells of 3 × 3 Gauss–Legendre nodes.
    """
    rows, cols = out.shape[1], out.shape[2]
    half = 0.7072  # from the centre of a pixel to its corner
    cell = 1.0 / split
    for k in range(len(x)):
        i = entry[k]
        cx, cy = x[k] - col0[i], y[k] - row0[i]
        r_first = max(0, int(math.floor(cy - outer - 1)))
        r_last = min(rows - 1, int(math.ceil(cy + outer + 1)))
        c_first = max(0, int(math.floor(cx - outer - 1)))
        c_last = min(cols - 1, int(math.ceil(cx + outer + 1)))
        for r in range(r_first, r_last + 1):
            dy = r - cy
            for c in range(c_first, c_last + 1):
                dx = c - cx
                distance = math.sqrt(dx * dx + dy * dy)
                if distance > outer + half:
                    continue
                if distance < inner - half:
                    out[i, r, c] += peak[k]
                    continue
                total = 0.0
                for a in range(split):
                    for b in range(split):
                        oy = dy + (a + 0.5) * cell - 0.5
                        ox = dx + (b + 0.5) * cell - 0.5
                        for p in range(3):
                            vy = oy + NODES[p] * cell
                            part = 0.0
                            for q in range(3):
                                vx = ox + NODES[q] * cell
                                at = math.sqrt(vx * vx + vy * vy) / step
                                j = int(at)
                                if j + 1 < len(profile):
                                    f = at - j
                                    part += WEIGHTS[q] * (profile[j] + f * (profile[j + 1] - profile[j]))
                            total += WEIGHTS[p] * part
                out[i, r, c] += peak[k] * total * cell * cell


@jit
def see_discs(
    out: Array,
    x: Array,
    y: Array,
    w: Array,
    h: Array,
    row: Ints,
    cx: Array,
    cy: Array,
    peak: Array,
    profile: Array,
    step: float,
    outer: float,
    blur: float,
) -> None:
    """Add discs at points, averaged over a box w × h about each, to ``out``; point i sees the discs at ``cx[row[i]], cy[row[i]]``.

    ``profile`` is as for `add_discs` and 0 beyond ``outer``. The boxes must be no wider than twice the blur: then three nodes a side do to
    1e-4, two where it is narrower than three quarters, one below a twentieth.
    """
    two = 0.5 / math.sqrt(3.0)
    for i in range(len(x)):
        size = max(w[i], h[i]) / blur
        nodes = 1 if size <= 0.05 else (2 if size <= 0.75 else 3)
        for k in range(cx.shape[1]):
            dx, dy = x[i] - cx[row[i], k], y[i] - cy[row[i], k]
            if abs(dx) > outer + w[i] or abs(dy) > outer + h[i]:
                continue
            total = 0.0
            for p in range(nodes):
                py, wy = (0.0, 1.0) if nodes == 1 else ((two * (2 * p - 1), 0.5) if nodes == 2 else (NODES[p], WEIGHTS[p]))
                vy = dy + py * h[i]
                for q in range(nodes):
                    px, wx = (0.0, 1.0) if nodes == 1 else ((two * (2 * q - 1), 0.5) if nodes == 2 else (NODES[q], WEIGHTS[q]))
                    vx = dx + px * w[i]
                    at = math.sqrt(vx * vx + vy * vy) / step
                    j = int(at)
                    if j + 1 < len(profile):
                        f = at - j
                        total += wy * wx * (profile[j] + f * (profile[j + 1] - profile[j]))
            out[i] += peak[k] * total
