"""Contributions put together: random parts as the root sum of squares, less what averaging takes away; biases as they are."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pixmetry.core.contribution import AVERAGES, Contribution
from pixmetry.core.errors import InputError


@dataclass(frozen=True)
class Combined:
    """Combined standard uncertainty and bias in px, k = 1."""

    u_x_px: float
    u_y_px: float
    bias_x_px: float
    bias_y_px: float
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


def combine(contributions: Iterable[Contribution], frames: int = 1, targets: int = 1) -> Combined:
    """Combine the contributions to the mean position over ``frames`` frames and ``targets`` targets.

    Notes
    -----
    u² = Σ u_i²/(frames if its class averages over frames)/(targets if it averages over targets), x and y apart (JCGM 100:2008, 5.1.2;
    uncorrelated contributions). No number of frames lowers a bias. A bias that is not corrected, and whose sign another camera would have
    the other way, enters as the root sum of squares with the others: b² = Σ b_i², and the total is √(u² + b²) (cf. JCGM 100:2008,
    F.2.4.5, which would rather have it corrected; that is what the advice says too).

    Raises
    ------
    InputError
        If a number of frames or targets is not at least 1.
    """
    if frames < 1 or targets < 1:
        raise InputError("nothing to average", value=(frames, targets), allowed="1 or more frames and targets")
    squares = np.zeros(4)
    for c in contributions:
        over_frames, over_targets = AVERAGES[c.gum_class]
        n = (frames if over_frames else 1) * (targets if over_targets else 1)
        squares += np.array([c.u_x_px**2 / n, c.u_y_px**2 / n, c.bias_x_px**2, c.bias_y_px**2])
    u_x, u_y, bias_x, bias_y = (float(v) for v in np.sqrt(squares))
    return Combined(u_x, u_y, bias_x, bias_y, frames, targets)
