"""The page of a data sheet of EMVA 1288: a summary that fits one sheet, all values, all plots."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

from pixmetry.emva.page import content
from pixmetry.report import Answer, Column, Figure, Page, Points, Reading, Row, Run, Section, Table, Text
from pixmetry.report.numbers import printed_number
from pixmetry.report.page import Inline
from pixmetry.report.provenance import provenance_section

if TYPE_CHECKING:
    from pixmetry.emva.page.figures import Plot
    from pixmetry.emva.records import DataSheet, Results

PLOT_HEIGHT_IN = 2.2
KIND = "EMVA 1288 data sheet"
FOOTER = (
    "Uncertainties are standard uncertainties (k = 1); they include the scatter of a repeated measurement of this camera, not the scatter "
    "between cameras of its type."
)
LIMITS = "Value ± standard uncertainty u (k = 1, two significant digits); “< x (95 %)” and “> x (95 %)” are one-sided 95 % limits."
VALUES = (
    "Standard uncertainty u (k = 1) with its degrees of freedom; “< x (95 %)” and “> x (95 %)” are one-sided limits. The clause is that of "
    "EMVA 1288 Release 4.0 Linear where it does not say otherwise. “Non-linearity taken into account” is the same quantity from a fit that "
    "includes the camera's curvature; its DSNU and PRNU have no high-pass, unlike those of Release 4.0, and include coarse patterns. The "
    "number of the method refers to the list below."
)
MORE = Text("The table continues to the right →", "hint")


def page_of(sheet: DataSheet) -> Page:
    """The page of a data sheet.

    Parameters
    ----------
    sheet : DataSheet

    Returns
    -------
    Page
    """
    channels, methods = sheet.results, content.methods_of(sheet)
    plots = [(r, all_plots(r)) for r in channels]
    lead = f"{KIND}, {content.release_title(channels[0].release)}"
    page = Page(str(sheet.camera.get("name", "Camera")), KIND, lead, content.facts(sheet), FOOTER)
    page.sections.append(_summary(sheet, [_figure(p, k) for k, p in enumerate(summary_plots(channels, plots))]))
    values = page.add_section("All values", Text(VALUES, "small soft"), name="values")
    for r in channels:
        parts = [MORE, _all_values(r, methods, len(channels) > 1)]
        values.add(*parts) if len(channels) == 1 else values.add_section(f"Channel {r.channel}", *parts)
    if methods:
        values.add_section("Methods", Points(methods, numbered=True))
    drawn = page.add_section("Plots", name="plots")
    for k, (r, every) in enumerate(plots, 1):
        for group, figures in _grouped(every, 100 * k):
            drawn.add_section(group if len(channels) == 1 else f"{r.channel}: {group}", *figures)
    if (origin := _origin(sheet)) is not None:
        page.sections.append(origin)
    return page


def _summary(sheet: DataSheet, figures: Sequence[Figure]) -> Section:
    channels = sheet.results
    section = Section("Summary", name="summary", is_sheet=True)
    if len(channels) == 1 and (readings := list(_readings(channels[0], content.headline_keys(channels)))):
        section.add(Answer([readings]))
    section.add(*(Text(line) for line in content.document_lines(channels)), Text(LIMITS, "small soft"))
    section.add(*([MORE] if len(channels) > 1 else []), _main_values(channels), *figures)
    if notes := content.notes_of(sheet):
        section.add_section("Notes", Points(notes))
    return section


def _readings(results: Results, keys: Iterable[str]) -> Iterator[Reading]:
    """The values that a reader looks for first, with their u."""
    for key in keys:
        value = results.values.get(key)
        if value is not None and value.value == value.value:
            number = printed_number(value)
            symbol = content.symbol_parts(content.describe(key, value.unit).symbol)
            yield Reading(_symbol(symbol), number.value, f"{number.u} {number.unit}")


def _symbol(parts: tuple[str, str], phone: bool = False) -> list[str | Run]:
    """A base with its subscript."""
    base, sub = parts
    more = " phone" if phone else ""
    return [Run(f" {base}" if phone else base, more.strip() or "sym"), Run(sub, "phone sub" if phone else "sub")]


def _titled(title: str, symbol: tuple[str, str], key: str = "") -> Inline:
    """A quantity's name, on narrow screens with its symbol, and its key."""
    below: list[str | Run] = ["\n", Run(key, "small mono")] if key else []
    return [title, *_symbol(symbol, phone=True), *below]


