"""Tables of text with a header (CSV, semicolons, tabs or blanks), read so that every mistake in them has a file and a line."""

from __future__ import annotations

import csv
import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pixmetry.core.checksums import check_file
from pixmetry.core.config import read_text
from pixmetry.core.errors import InputError
from pixmetry.core.plain_text import name_of

IGNORED = "-"  # a column of no interest, where columns are named in their order
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+")


@dataclass(frozen=True)
class Table:
    """Columns of text, and the line on which each row stands.

    Parameters
    ----------
    source : str
        The file, for messages.
    columns : dict of list of str
    lines : list of int
    """

    source: str
    columns: dict[str, list[str]]
    lines: list[int]

    def __len__(self) -> int:
        return len(self.lines)

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def where(self, row: int) -> str:
        """File and line of a row."""
        return f"{self.source}, line {self.lines[row]}"

    def spelled(self, *names: str) -> Table:
        """The same table, with columns of these names that were written in other upper and lower case."""
        lower = {name.lower(): name for name in names if name not in self.columns}
        renamed = {name: lower.pop(name.lower(), name) if name not in names else name for name in self.columns}
        return Table(self.source, {renamed[name]: values for name, values in self.columns.items()}, self.lines)

    def need(self, *names: str) -> None:
        """Refuse a table without these columns.

        Raises
        ------
        InputError
            If one is missing; it names what is there and what may have been meant.
        """
        missing = [name for name in names if name not in self.columns]
        if not missing:
            return
        others = [name for name in self.columns if name not in names]
        near = [name for name in others if missing[0].startswith(f"{name}_")] or difflib.get_close_matches(missing[0], others, 1, 0.5)
        meant = f"write `{missing[0]}` for `{near[0]}` in the header, or" if near else "name it in the header, or"
        raise InputError(
            f"column '{missing[0]}' is missing",
            where=self.source,
            value=", ".join(self.columns),
            allowed=f"a header with {', '.join(names)}",
            remedy=f"{meant} state under `columns:` of the project which column it is",
        )

    def texts(self, name: str) -> list[str]:
        """A column of names.

        Raises
        ------
        InputError
            If a name is empty.
        """
        values = self.columns[name]
        if "" in values:
            row = values.index("")
            raise InputError(f"'{name}' is empty", where=self.where(row), allowed="a name", remedy="name it, or delete the line")
        return values

    def numbers(self, name: str, *, empty: float | None = None, least: float = -np.inf, above: float = -np.inf) -> np.ndarray:
        """A column of finite numbers.

        Parameters
        ----------
        name : str
        empty : float, optional
            What an empty place stands for; None: it is a mistake.
        least, above : float
            What a number must not be below, and what it must be above.

        Raises
        ------
        InputError
            If a place holds something else.
        """
        texts = self.columns[name]
        if empty is not None and "" in texts:
            texts = [text or repr(empty) for text in texts]
        try:
            values = np.array(texts, dtype=float)
        except ValueError:
            row = next(i for i, text in enumerate(texts) if not _is_number(text))
            raise self._no_number(name, row) from None
        given = np.array([text != "" for text in self.columns[name]]) if empty is not None else np.ones(len(values), bool)
        bad = given & (~np.isfinite(values) | (values < least) | (values <= above))
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            limit = f" of at least {least:g}" if least > -np.inf else f" above {above:g}" if above > -np.inf else ""
            remedy = "correct it, or delete the line"
            what = f"'{name}' cannot be used"
            raise InputError(what, where=self.where(row), value=texts[row], allowed=f"a finite number{limit}", remedy=remedy)
        return values

    def _no_number(self, name: str, row: int) -> InputError:
        text = self.columns[name][row]
        remedy = "correct it, or delete the line"
        if _DECIMAL_COMMA.fullmatch(text):
            remedy = f"write the decimal point as a point: {text.replace(',', '.')}"
        what = f"'{name}' is empty" if text == "" else f"'{name}' is not a number"
        return InputError(what, where=self.where(row), value=text or None, allowed="a number", remedy=remedy)


