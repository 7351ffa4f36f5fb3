"""Layers of a scene: shapes with outlines, and sinusoidal gratings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.camera.light import Points
from pixmetry.core.errors import ParameterError
from pixmetry.core.random import Grid
from pixmetry.scene import _contour_kernels as kernels
from pixmetry.scene.motion import STILL, Motion
from pixmetry.scene.outlines import Outline, whole_ovals

Prepared = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]  # what the kernels take, see `_arrays`

SHARP_PX = 1e-6  # a blur of 0 is taken as this
MOST_NODES = 160  # of an ellipse that is integrated as a whole


@dataclass(frozen=True)
class Shapes:
    """Shapes that move together. Where they overlap, their heights add.

    Parameters
    ----------
    segments : ndarray, shape (m, 13)
    start : ndarray of int, shape (k + 1,)
        First segment of every shape, and the end.
    height_photons : ndarray, shape (k,)
    oval : ndarray, shape (k, 6)
        Of ellipses; NaN for other shapes.
    blur_px : float
        Standard deviation of a Gaussian blur; 0 for sharp shapes.
    motion : Motion
    told : sequence of dict
        True places when nothing is displaced.
    """

    segments: np.ndarray
    start: np.ndarray
    height_photons: np.ndarray
    oval: np.ndarray
    blur_px: float = 0.0
    motion: Motion = STILL
    told: Sequence[dict[str, Any]] = field(default=(), repr=False)
    own_light: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not 0 <= self.blur_px <= 100:
            raise ParameterError("a blur cannot be used", where="blur_px", value=self.blur_px, allowed="0 to 100 px")
        if not np.isfinite(self.height_photons).all():
            raise ParameterError("the height of a shape is not finite", where="peak_photons", allowed="finite numbers")

    @classmethod
    def of(cls, outlines: Sequence[Outline], blur_px: float = 0.0, motion: Motion = STILL) -> Shapes:
        """Shapes from their outlines."""
        start = np.concatenate([[0], np.cumsum([len(o.segments) for o in outlines])]).astype(np.int64)
        segments = np.concatenate([o.segments for o in outlines]) if outlines else np.zeros((0, kernels.SEGMENT))
        oval = np.array([np.full(6, np.nan) if o.oval is None else o.oval for o in outlines]).reshape(-1, 6)
        return cls(
            segments,
            start,
            np.array([o.height_photons for o in outlines], float),
            oval,
            blur_px,
            motion,
            [o.target for o in outlines if o.target],
        )

    @classmethod
    def of_ovals(
        cls, oval: np.ndarray, height_photons: np.ndarray, blur_px: float = 0.0, motion: Motion = STILL, told: Sequence[dict[str, Any]] = ()
    ) -> Shapes:
        """Many ellipses (cx, cy, ux, uy, vx, vy), shape (k, 6), with u × v positive."""
        segments = whole_ovals(oval).reshape(-1, kernels.SEGMENT)
        return cls(segments, 4 * np.arange(len(oval) + 1), np.ascontiguousarray(height_photons, float), oval, blur_px, motion, told)

    @property
    def moving(self) -> bool:
        """Whether the shapes move."""
        return not self.motion.still

    @property
    def smooth_px(self) -> float:
        """Blur of its own."""
        return self.blur_px

    @cached_property
    def box(self) -> np.ndarray:
        """Least x and y and greatest x and y of every shape, shape (k, 4)."""
        if not len(self.segments):
            return np.zeros((0, 4))
        x, y = self.segments[:, [9, 11]], self.segments[:, [10, 12]]
        first = self.start[:-1]
        low = [np.minimum.reduceat(v.min(axis=1), first) for v in (x, y)]
        return np.stack(low + [np.maximum.reduceat(v.max(axis=1), first) for v in (x, y)], axis=1)

    @cached_property
    def _sets(self) -> dict[float, Prepared]:
        return {}

    def _arrays(self, s: float) -> Prepared:
        """Kernel parameters of a blur ``s``."""
        found = self._sets.get(s)
        if found is None:
            total = (self.oval[:, 2:] ** 2).sum(axis=1)
            cross = self.oval[:, 2] * self.oval[:, 5] - self.oval[:, 3] * self.oval[:, 4]
            longer = np.sqrt(0.5 * (total + np.sqrt(np.maximum(total**2 - 4 * cross**2, 0.0))))
            count = np.maximum(np.ceil(2 * np.pi * longer / s), 12.0)
            count = np.where(count <= MOST_NODES, count, 0.0).astype(np.int64)  # NaN compares false: no ellipse
            found = (self.segments, self.start, self.height_photons, self.box, np.nan_to_num(self.oval), count, s)
            if len(self._sets) > 8:  # threads may do this at once: what they make is the same
                self._sets.clear()
            self._sets[s] = found
        return found

    def render(self, grid: Grid, frame_shape: tuple[int, int], time_s: np.ndarray, exposure_s: np.ndarray, lit: bool) -> np.ndarray:
        """Light of full pixels at a time of each window, shape (n, 1, rows, cols); with ``lit`` also its first moments, (n, 3, …)."""
        out = np.zeros((len(grid.frame), 3 if lit else 1, *grid.shape))
        dx, dy = (np.ascontiguousarray(np.broadcast_to(v, time_s.shape), float) for v in self.motion.offset(time_s, grid.frame))
        kernels.add_shapes(out, grid.row0, grid.col0, dx, dy, *self._arrays(max(self.blur_px, SHARP_PX)))
        return out

    def _points(self, at: Points) -> tuple[np.ndarray, np.ndarray]:
        if self.motion.still:
            x, y = at.x_px, at.y_px
        else:
            dx, dy = self.motion.offset(at.time_s, at.frame)
            x, y = at.x_px - dx, at.y_px - dy
        return np.ascontiguousarray(x, float).ravel(), np.ascontiguousarray(y, float).ravel()

    def sums(self, at: Points, width_px: ArrayLike, height_px: ArrayLike, lit: bool) -> np.ndarray:
        """Light averaged over a box about each point, shape (1, …); with ``lit`` also its first moments along x and y, (3, …)."""
        x, y = self._points(at)
        out = np.zeros((3 if lit else 1, x.size))
        w, h = (np.ascontiguousarray(np.broadcast_to(v, at.x_px.shape), float).ravel() for v in (width_px, height_px))
        s = max(float(np.hypot(self.blur_px, at.blur_px)), SHARP_PX)
        kernels.at_points(out, x, y, w, h, _side(x, y), *self._arrays(s))
        return out.reshape(-1, *at.x_px.shape)

    def detailed(self, at: Points, reach_px: ArrayLike) -> np.ndarray:
        """Where an outline may pass within this reach and the blur's."""
        x, y = self._points(at)
        out = np.zeros(x.size, bool)
        reach = np.broadcast_to(reach_px, at.x_px.shape).ravel() + kernels.REACH * float(np.hypot(self.blur_px, at.blur_px))
        kernels.outline_near(out, x, y, reach, _side(x, y), self.segments, self.start, self.box)
        return out.reshape(at.x_px.shape)

    def targets(self, time_s: float, frame: int) -> list[dict[str, Any]]:
        """True places at a time."""
        dx, dy = (float(v) for v in self.motion.offset(np.float64(time_s), np.int64(frame)))
        shift = {"x_px": dx, "y_px": dy, "ellipse_x_px": dx, "ellipse_y_px": dy}
        return [{k: v + shift[k] if k in shift else v for k, v in t.items()} for t in self.told]


