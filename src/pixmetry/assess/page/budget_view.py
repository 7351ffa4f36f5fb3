"""The budget on the page of an assessment: the answer, the largest contributions with advice, all sources, sum and check."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pixmetry.assess.page.figures import link_shares, pareto, target_picture
from pixmetry.budget.combine import Combined
from pixmetry.budget.monte_carlo import Crop, MonteCarlo
from pixmetry.budget.probe import phases_for
from pixmetry.budget.records import DECIDED, SUM, Budget, BudgetRow
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.contribution import UNSTEADY
from pixmetry.report import Answer, Column, Reading, Row, Run, Section, Table, Text, strong
from pixmetry.report.numbers import NO_BREAK, NONE, THIN, decimals_of, fixed, length_mpx, length_px, length_um, percent, signed
from pixmetry.report.page import Inline

CLASSES = {
    "T": "random in time, pixel by pixel",
    "Tr": "random in time, common to a row",
    "F": "fixed pattern",
    "G": "smooth geometry",
    "D": "drift",
    "O": "object and light",
}
CLASS_RULES = (
    "The class says what averaging does. T and Tr change from frame to frame: their variance falls as 1/n with n frames, and also with "
    "the number of targets. F is the same in every frame and differs between positions: more frames do not help, more targets do. "
    "G, D and O (smooth geometry, drift, object and light) fall with neither. Uncorrelated contributions add as squares, separately in x "
    "and y. A bias that is not corrected adds as its square, for any number of frames (JCGM 100:2008, 5.1.2 and F.2.4.5)."
)
NOT_HELD = (
    " Dark and evenly lit frames do not show the lens (distortion, blur, its change with focus and temperature), the geometry of sensor "
    "and mount (tilt, unflatness, expansion), or the object and its lighting. Their errors are additional; a calibration with targets "
    "measures them."
)
SOURCES = (
    "One target, one frame. The largest contributions first, then the accepted sources. “Row” is the row in the error table of a handbook "
    "of camera calibration, with its stars. Contributions are in thousandths of a pixel: root sum of squares of bias and uncertainty. {} "
    "“Known to” is the relative uncertainty of the analytic contribution that comes from the measured parameters. “Share” is the share of "
    "the squared total; for accepted sources, of the squared total with all accepted sources."
)
NAMED = 6  # accepted sources that the verdict names

Pitch = tuple[float, float] | None


def verdict_section(budget: Budget, crop: Crop | None = None) -> Section:
    """The answer: an interval, its standard uncertainty, the total after a calibration, and the totals for more frames."""
    pitch, one, every = budget.pitch_um, budget.verdict, budget.with_accepted[0]
    section = Section("Uncertainty of a coordinate", name="verdict")
    parts: list[Text | Sequence[Reading]] = []
    if budget.interval is not None:
        coverage = f"{100 * budget.interval.coverage:g} %"
        words = f"With a coverage of {coverage}, the position of one target in one frame is within these limits of its true position:"
        parts += [Text(words), _readings(budget.interval.half_px, pitch, "± ")]
    parts += [
        Text(
            "Standard uncertainty (k = 1) of one target in one frame, with everything that was measured or modelled, without calibration:"
        ),
        _readings((one.total_x_px, one.total_y_px), pitch),
        Text("and after a calibration, which removes errors that are constant or smooth over the frame:"),
        _readings((one.left_x_px, one.left_y_px), pitch),
        *([Text(budget.headline.why)] if budget.headline is not None and budget.headline.why else []),
        Text(_shares(budget.largest)),
        Text(_with_accepted(budget, every), "second"),
    ]
    places = f"Averaged over {(n := phases_for(budget.estimator))} × {n} sub-pixel positions of the target."
    target, estimator = budget.target.describe(), budget.estimator.describe()
    section.add(Answer(parts))
    section.add_text(strong("Target:"), f" {target}. ", strong("Estimator:"), f" {estimator}. {places}")
    section.add(None if crop is None else target_picture(crop, budget), link_shares(budget), pareto(budget))
    section.add(_ladder(budget))
    if pitch is None:
        words = " the pixel pitch of this camera was not given, so lengths are in pixels only. Add "
        keys = (Run("pitch_x_um", "code"), " and ", Run("pitch_y_um", "code"), " under ", Run("camera", "code"))
        section.add_text(strong("In µm:"), words, *keys, " in the campaign file and assess again.")
    return section.add_text(strong("Not included in this number."), NOT_HELD, style="soft")


def _um(value_px: float, pitch: Pitch, axis: str) -> str:
    return "" if pitch is None else f"{length_um(value_px, pitch['xy'.index(axis)])}{NO_BREAK}µm"


def _readings(pair: tuple[float, float], pitch: Pitch, sign: str = "") -> list[Reading]:
    return [
        Reading(axis, f"{sign}{length_px(v)} px" + (f" = {_um(v, pitch, axis)}" if pitch else ""))
        for axis, v in zip("xy", pair, strict=True)
    ]


def _cell(value_px: float, pitch: Pitch, axis: str, unit: str = "") -> Inline:
    """A length in px, and below it in µm where the pitch is known."""
    um = _um(value_px, pitch, axis)
    return [f"{length_px(value_px)}{unit}", *([Run(f"\n{um}", "small")] if um else [])]


def _text(value_px: float, pitch: Pitch) -> str:
    """A length that belongs to no axis; in µm only where the pitch is the same in both."""
    square = pitch is not None and pitch[0] == pitch[1]
    return f"{length_px(value_px)} px" + (f" = {length_um(value_px, pitch[0])} µm" if square and pitch else "")


def _with_accepted(budget: Budget, every: Combined) -> list[str | Run]:
    """What everything that was accepted would make of it, and which sources that is."""
    pitch = budget.pitch_um
    x, y = (
        f"{axis} {length_px(v)} px" + (f" = {_um(v, pitch, axis)}" if pitch else "")
        for axis, v in (("x", every.total_x_px), ("y", every.total_y_px))
    )
    left = f"(after a calibration x {length_px(every.left_x_px)} px, y {length_px(every.left_y_px)} px)"
    head = "With all sources that were accepted, not measured, at their bounds of the catalogue: "
    return [head, strong(x), ", ", strong(y), f" {left}. {_accepted(budget.accepted)}"]


def _ladder(budget: Budget) -> Table:
    pitch = budget.pitch_um
    rows: list[list[Inline]] = []
    for known, every in zip(budget.verdicts, budget.with_accepted, strict=True):
        pairs = ((known.total_x_px, known.total_y_px), (known.left_x_px, known.left_y_px), (every.total_x_px, every.total_y_px))
        cells = [_cell(v, pitch, axis) for pair in pairs for axis, v in zip("xy", pair, strict=True)]
        rows.append([f"{known.frames} frame{'' if known.frames == 1 else 's'}", *cells])
    groups = ("as it is", "calibrated", "with accepted")
    columns: list[Column | str] = ["Frames averaged", *(Column(f"{axis} / px", "right", group=group) for group in groups for axis in "xy")]
    caption = "More frames of the same target: random errors fall, fixed errors stay."
    return Table("Uncertainty for more frames", columns, rows, caption)


def _shares(rows: Sequence[BudgetRow]) -> str:
    """Shares of the squared total: parts in time, from place to place, smooth, constant, and drifting."""
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
    drifting = f"; {drift} % is drift, or belongs to the object, and is different in the next image" if parts[4] else ""
    return (
        f"Of the squared total, {random} % is random in time and falls with more frames. {place} % is fixed in the camera and differs "
        f"between positions. {smooth} % changes smoothly over the frame and {constant} % is constant; a calibration removes both{drifting}."
    )


def _accepted(rows: Sequence[BudgetRow]) -> str:
    if not rows:
        return "No source had to be accepted."
    names = ", ".join(r.title.lower() if not r.title[:2].isupper() else r.title for r in rows[:NAMED])
    more = f" and {len(rows) - NAMED} smaller" if len(rows) > NAMED else ""
    return f"This adds the largest value to be expected of a sound camera for {len(rows)} source{'s' * (len(rows) > 1)}: {names}{more}."


def largest_section(budget: Budget) -> Section:
    """The largest contributions with advice, and the largest accepted sources."""
    section = Section("The largest contributions, and what to do", name="largest")
    rows = {r.name: r for r in budget.rows}
    known = [a for a in budget.advice if a.status != "accepted"]
    for number, advice in enumerate(known, 1):
        row = rows[advice.name]
        part = section.add_section([f"{number}. {row.title} ", Run(_chip(row), "chip")])
        part.add_text(_sizes(row, budget.pitch_um), style="small").add_finding(advice.finding)
    if not known:
        section.add_text("No source contributes.")
    bounds = [a for a in budget.advice if a.status == "accepted"]
    if bounds:
        part = section.add_section("Accepted, not measured: what to measure first")
        part.add_text(
            "These count only in the total with all accepted sources, each at the largest value to be expected of a sound camera."
        )
        for advice in bounds:
            row = rows[advice.name]
            part.add_text(strong(row.title), " ", Run(_chip(row), "chip"), f" at most {_text(row.total_px, budget.pitch_um)}.")
            part.add_finding(advice.finding)
    return section


def _chip(row: BudgetRow) -> str:
    gum_class = row.part.gum_class
    return f"class {gum_class}: {CLASSES[gum_class]} · {'accepted at its bound' if row.status == 'accepted' else row.status}"


def _sizes(row: BudgetRow, pitch: Pitch) -> str:
    """Standard uncertainty and bias in x and in y."""

    def um(value: float, axis: str, text: str) -> str:
        return "" if pitch is None or text == "0" else f" ({signed(value * pitch['xy'.index(axis)], length_px).lstrip('+')}{NO_BREAK}µm)"

    c = row.part
    parts = []
    for axis, u, bias in (("x", c.u_x_px, c.bias_x_px), ("y", c.u_y_px, c.bias_y_px)):
        own, shift = length_px(u), signed(bias, length_px)
        parts.append(f"{axis}: u {own} px{um(u, axis, own)}, bias {shift} px{um(bias, axis, shift)}")
    return "; ".join(parts) + "."


def _monte_carlo_note(budget: Budget) -> str:
    done = next((r.monte_carlo for r in budget.rows if r.monte_carlo is not None), None)
    if done is None:
        return "There is no Monte Carlo."
    return (
        f"Monte Carlo with its standard error, for the sources of the simulated camera, from {done.trials} simulated windows for each "
        "source "
        f"({done.units} cameras of this type, {done.places} positions, {done.frames} frames each)."
    )


def sources_section(budget: Budget, unmeasured: Mapping[str, str]) -> Section:
    """All sources in the order of the budget; those that do not count are collapsed."""
    section = Section("All error sources", name="sources").add_text(SOURCES.format(_monte_carlo_note(budget)), style="small soft")
    counting = [r for r in budget.rows if r.counts]
    section.add(_source_table("Error sources that count", counting, unmeasured))
    if others := [r for r in budget.rows if not r.counts]:
        title = f"{len(others)} source{'s' if len(others) > 1 else ''} that {'do' if len(others) > 1 else 'does'} not count, and why"
        section.add_section(title, _source_table("Error sources that do not count", others, unmeasured), fold=True)
    return section


def _source_table(label: str, rows: Sequence[BudgetRow], unmeasured: Mapping[str, str]) -> Table:
    columns = ["Source", "Row", "Status", "Class"]
    numbers = [Column(axis, "right", group=group) for group in ("Analytic / 10⁻³ px", "Monte Carlo / 10⁻³ px") for axis in "xy"]
    return Table(label, [*columns, *numbers, Column("Known to", "right"), Column("Share", "right")], [_source(r, unmeasured) for r in rows])


def _source(row: BudgetRow, unmeasured: Mapping[str, str]) -> Row:
    source = get_source(row.source_id)
    c, mc = row.contribution, row.monte_carlo
    counts = c is not None and row.status not in ("not applicable", "left to calibration")
    name = row.name if row.name == row.source_id else f"{row.source_id} ({row.name})"
    cells: list[Inline] = [
        [row.title, "\n", Run(name, "small mono")],
        f"{source.number} {'★' * source.stars}".strip() if source.number else NONE,
        Run(row.status, f"status {row.status.replace(' ', '-')}"),
        c.gum_class if c is not None else source.gum_class,
        length_mpx(float(np.hypot(c.u_x_px, c.bias_x_px))) if counts and c else NONE,
        length_mpx(float(np.hypot(c.u_y_px, c.bias_y_px))) if counts and c else NONE,
        NONE if mc is None else _with_error(mc.x),
        NONE if mc is None else _with_error(mc.y),
        _known(row),
        f"{percent(row.share)} %" if counts else NONE,
    ]
    return Row(cells, _reason(row, unmeasured))


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
    """Why something is missing; empty if nothing is missing."""
    if row.status in DECIDED and row.contribution is not None:
        return ""
    return unmeasured.get(row.source_id, row.reason) if row.status == "accepted" else row.reason


def _known(row: BudgetRow) -> str:
    """Relative uncertainty of a measured contribution from the uncertainty of its parameters."""
    if row.u_of_total_px <= 0 or row.total_px <= 0:
        return ""
    share = row.u_of_total_px / row.total_px
    return f"± {percent(share)} %" if share <= 1 else f">{THIN}100 %"


def sum_section(budget: Budget) -> Section:
    """The sum of all contributions, one simulation of all sources, and how classes combine."""
    section = Section("The sum of the contributions, and one simulation of all sources", name="sum")
    columns: list[Column | str] = ["One target, one frame", Column("x", "right"), Column("y", "right")]
    section.add_table("Sum of the budget and Monte Carlo", columns, _sums(budget)).add_text(_interaction(budget))
    section.add_section("How classes combine", Text(CLASS_RULES))
    return section


def _sums(budget: Budget) -> list[Row]:
    pitch, v = budget.pitch_um, budget.sums[0] if budget.sums else budget.verdict
    px = f"{NO_BREAK}px"

    def row(label: str, x: float, y: float, total: bool = False) -> Row:
        return Row([label, _cell(x, pitch, "x", px), _cell(y, pitch, "y", px)], total=total)

    rows = [
        row("Standard uncertainties, analytic", v.u_x_px, v.u_y_px),
        row("Constant over the frame (bias), analytic", v.bias_x_px, v.bias_y_px),
        row("Sum of all measured and modelled, analytic", v.total_x_px, v.total_y_px, True),
        row("The same after a calibration", v.left_x_px, v.left_y_px, True),
    ]
    alone = [r.monte_carlo for r in budget.rows if r.monte_carlo is not None]
    if alone:
        rows.append(row("Each source alone by Monte Carlo, added", _sum_of(alone, "x"), _sum_of(alone, "y")))
    if budget.interaction is not None:
        together = [budget.interaction.together]
        rows.append(row("One Monte Carlo with all sources on", _sum_of(together, "x"), _sum_of(together, "y"), True))
    every = budget.with_accepted[0]
    return [*rows, row("The verdict, with all accepted sources at their bounds", every.total_x_px, every.total_y_px)]


def _sum_of(results: list[MonteCarlo], axis: str) -> float:
    return float(np.hypot(np.sqrt(sum(getattr(m, axis).u ** 2 for m in results)), sum(getattr(m, axis).bias for m in results)))


def _interaction(budget: Budget) -> str:
    """All sources at once compared with each source alone, and whether the difference is significant."""
    found, analytic_px = budget.interaction, (budget.sums[0] if budget.sums else budget.verdict).total_px
    if found is None:
        return "There is no Monte Carlo."
    difference, se = found.difference_px, found.se_px
    places = min(max(decimals_of(se, 2), 0), 6) if se > 0 else 6
    if abs(difference) <= 2 * se:
        verdict = "which is within two standard errors: no interaction is significant"
    elif difference > 0:
        verdict = "more than two standard errors: the sources interact"
    else:
        verdict = "below zero by more than two standard errors: the sources together are less than the sum of each alone"
    lost = f" In {found.together.lost} of {found.together.trials} windows no target was found." if found.together.lost else ""

    def px(value: float) -> str:
        return fixed(value, places)

    return (
        f"All sources at once give {px(found.together.total_px)} ± {px(found.together.se_total_px)} px (rms of x and y). The sum of "
        "each source "
        f"alone (scatter as squares, biases with their signs) is {px(found.sum_px)} ± {px(found.se_sum_px)} px. The interaction is the "
        f"difference, {px(difference)} ± {px(se)} px, {verdict}. The analytic sum is {px(analytic_px)} px.{lost}{_stands(budget)}"
    )


def _stands(budget: Budget) -> str:
    return "" if budget.headline is None else f" The verdict is that of {'the sum' if budget.headline.by == SUM else 'the Monte Carlo'}."
