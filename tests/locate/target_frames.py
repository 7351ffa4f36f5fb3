"""Frames of many equal targets at random phases, what a detection would say of them, and z-scores of what was found."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chndtr

from locate import rendered
from pixmetry.locate.detect.targets import Positions, Targets


def half_height(radius: float, blur: float) -> tuple[float, float]:
    """Radius at half height and peak of a blurred disc, the pixel as a part of the blur: the noncentral χ² law."""
    s = math.hypot(blur, 12**-0.5)
    r = np.linspace(0, radius + 6 * s, 4000)
    profile = chndtr((radius / s) ** 2, 2, (r / s) ** 2)
    return float(np.interp(-0.5 * profile[0], -profile, r)), float(profile[0])


def rough_targets(
    x: np.ndarray, y: np.ndarray, major: float | np.ndarray, minor: float | np.ndarray, blur: float, amplitude: float, background: float,
    rng: np.random.Generator, angle_deg: float = 0.0, sigma: float = 1.0,
) -> Targets:  # fmt: skip
    """What a detection would hand over: places off by up to 0.1 px."""
    one = np.ones(len(x))
    reach = major * one
    left, right, top, bottom = (np.nan_to_num(v).astype(int) for v in (x - reach, x + reach + 2, y - reach, y + reach + 2))
    return Targets(
        x_px=x + rng.uniform(-0.1, 0.1, len(x)), y_px=y + rng.uniform(-0.1, 0.1, len(x)), semi_major_px=major * one,
        semi_minor_px=minor * one, angle_deg=angle_deg * one, blur_px=math.hypot(blur, 12**-0.5) * one, amplitude_dn=amplitude * one,
        background_dn=background * one, background_x_dn_per_px=0 * one, background_y_dn_per_px=0 * one, sigma_dn=sigma * one,
        row_first=top, row_stop=bottom, col_first=left, col_stop=right, flags=np.zeros(len(x), np.uint32),
    )  # fmt: skip


def draw_lattice(
    rng: np.random.Generator, radius: float, blur: float, *, side: int = 13, amplitude: float = 180.0, background: float = 20.0,
    minor: float = 0.0, angle_deg: float = 0.0, aperture: float = 1.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Mean image of side × side targets at random phases, far from each other, and their places."""
    pitch = int(2 * radius + 14 * max(math.hypot(blur, 0.29), 0.5) + 14)
    rows, cols = np.divmod(np.arange(side * side), side)
    x, y = ((n + 0.5) * pitch + rng.uniform(-0.5, 0.5, side * side) for n in (cols, rows))
    images = []
    for a, b in zip(x, y, strict=True):
        at = rendered.window(a, b, radius + 6 * math.hypot(blur, 0.3) + 1)
        images.append((at, rendered.ellipse(a, b, radius, minor or radius, angle_deg, blur, at, aperture=aperture)))
    mean = rendered.planted((side * pitch, side * pitch), background, amplitude, images)
    for values in (mean, x, y):
        values.setflags(write=False)
    return mean, x, y


def z_scores(found: Positions, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Two z-scores of each target, from its whole covariance: errors through the inverse of its Cholesky factor."""
    ex, ey = found.x_px - x, found.y_px - y
    first = ex / np.sqrt(found.var_x_px2)
    slope = found.cov_xy_px2 / found.var_x_px2
    return np.concatenate([first, (ey - slope * ex) / np.sqrt(found.var_y_px2 - slope * found.cov_xy_px2)])
