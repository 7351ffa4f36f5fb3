"""Frames with upright bars whose rows come early or late: written without the package."""

from __future__ import annotations

import numpy as np
from scipy.special import erf


def jitter(rng: np.random.Generator, frames: int, rows: int, white: float, loop: float = 0.0, length: float = 5.0, stride: int = 2):
    """Shift of each row in px, shape (frames, rows): white, and alike over some lines of a field."""
    shift = white * rng.standard_normal((frames, rows))
    rho = np.exp(-1 / length)
    for first in range(stride):
        state = rng.standard_normal(frames)
        for row in range(first, rows, stride):
            shift[:, row] += loop * state
            state = rho * state + np.sqrt(1 - rho**2) * rng.standard_normal(frames)
    return shift


def bars(
    rng: np.random.Generator, shift: np.ndarray, at: list[tuple[float, float]], *, cols: int = 160, slope: float = 0.02,
    sigma: float = 0.8, low: float = 60.0, height: float = 600.0, gain: float = 0.3, dark: float = 2.0, prnu: float = 0.005,
    motion: float = 0.1, row_noise: float = 0.0, bend: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Stored frames of 12 bits: bars from ``a`` to ``b`` px (centre columns, whole-pixel apertures and a Gaussian lens)."""
    frames, rows = shift.shape
    x, y = np.arange(cols), np.arange(rows)
    moved = motion * rng.standard_normal((frames, 1)) + 2e-4 * rng.standard_normal((frames, 1)) * (y - rows / 2)
    place = shift + moved + slope * (y - rows / 2) + (0 if bend is None else bend)

    def ramp(t):  # integral of the Gaussian's distribution, whose differences are means over pixels
        return t * 0.5 * (1 + erf(t / sigma / np.sqrt(2))) + sigma / np.sqrt(2 * np.pi) * np.exp(-0.5 * (t / sigma) ** 2)

    light = np.full((frames, rows, cols), low / gain)
    for a, b in at:
        for edge, sign in ((a, 1), (b, -1)):
            t = x - (edge + place[:, :, None])
            light += sign * height / gain * (ramp(t + 0.5) - ramp(t - 0.5))
    light *= 1 + prnu * rng.standard_normal((rows, cols))
    dn = gain * rng.poisson(light) + 20 + dark * rng.standard_normal(light.shape) + row_noise * rng.standard_normal((frames, rows, 1))
    return np.clip(np.rint(dn), 0, 4095).astype(np.uint16)
