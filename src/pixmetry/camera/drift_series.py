"""What a series of frames of a fixed field tells: how the image moves while camera and frame grabber warm up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.number import Estimates, Number

CAMERA_MODES = ("shift_x_px", "shift_y_px", "scale_rel", "rotation_rad")
DIGITAL = "the camera is digital: no frame grabber samples its lines"
GRABBER_MODES = ("affinity_rel", "shear_rel")  # of the scale along x alone, and of x over y: only analogue cameras have them


@dataclass(frozen=True)
class DriftSeries:
    """Motion of the image over time, and the curve through it.

    Parameters
    ----------
    time_s : ndarray, shape (frames,)
        Since camera and grabber were switched on.
    modes : tuple of str
        ``CAMERA_MODES``, and ``GRABBER_MODES`` of an analogue camera.
    values, u : ndarray, shape (frames, modes)
        Displacement of the field about the frame's centre: shift, scale, rotation (from x to y), scale along x alone, shear (x over y);
        their zero is the mean of the series. ``u`` is from the positions alone.
    fitted : ndarray, shape (frames, modes)
        The curve at these times.
    from_settled_px, u_from_settled_px : ndarray, shape (frames,)
        Distance of the farthest corner of the frame from where it will settle, by the curve.
    targets : int
        Targets that were followed.
    location_factor : float
        Scatter of single targets about the modes over what their covariances say; above 1 all u are enlarged by it.
    fit : Estimates
        ``shift_x_px``, ``shift_y_px``, ``scale_rel``, ``rotation_rad`` (from switching on to settled), ``fast_share``, ``fast_s``,
        ``slow_s``;
        of an analogue camera ``scale_error_rel``, ``scale_tau_s``, ``delay_ns``, ``delay_tau_s``; from frame to frame ``shift_std_px``,
        ``roll_std_rad``. ``reasons`` of names that it does not hold say why.
    stable : Number
        Time after switching on from which on the farthest corner stays within ``tolerance_px`` of where it settles, s.
    tolerance_px : float
    blur_px2, u_blur_px2 : ndarray, shape (frames,)
        Variance of the targets' blur about its mean over the series; NaN where it is not measured.
    focus : Number
        Change of that variance from the first fifth of the series to the last one, px².
    thermal : Estimates or None
        Of a series with the temperature of every frame, see `pixmetry.series.thermal`; the motion is then what is left without it.
    """

    time_s: np.ndarray
    modes: tuple[str, ...]
    values: np.ndarray
    u: np.ndarray
    fitted: np.ndarray
    from_settled_px: np.ndarray
    u_from_settled_px: np.ndarray
    targets: int
    location_factor: float
    fit: Estimates
    stable: Number
    tolerance_px: float
    blur_px2: np.ndarray
    u_blur_px2: np.ndarray
    focus: Number
    thermal: Estimates | None = None
