"""Marks of what was located, in Matplotlib axes: outlines, centres, lines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

CLEAN, FLAGGED, CROSS = "#00b4d8", "#ff9f1c", "#ff2e63"


def draw_marks(axes: Any, columns: Mapping[str, np.ndarray], zoom: float = 1.0) -> None:
    """Draw what was located into Matplotlib axes whose unit is the pixel.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    columns : mapping of ndarray, shape (n,)
        Of `pixmetry.locate.records.Located`.
    zoom : float
        How much larger than the frame they are.
    """
    from matplotlib.collections import EllipseCollection, LineCollection

    good = np.isfinite(columns["x_px"]) & np.isfinite(columns["y_px"])
    if not good.any():
        return
    x, y = columns["x_px"][good], columns["y_px"][good]
    colours = np.where(columns["flags"][good] != 0, FLAGGED, CLEAN)
    arm, ink, width = 3.0 / zoom, [CROSS], 0.8
    if "length_px" in columns and "angle_deg" in columns:
        angle, half = np.deg2rad(columns["angle_deg"][good]), 0.5 * columns["length_px"][good]
        along = np.stack([half * np.cos(angle), half * np.sin(angle)], axis=1)
        middle = np.stack([x, y], axis=1)
        axes.add_collection(LineCollection(list(np.stack([middle - along, middle + along], axis=1)), colors=list(colours), linewidths=1.2))
    else:
        major, minor, angle = _axes_of(columns, good)
        shown = np.isfinite(major)
        if not shown.any():  # nothing to draw around them: the cross alone shows place and flags
            arm, ink, width = 7.0 / zoom, list(np.tile(colours, 2)), 1.4
        if shown.any():
            axes.add_collection(
                EllipseCollection(
                    2 * major[shown],
                    2 * minor[shown],
                    angle[shown],
                    units="xy",
                    offsets=np.stack([x, y], axis=1)[shown],
                    transOffset=axes.transData,
                    facecolors="none",
                    edgecolors=list(colours[shown]),
                    linewidths=1.0,
                )
            )
    level, upright = np.array([[-arm, 0.0], [arm, 0.0]]), np.array([[0.0, -arm], [0.0, arm]])
    middle = np.stack([x, y], axis=1)[:, None, :]
    axes.add_collection(LineCollection(list(np.concatenate([middle + level, middle + upright])), colors=ink, linewidths=width))
    if len(x) <= 500 and "code" in columns:
        for xi, yi, code in zip(x, y, columns["code"][good], strict=True):
            if code >= 0:
                axes.annotate(str(int(code)), (xi, yi), (6, -6), textcoords="offset points", color=CROSS, fontsize=8)


def _axes_of(columns: Mapping[str, np.ndarray], good: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Semi axes and angle of what is drawn around each target; NaN where the table tells no size."""
    nothing = np.full(int(good.sum()), np.nan)
    if "semi_major_px" in columns:
        return columns["semi_major_px"][good], columns["semi_minor_px"][good], columns.get("angle_deg", nothing * 0)[good]
    for name in ("radius_px", "sigma_px"):
        if name in columns:
            return columns[name][good], columns[name][good], np.zeros_like(nothing)
    return nothing, nothing, nothing