def _side(x: np.ndarray, y: np.ndarray) -> float:
    """Side of the bins in which points look for shapes, in pixels."""
    return max(24.0, *(float(np.ptp(v)) / 256 for v in (x, y))) if x.size else 24.0


@dataclass(frozen=True)
class Sine:
    """A sinusoidal grating over the whole plane: mean (1 + contrast · cos(2π (x cos θ + y sin θ)/period + phase)).

    Parameters
    ----------
    period_px, angle_deg, phase_deg : float
        ``angle_deg`` is the direction in which the light varies, from x towards y; the phase is that at pixel (0, 0).
    mean_photons, contrast : float
    blur_px : float
    motion : Motion
    """

    period_px: float
    angle_deg: float = 0.0
    phase_deg: float = 0.0
    mean_photons: float = 1000.0
    contrast: float = 1.0
    blur_px: float = 0.0
    motion: Motion = STILL
    own_light: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not (0.1 <= self.period_px <= 1e6 and self.mean_photons >= 0 and 0 <= self.contrast <= 1 and 0 <= self.blur_px <= 100):
            raise ParameterError(
                "a sine grating cannot be used",
                where="sine",
                allowed="period 0.1 to 1e6 px, mean 0 or more, contrast 0 to 1, blur 0 to 100 px",
            )

    @property
    def moving(self) -> bool:
        """Whether it moves."""
        return not self.motion.still

    @property
    def smooth_px(self) -> float:
        """Scale of its finest detail: a sinusoid is as smooth as a Gaussian of this deviation."""
        return max(self.blur_px, self.period_px / 8)

    def sums(self, at: Points, width_px: ArrayLike, height_px: ArrayLike, lit: bool) -> np.ndarray:
        """Light averaged over boxes, and its first moments; see `Shapes.sums`."""
        dx, dy = self.motion.offset(at.time_s, at.frame)
        k = 2 * np.pi / self.period_px
        kx, ky = k * np.cos(np.deg2rad(self.angle_deg)), k * np.sin(np.deg2rad(self.angle_deg))
        phase = kx * (at.x_px - dx) + ky * (at.y_px - dy) + np.deg2rad(self.phase_deg)
        variance = self.blur_px**2 + at.blur_px**2
        (ax, bx), (ay, by) = _passed(kx, width_px, variance), _passed(ky, height_px, variance)
        size = self.mean_photons * self.contrast
        parts = [self.mean_photons + size * ax * ay * np.cos(phase)]
        if lit:  # ∫ u k(u) cos(κu + φ) du = K'(κ) sin φ, K being the transform of k
            parts += [size * bx * ay * np.sin(phase), size * ax * by * np.sin(phase)]
        return np.stack([np.broadcast_to(p, at.x_px.shape) for p in parts])

    def render(self, grid: Grid, frame_shape: tuple[int, int], time_s: np.ndarray, exposure_s: np.ndarray, lit: bool) -> np.ndarray:
        """Light of full pixels; see `Shapes.render`."""
        at = pixel_points(grid, frame_shape, time_s, exposure_s)
        return self.sums(at, np.float64(1), np.float64(1), lit).swapaxes(0, 1)

    def detailed(self, at: Points, reach_px: ArrayLike) -> np.ndarray:
        """Everywhere."""
        return np.ones(at.x_px.shape, bool)

    def targets(self, time_s: float, frame: int) -> list[dict[str, Any]]:
        """None: it has no place."""
        return []


