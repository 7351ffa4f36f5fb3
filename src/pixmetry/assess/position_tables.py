"""Tables of positions from any program: columns x and y found, everything else kept as it was written."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.calibrate.project.tables import Table, read_table
from pixmetry.core.config import read_text
from pixmetry.core.door import check_depth, one_sentence
from pixmetry.core.errors import InputError
from pixmetry.core.plain_text import cell, comment, name_of
from pixmetry.files.strict_json import json_text
from pixmetry.locate.records import LOCATED_SCHEMA, Located

CORRECTED = "corrected positions"  # how the comment of every table begins that is written here
MARKS = {  # how tables begin that are written here
    "csv": re.compile(rb"(?:# pixmetry [^\n]*\n)?# pixmetry corrected positions: "),
    "json": re.compile(rb'\s*\{\s*(?:"schema": "[^"]*",\s*)?"corrected": "'),
}
ORIGINS = {"first_pixel": 0.0, "corner": 0.5, "one": 1.0}  # what the centre of the top-left pixel is called
X_NAMES, Y_NAMES = ("x_px", "x"), ("y_px", "y")
# names of columns with the uncertainty, by what they hold; {} is the axis
VARIANCES = ("var_{}_px2", "var_{}")
DEVIATIONS = ("u_{}_px", "u_{}", "sigma_{}_px", "sigma_{}", "std_{}_px", "std_{}")
COVARIANCES = ("cov_xy_px2", "cov_xy")
LEAST_CORRELATION = 0.01  # a smaller one gets no column where the table has none for it
OTHER_FORMS = (".parquet", ".xlsx", ".xls", ".xml", ".yaml", ".yml", ".html", ".npy", ".tif", ".tiff", ".png")
OF_CORRECTION = ("correction_var_x_px2", "correction_cov_xy_px2", "correction_var_y_px2")  # of a table that says nothing of its own


@dataclass(frozen=True)
class Positions:
    """Positions of a table, and the table.

    Parameters
    ----------
    x_px, y_px : ndarray, shape (n,)
        From the centre of the top-left pixel; NaN where a row has none.
    covariance_px2 : ndarray, shape (n, 3), or None
        var x, cov xy, var y; None where the table does not tell them.
    columns : dict of list
        All columns, as they were.
    names : (str, str)
        Those with x and y.
    uncertainty : mapping of str to str
        Those with the uncertainty, and what they hold: ``var_x``, ``var_y``, ``u_x``, ``u_y`` or ``cov``.
    first : float
        What the centre of the top-left pixel is called in the table.
    form : str
        ``csv``, ``json``, or empty for arrays.
    comments : tuple of str
        Of a CSV file, with their ``#``.
    parted_by : str
        What parts its columns.
    lines : tuple of tuple of str
        What stands in each place of a CSV file, that of the header first.
    record : mapping
        Of a JSON file that is more than a list of rows.
    source : str
        The file, for messages.
    """

    x_px: np.ndarray
    y_px: np.ndarray
    covariance_px2: np.ndarray | None
    columns: Mapping[str, Sequence[Any]]
    names: tuple[str, str] = ("x_px", "y_px")
    uncertainty: Mapping[str, str] = field(default_factory=dict)
    first: float = 0.0
    form: str = ""
    comments: tuple[str, ...] = ()
    parted_by: str = ","
    lines: tuple[tuple[str, ...], ...] = ()
    record: Mapping[str, Any] = field(default_factory=dict)
    source: str = "positions"

    def __len__(self) -> int:
        return len(self.x_px)

    @property
    def corrected_before(self) -> frozenset[str]:
        """Names of the sources from which the table says that it was freed."""
        head = f"# pixmetry {CORRECTED}: "
        told = [line[len(head) :] for line in self.comments if line.startswith(head)] + [str(self.record.get("corrected", ""))]
        return frozenset(name for line in told if " corrected; " in line for name in line.partition(" corrected; ")[0].split(", "))

    def numbers(self, name: str) -> np.ndarray | None:
        """A column of numbers; None where there is no such column.

        Raises
        ------
        InputError
            If a value in it is none.
        """
        if name not in self.columns:
            return None
        values = _floats(self.columns[name], name, self.source)
        lost = np.flatnonzero(~np.isfinite(values) & np.isfinite(self.x_px))
        if len(lost):
            where = f"{self.source}, row {lost[0] + 1}"
            raise InputError(f"'{name}' has no value", where=where, allowed="a number in every row", remedy="fill it, or delete the column")
        return values

    def replaced(
        self, x_px: np.ndarray, y_px: np.ndarray, covariance_px2: np.ndarray | None, correction_px2: np.ndarray | None
    ) -> dict[str, Any]:
        """All columns with other positions; covariances in the columns that hold them, or those of the correction in new ones.

        A table with uncertainties but no column for the covariance of x and y gets one if a correlation is 0.01 or more.
        A row without a position stays as it is; one whose position is lost by the correction is empty there.
        """
        columns: dict[str, Any] = dict(self.columns)
        lost, none = ~(np.isfinite(x_px) & np.isfinite(y_px)), ~np.isfinite(self.x_px)

        def column(name: str, values: np.ndarray) -> list[Any]:
            old = self.columns.get(name, [None] * len(self))
            return [old[i] if none[i] else None if lost[i] else float(v) for i, v in enumerate(values)]

        for name, values in zip(self.names, (x_px, y_px), strict=True):
            columns[name] = column(name, values + self.first)
        new: dict[str, np.ndarray] = {}
        if covariance_px2 is None:
            new = {} if correction_px2 is None else dict(zip(OF_CORRECTION, correction_px2.T, strict=True))
        else:
            var_x, cov, var_y = covariance_px2.T
            of = {"var_x": var_x, "var_y": var_y, "u_x": np.sqrt(var_x), "u_y": np.sqrt(var_y), "cov": cov}
            new = {name: of[what] for name, what in self.uncertainty.items()}
            if "cov" not in self.uncertainty.values() and (np.abs(cov) > LEAST_CORRELATION * of["u_x"] * of["u_y"]).any():
                new[COVARIANCES[0]] = cov
        columns |= {name: column(name, values) for name, values in new.items()}
        return columns

    def content(self, columns: Mapping[str, Sequence[Any]], told: str) -> bytes:
        """The file with these columns, in the form in which it came; arrays as CSV. ``told`` says in a line what was done."""
        if self.form == "json":
            rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
            rest = {name: value for name, value in self.record.items() if name not in ("schema", "corrected")}
            before = "".join(f"; before: {text}" for text in [self.record.get("corrected")] if text)
            schema = {"schema": self.record["schema"]} if "schema" in self.record else {}
            return json_text({**schema, "corrected": told + before, **rest, "columns": list(columns), "targets": rows}).encode()
        text = io.StringIO()
        said = f"# pixmetry {CORRECTED}: {comment(told)}"
        first = self.comments[:1] if self.comments and self.comments[0].startswith("# pixmetry ") else ()
        for line in (*first, said, *self.comments[len(first) :]):
            text.write(f"{line}\n")
        if self.lines:
            text.writelines(f"{self.parted_by.join(line)}\n" for line in self._lines_with(columns))
        else:
            writer = csv.writer(text, lineterminator="\n", delimiter=self.parted_by)
            writer.writerow(columns)
            writer.writerows([[_written(v, self.parted_by) for v in row] for row in zip(*columns.values(), strict=True)])
        return text.getvalue().encode()

    def _lines_with(self, columns: Mapping[str, Sequence[Any]]) -> list[list[str]]:
        """What stands in each place of the file with these columns; what is not changed is as it was written."""
        head = [_read_cell(value, self.parted_by) for value in self.lines[0]]
        out = [list(line) for line in self.lines]
        for name, values in columns.items():
            own = self.columns.get(name)
            if own is None:
                out[0].append(_written(name, self.parted_by))
            for i, (line, value) in enumerate(zip(out[1:], values, strict=True)):
                if own is None:
                    line.append(str(_written(value, self.parted_by)))
                elif value is not own[i]:
                    line[head.index(name)] = str(_written(value, self.parted_by))
        return out


def form_of(path: Path) -> str:
    """The form of a table's file: ``json`` or ``csv``."""
    return "json" if path.suffix.lower() == ".json" else "csv"


