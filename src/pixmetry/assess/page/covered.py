"""The section of an assessment's page on covered columns and rows."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.observations import CoveredPixels
from pixmetry.report import Column, Section, Table
from pixmetry.report.drawing import BLUE, RED, SOFT, canvas
from pixmetry.report.numbers import printed_number, significant, uncertain
from pixmetry.report.page import Figure

NAMES = {
    "serial_cti": "Charge left behind per transfer along the register",
    "parallel_cti": "Charge left behind per transfer down the columns",
    "trail_px": "Mean distance by which it is late",
    "smear_s": "Time of the transfer through the light, at full sensitivity",
    "droop_rel": "Droop of a constant level until the end of the line",
}


def covered_section(found: CoveredPixels) -> Section:
    """What they tell, the trails behind the light, and what is not told with the reason."""
    section = Section("Covered columns and rows", name="covered").add_text(summary_sentence(found))
    if found.trails:
        section.add(trail_figure(found))
    rows = []
    for name, title in NAMES.items():
        if name in found.fit:
            number = found.fit[name]
            shown = printed_number(number) if number.is_limit else uncertain(number.value, number.u, number.unit)
            rows.append([title, shown.value, "" if number.is_limit else f"± {shown.u}", shown.unit, number.reason])
        elif why := found.fit.reasons.get(name, ""):
            rows.append([title, "–", "", "", why])
    columns: list[Column | str] = ["Quantity", Column("Value", "right"), Column("± u", "u"), Column("Unit", "unit"), "Note"]
    section.add(Table("From covered pixels", columns, rows))
    if found.row_noise:
        each = [[significant(t), significant(s, 2), significant(u, 1)] for t, s, u in found.row_noise]
        titles: list[Column | str] = [Column(t, "right") for t in ("Exposure / s", "Noise common to a row / DN", "u / DN")]
        section.add_section("Noise of whole rows", fold=True).add(Table("Noise common to a row, in covered columns", titles, each))
    return section


def summary_sentence(found: CoveredPixels) -> str:
    """How many there are, and how many quantities they tell."""
    sides = [f"{count} {what}" for what, count in (
        ("columns on the left", found.covered.left), ("columns on the right", found.covered.right),
        ("rows at the top", found.covered.top), ("rows at the bottom", found.covered.bottom),
    ) if count]  # fmt: skip
    told = sum(name in found.fit and not found.fit[name].is_limit for name in NAMES)
    quantities = f"{told} of {len(NAMES)} quantities"
    return f"The stored frames have {', '.join(sides)} without light. They tell {quantities}; others are bounded, or not told."


def trail_figure(found: CoveredPixels) -> Figure:
    """What covered pixels show behind the light, over the light beside them."""
    with canvas(2.6) as (figure, axes):
        for trail, colour, mark in zip(found.trails, (BLUE, RED), ("o", "s"), strict=False):
            at = np.arange(1, len(trail.shape) + 1)
            label = f"{trail.axis}, {trail.transfers} transfers"
            axes.errorbar(at, 1e3 * trail.shape, 2e3 * trail.u_shape, fmt=mark, color=colour, markersize=3, linewidth=0.8, label=label)
        axes.axhline(0, color=SOFT, linewidth=0.6)
        axes.set_xlabel("covered pixel behind the light")
        axes.set_ylabel("share of the light / ‰")
        axes.legend(loc="upper right")
        caption = (
            "What covered columns and rows show behind the lit area of bright frames, over the light beside them, with ± 2 u. The first "
            "one is what all transfers together leave behind."
        )
        return Figure(figure, "covered", f"Trail behind the light in covered pixels. {summary_sentence(found)}", caption)
