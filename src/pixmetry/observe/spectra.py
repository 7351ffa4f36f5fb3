"""Power spectra of rows and columns: of the mean image (fixed) and of frame differences (temporal)."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.observations import Spectra
from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError, MeasureError

GRAIN_DN2 = 2.0**-12  # powers are rounded to this, so that their sum is exact and does not depend on the order


def periodogram(image: np.ndarray) -> np.ndarray:
    """Two-dimensional power of an image less its mean, scaled so that white noise of variance σ² has power σ² everywhere.

    Parameters
    ----------
    image : ndarray, shape (rows, cols), DN

    Returns
    -------
    ndarray, shape (rows, cols // 2 + 1), float32 or float64, DN²
        |Σ y exp(−2πi(ux/N + vy/M))|² / (MN).
    """
    from scipy.fft import rfft2

    spectrum = rfft2(image - image.mean(dtype=float).astype(image.dtype))
    power: Array = (spectrum.real**2 + spectrum.imag**2) / image.size
    return power


def _profiles(power: np.ndarray, cols: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean power of the rows and of the columns from a two-dimensional periodogram (Parseval along the other axis).

    EMVA 1288 R4.0 §8.4: p_h[v] = ⟨|ŷ_m[v]|²⟩ over the rows m with ŷ = N^−½ Σ y exp(−2πi nv/N); columns likewise.
    """
    horizontal = power.mean(axis=0, dtype=float)
    weight = np.ones(power.shape[1])
    weight[0] = 0.5
    if cols % 2 == 0:
        weight[-1] = 0.5
    half = power.astype(float) @ weight / cols
    # the half plane that rfft2 leaves out mirrors this one: p[−u, −v] = p[u, v]
    vertical = half + np.roll(half[::-1], 1)
    return horizontal, vertical[: power.shape[0] // 2 + 1]


class SpectraAccumulator:
    """Periodogram of the differences of frames 2k and 2k + 1, k = 0 … pairs − 1.

    A few pairs are enough: with 480 rows, 8 pairs give the power at one frequency to 2 %. No more than the unpaired frames are held.

    Parameters
    ----------
    pairs : int
        Number of pairs to use; later frames are passed over.
    """

    def __init__(self, pairs: int = 8) -> None:
        self.pairs = pairs
        self.n_pairs = 0
        self._power: np.ndarray | None = None
        self._waiting: dict[int, np.ndarray] = {}
        self._next = 0

    def add(self, frame: np.ndarray, index: int | None = None) -> None:
        """Add one frame; ``index`` is its place in the group, by default the next."""
        index = self._next if index is None else index
        self._next = index + 1
        if index // 2 < self.pairs:
            self._pair(index // 2, np.ascontiguousarray(frame))

    def _pair(self, pair: int, frame: np.ndarray) -> None:
        if pair not in self._waiting:
            self._waiting[pair] = frame.copy()
            return
        # the sign of a difference does not matter to its power; float32 holds 16-bit differences exactly
        difference = frame.astype(np.float32) - self._waiting.pop(pair).astype(np.float32)
        power = np.rint(periodogram(difference) / (2 * GRAIN_DN2)) * GRAIN_DN2
        self._accumulate(power.astype(float), 1)

    def _accumulate(self, power: np.ndarray, pairs: int) -> None:
        if self._power is not None and self._power.shape != power.shape:
            raise InputError("frames of one group differ in shape", value=power.shape, allowed=str(self._power.shape))
        self._power = power if self._power is None else self._power + power
        self.n_pairs += pairs

    def result(self, mean_map_dn: np.ndarray) -> Spectra:
        """Spectra of the fixed pattern (from the mean map of the whole stack) and of the temporal noise of one frame.

        Parameters
        ----------
        mean_map_dn : ndarray, shape (rows, cols), DN
            It still holds 1/L of the temporal noise of the L frames.

        Raises
        ------
        MeasureError
            If no pair of frames was seen.
        """
        if self._power is None:
            raise MeasureError("spectra of temporal noise need a pair of frames", value=0, allowed="2 frames or more")
        rows, cols = mean_map_dn.shape
        temporal = self._power / self.n_pairs
        fixed_h, fixed_v = _profiles(periodogram(np.asarray(mean_map_dn, dtype=float)), cols)
        temporal_h, temporal_v = _profiles(temporal, cols)
        two_dimensional = temporal.astype(np.float32)
        two_dimensional[0, :] = 0.0
        two_dimensional[:, 0] = 0.0
        return Spectra(
            frequency_h=np.arange(cols // 2 + 1) / cols,
            fixed_h_dn2=fixed_h,
            temporal_h_dn2=temporal_h,
            frequency_v=np.arange(rows // 2 + 1) / rows,
            fixed_v_dn2=fixed_v,
            temporal_v_dn2=temporal_v,
            temporal_power_dn2=two_dimensional,
            n_pairs=self.n_pairs,
        )
