"""How an error source reaches a target's position: the linear response of an estimator, and the contribution that comes of it.

Classes, by what averages a contribution: ``T`` temporal, pixel by pixel or frame by frame, and ``Tr`` temporal, common to a row: over
frames and targets; ``F`` fixed, changes with the sub-pixel phase or the place on the sensor: over targets; ``G`` smooth geometric
mapping: by neither, self-calibration absorbs part; ``D`` drift: by neither; ``O`` object and illumination: by neither.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

AVERAGES = {  # (over frames, over targets)
    "T": (True, True),
    "Tr": (True, True),
    "F": (False, True),
    "G": (False, False),
    "D": (False, False),
    "O": (False, False),
}


@dataclass(frozen=True)
class Contribution:
    """What one source adds to the position of one target in one frame, k = 1.

    ``bias_*`` is the mean shift over all phases and places, ``u_*`` the standard deviation about it. ``model_error`` is the relative
    error that the propagator declares for its ``u`` and ``bias`` (the larger of it and ``floor_px`` holds).
    """

    u_x_px: float
    u_y_px: float
    gum_class: str
    bias_x_px: float = 0.0
    bias_y_px: float = 0.0
    model_error: float = 0.1
    floor_px: float = 2e-4
    method: str = ""

    @property
    def total_px(self) -> float:
        """Root mean square over x and y of random part and bias together."""
        return float(np.sqrt(0.5 * (self.u_x_px**2 + self.u_y_px**2 + self.bias_x_px**2 + self.bias_y_px**2)))


@dataclass(frozen=True)
class Probe:
    """A target seen through an estimator, noise-free, at several places within the pixel.

    Parameters
    ----------
    signal_dn : ndarray, shape (p, rows, cols), float64
        Linear signal above black (background and target) in DN, at p sub-pixel phases.
    background_dn : float
        Linear signal of the background.
    x_px, y_px : ndarray, shape (p,)
        True positions in window coordinates (0 is the centre of the window's first pixel).
    x_hat_px, y_hat_px : ndarray, shape (p,)
        What the estimator gives without any error source.
    gx, gy : ndarray, shape (p, rows, cols)
        Change of the estimated x and y per DN added to a pixel: the estimator's gradient.
    gain_dn_per_e, exposure_s, temperature_c, bits : float
        Of the camera under which the target is seen.
    frame_shape : (int, int)
    locate : callable, optional
        The estimator itself, (p, rows, cols) DN to x and y in window coordinates, for changes that are too large for its gradient.
    """

    signal_dn: np.ndarray
    background_dn: float
    x_px: np.ndarray
    y_px: np.ndarray
    x_hat_px: np.ndarray
    y_hat_px: np.ndarray
    gx: np.ndarray
    gy: np.ndarray
    gain_dn_per_e: float
    exposure_s: float
    temperature_c: float
    bits: int
    frame_shape: tuple[int, int]
    locate: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None

    def white(self, sigma_dn: np.ndarray | float) -> tuple[float, float]:
        """u_x, u_y from independent errors of standard deviation ``sigma_dn`` (scalar or per pixel) in every pixel."""
        var = np.broadcast_to(np.asarray(sigma_dn, float) ** 2, self.gx.shape)
        u_x, u_y = (float(np.sqrt((g**2 * var).sum(axis=(1, 2)).mean())) for g in (self.gx, self.gy))
        return u_x, u_y

    def rows(self, sigma_dn: np.ndarray | float) -> tuple[float, float]:
        """u_x, u_y from errors common to each row; ``sigma_dn`` scalar, or per pixel for one that scales with the signal."""
        return self._lines(sigma_dn, axis=2)

    def columns(self, sigma_dn: np.ndarray | float) -> tuple[float, float]:
        """u_x, u_y from errors common to each column."""
        return self._lines(sigma_dn, axis=1)

    def _lines(self, sigma_dn: np.ndarray | float, axis: int) -> tuple[float, float]:
        weight = np.broadcast_to(np.asarray(sigma_dn, float), self.gx.shape)
        u_x, u_y = (float(np.sqrt(((g * weight).sum(axis=axis) ** 2).sum(axis=1).mean())) for g in (self.gx, self.gy))
        return u_x, u_y

    def field(self, error_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shift in x and y, shape (p,), from a given error field (p, rows, cols) or (rows, cols) in DN (first order)."""
        return (self.gx * error_dn).sum(axis=(1, 2)), (self.gy * error_dn).sum(axis=(1, 2))

    def moved(self, signal_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shift in x and y, shape (p,), when the signal becomes this one; by the estimator itself, or to first order if it is not given."""
        if self.locate is None:
            return self.field(signal_dn - self.signal_dn)
        x, y = self.locate(signal_dn)
        return x - self.x_hat_px, y - self.y_hat_px

    def contribution(self, u: tuple[float, float], gum_class: str, **kw: Any) -> Contribution:
        """Shorthand for a contribution without bias."""
        return Contribution(u_x_px=u[0], u_y_px=u[1], gum_class=gum_class, **kw)

    def from_shifts(
        self, dx: np.ndarray, dy: np.ndarray, gum_class: str, beside: tuple[float, float] = (0.0, 0.0), **kw: Any
    ) -> Contribution:
        """Contribution from shifts at each phase: their mean is the bias, their scatter the uncertainty, with that of ``beside`` (x, y)."""
        return Contribution(
            u_x_px=float(np.hypot(np.std(dx), beside[0])),
            u_y_px=float(np.hypot(np.std(dy), beside[1])),
            bias_x_px=float(np.mean(dx)),
            bias_y_px=float(np.mean(dy)),
            gum_class=gum_class,
            **kw,
        )
