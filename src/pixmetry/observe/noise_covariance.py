"""Autocovariance of the noise of frame pairs, summed beside the moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pixmetry.camera.noise_covariance import LAGS, REACH, NoiseCovariance, plane_of
from pixmetry.core.arrays import Array
from pixmetry.observe._covariance_kernels import sum_lag_products

ROUNDS = 4  # of the correction for the means that are taken out; each is smaller by the share of a line that the lags are


@dataclass
class LagProducts:
    """Products of the noise of frame pairs at small lags; by the number of the pair, so that their sum does not depend on the order."""

    by_pair: dict[int, np.ndarray] = field(default_factory=dict)  # each of shape (2, 2, 5, 9), as `sum_lag_products` has them
    shape: tuple[int, int] = (0, 0)

    def add(self, pair: int, products: np.ndarray, shape: tuple[int, int]) -> None:
        """Add the products of one pair."""
        self.by_pair[pair] = products
        self.shape = shape

    def covariance_dn2(self) -> np.ndarray:
        """Mean products, shape (2, 2, 5, 9), DN²; see `NoiseCovariance`.

        Notes
        -----
        Without the means of rows and columns a product at lag (j, i) is too small by Σ_i C(j, i)/N + Σ_j C(j, i)/M − ΣΣ C/(MN) for N
        columns and M rows (as the n − 1 of a variance, for each lag). The sums over the lags within reach are put in, of what was
        corrected so far.
        """
        (rows, cols), total = self.shape, np.sum([self.by_pair[k] for k in sorted(self.by_pair)], axis=0)
        mean = total / (len(self.by_pair) * _counts(self.shape))
        down, along = np.array(LAGS).T
        pooled = plane_of(mean.mean(axis=(0, 1))[down, along + REACH])
        found = pooled
        for _ in range(ROUNDS):
            lines = found.sum(axis=1, keepdims=True) / cols + found.sum(axis=0, keepdims=True) / rows - found.sum() / (rows * cols)
            found = pooled + lines
        corrected: Array = mean + (found - pooled)[REACH:]
        return corrected


def _counts(shape: tuple[int, int]) -> np.ndarray:
    """Number of products at each lag by the parities of row and column, shape (2, 2, 5, 9)."""
    rows, cols = (np.arange(n) for n in shape)
    down = np.array([[np.sum((rows % 2 == p) & (rows + j < shape[0])) for j in range(REACH + 1)] for p in (0, 1)])
    along = [[np.sum((cols % 2 == p) & (cols + i >= 0) & (cols + i < shape[1])) for i in range(-REACH, REACH + 1)] for p in (0, 1)]
    counts: Array = down[:, None, :, None] * np.array(along)[None, :, None, :]
    return counts


def lag_products(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Products of the noise of two frames at small lags.

    Parameters
    ----------
    first, second : ndarray, shape (rows, cols), uint8 or uint16, DN

    Returns
    -------
    ndarray, shape (2, 2, 5, 9), float64, DN²
        Of their difference over √2, less its row and column means; see `sum_lag_products`.
    """
    rows, cols = first.shape
    padded = np.zeros((rows + REACH, cols + 2 * REACH), np.float32)
    noise = padded[:rows, REACH : REACH + cols]
    np.subtract(second, first, out=noise, dtype=np.float32)
    noise -= noise.mean(axis=1, dtype=float)[:, None].astype(np.float32)
    noise -= noise.mean(axis=0, dtype=float).astype(np.float32)
    sums = np.empty((2, 2, REACH + 1, 2 * REACH + 1))
    sum_lag_products(padded, rows, cols, sums)
    halves: Array = sums / 2
    return halves


@dataclass(frozen=True)
class CorrelatedGroup:
    """One group of frames with its products."""

    bright: bool
    stack: bool
    exposure_s: float
    mean_dn: float
    clipped: float
    products: LagProducts
    var_dn2: float
    n_frames: int


def noise_covariance(groups: Sequence[CorrelatedGroup]) -> NoiseCovariance | None:
    """The record of all groups that are large enough; None where there is none."""
    used = [g for g in groups if g.products.by_pair and min(g.products.shape) > 4 * REACH]
    if not used:
        return None
    return NoiseCovariance(
        bright=np.array([g.bright for g in used]),
        stack=np.array([g.stack for g in used]),
        exposure_s=np.array([g.exposure_s for g in used]),
        mean_dn=np.array([g.mean_dn for g in used]),
        clipped=np.array([g.clipped for g in used]),
        n_pairs=np.array([len(g.products.by_pair) for g in used]),
        covariance_dn2=np.array([g.products.covariance_dn2() for g in used]),
        stack_var_dn2=np.array([g.var_dn2 if g.stack else np.nan for g in used]),
        n_frames=np.array([g.n_frames for g in used]),
        frame_shape=used[0].products.shape,
    )
