"""Places of a texture: windows of the first frame, found again in every other one by least-squares matching."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.locate.frame import checked_frame
from pixmetry.series.track import FrameTargets

HALF_PX = 15  # of a window
MARGIN_PX = 12  # about a window, for what the splines need and the motion after the whole frame's
CELLS = (6, 8)  # at most one window in each of these parts of a frame, along y and x
LEAST_U_PX = 0.03  # windows of which a frame tells less are not followed
LEAST_ALIKE = 0.8  # correlation of a window with the first frame's, below which something else is seen
FARTHEST_PX = 6.0  # from where the motion of the whole frame puts a window
STEP_PX = 1e-4  # the search ends there
ROUNDS = 20
SAME = 1e-6  # of the noise: a frame that is a copy of the first one
BLUR_PX = 2.0  # of the first search, so that it starts from as far
COARSE = 4  # pixels a side that are summed for the motion of the whole frame
GRADIENT_VARIANCE = 1.392  # of the cubic spline's slope at a pixel, over the pixels' variance: 9 (2/√3 − 1)


@dataclass(frozen=True)
class Texture:
    """Windows that are followed: the first frame, their centres (row, col) as integers, its noise.

    ``coarse`` is the first frame's spectrum, for the motion of the whole frame; ``variance_dn2`` its noise's variance, at most.
    """

    frame: Array
    centres: np.ndarray
    coarse: np.ndarray
    variance_dn2: float

    def find(self, frame: np.ndarray, name: str, time_s: float) -> FrameTargets:
        """Find the windows in a frame: their centres, and the covariance from the noise and their gradients."""
        grey = checked_frame(frame, name).astype(np.float64)
        step = self._whole_step(grey)
        places, covariances = [], []
        for row, col in self.centres:
            found = self._matched(grey, int(row), int(col), step)
            if found is not None:
                (dx, dy), covariance = found
                places.append((col + dx, row + dy))
                covariances.append(covariance)
        return FrameTargets(name, time_s, np.array(places).reshape(-1, 2), np.array(covariances).reshape(-1, 2, 2))

    def _whole_step(self, grey: Array) -> np.ndarray:
        """Motion of the whole frame (x, y) to a few pixels, by phase correlation."""
        small = _small(grey)
        cross = np.fft.rfft2(small) * self.coarse.conj()
        peak = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-12), small.shape)
        at = np.array(np.unravel_index(int(peak.argmax()), peak.shape), float)
        size = np.array(small.shape)
        moved = np.where(at > size / 2, at - size, at) * COARSE
        return moved[::-1] if np.all(np.abs(moved) < 0.2 * size * COARSE) else np.zeros(2)

    def _matched(self, grey: Array, row: int, col: int, step: np.ndarray) -> tuple[np.ndarray, Array] | None:
        """Motion (x, y) of a window and its covariance, or None where it is not found.

        Gauss-Newton on the square of frame(x + d) − gain · first(x) − offset, first in blurred windows. Both frames are equally noisy, so
        the residuals hold twice the noise's variance; that of the first frame moves a window alike in all frames, and is no part of u.
        """
        near = np.rint(step).astype(int)
        reach = HALF_PX + MARGIN_PX
        top, left = row + near[1] - reach, col + near[0] - reach
        size = 2 * reach + 1
        if top < 0 or left < 0 or top + size > grey.shape[0] or left + size > grey.shape[1]:
            return None
        template = self.frame[row - reach : row + reach + 1, col - reach : col + reach + 1]
        window = grey[top : top + size, left : left + size]
        moved = np.zeros(2)
        for blur in (BLUR_PX, 0.0):
            one, other = (ndimage.gaussian_filter(part, blur) if blur else part for part in (template, window))
            found = _search(one, other, moved)
            if found is None:
                return None
            moved, normal, variance, alike = found
        if alike < LEAST_ALIKE:
            return None
        noise = variance / 2 if variance > SAME * self.variance_dn2 else self.variance_dn2  # the first frame itself, or a copy of it
        normal[[0, 1], [0, 1]] -= GRADIENT_VARIANCE * noise * (2 * HALF_PX + 1) ** 2
        covariance: Array = np.asarray(np.linalg.inv(normal)[:2, :2] * noise, np.float64)
        if not np.all(np.linalg.eigvalsh(covariance) > 0):
            return None
        return moved + near, covariance


def texture_of(frame: np.ndarray, name: str = "first frame") -> Texture:
    """Choose windows of a frame that can be followed.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)

    Returns
    -------
    Texture

    Raises
    ------
    MeasureError
        If fewer than three windows have gradients along both axes beyond the noise.

    Notes
    -----
    The structure tensor of a window, summed gradients' products, is the inverse of its position's covariance over the noise's variance
    (Förstner and Gülch 1987); its smaller eigenvalue, less what noise adds, chooses the window of each part of the frame.
    """
    grey = checked_frame(frame, name).astype(np.float64)
    gy, gx = _gradients(grey)
    size = 2 * HALF_PX + 1
    xx, xy, yy = (ndimage.uniform_filter(product, size, mode="constant") * size**2 for product in (gx * gx, gx * gy, gy * gy))
    variance = _noise_variance(grey)
    least = 0.5 * (xx + yy - np.hypot(xx - yy, 2 * xy)) - GRADIENT_VARIANCE * variance * size**2
    reach = HALF_PX + MARGIN_PX
    centres = []
    for rows in np.array_split(np.arange(reach, grey.shape[0] - reach), CELLS[0]):
        for cols in np.array_split(np.arange(reach, grey.shape[1] - reach), CELLS[1]):
            if not rows.size or not cols.size:
                continue
            part = least[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
            row, col = np.unravel_index(int(part.argmax()), part.shape)
            if part[row, col] * LEAST_U_PX**2 > max(variance, 1 / 12):
                centres.append((rows[0] + row, cols[0] + col))
    if len(centres) < 3:
        raise MeasureError(
            f"no targets are found, and {len(centres)} places with a texture beyond the noise",
            where=name,
            allowed="3 or more, spread over the frame",
            remedy="check the kind of target, and that it is in focus",
        )
    return Texture(grey, np.array(centres), np.fft.rfft2(_small(grey)), max(variance, 1 / 12))


def _gradients(grey: Array) -> tuple[Array, Array]:
    """Slopes along y and x of the cubic spline through the pixels."""
    gy, gx = (ndimage.correlate1d(ndimage.spline_filter1d(grey, 3, axis, mode="mirror"), [-0.5, 0, 0.5], axis) for axis in (0, 1))
    return gy, gx


def _noise_variance(grey: Array) -> float:
    """Variance of the noise, from the median of second differences along both axes, which texture hardly reaches in smooth parts."""
    second = ndimage.correlate1d(ndimage.correlate1d(grey, [1.0, -2.0, 1.0], axis=0), [1.0, -2.0, 1.0], axis=1)
    return float((np.median(np.abs(second)) / 0.6745) ** 2 / 36)


def _small(grey: Array) -> Array:
    """Sums of blocks under a window that falls to 0 at the border, less their mean."""
    rows, cols = (size // COARSE for size in grey.shape)
    blocks = grey[: rows * COARSE, : cols * COARSE].reshape(rows, COARSE, cols, COARSE).mean(axis=(1, 3))
    hann = np.hanning(rows)[:, None] * np.hanning(cols)
    windowed: Array = (blocks - blocks.mean()) * hann
    return windowed


def _search(template: Array, window: Array, start: np.ndarray) -> tuple[np.ndarray, Array, float, float] | None:
    """Motion (x, y), normal matrix of motion, gain and offset, variance of the residuals, and the correlation."""
    inner = slice(MARGIN_PX, -MARGIN_PX)
    known = template[inner, inner].ravel()
    gy, gx = (g[inner, inner].ravel() for g in _gradients(template))
    design = np.column_stack([gx, gy, known - known.mean(), np.ones_like(known)])
    normal = design.T @ design
    if np.linalg.cond(normal / np.sqrt(np.outer(np.diag(normal), np.diag(normal)))) > 1e8:
        return None
    spline = ndimage.spline_filter(window, order=3, mode="mirror")
    y, x = np.indices(window.shape)[:, inner, inner].reshape(2, -1).astype(float)
    moved = start.copy()
    for _ in range(ROUNDS):
        seen = ndimage.map_coordinates(spline, [y + moved[1], x + moved[0]], order=3, mode="mirror", prefilter=False)
        solved = np.linalg.solve(normal, design.T @ seen)
        gain = solved[2]
        if not gain > 0.1:
            return None
        change = solved[:2] / gain
        moved = moved - change  # seen = gain · first(x + m): a motion m that is left is in the gradients' part
        if np.abs(moved).max() > FARTHEST_PX:
            return None
        if np.abs(change).max() < STEP_PX:
            break
    left = seen - design @ solved
    variance = float(left @ left) / (left.size - 4)
    about = seen - seen.mean()
    alike = float(np.sqrt(max(1 - (left @ left) / max(about @ about, 1e-300), 0.0)))
    return moved, normal * gain**2, variance, alike