def mark_of(form: str) -> re.Pattern[bytes]:
    """How a table in this form begins that was written here."""
    return MARKS[form or "csv"]


def check_form(path: Path, form: str) -> None:
    """Refuse a name that ends as that of a file of another form.

    Raises
    ------
    InputError
    """
    form = form or "csv"
    if form_of(path) != form or path.suffix.lower() in OTHER_FORMS:
        allowed = "a name that ends in .json" if form == "json" else "a name that ends in .csv, .txt or the like"
        raise InputError(f"the table is written as {form.upper()}", where=str(path), allowed=allowed, remedy="choose another name")


def read_positions(table: Any, *, x: str | None = None, y: str | None = None, origin: str = "first_pixel") -> Positions:
    """Positions of a file, of what `pixmetry.locate` returned, or of arrays.

    Parameters
    ----------
    table : path, Located, mapping of columns, or array_like of shape (n, 2)
    x, y : str, optional
        Names of the columns; by default ``x_px`` and ``y_px``, or ``x`` and ``y``, in upper or lower case.
    origin : {"first_pixel", "corner", "one"}
        What the table calls the centre of its top-left pixel: (0, 0), (0.5, 0.5) or (1, 1).

    Raises
    ------
    InputError
        If the file cannot be read, or has no such columns.
    """
    if origin not in ORIGINS:
        raise InputError("no such origin", where="origin", value=origin, allowed=", ".join(ORIGINS))
    if isinstance(table, str | Path):
        read = _of_json(Path(table)) if form_of(Path(table)) == "json" else _of_text(Path(table))
    elif isinstance(table, Located | Mapping):
        columns = table.columns if isinstance(table, Located) else table
        with one_sentence("no positions", "table", allowed="columns of one length by their names", remedy="check the argument"):
            lists = {name: np.atleast_1d(np.asarray(v)).tolist() for name, v in columns.items()}
        if not all(isinstance(name, str) for name in lists) or len({len(v) for v in lists.values()}) > 1:
            raise InputError("no positions", where="table", allowed="columns of one length by their names", remedy="check the argument")
        read = Positions(np.zeros(0), np.zeros(0), None, lists)
    else:
        with one_sentence("no positions", "table", allowed="a file, a table, or an array of shape (n, 2)", remedy="check the argument"):
            at = np.asarray(table, float)
        if at.ndim != 2 or at.shape[1] != 2:
            raise InputError(
                "no positions", where="table", value=f"shape {at.shape}", allowed="a file, a table, or an array of shape (n, 2)"
            )
        read = Positions(np.zeros(0), np.zeros(0), None, {"x_px": at[:, 0].tolist(), "y_px": at[:, 1].tolist()})
    return _found(read, x, y, ORIGINS[origin])


