"""Autocovariance of the noise of frame pairs, summed beside the moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pixmetry.camera.noise_covariance import LAGS, REACH, NoiseCovariance, plane_of
from pixmetry.core.arrays import Array
from pixmetry.observe._covariance_kernels import sum_differences, sum_lag_products

MARGIN_PX = 8
FIRST_FRAME, MOST_FRAMES = 4, 32  # of a stack whose succession is looked at; the first ones may hold what was before them


@dataclass
class LagProducts:
    """Products of the noise of frame pairs at small lags, inside of a margin; by the number of the pair, for a sum of any order."""

    by_pair: dict[int, np.ndarray] = field(default_factory=dict)  # each of shape (2, 2, 5, 9), as `sum_lag_products` has them
    _means: dict[int, float] = field(default_factory=dict)
    samples: dict[int, np.ndarray] = field(default_factory=dict)  # the first frames of a stack
    margin_px: int = 0
    shape: tuple[int, int] = (0, 0)  # of the frames, without their margin

    def add(self, pair: int, products: np.ndarray, mean_dn: float, shape: tuple[int, ...]) -> None:
        """Add the products of one pair of frames of a shape, and the mean of its first frame inside of the margin."""
        m = margin_px(shape)
        self.by_pair[pair] = products
        self.margin_px, self.shape = m, (shape[0] - 2 * m, shape[1] - 2 * m)
        self._means[pair] = mean_dn

    def mean_dn(self) -> float:
        """Mean of the frames inside of the margin, DN."""
        return float(np.mean([self._means[k] for k in sorted(self._means)]))

    def covariance_dn2(self) -> np.ndarray:
        """Mean products, shape (2, 2, 5, 9), DN²; see `NoiseCovariance`.

        Notes
        -----
        Without the means of rows and columns a product at lag (j, i) is too small by Σ_i C(j, i)/N + Σ_j C(j, i)/M − ΣΣ C/(MN) for N
        columns and M rows (as the n − 1 of a variance, for each lag). These equations are solved for the lags within reach.
        """
        (rows, cols), total = self.shape, np.sum([self.by_pair[k] for k in sorted(self.by_pair)], axis=0)
        mean = total / (len(self.by_pair) * _counts(self.shape))
        down, along = np.array(LAGS).T
        pooled = plane_of(mean.mean(axis=(0, 1))[down, along + REACH])
        n, m = pooled.shape
        over_row, over_column = np.kron(np.eye(n), np.ones((m, m))) / cols, np.kron(np.ones((n, n)), np.eye(m)) / rows
        lost = over_row + over_column - np.ones((n * m, n * m)) / (rows * cols)
        found = np.linalg.solve(np.eye(n * m) - lost, pooled.ravel()).reshape(n, m)
        corrected: Array = mean + (found - pooled)[REACH:]
        return corrected


class FrameSuccession:
    """Differences of frames one and two apart; frames may come in any order, and few are held.

    Parameters
    ----------
    first, most : int
        The first frame that is looked at, and how many.
    """

    def __init__(self, first: int = FIRST_FRAME, most: int = MOST_FRAMES) -> None:
        self._first, self._most = first, most
        self._waiting: dict[int, np.ndarray] = {}
        self._squares: dict[tuple[int, int], float] = {}  # by first frame and distance

    def due(self, index: int, frame: np.ndarray) -> list[tuple[tuple[int, int], np.ndarray, np.ndarray]]:
        """Pairs of frames whose difference is now to be taken, with their keys for `put`."""
        if not self._first <= index < self._first + self._most:
            return []
        waiting = self._waiting
        waiting[index] = frame
        keys = [(i, lag) for lag in (1, 2) for i in (index - lag, index) if i in waiting and i + lag in waiting]
        found = [((i, lag), waiting[i], waiting[i + lag]) for i, lag in keys]
        around = range(index - 2, index + 3)
        for i in around:  # a frame with all of its neighbours is no longer needed
            if all(j in waiting or (j, -1) in self._squares for j in (i - 2, i - 1, i, i + 1, i + 2) if j >= self._first):
                self._squares[i, -1] = 0.0
        for i in [i for i in waiting if (i, -1) in self._squares]:
            del waiting[i]
        return found

    def put(self, key: tuple[int, int], square_dn2: float) -> None:
        """Keep half the mean square of one difference."""
        self._squares[key] = square_dn2

    def result(self) -> tuple[np.ndarray, int]:
        """Means over the pairs one and two frames apart, shape (2,), NaN without any; and the number of frames."""
        means = np.full(2, np.nan)
        for lag in (1, 2):
            values = [self._squares[key] for key in sorted(self._squares) if key[1] == lag]
            if values:
                means[lag - 1] = np.mean(values)
        frames = sum(1 for key in self._squares if key[1] == 1) + 1
        return means, frames if np.isfinite(means).all() else 0


def white_square(first: np.ndarray, second: np.ndarray) -> float:
    """Half the mean square of the difference of two frames, DN², without what rows and columns have in common."""
    rows, cols = first.shape
    of_rows, of_cols = np.empty(rows, np.int64), np.empty(cols, np.int64)
    squares = sum_differences(first, second, of_rows, of_cols)
    total, by_row, by_col = float(of_rows.sum()), float((of_rows.astype(float) ** 2).sum()), float((of_cols.astype(float) ** 2).sum())
    white = squares - (rows * by_row + cols * by_col - total**2) / (rows * cols)
    return white / (2 * (rows - 1) * (cols - 1))


def _counts(shape: tuple[int, int]) -> np.ndarray:
    """Number of products at each lag by the parities of row and column, shape (2, 2, 5, 9)."""
    rows, cols = (np.arange(n) for n in shape)
    down = np.array([[np.sum((rows % 2 == p) & (rows + j < shape[0])) for j in range(REACH + 1)] for p in (0, 1)])
    along = [[np.sum((cols % 2 == p) & (cols + i >= 0) & (cols + i < shape[1])) for i in range(-REACH, REACH + 1)] for p in (0, 1)]
    counts: Array = down[:, None, :, None] * np.array(along)[None, :, None, :]
    return counts


def margin_px(shape: tuple[int, ...]) -> int:
    """Width of the border that is left out, even, so that a mosaic keeps its phase: filters repeat or mirror the frame there."""
    return min(MARGIN_PX, min(shape) // 8 // 2 * 2)


def lag_products(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, float]:
    """Products of the noise of two frames at small lags.

    Parameters
    ----------
    first, second : ndarray, shape (rows, cols), uint8 or uint16, DN

    Returns
    -------
    ndarray, shape (2, 2, 5, 9), float64, DN²
        Of their difference over √2 inside of the margin, less its row and column means; see `sum_lag_products`.
    float
        Mean of the first frame inside of the margin, DN.
    """
    sums = np.empty((2, 2, REACH + 1, 2 * REACH + 1))
    mean = sum_lag_products(first, second, margin_px(first.shape), sums)
    return sums / 2, mean


@dataclass(frozen=True)
class CorrelatedGroup:
    """One group of frames with its products."""

    bright: bool
    stack: bool
    exposure_s: float
    mean_dn: float
    clipped: float
    products: LagProducts
    succession: FrameSuccession
    var_dn2: float


def noise_covariance(groups: Sequence[CorrelatedGroup]) -> NoiseCovariance | None:
    """The record of all groups that are large enough; None where there is none."""
    used = [g for g in groups if g.products.by_pair and min(g.products.shape) > 4 * REACH]
    if not used:
        return None
    successions = [g.succession.result() for g in used]
    return NoiseCovariance(
        bright=np.array([g.bright for g in used]),
        stack=np.array([g.stack for g in used]),
        exposure_s=np.array([g.exposure_s for g in used]),
        mean_dn=np.array([g.mean_dn for g in used]),
        clipped=np.array([g.clipped for g in used]),
        n_pairs=np.array([len(g.products.by_pair) for g in used]),
        covariance_dn2=np.array([g.products.covariance_dn2() for g in used]),
        inner_mean_dn=np.array([g.products.mean_dn() for g in used]),
        var_dn2=np.array([g.var_dn2 for g in used]),
        successive_dn2=np.array([mean for mean, _ in successions]),
        n_successive=np.array([frames for _, frames in successions]),
        frame_shape=used[0].products.shape,
        margin_px=used[0].products.margin_px,
    )
