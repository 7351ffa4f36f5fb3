"""Centroids of grey values over a fixed square of pixels, plain, squared, or above a threshold, and how they answer to each pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.centroids._moment_kernels import CENTROID, HARD, SOFT, SQUARED, locate_windows
from pixmetry.locate.estimator import KnownTarget

LAWS = {"centroid": CENTROID, "squared_centroid": SQUARED, "soft_threshold": SOFT, "hard_threshold": HARD}
PREFIX = "fixed_"  # of their names: what pixmetry locate runs under the same law follows the target with its window
THRESHOLDED = ("soft_threshold", "hard_threshold")


@dataclass(frozen=True)
class FixedCentroid:
    """A centroid x̂ = Σ f(I_i) x_i / Σ f(I_i) over a square of pixels about the one that is nearest to the target.

    That is what a program of one's own may do; its name is that of its law after ``fixed_``. The estimators of `pixmetry locate` are in
    `TargetEstimator`.

    Parameters
    ----------
    law : {"centroid", "squared_centroid", "soft_threshold", "hard_threshold"}
        With I the grey value above the background and T the threshold, f is I, I², max(I − T, 0), or I where I > T and 0 elsewhere.
    window : int
        Side of the square in pixels, odd.
    sigma : float, optional
        Threshold in standard deviations of the background's noise; `resolved` turns it into DN. By default 3 where a threshold is used.
    threshold_dn : float, optional
        Threshold above the background in DN; known at once, or by `resolved`.
    background_dn : float
        Grey value that is taken as zero.

    Raises
    ------
    InputError
        If the law is unknown, the window is not an odd number, or the threshold is negative.

    References
    ----------
    H. C. van Assen, M. Egmont-Petersen, J. H. C. Reiber, IEEE Trans. Image Processing 11(12), 1379 (2002), for the bias and variance of
    centroids of grey values above a threshold. S. S. Welch, NASA TP-3331 (1993), for the effects of pixel size, noise and window.
    """

    law: str = "soft_threshold"
    window: int = 13
    sigma: float | None = None
    threshold_dn: float | None = None
    background_dn: float = 0.0

    def __post_init__(self) -> None:
        if self.law not in LAWS:
            raise InputError("no such law of a centroid", value=self.law, allowed=", ".join(LAWS))
        if self.window != int(self.window) or self.window < 3 or self.window % 2 == 0:
            raise InputError("the estimator's window has no central pixel", value=self.window, allowed="an odd number of pixels from 3 on")
        for value in (self.sigma, self.threshold_dn):
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise InputError("the threshold is below the background", value=value, allowed="0 or more")
        if self.law in THRESHOLDED:
            if self.sigma is None and self.threshold_dn is None:
                object.__setattr__(self, "sigma", 3.0)
        elif self.sigma is not None or self.threshold_dn is not None:
            raise InputError(f"a {self.law} has no threshold", allowed=f"only window=, or one of {', '.join(THRESHOLDED)}")

    @property
    def name(self) -> str:
        """As on the command line."""
        return PREFIX + self.law

    @property
    def by_differences(self) -> bool:
        """Its gradient is known in closed form."""
        return False

    def resolved(self, background_dn: float, noise_dn: float, target: KnownTarget | None = None) -> FixedCentroid:
        """Return it for a given background and standard deviation of its noise: a threshold in sigma becomes one in DN."""
        threshold = self.threshold_dn if self.sigma is None else self.sigma * noise_dn
        return replace(self, threshold_dn=threshold, background_dn=background_dn)

    def as_seen(self, level_dn: Callable[[float], float]) -> FixedCentroid:
        """Return it with background and threshold as a camera shows them; ``level_dn`` gives the grey value of light so much above it."""
        ground = level_dn(0.0)
        threshold = None if self.threshold_dn is None else level_dn(self.threshold_dn) - ground
        return replace(self, background_dn=ground, threshold_dn=threshold, sigma=None)

    def locate(self, windows_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Estimate one position a window.

        Parameters
        ----------
        windows_dn : ndarray, shape (n, rows, cols)
            Grey values; the square of `window` pixels lies about pixel ``(rows // 2, cols // 2)`` and must fit.

        Returns
        -------
        x, y : ndarray, shape (n,), float64
            In window coordinates: 0 is the centre of the first pixel. NaN where no light is left (Σ f ≤ 0).

        Raises
        ------
        InputError
            If the square does not fit, or the threshold in DN is not known.
        """
        data = windows_dn if windows_dn.dtype in (np.float32, np.float64) else windows_dn.astype(np.float32)
        r, c = self._square(data.shape)
        return locate_windows(data, LAWS[self.law], float(self.background_dn), self._threshold(), (r.start, r.stop), (c.start, c.stop))

    def gradient(self, windows_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how the estimated x and y change per DN added to each pixel, two arrays of shape (n, rows, cols), float64.

        Notes
        -----
        dx̂/dI_i = f'(I_i)(x_i − x̂)/Σf, zero outside the square. What a pixel does that crosses a hard threshold (a jump, not a slope) is
        not in it, nor is a square that follows the estimate.
        """
        r, c = self._square(windows_dn.shape)
        value = np.asarray(windows_dn, float)[:, r, c] - self.background_dn
        weight, slope = self._law(value)
        total = weight.sum(axis=(1, 2), keepdims=True)
        total = np.where(total > 0, total, np.nan)
        x, y = np.arange(c.start, c.stop, dtype=float), np.arange(r.start, r.stop, dtype=float)[:, None]
        gx, gy = np.zeros(windows_dn.shape), np.zeros(windows_dn.shape)
        gx[:, r, c] = slope * (x - (weight * x).sum(axis=(1, 2), keepdims=True) / total) / total
        gy[:, r, c] = slope * (y - (weight * y).sum(axis=(1, 2), keepdims=True) / total) / total
        return gx, gy

    def describe(self) -> str:
        """Say it in words."""
        text = f"{self.law.replace('_', ' ')} in a fixed square of {self.window} × {self.window} px"
        if self.law in THRESHOLDED:
            sigma = "" if self.sigma is None else f"{self.sigma:g} standard deviations"
            level = "" if self.threshold_dn is None else f"{self.threshold_dn:.3g} DN"
            text += ", " + " = ".join(t for t in (sigma, level) if t) + " above the background"
        return text

    def _law(self, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.law == "centroid":
            return value, np.ones_like(value)
        if self.law == "squared_centroid":
            return value**2, 2 * value
        above = value > self._threshold()
        return np.where(above, value - (self._threshold() if self.law == "soft_threshold" else 0.0), 0.0), above.astype(float)

    def _threshold(self) -> float:
        if self.law not in THRESHOLDED:
            return 0.0
        if self.threshold_dn is None:
            raise InputError("the threshold is given in standard deviations of a noise that is not known", remedy="call resolved() first")
        return float(self.threshold_dn)

    def _square(self, shape: tuple[int, ...]) -> tuple[slice, slice]:
        half = self.window // 2
        middle = [side // 2 for side in shape[1:]]
        if any(m - half < 0 or m + half >= side for m, side in zip(middle, shape[1:], strict=True)):
            raise InputError("the estimator's window does not fit", value=shape[1:], allowed=f"at least {self.window} × {self.window} px")
        rows, cols = (slice(m - half, m + half + 1) for m in middle)
        return rows, cols
