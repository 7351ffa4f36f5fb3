"""The page of a camera's budget: the answer with its interval, what matters, what to do next, every row, the handbook's table beside it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from pixmetry.budget.answer import Answer as Totals
from pixmetry.budget.answer import Next, rms
from pixmetry.budget.calibration_noise import CALIBRATION
from pixmetry.budget.camera_budget import CameraBudget
from pixmetry.budget.handbook import why_differ
from pixmetry.budget.object_space import SpacePoint
from pixmetry.budget.sweep import WIDE, Sweep
from pixmetry.budget.table import ABSENT, Parts, SourceRow
from pixmetry.camera.catalogue import STAGES
from pixmetry.report import Answer, Column, Figure, Page, Points, Reading, Row, Run, Section, Table, Text, strong
from pixmetry.report.blocks import Block, block_diagram
from pixmetry.report.drawing import BLUE, SOFT, canvas
from pixmetry.report.numbers import NONE, length_mpx, length_px, length_um, percent, significant
from pixmetry.report.page import Inline

KIND = "error budget"
TITLE = f"<title>: {KIND}</title>"  # ends so
FOOTER = "All lengths are standard uncertainties (k = 1), bias included; x runs along rows, y along columns."
LISTED = 8  # things to do
MOST_BARS = 14
AXES = ("X", "Y", "Z (depth)")
HOW_TO_READ = (
    "One target in one frame, in thousandths of a pixel; the largest after the calibration first. “Before” is without any calibration, "
    "“after” is what that of the scenario leaves. “At most” is what a sound camera can have where nothing was measured. Random part and "
    "bias are added as squares."
)
STAR_SCALE = "Stars are by the total before calibration: ★ from 0.005 px, ★★ 0.03, ★★★ 0.1, ★★★★ 0.3, ★★★★★ 1 px."


def page_of(budget: CameraBudget, sweep: Sweep | None = None) -> Page:
    """The page of a camera's budget.

    Parameters
    ----------
    budget : CameraBudget
    sweep : Sweep, optional
        The answer over a range of one entry.

    Returns
    -------
    Page
    """
    page = Page(budget.camera, KIND, "pixmetry error budget", _facts(budget), FOOTER)
    page.sections += [
        _answer(budget),
        _next("What to change next", "change", budget.to_change, "the total falls from {} to {} px"),
        _next("What to measure next", "measure", budget.to_measure, "the upper end of the interval falls from {} to {} px"),
        _all_rows(budget),
        _handbook(budget),
        _scenario(budget),
    ]
    if budget.disagreements:
        page.sections.insert(3, _descriptions(budget))
    if sweep is not None:
        page.sections.insert(1, _sweep(sweep))
    return page


def _facts(budget: CameraBudget) -> list[tuple[str, str]]:
    setting, camera = budget.setting, budget.setting.described
    rows, cols = camera.frame_shape
    facts = [("Camera", f"{camera.name}, {cols} × {rows} px")]
    if camera.pitch_um is not None:
        facts.append(("Pixel pitch", f"{camera.pitch_um[0]:g} × {camera.pitch_um[1]:g} µm"))
    facts += [("Target", setting.target.describe()), ("Estimator", budget.estimator.describe())]
    facts.append(("Calibration", budget.scenario.calibration.model.replace("_", " ")))
    if setting.px_per_mm is not None:
        facts.append(("Scale", f"{significant(setting.px_per_mm)} px for a millimetre on the object"))
    return facts


# ---- the answer --------------------------------------------------------------------------------------------------------------------


def _answer(budget: CameraBudget) -> Section:
    one, mean, count = budget.one, budget.answer, budget.scenario.count
    section = Section("Uncertainty of a position", name="answer")
    parts: list[Text | Sequence[Reading]] = [Text("One target in one frame, after the calibration:"), _readings(budget, one.after_px)]
    parts.append(Text(_interval(one)))
    if (count.frames, count.targets) != (1, 1):
        parts += [Text(f"Mean over {_many(count.frames, 'frame')} and {_many(count.targets, 'target')}:"), _readings(budget, mean.after_px)]
    point = budget.point
    if point is not None:
        parts.append(Text(f"A point on the object, by {count.rays} rays with a base of {count.base_to_height:g} of the distance:"))
        parts.append([Reading(n, f"{significant(float(v), 2)} mm") for n, v in zip(AXES, point.u_mm, strict=True)])
        parts.append(Text(_about_points(budget, point), "second"))
    parts.append(Text(f"Without any calibration: x {length_px(one.before_px[0])} px, y {length_px(one.before_px[1])} px.", "second"))
    if budget.goal is not None:
        parts.insert(2, Text(strong(budget.goal.text)))
    section.add(Answer(parts))
    for row in budget.left_out:
        section.add_text(strong("Not in the answer:"), f" {row.title} ({row.reason}).")
    if budget.together is not None:
        t = budget.together
        section.add_text(
            strong("Check by simulation:"),
            f" all sources of the chain at once, the target at rest, {t.trials} windows: {length_px(t.total_px)} ± "
            f"{length_px(t.se_total_px)} px before a calibration, {length_px(t.calibrated_px)} ± {length_px(t.se_calibrated_px)} px after.",
        )
    section.add(_chain(budget), _bars(budget))
    return section


def _about_points(budget: CameraBudget, point: SpacePoint) -> str:
    """What the numbers of a point in space rest on."""
    count = budget.scenario.count
    worst = ", ".join(f"{n[0]} {significant(float(v), 2)} mm" for n, v in zip(AXES, point.worst_mm, strict=True))
    posed = f"images oriented by {count.points} points that all of them see" if count.points else "orientations known"
    return f"Mean over the object; at its worst place {worst}. With {posed}. Scale and coordinate system of the object are not in it."


def _many(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _interval(one: Totals) -> str:
    after, least, most = (rms(pair) for pair in (one.after_px, one.least_px, one.most_px))
    return (
        f"Root mean square of x and y: {length_px(after)} px; between {length_px(least)} px (only what is known of this camera) and "
        f"{length_px(most)} px (everything that is not measured at the largest of a sound camera)."
    )


def _readings(budget: CameraBudget, pair: tuple[float, float]) -> list[Reading]:
    um, mm = budget.um(pair), budget.mm(pair)
    found = []
    for k, axis in enumerate("xy"):
        parts = [f"{length_px(pair[k])} px"]
        parts += [f"{length_um(pair[k], um[k] / pair[k])} µm"] if um is not None and pair[k] else []
        parts += [f"{significant(mm[k], 2)} mm"] if mm is not None else []
        found.append(Reading(axis, " = ".join(parts)))
    return found


def _chain(budget: CameraBudget) -> Figure:
    """The links of the chain in the order of the light, each with what it leaves."""
    counting = [r for r in budget.rows if r.counts]
    there = {r.source_id.split(".")[0] for r in budget.rows if r.status != ABSENT}
    whole = sum(r.after_px**2 for r in counting) or 1.0
    parts = {stage: sum(r.after_px**2 for r in counting if r.source_id.split(".")[0] == stage) for stage in there}
    blocks = [
        Block(stage, parts[stage] / whole, [f"{length_mpx(float(np.sqrt(parts[stage])))} mpx"])
        for stage in (*STAGES, CALIBRATION)
        if stage in there
    ]
    caption = "Share of each link in the square of the total after the calibration, and its part in 10⁻³ px."
    return block_diagram(blocks, "chain", "the links of the chain", caption)


def _bars(budget: CameraBudget) -> Figure:
    """The largest sources, before and after the calibration."""
    largest = sorted((r for r in budget.rows if r.counts or r.before_px), key=lambda r: -max(r.after_px, 1e-3 * r.before_px))[:MOST_BARS]
    floor = 1e-4  # below that nothing matters
    with canvas(0.4 + 0.19 * len(largest)) as (figure, axes):
        for k, row in enumerate(reversed(largest)):
            axes.plot([max(row.before_px, floor)], [k], "o", markerfacecolor="none", color=SOFT)
            if row.largest_px > max(row.after_px, floor):
                axes.plot(
                    [max(row.after_px, floor), max(row.largest_px, floor)],
                    [k, k],
                    color=BLUE,
                    alpha=0.35,
                    linewidth=4,
                    solid_capstyle="butt",
                )
            axes.plot([max(row.after_px, floor)], [k], "o", color=BLUE)
        axes.set_xscale("log")
        axes.set_yticks(range(len(largest)), [r.title for r in reversed(largest)])
        axes.set_xlabel("px, one target in one frame")
    top = ", ".join(f"{r.title} {length_px(r.after_px)} px" for r in largest[:3])
    caption = "Open: before any calibration; filled: after it; band: up to the largest of a sound camera, where it was not measured."
    return Figure(figure, "largest", f"The largest sources before and after calibration: {top}.", caption)


def _sweep(sweep: Sweep) -> Section:
    """The answer over a range of one entry."""
    values = [s.value for s in sweep.steps]
    with canvas(2.2) as (figure, axes):
        axes.fill_between(
            values, *([rms(getattr(s.answer, n)) for s in sweep.steps] for n in ("least_px", "most_px")), color=BLUE, alpha=0.15
        )
        axes.plot(values, [rms(s.answer.after_px) for s in sweep.steps], "o-", color=BLUE, label="after calibration")
        axes.set_yscale("log")
        if min(values) > 0 and max(values) / min(values) >= WIDE:
            axes.set_xscale("log")
            axes.set_xticks(values, [f"{v:g}" for v in values], minor=False)
            axes.minorticks_off()
        axes.set_xlabel(sweep.key)
        axes.set_ylabel("px, rms of x and y")
    low = min(sweep.steps, key=lambda s: rms(s.answer.after_px))
    alt = f"Total after calibration over {sweep.key}; smallest at {low.value:g}."
    section = Section(f"Over {sweep.key}", name="sweep")
    if sweep.sentence:
        section.add_text(sweep.sentence)
    section.add(Figure(figure, "sweep", alt, "Line: after the calibration; band: the interval."))
    columns = [
        Column(sweep.key, "right"),
        *(Column(f"{n} / px", "right") for n in ("After", "At least", "At most")),
    ]
    in_mm = any(s.after_mm is not None for s in sweep.steps)
    columns += [Column("After / mm", "right")] if in_mm else []
    columns.append(Column("Largest source"))
    cells = []
    for s in sweep.steps:
        mm = [] if not in_mm else [NONE if s.after_mm is None else significant(s.after_mm, 2)]
        cells.append([f"{s.value:g}", *(length_px(rms(p)) for p in _three(s.answer)), *mm, s.largest])
    return section.add(Table(f"Total over {sweep.key}", columns, cells))


def _three(answer: Totals) -> tuple[tuple[float, float], ...]:
    return answer.after_px, answer.least_px, answer.most_px


# ---- what to do --------------------------------------------------------------------------------------------------------------------


def _next(title: str, name: str, steps: Sequence[Next], words: str) -> Section:
    section = Section(title, name=name)
    if not steps:
        return section.add_text("Nothing that would make a difference.")
    items: list[Inline] = []
    for step in steps[:LISTED]:
        if step.is_worth_it:
            numbers = words.format(length_px(step.now_px, 3), length_px(step.then_px, 3))
            items.append([strong(f"{step.title}:"), f" {step.text} ".replace("  ", " "), f"({numbers})"])
    return section.add(Points(items, numbered=True) if items else Text("No single source makes a difference of 1 %."))


# ---- the rows ----------------------------------------------------------------------------------------------------------------------


def _all_rows(budget: CameraBudget) -> Section:
    section = Section("All error sources", name="sources").add_text(HOW_TO_READ, style="small soft")
    groups = {key: list(rows) for key, rows in groupby(sorted(budget.rows, key=_group), key=_group)}
    section.add(_table("Error sources that count", groups.get(0, [])))
    for key, words in ((1, "that may be there, at most"), (2, "that do nothing here"), (3, "that are not in this camera")):
        if rows := groups.get(key, []):
            section.add_section(f"{_many(len(rows), 'source')} {words}", _table(f"Error sources {words}", rows), fold=True)
    return section


def _group(row: SourceRow) -> int:
    return 3 if row.status == ABSENT else 0 if row.counts or row.before_px >= 1e-4 else 1 if row.largest_px > 0 else 2


def _table(label: str, rows: Sequence[SourceRow]) -> Table:
    numbers = [Column(axis, "right", group=group) for group in ("Before / 10⁻³ px", "After / 10⁻³ px") for axis in "xy"]
    columns: list[Column | str] = ["Source", "Row", "Known", "Class", *numbers, Column("At most", "right"), Column("Share", "right")]
    return Table(label, columns, [_cells(r) for r in rows])


def _cells(row: SourceRow) -> Row:
    def pair(parts: Parts | None) -> list[str]:
        return [NONE, NONE] if parts is None else [length_mpx(v) for v in parts.axes_px()]

    name = row.name if row.name == row.source_id else f"{row.source_id} ({row.name})"
    cells = [
        [row.title, "\n", Run(name, "small mono")],
        f"{row.number} {'★' * row.stars}".strip() if row.number else NONE,
        "taken up by the calibration" if row.taken_up else row.status,
        row.gum_class,
        *pair(row.before),
        *pair(row.after),
        length_mpx(row.largest_px) if row.largest is not None else "",
        f"{percent(row.share)} %" if row.counts else "",
    ]
    return Row(cells, "; ".join(w for w in (row.how, row.reason) if w))


def _handbook(budget: CameraBudget) -> Section:
    """The handbook's table again: its stars and ours."""
    section = Section("The handbook's error table, for this camera", name="handbook")
    section.add_text(STAR_SCALE, style="small soft")
    rows = sorted((r for r in budget.rows if r.number), key=lambda r: (r.number, -r.before_px))
    columns: list[Column | str] = [
        "Row",
        "Source",
        "Handbook",
        "Here",
        Column("Before / px", "right"),
        Column("After / px", "right"),
        "Why they differ",
    ]
    cells = [
        [
            str(r.number),
            r.title,
            "★" * r.stars or NONE,
            NONE if r.before is None else "★" * r.own_stars or "none",
            NONE if r.before is None else length_px(r.before_px),
            NONE if r.after is None else length_px(r.after_px),
            why_differ(r),
        ]
        for r in rows
    ]
    return section.add(Table("The handbook's error table", columns, cells))


# ---- what it rests on --------------------------------------------------------------------------------------------------------------


def _scenario(budget: CameraBudget) -> Section:
    section = Section("What is measured, and how", name="scenario")
    section.add_text("The scenario; what was not given has its default.", style="small soft")
    rows = [
        [Run(name, "mono"), "not given" if value is None else str(value), "given" if given else "default"]
        for name, (value, given) in budget.scenario.told.items()
    ]
    return section.add_section("Entries of the scenario", Table("Scenario", ["Entry", "Value", ""], rows), fold=True)


def _descriptions(budget: CameraBudget) -> Section:
    section = Section("Sheet and measurement", name="descriptions")
    rows = [
        [
            [d.name, "\n", Run(d.parameter, "small mono")],
            significant(d.first, 4),
            significant(d.second, 4),
            d.unit,
            "agree" if d.agree else Run("differ", "status differ"),
        ]
        for d in budget.disagreements
    ]
    columns: list[Column | str] = ["Parameter", Column("First", "right"), Column("Second", "right"), "Unit", ""]
    return section.add(Table("Values that two descriptions know", columns, rows))
