"""Scatter of a plate's targets against their neighbours: what their positions are off by beyond their stated uncertainty.

On real boards neither χ² nor the stated covariance tells how far positions scatter; it goes with the picture (its view, its motion).
Where targets lie on a grid, the picture itself tells it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LEAST = 12  # targets with all eight neighbours
GAIN = 2.25  # of the variance of a target in the difference to its neighbours: (1 + ½)²
FAR_SIGMA = 4.0  # differences farther out have no voice
KEPT = 0.998872  # variance that a normal distribution keeps when values beyond 4 standard deviations are left out
WORTH = 0.5  # of a difference, which shares targets with those beside it, among independent ones
CLEAR_SIGMA = 5.0  # by which the scatter must exceed what is stated


@dataclass(frozen=True)
class GridScatter:
    """Scatter of the targets of a grid, per coordinate.

    Parameters
    ----------
    scatter_px : float
        Standard deviation against the neighbours.
    stated_px : float
        What the covariances promise.
    added_px : float
        Standard deviation that explains the rest; 0 where the scatter is not clearly larger than promised.
    """

    scatter_px: float
    stated_px: float
    added_px: float


def grid_scatter(x_px: np.ndarray, y_px: np.ndarray, variance_px2: np.ndarray, col: np.ndarray, row: np.ndarray) -> GridScatter | None:
    """Compare the scatter of targets with their stated variance; None with fewer than 12 targets that have all eight neighbours.

    Parameters
    ----------
    x_px, y_px : ndarray, shape (n,)
    variance_px2 : ndarray, shape (n,)
        Mean of the variances of x and y.
    col, row : ndarray of int, shape (n,)
        Place in the grid; negative for none.

    Notes
    -----
    Of each target, half of its four nearest neighbours is taken and a quarter of the four on the diagonals is added: the second difference
    along columns of the second difference along rows, over 4. Perspective, the lens, and a board that is bent leave nothing of it, for it
    vanishes where positions are of the second degree along only one of the two. Independent errors of variance s² make it 2.25 s².
    What neighbours have in common is not seen.

    Examples
    --------
    >>> import numpy as np
    >>> from pixmetry.locate.grid_scatter import grid_scatter
    >>> row, col = (a.ravel() for a in np.indices((20, 30)))
    >>> x, y = np.stack([15.0 * col, 15.0 * row]) + np.random.default_rng(1).normal(0, 0.05, (2, 600))
    >>> found = grid_scatter(x, y, np.full(600, 0.03**2), col, row)
    >>> round(found.scatter_px, 2), round(found.added_px, 2)
    (0.05, 0.04)
    """
    on = np.isfinite(x_px) & np.isfinite(y_px) & np.isfinite(variance_px2) & (col >= 0) & (row >= 0)
    if on.sum() < LEAST:
        return None
    place = np.full((int(row[on].max()) + 1, int(col[on].max()) + 1, 2), np.nan)
    place[row[on], col[on]] = np.stack([x_px[on], y_px[on]], axis=1)
    along = place[1:-1] - 0.5 * (place[:-2] + place[2:])
    apart = (along[:, 1:-1] - 0.5 * (along[:, :-2] + along[:, 2:])).reshape(-1, 2)
    apart = apart[np.isfinite(apart).all(axis=1)]
    if len(apart) < LEAST:
        return None
    good = np.ones(len(apart), bool)
    for _ in range(4):
        good = (np.abs(apart) < FAR_SIGMA * 1.4826 * np.median(np.abs(apart[good]))).all(axis=1)
    square = float((apart[good] ** 2).mean()) / (KEPT * GAIN)
    stated = float(np.median(variance_px2[on]))
    clear = square > stated * (1 + CLEAR_SIGMA / np.sqrt(WORTH * good.sum()))
    return GridScatter(float(np.sqrt(square)), float(np.sqrt(stated)), float(np.sqrt(square - stated)) if clear else 0.0)
