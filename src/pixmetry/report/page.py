"""The tree of a page: sections of text, tables, figures and findings, of which HTML and PDF are made.

Every job builds its page of these, and so can anyone::

    page = Page("Camera 7", "warm-up")
    section = page.add_section("What was seen")
    section.add_text("The centre drifts by a tenth of a pixel in the first hour.")
    section.add_table("Drift", ["Time / min", Column("x / px", "right")], [["10", "0.04"], ["60", "0.10"]])
    section.add_figure(figure, alt="Drift of x against time", caption="Drift of the centre.")
    write_html(page, "warm-up.html")
    write_pdf(page, "warm-up.pdf")
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from pixmetry.report.numbers import PrintedNumber, printed_number

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

LONG = 16  # rows, from which on a table that may do so scrolls on screen


@dataclass(frozen=True)
class Run:
    """Words in one style: ``strong``, ``code``, ``mono``, ``soft``, ``small``, ``sub``, ``chip``, or ``phone`` (on narrow screens only).

    A line break is ``\\n``.
    """

    text: str
    style: str = ""


Inline = str | Run | Sequence["str | Run"]


def runs_of(content: Inline) -> list[Run]:
    """Words as runs, without those that are empty."""
    parts = [content] if isinstance(content, str | Run) else content
    runs = [part if isinstance(part, Run) else Run(part) for part in parts]
    return [run for run in runs if run.text]


def plain(content: Inline) -> str:
    """The words alone."""
    return "".join(run.text for run in runs_of(content) if run.style != "phone")


def strong(text: str) -> Run:
    """Words in bold."""
    return Run(text, "strong")


@dataclass(frozen=True)
class Text:
    """A paragraph; ``style`` is ``small``, ``soft``, both, or ``hint`` (on narrow screens only)."""

    content: Inline
    style: str = ""


@dataclass(frozen=True)
class Points:
    """A list of sentences, numbered or not."""

    items: Sequence[Inline]
    numbered: bool = False
    style: str = "small"


@dataclass(frozen=True)
class Facts:
    """Labels with their values."""

    pairs: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Reading:
    """One number of an answer, in large type: label, number, and a note in small type."""

    label: Inline
    value: str
    note: str = ""


@dataclass(frozen=True)
class Answer:
    """The main result at the top of a page: sentences, and rows of readings."""

    parts: Sequence[Text | Sequence[Reading]]


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Parameters
    ----------
    heading : str
    align : str
        ``left``, ``right``, or ``number``: cells are a `Number`, or a `PrintedNumber`, and take columns for value, u and, without ``unit``,
        the unit.
    unit : str
        Of all its numbers; it stands in the heading.
    group : str
        Heading over all columns of the same group, which are neighbours.
    everywhere : bool
        Whether narrow screens show it too.
    """

    heading: str
    align: str = "left"
    unit: str = ""
    group: str = ""
    everywhere: bool = True


@dataclass(frozen=True)
class Row:
    """Cells of a table, a line of small print below; or a heading over all columns, or (``total``) a row that is set off."""

    cells: Sequence[Any]
    note: Inline = ""
    heading: bool = False
    total: bool = False


@dataclass(frozen=True)
class Table:
    """A table; the first cell of each row is its heading, ``label`` describes it for screen readers."""

    label: str
    columns: Sequence[Column | str]
    rows: Sequence[Row | Sequence[Any]]
    caption: str = ""
    scrolls: bool = False

    @property
    def is_long(self) -> bool:
        """Whether it has so many rows that it scrolls on screen."""
        return self.scrolls and len(self.rows) > LONG

    def flat(self) -> tuple[list[Column], list[Row]]:
        """Columns and rows with each number's value, u and unit in columns of their own."""
        columns = [Column(c) if isinstance(c, str) else c for c in self.columns]
        spread = [part for column in columns for part in _spread_column(column)]
        rows = [row if isinstance(row, Row) else Row(row) for row in self.rows]
        return spread, [row if row.heading else replace(row, cells=_spread_cells(columns, row.cells)) for row in rows]


