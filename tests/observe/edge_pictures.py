"""Pictures of blurred edges in closed form, made without the package."""

from __future__ import annotations

import numpy as np
from scipy.special import erf


def spread(d: np.ndarray, sigma: float, width: float = 1.0) -> np.ndarray:
    """Edge spread function of a Gaussian blur and a box of some width, both along the normal: 0 to 1."""

    def integral(z: np.ndarray) -> np.ndarray:
        return z * 0.5 * (1 + erf(z / (sigma * np.sqrt(2)))) + sigma * np.exp(-0.5 * (z / sigma) ** 2) / np.sqrt(2 * np.pi)

    return (integral(d + width / 2) - integral(d - width / 2)) / width


def response(frequency: np.ndarray, sigma: float, width: float = 1.0) -> np.ndarray:
    """Its frequency response."""
    return np.exp(-2 * (np.pi * sigma * frequency) ** 2) * np.abs(np.sinc(width * frequency))


def one_edge(
    rng: np.random.Generator,
    angle_deg: float = 5.0,
    shape=(120, 100),
    sigma=0.5,
    low=200.0,
    high=1200.0,
    noise=5.0,
    bend_px=0.0,
    at_px=None,
) -> np.ndarray:
    """A nearly vertical edge through the middle, or ``at_px``, brighter to the right; ``bend_px`` bows it at the ends."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    t = (y - 0.5 * (shape[0] - 1)) / (0.5 * shape[0])
    middle = 0.5 * (shape[1] - 1) + rng.uniform(-0.5, 0.5) if at_px is None else at_px
    at = middle + np.tan(np.radians(angle_deg)) * (y - 0.5 * (shape[0] - 1)) + bend_px * t**2
    clean = low + (high - low) * spread((x - at) * np.cos(np.radians(angle_deg)), sigma)
    return clean + noise * rng.standard_normal(shape)


def squares(
    rng: np.random.Generator, shape=(420, 420), cell=200, sigma=0.5, angle_deg=5.0, low=200.0, high=1200.0, noise=5.0
) -> np.ndarray:
    """Bright squares turned by an angle, one in the middle of each cell, of 0.6 of its side: four edges each."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    out = np.full(shape, float(low))
    for cy in range(cell // 2, shape[0] - cell // 4, cell):
        for cx in range(cell // 2, shape[1] - cell // 4, cell):
            dx, dy = x - cx - rng.uniform(-0.5, 0.5), y - cy - rng.uniform(-0.5, 0.5)
            sides = [spread(v + 0.3 * cell, sigma) - spread(v - 0.3 * cell, sigma) for v in (dx * c + dy * s, dy * c - dx * s)]
            out += (high - low) * sides[0] * sides[1]
    return out + noise * rng.standard_normal(shape)


def stored(values: np.ndarray, top: int = 4095) -> np.ndarray:
    """Whole numbers within the scale, 16 bits."""
    return np.clip(np.rint(values), 0, top).astype(np.uint16)
