"""Temporal noise without light from the dark levels, and the parts of noise and pattern that quantisation and clipping at black hide."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pixmetry.core.number import ONE_SIDED_95
from pixmetry.emva.files.keys import MINIMUM_DARK_VAR_DN2, UNDERFLOW_FRACTION
from pixmetry.emva.records import Measurement, Series
from pixmetry.emva.series import first_of_equal
from pixmetry.emva.temporal import dark_line
from pixmetry.observe.photon_transfer_levels import clipped_black, core_spread_dn2
from pixmetry.observe.photon_transfer_model import rounding_error_vars, slope_error_var, white_before_rounding

MOSTLY_BLACK = 0.5  # of the dark pixels at the lowest code: not even the middle one shows its noise


@dataclass(frozen=True)
class DarkNoise:
    """The dark variance at zero exposure with its u, that of the levels of the shortest exposure, and the share of pixels held at black."""

    var_dn2: float
    u_dn2: float
    shortest_dn2: float
    black: float

    @classmethod
    def of(cls, m: Measurement, series: Series, u_dn2: float) -> DarkNoise:
        """Read it from the series, in which ``u_dn2`` is the u of the variance at zero exposure."""
        shortest = first_of_equal(series.dark_exposure_s) == 0
        black = clipped_black(m.transfer)
        if m.dark_stack is not None:
            black = max(black, m.dark_stack.fraction_min - float(m.transfer.bright.fraction_min.min()))
        return cls(float(dark_line(series)[2]), u_dn2, float(np.mean(series.own_dark_var_dn2[..., shortest])), black)

    @property
    def below(self) -> bool:
        """Whether the variance comes out below 0.24 DN², which then stands for it (R4.0 eq. 54)."""
        return self.var_dn2 < MINIMUM_DARK_VAR_DN2

    @property
    def hidden(self) -> bool:
        """Whether it is below beyond doubt: not by an extrapolation that might as well have come out above."""
        return self.below and min(max(self.var_dn2, 0.0) + ONE_SIDED_95 * self.u_dn2, self.shortest_dn2) < MINIMUM_DARK_VAR_DN2

    @property
    def limit_dn2(self) -> float:
        """95 % upper limit of the variance where it comes out below."""
        return MINIMUM_DARK_VAR_DN2 if self.hidden else max(max(self.var_dn2, 0.0) + ONE_SIDED_95 * self.u_dn2, MINIMUM_DARK_VAR_DN2)

    @property
    def clipped(self) -> bool:
        """Whether more dark pixels are at the lowest code than the standard allows."""
        return self.black > UNDERFLOW_FRACTION

    @property
    def blind(self) -> bool:
        """Whether so many pixels are clipped that the dark frames show neither noise nor pattern."""
        return self.black > MOSTLY_BLACK


def pattern_limit_dn2(square_dn2: float, u_dn2: float, m: Measurement) -> float:
    """95 % upper limit of a variance of the dark pattern that was seen through quantisation.

    Rounding at an unknown place within a code changes differences by an unknown factor, and hides some of the pattern altogether (Widrow
    and Kollár, Quantization Noise, ch. 5).
    """
    seen = max(square_dn2, 0.0)
    temporal = float(m.transfer.dark.ms_pixel_dn2.min()) if m.dark_stack is None else m.dark_stack.ms_pixel_dn2
    white = white_before_rounding(temporal, core_spread_dn2(m.dark_stack))
    lost = float(rounding_error_vars(np.array(white), seen)[0])
    return seen + ONE_SIDED_95 * math.hypot(u_dn2, 2 * math.sqrt(slope_error_var(white, seen)) * seen, lost)
