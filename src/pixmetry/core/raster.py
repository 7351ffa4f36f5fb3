"""Point spreads on the fine raster of the light, made from their transfer functions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pixmetry.core.light import FINE

Transfer = Callable[[np.ndarray, np.ndarray], np.ndarray]
BAND = FINE / 2  # cycles per pixel: the raster's own limit
BLEND = 0.5  # cycles per pixel on both sides of it


def kernel_of(transfer: Transfer, half_cells: int) -> np.ndarray:
    """The point spread of a transfer function at the points of the raster; shape (2 half_cells + 1,) * 2, sum 1.

    Parameters
    ----------
    transfer : callable
        ``(fx, fy)`` in cycles per pixel, arrays -> ``∬ PSF exp(−2πi (fx x + fy y))``, 1 at 0.
    half_cells : int
        Points on each side of the middle one.

    Notes
    -----
    The transfer function is sampled at multiples of 1/side and kept there exactly; what the spread has beyond the side is folded back
    into it (so that none of it is lost or lent to the core). Up to `BAND` − `BLEND` cycles per pixel the raster has the transfer
    function itself; around `BAND` it goes over smoothly into the periods of the raster.
    """
    side = 2 * half_cells + 1
    f_x, f_y = np.fft.rfftfreq(side, 1 / FINE), np.fft.fftfreq(side, 1 / FINE)  # the other half is the conjugate
    spectrum = np.zeros((f_y.size, f_x.size), complex)
    for period_x in (-FINE, 0, FINE):  # of the raster
        for period_y in (-FINE, 0, FINE):
            wx, wy = _share(f_x + period_x), _share(f_y + period_y)
            ix, iy = np.flatnonzero(wx), np.flatnonzero(wy)
            if ix.size and iy.size:
                fy, fx = np.meshgrid(f_y[iy] + period_y, f_x[ix] + period_x, indexing="ij")
                spectrum[np.ix_(iy, ix)] += wy[iy][:, None] * wx[ix] * transfer(fx, fy)
    kernel = np.fft.fftshift(np.fft.irfft2(spectrum, s=(side, side)))
    return kernel / kernel.sum()


def _share(f: np.ndarray) -> np.ndarray:
    """Weight of a frequency: 1 below the band's limit, 0 above it, blended over it; the weights of all periods sum to 1."""
    t = np.clip((np.abs(f) - BAND + BLEND) / (2 * BLEND), 0.0, 1.0)
    return np.cos(0.5 * np.pi * t) ** 2
