"""Kernels of locating: weighted centroids of a batch of windows."""

from __future__ import annotations

import numpy as np

from pixmetry.core.jit import jit

CENTROID, SQUARED, SOFT, HARD = 0, 1, 2, 3


@jit
def locate_windows(windows, law, background_dn, threshold_dn, row_first, row_stop, col_first, col_stop):
    """Return x, y, shape (n,), of Σ f(I) x / Σ f(I) over the given rows and columns; NaN where Σ f is not positive."""
    n = windows.shape[0]
    x, y = np.empty(n, np.float64), np.empty(n, np.float64)
    for i in range(n):
        total, along_x, along_y = 0.0, 0.0, 0.0
        for r in range(row_first, row_stop):
            row_total, row_x = 0.0, 0.0
            for c in range(col_first, col_stop):
                value = np.float64(windows[i, r, c]) - background_dn
                if law == SOFT:
                    value = max(value - threshold_dn, 0.0)
                elif law == HARD:
                    value = value if value > threshold_dn else 0.0
                elif law == SQUARED:
                    value = value * value
                row_total += value
                row_x += value * c
            total += row_total
            along_x += row_x
            along_y += row_total * r
        x[i] = along_x / total if total > 0.0 else np.nan
        y[i] = along_y / total if total > 0.0 else np.nan
    return x, y
