"""The page of a fleet: how its values are spread, which cameras stand out, keep no limits, or drift."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.assess.judge.fleet import FAR_SPREADS, Drift, FleetReport, Odd
from pixmetry.core.plain_text import ends_of_paths
from pixmetry.emva.records import MONO
from pixmetry.report import Column, Page, Section
from pixmetry.report.drawing import BLUE, SOFT, canvas
from pixmetry.report.numbers import pretty_unit, printed_number, signed, significant

MOST_SHOWN = 30  # values in the figure
MOST_ROWS = 100  # of a table of single cameras; all are in the files
END = 8.0  # spreads at the ends of the figure


def page_of(found: FleetReport) -> Page:
    """The page of a fleet."""
    names = len(found.fleet.names)
    title = f"{names} cameras"
    footer = "u is a standard uncertainty (k = 1). All values are in the tables beside this page."
    page = Page(title, "fleet of cameras", "pixmetry fleet", [("Cameras", str(names)), ("Results", str(len(found.members)))], footer)
    page.sections += [_answer(found), _distribution(found), _odd(found)]
    page.sections += [part for part in (_limits(found), _drift(found)) if part is not None]
    if found.notes:
        page.sections.append(Section("Notes", name="notes").add_text(". ".join(found.notes) + "."))
    return page


def sentences(found: FleetReport) -> list[str]:
    """The result in a few sentences."""
    odd = {o.camera for o in found.odd}
    chance = f"{100 * (1 - found.fleet.level):.3g} %"
    said = [
        f"{len(found.fleet.names)} cameras, {len(found.fleet.rows)} values: "
        + (f"{len(odd)} cameras stand out" if odd else "no camera stands out")
        + f" (if all are alike, the chance that any does is at most {chance})."
    ]
    if odd:
        sure = len({o.camera for o in found.odd if o.is_sure})
        said.append(f"Of {sure} of them a value is beyond {FAR_SPREADS:g} spreads of the median with its guard band too.")
    if found.limits:
        count = {verdict: 0 for verdict in ("pass", "undecided", "fail")}
        for rows in found.limits.values():
            verdicts = {row.judgement.verdict for row in rows}
            count["fail" if "fail" in verdicts else "undecided" if "undecided" in verdicts else "pass"] += 1
        said.append(f"Limits: {count['pass']} cameras keep them, {count['fail']} do not, {count['undecided']} are undecided.")
    if found.drifts:
        drifting = {d.camera for d in found.drifts if d.drifts}
        cameras = len({d.camera for d in found.drifts})
        said.append(f"Over time: of {cameras} cameras with several results {len(drifting)} drift.")
    return said


def _answer(found: FleetReport) -> Section:
    section = Section("In short", name="answer")
    for sentence in sentences(found):
        section.add_text(sentence)
    return section


def named(channel: str, key: str) -> str:
    """The key, with its channel where there are several."""
    return key if channel == MONO else f"{key} [{channel}]"


def _distribution(found: FleetReport) -> Section:
    section = Section("How the values are spread", name="distribution")
    rows = sorted(found.fleet.rows, key=lambda r: -np.nanmax(np.abs([min(abs(s), 1e9) for s in r.scores])))
    shown = rows[:MOST_SHOWN]
    with canvas(0.8 + 0.2 * len(shown)) as (figure, axes):
        for k, row in enumerate(reversed(shown)):
            scores = np.clip(np.array(row.scores, float), -END, END)
            out = np.array(row.stands_out)
            axes.plot(scores[~out], np.full((~out).sum(), k), "|", color=SOFT, markersize=7)
            axes.plot(scores[out], np.full(out.sum(), k), "o", color=BLUE)
        axes.set_yticks(range(len(shown)), [named(row.channel, row.key) for row in reversed(shown)])
        axes.set_xlim(-END - 0.3, END + 0.3)
        axes.set_xlabel("distance from the median, spreads")
    caption = f"A mark a camera, a disc for one that stands out; at ±{END:g} are those farther away. The value with the farthest first."
    section.add_figure(figure, alt="Distances of the cameras from the median of each value", caption=caption, name="scores")
    columns: list[Column | str] = [
        "Value",
        Column("Unit"),
        *(Column(h, "right") for h in ("Median", "Spread", "u", "Least", "Most", "Cameras")),
    ]
    cells = []
    for row in rows:
        values = np.array(row.values, float)
        numbers = (row.median, row.spread, row.u, np.nanmin(values), np.nanmax(values))
        texts = [significant(float(v), n) for v, n in zip(numbers, (4, 2, 2, 4, 4), strict=True)]
        cells.append((named(row.channel, row.key), pretty_unit(row.unit), *texts, str(int(np.isfinite(values).sum()))))
    caption = (
        "Spread: standard deviation between cameras, from the nearest three quarters of them; at least u, the median of the uncertainties."
    )
    return section.add_table("Values of the fleet", columns, cells, caption=caption, scrolls=True)


def _odd(found: FleetReport) -> Section:
    section = Section("Cameras that stand out", name="odd")
    if not found.odd:
        return section.add_text("None.")
    short = dict(zip(found.fleet.names, ends_of_paths(found.fleet.names), strict=True))
    columns: list[Column | str] = [
        "Camera",
        "Value",
        Column("Measured"),
        Column("Median", "right"),
        Column("In spreads", "right"),
        "Beyond the band",
    ]
    rows = [_odd_row(odd, short[odd.camera]) for odd in found.odd[:MOST_ROWS]]
    caption = f"Band: median ± {FAR_SPREADS:g} spreads. “sure”: beyond it by its guard band too (95 %, JCGM 106, 8.3.3)."
    return section.add_table("Cameras that stand out", columns, rows, caption=caption, scrolls=True)


def _odd_row(odd: Odd, name: str) -> tuple[str, ...]:
    spreads = signed(odd.in_spreads, lambda x: f"{x:.1f}") if math.isfinite(odd.in_spreads) else "all others are equal"
    key, measured = named(odd.channel, odd.key), printed_number(odd.value).joined()
    return name, key, measured, significant(odd.median, 4), spreads, "sure" if odd.is_sure else "within its u"


def _limits(found: FleetReport) -> Section | None:
    broken = [(camera, row) for camera, rows in found.limits.items() for row in rows if row.judgement.verdict != "pass"]
    if not found.limits:
        return None
    section = Section("Limits", name="limits")
    if not broken:
        return section.add_text("All cameras keep all limits.")
    columns: list[Column | str] = [
        "Camera",
        "Value",
        Column("Measured"),
        Column("Limits", "right"),
        Column("Guard band", "right"),
        "Verdict",
    ]
    cells = []
    for camera, row in broken[:MOST_ROWS]:
        ends = " to ".join("" if math.isinf(v) else significant(v, 4) for v in (row.lower, row.upper))
        band = "" if math.isnan(row.judgement.guard_band) else significant(row.judgement.guard_band, 2)
        verdict = row.judgement.verdict + (f": {row.judgement.reason}" if row.judgement.reason else "")
        cells.append((camera, named(row.channel, row.key), printed_number(row.value).joined(), ends, band, verdict))
    return section.add_table("Limits that are not kept for sure", columns, cells, scrolls=True)


def _drift(found: FleetReport) -> Section | None:
    if not found.drifts:
        return None
    section = Section("Over time", name="drift")
    drifting = [d for d in found.drifts if d.drifts]
    if not drifting:
        return section.add_text("No value of any camera changes with time beyond its uncertainty.")
    columns: list[Column | str] = ["Camera", "Value", Column("Per year"), Column("Results", "right"), Column("Over", "right")]
    return section.add_table("Values that drift", columns, [_drift_cells(d) for d in drifting[:MOST_ROWS]], scrolls=True)


def _drift_cells(d: Drift) -> tuple[str, ...]:
    unit = f" {pretty_unit(d.unit)}" if d.unit not in ("", "1") else ""
    change = f"{signed(d.per_year, lambda x: significant(x, 3))} ± {significant(d.u_per_year, 2)}{unit}"
    return d.camera, named(d.channel, d.key), change, str(d.results), f"{significant(d.years, 2)} years"
