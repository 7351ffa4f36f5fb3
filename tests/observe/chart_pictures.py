"""Pictures of grey charts and of scenes behind a camera's curve, made without the package."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

TOP = 4095


def power(gamma: float = 0.45, reference: float = TOP) -> Callable[[np.ndarray], np.ndarray]:
    """A pure power curve, odd about black."""
    return lambda x: np.sign(x) * reference * (np.abs(x) / reference) ** gamma


def bt709(reference: float = TOP) -> Callable[[np.ndarray], np.ndarray]:
    """ITU-R BT.709-6, item 1.2, as printed."""

    def curve(x: np.ndarray) -> np.ndarray:
        v = np.abs(x) / reference
        return np.sign(x) * reference * np.where(v < 0.018, 4.5 * v, 1.099 * np.maximum(v, 1e-12) ** 0.45 - 0.099)

    return curve


def srgb(reference: float = TOP) -> Callable[[np.ndarray], np.ndarray]:
    """IEC 61966-2-1, as printed."""

    def curve(x: np.ndarray) -> np.ndarray:
        v = np.abs(x) / reference
        return np.sign(x) * reference * np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 1e-12) ** (1 / 2.4) - 0.055)

    return curve


def knee(at: float, slope: float) -> Callable[[np.ndarray], np.ndarray]:
    """A straight line with a bend."""
    return lambda x: np.where(x > at, at + slope * (x - at), x)


def expose(
    rng: np.random.Generator,
    electrons: np.ndarray,
    curve: Callable[[np.ndarray], np.ndarray],
    frames: int = 2,
    *,
    gain: float = 0.4,
    dark_noise_e: float = 8.0,
    black: float = 100.0,
    noise_dn: float = 0.0,
    prnu: np.ndarray | float = 1.0,
    top: int = TOP,
) -> np.ndarray:
    """Frames of a camera: shot noise, read noise, gain, curve, noise behind it, black level, rounding."""
    shape = (frames, *electrons.shape)
    e = rng.poisson(electrons * prnu, shape) + dark_noise_e * rng.standard_normal(shape)
    return np.clip(np.rint(curve(gain * e) + noise_dn * rng.standard_normal(shape) + black), 0, top).astype(np.uint16)


def wedge(
    densities: np.ndarray, white_e: float, *, side: int = 48, gap: int = 12, columns: int = 6, surround: float = 0.18
) -> tuple[np.ndarray, list[tuple[int, int, int, int]]]:
    """Electrons of a chart of square patches, and their places (x, y, width, height)."""
    rows = -(-len(densities) // columns)
    pitch = side + gap
    light = np.full((rows * pitch + gap, columns * pitch + gap), surround)
    places = []
    for k, d in enumerate(densities):
        y, x = gap + (k // columns) * pitch, gap + (k % columns) * pitch
        light[y : y + side, x : x + side] = 10.0**-d
        places.append((x, y, side, side))
    return white_e * light, places


def field_of(shape: tuple[int, int], x: float, y: float, bow: float) -> np.ndarray:
    """Uneven light, 1 in the middle."""
    v, u = (np.linspace(-1, 1, n) for n in shape)
    return np.exp(x * u[None, :] + y * v[:, None] + bow * (u[None, :] ** 2 + v[:, None] ** 2))
