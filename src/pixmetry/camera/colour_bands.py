"""What pictures of the same targets in light of several wavelengths tell: scale, focus and light of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.number import Estimates


@dataclass(frozen=True)
class ColourBands:
    """Targets in light of several wavelengths; arrays of shape (bands,) by rising wavelength, without a filter first.

    Parameters
    ----------
    wavelength_nm : ndarray
    filtered : ndarray of bool
        Whether a filter was in front of the lens or sensor.
    names : tuple of str
        As stated; empty without.
    frames, targets : ndarray of int
        Frames of the band, and targets that were found in them.
    level_dn_per_s, u_level_dn_per_s : ndarray
        Light of the targets over their ground and the exposure; DN where no exposure was stated.
    blur_var_px2, u_blur_var_px2 : ndarray
        Variance of the blur of the targets' edges along an axis.
    radius_px : ndarray
    shift_x_px, shift_y_px, scale_rel, u_scale_rel : ndarray
        Place and scale of the field of targets against the mean of all bands; NaN where they are not told.
    focus_um : ndarray
        Distance of the sensor from the sharpest band's focus that would make the blur; NaN where f-number or pitch are not known.
    transmittance_nm, transmittance, u_transmittance : ndarray, shape (n,)
        Light with the filter over that without it.
    colour : Estimates
        ``scale_per_nm``, or the reason why it is not told.
    diffusion : Estimates
        ``diffusion_length_um``, or the reason.
    filter : Estimates
        ``peak_rel``, ``cut_nm``, ``plate_um`` as far as they are told; ``reasons`` for the others.
    long_nm : float
        Wavelength from which the diffusion is told; NaN without.
    notes : tuple of str
    """

    wavelength_nm: np.ndarray
    filtered: np.ndarray
    names: tuple[str, ...]
    frames: np.ndarray
    targets: np.ndarray
    level_dn_per_s: np.ndarray
    u_level_dn_per_s: np.ndarray
    blur_var_px2: np.ndarray
    u_blur_var_px2: np.ndarray
    radius_px: np.ndarray
    shift_x_px: np.ndarray
    shift_y_px: np.ndarray
    scale_rel: np.ndarray
    u_scale_rel: np.ndarray
    focus_um: np.ndarray
    transmittance_nm: np.ndarray
    transmittance: np.ndarray
    u_transmittance: np.ndarray
    colour: Estimates
    diffusion: Estimates
    filter: Estimates
    long_nm: float
    notes: tuple[str, ...] = ()
