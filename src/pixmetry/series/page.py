"""The page of a series, and the section of it on the page of an assessment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.camera.drift_series import DriftSeries
from pixmetry.core.number import LOWER_LIMIT, Number
from pixmetry.report import Column, Page, Section, Table
from pixmetry.report.drawing import BLUE, GRID, INK, RED, SOFT, canvas, line
from pixmetry.report.numbers import significant
from pixmetry.report.page import Answer, Figure, Reading, Text
from pixmetry.report.provenance import provenance_section

if TYPE_CHECKING:
    from pixmetry.series.records import Series

WORDS = {
    "shift_x_px": "Shift along x, from switching on to settled",
    "shift_y_px": "Shift along y",
    "scale_rel": "Change of scale",
    "rotation_rad": "Rotation, from x to y",
    "fast_share": "Share that settles fast",
    "fast_s": "Fast time constant",
    "slow_s": "Slow time constant",
    "scale_error_rel": "Frame grabber: error of its clock when switched on",
    "scale_tau_s": "Frame grabber: time constant of the clock",
    "delay_ns": "Frame grabber: delay of the lines when switched on",
    "delay_tau_s": "Frame grabber: time constant of the delay",
    "shift_std_px": "Scatter of the whole image from frame to frame, along each axis",
    "roll_std_rad": "Scatter of its rotation",
}
TITLES = {
    "shift_x_px": "shift x / px",
    "shift_y_px": "shift y / px",
    "scale_rel": "scale / 1e-6",
    "rotation_rad": "rotation / µrad",
    "affinity_rel": "x scale / 1e-6",
    "shear_rel": "shear / 1e-6",
}
FOOTER = "Standard uncertainties (k = 1). x runs along rows, y along columns; the image turns about the frame's centre."


def page_of(found: Series) -> Page:
    """The page of a series."""
    drift = found.drift
    rows, cols = found.frame_shape
    facts = [
        ("Frames", f"{len(found.frames)} of {cols} × {rows} pixels"),
        ("Time", f"{_minutes(drift.time_s[0])} to {_minutes(drift.time_s[-1])} after switching on"),
        ("Targets", str(drift.targets)),
    ]
    page = Page(found.frames[0], "motion of the image over time", "pixmetry series of a fixed field", facts, FOOTER)
    verdict = page.add_section("Is the camera stable?", name="verdict")
    far, u = (float(v[-1]) for v in (drift.from_settled_px, drift.u_from_settled_px))
    now = Reading("still to go at the end", f"{significant(far, 2)} px", f"± {significant(u, 1)} px")
    verdict.add(Answer([Text(stable_sentence(drift)), [now]]))
    for note in found.notes:
        verdict.add_text(note, style="small soft")
    page.sections.append(drift_section(drift))
    if (origin := provenance_section(found.provenance)) is not None:
        page.sections.append(origin)
    return page


def stable_sentence(drift: DriftSeries) -> str:
    """When the camera is stable, in a sentence."""
    stable, limit = drift.stable, f"{drift.tolerance_px:g} px"
    if not stable.is_available:
        return f"Whether the image stays within {limit} of where it settles is not told: {stable.reason}."
    if stable.kind == LOWER_LIMIT:
        return f"After {_minutes(stable.value)} the image is not yet within {limit} of where it settles, and the series ends there."
    if stable.u == 0:
        return f"The image stays within {limit} of its place from the first frame on."
    u = significant(stable.u / 60, 2)
    extrapolated = f" ({stable.reason})" if stable.reason else ""
    when = f"From {significant(stable.value / 60, 3)} ± {u} min after switching on"
    return f"{when}, every point stays within {limit} of where it settles{extrapolated}."


def drift_section(drift: DriftSeries) -> Section:
    """Figure and values of a series."""
    section = Section("Motion of the image while the camera warms up", name="series").add_text(stable_sentence(drift))
    if drift.location_factor > 1.2:
        section.add_text(
            f"Single targets scatter {drift.location_factor:.2g} times more about the motion of the field than the uncertainty of their "
            "positions says. All uncertainties here are enlarged by that factor.",
            style="small soft",
        )
    section.add(motion_figure(drift))
    rows: list[list[Any]] = [[WORDS[number.name], number, number.reason] for number in drift.fit]
    gone = {name: why for name, why in drift.fit.reasons.items() if name not in drift.fit and name in WORDS}
    rows += [[WORDS[name], Number.not_available("1", why), why] for name, why in gone.items()]
    section.add(Table("What the series tells", ["Quantity", Column("Value", "number"), "Note"], rows))
    return section


def motion_figure(drift: DriftSeries) -> Figure:
    """Modes over time with the fitted curves, and the distance to where the farthest corner settles."""
    minutes = drift.time_s / 60
    count = len(drift.modes)
    with canvas(1.15 * count + 1.5, nrows=count + 1, sharex=True) as (figure, axes):
        for k, mode in enumerate(drift.modes):
            factor = 1.0 if mode.endswith("px") else 1e6
            top = axes[k]
            top.fill_between(minutes, *(factor * (drift.values[:, k] + s * 2 * drift.u[:, k]) for s in (-1, 1)), color=GRID, linewidth=0)
            line(top, minutes, factor * drift.values[:, k], color=SOFT, linewidth=0.5, marker=".", markersize=2)
            line(top, minutes, factor * drift.fitted[:, k], color=BLUE)
            top.set_ylabel(TITLES[mode])
        low = axes[count]
        u = drift.u_from_settled_px
        least, most = np.maximum(drift.from_settled_px - 2 * u, 0), drift.from_settled_px + 2 * u
        low.fill_between(minutes, least, most, color=BLUE, alpha=0.2, linewidth=0)
        line(low, minutes, drift.from_settled_px, color=BLUE)
        low.axhline(drift.tolerance_px, color=RED, linewidth=0.7, linestyle="--")
        if drift.stable.is_available and drift.stable.value <= drift.time_s[-1]:
            low.axvline(drift.stable.value / 60, color=INK, linewidth=0.6, linestyle=":")
        low.set_ylim(bottom=0)
        low.set_ylabel("to settle / px")
        low.set_xlabel("minutes after switching on")
        caption = (
            "Motion of the field of targets: dots with ± 2 u (grey), fitted curve (blue). Below: how far the farthest corner still is from "
            "where it settles, with ± 2 u; the dashed line is the tolerance."
        )
        return Figure(figure, "series", f"Motion of the image over {drift.time_s.size} frames. {stable_sentence(drift)}", caption)


def _minutes(seconds: float) -> str:
    return f"{significant(float(seconds) / 60, 3)} min"
