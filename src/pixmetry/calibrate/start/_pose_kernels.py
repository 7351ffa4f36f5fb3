"""The pose of one image by least squares on directions, points that do not fit left out."""

from __future__ import annotations

import numpy as np

from pixmetry.core.arrays import Array, Flags
from pixmetry.core.jit import jit

ROUNDS = 3  # of choosing the points that fit
STEPS = 20  # of one fit
SMALLEST = 1e-20  # square of a step, in radians and in units of the distance, of a last one
LARGEST_DAMPING = 1e6
GAINED = 0.999  # share of the cost above which another round is not worth it


@jit
def judged(xyz: Array, uv: Array, rotation: Array, shift: Array, tolerance: float, fits: Flags) -> float:
    """Mean of min(error, tolerance)² of the directions; writes which points fit."""
    most = tolerance * tolerance
    total = 0.0
    for i in range(len(uv)):
        x, y, z = shift[0], shift[1], shift[2]
        for k in range(3):
            x += rotation[0, k] * xyz[i, k]
            y += rotation[1, k] * xyz[i, k]
            z += rotation[2, k] * xyz[i, k]
        error = most
        if z > 0.0:
            error = (x / z - uv[i, 0]) ** 2 + (y / z - uv[i, 1]) ** 2
        fits[i] = error < most  # false where it is no number
        total += error if error < most else most
    return total / len(uv)


@jit
def normals(xyz: Array, uv: Array, rotation: Array, shift: Array, fits: Flags, N: Array, g: Array) -> float:
    """Normal equations of a small rotation about the camera's axes and of the shift; returns the sum of squares, NaN behind the camera."""
    N[:, :] = 0.0
    g[:] = 0.0
    total = 0.0
    row = np.empty((2, 6))
    for i in range(len(uv)):
        if not fits[i]:
            continue
        x, y, z = 0.0, 0.0, 0.0
        for k in range(3):
            x += rotation[0, k] * xyz[i, k]
            y += rotation[1, k] * xyz[i, k]
            z += rotation[2, k] * xyz[i, k]
        tx, ty, tz = x + shift[0], y + shift[1], z + shift[2]
        if not tz > 0.0:
            return np.nan
        u, v = tx / tz, ty / tz
        for a in range(2):
            d0, d1 = (1.0 / tz, 0.0) if a == 0 else (0.0, 1.0 / tz)
            d2 = -(u if a == 0 else v) / tz
            row[a, 0], row[a, 1], row[a, 2] = y * d2 - z * d1, z * d0 - x * d2, x * d1 - y * d0
            row[a, 3], row[a, 4], row[a, 5] = d0, d1, d2
        e0, e1 = uv[i, 0] - u, uv[i, 1] - v
        total += e0 * e0 + e1 * e1
        for a in range(6):
            g[a] += row[0, a] * e0 + row[1, a] * e1
            for b in range(a + 1):
                N[a, b] += row[0, a] * row[0, b] + row[1, a] * row[1, b]
    return total


@jit
def damped_step(N: Array, g: Array, damping: float, step: Array) -> bool:
    """Solve (N + damping · its diagonal) step = g by a Cholesky factor; whether there is one."""
    L = np.zeros((6, 6))
    for a in range(6):
        for b in range(a + 1):
            value = N[a, b] * (1.0 + damping if a == b else 1.0)
            for k in range(b):
                value -= L[a, k] * L[b, k]
            if a == b:
                if not value > 1e-14 * N[a, a]:
                    return False
                L[a, a] = np.sqrt(value)
            else:
                L[a, b] = value / L[b, b]
    for a in range(6):
        value = g[a]
        for k in range(a):
            value -= L[a, k] * step[k]
        step[a] = value / L[a, a]
    for a in range(5, -1, -1):
        value = step[a]
        for k in range(a + 1, 6):
            value -= L[k, a] * step[k]
        step[a] = value / L[a, a]
    return True


@jit
def turned(rotation: Array, step: Array, out: Array) -> None:
    """exp([w]×) R of the first three numbers of a step (Rodrigues)."""
    w0, w1, w2 = step[0], step[1], step[2]
    angle2 = w0 * w0 + w1 * w1 + w2 * w2
    angle = np.sqrt(angle2)
    s, c = (np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2) if angle > 1e-6 else (1.0 - angle2 / 6.0, 0.5)
    for k in range(3):
        r0, r1, r2 = rotation[0, k], rotation[1, k], rotation[2, k]
        a0, a1, a2 = w1 * r2 - w2 * r1, w2 * r0 - w0 * r2, w0 * r1 - w1 * r0
        out[0, k] = r0 + s * a0 + c * (w1 * a2 - w2 * a1)
        out[1, k] = r1 + s * a1 + c * (w2 * a0 - w0 * a2)
        out[2, k] = r2 + s * a2 + c * (w0 * a1 - w1 * a0)


@jit
def fitted_pose(xyz: Array, uv: Array, rotation: Array, shift: Array, fits: Flags) -> None:
    """Improve a pose in place by the points that fit (Levenberg and Marquardt)."""
    N, g, step, turn, moved = np.empty((6, 6)), np.empty(6), np.empty(6), np.empty((3, 3)), np.empty(3)
    ahead, ahead_g = np.empty((6, 6)), np.empty(6)
    cost, damping = normals(xyz, uv, rotation, shift, fits, N, g), 0.0
    for _ in range(STEPS):
        if not damped_step(N, g, damping, step):
            damping = max(10.0 * damping, 1e-6)
            if damping > LARGEST_DAMPING:
                return
            continue
        turned(rotation, step, turn)
        for k in range(3):
            moved[k] = shift[k] + step[3 + k]
        after = normals(xyz, uv, turn, moved, fits, ahead, ahead_g)
        if not after <= cost:
            damping = max(10.0 * damping, 1e-4)
            if damping > LARGEST_DAMPING:
                return
            continue
        rotation[:, :] = turn
        shift[:] = moved
        N[:, :] = ahead
        g[:] = ahead_g
        cost, damping = after, (0.1 * damping if damping > 1e-6 else 0.0)
        size = (step[3] ** 2 + step[4] ** 2 + step[5] ** 2) / (shift[0] ** 2 + shift[1] ** 2 + shift[2] ** 2)
        if step[0] ** 2 + step[1] ** 2 + step[2] ** 2 + size < SMALLEST:
            return


@jit
def refined(xyz: Array, uv: Array, rotation: Array, shift: Array, tolerance: float, fewest: int, fits: Flags) -> float:
    """Improve a pose X → R X + t in place, points that do not fit within the tolerance left out; returns its cost as of `judged`."""
    cost = judged(xyz, uv, rotation, shift, tolerance, fits)
    turn, moved, fit = rotation.copy(), shift.copy(), fits.copy()
    for _ in range(ROUNDS):
        if fits.sum() < fewest:
            return cost
        fitted_pose(xyz, uv, turn, moved, fits)
        new = judged(xyz, uv, turn, moved, tolerance, fit)
        if not new <= cost:
            return cost
        rotation[:, :] = turn
        shift[:] = moved
        fits[:] = fit
        before, cost = cost, new
        if new > GAINED * before:
            return cost
    return cost
