"""Contributions put together: random parts as the root sum of squares, less what averaging takes away; biases as they are."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pixmetry.camera.contribution import UNSTEADY, Contribution
from pixmetry.core.errors import InputError


@dataclass(frozen=True)
class Combined:
    """Combined standard uncertainty and bias in px, k = 1; ``left_*`` is the remaining error of both after a calibration."""

    u_x_px: float
    u_y_px: float
    bias_x_px: float
    bias_y_px: float
    left_x_px: float
    left_y_px: float
    frames: int = 1
    targets: int = 1

    @property
    def total_x_px(self) -> float:
        """Random part and bias in x together."""
        return float(np.hypot(self.u_x_px, self.bias_x_px))

    @property
    def total_y_px(self) -> float:
        """Random part and bias in y together."""
        return float(np.hypot(self.u_y_px, self.bias_y_px))

    @property
    def total_px(self) -> float:
        """Root mean square over x and y of random part and bias together."""
        return float(np.sqrt(0.5 * (self.total_x_px**2 + self.total_y_px**2)))

    @property
    def calibrated_px(self) -> float:
        """Root mean square over x and y of the error that remains after a calibration, without the constant and the smooth part."""
        return float(np.sqrt(0.5 * (self.left_x_px**2 + self.left_y_px**2)))


def combine(contributions: Iterable[Contribution], frames: int = 1, targets: int = 1, signed: bool = False) -> Combined:
    """Combine the contributions to the mean position over ``frames`` frames and ``targets`` targets.

    ``signed``: the biases are of one camera whose sources are known, and add with their signs; else each may have either.

    Notes
    -----
    u² = Σ time_i²/(frames · targets) + place_i²/targets + smooth_i², x and y apart (JCGM 100:2008, 5.1.2; uncorrelated contributions); for
    the classes D and O, which the next frames and targets share, Σ u_i². What a calibration leaves is the same without what is smooth
    and without the biases, but for D and O, of which it takes nothing up. No number of frames lowers a bias.
    Biases whose signs are known add as they are, b = Σ b_i: two filters delay a line by the sum of their delays. A bias whose sign another
    camera would have the other way enters as the root sum of squares with the others, b² = Σ b_i². The total is √(u² + b²) (cf. JCGM
    100:2008, F.2.4.5, which would rather have a bias corrected; that is what the advice says too).

    Raises
    ------
    InputError
        If a number of frames or targets is not at least 1.
    """
    if frames < 1 or targets < 1:
        raise InputError("nothing to average", value=(frames, targets), allowed="1 or more frames and targets")
    squares, sums, unsteady = np.zeros((3, 2)), np.zeros(2), np.zeros(2)
    for c in contributions:
        u, bias, time, smooth, place = (np.square(v) for v in (c.u_px, c.bias_px, c.time_px, c.smooth_px, c.place_px))
        sums += c.bias_px
        if c.gum_class in UNSTEADY:
            unsteady += c.bias_px
            squares += [u, bias, u + (0 if signed else bias)]
        else:
            left = time / (frames * targets) + place / targets
            squares += [left + smooth, bias, left]
    if signed:
        squares[1] = sums**2
        squares[2] += unsteady**2
    u_x, u_y, bias_x, bias_y, left_x, left_y = np.sqrt(squares).ravel().tolist()
    return Combined(u_x, u_y, bias_x, bias_y, left_x, left_y, frames, targets)


def together_with(one: Combined, other: Combined) -> Combined:
    """Two independent parts of one total, for the same number of frames and targets, added as squares."""
    names = ("u_x_px", "u_y_px", "bias_x_px", "bias_y_px", "left_x_px", "left_y_px")
    parts = {name: float(np.hypot(getattr(one, name), getattr(other, name))) for name in names}
    return Combined(**parts, frames=one.frames, targets=one.targets)
