"""Records of locating: what was detected, where it is and how sure that is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
    POOR_FIT = 128  # the residuals are larger than the noise; the covariance is that of the residuals
    NOT_CONVERGED = 256  # the fit did not come to rest, or far from knows the place; such targets are left out of tables
    FAINT = 512  # so little contrast that the covariance, which is of first order, is too small
    DEFECT = 1024  # pixels that stand out alone (hot, dead, hit by a particle) were left out
    GRID_SCATTER = 2048  # the targets of the grid scatter more than was stated: the covariance holds this scatter

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


@dataclass(frozen=True)
class LeftOut:
    """What was seen in an image and has no position in its table, and why; arrays of shape (n,).

    Parameters
    ----------
    x_px, y_px : ndarray
        Where it was seen, roughly.
    semi_major_px : ndarray
        Half its length, roughly; NaN where it is not known.
    amplitude_dn : ndarray
        Height over the background, negative for dark ones; NaN where it is not known.
    reason : ndarray of str
        Why it has no position, in words.
    image : ndarray of str
        Name of its image.

    Examples
    --------
    >>> import numpy as np
    >>> from pixmetry.locate.detect.targets import LeftOut
    >>> lost = LeftOut.of(np.array([3.0, 5.0]), np.array([4.0, 4.0]), "the fit did not converge", image="a")
    >>> lost.counted()
    {'the fit did not converge': 2}
    """

    x_px: np.ndarray
    y_px: np.ndarray
    semi_major_px: np.ndarray
    amplitude_dn: np.ndarray
    reason: np.ndarray
    image: np.ndarray

    @classmethod
    def of(
        cls,
        x_px: Iterable[float] = (),
        y_px: Iterable[float] = (),
        reason: str = "",
        semi_major_px: np.ndarray | None = None,
        amplitude_dn: np.ndarray | None = None,
        image: str = "",
    ) -> LeftOut:
        """Make one of places that have a reason in common; without places, an empty one."""
        x, y = np.array(x_px, float), np.array(y_px, float)
        unknown = np.full(len(x), np.nan)
        major = unknown if semi_major_px is None else np.asarray(semi_major_px, float)
        height = unknown if amplitude_dn is None else np.asarray(amplitude_dn, float)
        return cls(x, y, major, height, np.full(len(x), reason), np.full(len(x), image))

    @classmethod
    def joined(cls, parts: Sequence[LeftOut]) -> LeftOut:
        """Put several under each other."""
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)}) if parts else cls.of()

    def __len__(self) -> int:
        return len(self.x_px)

    def counted(self) -> dict[str, int]:
        """How many have each reason, the most frequent first."""
        reasons, counts = np.unique(self.reason, return_counts=True)
        return {str(reasons[i]): int(counts[i]) for i in np.argsort(-counts, kind="stable")}

    def sentence(self) -> str:
        """Say how many there are for each reason; empty if there are none."""
        return "; ".join(f"{n} × {reason}" for reason, n in self.counted().items())
