"""Point spreads on the fine raster of the light, made from their transfer functions; Gaussians for the tails that reach beyond it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import nnls
from scipy.special import ndtr

from pixmetry.camera.light import FINE, veil_step
from pixmetry.core.arrays import Array

Transfer = Callable[[np.ndarray, np.ndarray], np.ndarray]
Beyond = Callable[[np.ndarray], np.ndarray]
EDGE = 5e-4  # of an edge's height: what light beyond the farthest Gaussian may change
MOST_OCTAVES = 14
BAND = FINE / 2  # cycles per pixel: the raster's own limit
BLEND = 0.5  # cycles per pixel on both sides of it


def kernel_of(transfer: Transfer, half_cells: int) -> np.ndarray:
    """The point spread of a transfer function at the points of the raster; shape (2 half_cells + 1,) * 2, its sum transfer(0, 0).

    Parameters
    ----------
    transfer : callable
        ``(fx, fy)`` in cycles per pixel, arrays -> ``∬ PSF exp(−2πi (fx x + fy y))``.
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
    return kernel


def spread_of(transfer: Transfer, reach_px: float, beyond: Beyond, pitch_um: tuple[float, float]) -> tuple[np.ndarray, np.ndarray | None]:
    """A point spread with a long tail: its kernel on the fine raster, and Gaussians for the tail beyond.

    Parameters
    ----------
    transfer : callable
        As for `kernel_of`.
    reach_px : float
        Half side of the kernel.
    beyond : callable
        Of the tail: ``d_um -> share of an edge's light`` that is found farther than d on its dark side; used outside the kernel only.
    pitch_um : (float, float)
        In x and y.

    Returns
    -------
    kernel : ndarray
        What the Gaussians leave of the spread. Their transfer functions are taken off exactly, so both together have its own.
    far : ndarray, shape (k, 3), or None
        See `core.light.Light`. None where less than `EDGE` of an edge's light goes beyond the kernel.

    Notes
    -----
    Their deviations double from half the reach on, until less than `EDGE` is beyond three of the last. Their shares, none negative, are
    fitted to the tail at distances from the reach on; the kernel folds back only what they do not hold of it.
    """
    half_cells = int(round(reach_px * FINE))
    reach_um = reach_px * min(pitch_um)
    sigma_um = 0.5 * reach_um * 2.0 ** np.arange(MOST_OCTAVES)
    if beyond(np.array([reach_um]))[0] < EDGE:
        return kernel_of(transfer, half_cells), None
    over = np.flatnonzero(beyond(3 * sigma_um) < EDGE)
    sigma_um = sigma_um[: over[0] + 1] if over.size else sigma_um
    d = np.geomspace(0.8 * reach_um, 3 * sigma_um[-1], 200)
    share, _ = nnls(ndtr(-d[:, None] / sigma_um), beyond(d))
    share *= min(1.0, 0.999 / share.sum())  # where all of the light goes far
    share, sigma_um = share[share > 0], sigma_um[share > 0]
    far = np.stack([share, (sigma_um / pitch_um[0]) ** 2, (sigma_um / pitch_um[1]) ** 2], axis=1)

    def rest(fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        out = transfer(fx, fy)
        for part, across, down in far:  # as the light draws them: linear between points of a lattice
            veil = np.exp(-2 * np.pi**2 * (across * fx**2 + down * fy**2))
            out = out - part * veil * _hat(fx, across) * _hat(fy, down)
        return out

    return kernel_of(rest, half_cells), far


def _hat(f: np.ndarray, variance_px2: float) -> np.ndarray:
    """Transfer function of linear interpolation at the pixels between points some pixels apart."""
    step = veil_step(variance_px2)
    return (np.sinc(step * f) / np.sinc(f)) ** 2 if step > 1 else np.ones_like(f)


def _share(f: np.ndarray) -> np.ndarray:
    """Weight of a frequency: 1 below the band's limit, 0 above it, blended over it; the weights of all periods sum to 1."""
    t = np.clip((np.abs(f) - BAND + BLEND) / (2 * BLEND), 0.0, 1.0)
    share: Array = np.cos(0.5 * np.pi * t) ** 2
    return share
