"""Brown's distortion polynomial and its inverse, point by point."""

from __future__ import annotations

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.jit import jit


@jit
def polynomial(x: Array, y: Array, k1: float, k2: float, k3: float, k4: float, k5: float, p1: float, p2: float) -> tuple[Array, Array]:
    """Return the polynomial's values at flat arrays of places."""
    u, v = np.empty_like(x), np.empty_like(y)
    for i in range(len(x)):
        r2 = x[i] * x[i] + y[i] * y[i]
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * (k4 + r2 * k5))))
        u[i] = x[i] * radial + p1 * (r2 + 2.0 * x[i] * x[i]) + 2.0 * p2 * x[i] * y[i]
        v[i] = y[i] * radial + p2 * (r2 + 2.0 * y[i] * y[i]) + 2.0 * p1 * x[i] * y[i]
    return u, v


@jit
def inverse(u: Array, v: Array, k1: float, k2: float, k3: float, k4: float, k5: float, p1: float, p2: float) -> tuple[Array, Array]:
    """Return the places at which the polynomial has these values, by Newton's method from the values themselves."""
    x, y = np.empty_like(u), np.empty_like(v)
    for i in range(len(u)):
        a, b = u[i], v[i]
        for _ in range(40):
            r2 = a * a + b * b
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * (k4 + r2 * k5))))
            slope = k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3 + r2 * (4.0 * k4 + 5.0 * r2 * k5)))
            fx = a * radial + p1 * (r2 + 2.0 * a * a) + 2.0 * p2 * a * b - u[i]
            fy = b * radial + p2 * (r2 + 2.0 * b * b) + 2.0 * p1 * a * b - v[i]
            xx = radial + 2.0 * a * a * slope + 6.0 * p1 * a + 2.0 * p2 * b
            yy = radial + 2.0 * b * b * slope + 6.0 * p2 * b + 2.0 * p1 * a
            xy = 2.0 * a * b * slope + 2.0 * p1 * b + 2.0 * p2 * a
            det = xx * yy - xy * xy
            da, db = (fx * yy - fy * xy) / det, (fy * xx - fx * xy) / det
            a -= da
            b -= db
            if abs(da) + abs(db) < 1e-13 * (1.0 + abs(a) + abs(b)):
                break
        x[i], y[i] = a, b
    return x, y
