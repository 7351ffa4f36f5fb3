"""Records of locating: what was detected, where it is and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import IntFlag

import numpy as np


class Flag(IntFlag):
    """What a reader of a position should know about its target."""

    BORDER = 1  # touches the frame's border, or its window is cut off there
    SATURATED = 2  # grey values at the top of the scale
    CLIPPED_AT_BLACK = 4  # grey values at the bottom of the scale
    UNDER_SAMPLED = 8  # so small or so sharp that the position depends on the sub-pixel phase
    OVERLAPPING = 16  # touches another target
    GRADIENT = 32  # the light falls off across the target, significantly
    UNEVEN_BACKGROUND = 64  # the background slopes under the target, significantly
    POOR_FIT = 128  # the residuals are larger than the noise
    NOT_CONVERGED = 256  # the fit did not come to rest, or far from knows the place; not to be used
    FAINT = 512  # so little contrast that the covariance, which is of first order, is too small

    def words(self) -> str:
        """Names joined by ``|``, lower case; empty if there are none."""
        return "|".join(f.name.lower() for f in Flag if f & self and f.name)


@dataclass(frozen=True)
class Targets:
    """Detected targets, arrays of shape (n,). All places are in pixels from the centre of the top-left pixel.

    Parameters
    ----------
    x_px, y_px : ndarray
        Rough centre (to about 0.1 px).
    semi_major_px, semi_minor_px, angle_deg : ndarray
        The ellipse that has the area and the second moments of the region above half height; angle from x towards y, −90 … 90.
    blur_px : ndarray
        Rough standard deviation of the edge, in which the pixel is included.
    amplitude_dn : ndarray
        Height over the background, negative for dark targets.
    background_dn, background_x_dn_per_px, background_y_dn_per_px : ndarray
        The background at the centre and its slopes, from the map of the background.
    sigma_dn : ndarray
        Standard deviation of the background's noise there.
    row_first, row_stop, col_first, col_stop : ndarray of int
        Box of the region above half height.
    flags : ndarray of uint32
        Of `Flag`.
    """

    x_px: np.ndarray
    y_px: np.ndarray
    semi_major_px: np.ndarray
    semi_minor_px: np.ndarray
    angle_deg: np.ndarray
    blur_px: np.ndarray
    amplitude_dn: np.ndarray
    background_dn: np.ndarray
    background_x_dn_per_px: np.ndarray
    background_y_dn_per_px: np.ndarray
    sigma_dn: np.ndarray
    row_first: np.ndarray
    row_stop: np.ndarray
    col_first: np.ndarray
    col_stop: np.ndarray
    flags: np.ndarray

    def __len__(self) -> int:
        return len(self.x_px)

    def __getitem__(self, which: np.ndarray | slice) -> Targets:
        """A part of them, by mask, index array or slice."""
        return Targets(**{f.name: getattr(self, f.name)[which] for f in fields(self)})


@dataclass(frozen=True)
class Positions:
    """Measured positions of targets, in the order of the targets; arrays of shape (n,), NaN where there is none.

    Parameters
    ----------
    x_px, y_px : ndarray
    var_x_px2, cov_xy_px2, var_y_px2 : ndarray
        Covariance of the position in pixels². It holds the noise of the pixels and, for operators whose result depends on the sub-pixel
        phase, the variance over the phase (`s_curve_px` in `more` is its standard deviation).
    flags : ndarray of uint32
        Of `Flag`: those of the targets and what the estimator adds.
    more : dict of ndarray
        Further columns: amplitude_dn, background_dn, radius_px or semi_major_px …, blur_px, chi2_per_dof, dof.
    """

    x_px: np.ndarray
    y_px: np.ndarray
    var_x_px2: np.ndarray
    cov_xy_px2: np.ndarray
    var_y_px2: np.ndarray
    flags: np.ndarray
    more: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.x_px)