def _found(read: Positions, x: str | None, y: str | None, first: float) -> Positions:
    """The same with its positions and uncertainties."""
    names = tuple(_column(read, [asked] if asked else usual, axis) for asked, usual, axis in ((x, X_NAMES, "x"), (y, Y_NAMES, "y")))
    at = [_floats(read.columns[name], name, read.source) - first for name in names]
    lost = ~(np.isfinite(at[0]) & np.isfinite(at[1]))
    at = [np.where(lost, np.nan, v) for v in at]
    uncertainty, covariance = _uncertainty(read, lost)
    return replace(
        read, x_px=at[0], y_px=at[1], covariance_px2=covariance, names=(names[0], names[1]), uncertainty=uncertainty, first=first
    )


def _uncertainty(read: Positions, lost: np.ndarray) -> tuple[dict[str, str], np.ndarray | None]:
    """Columns with the uncertainty, and the covariance; variances count where a table has both."""
    pairs = [
        (kind, one, other)
        for kind, patterns in (("var", VARIANCES), ("u", DEVIATIONS))
        for one, other in zip(_named(patterns, "x"), _named(patterns, "y"), strict=True)
        if one in read.columns and other in read.columns
    ]
    if not pairs:
        return {}, None
    mixed = next((name for name in COVARIANCES if name in read.columns), None)
    kind, *pair = pairs[0]
    values = [_floats(read.columns[name], name, read.source) for name in (*pair, *([] if mixed is None else [mixed]))]
    covariance = np.zeros((len(lost), 3))
    for column, value in zip((0, 2, 1), values, strict=False):
        covariance[:, column] = value**2 if kind == "u" and column != 1 else value
    bad = np.flatnonzero((~np.isfinite(np.array(values)) | (np.array(values[:2]) < 0).any(axis=0)).any(axis=0) & ~lost)
    if len(bad):
        where = f"{read.source}, row {bad[0] + 1}"
        raise InputError(
            f"'{pair[0]}' and '{pair[1]}' hold no uncertainty", where=where, allowed="numbers of 0 or more", remedy="correct it"
        )
    beyond = np.flatnonzero((covariance[:, 1] ** 2 > covariance[:, 0] * covariance[:, 2] * (1 + 1e-6)) & ~lost)
    if len(beyond):
        where, allowed = (
            f"{read.source}, row {beyond[0] + 1}",
            f"at most the product of the standard uncertainties of '{' and '.join(pair)}'",
        )
        raise InputError(
            f"'{mixed}' is no covariance", where=where, value=float(covariance[beyond[0], 1]), allowed=allowed, remedy="correct it"
        )
    names = {name: f"{kind}_{axis}" for kind, *both in pairs for name, axis in zip(both, "xy", strict=True)}
    return names | ({} if mixed is None else {mixed: "cov"}), covariance


