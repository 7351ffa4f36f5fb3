"""Temporal and spatial moments of a group of frames, in one pass.

All running sums are integers, so a result has the same bits for any order of the frames and any way of sharing them between
threads; the memory does not grow with their number. The temporal variance is split by a two-way analysis of variance into what is
common to a frame, to a row, to a column, and the rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pixmetry.camera.observations import LevelMoments
from pixmetry.core.arrays import Ints
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.observe._kernels import accumulate_frame, count_codes, sum_maps, sum_pair, sum_squares
from pixmetry.observe.defects import HotTail

MAX_FRAMES = 65536  # so that the sum of 16-bit codes fits 32 bits


@dataclass(frozen=True)
class MeanSquares:
    """Temporal mean squares of a group of frames, as in ``LevelMoments``."""

    pixel_dn2: float
    row_dn2: float
    col_dn2: float
    frame_dn2: float
    total_dn2: float  # plain temporal variance per pixel without the frame part


@dataclass(frozen=True)
class LevelSummary:
    """What one exposure level contributes to a series; ``counts`` (shape (2**bits,), int64) also feed the code histogram."""

    n_frames: int
    mean_dn: float
    squares: MeanSquares
    kurtosis_excess: float
    counts: np.ndarray
    spatial_cov_dn2: float
    row_mean_dn: np.ndarray  # shape (rows,)
    tail: HotTail | None = None  # of the codes, where they were not kept one by one


def check_frame(frame: np.ndarray, bits: int, shape: tuple[int, int] | None = None) -> np.ndarray:
    """Return the frame, contiguous, if it can be reduced: two-dimensional, uint8 or uint16, of the given shape, codes within the bits.

    Raises
    ------
    InputError
        If it is not.
    """
    frame = np.asarray(frame)
    if frame.ndim != 2 or frame.size == 0 or frame.dtype not in (np.uint8, np.uint16):
        raise InputError(
            "a frame must be a two-dimensional array of stored codes",
            value=(frame.dtype.name, frame.shape),
            allowed="uint8 or uint16, [row, col]",
        )
    if shape is not None and frame.shape != shape:
        raise InputError("a frame has another shape than the first of its group", value=frame.shape, allowed=str(shape))
    if (highest := int(frame.max())) >= 2**bits:
        raise InputError(
            "a frame holds codes above the stated number of bits",
            value=highest,
            allowed=f"0 to {2**bits - 1}",
            remedy="state the bits that the file really uses",
        )
    return np.ascontiguousarray(frame)


class FrameMoments:
    """Running sums over the frames of one group.

    Parameters
    ----------
    bits : int
        Bits per stored code; a frame with a code of ``2**bits`` or more is refused.
    """

    def __init__(self, bits: int) -> None:
        if not 1 <= bits <= 16:
            raise InputError("bits per code out of range", where="bits", value=bits, allowed="1 to 16")
        self.bits = bits
        self._shape: tuple[int, int] | None = None
        self._frame_sums: dict[int, int] = {}
        self._row_squares = self._col_squares = 0  # Σ over frames and rows (columns) of the squared row (column) sums

    def _allocate(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self._total = np.zeros(shape, np.uint32)
        self._total_sq = np.zeros(shape, np.uint64)
        self._rows = np.zeros(shape[0], np.int64)
        self._cols = np.zeros(shape[1], np.int64)
        self._counts = np.zeros((4, 2**self.bits), np.int64)

    def add(self, frame: np.ndarray, index: int | None = None) -> None:
        """Add one frame.

        Parameters
        ----------
        frame : ndarray, shape (rows, cols), uint8 or uint16, DN
        index : int, optional
            Place of the frame in its group; by default the frames come in order. Needed where threads share a group.

        Raises
        ------
        InputError
            If the frame does not fit the group, holds codes above the stated bits, or its index was used before.
        """
        frame = check_frame(frame, self.bits, self._shape)
        if self._shape is None:
            self._allocate((frame.shape[0], frame.shape[1]))
        index = len(self._frame_sums) if index is None else index
        if index in self._frame_sums or len(self._frame_sums) == MAX_FRAMES:
            raise InputError("frame index used twice, or too many frames in a group", value=index, allowed=f"up to {MAX_FRAMES} frames")
        accumulate_frame(frame, self._total, self._total_sq, self._rows, self._cols, self._counts)
        self._frame_sums[index] = int(self._rows.sum())
        self._row_squares += _joined(sum_squares(self._rows))
        self._col_squares += _joined(sum_squares(self._cols))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the frames."""
        if self._shape is None:
            raise MeasureError("no frame was added to the group")
        return self._shape

    @property
    def n_frames(self) -> int:
        """Number of frames so far."""
        return len(self._frame_sums)

    @property
    def counts(self) -> np.ndarray:
        """Occurrences of each code, shape (2**bits,), int64."""
        self._need(1)
        of_codes: Ints = self._counts.sum(axis=0)
        return of_codes

    def _need(self, frames: int) -> None:
        if self.n_frames < frames:
            raise MeasureError("not enough frames in a group", value=self.n_frames, allowed=f"{frames} or more")

    def frame_means_dn(self) -> np.ndarray:
        """Mean of each frame in the order of their indices, shape (frames,), DN."""
        self._need(1)
        sums = [self._frame_sums[i] for i in sorted(self._frame_sums)]
        return np.array(sums, dtype=float) / (self.shape[0] * self.shape[1])

    def mean_map_dn(self) -> np.ndarray:
        """Mean over the frames, shape (rows, cols), float64, DN."""
        self._need(1)
        return self._total / self.n_frames

    def deviation_map_dn2(self) -> np.ndarray:
        """Sum of squared deviations from each pixel's mean, shape (rows, cols), float64, DN²."""
        self._need(2)
        f = self.n_frames
        total = self._total.astype(np.uint64)
        # F Σy² ≥ (Σy)², both exact below 2**64 for 16-bit codes and up to 65536 frames
        return (np.uint64(f) * self._total_sq - total * total) / f

    def mean_squares(self) -> MeanSquares:
        """Split the temporal variance over frames, rows, columns and the rest.

        Returns
        -------
        MeanSquares
            Unbiased for any number of frames ≥ 2.

        Raises
        ------
        MeasureError
            With fewer than two frames, rows or columns.

        Notes
        -----
        Balanced analysis of variance with fixed pixel means (Scheffé, *The Analysis of Variance*, 1959, ch. 4) with the sums of squares
        SS_row = N Σ (R_fr − R_r − G_f + G)² on (F−1)(M−1) degrees of freedom, and so on; the sums are exact integers until the last
        division. For F = 2 the total is ½⟨d²⟩ − ½⟨d⟩² of the difference d, EMVA 1288 R4.0 eq. 18.
        """
        self._need(2)
        f, (m, n) = self.n_frames, self.shape
        _need_rows_and_cols(self.shape)
        deviations, _ = sum_maps(self._total, self._total_sq, f, self._rows, self._cols)
        row_totals, col_totals = self._rows.tolist(), self._cols.tolist()
        frame_sums = list(self._frame_sums.values())
        grand = sum(frame_sums)
        frames = f * sum(v * v for v in frame_sums) - grand * grand
        rows = f * self._row_squares - sum(v * v for v in row_totals)
        cols = f * self._col_squares - sum(v * v for v in col_totals)
        return _mean_squares(f, (m, n), deviations, frames, rows, cols)

    def spatial_covariance_dn2(self) -> float:
        """Spatial variance free of temporal noise, DN²: ⟨y_f y_g⟩ − µ_f µ_g averaged over all pairs f ≠ g (EMVA 1288 R4.0 eq. 32)."""
        self._need(2)
        f, size = self.n_frames, self.shape[0] * self.shape[1]
        _, products = sum_maps(self._total, self._total_sq, f, self._rows, self._cols)
        return _covariance(list(self._frame_sums.values()), size, products)

    def kurtosis_excess(self) -> float:
        """Excess kurtosis of the frame differences; NaN where it was not summed."""
        return float("nan")

    def summary(self) -> LevelSummary:
        """What the level contributes to a series; the maps can then be dropped."""
        return LevelSummary(
            n_frames=self.n_frames,
            mean_dn=float(self.frame_means_dn().mean()),
            squares=self.mean_squares(),
            kurtosis_excess=self.kurtosis_excess(),
            counts=self.counts,
            spatial_cov_dn2=self.spatial_covariance_dn2(),
            row_mean_dn=self.mean_map_dn().mean(axis=1),
        )


