"""Gaussian profiles and targets on the pixel grid, and the converter that stores them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

TOP_DN = 255  # of 8 bits


def gaussian(x_px: ArrayLike, sigma_px: float, integrated: bool = True) -> np.ndarray:
    """Gaussian of height 1 at distances ``x_px`` from its centre: averaged over the pixel, or sampled at the pixel's centre.

    Parameters
    ----------
    x_px : array_like
        Pixel centre less centre of the profile.
    sigma_px : float
        Standard deviation, without the pixel.
    integrated : bool
        Mean over a pixel of full width, or the value at its centre.

    Returns
    -------
    ndarray, float64, same shape
    """
    from scipy.special import erf

    x = np.asarray(x_px, float)
    if not integrated:
        return np.exp(-0.5 * (x / sigma_px) ** 2)
    scale = np.sqrt(2.0) * sigma_px
    return np.sqrt(np.pi / 2) * sigma_px * (erf((x + 0.5) / scale) - erf((x - 0.5) / scale))


def stored(level_dn: np.ndarray, conversion: str = "rounded") -> np.ndarray:
    """What an 8-bit converter makes of a level: "unquantised" only cuts off at 0, "rounded" and "truncated" make whole numbers first.

    Returns
    -------
    ndarray, same shape, float64
        Within 0 … 255.
    """
    level = np.asarray(level_dn, float)
    if conversion != "unquantised":
        level = {"rounded": np.rint, "truncated": np.floor}[conversion](level)
    return np.clip(level, 0.0, TOP_DN)