def _passed(k: float, width_px: ArrayLike, variance_px2: float) -> tuple[np.ndarray, np.ndarray]:
    """Transform of a box of unit area blurred by a Gaussian at the angular frequency ``k``, and its derivative."""
    width = np.asarray(width_px, float)
    a = 0.5 * k * width
    sinc = np.sinc(a / np.pi)
    small = np.abs(a) < 1e-4
    slope = np.where(small, -a / 3, (np.cos(a) - sinc) / np.where(small, 1.0, a))
    gauss = np.exp(-0.5 * k * k * variance_px2)
    return sinc * gauss, (0.5 * width * slope - k * variance_px2 * sinc) * gauss


def pixel_points(grid: Grid, frame_shape: tuple[int, int], time_s: np.ndarray, exposure_s: np.ndarray) -> Points:
    """The centres of the pixels of windows."""
    y = (grid.row0[:, None] + np.arange(grid.shape[0]))[:, :, None]
    x = (grid.col0[:, None] + np.arange(grid.shape[1]))[:, None, :]
    parts = (x, y, *(np.asarray(v)[:, None, None] for v in (time_s, exposure_s)))
    x, y, time, exposure = (np.broadcast_to(np.asarray(v, float), grid.size) for v in parts)
    return Points(x, y, time, exposure, np.broadcast_to(grid.frame[:, None, None], grid.size), 0.0, frame_shape)
