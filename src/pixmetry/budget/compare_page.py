"""The page of budgets side by side: which camera is the better, how sure that is, and what makes the difference."""

from __future__ import annotations

from math import isfinite

from pixmetry.budget.compare import LIKELY, OPEN, SAME, SURE, BudgetComparison, BudgetSide, Rank
from pixmetry.report import Answer, Column, Figure, Page, Reading, Row, Run, Section, Table, Text
from pixmetry.report.drawing import BLUE, SOFT, canvas
from pixmetry.report.numbers import NONE, length_px, percent, significant

KIND = "comparison of error budgets"
TITLE = f"<title>: {KIND}</title>"  # ends so
FOOTER = "All lengths are standard uncertainties (k = 1), bias included, root mean square of x and y."
MOST_ROWS = 20
HOW_TO_READ = (
    "What each source leaves after the calibration. The share is its part of the difference of the squares between that budget and the "
    "best one; it is negative where the source is larger in the best one."
)
UNITS = {"px": "px", "um": "µm", "mm": "mm"}


def page_of(found: BudgetComparison) -> Page:
    """The page of a comparison of budgets.

    Parameters
    ----------
    found : BudgetComparison

    Returns
    -------
    Page
    """
    names = ", ".join(s.name for s in found.sides)
    page = Page(names, KIND, "pixmetry comparison of error budgets", [("Best", found.best.name)], FOOTER)
    page.sections += [_answer(found), _side_by_side(found), _sources(found), _settings(found)]
    return page


def sentences(found: BudgetComparison) -> list[str]:
    """The verdict in words: one sentence for every budget but the best one, and what has to be kept in mind."""
    said = [_sentence(found, rank) for rank in found.ranks[1:]]
    if found.unit == "px" and len({s.um_per_px for s in found.sides}) > 1:
        said.append(
            "The pixels are not of the same size, and the scale on the object is not known: compare in mm (object.distance_mm and "
            "object.f_mm, or object.field_mm)."
        )
    alike = len({(s.frame_shape, s.um_per_px) for s in found.sides}) == 1
    if alike and len({s.camera for s in found.sides}) > 1 and any(r.verdict in (LIKELY, OPEN) for r in found.ranks[1:]):
        said.append("If this is one camera with different lenses, give it one name: what is not known of it is then the same in all.")
    if len({s.field_mm and tuple(round(v) for v in s.field_mm) for s in found.sides}) > 1:
        fields = ", ".join(f"{s.name} {field_of(s)}" for s in (found.sides[r.side] for r in found.ranks))
        said.append(f"They do not see the same field: {fields}.")
    if len({s.exposure_s for s in found.sides}) > 1:
        times = ", ".join(f"{s.name} {time_of(s)}" for s in (found.sides[r.side] for r in found.ranks))
        said.append(f"They do not expose equally long: {times}. Dark current and motion differ by that; --set exposure_s=… is for all.")
    if len({(s.frames, s.targets) for s in found.sides}) > 1:
        said.append("The means are over different numbers of frames or targets.")
    if len({s.estimator for s in found.sides}) > 1:
        said.append("The targets are located by different estimators.")
    if any(key.startswith("target.") for key in found.settings):
        said.append("The targets are not the same: see the scenarios.")
    return said


def _sentence(found: BudgetComparison, rank: Rank) -> str:
    best, other = found.best.name, found.sides[rank.side].name
    if rank.verdict == SAME:
        return f"{best} and {other} are the same within 1 %."
    if rank.ratio <= 1.01:
        head = f"{best} and {other} are the same within 1 % as far as one knows"
    else:
        head = f"{best} is better than {other}, {significant(rank.ratio, 3)} times"
    if rank.verdict == SURE:
        if rank.overlaps:
            return f"{head}. That is sure although the intervals overlap: what is not known is the same in both."
        return f"{head}. That is sure: the intervals do not overlap."
    which = f" (most of all: {', '.join(rank.open_sources)})" if rank.open_sources else ""
    if rank.verdict == LIKELY:
        return f"{head}. That is likely, not sure: their intervals overlap, and what is not measured can turn the order{which}."
    return f"{head}. That is open: what is not measured decides{which}."


def length_of(side: BudgetSide, pair_px: tuple[float, float], unit: str) -> str:
    """A length rounded for the eye; a dash where that scale is not known."""
    value = side.size(pair_px, unit)
    if not isfinite(value):
        return NONE
    return length_px(value) if unit == "px" else significant(value, 2)


def field_of(side: BudgetSide) -> str:
    """Width and height of the field of view; a dash where the scale is not known."""
    return NONE if side.field_mm is None else f"{side.field_mm[0]:.0f} × {side.field_mm[1]:.0f} mm"


def time_of(side: BudgetSide) -> str:
    """Exposure time; a dash where the budget does not tell it."""
    return NONE if side.exposure_s is None else f"{significant(1e3 * side.exposure_s, 3)} ms"


def settings_of(found: BudgetComparison) -> list[tuple[str, list[str]]]:
    """What was not the same, as words; the camera's name stands with every budget anyway."""
    return [(key, [_entry(v) for v in values]) for key, values in found.settings.items()]


