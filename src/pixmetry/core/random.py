"""Keyed random streams: the same pixel of the same frame always gets the same number.

A number is a function (Philox4x32-10, a counter-based generator) of a key and a place. The key is a hash of the seed, of the name of the
error source, of the kind of draw and of the draw's number; the place is frame, row and column in absolute coordinates. No state is
kept, so a window equals the crop of the whole bit for bit, whatever the tiles, batches or threads, and whichever other sources are on.

What is *fixed* hangs on the unit seed and never sees the frame: another unit seed is another camera of the same type. What is temporal
hangs on the exposure seed. The methods run in the caller's thread and release the GIL.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.random import Generator as Generator
from numpy.random import Philox
from numpy.typing import ArrayLike, NDArray

from pixmetry.core import _binomial_kernels as binomial_kernels
from pixmetry.core import _random_kernels as kernels
from pixmetry.core.arrays import Singles
from pixmetry.core.errors import ParameterError

_ZERO = np.zeros(1, np.int64)


@dataclass(frozen=True, eq=False)
class Grid:
    """Where draws are wanted: a batch of equal windows in absolute pixel coordinates.

    Parameters
    ----------
    frame : ndarray, shape (n,), int64
        Frame number of each window.
    row0, col0 : ndarray, shape (n,), int64
        Row and column of the first pixel of each window. May be negative; rows and columns repeat after 2^32.
    shape : tuple of int
        Rows and columns of every window.

    Raises
    ------
    ValueError
        If the three arrays differ in length or a side of the windows is negative.
    """

    frame: NDArray[np.int64]
    row0: NDArray[np.int64]
    col0: NDArray[np.int64]
    shape: tuple[int, int]

    def __post_init__(self) -> None:
        for name in ("frame", "row0", "col0"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), np.int64).reshape(-1))
        if not len(self.frame) == len(self.row0) == len(self.col0):
            raise ValueError(f"frame, row0 and col0 differ in length: {len(self.frame)}, {len(self.row0)}, {len(self.col0)}")
        if min(self.shape) < 0:
            raise ValueError(f"negative window shape {self.shape}")

    @classmethod
    def whole(cls, frames: Sequence[int] | NDArray[np.int64], shape: tuple[int, int]) -> Grid:
        """Return the grid of whole frames, with pixel (0, 0) as origin."""
        zero = np.zeros(len(frames), np.int64)
        return cls(np.asarray(frames, np.int64), zero, zero, shape)

    @property
    def size(self) -> tuple[int, int, int]:
        """Shape of an array over this grid: (n, rows, cols)."""
        return len(self.frame), *self.shape


@dataclass(frozen=True)
class Streams:
    """All randomness of one camera: a seed for what its unit is made of, and one for what happens during the exposures.

    ``known`` is what was measured of the unit, by the name of the error source and of the array, and need not be drawn.
    """

    unit_seed: int
    exposure_seed: int
    known: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict, compare=False, repr=False)

    def of(self, instance_name: str) -> Stream:
        """Return the stream of one error source, by the name that it has in its camera."""
        return Stream(self.unit_seed, self.exposure_seed, instance_name, self.known.get(instance_name, {}))


@dataclass(frozen=True)
class Stream:
    """Random numbers of one error source.

    Notes
    -----
    `draw` numbers the independent draws of a source. Draws of different methods are independent too, whatever their number.

    Normal numbers are float32, by Box and Muller from 32 bits each; none is beyond 6.8 standard deviations (probability 1e-11), and the
    error of a value is below 1e-6. Uniform numbers are float32, (k + 1/2) 2^-23, never 0 or 1.
    """

    unit_seed: int
    exposure_seed: int
    name: str
    known: Mapping[str, np.ndarray] = field(default_factory=dict, compare=False, repr=False)
    quiet = False  # True where every temporal draw is at its mean: an effect whose mean is not that of its draw's mean asks for it

    def known_fixed(self, name: str, grid: Grid) -> NDArray[np.float32] | None:
        """Return what was measured of the unit's pixels under a name, shape (n, rows, cols), float32; None where nothing was."""
        whole = self.known.get(name)
        if whole is None:
            return None
        rows, cols = grid.shape
        if len(np.unique(grid.row0)) == 1 == len(np.unique(grid.col0)):  # whole frames, or one window of many
            part = whole[grid.row0[0] : grid.row0[0] + rows, grid.col0[0] : grid.col0[0] + cols].astype(np.float32)
            return np.broadcast_to(part, grid.size)
        at = grid.row0[:, None, None] + np.arange(rows)[:, None], grid.col0[:, None, None] + np.arange(cols)
        in_windows: Singles = whole[at].astype(np.float32)
        return in_windows

    def known_unit(self, name: str) -> np.ndarray | None:
        """Return what was measured of the unit as a whole under a name; None where nothing was."""
        return self.known.get(name)

    def normal(self, grid: Grid, draw: int = 0) -> NDArray[np.float32]:
        """Return standard normal numbers, shape (n, rows, cols), new in every frame."""
        return self._windows(self._key("exposure", "normal", draw), grid)

    def normal_fixed(self, grid: Grid, draw: int = 0) -> NDArray[np.float32]:
        """Return standard normal numbers, shape (n, rows, cols), fixed in the unit: the same in every frame."""
        return self._windows(self._key("unit", "normal", draw), _still(grid))

    def normal_rows(self, grid: Grid, draw: int = 0) -> NDArray[np.float32]:
        """Return one standard normal number a row, shape (n, rows), new in every frame."""
        return self._lines(self._key("exposure", "normal rows", draw), grid.frame, grid.row0, grid.shape[0])

    def normal_rows_fixed(self, grid: Grid, draw: int = 0) -> NDArray[np.float32]:
        """Return one standard normal number a row, shape (n, rows), fixed in the unit."""
        return self._lines(self._key("unit", "normal rows", draw), np.zeros_like(grid.frame), grid.row0, grid.shape[0])

    def normal_cols(self, grid: Grid, draw: int = 0) -> NDArray[np.float32]:
        """Return one standard normal number a column, shape (n, cols), new in every frame."""
        return self._lines(self._key("exposure", "normal cols", draw), grid.frame, grid.col0, grid.shape[1])

    def normal_cols_fixed(self, grid: Grid, draw: int = 0) -> NDArray[np.float32]:
        """Return one standard normal number a column, shape (n, cols), fixed in the unit."""
        return self._lines(self._key("unit", "normal cols", draw), np.zeros_like(grid.frame), grid.col0, grid.shape[1])

    def normal_frames(self, grid: Grid, draw: int = 0) -> NDArray[np.float32]:
        """Return one standard normal number a frame, shape (n,)."""
        return self._lines(self._key("exposure", "normal frames", draw), grid.frame, np.zeros_like(grid.frame), 1)[:, 0]

    def normal_unit(self, count: int, draw: int = 0) -> NDArray[np.float32]:
        """Return `count` standard normal numbers fixed in the unit, shape (count,); a shorter call gives the first of them."""
        numbers: Singles = self._lines(self._key("unit", "normal unit", draw), _ZERO, _ZERO, count)[0]
        return numbers

    def uniform(self, grid: Grid, draw: int = 0) -> NDArray[np.float32]:
        """Return uniform numbers in (0, 1), shape (n, rows, cols), new in every frame."""
        return self._windows(self._key("exposure", "uniform", draw), grid, uniform=True)

    def uniform_fixed(self, grid: Grid, draw: int = 0) -> NDArray[np.float32]:
        """Return uniform numbers in (0, 1), shape (n, rows, cols), fixed in the unit."""
        return self._windows(self._key("unit", "uniform", draw), _still(grid), uniform=True)

    def uniform_frames(self, grid: Grid, draw: int = 0) -> NDArray[np.float32]:
        """Return one uniform number a frame, shape (n,)."""
        return self._lines(self._key("exposure", "uniform frames", draw), grid.frame, np.zeros_like(grid.frame), 1, uniform=True)[:, 0]

    def uniform_unit(self, count: int, draw: int = 0) -> NDArray[np.float32]:
        """Return `count` uniform numbers fixed in the unit, shape (count,); a shorter call gives the first of them."""
        numbers: Singles = self._lines(self._key("unit", "uniform unit", draw), _ZERO, _ZERO, count, uniform=True)[0]
        return numbers

    def poisson(self, mean: ArrayLike, grid: Grid, draw: int = 0) -> NDArray[np.float32]:
        """Return Poisson numbers, shape (n, rows, cols), new in every frame.

        Parameters
        ----------
        mean : array_like, broadcast to (n, rows, cols), float32
            Mean of each pixel, in counts (electrons, photons).
        grid : Grid
            Where.
        draw : int
            Which draw of this source.

        Returns
        -------
        ndarray, shape (n, rows, cols), float32
            The smallest count whose cumulative probability reaches a uniform number of 52 bits that belongs to the pixel. So a count
            never falls when its mean rises, and two runs that differ in the mean are paired. Exact (to the 1e-14 at which float64 knows
            the cumulative probability) for means up to 1e7; above, within 0.05 % of a standard deviation and rounded to float32.

        Raises
        ------
        ParameterError
            If a mean is negative, infinite or NaN.
        """
        return self._poisson(self._key("exposure", "poisson", draw), mean, grid)

    def binomial(self, count: ArrayLike, share: ArrayLike, grid: Grid, draw: int = 0) -> NDArray[np.float32]:
        """Return how many of each count go one way, each for itself with probability ``share``; shape (n, rows, cols), new in every frame.

        Parameters
        ----------
        count : array_like, broadcast to (n, rows, cols), float32
            Electrons, as a rule whole numbers. Of a part of one the share goes.
        share : array_like, a number or broadcast to (n, rows, cols)
            Between 0 and 1.
        grid : Grid
            Where.
        draw : int
            Which draw of this source.

        Returns
        -------
        ndarray, shape (n, rows, cols), float32
            By inversion: it never falls when the share rises. Exact for means below 12, above to 3e-4 of the cumulative probability.
        """
        p = np.asarray(share, np.float64)
        p = np.ascontiguousarray(p.reshape((1,) * (3 - p.ndim) + p.shape))
        if p.size and not (p.min() >= 0 and p.max() <= 1):
            raise ParameterError("a share of charge lies outside 0 to 1", where="share", allowed="0 to 1")
        out = np.empty(grid.size, np.float32)
        binomial_kernels.binomial_windows(self.key("binomial", draw), grid.frame, grid.row0, grid.col0, _filled(count, grid), p, out)
        return out

    def key(self, kind: str, draw: int = 0) -> np.uint64:
        """Return the key of temporal draws, for a kernel that draws for itself; ``kind`` names what it draws."""
        return self._key("exposure", kind, draw)

    def add_normal(self, data: ArrayLike, grid: Grid, scale: ArrayLike, draw: int = 0) -> NDArray[np.float32]:
        """Return ``data + scale * self.normal(grid, draw)`` in one pass.

        Parameters
        ----------
        data : array_like, broadcast to (n, rows, cols), float32
            What the noise is added to; it is not changed.
        grid : Grid
            Where.
        scale : array_like, a number or broadcast to (n, rows, cols), float32
            Standard deviation, in the unit of the data.
        draw : int
            Which draw of this source.

        Returns
        -------
        ndarray, shape (n, rows, cols), float32
        """
        return self._add(self._key("exposure", "normal", draw), data, grid, scale)

    def add_normal_fixed(self, data: ArrayLike, grid: Grid, scale: ArrayLike, draw: int = 0) -> NDArray[np.float32]:
        """Return ``data + scale * self.normal_fixed(grid, draw)`` in one pass; see `add_normal`."""
        return self._add(self._key("unit", "normal", draw), data, _still(grid), scale)

    def _key(self, life: str, kind: str, draw: int) -> np.uint64:
        return _key(self.unit_seed if life == "unit" else self.exposure_seed, life, self.name, kind, draw)

    @staticmethod
    def _windows(key: np.uint64, grid: Grid, uniform: bool = False) -> NDArray[np.float32]:
        out = np.empty(grid.size, np.float32)
        kernels.draw_windows(key, grid.frame, grid.row0, grid.col0, uniform, out)
        return out

    @staticmethod
    def _lines(
        key: np.uint64, frame: NDArray[np.int64], start: NDArray[np.int64], count: int, uniform: bool = False
    ) -> NDArray[np.float32]:
        out = np.empty((len(frame), 1, count), np.float32)
        kernels.draw_windows(key, frame, np.zeros_like(frame), start, uniform, out)
        return out[:, 0]

    @staticmethod
    def _add(key: np.uint64, data: ArrayLike, grid: Grid, scale: ArrayLike) -> NDArray[np.float32]:
        out = np.empty(grid.size, np.float32)
        factor = np.asarray(scale, np.float32)
        if factor.ndim:
            factor = _filled(factor, grid)
        kernels.add_windows(key, grid.frame, grid.row0, grid.col0, _filled(data, grid), factor.reshape(-1), out)
        return out

    @staticmethod
    def _poisson(key: np.uint64, mean: ArrayLike, grid: Grid) -> NDArray[np.float32]:
        out = np.empty(grid.size, np.float32)
        refused = kernels.poisson_windows(key, grid.frame, grid.row0, grid.col0, _filled(mean, grid), out)
        if refused:
            raise ParameterError(f"{refused} pixels have no Poisson distribution", where="mean", allowed="finite numbers of at least 0")
        return out


