"""A4 pages of text, tables and plots by matplotlib alone: vectors, text that can be selected, the same bytes every time."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from pixmetry.report.drawing import GRID, INK, SOFT, STYLE, own_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH_PT, HEIGHT_PT, POINTS = 595.28, 841.89, 72.0
LEFT, RIGHT, TOP, BOTTOM = 40.0, 40.0, 38.0, 42.0
INNER = WIDTH_PT - LEFT - RIGHT
KEY, KEY_GAP = 0.85, 4.0  # size of a key beside that of the text, and the points between them
PDF_STYLE: Any = STYLE | {"pdf.fonttype": 42, "pdf.compression": 9, "font.family": ["DejaVu Sans"]}


@dataclass(frozen=True)
class Column:
    """A column of a table: its width and heading, and at which side its text stands."""

    width: float
    heading: str
    right: bool = False


@dataclass(frozen=True)
class Cells:
    """A row of a table: a text, or base and subscript, for every column; a line of small print below, or a heading over all columns."""

    cells: tuple[str | tuple[str, str], ...]
    below: str = ""
    is_heading: bool = False
    key: str = ""  # small, behind the first text


@lru_cache(maxsize=4)
def _font(bold: bool) -> Any:
    from matplotlib.font_manager import FontProperties, findfont, get_font

    return get_font(findfont(FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal")))


def printable(text: str) -> str:
    """Text with a space for every kind of break, and the replacement sign for characters that the font has not."""
    marks = (" " if c in "\t\n\r" else c for c in text)
    return "".join(c if _font(False).get_char_index(ord(c)) else "\ufffd" for c in marks)


@lru_cache(maxsize=4096)
def _advance(character: str, bold: bool) -> float:
    """Width of one character in units of the type size."""
    font = _font(bold)
    font.set_size(1000, 72)
    return font.load_char(ord(character)).linearHoriAdvance / 65536 / 1000


def text_width(text: str, size: float, bold: bool = False) -> float:
    """Width of a line of text in points."""
    return size * sum(_advance(c, bold) for c in text)


def wrapped(text: str, width: float, size: float, bold: bool = False) -> list[str]:
    """Lines of a text that are no wider than ``width`` points; a word that is wider is cut."""
    lines, line = [], ""
    for word in printable(text).split(" "):
        longer = f"{line} {word}" if line else word
        if text_width(longer, size, bold) <= width:
            line = longer
            continue
        if line:
            lines.append(line)
        while text_width(word, size, bold) > width and len(word) > 1:
            cut = next(k for k in range(len(word) - 1, 0, -1) if k == 1 or text_width(word[:k], size, bold) <= width)
            lines.append(word[:cut])
            word = word[cut:]
        line = word
    return [*lines, line] if line or not lines else lines


@dataclass
class Paper:
    """Pages that are filled from top to bottom; ``y`` is how far down the last page is full, in points."""

    figures: list[Figure] = field(default_factory=list)
    y: float = TOP

    def new_page(self) -> None:
        """Begin a page."""
        from matplotlib.figure import Figure

        self.figures.append(Figure(figsize=(WIDTH_PT / POINTS, HEIGHT_PT / POINTS)))
        self.y = TOP

    @property
    def left_over(self) -> float:
        """Points that are free on this page."""
        return HEIGHT_PT - BOTTOM - self.y

    def need(self, height: float) -> None:
        """Begin a page if that much is not free."""
        if height > self.left_over:
            self.new_page()

    def put(self, x: float, text: str, size: float, *, down: float = 0.0, right: bool = False, **kw: Any) -> None:
        """One line of text, its baseline one size below the cursor and ``down`` more; x in points from the left edge."""
        if text:
            y = 1 - (self.y + down + size) / HEIGHT_PT
            style: Any = {"color": INK, "fontsize": size, "ha": "right" if right else "left", "parse_math": False} | kw
            self.figures[-1].text(x / WIDTH_PT, y, printable(text), **style)

    def put_symbol(self, x: float, symbol: tuple[str, str], size: float) -> None:
        """A base with its subscript."""
        self.put(x, symbol[0], size, down=0.2 * size)
        self.put(x + text_width(symbol[0], size) + 0.3, symbol[1], 0.76 * size, down=0.56 * size)

    def rule(self, colour: str = GRID, width: float = 0.5, down: float = 0.0) -> None:
        """A line from margin to margin at the cursor."""
        from matplotlib.lines import Line2D

        y = 1 - (self.y + down) / HEIGHT_PT
        figure = self.figures[-1]
        figure.add_artist(Line2D([LEFT / WIDTH_PT, 1 - RIGHT / WIDTH_PT], [y, y], color=colour, linewidth=width))

    def paragraph(self, text: str, size: float = 7.5, *, x: float = LEFT, width: float = INNER, space: float = 3.0, **kw: Any) -> None:
        """Text over as many lines as it takes; its own line breaks stay."""
        bold = kw.get("fontweight") == "bold"
        for line in (line for part in text.splitlines() for line in wrapped(part, width, size, bold)):
            self.need(1.35 * size)
            self.put(x, line, size, **kw)
            self.y += 1.35 * size
        self.y += space

    def heading(self, text: str, size: float = 11.0, keep: float = 60.0) -> None:
        """A heading that stays with what follows it."""
        self.need(1.9 * size + keep)
        if size >= 10:
            self.rule(INK, 1.0)
            self.y += 4
        self.paragraph(text, size, fontweight="bold", space=0.25 * size)

    def facts(self, pairs: Sequence[tuple[str, str]], columns: int = 4, size: float = 7.2) -> None:
        """Labels with what they stand for, in a grid."""
        width = INNER / columns
        for first in range(0, len(pairs), columns):
            row = [(label, wrapped(text, width - 8, size)) for label, text in pairs[first : first + columns]]
            self.need(1.3 * size * (1 + max(len(lines) for _, lines in row)))
            for k, (label, lines) in enumerate(row):
                self.put(LEFT + k * width, label, size - 1.2, color=SOFT)
                for n, line in enumerate(lines, 1):
                    self.put(LEFT + k * width, line, size, down=n * 1.25 * size)
            self.y += 1.25 * size * (1 + max(len(lines) for _, lines in row)) + 3

    def table(self, columns: Sequence[Column], rows: Iterable[Cells], size: float = 7.0, lead: float = 1.62) -> None:
        """A table; its head is repeated on every page, and no row is parted."""
        self.need(4 * lead * size)
        self._table_head(columns, size, lead)
        for row in rows:
            pairs = [] if row.is_heading else zip(row.cells, columns, strict=True)
            cells = [wrapped(cell, column.width - 5, size) if isinstance(cell, str) else cell for cell, column in pairs]
            small = wrapped(row.below, INNER - 14, 0.88 * size) if row.below else []
            first = cells[0] if row.key else None
            if isinstance(first, list) and text_width(first[-1], size) + KEY_GAP + text_width(row.key, KEY * size) > columns[0].width - 5:
                first.append("")
            lines = max((len(c) for c in cells if isinstance(c, list)), default=1)
            height = (lead - 1.2 + 1.2 * lines + 1.12 * len(small)) * size
            if height + (2 * lead * size if row.is_heading else 0) > self.left_over:
                self.new_page()
                self._table_head(columns, size, lead)
            self._table_row(columns, row, cells, size)
            for n, line in enumerate(small):
                self.put(LEFT + 10, line, 0.88 * size, down=(lead - 1.2 + 1.2 * lines - 0.1 + 1.12 * n) * size, color=SOFT)
            self.y += height
            self.rule()

    def _table_head(self, columns: Sequence[Column], size: float, lead: float) -> None:
        x = LEFT
        for column in columns:
            self.put(x + (column.width - 5 if column.right else 0), column.heading, size, right=column.right, fontweight="bold")
            x += column.width
        self.y += lead * size
        self.rule(INK, 0.7)

    def _table_row(self, columns: Sequence[Column], row: Cells, cells: list, size: float) -> None:
        if row.is_heading:
            self.put(LEFT, str(row.cells[0]), size, down=0.35 * size, fontweight="bold")
        if row.key:
            last = cells[0][-1]
            behind = text_width(last, size) + KEY_GAP if last else 0.0
            down = (0.2 + 1.2 * (len(cells[0]) - 1) + 1 - KEY) * size  # on the same base line
            self.put(LEFT + behind, row.key, KEY * size, down=down, color=SOFT)
        x = LEFT
        for column, cell in zip(columns, cells, strict=False):
            if isinstance(cell, tuple):
                self.put_symbol(x, cell, size)
            else:
                for n, line in enumerate(cell):
                    self.put(x + (column.width - 5 if column.right else 0), line, size, down=(0.2 + 1.2 * n) * size, right=column.right)
            x += column.width

    def finish(self, footer: str) -> None:
        """Footers, once the number of pages is known."""
        y = 1 - (HEIGHT_PT - BOTTOM + 18) / HEIGHT_PT
        for k, figure in enumerate(self.figures, 1):
            figure.text(LEFT / WIDTH_PT, y, printable(footer), fontsize=6.2, color=SOFT, parse_math=False)
            figure.text(1 - RIGHT / WIDTH_PT, y, f"{k} / {len(self.figures)}", fontsize=6.2, color=SOFT, ha="right")

    def to_bytes(self, metadata: dict[str, str]) -> bytes:
        """All pages as one PDF."""
        from matplotlib.backends.backend_pdf import PdfPages

        raw = io.BytesIO()
        with PdfPages(raw, metadata=metadata | {"CreationDate": None, "Creator": "pixmetry", "Producer": None}) as pdf:
            for figure in self.figures:
                pdf.savefig(figure)
        return raw.getvalue()


@contextmanager
def paper() -> Iterator[Paper]:
    """Empty paper in the report's style, with its first page begun."""
    with own_style(PDF_STYLE):
        sheet = Paper()
        sheet.new_page()
        yield sheet
