"""Frames that are shifted by parts of a pixel, on a finer grid: frequencies that a single frame folds down are parted by the shifts.

The image on the pixels, g = image ∗ aperture, is displaced by s in a frame: a pixel at x holds g(x − s). Of a frequency f of g, a frame
shows exp(−2πi f s), and all frequencies that differ by whole cycles per pixel are folded into one. Frames with other shifts fold them with
other phases; M frames or more part M of them along an axis (R. Y. Tsai, T. S. Huang 1984). Then each is divided by the aperture's transfer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pixmetry.core.errors import InputError

MOST_FINER = 4
BORDER_PX = 8  # along each edge, over which the frames are faded out
LEAST_PX = 16  # of each side that is left
LEAST_CONTRAST = 0.1  # that the aperture leaves to a frequency that is restored
MOST_NOISE = 2.0  # by which uneven shifts may raise the noise over that of evenly spread ones
SHIFT_KEY, FINER_KEY = "shifts_px", "finer"  # in the maps of a correction
Transfer = Callable[[np.ndarray, np.ndarray], np.ndarray]  # of frequencies along x and y, in cycles per pixel


class Area(NamedTuple):
    """What is left of a frame without its border: first row and column, and size; pixels."""

    row0: int
    col0: int
    rows: int
    cols: int


@dataclass(frozen=True, eq=False)
class ShiftedFrames:
    """Frames of one image at known places.

    Parameters
    ----------
    shifts_px : ndarray, shape (n, 2), float64
        By how much the image is displaced in each frame, along x and y.
    finer : (int, int)
        Pixels of the finer grid in a pixel, along x and y.
    frame_shape : (int, int)
        Rows and columns of a frame.

    Examples
    --------
    >>> import numpy as np
    >>> quarters = [[k / 4, 0.0] for k in range(4)]
    >>> grid = ShiftedFrames(np.array(quarters), (4, 1), (48, 48))
    >>> grid.area, round(grid.unevenness, 6)
    (Area(row0=8, col0=8, rows=32, cols=31), 1.0)
    """

    shifts_px: np.ndarray
    finer: tuple[int, int]
    frame_shape: tuple[int, int]

    def check(self) -> None:
        """Refuse shifts from which the finer grid cannot be made."""
        s, (mx, my) = np.asarray(self.shifts_px), self.finer
        if s.ndim != 2 or s.shape[1] != 2 or not np.isfinite(s).all():
            raise InputError("a shift along x and y is needed for every frame", where="shifts", value=s.shape, allowed="(frames, 2)")
        if not (1 <= mx <= MOST_FINER and 1 <= my <= MOST_FINER):
            raise InputError("no such finer grid", where="finer", value=f"{mx}x{my}", allowed=f"1 to {MOST_FINER} along each axis")
        if len(s) < mx * my:
            remedy = f"take {mx * my} frames, or ask for a coarser grid"
            raise InputError("too few frames", where="finer", value=f"{len(s)} for {mx}x{my}", allowed=f"{mx * my} or more", remedy=remedy)
        if not self.unevenness <= MOST_NOISE:
            remedy = f"shift the image by steps of 1/{max(mx, my)} px, or ask for a coarser grid"
            value = f"noise × {self.unevenness:.3g}" if np.isfinite(self.unevenness) else "they coincide"
            raise InputError("the shifts do not part the pixels of the finer grid", where="shifts", value=value,
                             allowed=f"noise × {MOST_NOISE:g}", remedy=remedy)  # fmt: skip
        if min(self.area.rows, self.area.cols) < LEAST_PX:
            need = tuple(int(np.ceil(np.ptp(s[:, k]))) + 2 * BORDER_PX + LEAST_PX + 2 for k in (1, 0))
            raise InputError("the frames are too small, or shifted too far", where="frames", value=self.frame_shape,
                             allowed=f"{need[0]} rows and {need[1]} columns", remedy="take larger frames")  # fmt: skip

    @cached_property
    def _phases(self) -> np.ndarray:
        """Of the folded frequencies, row by row of the finer spectrum, in every frame; shape (frames, frequencies)."""
        mx, my = np.meshgrid(np.arange(self.finer[0]), np.arange(self.finer[1]))
        wave = np.outer(self.shifts_px[:, 0], mx.ravel()) + np.outer(self.shifts_px[:, 1], my.ravel())
        return np.exp(-2j * np.pi * wave)

    @cached_property
    def _covariance(self) -> np.ndarray:
        """Variance of each parted frequency over that of one frame."""
        strength = np.linalg.svd(self._phases, compute_uv=False)
        if strength[-1] < 1e-6 * strength[0]:
            return np.full(self._phases.shape[1], np.inf)
        return np.real(np.diag(np.linalg.inv(self._phases.conj().T @ self._phases)))

    @property
    def unevenness(self) -> float:
        """Noise over that of as many frames with evenly spread shifts; inf where the shifts do not part the frequencies."""
        return float(np.sqrt(self._covariance.mean() * len(self.shifts_px)))

    @cached_property
    def area(self) -> Area:
        """Whole pixels that all frames hold, without the border."""
        first, last = np.ceil(self._reach[0] + BORDER_PX), np.floor(self._reach[1] - BORDER_PX)
        col0, row0 = (int(v) for v in first)
        cols, rows = (int(v) for v in last - first + 1)
        return Area(row0, col0, rows, cols)

    @property
    def _reach(self) -> tuple[np.ndarray, np.ndarray]:
        """First and last place of the image, along x and y, that every frame holds."""
        size = np.array(self.frame_shape[::-1], float)
        return -self.shifts_px.min(axis=0), size - 1 - self.shifts_px.max(axis=0)

    def frequencies(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the finer spectrum along x and y in cycles per pixel, in the order of `numpy.fft`."""
        return tuple(m * np.fft.fftfreq(m * n) for m, n in zip(self.finer, self.frame_shape[::-1], strict=True))  # type: ignore[return-value]

    def restored(self, frames: np.ndarray, transfer: Transfer) -> tuple[np.ndarray, float]:
        """The image on the finer grid, over `area`, and what is left between frames and image.

        Parameters
        ----------
        frames : ndarray, shape (n, rows, cols), float
        transfer : callable
            Complex transfer of the aperture.

        Returns
        -------
        ndarray, shape (rows of the area × finer y, cols × finer x), float64
            Means over the finer pixels.
        float
            Standard deviation of the residuals in a pixel; NaN where there are no more frames than needed.
        """
        self.check()
        (mx, my), (rows, cols), level, low = self.finer, self.frame_shape, float(np.mean(frames)), self._lowest
        spectra = np.empty((len(frames), rows, cols), complex)
        for k, (frame, (sx, sy)) in enumerate(zip(frames, self.shifts_px, strict=True)):
            fade = np.outer(self._fade(np.arange(rows) - sy, 1), self._fade(np.arange(cols) - sx, 0))
            turn = np.exp(2j * np.pi * (low[1] * sy)[:, None]) * np.exp(2j * np.pi * low[0] * sx)
            spectra[k] = np.fft.fft2((frame - level) * fade) * turn
        inverse = np.linalg.pinv(self._phases)
        parted = np.tensordot(inverse, spectra, 1)  # (frequencies, rows, cols)
        spare, left = len(frames) - mx * my, float("nan")
        if spare > 0:
            rest = spectra - np.tensordot(self._phases, parted, 1)
            weight = sum(np.mean(self._fade(np.arange(rows) - s[1], 1) ** 2) * np.mean(self._fade(np.arange(cols) - s[0], 0) ** 2)
                         for s in self.shifts_px) / len(frames)  # fmt: skip
            left = float(np.sqrt(np.mean(np.abs(rest) ** 2) / (rows * cols * weight) * len(frames) / spare))
        whole = self._in_order(parted)
        fx, fy = self.frequencies()
        gain = self._gain(transfer)
        start = [(1 / m - 1) / 2 for m in self.finer]  # of the first finer pixel in the pixel 0
        gain = gain * np.exp(2j * np.pi * fy * start[1])[:, None] * np.exp(2j * np.pi * fx * start[0])
        image = np.real(np.fft.ifft2(whole * gain)) * mx * my + level
        a = self.area
        # places of the image lie beyond the frame where all shifts have an offset; the spectrum repeats them after a frame's size
        at_y, at_x = my * a.row0 + np.arange(my * a.rows), mx * a.col0 + np.arange(mx * a.cols)
        return image.take(at_y, 0, mode="wrap").take(at_x, 1, mode="wrap"), left

    def noise_rel(self, transfer: Transfer) -> float:
        """Standard deviation of a finer pixel over that of a pixel of one frame, by white noise."""
        power = np.abs(self._gain(transfer)) ** 2 * self._in_order(self._covariance[:, None, None])
        return float(np.sqrt(np.mean(power) * self.finer[0] * self.finer[1]))

    @property
    def _lowest(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the frequencies along x and along y that fold to one, the lowest."""
        bases = [(m, np.arange(n) / n) for m, n in zip(self.finer, self.frame_shape[::-1], strict=True)]
        x, y = (base - m // 2 - (np.where(base < 0.5, 0, 1) if m % 2 else 0) for m, base in bases)
        return x, y

    def _in_order(self, parted: np.ndarray) -> np.ndarray:
        """Parted frequencies, shape (frequencies, rows, cols), where they stand in the finer spectrum."""
        (mx, my), (rows, cols), low = self.finer, self.frame_shape, self._lowest
        whole = np.zeros((my * rows, mx * cols), parted.dtype)
        for index, part in enumerate(parted):
            parts = [np.rint((lo + step) * n).astype(int) % (m * n)
                     for lo, step, n, m in ((low[1], index // mx, rows, my), (low[0], index % mx, cols, mx))]  # fmt: skip
            whole[np.ix_(*parts)] = part
        return whole

    def _gain(self, transfer: Transfer) -> np.ndarray:
        """Of the restored spectrum: from the aperture of a pixel to that of the finer pixel."""
        fx, fy = self.frequencies()
        wanted = np.outer(np.sinc(fy / self.finer[1]), np.sinc(fx / self.finer[0]))
        return wanted * inverse_of(transfer(fx, fy[:, None]))

    def _fade(self, places_px: np.ndarray, axis: int) -> np.ndarray:
        """Weight of places along an axis: 1 within, falling to 0 over the border."""
        first, last = self._reach[0][axis], self._reach[1][axis]
        inward = np.clip(np.minimum(places_px - first, last - places_px) / BORDER_PX, 0, 1)
        return np.asarray(np.sin(0.5 * np.pi * inward) ** 2)


def inverse_of(transfer: np.ndarray) -> np.ndarray:
    """The reciprocal where the contrast is `LEAST_CONTRAST` or more; below that it falls to nothing with the contrast."""
    return np.asarray(np.conj(transfer) / np.maximum(np.abs(transfer), LEAST_CONTRAST) ** 2)


def finest(shifts_px: np.ndarray, frame_shape: tuple[int, int]) -> tuple[int, int]:
    """The finest grid that frames with these shifts part without much noise; (1, 1) if there is none."""
    steps = range(1, MOST_FINER + 1)
    for mx, my in sorted(((x, y) for x in steps for y in steps), key=lambda m: (-m[0] * m[1], abs(m[0] - m[1]))):
        if mx * my <= len(shifts_px) and ShiftedFrames(shifts_px, (mx, my), frame_shape).unevenness <= MOST_NOISE:
            return mx, my
    return 1, 1


def lost_bands(transfer: Callable[[np.ndarray], np.ndarray], finer: int) -> list[tuple[float, float]]:
    """Frequencies of the finer grid along an axis that the aperture leaves too little contrast: from, to, in cycles per pixel."""
    f = np.linspace(0, finer / 2, 1001)
    low = np.flatnonzero(np.diff(np.concatenate([[0], np.abs(transfer(f)) < LEAST_CONTRAST, [0]]).astype(int)))
    return [(float(f[a]), float(f[b - 1])) for a, b in low.reshape(-1, 2)]
