"""The section of an assessment's page on targets seen or lit from several sides."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.views import TargetViews
from pixmetry.core.number import Number
from pixmetry.report import Column, Section, Table
from pixmetry.report.drawing import BLUE, INK, RED, SOFT, canvas, line
from pixmetry.report.numbers import significant, uncertain
from pixmetry.report.page import Figure

TITLES = {
    "gradient_rel_per_px": "Slope of the light over a target, standard deviation",
    "view_angle_deg": "Largest angle between line of sight and normal",
    "diameter_px": "Diameter of the targets",
}
LIKE = {"retro": "retro-reflective targets", "diffuse": "diffuse targets", "glossy": "glossy targets"}


def views_section(found: TargetViews) -> Section:
    """Sentence, figure, values, and a table of the views."""
    section = Section("Targets from several sides", name="views").add_text(summary_sentence(found)).add(views_figure(found))
    rows = [[TITLES[n.name], n, n.reason] for n in found.fit]
    rows += [[TITLES[n], Number.not_available("1", why), why] for n, why in found.fit.reasons.items() if n not in found.fit]
    section.add(Table("What the views tell", ["Quantity", Column("Value", "number"), "Note"], rows))
    columns: list[Column | str] = ["View", Column("Targets", "right"), Column("Angle / °", "right"), Column("Eccentricity / px", "right")]
    columns.append(Column("Mean slope of the light along x, y / 1/px", "right"))
    each = []
    for k in range(found.views):
        own = found.view == k
        e = "–" if found.eccentricity_px is None else significant(float(found.eccentricity_px[k]))
        slopes = ", ".join(f"{float(v[own].mean()):+.2g}" for v in (found.gradient_x_per_px, found.gradient_y_per_px))
        each.append([str(k + 1), str(int(own.sum())), f"{found.angle_deg[k]:.1f}", e, slopes])
    section.add_section("View by view", Table(f"The {found.views} views", columns, each), fold=True)
    return section


def summary_sentence(found: TargetViews) -> str:
    """How many views, what the light does, and what it does to centroids."""
    slope = found.fit["gradient_rel_per_px"]
    moved = float(np.sqrt(np.mean(np.square([found.predicted_x_px, found.predicted_y_px]))))
    text = f"{len(found.view)} targets in {found.views} views. "
    if slope.is_limit:
        text += f"The light has no slope over the targets, below {significant(slope.value)} per px (95 %), as on {LIKE[found.surface]}. "
    else:
        text += f"The light over a target has a slope of {significant(slope.value)} per px, as on {LIKE[found.surface]}. "
        text += (
            f"It moves the centre of their light by {significant(moved)} px (rms of x and y); outlines fitted with a slope do not move. "
        )
    if np.isfinite(found.slope):
        text += f"It explains {uncertain(found.slope, found.u_slope, '').joined()} of what the centres of light show. "
    if found.eccentricity_px is not None and found.eccentricity_px.max() > 0:
        most = significant(float(found.eccentricity_px.max()))
        text += f"The ellipses' centres lie up to {most} px beside the images of the circles' centres."
    return text


def views_figure(found: TargetViews) -> Figure:
    """Slopes of the light, and centroids' offsets against what the slopes make of them."""
    with canvas(2.8, ncols=2) as (figure, (left, right)):
        left.errorbar(
            1e3 * found.gradient_x_per_px, 1e3 * found.gradient_y_per_px, 1e3 * found.u_gradient_y_per_px, 1e3 * found.u_gradient_x_per_px,
            fmt=".", color=BLUE, markersize=3, elinewidth=0.5,
        )  # fmt: skip
        left.axhline(0, color=SOFT, linewidth=0.6)
        left.axvline(0, color=SOFT, linewidth=0.6)
        left.set_aspect("equal", adjustable="datalim")
        left.set_xlabel("slope along x / 1/1000 px")
        left.set_ylabel("slope along y / 1/1000 px")
        for predicted, seen, colour, axis in (
            (found.predicted_x_px, found.centroid_x_px, BLUE, "x"),
            (found.predicted_y_px, found.centroid_y_px, RED, "y"),
        ):
            line(right, predicted, seen, color=colour, linestyle="", marker=".", markersize=3, label=f"along {axis}")
        most = float(np.abs([found.predicted_x_px, found.predicted_y_px]).max())
        line(right, np.array([-most, most]), np.array([-most, most]), color=INK, linewidth=0.8)
        right.set_xlabel("offset by the slope of the light / px")
        right.set_ylabel("centre of light less outline / px")
        right.legend(loc="best")
        caption = (
            "Left: slope of the light over each target in each view, with u. Right: centre of the light less that of the outline, against "
            "what the slope makes of it; the line has the slope 1."
        )
        return Figure(figure, "views", f"Slopes of the light over targets. {summary_sentence(found)}", caption)
