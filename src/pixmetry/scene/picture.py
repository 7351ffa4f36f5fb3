"""A scene made of layers on one background, under one lighting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.camera.light import Points
from pixmetry.core.arrays import Array, Singles
from pixmetry.core.random import Grid
from pixmetry.scene.lighting import Lighting
from pixmetry.scene.shapes import pixel_points
from pixmetry.scene.uniform import Uniform


class Layer(Protocol):
    """Part of a scene: see `Shapes` for what each method gives."""

    @property
    def moving(self) -> bool: ...
    @property
    def smooth_px(self) -> float: ...
    @property
    def own_light(self) -> bool: ...  # whether the scene's lighting does not act on it
    def render(self, grid: Grid, frame_shape: tuple[int, int], time_s: np.ndarray, exposure_s: np.ndarray, lit: bool) -> np.ndarray: ...
    def sums(self, at: Points, width_px: ArrayLike, height_px: ArrayLike, lit: bool) -> np.ndarray: ...
    def detailed(self, at: Points, reach_px: ArrayLike) -> np.ndarray: ...
    def targets(self, time_s: float, frame: int) -> list[dict[str, Any]]: ...


@dataclass(frozen=True)
class Picture:
    """Layers whose light adds up.

    Parameters
    ----------
    layers : sequence of layers
        `Shapes`, `Sine`, `Speckle`.
    background : Uniform
        Its ``reference_exposure_s`` scales the layers too.
    lighting : Lighting, optional
        A factor on the light before the blur, of all layers but a laser's. Over the blur and the box, it is taken as linear.
    """

    layers: Sequence[Layer]
    background: Uniform = field(default_factory=Uniform)
    lighting: Lighting | None = None

    @property
    def moving(self) -> bool:
        """Whether anything depends on time or frame."""
        return any(layer.moving for layer in self.layers)

    @property
    def smooth_px(self) -> float:
        """Blur of the sharpest layer."""
        return min((layer.smooth_px for layer in self.layers), default=100.0)

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        """Photons of full pixels in the middle of the exposure, shape (n, rows, cols), float32."""
        lit = self.lighting is not None
        middle = np.asarray(time_s, float) + 0.5 * np.asarray(exposure_s, float)
        total, own = np.zeros((3 if lit else 1, *grid.size)), np.zeros(grid.size)
        for layer in self.layers:
            light = layer.render(grid, frame_shape, middle, exposure_s, lit)
            if layer.own_light:
                own += light[:, 0]
            else:
                total += light.swapaxes(0, 1)
        scale = self.background.photons_scale(exposure_s)[:, None, None]
        total *= scale
        total[0] += self.background.photons(grid, frame_shape, exposure_s, time_s)
        at = pixel_points(grid, frame_shape, middle, exposure_s) if lit else None
        seen: Singles = np.maximum(self._lit(total, at) + own * scale, 0.0).astype(np.float32)
        return seen

    def radiance(self, at: Points) -> np.ndarray:
        """Light at points after the blur, float64."""
        return self.averaged(at, np.float64(0), np.float64(0))

    def averaged(self, at: Points, width_px: ArrayLike, height_px: ArrayLike) -> np.ndarray:
        """Light after the blur, averaged over an upright box of this size about each point."""
        lit = self.lighting is not None
        total, own = np.zeros((3 if lit else 1, *at.x_px.shape)), np.zeros(at.x_px.shape)
        for layer in self.layers:
            light = layer.sums(at, width_px, height_px, lit)
            if layer.own_light:
                own += light[0]
            else:
                total += light
        exposure = np.broadcast_to(at.exposure_s, at.x_px.shape)
        scale = self.background.photons_scale(exposure.ravel()).reshape(exposure.shape)
        total *= scale
        total[0] += self.background.radiance(at)
        seen: Array = np.maximum(self._lit(total, at) + own * scale, 0.0)
        return seen

    def _lit(self, total: Array, at: Points | None) -> Array:
        lit: Array = total[0]
        if self.lighting is None or at is None:
            return lit
        factor, along_x, along_y = self.lighting.with_slopes(at.x_px, at.y_px)
        lit = factor * total[0] + along_x * total[1] + along_y * total[2]
        return lit

    def detailed(self, at: Points, reach_px: ArrayLike) -> np.ndarray:
        """Where the light may vary by more than a slope within a reach of each point."""
        found = np.zeros(at.x_px.shape, bool)
        for layer in self.layers:
            found |= layer.detailed(at, reach_px)
        return found

    def targets(self, time_s: float = 0.0, frame: int = 0) -> list[dict[str, Any]]:
        """True places of all targets at a time."""
        return [t for layer in self.layers for t in layer.targets(time_s, frame)]
