"""What frames of moving targets tell: when each part of a frame is exposed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.number import Estimates


@dataclass(frozen=True)
class MotionSeries:
    """Moving targets, and the times that their places tell.

    Parameters
    ----------
    frames, targets : int
        Frames that were used, and targets in the frame with the most of them.
    speed_px_s : ndarray, shape (frames, 2)
        Mean velocity of the targets of every frame.
    lag_px : ndarray, shape (frames, 2)
        Mean displacement of the odd rows against the even ones.
    shear : ndarray, shape (frames, 2)
        By how much the picture is sheared along x, and stretched along y, per row.
    u_lag_px, u_shear : ndarray, shape (frames, 2)
    stated_exposure_s : float
        The stated exposure that ``exposure_s`` belongs to, the longest of the runs; 0 where none was stated.
    fit : Estimates
        ``field_period_s`` (between even and odd rows), ``row_time_s`` (from row to row), ``jitter_s``, ``exposure_s`` (of the even exposure
        that blurs as much), ``rows_swapped_px`` (odd rows less even ones at rest), ``separation_s`` and ``ambient_share`` of two pulses of
        light. ``reasons`` say which rows come first, and of names that it does not hold why.
    """

    frames: int
    targets: int
    speed_px_s: np.ndarray
    lag_px: np.ndarray
    shear: np.ndarray
    u_lag_px: np.ndarray
    u_shear: np.ndarray
    stated_exposure_s: float
    fit: Estimates
