"""Scenes in closed form for the tests of sources that act on light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.light import Points
from pixmetry.camera.signal import Signal
from pixmetry.camera.source import Parameters, Source
from pixmetry.core.random import Grid

MEAN = 1e4


@dataclass(frozen=True)
class Wave:
    """``MEAN (1 + cos(2π (fx x + fy y) − phase))``, with the phase of frame 0 being 0 and that of frame 1 a quarter turn."""

    fx: float
    fy: float
    x0: float
    y0: float
    moving = True
    smooth_px = 0.12

    def radiance(self, at: Points) -> np.ndarray:
        angle = 2 * np.pi * (self.fx * (at.x_px - self.x0) + self.fy * (at.y_px - self.y0))
        fall = np.exp(-2 * (np.pi * at.blur_px) ** 2 * (self.fx**2 + self.fy**2))
        return MEAN * (1 + fall * np.cos(angle - 0.5 * np.pi * at.frame))


@dataclass(frozen=True)
class Spot:
    """A round Gaussian spot, its centre at (x[k], y[k]) in frame k; of ``MEAN`` photons in all."""

    x: np.ndarray
    y: np.ndarray
    sigma: float
    moving = True

    @property
    def smooth_px(self) -> float:
        return self.sigma

    def radiance(self, at: Points) -> np.ndarray:
        var = self.sigma**2 + at.blur_px**2
        r2 = (at.x_px - self.x[at.frame]) ** 2 + (at.y_px - self.y[at.frame]) ** 2
        return MEAN * np.exp(-0.5 * r2 / var) / (2 * np.pi * var)


@dataclass(frozen=True)
class Line:
    """A vertical Gaussian line, its middle at x[k] in frame k."""

    x: np.ndarray
    sigma: float
    moving = True

    @property
    def smooth_px(self) -> float:
        return self.sigma

    def radiance(self, at: Points) -> np.ndarray:
        var = self.sigma**2 + at.blur_px**2
        return MEAN * np.exp(-0.5 * (at.x_px - self.x[at.frame]) ** 2 / var) / np.sqrt(2 * np.pi * var)


@dataclass(frozen=True)
class Flat:
    """The same light everywhere."""

    smooth_px = 100.0  # no detail that would need many points in a pixel

    def radiance(self, at: Points) -> np.ndarray:
        return np.full(at.x_px.shape, MEAN)

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        return np.full(grid.size, MEAN, np.float32)


def camera(shape: tuple[int, int], *chain: tuple[Source, Parameters], **kw) -> Camera:
    """The sources one after the other, and nothing else."""
    return Camera("t", shape, tuple(Element(f"{i} {s.id}", s, p) for i, (s, p) in enumerate(chain)), **kw)


def transfer(fx: float, fy: float, *chain: tuple[Source, Parameters], side: int = 3) -> complex:
    """What becomes of a wave at the middle pixel: the transfer function of chain and pixel at a frequency, complex."""
    middle = side // 2
    seen = camera((side, side), *chain).expose(Wave(fx, fy, middle, middle), 2).data[:, middle, middle] / MEAN - 1
    return complex(seen[0], seen[1])


def mapped(source: Source, params: Parameters, x: Sequence[float], y: Sequence[float], shape: tuple[int, int], frame: int = 0, **kw):
    """Where the camera says that points of the ideal image lie in its frame."""
    return camera(shape, (source, params), **kw).true_positions(x, y, frame=frame)


def signal_of(source: Source, params: Parameters, shape: tuple[int, int], frames: int = 1, **kw) -> Signal:
    """The signal at the head of a chain of this source, whole frames."""
    return camera(shape, (source, params), **kw).signal(Flat(), Grid.whole(range(frames), shape))


def centroids(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Plain centroids over whole frames."""
    images = images.astype(float)
    total = images.sum(axis=(1, 2))
    rows, cols = (np.arange(n) for n in images.shape[1:])
    return (images.sum(axis=1) * cols).sum(axis=1) / total, (images.sum(axis=2) * rows).sum(axis=1) / total


def first_harmonic(error: np.ndarray, phase: np.ndarray) -> float:
    """Coefficient of sin 2πc in an error at evenly spread phases c."""
    return float(2 * np.mean(error * np.sin(2 * np.pi * phase)))