def _spread_column(column: Column) -> list[Column]:
    heading = f"{column.heading} / {column.unit}" if column.unit else column.heading
    if column.align != "number":
        return [replace(column, heading=heading)]
    value, u = replace(column, heading=heading, align="right"), replace(column, heading="± u", align="u")
    return [value, u] if column.unit else [value, u, replace(column, heading="Unit", align="unit")]


def _spread_cells(columns: Sequence[Column], cells: Sequence[Any]) -> list[Inline]:
    out: list[Inline] = []
    for column, cell in zip(columns, cells, strict=True):
        if isinstance(cell, str | Run | tuple | list):
            out.append(cell)
            continue
        number = cell if isinstance(cell, PrintedNumber) else printed_number(cell)
        if column.align != "number":
            out.append(number.joined())
        else:
            out += [number.value, number.u] if column.unit else [number.value, number.u, number.unit]
    return out


@dataclass(frozen=True, eq=False)
class Figure:
    """A drawing by matplotlib, kept as such: HTML shows it as SVG, and a PDF draws the same into its sheet.

    Parameters
    ----------
    drawing : matplotlib Figure or None
        None where it could not be drawn: the caption then says why.
    name : str
        Unique on its page.
    alt : str
        What it shows, for those who do not see it.
    caption, title : str, `Run` or sequence of these
    """

    drawing: Drawing | None
    name: str
    alt: str = ""
    caption: Inline = ""
    title: Inline = ""

    @cached_property
    def svg(self) -> str:
        """Markup that takes its colours and its type from the page around it."""
        from pixmetry.report.drawing import svg_of

        return "" if self.drawing is None else svg_of(self.drawing, self.name, self.alt)


@dataclass
class Section:
    """A part of a page under a heading; figures that follow each other stand side by side.

    Parameters
    ----------
    title : str, `Run` or sequence of these
    parts : list
        Text, tables, figures, findings, further sections.
    name : str
        Of its place on the page; only a section of the page itself has one.
    fold : bool
        Whether a screen shows its title alone until asked.
    is_sheet : bool
        Whether paper gives it a sheet of its own, with figures as low as it takes.
    """

    title: Inline
    parts: list[Any] = field(default_factory=list)
    name: str = ""
    fold: bool = False
    is_sheet: bool = False

    def add(self, *parts: Any) -> Section:
        """Add parts as they are, without those that are None; every ``add`` but that of a section returns the section itself."""
        self.parts += [part for part in parts if part is not None]
        return self

    def add_text(self, *content: str | Run, style: str = "") -> Section:
        """Add a paragraph."""
        return self.add(Text(content, style))

    def add_table(self, label: str, columns: Sequence[Column | str], rows: Iterable[Any], **kw: Any) -> Section:
        """Add a table; ``kw`` as of `Table`."""
        return self.add(Table(label, columns, list(rows), **kw))

    def add_figure(self, drawing: Drawing, *, alt: str, caption: Inline = "", title: Inline = "", name: str = "") -> Section:
        """Add a figure of matplotlib; a name has to be its own on the page."""
        return self.add(Figure(drawing, name or f"figure-{id(drawing):x}", alt, caption, title))

    def add_finding(self, finding: Any) -> Section:
        """Add something that was found, with its advice."""
        return self.add(finding)

    def add_section(self, title: Inline, *parts: Any, **kw: Any) -> Section:
        """Add a section below this one and return it; ``kw`` as of `Section`."""
        part = Section(title, **kw).add(*parts)
        self.parts.append(part)
        return part


@dataclass
class Page:
    """A page: a name, what kind of page it is, facts in its head, sections.

    Parameters
    ----------
    name : str
        What it is about; the heading.
    kind : str
        Ends the title; only pages of the same kind replace each other on disk.
    lead : str
        Stands above the heading.
    facts : sequence of (str, str)
    footer : str
    """

    name: str
    kind: str = "report"
    lead: str = "pixmetry report"
    facts: Sequence[tuple[str, str]] = ()
    footer: str = ""
    sections: list[Section] = field(default_factory=list)

    @property
    def title(self) -> str:
        """Name and kind."""
        return f"{self.name}: {self.kind}"

    def add_section(self, title: Inline, *parts: Any, **kw: Any) -> Section:
        """Add a section and return it, to be filled; ``kw`` as of `Section`."""
        section = Section(title, **kw).add(*parts)
        self.sections.append(section)
        return section
