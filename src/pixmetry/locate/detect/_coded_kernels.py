"""Kernel of coded targets: grey values on ellipses about a target."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.jit import jit


@jit
def sample_rings(frame, x, y, semi_major, semi_minor, angle, radii, directions, start, stop, out):
    """Interpolate linearly at centre + M (ρ cos φ, ρ sin φ), with M the map of the unit circle to the target's outline.

    out (n, len(radii), len(directions)) becomes NaN outside the frame. M is the symmetric map that has the ellipse's axes.
    """
    rows, cols = frame.shape
    for i in range(start, stop):
        c, s = math.cos(angle[i]), math.sin(angle[i])
        m11 = semi_major[i] * c * c + semi_minor[i] * s * s
        m12 = (semi_major[i] - semi_minor[i]) * c * s
        m22 = semi_major[i] * s * s + semi_minor[i] * c * c
        for d in range(directions.shape[0]):
            ex, ey = math.cos(directions[d]), math.sin(directions[d])
            dx, dy = m11 * ex + m12 * ey, m12 * ex + m22 * ey
            for r in range(radii.shape[0]):
                px, py = x[i] + radii[r] * dx, y[i] + radii[r] * dy
                if not (0.0 <= px <= cols - 1.0 and 0.0 <= py <= rows - 1.0):
                    out[i, r, d] = np.nan
                    continue
                col, row = min(int(px), cols - 2), min(int(py), rows - 2)
                fx, fy = px - col, py - row
                top = (1.0 - fx) * frame[row, col] + fx * frame[row, col + 1]
                bottom = (1.0 - fx) * frame[row + 1, col] + fx * frame[row + 1, col + 1]
                out[i, r, d] = (1.0 - fy) * top + fy * bottom
