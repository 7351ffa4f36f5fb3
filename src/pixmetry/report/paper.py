"""A4 sheets of text, tables and figures by matplotlib alone: vectors, text that can be selected, the same bytes every time."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import groupby
from typing import TYPE_CHECKING, Any

from pixmetry.report.drawing import GRID, INK, SOFT, STYLE, own_style
from pixmetry.report.page import Column, Inline, Row, Run, Table, runs_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Sheet

WIDTH_PT, HEIGHT_PT, POINTS = 595.28, 841.89, 72.0
LEFT, RIGHT, TOP, BOTTOM = 36.0, 36.0, 36.0, 42.0
INNER = WIDTH_PT - LEFT - RIGHT
PAD, LEAST_SIZE = 5.0, 4.6  # points between columns; the smallest type of a table that is too wide
LEAD, LINE, NOTE = 1.62, 1.2, 0.88  # of a table in its type size: a row of one line, every further line, its small print
ROUNDING = 0.01  # points
AIR = 18.0  # points, by which the columns of a narrow table stand apart
WHOLE = 90.0  # points, up to which a number is not broken
PDF_STYLE: Any = STYLE | {"pdf.fonttype": 42, "pdf.compression": 9, "font.family": ["DejaVu Sans", "DejaVu Sans Mono"]}


@dataclass(frozen=True)
class Type:
    """Type of a style of words: face, size relative to the text, shift below the line, colour."""

    face: str = "normal"
    size: float = 1.0
    down: float = 0.0
    colour: str = INK


TYPES = {
    "": Type(),
    "strong": Type("bold"),
    "code": Type("mono", 0.92),
    "mono": Type("mono", 0.92),
    "soft": Type(colour=SOFT),
    "small": Type(size=0.85, colour=SOFT),
    "chip": Type(size=0.85, colour=SOFT),
    "sub": Type(size=0.76, down=0.28),
}


def type_of(style: str) -> Type:
    """How words of a style are set on paper; a style that only a screen knows is plain."""
    return TYPES.get(style.partition(" ")[0], TYPES[""])


def _family(face: str) -> dict[str, str]:
    return {"family": "DejaVu Sans Mono" if face == "mono" else "DejaVu Sans", "weight": "bold" if face == "bold" else "normal"}


@lru_cache(maxsize=4)
def _font(face: str) -> Any:
    from matplotlib.font_manager import FontProperties, findfont, get_font

    style: Any = _family(face)
    return get_font(findfont(FontProperties(**style)))


def printable(text: str) -> str:
    """Text with a space for every kind of break, and the replacement sign for characters that the font has not."""
    marks = (" " if c in "\t\n\r" else c for c in text)
    return "".join(c if _font("normal").get_char_index(ord(c)) else "\ufffd" for c in marks)


@lru_cache(maxsize=8192)
def _advance(character: str, face: str) -> float:
    """Width of one character in units of the type size."""
    font = _font(face)
    font.set_size(1000, 72)
    return float(font.load_char(ord(character)).linearHoriAdvance) / 65536 / 1000


def text_width(text: str, size: float, face: str = "normal") -> float:
    """Width of a line of text in points."""
    return size * sum(_advance(c, face) for c in text)


def run_width(run: Run, size: float) -> float:
    """Width of a run in text of this size, in points."""
    kind = type_of(run.style)
    return text_width(run.text, size * kind.size, kind.face)


def _words(content: Inline) -> Iterator[list[Run] | None]:
    """Words, each of runs that follow without a space; None where a line ends."""
    word: list[Run] = []
    for run in runs_of(content):
        if run.style.startswith("phone"):
            continue
        for k, line in enumerate(run.text.split("\n")):
            if k:
                yield word
                yield None
                word = []
            for n, piece in enumerate(printable(line).split(" ")):
                if n:
                    yield word
                    word = []
                if piece:
                    word = [*word, Run(piece, run.style)]
    yield word


def _cut(word: list[Run], width: float, size: float) -> tuple[list[Run], list[Run]]:
    """A word that is wider than a line: as many characters of it as fit, at least one, and the others."""
    taken: list[Run] = []
    left = width
    for k, run in enumerate(word):
        if run_width(run, size) <= left:
            taken.append(run)
            left -= run_width(run, size)
            continue
        n = 0
        while n < len(run.text) and run_width(Run(run.text[: n + 1], run.style), size) <= left:
            n += 1
        n = max(n, 0 if taken else 1)
        head, tail = ([Run(part, run.style)] if part else [] for part in (run.text[:n], run.text[n:]))
        return [*taken, *head], [*tail, *word[k + 1 :]]
    return taken, []


def lines_of(content: Inline, width: float, size: float) -> list[list[Run]]:
    """Lines that are no wider than ``width`` points; a word that is wider is cut."""
    lines: list[list[Run]] = []
    line: list[Run] = []
    used = 0.0
    for word in _words(content):
        if word is None:
            lines.append(line)
            line, used = [], 0.0
            continue
        space = [Run(" ", line[-1].style)] if line else []
        across = sum(run_width(run, size) for run in [*space, *word])
        if used + across <= width + ROUNDING:
            line, used = [*line, *space, *word], used + across
            continue
        if line:
            lines.append(line)
        while sum(run_width(run, size) for run in word) > width + ROUNDING and sum(len(run.text) for run in word) > 1:
            head, word = _cut(word, width, size)
            lines.append(head)
        line, used = word, sum(run_width(run, size) for run in word)
    if line or not lines:
        lines.append(line)
    return [[Run("".join(run.text for run in same), style) for style, same in groupby(line, lambda r: r.style)] for line in lines]


def wrapped(text: str, width: float, size: float) -> list[str]:
    """`lines_of` of plain words, as text."""
    return ["".join(run.text for run in line) for line in lines_of(text, width, size)]


@dataclass
class Paper:
    """Pages that are filled from top to bottom; ``y`` is how far down the last page is full, in points."""

    figures: list[Sheet] = field(default_factory=list)
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

    def to_share(self, x: float, height: float) -> tuple[float, float]:
        """Share of the sheet's width that is left of ``x`` points, and of its height that is below what is that high under the cursor."""
        return x / WIDTH_PT, 1 - (self.y + height) / HEIGHT_PT

    def put(self, x: float, content: Inline, size: float, *, down: float = 0.0, right: bool = False, **kw: Any) -> None:
        """One line of text, its baseline one size below the cursor and ``down`` more; x in points from the left edge, or the right end."""
        runs = runs_of(content)
        at = x - (sum(run_width(run, size) for run in runs) if right and len(runs) > 1 else 0.0)
        for run in runs:
            kind = type_of(run.style)
            y = 1 - (self.y + down + size * (1 + kind.down)) / HEIGHT_PT
            style: Any = {"color": kind.colour, "fontsize": size * kind.size, **_family(kind.face), "parse_math": False}
            style |= {"ha": "right" if right and len(runs) == 1 else "left"} | kw
            self.figures[-1].text(at / WIDTH_PT, y, printable(run.text), **style)
            at += run_width(run, size)

    def rule(self, colour: str = GRID, width: float = 0.5, down: float = 0.0, start: float = LEFT, end: float = WIDTH_PT - RIGHT) -> None:
        """A line at the cursor, from margin to margin or from ``start`` to ``end`` in points."""
        from matplotlib.lines import Line2D

        y = 1 - (self.y + down) / HEIGHT_PT
        self.figures[-1].add_artist(Line2D([start / WIDTH_PT, end / WIDTH_PT], [y, y], color=colour, linewidth=width))

    def paragraph(
        self, content: Inline, size: float = 7.5, *, x: float = LEFT, width: float = INNER, space: float = 3.0, **kw: Any
    ) -> None:
        """Text over as many lines as it takes; its own line breaks stay."""
        for line in lines_of(content, width, size):
            self.need(1.35 * size)
            self.put(x, line, size, **kw)
            self.y += 1.35 * size
        self.y += space

    def heading(self, content: Inline, size: float = 11.0, keep: float = 60.0) -> None:
        """A heading that stays with what follows it."""
        self.need(1.9 * size + keep)
        if size >= 10:
            self.rule(INK, 1.0)
            self.y += 4
        bold = [Run(run.text, run.style or "strong") for run in runs_of(content)]
        self.paragraph(bold, size, space=0.25 * size)

    def facts(self, pairs: Sequence[tuple[str, str]], columns: int = 5, size: float = 7.2) -> None:
        """Labels with their values, in a grid."""
        width = INNER / columns
        for first in range(0, len(pairs), columns):
            row = [(label, lines_of(text, width - 8, size)) for label, text in pairs[first : first + columns]]
            self.need(1.3 * size * (1 + max(len(lines) for _, lines in row)))
            for k, (label, lines) in enumerate(row):
                self.put(LEFT + k * width, label, size - 1.2, color=SOFT)
                for n, line in enumerate(lines, 1):
                    self.put(LEFT + k * width, line, size, down=n * 1.25 * size)
            self.y += 1.25 * size * (1 + max(len(lines) for _, lines in row)) + 3

    def table(self, table: Table, size: float = 6.8, lead: float = LEAD) -> None:
        """A table; its head is repeated on every sheet, and no row is parted."""
        columns, rows = table.flat()
        widths, size = _widths(columns, rows, size)
        laid = _Laid(columns, widths, size)
        self.need(laid.head_height() + 2 * lead * size)
        self._head(laid)
        for row in rows:
            cells = [] if row.heading else laid.lines(row)
            small = lines_of(row.note, INNER - 14, NOTE * size) if runs_of(row.note) else []
            count = max((len(c) for c in cells), default=1)
            height = (lead - LINE + LINE * count + 1.12 * len(small)) * size
            if height + (2 * lead * size if row.heading else 0) > self.left_over:
                self.new_page()
                self._head(laid)
            if row.total:
                self.rule(INK, 0.7)
            if row.heading:
                self.put(LEFT, [Run(run.text, "strong") for run in runs_of(row.cells[0])], size, down=(lead - 1.27) * size)
            for x, column, lines in zip(laid.places(), columns, cells, strict=False):
                for n, line in enumerate(lines):
                    shown = [Run(run.text, run.style or "strong") for run in line] if row.total else line
                    self.put(x, shown, size, down=(lead - 1.42 + LINE * n) * size, right=column.align == "right")
            for n, line in enumerate(small):
                self.put(LEFT + 10, line, NOTE * size, down=(lead - LINE + LINE * count - 0.1 + 1.12 * n) * size, color=SOFT)
            self.y += height
            self.rule()
        self.y += 5

    def _head(self, laid: _Laid) -> None:
        size, height = laid.size, laid.head_height()
        for (x, width), text in laid.groups():
            self.put(x, text, size)
            self.rule(GRID, 0.5, LEAD * size, x, x + width)
        for x, column, lines in zip(laid.places(), laid.columns, laid.heads(), strict=True):
            for n, line in enumerate(reversed(lines), 1):
                self.put(x, line, size, down=height - (LEAD + LINE * (n - 1)) * size, right=column.align == "right")
        self.y += height
        self.rule(INK, 0.7)

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


