"""The budget as the page shows it: verdict, ladder of frames, largest contributions with advice, table of all sources, sum and check."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from pixmetry.budget.combine import Combined
from pixmetry.budget.headline import SUM
from pixmetry.budget.job import DECIDED, Budget, BudgetRow
from pixmetry.budget.monte_carlo import MonteCarlo
from pixmetry.budget.probe import phases_for
from pixmetry.camera.catalogue import STAGES, get_source
from pixmetry.camera.contribution import UNSTEADY
from pixmetry.report.numbers import NONE, THIN, decimals_of, fixed, length_mpx, length_px, length_um, percent, signed

CLASSES = {
    "T": "random in time, pixel by pixel",
    "Tr": "random in time, common to a row",
    "F": "fixed pattern",
    "G": "smooth geometry",
    "D": "drift",
    "O": "object and light",
}
CLASS_RULES = (
    "Classes say what averaging does. T and Tr change from frame to frame: their variance falls as 1/n with n frames, and again with "
    "the number of targets. F stays the same in every frame and changes from place to place: more frames do not help, more targets do. "
    "G, D and O (smooth geometry, drift, object and light) fall with neither. Uncorrelated contributions add as squares, x and y apart; "
    "a bias that is not corrected adds as its square and is lowered by no number of frames (JCGM 100:2008, 5.1.2 and F.2.4.5)."
)
NAMED = 6  # accepted sources that the verdict names


@dataclass(frozen=True)
class Length:
    """A length as text, in px and (where the pitch is known) in µm; ``axis`` is x or y."""

    px: str
    um: str
    axis: str = ""


@dataclass(frozen=True)
class Verdict:
    """The first section's texts and numbers."""

    first: list[Length]
    calibrated: list[Length]
    second: list[Length]
    second_calibrated: list[Length]
    shares: str
    accepted: str
    target: str
    estimator: str
    places: str
    ladder: list[dict[str, Any]]
    why: str = ""


def budget_content(budget: Budget, unmeasured: Mapping[str, str]) -> dict[str, Any]:
    """Everything that the page says of the budget."""
    top, accepted, longest_px = _top(budget)
    return {
        "verdict": _verdict(budget),
        "pitch_known": budget.pitch_um is not None,
        "top": top,
        "accepted": accepted,
        "scale": _text(longest_px, budget.pitch_um),
        "sources": _sources(budget, unmeasured),
        "mc_note": _monte_carlo_note(budget),
        "sums": _sums(budget),
        "interaction": _interaction(budget),
        "class_rules": CLASS_RULES,
    }


def _length(value_px: float, pitch_um: tuple[float, float] | None, axis: str) -> Length:
    pitch = None if pitch_um is None else pitch_um["xy".index(axis)]
    return Length(length_px(value_px), "" if pitch is None else length_um(value_px, pitch), axis)


def _text(value_px: float, pitch_um: tuple[float, float] | None) -> str:
    """A length that belongs to no axis; in µm only where the pitch is the same in both."""
    square = pitch_um is not None and pitch_um[0] == pitch_um[1]
    return f"{length_px(value_px)} px" + (f" = {length_um(value_px, pitch_um[0])} µm" if square and pitch_um else "")


def _both(combined: Combined, pitch_um: tuple[float, float] | None) -> list[Length]:
    return [_length(combined.total_x_px, pitch_um, "x"), _length(combined.total_y_px, pitch_um, "y")]


def _left(combined: Combined, pitch_um: tuple[float, float] | None) -> list[Length]:
    return [_length(combined.left_x_px, pitch_um, "x"), _length(combined.left_y_px, pitch_um, "y")]


def _verdict(budget: Budget) -> Verdict:
    pitch = budget.pitch_um
    ladder = [
        {"label": f"{a.frames} frame{'' if a.frames == 1 else 's'}", "cells": [*_both(a, pitch), *_left(a, pitch), *_both(b, pitch)]}
        for a, b in zip(budget.verdicts, budget.with_accepted, strict=True)
    ]
    return Verdict(
        first=_both(budget.verdict, pitch),
        calibrated=_left(budget.verdict, pitch),
        second=_both(budget.with_accepted[0], pitch),
        second_calibrated=_left(budget.with_accepted[0], pitch),
        shares=_shares(budget.largest),
        accepted=_accepted(budget.accepted),
        target=budget.target.describe(),
        estimator=budget.estimator.describe(),
        places=f"Averaged over {(n := phases_for(budget.estimator))} × {n} places of the target within a pixel.",
        ladder=ladder,
        why="" if budget.headline is None else budget.headline.why,
    )


