"""Tables of positions from any program: columns x and y found, everything else kept as it was written."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.calibrate.project.tables import Table, read_table
from pixmetry.core.config import read_text
from pixmetry.core.errors import InputError
from pixmetry.core.plain_text import cell, comment
from pixmetry.files.strict_json import json_text
from pixmetry.locate.records import LOCATED_SCHEMA, Located

CORRECTED = "corrected positions"  # how the comment of every table begins that is written here
MARK = re.compile(rb"(?:# pixmetry pixmetry/located/|# pixmetry corrected positions|\s*\{\s*\"schema\": \"pixmetry/located/)")
ORIGINS = {"first_pixel": 0.0, "corner": 0.5, "one": 1.0}  # what the centre of the top-left pixel is called
X_NAMES, Y_NAMES = ("x_px", "x"), ("y_px", "y")
# names of columns with the uncertainty, by what they hold; {} is the axis
VARIANCES = ("var_{}_px2", "var_{}")
DEVIATIONS = ("u_{}_px", "u_{}", "sigma_{}_px", "sigma_{}", "std_{}_px", "std_{}")
COVARIANCES = ("cov_xy_px2", "cov_xy")
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
    uncertainty : tuple of str
        Those with the uncertainty: variances of x and y and the covariance, or the standard deviations; empty if there are none.
    first : float
        What the centre of the top-left pixel is called in the table.
    form : str
        ``csv``, ``json``, or empty for arrays.
    comments : tuple of str
        Of a CSV file, with their ``#``.
    parted_by : str
        What parts its columns.
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
    uncertainty: tuple[str, ...] = ()
    first: float = 0.0
    form: str = ""
    comments: tuple[str, ...] = ()
    parted_by: str = ","
    record: Mapping[str, Any] = field(default_factory=dict)
    source: str = "positions"

    def __len__(self) -> int:
        return len(self.x_px)

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
            deviations = bool(self.uncertainty) and self.uncertainty[0] not in _named(VARIANCES, "x")
            new = dict(zip(self.uncertainty, [np.sqrt(var_x), np.sqrt(var_y)] if deviations else [var_x, var_y, cov], strict=False))
        columns |= {name: column(name, values) for name, values in new.items()}
        return columns

    def content(self, columns: Mapping[str, Sequence[Any]], told: str) -> bytes:
        """The file with these columns, in the form in which it came; arrays as CSV. ``told`` says in a line what was done."""
        if self.form == "json":
            rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
            if not self.record:
                return json_text(rows).encode()
            return json_text({**self.record, "corrected": told, "columns": list(columns), "targets": rows}).encode()
        text = io.StringIO()
        said = f"# pixmetry {CORRECTED}: {comment(told)}"
        first = self.comments[:1] if self.comments and self.comments[0].startswith("# pixmetry ") else ()
        for line in (*first, said, *self.comments[len(first) :]):
            text.write(f"{line}\n")
        writer = csv.writer(text, lineterminator="\n", delimiter=self.parted_by)
        writer.writerow(columns)
        writer.writerows([[_written(v, self.parted_by) for v in row] for row in zip(*columns.values(), strict=True)])
        return text.getvalue().encode()


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
        read = _of_json(Path(table)) if Path(table).suffix.lower() == ".json" else _of_text(Path(table))
    elif isinstance(table, Located | Mapping):
        columns = table.columns if isinstance(table, Located) else table
        read = Positions(np.zeros(0), np.zeros(0), None, {name: np.asarray(v).tolist() for name, v in columns.items()})
    else:
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
    return Positions(
        at[0], at[1], covariance, read.columns, (names[0], names[1]), uncertainty, first, read.form, read.comments, read.parted_by,
        read.record, read.source,
    )  # fmt: skip


def _uncertainty(read: Positions, lost: np.ndarray) -> tuple[tuple[str, ...], np.ndarray | None]:
    for patterns, power in ((VARIANCES, 1), (DEVIATIONS, 2)):
        for one, other in zip(_named(patterns, "x"), _named(patterns, "y"), strict=True):
            if one not in read.columns or other not in read.columns:
                continue
            mixed = next((name for name in COVARIANCES if name in read.columns), None) if power == 1 else None
            used = (one, other) if mixed is None else (one, other, mixed)
            values = [_floats(read.columns[name], name, read.source) ** (power if i < 2 else 1) for i, name in enumerate(used)]
            bad = np.flatnonzero((~np.isfinite(np.array(values)) | (np.array(values[:2]) < 0).any(axis=0)).any(axis=0) & ~lost)
            if len(bad):
                where = f"{read.source}, row {bad[0] + 1}"
                what = f"'{one}' and '{other}' hold no uncertainty"
                raise InputError(what, where=where, allowed="numbers of 0 or more", remedy="correct it")
            covariance = np.zeros((len(lost), 3))
            covariance[:, 0], covariance[:, 2] = values[0], values[1]
            if mixed is not None:
                covariance[:, 1] = values[2]
            return used, covariance
    return (), None


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
    first = next(line for line in lines if not line.lstrip().startswith("#"))
    parted_by = next((mark for mark in "\t;," if mark in first), " ")
    nothing = np.zeros(0)
    return Positions(nothing, nothing, None, table.columns, form="csv", comments=comments, parted_by=parted_by, source=str(path))


def _of_json(path: Path) -> Positions:
    allowed = f"a table of `pixmetry locate` ({LOCATED_SCHEMA}), or a list of objects with x and y"
    try:
        record = json.loads(read_text(path))
    except (ValueError, RecursionError):
        raise InputError("is not JSON", where=str(path), allowed=allowed, remedy="check the file") from None
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
