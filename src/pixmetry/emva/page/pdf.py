"""The data sheet of a test by EMVA 1288 as a PDF: a summary page, all values, all plots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pixmetry import __version__
from pixmetry.emva.page import content
from pixmetry.emva.page.facts import facts, provenance
from pixmetry.emva.page.page import all_plots, summary_plots
from pixmetry.report.paper import HEIGHT_PT, INNER, LEFT, POINTS, Cells, Column, Paper, paper, wrapped

if TYPE_CHECKING:
    from pixmetry.emva.page.figures import Plot
    from pixmetry.emva.records import DataSheet, Results

GAP_PT, CAPTION_PT, PLOT_PT = 14.0, 6.6, 145.0
LEAST_PLOT_PT = 115.0  # where the notes of the first page, or the foot of a page, need the room
NOTE_PT, POINT_INDENT = 6.8, 12
VALUE_COLUMNS = (
    *(Column(160, "Quantity, key"), Column(54, "Symbol"), Column(52, "Value", True), Column(47, "± u"), Column(46, "Unit")),
    *(Column(31, "dof", True), Column(72, "Nonlinear fit"), Column(34, "Clause"), Column(19.28, "M.", True)),
)


def render_pdf(sheet: DataSheet) -> bytes:
    """Return the data sheet as the bytes of a PDF."""
    name = _name(sheet)
    with paper() as pages:
        lay_out(sheet, pages)
        return pages.to_bytes({"Title": f"{name}: EMVA 1288 data sheet", "Subject": _release(sheet), "Keywords": "EMVA 1288"})


def lay_out(sheet: DataSheet, pages: Paper) -> None:
    """Fill empty paper with the data sheet."""
    channels = sheet.results
    plots = [(r, all_plots(r)) for r in channels]
    _summary(sheet, pages, summary_plots(channels, plots))
    pages.new_page()
    _values(sheet, pages)
    pages.y += 8
    pages.heading("3  Plots", keep=PLOT_PT + 40)
    for r, every in plots:
        if len(channels) > 1:
            pages.heading(f"Channel {r.channel}", 9.0, keep=PLOT_PT)
        for group in dict.fromkeys(p.group for p in every):
            _plots(pages, [p for p in every if p.draw is not None and p.group == group])
        _missing(pages, [p for p in every if p.draw is None])
    _provenance(sheet, pages)
    pages.finish(f"{_name(sheet)} · EMVA 1288 data sheet, {_release(sheet)} · pixmetry {__version__}")


def _name(sheet: DataSheet) -> str:
    return str(sheet.camera.get("name", "Camera"))


def _release(sheet: DataSheet) -> str:
    return content.release_title(sheet.results[0].release)


def _summary(sheet: DataSheet, pages: Paper, plots: Sequence[Plot]) -> None:
    channels = sheet.results
    pages.paragraph(f"EMVA 1288 data sheet, {_release(sheet)}", 7.5, space=0)
    pages.paragraph(_name(sheet), 14, fontweight="bold", space=4)
    pages.rule()
    pages.y += 4
    pages.facts(facts(sheet), columns=5)
    pages.heading("1  Summary")
    for line in content.document_lines(channels):
        pages.paragraph(line, space=1)
    words = "Value ± standard uncertainty u (k = 1, two significant digits); “< x (95 %)” and “> x (95 %)” are one-sided 95 % limits."
    pages.paragraph(words, 6.6, space=2)
    _main_table(pages, channels)
    pages.y += 6
    notes = content.notes_of(sheet)
    below = sum(1.35 * NOTE_PT * len(wrapped(note, INNER - POINT_INDENT, NOTE_PT)) + 1 for note in notes) + (16 if notes else 0)
    _plots(pages, plots, min(PLOT_PT, max(pages.left_over - below - 40, LEAST_PLOT_PT)))  # captions of three lines
    if notes:
        pages.heading("Notes", 8.0, keep=10)
        for note in notes:
            _point(pages, "•", note, NOTE_PT)


def _main_table(pages: Paper, channels: Sequence[Results]) -> None:
    rows = content.main_rows(channels, content.main_keys(channels))
    if len(channels) == 1:
        columns = [Column(215, "Quantity"), Column(85, "Symbol"), Column(75, "Value", True), Column(75, "± u"), Column(INNER - 450, "Unit")]
        cells = [Cells((r.title, r.symbol, r.cells[0].value, r.cells[0].u, r.unit)) for r in rows]
    else:
        width = (INNER - 240) / len(channels)
        columns = [Column(140, "Quantity"), Column(55, "Symbol"), *(Column(width, r.channel) for r in channels), Column(45, "Unit")]
        cells = [Cells((r.title, r.symbol, *(content.joined(c, with_unit=False) for c in r.cells), r.unit)) for r in rows]
    pages.table(columns, cells, 7.0 if len(channels) == 1 else 6.3, lead=1.5 if len(rows) <= 28 else 1.4)


def _values(sheet: DataSheet, pages: Paper) -> None:
    methods = content.methods_of(sheet)
    pages.heading("2  All values")
    words = (
        "Standard uncertainty u (k = 1) with its degrees of freedom; “< x (95 %)” and “> x (95 %)” are one-sided limits. The clause is "
        "that of EMVA 1288 Release 4.0 Linear where it does not say otherwise. “Nonlinear fit”: the same quantity from a fit that holds "
        "the camera's curvature; its DSNU and PRNU are not high-passed as those of Release 4.0 are, and hold coarse "
        "patterns too. M. is the number of the method in the list at the end."
    )
    pages.paragraph(words, 6.8)
    for r in sheet.results:
        if len(sheet.results) > 1:
            pages.heading(f"Channel {r.channel}", 9.0)
        rows: list[Cells] = []
        for title, found in content.all_rows(r, methods).items():
            rows.append(Cells((title,), is_heading=True))
            rows += [
                Cells(
                    (v.title, v.symbol, v.number.value, v.number.u, v.number.unit, v.dof, v.nonlinear, v.clause, v.method),
                    below=v.reason,
                    key=v.key,
                )
                for v in found
            ]
        pages.table(VALUE_COLUMNS, rows, 6.6)
        pages.y += 8
    if methods:
        pages.heading("Methods", 8.0, keep=20)
        for k, method in enumerate(methods, 1):
            _point(pages, str(k), method, NOTE_PT)


def _point(pages: Paper, mark: str, text: str, size: float) -> None:
    """A line of a list: the mark, then the text indented."""
    pages.need(1.35 * size)
    pages.put(LEFT, mark, size)
    pages.paragraph(text, size, x=LEFT + POINT_INDENT, width=INNER - POINT_INDENT, space=1)


def _plots(pages: Paper, plots: Sequence[Plot], height: float = PLOT_PT) -> None:
    """Two plots beside each other with their captions, row by row."""
    width = (INNER - GAP_PT) / 2
    for first in range(0, len(plots), 2):
        pair = plots[first : first + 2]
        captions = [wrapped(p.caption, width, CAPTION_PT) for p in pair]
        text = 1.3 * CAPTION_PT * max(len(lines) for lines in captions)
        free = pages.left_over - text - 2
        row = free if LEAST_PLOT_PT <= free < height else height  # rather a little lower than half a page left blank
        pages.need(row + text + 2)
        for k, (plot, lines) in enumerate(zip(pair, captions, strict=True)):
            left = LEFT + k * (width + GAP_PT)
            _draw(pages, plot, (left, HEIGHT_PT - pages.y - row, width, row))
            for n, line in enumerate(lines):
                pages.put(left, line, CAPTION_PT, down=row + 2 + 1.3 * n * CAPTION_PT)
        pages.y += row + text + 12


def _draw(pages: Paper, plot: Plot, box_pt: tuple[float, float, float, float]) -> None:
    from pixmetry.emva.page.figures import fill

    axes = pages.figures[-1].add_axes((0, 0, 1, 1))
    left, bottom, width, height = (v / POINTS for v in box_pt)
    fill(plot, axes, (left, bottom, width, height))


def _missing(pages: Paper, plots: Sequence[Plot]) -> None:
    for plot in plots:
        pages.paragraph(f"{plot.title}: {plot.caption}", 7.0, space=1)


def _provenance(sheet: DataSheet, pages: Paper) -> None:
    pages.y += 8
    pages.heading("4  Where this comes from")
    pairs = provenance(sheet)
    pages.facts([p for p in pairs if p[0] != "Command"], columns=4)
    for label, text in pairs:
        if label == "Command":
            pages.paragraph(f"Command: {text}", 7.0, space=1)
    if sheet.licence:
        lines = [line for line in f"Data: {sheet.licence}".splitlines() if line.strip()]
        pages.paragraph("\n".join(lines), 7.0, space=1)
    words = (
        "Uncertainties are standard uncertainties (k = 1) of a repeated measurement of this camera, not the scatter between cameras of "
        "its type."
    )
    pages.paragraph(words, 6.8)