def _entry(value: object) -> str:
    return "not given" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _answer(found: BudgetComparison) -> Section:
    section = Section("Which is the best", name="answer")
    unit = UNITS[found.unit]
    where = " on the object," if found.unit == "mm" else ""
    parts: list[Text | list[Reading]] = [Text(f"Uncertainty of a position{where} after the calibration; the best first:")]
    readings = []
    for rank in found.ranks:
        side = found.sides[rank.side]
        answer = side.answer
        low, high = (length_of(side, pair, found.unit) for pair in (answer.least_px, answer.most_px))
        readings.append(Reading(side.name, f"{length_of(side, answer.after_px, found.unit)} {unit}", f"{low} to {high} {unit}"))
    parts.append(readings)
    section.add(Answer([*parts, *(Text(words) for words in sentences(found))]))
    return section.add(_intervals(found))


def _intervals(found: BudgetComparison) -> Figure:
    """Each budget: before, after, and its interval."""
    with canvas(0.55 + 0.26 * len(found.sides)) as (figure, axes):
        for k, rank in enumerate(reversed(found.ranks)):
            side = found.sides[rank.side]
            before, after, least, most = (
                max(side.size(p, found.unit), 1e-9)
                for p in (side.answer.before_px, side.answer.after_px, side.answer.least_px, side.answer.most_px)
            )
            axes.plot([least, most], [k, k], color=BLUE, alpha=0.35, linewidth=5, solid_capstyle="butt")
            axes.plot([before], [k], "o", markerfacecolor="none", color=SOFT)
            axes.plot([after], [k], "o", color=BLUE)
        axes.set_xscale("log")
        axes.set_ylim(-0.6, len(found.ranks) - 0.4)
        axes.set_yticks(range(len(found.ranks)), [found.sides[r.side].name for r in reversed(found.ranks)])
        axes.set_xlabel(f"{UNITS[found.unit]}, rms of x and y")
    sides = [found.sides[r.side] for r in found.ranks]
    order = ", ".join(f"{s.name} {length_of(s, s.answer.after_px, found.unit)}" for s in sides)
    caption = "Open: before any calibration; filled: after it; band: from what is known alone to all that is not measured at its bound."
    return Figure(figure, "intervals", f"Totals after the calibration in {UNITS[found.unit]}: {order}.", caption)


def _side_by_side(found: BudgetComparison) -> Section:
    section = Section("Side by side", name="sides")
    columns: list[Column | str] = ["", *(Column(found.sides[r.side].name, "right") for r in found.ranks)]
    rows: list[list[str]] = [["Camera", *(found.sides[r.side].camera for r in found.ranks)]]
    words = (("before", "Before the calibration"), ("after", "After the calibration"), ("least", "At least"), ("most", "At most"))
    for unit in ("px", "um", "mm"):
        if not any(isfinite(s.size((1.0, 1.0), unit)) for s in found.sides):
            continue
        for name, label in words:
            cells = [length_of(s, getattr(s.answer, f"{name}_px"), unit) for s in (found.sides[r.side] for r in found.ranks)]
            rows.append([f"{label} / {UNITS[unit]}", *cells])
    if any(s.depth_mm is not None for s in found.sides):
        depths = [found.sides[r.side].depth_mm for r in found.ranks]
        rows.append(["Depth of a point in space / mm", *(NONE if d is None else significant(d, 2) for d in depths)])
    if any(s.field_mm is not None for s in found.sides):
        rows.append(["Field of view", *(field_of(found.sides[r.side]) for r in found.ranks)])
    rows.append(["Frames, targets of the mean", *(f"{found.sides[r.side].frames}, {found.sides[r.side].targets}" for r in found.ranks)])
    return section.add(Table("Budgets side by side", columns, rows))


def _sources(found: BudgetComparison) -> Section:
    section = Section("Where the difference comes from", name="sources").add_text(HOW_TO_READ, style="small soft")
    order = [r.side for r in found.ranks]
    shown = [k for k in order[1:] if any(isfinite(r.shares[k]) for r in found.rows)]
    unit, scale = ("10⁻³ px", 1e3) if found.unit == "px" else ("µm", 1e3)
    columns: list[Column | str] = ["Source"]
    columns += [Column(found.sides[k].name, "right", group=f"After the calibration / {unit}") for k in order]
    columns += [Column(found.sides[k].name, "right", group="Share of the difference") for k in shown]
    rows = []
    for row in found.rows[:MOST_ROWS]:
        known = dict.fromkeys(s for s in row.statuses if s)
        note = f"known as: {', '.join(row.statuses[k] or NONE for k in order)}" if len(known) > 1 else next(iter(known), "")
        sizes = [significant(scale * row.sizes[k], 2) for k in order]
        shares = [f"{percent(row.shares[k])} %" if isfinite(row.shares[k]) else NONE for k in shown]
        rows.append(Row([[row.title, "\n", Run(row.source_id, "small mono")], *sizes, *shares], note))
    section.add(Table("Sources by how much they differ", columns, rows))
    if len(found.rows) > MOST_ROWS:
        section.add_text(f"{len(found.rows) - MOST_ROWS} sources that differ less are not shown.", style="small soft")
    return section


def _settings(found: BudgetComparison) -> Section:
    section = Section("What was not the same", name="settings")
    told = settings_of(found)
    if not told:
        return section.add_text("Cameras and scenarios have the same names and entries.")
    order = [r.side for r in found.ranks]
    columns: list[Column | str] = ["Entry", *(found.sides[k].name for k in order)]
    return section.add(Table("Entries that differ", columns, [[Run(key, "mono"), *(values[k] for k in order)] for key, values in told]))
