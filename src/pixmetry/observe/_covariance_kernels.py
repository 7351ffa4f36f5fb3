"""Products of the noise with itself at small lags."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.jit import jit

REACH = 4  # px to each side


@jit
def sum_lag_products(padded: NDArray[np.float32], rows: int, cols: int, sums: NDArray[np.float64]) -> None:
    """Products of a noise field with itself at lags up to ± `REACH` pixels, by the place in the pattern of two by two.

    Parameters
    ----------
    padded : ndarray, shape (rows + 4, cols + 8), float32, DN
        The field z(y, x) at [y, x + 4], zeros around it.
    rows, cols : int
    sums : ndarray, shape (2, 2, 5, 9), float64, DN²
        Set: ``sums[r, c, j, 4 + i]`` to Σ z(y, x) z(y + j, x + i) over the pixels whose row and column have the parities r and c and whose
        partner lies in the field.
    """
    lines = np.zeros((REACH + 1, 2 * REACH + 1, cols), np.float32)  # sums over the rows of one parity; single precision is enough
    for parity in range(2):
        lines[:] = 0.0
        for r in range(parity, rows, 2):
            own = padded[r, REACH : REACH + cols]
            for j in range(REACH + 1):
                for i in range(2 * REACH + 1):
                    line, other = lines[j, i], padded[r + j, i : i + cols]
                    for c in range(cols):
                        line[c] += own[c] * other[c]
        for j in range(REACH + 1):
            for i in range(2 * REACH + 1):
                for p in range(2):
                    total = 0.0
                    for c in range(p, cols, 2):
                        total += lines[j, i, c]
                    sums[parity, p, j, i] = total