def _main_values(channels: Sequence[Results]) -> Table:
    columns = [Column("Quantity"), Column("Symbol", everywhere=False)]
    if len(channels) == 1:
        columns += [Column("Value", "right"), Column("± u", "u")]
    else:
        columns += [column for r in channels for column in (Column("", "right", group=r.channel), Column("", "u", group=r.channel))]
    rows = [
        [_titled(r.title, r.symbol), _symbol(r.symbol), *(text for c in r.cells for text in (c.value, c.u)), r.unit]
        for r in content.main_rows(channels, content.main_keys(channels))
    ]
    return Table("Main values", [*columns, Column("Unit", "unit")], rows)


def _all_values(results: Results, methods: Sequence[str], several: bool) -> Table:
    rows: list[Row] = []
    for heading, found in content.all_rows(results, methods).items():
        rows.append(Row([heading], heading=True))
        rows += [
            Row([_titled(r.title, r.symbol, r.key), _symbol(r.symbol), r.number, r.dof, r.nonlinear, r.clause, r.method], r.reason)
            for r in found
        ]
    columns = [
        Column("Quantity"),
        Column("Symbol", everywhere=False),
        Column("Value", "number"),
        Column("dof", "right"),
        Column("Non-linearity\ntaken into account", "unit"),
        Column("Clause", "unit"),
        Column("Method", "right"),
    ]
    return Table(f"All values of channel {results.channel}" if several else "All values", columns, rows)


def _origin(sheet: DataSheet) -> Section | None:
    inputs = sheet.provenance.get("inputs", ())
    files = [("Input files", f"{len(inputs)}, each with its SHA-256")] if inputs else []
    return provenance_section(sheet.provenance, sheet.licence, [("Release", content.release_title(sheet.results[0].release)), *files])


def all_plots(results: Results) -> list[Plot]:
    """Every plot of one channel, those that cannot be drawn with the sentence in their place."""
    from pixmetry.emva.page.plots import dark_and_general_plots, series_plots, spatial_plots

    return [*series_plots(results), *dark_and_general_plots(results), *spatial_plots(results)]


def summary_plots(channels: Sequence[Results], plots: Sequence[tuple[Results, Sequence[Plot]]]) -> list[Plot]:
    """Photon transfer and signal-to-noise ratio for the first page: of a colour camera all channels in one plot."""
    from pixmetry.emva.page.plots import snr_together, together

    if len(channels) == 1:
        return [p for p in plots[0][1] if p.draw is not None and p.title in ("Photon transfer", "Signal-to-noise ratio")]
    every = (("PTC", together), ("SNR", snr_together))
    return [make(having) for curve, make in every if (having := [r for r in channels if r.curves.get(curve)])]


def _grouped(plots: Sequence[Plot], first: int) -> Iterator[tuple[str, list[Figure]]]:
    """Figures by group, in the order of the plots; ``first`` numbers them through the page."""
    numbered = sorted(enumerate(plots, first), key=lambda pair: [p.group for p in plots].index(pair[1].group))
    for group, members in groupby(numbered, lambda pair: pair[1].group):
        yield group, [_figure(plot, number) for number, plot in members]


def _figure(plot: Plot, number: int) -> Figure:
    from pixmetry.emva.page.figures import fill
    from pixmetry.report.drawing import WIDTH_IN, canvas

    if plot.draw is None:
        return Figure(None, f"p{number}", "", plot.caption, plot.title)
    with canvas(PLOT_HEIGHT_IN) as (figure, axes):
        figure.set_layout_engine("none")
        fill(plot, axes, (0, 0, WIDTH_IN, PLOT_HEIGHT_IN))
        return Figure(figure, f"p{number}", f"{plot.title}. {plot.alt}", plot.caption)
