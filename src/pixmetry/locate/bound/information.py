"""What a stored grey value tells about the mean it was drawn from: Fisher information of a pixel with noise, rounding and clipping."""

from __future__ import annotations

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.noise import ROUNDING_DN2, NoiseModel

DITHERED_DN = 0.4  # noise from which on rounding acts as further noise of 1/12 DN² (to 5 % of the variance at this noise, 1e-3 at 0.5 DN)
CODES_AT_ENDS_DN = 2.0  # noise up to which the codes near the ends of the scale are taken one by one; above, 0.4 % of the information
LEAST_NOISE_DN = 0.01  # below, grey values tell of a mean only where it crosses a threshold: there is a region of places, no variance
NEAR = 8.0  # standard deviations within which codes, or the ends of the scale, are looked at


def unrounded_variance_dn2(mean: np.ndarray, noise: NoiseModel, rounded: bool) -> np.ndarray:
    """Variance before rounding; same shape, DN².

    Raises
    ------
    InputError
        If rounding alone is more than the model's variance, or there is next to no noise.
    """
    variance = noise.variance_dn2(mean) - (ROUNDING_DN2 if rounded else 0.0)
    if (variance < -1e-9).any():
        raise InputError(
            "the noise is less than rounding makes",
            where="noise",
            value=noise.constant_dn2,
            allowed="a variance of 1/12 DN² or more where values are whole numbers",
            remedy="give the noise with rounding included, or say that values are not rounded",
        )
    if (variance < (LEAST_NOISE_DN**2 if rounded else 1e-300)).any():
        raise InputError(
            "there is no bound without noise" + (f": it is below {LEAST_NOISE_DN} DN before rounding" if rounded else ""),
            where="noise",
            remedy="give the temporal noise of the camera",
        )
    return variance


def information_per_dn2(mean: np.ndarray, noise: NoiseModel, rounded: bool = True) -> np.ndarray:
    """Fisher information of one grey value about its mean, in 1/DN².

    Parameters
    ----------
    mean : ndarray
        Before the ends of the scale cut it off.
    noise : NoiseModel
    rounded : bool
        Whether grey values are whole numbers; the model's variance then holds 1/12 DN² for it.

    Raises
    ------
    InputError
        As `unrounded_variance_dn2`.

    Notes
    -----
    Gaussian noise of known variance V: 1/V. That the variance too depends on the mean, and tells of it (½ V'²/V²), is left out: for Poisson
    light with read noise 1/V is the better approximation of the exact information. Rounding adds 1/12 to V while the noise before it is
    0.4 DN or more; below, the information is the exact one of the codes k, p(k) = Φ((k + ½ − µ)/σ) − Φ((k − ½ − µ)/σ). Values beyond the
    scale's ends all become the end: censored, they tell only that.
    """
    mean = np.asarray(mean, float)
    variance = unrounded_variance_dn2(mean, noise, rounded)
    if not rounded:
        return _censored(mean, np.sqrt(variance), noise.low_dn, noise.high_dn)
    sigma = np.sqrt(variance)
    end = np.minimum(np.abs(mean - noise.low_dn), np.abs(mean - noise.high_dn)) < NEAR * sigma
    by_code = (variance < DITHERED_DN**2) | (end & (sigma < CODES_AT_ENDS_DN))
    out = _censored(mean, np.sqrt(variance + ROUNDING_DN2), noise.low_dn + 0.5, noise.high_dn - 0.5)
    if by_code.any():
        out[by_code] = _of_codes(mean[by_code], sigma[by_code], noise.low_dn, noise.high_dn)
    return out


def exact_codes_matter(mean: np.ndarray, noise: NoiseModel, rounded: bool) -> bool:
    """Whether any pixel has so little noise that the codes are taken one by one."""
    return rounded and bool((unrounded_variance_dn2(mean, noise, rounded) < DITHERED_DN**2).any())


def kept_rounding_dn2(sigma: np.ndarray) -> np.ndarray:
    """Mean square of the error of rounding that stays when values with noise σ are averaged: Σ exp(−4π²k²σ²)/(2π²k²), 1/12 without noise.

    Notes
    -----
    The mean of a rounded value is off by Σ (−1)^k exp(−2π²k²σ²) sin(2πkµ)/(πk); means over µ of its square. B. Widrow, I. Kollár,
    Quantization Noise (2008), ch. 4.
    """
    k = np.arange(1, 200)
    out = np.zeros_like(sigma)
    near = sigma < 1.5 * DITHERED_DN  # beyond, less than 1e-7 DN²
    if near.any():
        out[near] = (np.exp(-((2 * np.pi * k * sigma[near][:, None]) ** 2)) / (2 * np.pi**2 * k**2)).sum(axis=1)
    return out


def _censored(mean: np.ndarray, sigma: np.ndarray, low: float, high: float) -> np.ndarray:
    """1/σ² of the values in between, and what the two ends tell: φ²/P each."""
    from scipy.special import log_ndtr, ndtr

    out = 1 / sigma**2
    for z in ((mean - high) / sigma, (low - mean) / sigma):  # positive: beyond that end
        near = z > -NEAR
        if near.any():
            t = z[near]
            density = np.exp(-0.5 * t**2) / np.sqrt(2 * np.pi)
            piled = np.exp(-(t**2) - np.log(2 * np.pi) - log_ndtr(t))
            # of the values beyond, ∫ t² φ = P(z) − z φ(z) is lost and φ²/P is gained
            out[near] += (piled - (ndtr(t) - t * density)) / sigma[near] ** 2
    return np.maximum(out, 0.0)


def _of_codes(mean: np.ndarray, sigma: np.ndarray, low: float, high: float) -> np.ndarray:
    """Σ (dp/dµ)²/p over the codes."""
    from scipy.special import ndtr

    reach = int(np.ceil(NEAR * sigma.max())) + 1
    edges = np.floor(mean)[..., None] + np.arange(-reach, reach + 2) - 0.5
    edges = np.where(edges < low, -np.inf, np.where(edges > high, np.inf, edges))
    z = (edges - mean[..., None]) / sigma[..., None]
    lower, upper = z[..., :-1], z[..., 1:]
    right = lower > 0  # differences of small numbers on either side
    share = np.where(right, ndtr(-lower) - ndtr(-upper), ndtr(upper) - ndtr(lower))
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi) / sigma[..., None]
    change = density[..., :-1] - density[..., 1:]
    return np.divide(change**2, share, out=np.zeros_like(share), where=share > 1e-300).sum(axis=-1)
