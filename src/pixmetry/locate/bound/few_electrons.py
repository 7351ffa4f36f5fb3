"""How much more a reading with few electrons tells than its variance says."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from pixmetry.locate.template._template_kernels import LEAST_ELECTRONS, MOST_ELECTRONS, PER_E

GAUSSIAN_FROM_E = 3.0  # read noise in electrons from which a reading is taken as normal with the variance of its mean


@lru_cache(maxsize=8)
def efficiency(sigma_e: float) -> np.ndarray:
    """Return Fisher's information of a reading about its mean, times its variance.

    A reading is d = n + e with n Poisson of mean µ and e normal of standard deviation ``sigma_e``, in electrons. Its information is
    I(µ) = E[(E[n | d]/µ − 1)²], and I · (µ + σ²) → 1 for many electrons or much noise, where the likelihood of a Poisson number shifted by
    σ² does as well.

    Parameters
    ----------
    sigma_e : float
        Above 0.

    Returns
    -------
    ndarray, float64
        At µ = `LEAST_ELECTRONS` exp(k / `PER_E`), k = 0, 1, …, up to `MOST_ELECTRONS`; empty where the read noise is so large that nothing
        is gained.

    References
    ----------
    D. L. Snyder, C. W. Helstrom, A. D. Lanterman, M. Faisal, R. L. White, J. Opt. Soc. Am. A 12(2), 272 (1995), for the likelihood of
    Poisson numbers with normal read noise. F. Huang et al., Nature Methods 10, 653 (2013), for the shifted Poisson number.
    """
    if sigma_e > GAUSSIAN_FROM_E:
        return np.empty(0)
    sigma = max(sigma_e, 0.05)
    mean = LEAST_ELECTRONS * np.exp(np.arange(int(np.log(MOST_ELECTRONS / LEAST_ELECTRONS) * PER_E) + 2) / PER_E)
    n = np.arange(int(MOST_ELECTRONS + 10 * np.sqrt(MOST_ELECTRONS)))
    factorials = np.concatenate([[0.0], np.cumsum(np.log(n[1:]))])
    poisson = np.exp(n * np.log(mean)[:, None] - mean[:, None] - factorials)
    step = sigma / 5
    d = np.arange(-7 * sigma, n[-1] + 7 * sigma, step)
    read = np.exp(-0.5 * ((d - n[:, None]) / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
    density = poisson @ read
    along = (poisson * n) @ read
    information = (np.where(density > 1e-290, along**2 / np.maximum(density, 1e-290), 0.0).sum(axis=1) * step) / mean**2 - 1
    return information * (mean + sigma**2)
