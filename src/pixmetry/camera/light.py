"""Light before it is sampled: a scene seen through optics, by pixels of some shape, at some times.

The sources in front of the pixel grid do not work on numbers. They change how the scene is looked at: where a pixel looks (distortion,
tilt, drift), with which spread (lens, diffuser, pixel aperture), and when (exposure, fields, rolling shutter). ``Light`` collects that; the
camera samples it once, at the first source that takes photons. So a pixel's value is an integral over the scene itself, whatever the order
and number of those sources, and nothing is interpolated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from pixmetry.camera._camera_kernels import decimate
from pixmetry.core.arrays import Array, Ints, Singles
from pixmetry.core.errors import InputError
from pixmetry.core.random import Grid

FINE = 4  # points per pixel and axis of the raster on which a tabulated point spread is applied
GAUSS = {  # nodes and weights on (-1/2, 1/2): Gauss–Legendre
    1: (np.zeros(1), np.ones(1)),
    3: (np.array([-0.3872983346207417, 0.0, 0.3872983346207417]), np.array([5.0, 8.0, 5.0]) / 18),
}
RASTER_POINTS = 1 << 17  # of that raster, looked at together
LEVEL_PX2 = 0.02  # a spread that varies over the sensor is interpolated between variances so far apart

USUAL_SMOOTH_PX = 0.5  # of a scene that does not say over which length its light changes
MOST_PARTS = 16  # into which a pixel is cut along each side, for a scene that is sharp and has no averages of its own

Pull = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Scene(Protocol):
    """What falls on the sensor plane.

    Only ``photons`` is needed by a camera without sources in front of its pixels; with such sources, ``radiance`` is. ``moving`` tells
    whether it depends on time or frame number.
    """

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        """Photons of full square pixels, float32, shape (n, rows, cols); ``exposure_s`` and ``time_s`` have shape (n,)."""

    # def radiance(self, at: Points) -> np.ndarray: ...
    # def averaged(self, at: Points, width_px, height_px) -> np.ndarray: ...   (optional: over an upright box about each point)
    # def detailed(self, at: Points, reach_px: np.ndarray) -> np.ndarray: ...   (optional)
    # moving: bool
    # smooth_px: float, over which its light changes; 0 for sharp edges (then `averaged(at, width_px, height_px)` is wanted)


@dataclass(frozen=True)
class Points:
    """Points at which a scene is asked for its light.

    Parameters
    ----------
    x_px, y_px : ndarray, float64, any shape
        In the scene's plane, in pixels of the ideal camera: pixel (0, 0) is the centre of the top-left pixel.
    time_s, exposure_s : ndarray, of that shape (broadcast)
        When, and the length of the exposure that the answer belongs to.
    frame : ndarray of int, of that shape (broadcast)
    blur_px : float
        Standard deviation of a Gaussian with which the light is spread; the scene adds it to its own.
    frame_shape : (int, int)
    """

    x_px: np.ndarray
    y_px: np.ndarray
    time_s: np.ndarray
    exposure_s: np.ndarray
    frame: np.ndarray
    blur_px: float
    frame_shape: tuple[int, int]

    def take(self, index: Any) -> Points:
        """Return some of the points, as flat arrays."""
        x, y = self.x_px[index], np.broadcast_to(self.y_px, self.x_px.shape)[index]
        time, exposure, frame = (_taken(v, self.x_px.shape, index, x.shape) for v in (self.time_s, self.exposure_s, self.frame))
        return Points(x, y, time, exposure, frame, self.blur_px, self.frame_shape)


def _taken(values: np.ndarray, shape: tuple[int, ...], index: Any, taken: tuple[int, ...]) -> np.ndarray:
    """Values at an index into an array of that shape; one value for all stays one value in memory."""
    one = np.size(values) > 0 and not any(s for s, size in zip(values.strides, values.shape, strict=True) if size > 1)
    return np.broadcast_to(values[(0,) * values.ndim], taken) if one else np.broadcast_to(values, shape)[index]


@dataclass(frozen=True)
class Light:
    """A scene and how it is looked at. Made by the camera; sources return changed copies.

    Parameters
    ----------
    scene : Scene
    grid : Grid
        Windows in pixels of the sensor.
    frame_shape : (int, int)
    exposure_s, time_s : ndarray, shape (n,)
        Length and start of each exposure.
    pulls : tuple of callables
        Coordinate maps in the order in which the light meets them. Each takes the place of a point after it and returns the place before
        it, ``(x, y) -> (x, y)``, arrays of shape (n, rows, cols) or broadcast to it.
    blur_px2 : float
        Variance of the Gaussian spread.
    varying : tuple of callables
        ``(x, y) -> px²``: variances of Gaussian spreads that change over the sensor; should be smaller than the pixel.
    dots : (dx, dy, weight), arrays of shape (k,)
        A spread made of a few points, such as a birefringent plate's.
    kernel : ndarray, shape (2 m + 1, 2 m + 1), optional
        A point spread on a raster of ``FINE`` points per pixel, row by row from the top; its sum and the shares of ``far`` make 1.
    far : ndarray, shape (k, 3), optional
        The tail of that spread, which reaches beyond its raster: Gaussians by share of the light, variance in x and in y (px²).
    aperture_px : (float, float)
        Width and height of the light-sensitive box in the middle of the pixel.
    sensitivity : float
        Photons counted over those that fall on the aperture's mean density times one pixel.
    moments_s, weights : ndarray, shape (n, rows or 1, m)
        When each row looks, and with which share of the light; by default once, in the middle of the exposure.
    jitter_px : (dx, dy), arrays of shape (n, rows, cols), optional
        Where each pixel lies, less its place on the grid.
    """

    scene: Any
    grid: Grid
    frame_shape: tuple[int, int]
    exposure_s: np.ndarray
    time_s: np.ndarray
    pulls: tuple[Pull, ...] = ()
    blur_px2: float = 0.0
    varying: tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], ...] = ()
    dots: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    kernel: np.ndarray | None = None
    far: np.ndarray | None = None
    aperture_px: tuple[float, float] = (1.0, 1.0)
    sensitivity: float = 1.0
    moments_s: np.ndarray | None = None
    weights: np.ndarray | None = None
    jitter_px: tuple[np.ndarray, np.ndarray] | None = None

    # ---- what sources do --------------------------------------------------------------------------------------------------------

    def moved(self, pull: Pull) -> Light:
        """Return the light after a coordinate map: ``pull`` takes places after it to places before it."""
        return replace(self, pulls=(*self.pulls, pull))

    def blurred(self, variance_px2: float) -> Light:
        """Return the light after a Gaussian spread."""
        return replace(self, blur_px2=self.blur_px2 + float(variance_px2))

    def blurred_by_place(self, variance_px2: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Light:
        """Return the light after a small Gaussian spread whose variance depends on the place ``(x, y)`` on the sensor."""
        return replace(self, varying=(*self.varying, variance_px2))

    def spread(self, dx_px: np.ndarray, dy_px: np.ndarray, weight: np.ndarray) -> Light:
        """Return the light after a spread into a few points, of weights that sum to 1."""
        dx, dy, w = (np.atleast_1d(np.asarray(v, float)) for v in (dx_px, dy_px, weight))
        if self.dots is not None:
            dx = (self.dots[0][:, None] + dx).ravel()
            dy = (self.dots[1][:, None] + dy).ravel()
            w = (self.dots[2][:, None] * w).ravel()
        return replace(self, dots=(dx, dy, w))

    def convolved(self, kernel: np.ndarray, far: np.ndarray | None = None) -> Light:
        """Return the light after a tabulated point spread: odd sides, ``FINE`` points per pixel; ``far``: its tail, see `camera.raster`."""
        new = np.asarray(kernel, float)
        if new.ndim != 2 or not all(s % 2 for s in new.shape) or not np.isfinite(new).all() or new.sum() <= 0:
            raise InputError("a point spread cannot be used", value=new.shape, allowed="a finite array with odd sides and a positive sum")
        new = new / new.sum() * (1.0 if far is None else 1.0 - far[:, 0].sum())
        if self.kernel is not None:
            from scipy.signal import convolve2d

            far = _both_tails((self.kernel, self.far), (new, far))
            new = convolve2d(self.kernel, new)
        return replace(self, kernel=new, far=far)

    def seen_at(self, moments_s: np.ndarray, weights: np.ndarray) -> Light:
        """Return the light with other times of looking; arrays of shape (n, rows or 1, m)."""
        return replace(self, moments_s=moments_s, weights=weights)

    def delayed(self, delay_s: np.ndarray) -> Light:
        """Return the light seen later by so much; ``delay_s`` has shape (n, rows), or (n, 1) where all rows look together."""
        times, weights = self.moments
        times = times + delay_s[:, :, None]
        return self.seen_at(times, np.broadcast_to(weights, times.shape))

    def jittered(self, dx_px: np.ndarray, dy_px: np.ndarray) -> Light:
        """Return the light with every pixel shifted by its own amount; arrays of shape (n, rows, cols), added to those before."""
        before = (0.0, 0.0) if self.jitter_px is None else self.jitter_px
        return replace(self, jitter_px=(before[0] + np.asarray(dx_px, float), before[1] + np.asarray(dy_px, float)))

    @property
    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and weights, shape (n, rows or 1, m) each."""
        if self.moments_s is None or self.weights is None:
            middle = (self.time_s + 0.5 * self.exposure_s)[:, None, None]
            return middle, np.ones_like(middle)
        return self.moments_s, self.weights

    @property
    def moving(self) -> bool:
        """Whether the scene depends on time."""
        return bool(getattr(self.scene, "moving", False))

    # ---- geometry ---------------------------------------------------------------------------------------------------------------

    def pulled(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places in the scene's plane at which places on the sensor look."""
        for pull in reversed(self.pulls):
            x, y = pull(x, y)
        return x, y

    def placed(self, x: np.ndarray, y: np.ndarray, tolerance_px: float = 1e-9) -> tuple[np.ndarray, np.ndarray]:
        """Places on the sensor at which points of the scene's plane are seen, the inverse of `pulled`; shape (n, k, 1).

        Newton's method with derivatives by differences; points that are seen nowhere become NaN.
        """
        u, v = np.array(x, float), np.array(y, float)
        if not self.pulls:
            return u, v
        step = 0.25
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # of points that are seen nowhere
            for _ in range(50):
                fx, fy = self.pulled(u, v)
                ex, ey = fx - x, fy - y
                (ax, ay), (bx, by) = self.pulled(u + step, v), self.pulled(u, v + step)
                jxx, jyx, jxy, jyy = (ax - fx) / step, (ay - fy) / step, (bx - fx) / step, (by - fy) / step
                det = jxx * jyy - jxy * jyx
                du, dv = (ex * jyy - ey * jxy) / det, (ey * jxx - ex * jyx) / det
                u, v = u - du, v - dv
                if not (np.abs([du, dv]) >= tolerance_px).any():
                    return u, v
            fx, fy = self.pulled(u, v)
            lost = ~(np.hypot(fx - x, fy - y) < 1e-6)
        return np.where(lost, np.nan, u), np.where(lost, np.nan, v)

    # ---- sampling ---------------------------------------------------------------------------------------------------------------

    def fingerprint(self) -> bytes | None:
        """Key that is equal for two exposures with the same light in the same windows; None if the scene may change.

        Coordinate maps are compared at 81 places of the frame: smooth maps that agree there to the last bit are the same.
        """
        if getattr(self.scene, "moving", True):
            return None
        parts = [self.exposure_s, self.moments[1], np.array([self.blur_px2, self.sensitivity, *self.aperture_px])]
        parts += [*(self.dots or ()), *(v for v in (self.kernel, self.far) if v is not None), *(self.jitter_px or ())]
        if self.pulls or self.varying:
            x, y = self._lattice()
            parts += [np.asarray(v, float) for v in (*self.pulled(x, y), *(f(x, y) for f in self.varying))]
        return b"|".join(np.ascontiguousarray(p).tobytes() for p in parts)

    def _lattice(self) -> tuple[np.ndarray, np.ndarray]:
        """A few places all over the frame, shape (n, 9, 9) each."""
        rows, cols = self.frame_shape
        y, x = np.linspace(0, rows - 1, 9)[None, :, None], np.linspace(0, cols - 1, 9)[None, None, :]
        shape = (len(self.grid.frame), 9, 9)
        return np.broadcast_to(x, shape), np.broadcast_to(y, shape)

    @property
    def plain(self) -> bool:
        """Whether full pixels look at the scene directly, in the middle of the exposure."""
        return (
            not (self.pulls or self.blur_px2 or self.varying)
            and self.dots is None
            and self.kernel is None
            and self.aperture_px == (1.0, 1.0)
            and self.sensitivity == 1.0
            and self.moments_s is None
            and self.jitter_px is None
        )

    def photons(self) -> np.ndarray:
        """Mean photons of every pixel, float32, shape (n, rows, cols)."""
        if self.plain and hasattr(self.scene, "photons"):
            return np.ascontiguousarray(self.scene.photons(self.grid, self.frame_shape, self.exposure_s, self.time_s), np.float32)
        if not hasattr(self.scene, "radiance"):
            raise InputError(
                f"the scene {type(self.scene).__name__} cannot be imaged through optics",
                allowed="scenes that give their light at any point (`radiance`)",
                remedy="switch the camera's optical sources off, or take another scene",
            )
        times, weights = self.moments
        if not self.moving:  # the light is the same at all times
            total = weights.sum(axis=2, keepdims=True)
            out = self._at(times.mean(axis=2)[:, :1], slice(None)) * total
        else:
            out = self._moving(times, weights)
        in_pixels: Singles = np.maximum(out * self.sensitivity, 0.0).astype(np.float32)
        return in_pixels

    def _moving(self, times: np.ndarray, weights: np.ndarray) -> np.ndarray:
        n, rows, cols = self.grid.size
        out = np.zeros((n, rows, cols))
        if self.kernel is None or times.shape[1] == 1:
            for k in range(times.shape[2]):
                out += weights[:, :, k, None] * self._at(times[:, :, k], slice(None))
            return out
        # a raster is shared by rows that look at the same times
        offset = np.round(times - self.time_s[:, None, None], 12)
        _, group = np.unique(offset.transpose(1, 0, 2).reshape(rows, -1), axis=0, return_inverse=True)
        for g in range(group.max() + 1):
            at = np.flatnonzero(group.ravel() == g)
            block = slice(int(at[0]), int(at[-1]) + 1)
            for k in range(times.shape[2]):
                seen = self._at(times[:, at[:1], k], block)
                out[:, at] += weights[:, at, k, None] * seen[:, at - at[0]]
        return out

    def _at(self, time_s: np.ndarray, block: slice) -> np.ndarray:
        """Mean light of some rows of pixels at a time of shape (n, rows or 1)."""
        rows = np.arange(self.grid.shape[0])[block]
        y = (self.grid.row0[:, None] + rows).astype(float)[:, :, None]
        x = (self.grid.col0[:, None] + np.arange(self.grid.shape[1])).astype(float)[:, None, :]
        time = time_s[:, :, None]
        mask = self._mask
        if mask is None:
            if self.jitter_px is not None:
                x, y = x + self.jitter_px[0][:, block], y + self.jitter_px[1][:, block]
            return self._averaged(x, y, time, self.aperture_px)
        if self.jitter_px is not None:
            mask = np.pad(mask, 2)
        m = mask.shape[0] // 2, mask.shape[1] // 2
        fine_y, fine_x = (_refined(v, axis, reach) for v, axis, reach in ((y, 1, m[0]), (x, 2, m[1])))
        fine, size = np.empty((len(fine_y), fine_y.shape[1], fine_x.shape[2])), (FINE, len(rows), self.grid.shape[1])
        step = max(1, RASTER_POINTS // (len(fine_x) * fine_x.shape[2]))
        for first in range(0, fine.shape[1], step):  # the looking takes several times the memory of what is seen
            some = slice(first, first + step)
            fine[:, some] = self._averaged(fine_x, fine_y[:, some], time[:, :1], self.aperture_px)
        seen = decimate(fine, mask, *size)
        if self.jitter_px is not None:  # to first order: all pixels share one raster
            seen += self.jitter_px[0][:, block] * decimate(fine, _slope(mask, 1), *size)
            seen += self.jitter_px[1][:, block] * decimate(fine, _slope(mask, 0), *size)
        for share, across, down in () if self.far is None else self.far:
            seen += share * self._veil(x, y, time[:, :1], across, down)
        return seen

    def _veil(self, x: np.ndarray, y: np.ndarray, time: np.ndarray, across_px2: float, down_px2: float) -> np.ndarray:
        """Light through a wide Gaussian as well, shape (n, rows, cols): seen by the scene itself, on every so many pixels.

        These are counted from the frame's corner, whatever the window; between them the light is linear.
        """
        shared = min(across_px2, down_px2)
        look, lattice = replace(self, blur_px2=self.blur_px2 + shared), []
        for at, variance in ((y[:, :, 0], down_px2), (x[:, 0], across_px2)):
            step = veil_step(variance)
            taps = _taps((variance - shared) / step**2)  # of what the Gaussian is wider in this axis
            rim = len(taps) // 2
            first, part = np.divmod(at, step)
            low = first[:, :1] - rim
            count = int(at.shape[1] - 1) // step + 3 + 2 * rim
            nodes = (low + np.arange(count)) * step
            lattice.append((nodes, taps, (first - first[:, :1]).astype(np.int64), part / step))
        seen = look._averaged(lattice[1][0][:, None, :], lattice[0][0][:, :, None], time, self.aperture_px)
        for axis, (_, taps, index, part) in zip((1, 2), lattice, strict=True):
            if len(taps) > 1:
                size = seen.shape[axis] - len(taps) + 1
                seen = sum(w * seen.take(range(k, k + size), axis) for k, w in enumerate(taps.tolist()))
            at, part = np.expand_dims(index, 3 - axis), np.expand_dims(part, 3 - axis)
            left, right = (np.take_along_axis(seen, at + k, axis) for k in (0, 1))
            seen = left * (1 - part) + right * part
        return seen

    @cached_property
    def _mask(self) -> np.ndarray | None:
        """Weights of the raster about a pixel's centre, if there is one: what a point gives to its right, a pixel takes from its left."""
        return None if self.kernel is None else np.ascontiguousarray(self.kernel[::-1, ::-1])

    def _averaged(self, x: np.ndarray, y: np.ndarray, time: np.ndarray, cell: tuple[float, float]) -> np.ndarray:
        """Light averaged over a cell about every point, through all spreads but the tabulated one."""
        n = len(self.grid.frame)
        shape = (n, y.shape[1], x.shape[2])
        # x is one row of columns and y one column of rows, unless pixels are moved one by one: what depends on one of them stays cheap
        sd = np.sqrt(np.broadcast_to(sum(v(x, y) for v in self.varying), shape)) if self.varying else None
        px, py = (np.broadcast_to(v, shape) for v in self.pulled(x, y))
        x, y = np.broadcast_to(x, shape), np.broadcast_to(y, shape)
        when, exposure, frame = (np.broadcast_to(v, shape) for v in (time, self.exposure_s[:, None, None], self.grid.frame[:, None, None]))
        centre = Points(px, py, when, exposure, frame, np.sqrt(self.blur_px2), self.frame_shape)
        dots = self.dots or (np.zeros(1), np.zeros(1), np.ones(1))
        detailed = getattr(self.scene, "detailed", None)
        busy = np.ones(shape, bool) if detailed is None else detailed(centre, self._reach(0.5 * np.hypot(*cell), dots))
        out = np.empty(shape)
        if not busy.all():
            out[~busy] = self.scene.radiance(centre.take(~busy))
        if busy.any():
            parts = self._parts()
            for count in np.unique(parts):  # frame by frame, as the maps may turn: the windows of a batch do not know of each other
                mine = busy & (parts == count)[:, None, None]
                if mine.any():
                    variance = None if sd is None else sd[mine] ** 2
                    out[mine] = self._summed(mine, x[mine], y[mine], centre.take(mine), variance, cell, dots, int(count))
        return out

    def _summed(
        self,
        which: np.ndarray,
        x: np.ndarray,
        y: np.ndarray,
        centre: Points,
        variance: np.ndarray | None,
        cell: tuple[float, float],
        dots: tuple[np.ndarray, np.ndarray, np.ndarray],
        parts: int,
    ) -> np.ndarray:
        """Light averaged over a cell about the points ``which`` of the batch; the cell is cut into ``parts`` along each side."""
        exact = getattr(self.scene, "averaged", None)
        places, total = _Places(which, self), np.zeros(len(x))
        size = () if exact is None else places.size(x, y, cell[0] / parts, cell[1] / parts)
        levels = [
            (mine, share, replace(centre if mine is None else centre.take(mine), blur_px=np.sqrt(self.blur_px2 + level)))
            for mine, share, level in _levels(variance)
        ]
        for dx, dy, w in self._nodes(cell, dots, parts):
            qx, qy = places.pulled(x + dx, y + dy)
            for mine, share, points in levels:
                every = slice(None) if mine is None else mine
                at = replace(points, x_px=qx[every], y_px=qy[every])
                seen = self.scene.radiance(at) if exact is None else exact(at, *(v if np.ndim(v) == 0 else v[every] for v in size))
                total[every] += w * share * seen
        return total

    def _parts(self) -> np.ndarray:
        """Into how many parts a cell is cut along each side for a scene that averages over upright boxes (0 for other scenes), shape (n,).

        One, unless the coordinate maps turn or shear the cell; then enough that the parts, upright themselves, stand for it to 1e-4 of an
        edge. A shear changes the second moment of the cell, a turn only the fourth, so blurred light needs fewer.
        """
        n = len(self.grid.frame)
        if not hasattr(self.scene, "averaged"):
            return np.zeros(n, np.int64)
        if not self.pulls:
            return np.ones(n, np.int64)
        (_, tilt_x), (tilt_y, _) = self._pixel_steps()
        shear, turn = np.abs(tilt_x + tilt_y).max(axis=(1, 2)), 0.5 * np.abs(tilt_x - tilt_y).max(axis=(1, 2))
        blur2 = self._smooth_px2
        spread2 = blur2 + 1.0 / 12.0
        turned = (2.0 * turn / spread2**2) ** 0.25 if blur2 > 0.04 else 30.0 * np.sqrt(np.maximum(turn, shear))
        parts = np.maximum(np.sqrt(100.0 * shear / spread2), turned)
        count: Ints = np.clip(np.ceil(parts - 1e-3), 1, 12).astype(np.int64)
        return count

    def _nodes(self, cell: tuple[float, float], dots: Any, boxes: int = 0) -> Iterator[tuple[float, float, float]]:
        """Offsets and weights of the aperture and the dots; or of the dots and the aperture divided into ``boxes``² parts."""
        fine = self._smooth_px2**0.5
        axes = []
        for size in cell:
            parts = boxes or max(1, int(np.ceil(size / max(fine, size / MOST_PARTS))))
            nodes, weights = GAUSS[1 if boxes else 3]
            start = (np.arange(parts) + 0.5) / parts - 0.5
            axes.append((size * (start[:, None] + nodes / parts).ravel(), np.tile(weights / parts, parts)))
        for ox, oy, ow in zip(*dots, strict=True):
            for ax, aw in zip(*axes[0], strict=True):
                for ay, bw in zip(*axes[1], strict=True):
                    yield ax - ox, ay - oy, ow * aw * bw

    @property
    def _smooth_px2(self) -> float:
        """Variance of the Gaussian that the scene is smooth like, with the spread that it is seen through."""
        return float(getattr(self.scene, "smooth_px", USUAL_SMOOTH_PX)) ** 2 + self.blur_px2

    def _pixel_steps(self) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """How far, in x and y of the scene, the next pixel to the right and the next one below look, all over the frame; (n, 9, 9) each."""
        x, y = self._lattice()
        at, right, down = (np.broadcast_arrays(*self.pulled(u, v)) for u, v in ((x, y), (x + 1, y), (x, y + 1)))
        return (right[0] - at[0], right[1] - at[1]), (down[0] - at[0], down[1] - at[1])

    def _reach(self, cell_px: float, dots: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
        """How far in the scene's plane a cell looks, shape (n, 1, 1).

        From a few places all over the frame, not from the window: whether a cell is taken to be uniform must not depend on the window.
        """
        x, y = self._lattice()
        shape = x.shape
        reach = np.full((shape[0], 1, 1), cell_px + float(np.hypot(dots[0], dots[1]).max()))
        if self.varying:
            variance = np.broadcast_to(sum(v(x, y) for v in self.varying), shape)
            reach = reach + 2.0 * np.sqrt(variance.max(axis=(1, 2), keepdims=True))
        if self.pulls:
            longest = np.maximum(*(np.hypot(*step) for step in self._pixel_steps()))
            reach = reach * np.maximum(1.0, 1.5 * longest.reshape(len(longest), -1).max(axis=1))[:, None, None]
        return reach


def veil_step(variance_px2: float) -> int:
    """Pixels between the places at which light behind a wide Gaussian is looked at: half a deviation."""
    return max(1, int(0.5 * variance_px2**0.5))


def _taps(variance: float) -> np.ndarray:
    """Weights of a Gaussian on whole numbers, of exactly this variance: e^(−t) I_k(t) (Lindeberg 1990)."""
    from scipy.special import ive

    reach = int(np.ceil(6 * variance**0.5 + 2)) if variance > 1e-6 else 0
    weights = ive(np.abs(np.arange(-reach, reach + 1)), variance)
    normalised: Array = weights / weights.sum()
    return normalised


def _both_tails(one: tuple[np.ndarray, np.ndarray | None], two: tuple[np.ndarray, np.ndarray | None]) -> np.ndarray | None:
    """The tail of two spreads in a row: each tail through the other's kernel, as far as its variance tells, and through its tail."""
    parts = []
    for (kernel, _), (_, far) in ((one, two), (two, one)):
        if far is not None:
            share, wide = kernel.sum(), []
            for axis in (0, 1):
                at, light = (np.arange(kernel.shape[1 - axis]) - kernel.shape[1 - axis] // 2) / FINE, kernel.sum(axis=axis) / share
                wide.append(max(float((light * at**2).sum() - (light * at).sum() ** 2), 0.0))
            parts.append(np.stack([far[:, 0] * share, far[:, 1] + wide[0], far[:, 2] + wide[1]], axis=1))
    if one[1] is not None and two[1] is not None:
        first, second = np.repeat(one[1], len(two[1]), axis=0), np.tile(two[1], (len(one[1]), 1))
        parts.append(np.column_stack([first[:, 0] * second[:, 0], first[:, 1:] + second[:, 1:]]))
    if not parts:
        return None
    together = np.concatenate(parts)
    size = np.round(np.log2(together[:, 1] * together[:, 2]) / 2)  # those of nearly the same width become one of their mean variance
    out = []
    for kind in np.unique(size):
        mine = together[size == kind]
        share = mine[:, 0].sum()
        out.append([share, *(mine[:, 0] @ mine[:, 1:] / share)])
    return np.array(out)


def _levels(variance: np.ndarray | None) -> Iterator[tuple[np.ndarray | None, Any, float]]:
    """The levels of variance between which points with a spread of their own lie: which points, with what share, and the level.

    Light is nearly linear in the variance of a small spread (its second derivative is a quarter of the fourth in place), so two looks at
    neighbouring levels stand for all between.
    """
    if variance is None:
        yield None, 1.0, 0.0
        return
    at = variance / LEVEL_PX2
    below = np.floor(at).astype(np.int64)
    for level in np.unique(np.concatenate([below, below + 1])):
        share = 1.0 - np.abs(at - level)
        mine = np.flatnonzero(share > 0)
        if len(mine):
            yield mine, share[mine], float(level) * LEVEL_PX2


class _Places:
    """Maps scattered points of a batch through coordinate maps that hold one value per window."""

    def __init__(self, busy: np.ndarray, light: Light) -> None:
        self.light = light
        self.counts = busy.reshape(len(busy), -1).sum(axis=1)

    def pulled(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not self.light.pulls:
            return x, y
        n, widest = len(self.counts), int(self.counts.max())
        if n == 1:
            px, py = self.light.pulled(x[None, :, None], y[None, :, None])
            return np.broadcast_to(px, (1, len(x), 1)).ravel(), np.broadcast_to(py, (1, len(x), 1)).ravel()
        inside = np.arange(widest) < self.counts[:, None]
        padded = [np.zeros((n, widest)) for _ in range(2)]
        for pad, v in zip(padded, (x, y), strict=True):
            pad[inside] = v
        px, py = self.light.pulled(padded[0][:, :, None], padded[1][:, :, None])
        u, v = (np.broadcast_to(p, (n, widest, 1))[:, :, 0][inside] for p in (px, py))
        return u, v

    def size(self, x: np.ndarray, y: np.ndarray, width: float, height: float) -> tuple[Any, Any]:
        """Width and height in the scene's plane of a box about each point."""
        if not self.light.pulls:
            return np.float64(width), np.float64(height)
        across = self.pulled(x + 0.5 * width, y)[0] - self.pulled(x - 0.5 * width, y)[0]
        along = self.pulled(x, y + 0.5 * height)[1] - self.pulled(x, y - 0.5 * height)[1]
        return np.abs(across), np.abs(along)


def _refined(v: np.ndarray, axis: int, reach: int) -> np.ndarray:
    """Points of the fine raster about whole pixels along an axis, pixel centres among them, with a margin of ``reach`` points."""
    first = v.take([0], axis=axis)
    count = (v.shape[axis] - 1) * FINE + 2 * reach + 1
    at = (np.arange(count) - reach) / FINE
    return first + (at[None, :, None] if axis == 1 else at[None, None, :])


def _slope(mask: np.ndarray, axis: int) -> np.ndarray:
    """The mask under which the raster's derivative per pixel is seen: differences of fourth order; the mask's rim of two cells is 0."""
    one, two = (np.roll(mask, k, axis) - np.roll(mask, -k, axis) for k in (1, 2))
    slope: Array = FINE * (8 * one - two) / 12
    return slope