def read_table(path: Path, columns: Sequence[str] | Mapping[str, str] | None = None) -> Table:
    """Read a table whose columns are parted by commas, semicolons, tabs or blanks; lines that begin with # are comments.

    A line that begins with # and no blank behind it, and has as many values as the header, may be a comment or a row whose first name
    begins with #: it is refused.

    Parameters
    ----------
    path : Path
    columns : sequence or mapping, optional
        The names of the columns in their order, for a file without a header (``-``: a column of no interest); or our names with
        those that the file's header has instead.

    Raises
    ------
    InputError
        If the file cannot be read, holds no row, a row has another number of values than the header, or may be a row or a comment; or if
        it is a table of a result and was changed since.
    """
    source = str(path)
    check_file(path)
    given = [(n, line) for n, line in enumerate(read_text(path).splitlines(), 1) if line.strip()]
    lines = [(n, line) for n, line in given if not line.lstrip().startswith("#")]
    if not lines:
        raise InputError("the table is empty", where=source, allowed="a header line, then one line a row", remedy="check the file")
    rows = _split(source, lines)
    _refuse_lost_rows(source, given, lines[0], len(rows[0][1]))
    if columns is None or isinstance(columns, Mapping):
        (line, header), rows = rows[0], rows[1:]
        header = _header(header, columns, f"{source}, line {line}")
    else:
        header = list(columns)
    if not rows:
        raise InputError("the table has a header, but no row", where=source, remedy="check the file")
    for line, row in rows:
        if len(row) != len(header):
            what = f"a row of {len(row)} values where the header names {len(header)}"
            remedy = "add what is missing, or put names with blanks or commas in quotes"
            if any(_DECIMAL_COMMA.fullmatch(value) for value in dict(lines)[line].split()):
                remedy = "write decimal points, not commas: commas separate the columns"
            raise InputError(what, where=f"{source}, line {line}", allowed=", ".join(header), remedy=remedy)
    values = zip(*(row for _, row in rows), strict=True)
    return Table(source, {name: list(v) for name, v in zip(header, values, strict=True) if name != IGNORED}, [n for n, _ in rows])


def inline_table(source: str, rows: Sequence[Mapping[str, object]], lines: Sequence[int]) -> Table:
    """A table of rows that stand in the project file itself."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    return Table(source, {name: ["" if row.get(name) is None else str(row[name]) for row in rows] for name in names}, list(lines))


def index_of_names(table: Table, column: str) -> dict[str, int]:
    """Row of each name.

    Raises
    ------
    InputError
        If a name is there twice.
    """
    rows: dict[str, int] = {}
    for row, name in enumerate(table.texts(column)):
        if rows.setdefault(name, row) != row:
            where = f"{table.source}, lines {table.lines[rows[name]]} and {table.lines[row]}"
            raise InputError(f"{column} '{name}' is listed twice", where=where, allowed="once", remedy="delete one of the two")
    return rows


def first_few(names: Iterable[str]) -> str:
    """The first few names."""
    all_names = list(names)
    return ", ".join(all_names[:6]) + (", …" if len(all_names) > 6 else "")


def _split(source: str, lines: Sequence[tuple[int, str]]) -> list[tuple[int, list[str]]]:
    """Each line's values; what parts them is told from the first line."""
    first = lines[0][1]
    parted_by = next((mark for mark in "\t;," if mark in first), None)
    if parted_by is None:
        return [(n, [value.strip('"') for value in line.split()]) for n, line in lines]
    try:
        rows, reader = [], csv.reader((line for _, line in lines), delimiter=parted_by, skipinitialspace=True)
        for row in reader:
            rows.append(row)
            if reader.line_num > len(rows):
                remedy = "close it on its line, or write two quotes for one in a name"
                raise InputError("a quote that is not closed", where=f"{source}, line {lines[len(rows) - 1][0]}", remedy=remedy)
    except csv.Error as problem:
        raise InputError(f"not a table of text ({problem})", where=source, remedy="check the file") from None
    return [(n, [name_of(value.strip()) for value in row]) for (n, _), row in zip(lines, rows, strict=True)]


def _refuse_lost_rows(source: str, given: Sequence[tuple[int, str]], first: tuple[int, str], width: int) -> None:
    """Refuse what would be left out as a comment although it has the form of a row."""
    for n, line in given:
        text = line.strip()
        if n > first[0] and re.match(r"#[^#\s]", text) and len(_split(source, [first, (n, text)])[1][1]) == width:
            remedy = f"put the name in quotes if it is a row, or write `# {text[1:10]}…`, with a blank, if it is a comment"
            raise InputError("a row whose name begins with #, or a comment", where=f"{source}, line {n}", value=text[:60], remedy=remedy)


def _header(found: list[str], columns: Mapping[str, str] | None, where: str) -> list[str]:
    """Names of the columns, with those of the project in place of the file's."""
    if any(_is_number(name) for name in found):
        raise InputError(
            "the table has no header",
            where=where,
            value=", ".join(found),
            allowed="names of the columns in the first line",
            remedy="write one, or name the columns in their order under `columns:` of the project",
        )
    for ours, theirs in (columns or {}).items():
        if theirs not in found:
            raise InputError(f"no column '{theirs}' to be '{ours}'", where=where, value=", ".join(found), remedy="correct `columns:`")
    renamed = {theirs: ours for ours, theirs in (columns or {}).items()}
    header = [renamed.get(name, name) for name in found]
    twice = next((name for name in header if name not in (IGNORED, "") and header.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"two columns are named '{twice}'", where=where, allowed="each name once", remedy="rename one of them")
    return header


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