def _shares(rows: Sequence[BudgetRow]) -> str:
    """How the square of the sum divides into what changes in time, from place to place, smoothly, not at all, and what drifts."""
    parts = np.zeros(5)
    for row in rows:
        c = row.contribution
        assert c is not None
        if c.gum_class in UNSTEADY:
            parts[4] += 2 * c.total_px**2
        else:
            parts[:4] += [np.square(v).sum() for v in (c.time_px, c.place_px, c.smooth_px, c.bias_px)]
    if parts.sum() == 0:
        return "Nothing that was measured moves this target."
    random, place, smooth, constant, drift = (percent(v) for v in parts / parts.sum())
    drifting = f"; {drift} % drifts or belongs to the object, and the next image has it otherwise" if parts[4] else ""
    return (
        f"Of the square of the sum, {random} % is random in time and falls with more frames; {place} % is fixed in the camera "
        f"and changes from place to place; {smooth} % changes smoothly over the frame and {constant} % is the same everywhere, which a "
        f"calibration takes up{drifting}."
    )


def _accepted(rows: Sequence[BudgetRow]) -> str:
    if not rows:
        return "Nothing was left to be accepted."
    names = ", ".join(r.title.lower() if not r.title[:2].isupper() else r.title for r in rows[:NAMED])
    more = f" and {len(rows) - NAMED} smaller" if len(rows) > NAMED else ""
    return f"That adds the largest that is to be expected of a sound camera for {len(rows)} source{'s' * (len(rows) > 1)}: {names}{more}."


def _top(budget: Budget) -> tuple[list[dict[str, Any]], list[dict[str, Any]], float]:
    """The largest contributions, and the largest of what was accepted, with their advice; and the px that the longest bar stands for."""
    rows = {r.name: r for r in budget.rows}
    chosen = [(a, rows[a.name]) for a in budget.advice]
    longest = max((abs(v) for _, r in chosen if r.status != "accepted" for v in _components(r)), default=0.0)
    entries: dict[bool, list[dict[str, Any]]] = {True: [], False: []}
    for advice, row in chosen:
        c = row.contribution
        assert c is not None
        accepted = row.status == "accepted"
        entries[accepted].append(
            {
                "title": row.title,
                "chip": f"class {c.gum_class}: {CLASSES[c.gum_class]} · {'accepted at its bound' if accepted else row.status}",
                "bars": [
                    _bar("x", c.u_x_px, c.bias_x_px, longest, budget.pitch_um),
                    _bar("y", c.u_y_px, c.bias_y_px, longest, budget.pitch_um),
                ],
                "size": _text(row.total_px, budget.pitch_um),
                "advice": advice.text,
                "gain": _gain(advice),
            }
        )
    return entries[False], entries[True], longest


def _components(row: BudgetRow) -> tuple[float, ...]:
    c = row.contribution
    return () if c is None else (c.u_x_px, c.u_y_px, c.bias_x_px, c.bias_y_px)


def _bar(axis: str, u: float, bias: float, longest: float, pitch_um: tuple[float, float] | None) -> dict[str, str]:
    """Bar lengths in percent of the longest, and the two numbers as text."""
    pitch = None if pitch_um is None else pitch_um["xy".index(axis)]

    def text(px: str, um: str) -> str:
        return f"{px} px" + (f" ({um} µm)" if pitch is not None and px != "0" else "")

    width = [f"{max(100 * abs(v) / longest, 0.2):.1f}" if v else "0" for v in (u, bias)]
    shift = text(signed(bias, length_px), signed(bias * (pitch or 0.0), length_px))
    return {"axis": axis, "random": width[0], "bias": width[1], "u": text(length_px(u), length_um(u, pitch)), "shift": shift}


def _gain(advice: Any) -> str:
    whole = "the total with everything accepted" if advice.status == "accepted" else "the total"
    now, gone, half = (length_px(v, 3) for v in (advice.combined_px, advice.removed_px, advice.halved_px))
    less = percent(1 - advice.removed_px / advice.combined_px) if advice.combined_px else NONE
    return f"without it {whole} would fall from {now} to {gone} px ({less} % less), with half of it to {half} px (rms of x and y)."


def _monte_carlo_note(budget: Budget) -> str:
    done = next((r.monte_carlo for r in budget.rows if r.monte_carlo is not None), None)
    if done is None:
        return "No Monte Carlo was made."
    return (
        f"Monte Carlo with its standard error, from {done.trials} exposed windows a source ({done.units} cameras of this type, "
        f"{done.places} places, {done.frames} frames each), for what the simulated camera holds."
    )


def _sources(budget: Budget, unmeasured: Mapping[str, str]) -> list[tuple[str, list[dict[str, str]]]]:
    def place(row: BudgetRow) -> int:
        return STAGES.index(row.source_id.split(".")[0])

    ordered = sorted(budget.rows, key=place)  # within a stage in the budget's own order
    return [(STAGES[k].capitalize(), [_source(r, unmeasured) for r in rows]) for k, rows in groupby(ordered, place)]


