"""The section of an assessment's page on a light that goes off: what the frames after it still show."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.observations import LightSteps
from pixmetry.core.number import Number
from pixmetry.report import Column, Section, Table
from pixmetry.report.drawing import BLUE, INK, SOFT, canvas, line
from pixmetry.report.numbers import printed_number, significant
from pixmetry.report.page import Figure

SHOWN = 12  # frames after the step


def light_off_section(found: LightSteps) -> Section:
    """Sentence, figure, and a table of the sequences."""
    section = Section("After the light went off", name="light-off").add_text(summary_sentence(found))
    if found.steps:
        section.add(decay_figure(found))
        columns: list[Column | str] = [Column("Light / DN", "right"), Column("Frames", "right")]
        columns += [Column(f"Share left in the {nth} dark frame", "right") for nth in ("first", "second")]
        rows = [
            [
                significant(s.signal_dn),
                f"{s.bright_frames} + {len(s.shares)}",
                *(printed_number(Number(float(s.shares[k]), s.u_shares[k])).joined() for k in (0, 1)),
            ]
            for s in found.steps
        ]
        section.add(Table("Sequences", columns, rows))
    return section


def summary_sentence(found: LightSteps) -> str:
    """What is left of a bright frame in the next one."""
    if "left_rel" not in found.fit:
        return f"What a bright frame leaves in the next one is not measured: {found.fit.reasons['left_rel']}."
    left = found.fit["left_rel"]
    if left.is_limit:
        return f"The share of the last bright frame that the first dark one shows is {printed_number(left).joined()}."
    return f"The first dark frame shows a share of {printed_number(left).joined()} of the last bright one."


def decay_figure(found: LightSteps) -> Figure:
    """Share of the last bright frame in those that follow, on a logarithmic scale."""
    with canvas(2.6) as (figure, axes):
        for step in found.steps:
            shares = np.abs(step.shares[:SHOWN])
            line(axes, np.arange(1, len(shares) + 1), np.maximum(shares, 1e-9), color=BLUE, marker="o", markersize=3, linewidth=0.8)
            axes.axhline(step.u_shares[0], color=SOFT, linewidth=0.6, linestyle=":")
        if "left_rel" in found.fit and not found.fit.limits:
            n = np.arange(1, SHOWN + 1)
            line(axes, n, found.fit["left_rel"].value ** n, color=INK, linestyle="--", linewidth=0.8)
        axes.set_yscale("log")
        axes.set_ylim(max(min(s.u_shares[0] for s in found.steps) / 10, 1e-8), 1)
        axes.set_xlabel("frame after the light went off")
        axes.set_ylabel("share of the last bright frame")
        caption = (
            "What frames show after the light went off, over the last bright frame (absolute values). Dotted: standard uncertainty of the "
            "first; dashed: a share that stays behind from frame to frame."
        )
        alt = f"Share of the last bright frame in the dark frames after it. {summary_sentence(found)}"
        return Figure(figure, "light-off", alt, caption)