def _named(patterns: Sequence[str], axis: str) -> list[str]:
    return [pattern.format(axis) for pattern in patterns]


def _column(read: Positions, wanted: Sequence[str], axis: str) -> str:
    lower = {name.lower(): name for name in reversed(list(read.columns))}
    for name in wanted:
        if name in read.columns:
            return name
        if name.lower() in lower:
            return lower[name.lower()]
    remedy = f"say which column it is: --{axis} NAME (in Python {axis}=NAME)"
    raise InputError(f"no column with {axis}", where=read.source, value=", ".join(read.columns), allowed=" or ".join(wanted), remedy=remedy)


def _floats(values: Sequence[Any], name: str, source: str) -> np.ndarray:
    out = np.full(len(values), np.nan)
    for i, value in enumerate(values):
        if value is None or (isinstance(value, str) and value.strip().lower() in ("", "nan", "none", "na")):
            continue
        try:
            out[i] = float(value)
        except (TypeError, ValueError):
            remedy = "correct it, or leave the place empty"
            if isinstance(value, str) and re.fullmatch(r"[+-]?\d*,\d+", value.strip()):
                remedy = f"write the decimal point as a point: {value.strip().replace(',', '.')}"
            raise InputError(f"'{name}' is no number", where=f"{source}, row {i + 1}", value=value, remedy=remedy) from None
    return out


def _of_text(path: Path) -> Positions:
    if path.suffix.lower() == ".parquet":
        raise InputError("not a table of text", where=str(path), allowed="CSV or JSON", remedy="let `pixmetry locate` write CSV or JSON")
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    table: Table = read_table(path)
    comments = tuple(line for line in lines if line.lstrip().startswith("#"))
    rows = [line for line in lines if not line.lstrip().startswith("#")]
    parted_by = next((mark for mark in "\t;," if mark in rows[0]), " ")
    written = tuple(_cells(line, parted_by) for line in rows)
    nothing = np.zeros(0)
    return Positions(
        nothing, nothing, None, table.columns, form="csv", comments=comments, parted_by=parted_by, lines=written, source=str(path)
    )


def _cells(line: str, parted_by: str) -> tuple[str, ...]:
    """What stands in each place of a line, with its quotes and blanks."""
    if parted_by == " ":
        return tuple(line.split())
    mark = re.escape(parted_by)
    found, at = [], 0
    while at <= len(line):
        cell_ = re.compile(rf' *"(?:[^"]|"")*"[^{mark}]*|[^{mark}]*').match(line, at)
        assert cell_ is not None
        found.append(cell_[0])
        at = cell_.end() + 1
    return tuple(found)


def _read_cell(text: str, parted_by: str) -> str:
    """The value of a place of a file, as `read_table` has it."""
    if parted_by == " ":
        return text.strip('"')
    return name_of("".join(next(csv.reader([text], delimiter=parted_by, skipinitialspace=True))).strip())


def _of_json(path: Path) -> Positions:
    allowed = f"a table of `pixmetry locate` ({LOCATED_SCHEMA}), or a list of objects with x and y"
    try:
        record = json.loads(read_text(path))
    except (ValueError, RecursionError):
        raise InputError("is not JSON", where=str(path), allowed=allowed, remedy="check the file") from None
    check_depth(record, str(path))
    rows = record if isinstance(record, list) else record.get("targets") if isinstance(record, dict) else None
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
        raise InputError("no table of positions", where=str(path), allowed=allowed, remedy="check the file")
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: [row.get(name) for row in rows] for name in names}
    head = {} if isinstance(record, list) else record
    nothing = np.zeros(0)
    return Positions(nothing, nothing, None, columns, form="json", record=head, source=str(path))


def _written(value: Any, parted_by: str) -> Any:
    if parted_by == " " and value in (None, ""):
        return "nan"  # an empty place would shift those behind it
    if isinstance(value, str):
        return cell(value)
    return "" if value is None else f"{value:.10g}" if isinstance(value, float) else value