def _source(row: BudgetRow, unmeasured: Mapping[str, str]) -> dict[str, str]:
    source = get_source(row.source_id)
    c, mc = row.contribution, row.monte_carlo
    counts = c is not None and row.status not in ("not applicable", "left to calibration")
    return {
        "id": row.name if row.name == row.source_id else f"{row.source_id} ({row.name})",
        "title": row.title,
        "number": f"{source.number} {'★' * source.stars}".strip() if source.number else NONE,
        "status": row.status,
        "gum_class": c.gum_class if c is not None else source.gum_class,
        "x": length_mpx(float(np.hypot(c.u_x_px, c.bias_x_px))) if counts and c else NONE,
        "y": length_mpx(float(np.hypot(c.u_y_px, c.bias_y_px))) if counts and c else NONE,
        "mc_x": NONE if mc is None else _with_error(mc.x),
        "mc_y": NONE if mc is None else _with_error(mc.y),
        "share": f"{percent(row.share)} %" if counts else NONE,
        "known": _known(row),
        "reason": _reason(row, unmeasured),
    }


def _with_error(axis: Any) -> str:
    """Total of one axis of a Monte Carlo and its standard error, in thousandths of a pixel."""
    total = float(np.hypot(axis.u, axis.bias))
    if not np.isfinite(total):
        return NONE
    error = 1000 * float(np.hypot(axis.u * axis.se_u, axis.bias * axis.se_bias) / total) if total else 0.0
    if error < 0.005:
        return length_mpx(total)
    places = min(max(decimals_of(error, 1), 0), 2)
    return f"{fixed(1000 * total, places)} ± {fixed(error, places)}"


def _reason(row: BudgetRow, unmeasured: Mapping[str, str]) -> str:
    """Why something is missing; nothing where all is there."""
    if row.status in DECIDED and row.contribution is not None:
        return ""
    return unmeasured.get(row.source_id, row.reason) if row.status == "accepted" else row.reason


def _known(row: BudgetRow) -> str:
    """Relative uncertainty of a measured contribution that comes of its parameters."""
    if row.u_of_total_px <= 0 or row.total_px <= 0:
        return ""
    share = row.u_of_total_px / row.total_px
    return f"± {percent(share)} %" if share <= 1 else f">{THIN}100 %"


def _sums(budget: Budget) -> list[dict[str, Any]]:
    pitch, v = budget.pitch_um, budget.sums[0] if budget.sums else budget.verdict

    def row(label: str, x: float, y: float, strong: bool = False) -> dict[str, Any]:
        return {"label": label, "x": _length(x, pitch, "x"), "y": _length(y, pitch, "y"), "strong": strong}

    rows = [
        row("Standard uncertainties, analytic", v.u_x_px, v.u_y_px),
        row("Constant over the frame (bias), analytic", v.bias_x_px, v.bias_y_px),
        row("Sum of all measured and modelled, analytic", v.total_x_px, v.total_y_px, True),
        row("What a calibration leaves of it", v.left_x_px, v.left_y_px, True),
    ]
    alone = [r.monte_carlo for r in budget.rows if r.monte_carlo is not None]
    if alone:
        rows.append(row("Each source alone by Monte Carlo, added", _sum_of(alone, "x"), _sum_of(alone, "y")))
    if budget.interaction is not None:
        together = [budget.interaction.together]
        rows.append(row("One Monte Carlo with all sources on", _sum_of(together, "x"), _sum_of(together, "y"), True))
    every = budget.with_accepted[0]
    return [*rows, row("The verdict, with everything accepted at its bound", every.total_x_px, every.total_y_px)]


def _sum_of(results: list[MonteCarlo], axis: str) -> float:
    return float(np.hypot(np.sqrt(sum(getattr(m, axis).u ** 2 for m in results)), sum(getattr(m, axis).bias for m in results)))


def _interaction(budget: Budget) -> str:
    """Everything at once against everything alone, and whether the difference can be told from chance."""
    found, analytic_px = budget.interaction, (budget.sums[0] if budget.sums else budget.verdict).total_px
    if found is None:
        return "No Monte Carlo was made."
    difference, se = found.difference_px, found.se_px
    places = min(max(decimals_of(se, 2), 0), 6) if se > 0 else 6
    if abs(difference) <= 2 * se:
        verdict = "which is within two standard errors: no interaction is seen"
    elif difference > 0:
        verdict = "more than two standard errors: the sources act on each other"
    else:
        verdict = "less by more than two standard errors: together the sources do less than the sum of each alone"
    lost = f" In {found.together.lost} of {found.together.trials} windows no target was found." if found.together.lost else ""

    def px(value: float) -> str:
        return fixed(value, places)

    return (
        f"All sources at once give {px(found.together.total_px)} ± {px(found.together.se_total_px)} px (rms of x and y); each alone, added "
        f"(scatter as squares, biases with their signs), {px(found.sum_px)} ± {px(found.se_sum_px)} px. The interaction is the "
        f"difference, {px(difference)} ± {px(se)} px, {verdict}. The analytic sum is {px(analytic_px)} px.{lost}{_stands(budget)}"
    )


def _stands(budget: Budget) -> str:
    return "" if budget.headline is None else f" The verdict is by {'the sum' if budget.headline.by == SUM else 'Monte Carlo'}."