class LevelAccumulator(FrameMoments):
    """The two or few frames of one exposure level: moments, and the kurtosis of the differences of frames 2k and 2k + 1."""

    def __init__(self, bits: int) -> None:
        super().__init__(bits)
        self._waiting: dict[int, tuple[int, np.ndarray]] = {}
        self._powers = DifferencePowers()

    def add(self, frame: np.ndarray, index: int | None = None) -> None:
        """Add one frame; see :meth:`FrameMoments.add`."""
        index = self.n_frames if index is None else index
        super().add(frame, index)
        self._pair(index, np.ascontiguousarray(frame))

    def _pair(self, index: int, frame: np.ndarray) -> None:
        if index // 2 not in self._waiting:
            self._waiting[index // 2] = (index, frame.copy())
            return
        other_index, other = self._waiting.pop(index // 2)
        first, second = (other, frame) if other_index < index else (frame, other)
        self._powers += _PairSums.of(first, second).powers

    def kurtosis_excess(self) -> float:
        """Excess kurtosis of the frame differences (0 for Gaussian noise, and where all differences are equal)."""
        self._need(2)
        return self._powers.kurtosis_excess()


@dataclass(frozen=True)
class DifferencePowers:
    """Exact sums over pixels of the powers 0 to 4 of frame differences."""

    sums: tuple[int, int, int, int, int] = (0, 0, 0, 0, 0)

    def __add__(self, other: DifferencePowers) -> DifferencePowers:
        n, s1, s2, s3, s4 = (a + b for a, b in zip(self.sums, other.sums, strict=True))
        return DifferencePowers((n, s1, s2, s3, s4))

    def kurtosis_excess(self) -> float:
        """m₄/m₂² − 3 of the central moments; 0 where all differences are equal."""
        n, s1, s2, s3, s4 = self.sums
        variance = n * s2 - s1 * s1  # n² m₂
        fourth = n**3 * s4 - 4 * n * n * s1 * s3 + 6 * n * s1 * s1 * s2 - 3 * s1**4  # n⁴ m₄
        return fourth / variance**2 - 3.0 if variance > 0 else 0.0


@dataclass(frozen=True)
class _PairSums:
    """Exact sums of two frames y0, y1 and their difference."""

    row_sums: np.ndarray  # shape (2, rows)
    col_sums: np.ndarray  # shape (2, cols)
    frame_sums: list[int]
    products: int  # Σ y0 y1
    powers: DifferencePowers

    @classmethod
    def of(cls, first: np.ndarray, second: np.ndarray) -> _PairSums:
        rows, cols = np.empty((2, first.shape[0]), np.int64), np.empty((2, first.shape[1]), np.int64)
        products, squares, cubes, fourths = sum_pair(first, second, rows, cols)
        frames = rows.sum(axis=1).tolist()
        powers = (first.size, frames[1] - frames[0], squares, _joined(cubes), _joined(fourths))
        return cls(rows, cols, frames, products, DifferencePowers(powers))


def summarize_pair(first: np.ndarray, second: np.ndarray, bits: int) -> LevelSummary:
    """Reduce a level of two frames; the same as with a ``LevelAccumulator``, to the bit, but without maps.

    Parameters
    ----------
    first, second : ndarray, shape (rows, cols), uint8 or uint16, DN
    bits : int
        Bits per stored code.

    Raises
    ------
    InputError
        If the frames differ in shape, are not stored codes, or hold codes above the stated bits.
    MeasureError
        With fewer than two rows or columns.
    """
    first = check_frame(first, bits)
    second = check_frame(second, bits, first.shape)
    sums, shape = _PairSums.of(first, second), first.shape
    _need_rows_and_cols(shape)
    counts = np.zeros((4, 2**bits), np.int64)
    count_codes(first, counts)
    count_codes(second, counts)
    # with two frames F Σ y² − (Σ y)² is the square of the difference
    frames = (sums.frame_sums[1] - sums.frame_sums[0]) ** 2
    rows, cols = (_joined(sum_squares(np.abs(part[1] - part[0]))) for part in (sums.row_sums, sums.col_sums))
    return LevelSummary(
        n_frames=2,
        mean_dn=float((np.array(sums.frame_sums, dtype=float) / first.size).mean()),
        squares=_mean_squares(2, shape, float(sums.powers.sums[2]), frames, rows, cols),
        kurtosis_excess=sums.powers.kurtosis_excess(),
        counts=counts.sum(axis=0),
        spatial_cov_dn2=_covariance(sums.frame_sums, first.size, 2.0 * sums.products),
        row_mean_dn=sums.row_sums.sum(axis=0) / (2 * shape[1]),
    )


def _joined(halves: tuple[int, int]) -> int:
    """An exact sum that a kernel gives in two halves."""
    high, low = halves
    return (int(high) << 32) + int(low)


def _need_rows_and_cols(shape: tuple[int, ...]) -> None:
    if min(shape) < 2:
        raise MeasureError("frames are too small to separate rows and columns", value=shape, allowed="2 x 2 or more")


def _mean_squares(f: int, shape: tuple[int, int], deviations: float, frames: int, rows: int, cols: int) -> MeanSquares:
    """From F Σ (value)² − (Σ value)² over the F frames, summed over pixels, for the frame sums, over the row sums and column sums."""
    m, n = shape
    ss_all = deviations / f
    ss_frame = frames / (f * m * n)
    ss_row = (m * rows - frames) / (f * m * n)
    ss_col = (n * cols - frames) / (f * m * n)
    dof = (f - 1) * (m - 1) * (n - 1)
    return MeanSquares(
        pixel_dn2=max((ss_all - ss_frame - ss_row - ss_col) / dof, 0.0),
        row_dn2=ss_row / (n * (f - 1) * (m - 1)),
        col_dn2=ss_col / (m * (f - 1) * (n - 1)),
        frame_dn2=ss_frame / (m * n * (f - 1)),
        total_dn2=max((ss_all - ss_frame) / (m * n * (f - 1)), 0.0),
    )


def _covariance(frame_sums: list[int], size: int, products: float) -> float:
    """Spatial covariance of different frames from Σ over pixels of (Σ y)² − Σ y² and the frame sums."""
    f, grand = len(frame_sums), sum(frame_sums)
    cross_means = (grand * grand - sum(v * v for v in frame_sums)) / (size * size)
    return (products / size - cross_means) / (f * (f - 1))


def level_moments(
    levels: Sequence[LevelAccumulator | LevelSummary],
    exposure_s: Sequence[float],
    photons: Sequence[float] | None = None,
    *,
    code_min: int = 0,
    code_max: int | None = None,
) -> LevelMoments:
    """Collect the levels of a series.

    Parameters
    ----------
    levels : sequence of LevelSummary or LevelAccumulator
        One per level, of two frames or more each. A summary needs no memory for maps.
    exposure_s : sequence of float
        Exposure time of each level.
    photons : sequence of float, optional
        Mean photons per pixel of each level.
    code_min, code_max : int
        Lowest and highest code that the camera can store; by default 0 and ``2**bits - 1``.

    Raises
    ------
    InputError
        If the sequences differ in length.
    MeasureError
        If a level has fewer than two frames.
    """
    if len(exposure_s) != len(levels) or (photons is not None and len(photons) != len(levels)):
        raise InputError("each level needs its exposure and photons", value=(len(levels), len(exposure_s)))
    rows = [level.summary() if isinstance(level, LevelAccumulator) else level for level in levels]
    shares = [row.counts / row.counts.sum() for row in rows]

    def column(values: Iterable[float]) -> np.ndarray:
        return np.array(list(values), dtype=float)

    return LevelMoments(
        exposure_s=column(exposure_s),
        photons=None if photons is None else column(photons),
        n_frames=np.array([row.n_frames for row in rows], dtype=int),
        mean_dn=column(row.mean_dn for row in rows),
        var_total_dn2=column(row.squares.total_dn2 for row in rows),
        ms_pixel_dn2=column(row.squares.pixel_dn2 for row in rows),
        ms_row_dn2=column(row.squares.row_dn2 for row in rows),
        ms_col_dn2=column(row.squares.col_dn2 for row in rows),
        ms_frame_dn2=column(row.squares.frame_dn2 for row in rows),
        kurtosis_excess=column(row.kurtosis_excess for row in rows),
        fraction_min=column(share[code_min] for share in shares),
        fraction_max=column(share[-1 if code_max is None else code_max] for share in shares),
        spatial_cov_dn2=column(row.spatial_cov_dn2 for row in rows),
    )
