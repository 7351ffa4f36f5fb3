"""What views of targets tell: the slope of the light over them, and how obliquely they are seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.number import Estimates


@dataclass(frozen=True)
class TargetViews:
    """Targets seen, or lit, from several sides; arrays of shape (n,) have an entry for each target of each view.

    Parameters
    ----------
    view : ndarray
        Number of the view, from 0.
    x_px, y_px : ndarray
    gradient_x_per_px, gradient_y_per_px, u_gradient_x_per_px, u_gradient_y_per_px : ndarray
        Relative slope of the light on the target.
    semi_major_px, semi_minor_px : ndarray
    centroid_x_px, centroid_y_px : ndarray
        Centre of the light less that of the outline.
    predicted_x_px, predicted_y_px : ndarray
        What the slope of the light makes of it.
    amplitude_dn_per_s : ndarray
        Light of the target over the exposure; DN where no exposure was stated.
    angle_deg, u_angle_deg : ndarray, shape (views,)
        Between the line of sight and the targets' normal, from the ellipses.
    principal_distance_px : float or None
    eccentricity_px : ndarray or None, shape (views,)
        Offset of the ellipses' centre from the image of the circles' centre; None where the principal distance is not known.
    surface : str
        The kind of surface that a slope of this size is assumed of in a budget: ``"retro"``, ``"diffuse"`` or ``"glossy"``.
    slope, u_slope : float
        Of the centroids' offsets over what the slopes of the light make of them; 1 if nothing else moves them. NaN where they are too
        small.
    fit : Estimates
        ``gradient_rel_per_px``, ``view_angle_deg``, ``diameter_px`` as far as they are told; ``reasons`` for the others.
    notes : tuple of str
    """

    view: np.ndarray
    x_px: np.ndarray
    y_px: np.ndarray
    gradient_x_per_px: np.ndarray
    gradient_y_per_px: np.ndarray
    u_gradient_x_per_px: np.ndarray
    u_gradient_y_per_px: np.ndarray
    semi_major_px: np.ndarray
    semi_minor_px: np.ndarray
    centroid_x_px: np.ndarray
    centroid_y_px: np.ndarray
    predicted_x_px: np.ndarray
    predicted_y_px: np.ndarray
    amplitude_dn_per_s: np.ndarray
    angle_deg: np.ndarray
    u_angle_deg: np.ndarray
    principal_distance_px: float | None
    eccentricity_px: np.ndarray | None
    surface: str
    slope: float
    u_slope: float
    fit: Estimates
    notes: tuple[str, ...] = ()

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.angle_deg)
