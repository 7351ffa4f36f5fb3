"""A uniform field, with a gradient if wanted: what an integrating sphere shows a sensor, nearly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.camera.light import Points
from pixmetry.core.arrays import Singles
from pixmetry.core.errors import ParameterError
from pixmetry.core.random import Grid


@dataclass(frozen=True)
class Uniform:
    """Mean photons per pixel, the same everywhere or with a linear gradient about the frame's centre.

    Parameters
    ----------
    level_photons : float
        Mean photons per pixel in one exposure at the frame's centre.
    gradient_x_per_px, gradient_y_per_px : float
        Relative change per pixel to the right and downwards.
    reference_exposure_s : float, optional
        If given, ``level_photons`` belongs to this exposure time and scales with the exposure.
    """

    level_photons: float = 0.0
    gradient_x_per_px: float = 0.0
    gradient_y_per_px: float = 0.0
    reference_exposure_s: float | None = None
    moving: ClassVar[bool] = False
    smooth_px: ClassVar[float] = 100.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.level_photons) and self.level_photons >= 0):
            raise ParameterError(
                "the number of photons is not usable", where="uniform.level_photons", value=self.level_photons, allowed="0 or more"
            )

    def photons_scale(self, exposure_s: np.ndarray) -> np.ndarray:
        """How much the light of each exposure differs from ``level_photons``, shape (n,)."""
        return np.ones(len(exposure_s)) if self.reference_exposure_s is None else exposure_s / self.reference_exposure_s

    def photons_map(self, grid: Grid, frame_shape: tuple[int, int]) -> np.ndarray:
        """Relative brightness, shape (n or 1, rows, cols), float32."""
        if not (self.gradient_x_per_px or self.gradient_y_per_px):
            return np.ones((1, *grid.shape), np.float32)
        y = grid.row0[:, None, None] + np.arange(grid.shape[0])[:, None] - 0.5 * (frame_shape[0] - 1)
        x = grid.col0[:, None, None] + np.arange(grid.shape[1]) - 0.5 * (frame_shape[1] - 1)
        return np.maximum(1 + self.gradient_x_per_px * x + self.gradient_y_per_px * y, 0).astype(np.float32)

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        """Photons per pixel, shape (n, rows, cols), float32."""
        light: Singles = (self.level_photons * self.photons_scale(exposure_s)).astype(np.float32)[:, None, None] * np.broadcast_to(
            self.photons_map(grid, frame_shape), grid.size
        )
        return light

    def radiance(self, at: Points) -> np.ndarray:
        """Photons per pixel at points; no blur changes a slope."""
        exposure = np.broadcast_to(np.asarray(at.exposure_s, float), at.x_px.shape)
        if not (self.gradient_x_per_px or self.gradient_y_per_px):
            return self.level_photons * self.photons_scale(exposure.ravel()).reshape(exposure.shape)
        x, y = at.x_px - 0.5 * (at.frame_shape[1] - 1), at.y_px - 0.5 * (at.frame_shape[0] - 1)
        field = np.maximum(1 + self.gradient_x_per_px * x + self.gradient_y_per_px * y, 0)
        return self.level_photons * self.photons_scale(exposure.ravel()).reshape(exposure.shape) * field

    def averaged(self, at: Points, width_px: ArrayLike, height_px: ArrayLike) -> np.ndarray:
        """The same, averaged over boxes."""
        return self.radiance(at)

    def detailed(self, at: Points, reach_px: ArrayLike) -> np.ndarray:
        """Nowhere."""
        return np.zeros(at.x_px.shape, bool)

    def targets(self, time_s: float = 0.0, frame: int = 0) -> list[dict[str, Any]]:
        """None."""
        return []
