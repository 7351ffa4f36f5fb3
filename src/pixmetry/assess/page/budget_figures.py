"""The budget in two drawings: the links of the chain with their shares, and the sources by size."""

from __future__ import annotations

import numpy as np

from pixmetry.budget.job import Budget, BudgetRow
from pixmetry.report import Figure
from pixmetry.report.drawing import BLUE, INK, RED, SOFT, canvas
from pixmetry.report.numbers import length_px, percent

MOST_BARS = 10
LONG_TITLE = 34  # characters of a source's title that have room beside its bar


def link_shares(budget: Budget) -> Figure | None:
    """The chain from the light to the file: what each link takes of the square of the sum; None where nothing counts."""
    stages = budget.stages
    if not stages:
        return None
    at = np.arange(len(stages), dtype=float)
    share = np.array([max(s.share, 0.0) for s in stages])
    with canvas(0.75 + 0.3 * len(stages)) as (figure, axes):
        axes.barh(at, 100 * share, 0.5, color=BLUE)
        for k, stage in enumerate(stages):
            bound = f", accepted at most {length_px(stage.accepted_px)} px" if stage.accepted_px else ""
            words = f"{percent(stage.share)} %, {length_px(stage.total_px)} px" if stage.total_px else "nothing measured"
            axes.text(100 * share[k] + 1.5, at[k], words + bound, va="center", fontsize=6.3)
        along = axes.get_yaxis_transform()  # across: shares of the axes; upright: links
        axes.plot(np.full(len(at), -0.035), at, color=SOFT, linewidth=0.8, marker="v", markersize=3.6, clip_on=False, transform=along)
        axes.set_yticks(at, [s.stage for s in stages])
        axes.tick_params(axis="y", length=0, pad=13)
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.set_axisbelow(True)
        axes.set_xlim(0, max(100 * float(share.max()) * 1.9, 10.0))
        axes.set_xlabel("share of the square of the sum / %")
        told = ", ".join(f"{s.stage} {percent(s.share)} %" for s in stages)
        caption = (
            "The chain in the order of the light: what each link takes of the square of the sum, and what its sources come to together. "
            "What was accepted at its bound is told beside it and is no part of the sum."
        )
        return Figure(figure, "links", f"Share of each link of the chain in the square of the sum: {told}.", caption)


def pareto(budget: Budget) -> Figure | None:
    """The sources of the verdict by size, with what they come to together; None where there are none."""
    rows = [r for r in budget.rows if r.counts and r.status != "accepted"]
    shown = rows[:MOST_BARS]
    if not shown:
        return None
    at = np.arange(len(shown), dtype=float)
    u, bias = (np.array([_rms(r, part) for r in shown]) for part in ("u", "bias"))
    together = np.cumsum([max(r.share, 0.0) for r in shown])
    with canvas(0.75 + 0.3 * len(shown)) as (figure, axes):
        axes.barh(at - 0.14, u, 0.26, color=BLUE, label="standard uncertainty")
        axes.barh(at + 0.14, np.abs(bias), 0.26, color=RED, label="bias")
        longest = float(max(u.max(), np.abs(bias).max()))
        for k, part in enumerate(together):
            axes.text(max(u[k], abs(bias[k])) + 0.02 * longest, at[k], f"{percent(float(part))} %", va="center", fontsize=6.3, color=INK)
        axes.set_yticks(at, [_short(r.title) for r in shown], fontsize=6.3)
        axes.tick_params(axis="y", length=0)
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.set_axisbelow(True)
        axes.set_xlim(0, 1.25 * longest)
        axes.locator_params(axis="x", nbins=4)
        axes.set_xlabel("rms of x and y / px")
        figure.legend(loc="outside upper center", ncols=2)
        more = "" if len(rows) == len(shown) else f" {len(rows) - len(shown)} smaller ones are in the table of all sources."
        caption = f"The sources by size. The percentage is what a bar and all above it make of the square of the sum.{more}"
        alt = (
            f"The {len(shown)} largest of {len(rows)} sources by size; the largest is {shown[0].title}, {length_px(shown[0].total_px)} px."
        )
        return Figure(figure, "pareto", alt, caption)


def _rms(row: BudgetRow, part: str) -> float:
    """Root mean square over x and y of the standard uncertainty (``u``) or of the bias."""
    c = row.contribution
    return float(np.hypot(getattr(c, f"{part}_x_px"), getattr(c, f"{part}_y_px")) / np.sqrt(2))


def _short(title: str) -> str:
    return title if len(title) <= LONG_TITLE else title[: LONG_TITLE - 1].rstrip() + "…"