@dataclass(frozen=True)
class _Laid:
    """Columns of a table with their widths, and the size of its type."""

    columns: Sequence[Column]
    widths: Sequence[float]
    size: float

    def lefts(self) -> list[float]:
        """Left ends, in points from the edge of the sheet."""
        return [LEFT + sum(self.widths[:k]) for k in range(len(self.widths))]

    def places(self) -> list[float]:
        """Position of text: left-aligned, or right-aligned for numbers."""
        both = zip(self.lefts(), self.widths, self.columns, strict=True)
        return [left + (width - PAD if column.align == "right" else 0.0) for left, width, column in both]

    def lines(self, row: Row) -> list[list[list[Run]]]:
        """Lines of each cell."""
        return [lines_of(cell, width - PAD, self.size) for cell, width in zip(row.cells, self.widths, strict=True)]

    def heads(self) -> list[list[list[Run]]]:
        """Lines of each heading."""
        return [lines_of(Run(c.heading, "strong"), w - PAD, self.size) for c, w in zip(self.columns, self.widths, strict=True)]

    def groups(self) -> Iterator[tuple[tuple[float, float], Run]]:
        """Headings over several columns: left end and width, and the words."""
        lefts = self.lefts()
        for group, members in groupby(range(len(self.columns)), lambda k: self.columns[k].group):
            mine = list(members)
            if group:
                yield (lefts[mine[0]], sum(self.widths[k] for k in mine) - PAD), Run(group, "strong")

    def head_height(self) -> float:
        """Height of the headings, in points."""
        lines = LEAD + LINE * (max(len(lines) for lines in self.heads()) - 1)
        return self.size * (lines + (LEAD if any(c.group for c in self.columns) else 0.0))


