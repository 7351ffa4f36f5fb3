"""One number that says how much a target looks like a good one: to sort by, and to leave the worst out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.locate.detect.targets import Flag

KIN = ("radius_px", "inner_radius_px", "semi_major_px", "semi_minor_px", "blur_px", "sigma_px", "amplitude_dn")
NEIGHBOURS = 12
HALF = 6.0  # distance from the usual, in usual spreads, at which the quality is one half
DOUBTFUL = (Flag.BORDER, Flag.OVERLAPPING, Flag.UNDER_SAMPLED, Flag.FAINT)  # each halves it
LEAST_SPREAD = 0.01  # of a size: finer than that no two targets are alike


def quality_of(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Rate the targets of one image from 0 (bad) to 1 (like the others); shape (n,).

    Parameters
    ----------
    columns : mapping of str to ndarray
        Of a table of positions.

    Notes
    -----
    d² is the sum of squares of how far a target is from the usual, each in usual spreads: how much χ² is above the median of the image
    (its own spread is √(2/dof)), and by how much size, blur and height differ from the median of the 12 nearest targets. The quality is
    1/(1 + (d/6)²): 0.9 at 2 spreads, 0.5 at 6, 0.1 at 18. Spreads are robust ones of the whole image, so that targets of many sizes have
    wide ones and lose nothing. It is halved for each of `border`, `overlapping`, `under_sampled` and `faint`.

    Examples
    --------
    >>> import numpy as np
    >>> from pixmetry.locate.quality import quality_of
    >>> chi2 = np.array([1.0, 1.1, 0.9, 8.0])
    >>> columns = {"x_px": np.arange(4.0), "y_px": np.zeros(4), "chi2_per_dof": chi2, "dof": np.full(4, 200.0), "flags": np.zeros(4, int)}
    >>> [round(float(q), 2) for q in quality_of(columns)]
    [1.0, 1.0, 1.0, 0.02]
    """
    n = len(columns["x_px"])
    square = np.zeros(n)
    if "chi2_per_dof" in columns:
        chi2 = columns["chi2_per_dof"]
        usual = max(1.0, float(np.nanmedian(chi2))) if np.isfinite(chi2).any() else 1.0
        spread = np.hypot(np.sqrt(2 / np.maximum(columns["dof"], 1.0)), _spread(chi2 / usual))
        square += np.nan_to_num(np.maximum(chi2 / usual - 1, 0.0) / spread, nan=0.0) ** 2
    alike = [columns[name] for name in KIN if name in columns and np.isfinite(columns[name]).all()] if n > NEIGHBOURS else []
    if alike:
        from pixmetry.locate._quality_kernels import from_neighbours

        values = np.stack([v / max(float(np.median(np.abs(v))), 1e-300) for v in alike])
        for apart in from_neighbours(columns["x_px"], columns["y_px"], values, NEIGHBOURS):
            square += (apart / max(_spread(apart), LEAST_SPREAD)) ** 2
    quality: np.ndarray = 1 / (1 + square / HALF**2)
    for flag in DOUBTFUL:
        quality = np.where((columns["flags"] & int(flag)) != 0, 0.5 * quality, quality)
    return quality


def _spread(values: np.ndarray) -> float:
    """Robust standard deviation."""
    values = values[np.isfinite(values)]
    return 1.4826 * float(np.median(np.abs(values - np.median(values)))) if len(values) else 0.0