class _Quiet:
    """A stream whose temporal draws equal their mean; fixed patterns of the unit are drawn as usual."""

    quiet = True

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        if name.endswith(("_fixed", "_unit")):
            return getattr(self._stream, name)
        raise AttributeError(name)

    def normal(self, grid: Grid, draw: int = 0) -> np.ndarray:
        return np.zeros(grid.size, np.float32)

    def normal_rows(self, grid: Grid, draw: int = 0) -> np.ndarray:
        return np.zeros(grid.size[:2], np.float32)

    def normal_cols(self, grid: Grid, draw: int = 0) -> np.ndarray:
        return np.zeros((grid.size[0], grid.size[2]), np.float32)

    def normal_frames(self, grid: Grid, draw: int = 0) -> np.ndarray:
        return np.zeros(grid.size[0], np.float32)

    def uniform(self, grid: Grid, draw: int = 0) -> np.ndarray:
        return np.full(grid.size, 0.5, np.float32)

    def uniform_frames(self, grid: Grid, draw: int = 0) -> np.ndarray:
        return np.full(grid.size[0], 0.5, np.float32)

    def poisson(self, mean: np.ndarray, grid: Grid, draw: int = 0) -> np.ndarray:
        return _fresh(mean, grid)

    def binomial(self, count: np.ndarray, share: Any, grid: Grid, draw: int = 0) -> np.ndarray:
        return _fresh(np.asarray(count, np.float32) * np.asarray(share, np.float32), grid)

    def key(self, kind: str, draw: int = 0) -> np.uint64:
        """Of no draw: a kernel that is given it must ask for ``quiet``."""
        return np.uint64(0)

    def add_normal(self, data: np.ndarray, grid: Grid, scale: Any, draw: int = 0) -> np.ndarray:
        return _fresh(data, grid)


def _fresh(data: np.ndarray, grid: Grid) -> np.ndarray:
    """A copy, as every draw returns: the caller may go on in place."""
    return np.array(np.broadcast_to(data, grid.size), np.float32)


@dataclass(frozen=True)
class QuietStreams(Streams):
    """Streams of which every temporal draw is at its mean: they make the expected frame of a unit."""

    def of(self, instance_name: str) -> Any:
        return _Quiet(super().of(instance_name))


def _still(grid: Grid) -> Grid:
    return Grid(np.zeros_like(grid.frame), grid.row0, grid.col0, grid.shape)


def _filled(values: ArrayLike, grid: Grid) -> NDArray[np.float32]:
    return np.ascontiguousarray(np.broadcast_to(np.asarray(values, np.float32), grid.size))


@lru_cache(maxsize=4096)
def _key(seed: int, life: str, name: str, kind: str, draw: int) -> np.uint64:
    text = "\0".join([str(int(seed)), life, kind, str(int(draw)), name])
    return np.uint64(int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little"))


def generator(seed: int, name: str) -> Generator:
    """A generator for draws without a position on a sensor, such as those of a result's uncertainty; another one for each seed and name."""
    return Generator(Philox(key=int(_key(seed, "result", name, "", 0))))
