"""The section of an assessment's page on bright spots: what they leave in the rest of their columns, and their streaks."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.observations import BrightSpots
from pixmetry.report import Column, Section, Table
from pixmetry.report.drawing import BLUE, INK, RED, canvas, line
from pixmetry.report.numbers import printed_number, significant, uncertain
from pixmetry.report.page import Figure

WORDS = (
    "Smear leaves the same level in a column at every exposure, cross-talk and stray light grow with it. Charge that full pixels spill "
    "ends in a streak; how far it reaches up and down tells blooming."
)
TITLES = {
    "smear_s": ("Smear: transfer time × leak", "s"),
    "col_crosstalk": ("Cross-talk of columns", "1"),
    "row_crosstalk": ("Cross-talk of rows", "1"),
    "plateau_dn": ("Level at which spots saturate", "DN"),
}
MOST_ROWS = 20


def spots_section(found: BrightSpots) -> Section:
    """Sentence, figures, values, and a table of the spots."""
    section = Section("Bright spots", name="spots").add_text(summary_sentence(found))
    if not found.spots:
        return section
    section.add_text(WORDS, style="small soft").add(level_figure(found))
    if found.streaks is not None:
        section.add(streak_figure(found))
    rows = []
    for name, (title, unit) in TITLES.items():
        if name in found.fit:
            value = found.fit[name]
            number = printed_number(value) if value.is_limit else uncertain(value.value, value.u, unit)
            rows.append([title, number.value, "" if value.is_limit else f"± {number.u}", number.unit, value.reason])
        elif name in found.fit.reasons:
            rows.append([title, "–", "", unit, found.fit.reasons[name]])
    section.add(Table("Values", ["Quantity", Column("Value", "right"), Column("± u", "u"), Column("Unit", "unit"), "Remark"], rows))
    each = [[f"{s.x_px:.1f}, {s.y_px:.1f}", significant(s.peak_dn_per_s)] for s in found.spots[:MOST_ROWS]]
    folded = section.add_section("Spot by spot", fold=True)
    title = f"The {len(found.spots)} spots" if len(found.spots) <= MOST_ROWS else f"The first {MOST_ROWS} of {len(found.spots)} spots"
    folded.add(Table(title, [Column("x, y / px"), Column("Brightest pixel / DN/s", "right")], each))
    return section


def summary_sentence(found: BrightSpots) -> str:
    """How many spots and exposures there are, and where they saturate."""
    if not found.spots:
        return f"Nothing was measured from bright spots: {next(iter(found.fit.reasons.values()), 'none was found')}."
    count = f"{len(found.spots)} spots" if len(found.spots) > 1 else "One spot"
    times = f"at {len(found.exposure_s)} exposures" if len(found.exposure_s) > 1 else "at one exposure"
    if not found.saturated.any():
        return f"{count} {times}; none saturates."
    end = "the highest code: the converter ends first" if found.clipped else "below the highest code: the pixels are full"
    over = found.exposure_s[-1] / found.exposure_s[0] * found.peak_dn[0] / found.plateau_dn
    return f"{count} {times}, up to {over:.2g} times saturation at {significant(found.plateau_dn)} DN above black, {end}."


def level_figure(found: BrightSpots) -> Figure:
    """Level of the rest of the columns against the exposure."""
    with canvas(2.6) as (figure, axes):
        for level, colour, word in ((found.level_up_s, BLUE, "above"), (found.level_down_s, RED, "below")):
            axes.errorbar(
                found.exposure_s, level, 2 * found.u_level_s, color=colour, marker="o", markersize=3, linewidth=0.8, capsize=2, label=word
            )
        if "smear_s" in found.fit and "smear_s" not in found.fit.limits:
            axes.axhline(found.fit["smear_s"].value / found.frame_rows, color=INK, linestyle="--", linewidth=0.8)
        axes.set_xscale("log")
        axes.axhline(0, color=INK, linewidth=0.4)
        axes.set_xlabel("exposure / s")
        axes.set_ylabel("level over light of column / s")
        axes.legend(loc="best")
        caption = (
            "Level of the rest of the spots' columns, above and below them, over the light of the column in one second, ± 2 u. Dashed: "
            "smear. What rises with the exposure is cross-talk or stray light."
        )
        return Figure(figure, "spot-levels", f"Level of the columns of spots against the exposure. {summary_sentence(found)}", caption)


def streak_figure(found: BrightSpots) -> Figure:
    """Charge above and below the centre of overexposed spots against the light of the column."""
    streaks = found.streaks
    assert streaks is not None
    light = streaks.light_dn.sum(axis=1) / found.plateau_dn
    order = np.argsort(light)
    with canvas(2.6) as (figure, axes):
        for charge, colour, word in ((streaks.up_dn, BLUE, "above"), (streaks.down_dn, RED, "below")):
            line(
                axes, light[order], charge[order] / found.plateau_dn, color=colour, linestyle="none", marker="o", markersize=2.5, label=word
            )
        axes.set_xlabel("light of the column / full pixels")
        axes.set_ylabel("charge / full pixels")
        axes.legend(loc="best")
        caption = (
            "Charge above and below the centre of overexposed spots, column by column. The two differ if more charge spills to one side."
        )
        return Figure(figure, "spot-streaks", f"Charge above and below the centres of {len(found.spots)} overexposed spots.", caption)
