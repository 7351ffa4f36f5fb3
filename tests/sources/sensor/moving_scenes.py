"""Scenes that move, for the sources of time; written as functions of place and time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from catalogue.support import Flat
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.light import Points
from pixmetry.camera.source import Source


@dataclass(frozen=True)
class Spot:
    """A Gaussian spot on black that moves with a speed and an acceleration along x; a vertical line where it has no height."""

    x_px: float
    y_px: float | None
    speed_px_per_s: float = 0.0
    acceleration_px_per_s2: float = 0.0
    smooth_px: float = 1.5
    peak: float = 1000.0
    moving = True

    def radiance(self, at: Points) -> np.ndarray:
        t, variance = at.time_s, self.smooth_px**2 + at.blur_px**2
        x = self.x_px + self.speed_px_per_s * t + 0.5 * self.acceleration_px_per_s2 * t**2
        square = (at.x_px - x) ** 2 + (0.0 if self.y_px is None else (at.y_px - self.y_px) ** 2)
        return self.peak * np.exp(-0.5 * square / variance) + 0 * at.x_px

    def photons(self, grid: Any, frame_shape: Any, exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        raise AssertionError("this scene is to be seen through the sources in front of the pixels")


@dataclass(frozen=True)
class Steady(Flat):
    """Even light of 10 000 photons at all times, declared as moving so that every look is taken."""

    level_dn: float = 50.0
    moving = True


STEADY = 10_000.0  # photons


def chain(*pairs: tuple[Source, Any], shape: tuple[int, int] = (32, 48), **kw: Any) -> Camera:
    """A camera of these sources alone; what comes out are photons."""
    return Camera("test", shape, tuple(Element(s.id, s, p) for s, p in pairs), **kw)


def moments(image: np.ndarray) -> tuple[float, float, float, float]:
    """Centre and variances (x, y, var x, var y) of an image."""
    image = np.asarray(image, float)
    total, rows, cols = image.sum(), np.arange(image.shape[0])[:, None], np.arange(image.shape[1])
    x, y = (image * cols).sum() / total, (image * rows).sum() / total
    return x, y, (image * (cols - x) ** 2).sum() / total, (image * (rows - y) ** 2).sum() / total


def row_centres(image: np.ndarray) -> np.ndarray:
    """Centre along x of every row."""
    image = np.asarray(image, float)
    return (image * np.arange(image.shape[1])).sum(axis=1) / image.sum(axis=1)
