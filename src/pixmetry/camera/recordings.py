"""What one scene, seen directly and once more after it was recorded, tells of the recorder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.number import Estimates


@dataclass(frozen=True)
class Recordings:
    """A recorder by what it changes.

    Parameters
    ----------
    direct_frames, recorded_frames : int
    frequency : ndarray, shape (n,)
        Along the rows, cycles per pixel.
    transfer, u_transfer : ndarray, shape (n,)
        Contrast after over contrast before the recorder; NaN where the scene shows nothing.
    difference_dn2 : ndarray, shape (recorded frames − 1,)
        Half the mean square of the difference of each recorded frame to the one before.
    direct_difference_dn2 : float
        The same, mean of the frames that came directly.
    step_px : ndarray, shape (rows,)
        By how much each row of the recorded mean image lies to the right; NaN where it shows nothing.
    fit : Estimates
        ``noise_ratio`` (temporal variance after over before), ``frame_correlation`` (of the noise, from frame to frame), ``group``,
        ``quality`` of a coder; ``bandwidth_rel`` in cycles per pixel, ``noise_dn``, ``head_switch_px`` of a tape. ``reasons`` of names
        that it does not hold.
    played, direct : Estimates
        Jitter of the rows after and before the recorder: ``white_px``, ``loop_px``, ``loop_rows``.
    """

    direct_frames: int
    recorded_frames: int
    frequency: np.ndarray
    transfer: np.ndarray
    u_transfer: np.ndarray
    difference_dn2: np.ndarray
    direct_difference_dn2: float
    step_px: np.ndarray
    fit: Estimates
    played: Estimates = Estimates.empty()
    direct: Estimates = Estimates.empty()
