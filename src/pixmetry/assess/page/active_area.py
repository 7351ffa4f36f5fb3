"""The section of an assessment's page on the border of the active area and the sampling clock."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.observations import ActiveArea
from pixmetry.report import Section
from pixmetry.report.drawing import BLUE, RED, SOFT, canvas, line
from pixmetry.report.numbers import uncertain
from pixmetry.report.page import Figure


def area_section(found: ActiveArea) -> Section:
    """Where the image lies in the frame, and the profiles that show it."""
    return Section("Border of the active area", name="area").add_text(area_sentence(found)).add(profile_figure(found))


def area_sentence(found: ActiveArea) -> str:
    """Sides of the image, offsets and clocks; and what is not told."""
    sides = {"left": found.left, "right": found.right, "top": found.top, "bottom": found.bottom}
    seen = [f"{name} {v:.1f}" for name, v in sides.items() if np.isfinite(v)]
    parts = [f"Black borders end at: {', '.join(seen)} px." if seen else "No black border is seen."]
    words = {"row_offset": "row offset", "col_offset": "column offset", "clock_ratio": "sampling clock over pixel clock"}
    words |= {"clock_mhz": "sampling clock", "start_ns": "start"}
    told = []
    for name, word in words.items():
        if name in found.fit:
            number = found.fit[name]
            if number.u == 0:
                told.append(f"{word} {number.value:.0f} {number.unit}".replace("-", "−"))
            else:
                shown = uncertain(number.value, number.u, number.unit)
                told.append(f"{word} {shown.value} ± {shown.u} {'' if shown.unit == '1' else shown.unit}".rstrip())
    if told:
        parts.append(f"{', '.join(told)}.".capitalize())
    missing = dict.fromkeys(why for name, why in found.fit.reasons.items() if name not in found.fit)
    return " ".join([*parts, *(f"Not told: {why}." for why in missing)])


def profile_figure(found: ActiveArea) -> Figure:
    """Mean profiles along the columns and rows, with the ends of the image."""
    with canvas(2.6, ncols=2) as (figure, panels):
        pairs = ((found.profile_cols_dn, (found.left, found.right), "column"), (found.profile_rows_dn, (found.top, found.bottom), "row"))
        for axes, (profile, ends, word) in zip(panels, pairs, strict=True):
            line(axes, np.arange(len(profile)), profile, color=BLUE)
            axes.axhline(found.black_dn, color=SOFT, linewidth=0.6, linestyle=":")
            for end in ends:
                if np.isfinite(end):
                    axes.axvline(end - 0.5, color=RED, linewidth=0.8)
            axes.set_xlabel(f"{word} / px")
            axes.set_ylabel("median / DN")
        alt = f"Profiles of a bright field along columns and rows. {area_sentence(found)}"
        caption = "Profiles of the bright field along columns and rows; red lines are the ends of the image."
        return Figure(figure, "area", alt, caption)
