"""A page as a PDF: the same tree as the HTML, on A4 sheets."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry import __version__
from pixmetry.report.drawing import BLUE, RED, SOFT
from pixmetry.report.page import Answer, Figure, Page, Points, Reading, Run, Section, Table, Text, runs_of, strong
from pixmetry.report.paper import BOTTOM, HEIGHT_PT, INNER, LEAD, LEFT, TOP, Paper, lines_of, paper, run_width

if TYPE_CHECKING:
    from matplotlib.artist import Artist

TEXT, SMALL, CAPTION, INDENT = 7.5, 6.8, 6.6, 12.0  # type sizes in points, and how far a list stands in
GAP, WIDE_IN = 12.0, 5.0  # points between two figures; inches, from which a figure takes the width of the sheet
LEAST_FIGURE = 100.0  # points, below which no figure is made lower to fit
MOST_ROWS = 60  # of a table that a screen folds away
SHRINK = (1.0, 0.95, 0.9, 0.8, 0.72, 0.65, 0.58)
TIGHT = 1.32  # lead of the tables of a section that is to fit one sheet
PANEL = "#f4f6f8"


def pdf_of(page: Page) -> bytes:
    """Return a page as the bytes of a PDF.

    Parameters
    ----------
    page : Page

    Returns
    -------
    bytes
        The same for the same page.
    """
    with paper() as sheets:
        lay_out(page, sheets)
        return sheets.to_bytes({"Title": page.title, "Subject": page.lead})


def write_pdf(page: Page, path: str | Path) -> Path:
    """Write a page as a PDF and return its path; an existing file is replaced."""
    target = Path(path)
    target.write_bytes(pdf_of(page))
    return target


def lay_out(page: Page, sheets: Paper) -> None:
    """Fill empty paper with a page."""
    sheets.paragraph(page.lead, TEXT, space=0, color=SOFT)
    sheets.paragraph(strong(page.name), 14, space=4)
    if page.facts:
        sheets.rule()
        sheets.y += 4
        sheets.facts(page.facts)
    for number, section in enumerate(page.sections, 1):
        if section.is_sheet:
            if sheets.y > HEIGHT_PT / 3:
                sheets.new_page()
            _section(sheets, section, number, _shrink(sheets, section, number))
            if number < len(page.sections):
                sheets.new_page()
        else:
            sheets.y += 6 if sheets.y > TOP else 0
            _section(sheets, section, number)
    if page.footer:
        sheets.y += 4
        sheets.paragraph(page.footer, SMALL, color=SOFT)
    sheets.finish(f"{page.title} · pixmetry {__version__}")


def _shrink(sheets: Paper, section: Section, number: int) -> float:
    """By how much the figures of a section are made lower, so that it fits on what is left of its sheet, if it can."""
    for shrink in SHRINK:
        trial = Paper([], 0.0)
        trial.new_page()
        trial.y = sheets.y
        _section(trial, section, number, shrink)
        if len(trial.figures) == 1:
            return shrink
    return 1.0


def _section(sheets: Paper, section: Section, number: int, shrink: float = 1.0) -> None:
    sheets.heading([Run(f"{number}  ", "strong"), *runs_of(section.title)], keep=_keep(section))
    _parts(sheets, section.parts, 0, False, shrink)


def _keep(section: Section) -> float:
    """Points that have to be free under a heading for what follows it, rather than that a sheet ends with it."""
    first = section.parts[:2]
    return 190.0 if any(isinstance(part, Figure) for part in first) else 60.0 if first else 10.0


def _parts(sheets: Paper, parts: Sequence[Any], depth: int, folded: bool, shrink: float) -> None:
    for kind, group in groupby(parts, lambda part: type(part).__name__):
        if kind == "Figure":
            _figures(sheets, list(group), shrink)
            continue
        for part in group:
            if kind == "Section":
                sheets.heading(part.title, 9.0 - 0.8 * min(depth, 1), keep=_keep(part))
                _parts(sheets, part.parts, depth + 1, folded or part.fold, shrink)
            elif kind == "Table":
                _table(sheets, part, folded, LEAD if shrink == 1 else TIGHT)
            else:
                _MAKE[kind](sheets, part)


def _text(sheets: Paper, text: Text) -> None:
    if "hint" not in text.style:
        sheets.paragraph(text.content, SMALL if "small" in text.style else TEXT, **_colour(text.style))


def _colour(style: str) -> dict[str, Any]:
    return {"color": SOFT} if "soft" in style.split() else {}


def _points(sheets: Paper, points: Points) -> None:
    for k, item in enumerate(points.items, 1):
        sheets.need(1.35 * SMALL)
        sheets.put(LEFT, str(k) if points.numbered else "•", SMALL)
        sheets.paragraph(item, SMALL, x=LEFT + INDENT, width=INNER - INDENT, space=1)
    sheets.y += 3


def _finding(sheets: Paper, finding: Any) -> None:
    mark = {"warning": "Warning: ", "error": "Error: "}.get(finding.level, "")
    lines: list[tuple[list[Run], dict[str, Any]]] = [(line, {}) for line in lines_of([strong(mark), finding.text], INNER - INDENT, TEXT)]
    if finding.advice:
        lines += [(line, {"color": SOFT}) for line in lines_of([strong("To do: "), finding.advice], INNER - INDENT, TEXT)]
    height = 1.35 * TEXT * len(lines)
    sheets.need(height + 4)
    _bar(sheets, RED if mark else SOFT, height)
    for line, colour in lines:
        sheets.put(LEFT + INDENT, line, TEXT, **colour)
        sheets.y += 1.35 * TEXT
    sheets.y += 5


def _bar(sheets: Paper, colour: str, height: float, ground: str = "") -> None:
    """An upright bar at the left margin, and where asked a ground behind what stands there."""
    from matplotlib.patches import Rectangle

    wide, bottom = sheets.to_share(LEFT, height)
    for width, face in (((INNER, ground),) if ground else ()) + ((2.5, colour),):
        sheets.figures[-1].add_artist(
            Rectangle((wide, bottom), sheets.to_share(width, 0)[0], height / HEIGHT_PT, facecolor=face, edgecolor="none", zorder=-1)
        )


def _answer(sheets: Paper, answer: Answer) -> None:
    """The panel at the top: measured first, for its ground lies behind it."""
    rows: list[tuple[float, list[tuple[float, list[Run], float]]]] = []  # height; and x, words, size of what stands in it
    width = INNER - 2 * INDENT
    for part in answer.parts:
        if isinstance(part, Text):
            rows += [(1.35 * TEXT, [(0.0, line, TEXT)]) for line in lines_of(part.content, width, TEXT)]
            continue
        row: list[tuple[float, list[Run], float]] = []
        x = 0.0
        for reading in part:
            pieces = _pieces(reading)
            across = sum(w for _, _, w in pieces)
            if row and x + across > width:
                rows.append((20.0, row))
                row, x = [], 0.0
            for run, size, w in pieces:
                row.append((x, [run], size))
                x += w
            x += 22.0
        rows.append((20.0, row))
    height = sum(h for h, _ in rows) + 10
    sheets.need(height + 6)
    _bar(sheets, BLUE, height, PANEL)
    sheets.y += 4
    for h, row in rows:
        for x, line, size in row:
            sheets.put(LEFT + INDENT + x, line, size, down=0.72 * h - size if h > TEXT * 1.35 else 0.0)
        sheets.y += h
    sheets.y += 12


def _pieces(reading: Reading) -> list[tuple[Run, float, float]]:
    """Words of a reading with their size and width."""
    pieces = [(run, 8.0) for run in runs_of(reading.label)] + [(strong(reading.value), 14.0), (Run(reading.note, "soft"), 8.0)]
    shown = [(run, size) for run, size in pieces if run.text]
    last = len(runs_of(reading.label)) - 1
    return [(run, size, run_width(run, size) + (5.0 if k >= last else 0.0)) for k, (run, size) in enumerate(shown)]


def _table(sheets: Paper, table: Table, folded: bool, lead: float) -> None:
    if table.caption:
        sheets.paragraph(table.caption, SMALL, space=1, color=SOFT)
    more = len(table.rows) - MOST_ROWS if folded else 0
    if more > 0:
        sheets.table(Table(table.label, table.columns, table.rows[:MOST_ROWS]))
        sheets.paragraph(f"The HTML page has {more} more rows.", SMALL, color=SOFT)
    else:
        sheets.table(table, lead=lead)


def _figures(sheets: Paper, figures: Sequence[Figure], shrink: float) -> None:
    """Two figures side by side with titles and captions, row by row; a wide figure alone."""
    row: list[Figure] = []
    for figure in figures:
        if figure.drawing is None:
            continue
        if figure.drawing.get_figwidth() > WIDE_IN:
            _figure_row(sheets, row, INNER / 2 - GAP / 2, shrink)
            _figure_row(sheets, [figure], INNER, shrink)
            row = []
            continue
        row.append(figure)
        if len(row) == 2:
            _figure_row(sheets, row, (INNER - GAP) / 2, shrink)
            row = []
    _figure_row(sheets, row, (INNER - GAP) / 2, shrink)
    for figure in figures:
        if figure.drawing is None:
            sheets.paragraph([*runs_of(figure.title), ": ", *runs_of(figure.caption)], SMALL, space=1)


def _figure_row(sheets: Paper, row: Sequence[Figure], width: float, shrink: float) -> None:
    if not row:
        return
    titles = [lines_of([Run(run.text, run.style or "strong") for run in runs_of(f.title)], width, TEXT) if f.title else [] for f in row]
    captions = [lines_of(f.caption, width, CAPTION) for f in row]
    above = 1.3 * TEXT * max(len(lines) for lines in titles)
    below = 1.3 * CAPTION * max(len(lines) for lines in captions)
    most = HEIGHT_PT - TOP - BOTTOM - above - below - 4
    heights = [min(_height(f, width) * shrink, most) for f in row]
    height = max(heights)
    if height + above + below + 2 > sheets.left_over >= 0.85 * height + above + below + 2 and height > LEAST_FIGURE:
        less = (sheets.left_over - above - below - 3) / height  # rather a little lower than half a sheet left blank
        heights = [less * h for h in heights]
        height = max(heights)
    sheets.need(height + above + below + 2)
    for k, (figure, title, caption) in enumerate(zip(row, titles, captions, strict=True)):
        left = LEFT + k * (width + GAP)
        for n, line in enumerate(title):
            sheets.put(left, line, TEXT, down=1.3 * n * TEXT)
        bottom = HEIGHT_PT - sheets.y - above - heights[k]
        sheets.figures[-1].add_artist(_placed(figure.drawing, (left, bottom, width, heights[k])))
        for n, line in enumerate(caption):
            sheets.put(left, line, CAPTION, down=above + height + 2 + 1.3 * n * CAPTION)
    sheets.y += height + above + below + 10


def _height(figure: Figure, width: float) -> float:
    """Height of a figure that is that wide, in points."""
    if figure.drawing is None:
        return 0.0
    across, up = figure.drawing.get_size_inches()
    return float(width * up / across)


def _placed(drawing: Any, box_pt: tuple[float, float, float, float]) -> Artist:
    """What draws a figure into a box (left, bottom, width, height) of the sheet that it is added to, and leaves it as it was."""
    from matplotlib.artist import Artist
    from matplotlib.backends.backend_pdf import FigureCanvasPdf

    class Placed(Artist):
        def draw(self, renderer: Any) -> None:
            size, dpi, canvas, engine = drawing.get_size_inches().copy(), drawing.dpi, drawing.canvas, drawing.get_layout_engine()
            ground = drawing.patch.get_visible()
            left, bottom, width, height = (v / 72 for v in box_pt)
            owner = renderer.figure  # that of what it turns into pixels, whose resolution it changes meanwhile
            try:
                FigureCanvasPdf(drawing)
                drawing.dpi = 72
                drawing.set_size_inches(width, height)
                drawing.patch.set_visible(False)
                drawing.draw_without_rendering()  # finds room for the labels
                drawing.set_layout_engine("none")
                drawing.bbox_inches.set_points(np.array([[left, bottom], [left + width, bottom + height]]))
                renderer.figure = drawing
                drawing.draw(renderer)
            finally:
                renderer.figure = owner
                drawing.bbox_inches.set_points(np.array([[0.0, 0.0], size]))
                drawing.dpi = dpi
                drawing.patch.set_visible(ground)
                drawing.set_canvas(canvas)
                drawing.set_layout_engine(engine if engine is not None else "none")

    return Placed()


_MAKE: dict[str, Any] = {
    "Text": _text,
    "Points": _points,
    "Facts": lambda sheets, facts: sheets.facts(facts.pairs),
    "Answer": _answer,
    "Finding": _finding,
}
