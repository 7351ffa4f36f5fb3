"""Where a camera shows points of the whole frame, and what a calibration leaves of that.

A *field* is the displacement of points at many places of the frame, in pixels of the sensor: where a frame shows them less where they
belong. It is exact: the camera's own maps give it, no image is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.budget.networks import FOUR, TEN, Images, interior_basis, solve
from pixmetry.camera.camera import Camera

SAME_CLOCK = 0.005  # relative difference of clocks that are meant to be one
SIDE = 20  # places along each side of the frame


@dataclass(frozen=True)
class Places:
    """Places that are spread over a sensor, and the corners of the cells of a residual grid around each.

    ``x_px`` and ``y_px`` have the shape (5, n): the places, and the four corners of the cell that each lies in; ``weights`` (4, n) are
    those of the corners in the bilinear interpolation at the place. The first ``even`` of them are spread evenly over the frame:
    calibrations are fitted to these.
    """

    x_px: np.ndarray
    y_px: np.ndarray
    weights: np.ndarray
    frame_shape: tuple[int, int]
    even: int = SIDE * SIDE

    @classmethod
    def over(cls, frame_shape: tuple[int, int], grid_px: float, also_px: np.ndarray | None = None) -> Places:
        """Places for a sensor of this size and a grid of this spacing (one cell over the frame, where it is larger).

        ``also_px``, shape (2, k): more places, behind those that are spread evenly.
        """
        rows, cols = frame_shape
        n = np.arange(SIDE * SIDE)
        # an additive recurrence with irrational steps: even over the frame, and over the cells of a grid of any spacing
        share = np.stack([(0.5 + n * 0.7548776662466927) % 1, (0.5 + n * 0.5698402909980532) % 1])
        ends = np.array([[cols - 1.0], [rows - 1.0]])
        at = share * ends if also_px is None else np.concatenate([share * ends, also_px], axis=1)
        cells = np.maximum(np.ceil(ends / grid_px), 1.0)
        step = ends / cells
        cell = np.minimum(np.floor(at / np.where(step > 0, step, 1.0)), cells - 1)
        low, high = cell * step, (cell + 1) * step
        part = np.divide(at - low, step, out=np.zeros_like(at), where=step > 0)
        x = np.stack([at[0], low[0], high[0], low[0], high[0]])
        y = np.stack([at[1], low[1], low[1], high[1], high[1]])
        u, v = part
        return cls(x, y, np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v]), frame_shape)


def field_of(camera: Camera, places: Places, known_layout: bool = True, seed: int = 0) -> np.ndarray:
    """Displacement of all places of the grid in x and y, shape (2, 5, n), px of the sensor; NaN where a place is not in the frame.

    ``known_layout``: how the camera lays out its frames (clock of the samples, offsets, fields) is accounted for, as in `Camera.layout`.
    Without, the middle of the frame is taken for that of the sensor; of a grabber with a clock of its own, a row of samples for all of
    a row of the sensor. ``seed``: of the exposure, for what is drawn anew in every one.
    """
    x, y = places.x_px.ravel(), places.y_px.ravel()
    seen = camera.true_positions(x, y, seed=seed, temperature_c=camera.temperature_c)
    back = []
    laid_out = camera.layout([0.0, 1.0], [0.0, 1.0])
    clocks = [1e6 * e.params.clock_mhz for e in camera.active if e.source.id == "grabber.sampling_clock"]
    resampled = any(abs(hz / camera.pixel_clock_hz - 1) > SAME_CLOCK for hz in clocks)
    for axis, (at, ends) in enumerate(zip(seen, laid_out, strict=True)):
        size, shown = places.frame_shape[1 - axis], camera.output_shape[1 - axis]
        if known_layout:
            back.append((at - ends[0]) / (ends[1] - ends[0]))
        else:
            step = size / shown if resampled and axis == 0 else max(round(size / shown), 1)
            back.append((at - (shown - 1) / 2) * step + (size - 1) / 2)
    field = np.stack([back[0] - x, back[1] - y]).reshape(2, *places.x_px.shape)
    rows, cols = camera.output_shape
    outside = ((np.abs(seen[0] - (cols - 1) / 2) > cols / 2) | (np.abs(seen[1] - (rows - 1) / 2) > rows / 2)).reshape(places.x_px.shape)
    field[:, 0, outside[0]] = np.nan  # the corners of a grid may lie beyond
    return field


@dataclass(frozen=True)
class Calibration:
    """What positions are corrected for.

    Parameters
    ----------
    model : {"none", "principal_point_and_scale", "lens", "residual_grid"}
        Nothing; a shift and a scale of each axis, and a small rotation of the camera; these, shear, radial terms and decentring (D. C.
        Brown, Photogrammetric Engineering 37(8), 1971); these, and a grid of what is left, interpolated bilinearly.
    every_image : bool
        A shift and the scales are fitted in every image again.
    places : Places
    aspect : float
        Pitch in y over that in x.
    radial : int
        Radial terms of a lens: 3 up to the seventh power, 5 up to the eleventh.
    images : Images, optional
        The calibration's own, whose image points are the last of the places. By their adjustment the model is fitted for the places between
        these and the even ones; poses and points of the calibration take up what they can, and the model the rest.
    """

    model: str
    every_image: bool
    places: Places
    aspect: float = 1.0
    radial: int = 3
    images: Images | None = None

    def left(self, now: np.ndarray, then: np.ndarray) -> np.ndarray:
        """What stays of a field when it was calibrated as it was ``then``; shape (2, n), at the places themselves.

        The polynomials are of the measured places, as those of photogrammetric calibrations are: places and displacement together.
        """
        square = np.array([1.0, self.aspect])[:, None, None]  # all lengths in pixels along x
        now, then = now * square, then * square
        found = now[:, 0]
        if self.model != "none":
            found = found - self._modelled(then)
            if self.images is not None and self.model != "residual_grid":
                n, own = self.places.even, found.shape[1] - self.images.image[0].size
                found[:, n:own] = now[:, 0, n:own] - self._adjusted(self.images, then[:, 0])[:, n:own]
        if self.every_image:
            scales = _scales(*self._unit(np.zeros_like(now)))[:, :, 0]
            found = found - self._followed(found, scales, scales)
        return found / square[:, 0]

    def _modelled(self, then: np.ndarray) -> np.ndarray:
        x, y = self._unit(then)
        basis = _oriented(x, y) if self.model == "principal_point_and_scale" else _lens(x, y, self.radial)
        smooth = self._followed(then[:, 0], basis[:, :, 0], basis)
        rest = then - smooth
        grid = np.einsum("kn,akn->an", self.places.weights, np.nan_to_num(rest[:, 1:]))
        n = self.places.even
        helps = np.nansum((rest[:, 0] - grid)[:, :n] ** 2) < np.nansum(rest[:, 0, :n] ** 2)  # one with cells too large does not
        return smooth[:, 0] + grid if self.model == "residual_grid" and helps else smooth[:, 0]

    def _adjusted(self, images: Images, then: np.ndarray) -> np.ndarray:
        """What the model says at all places, when the calibration's own images have been adjusted."""
        half = max(self.places.frame_shape) / 2
        x, y = (v[0] for v in self._unit(then[:, None]))
        size = images.image[0].size
        moved, shape = then[:, -size:].reshape(images.image.shape), images.image.shape[1:]
        seen = np.isfinite(moved).all(axis=0) & (True if images.seen is None else images.seen)
        measured = half * np.stack([v[-size:].reshape(shape) for v in (x, y)])
        which = FOUR if self.model == "principal_point_and_scale" else TEN
        solved = solve(replace(images, seen=seen, measured=np.where(seen, measured, 0.0)), (1.0, 1.0), which)
        found = solved.interior @ np.where(seen, moved, 0.0).ravel()
        return np.asarray(np.tensordot(found, interior_basis(x, y)[which], axes=1))

    def _followed(self, values: np.ndarray, basis: np.ndarray, at: np.ndarray) -> np.ndarray:
        n = self.places.even
        return _followed(values[:, :n], basis[..., :n], at)

    def _unit(self, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Measured places, over half the frame's longer side."""
        rows, cols = self.places.frame_shape
        scale = max(rows, cols) / 2
        x, y = self.places.x_px - (cols - 1) / 2, self.aspect * (self.places.y_px - (rows - 1) / 2)
        return (x + moved[0]) / scale, (y + moved[1]) / scale


def _scales(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Shifts and scales, shape (4, 2, …)."""
    one, zero = np.ones_like(x), np.zeros_like(x)
    return np.array([[one, zero], [zero, one], [x, zero], [zero, y]])


def _oriented(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Shifts, scales, and a small rotation of the camera (or a tilt of the sensor), which the exterior orientation takes up; (7, 2, …)."""
    return np.concatenate([_scales(x, y), np.array([[y, -x], [x * x, x * y], [x * y, y * y]])])


def _lens(x: np.ndarray, y: np.ndarray, terms: int) -> np.ndarray:
    """What a self-calibration with so many radial terms takes up, shape (10 + terms, 2, …)."""
    r2 = x**2 + y**2
    shear = [[y, x]]
    radial = [[x * r2**k, y * r2**k] for k in range(1, terms + 1)]
    decentring = [[r2 + 2 * x * x, 2 * x * y], [2 * x * y, r2 + 2 * y * y]]
    return np.concatenate([_oriented(x, y), np.array(shear + radial + decentring)])


def _followed(values: np.ndarray, basis: np.ndarray, at: np.ndarray) -> np.ndarray:
    """What a basis (k, 2, n) follows of values (2, n) by least squares over the places that are seen; at other places, as ``at`` (k, …)."""
    seen = np.isfinite(values)
    columns = np.where(seen[None], basis, 0.0).reshape(len(basis), -1).T
    found = np.linalg.lstsq(columns, np.where(seen, values, 0.0).ravel(), rcond=None)[0]
    return np.asarray(np.tensordot(found, at, axes=1))


def spread_of(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of a field over the frame, each of shape (2,); places that are not seen are left out."""
    return np.nanmean(field, axis=1), np.nanstd(field, axis=1)