def _widths(columns: Sequence[Column], rows: Sequence[Row], size: float) -> tuple[list[float], float]:
    """Widths of columns: as wide as their text where there is room, else shared by need; a table that is too wide gets smaller type."""

    def across(content: Inline) -> tuple[float, float]:
        """Width of the longest line, and of the longest word."""
        words = [0.0 if word is None else sum(run_width(run, size) for run in word) for word in _words(content)]
        lines = [sum(run_width(run, size) for run in line) for line in lines_of(content, 1e9, size)]
        return max(lines), max(words)

    wish, least, heads = [], [], []
    for k, column in enumerate(columns):
        cells = [across(row.cells[k]) for row in rows if not row.heading]
        head = across(Run(column.heading, "strong"))
        longest, word = (max((c[i] for c in cells), default=0.0) for i in (0, 1))
        whole = longest if column.align != "left" and longest < WHOLE else word
        least.append(max(whole, head[1]) + PAD)
        wish.append(max(longest, head[1]) + PAD)
        heads.append(max(longest, head[0]) + PAD)
    for group in {c.group for c in columns} - {""}:
        mine = [k for k, c in enumerate(columns) if c.group == group]
        short = across(Run(group, "strong"))[0] + PAD - sum(wish[k] for k in mine)
        for k in mine if short > 0 else ():
            wish[k] += short / len(mine)
            heads[k] = max(heads[k], wish[k])
    if sum(heads) <= INNER:
        wish = heads
    if sum(wish) <= INNER:
        between = min((INNER - sum(wish)) / len(wish), AIR)
        return [w + (between if c.align != "u" else 0.0) for w, c in zip(wish, [*columns[1:], Column("")], strict=True)], size
    if sum(least) > INNER:
        if size > LEAST_SIZE:
            return _widths(columns, rows, max(0.94 * size, LEAST_SIZE))
        return [w * INNER / sum(least) for w in least], size
    slack = (INNER - sum(least)) / (sum(wish) - sum(least))
    return [m + slack * (w - m) for m, w in zip(least, wish, strict=True)], size


@contextmanager
def paper() -> Iterator[Paper]:
    """Empty paper in the report's style, with its first page begun."""
    with own_style(PDF_STYLE):
        sheet = Paper()
        sheet.new_page()
        yield sheet
