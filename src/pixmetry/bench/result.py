"""A result of any kind as tables, maps and points, to be looked at: what its files hold, under the names that they have there."""

from __future__ import annotations

import base64
import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.core.checksums import check_record
from pixmetry.core.config import read_text
from pixmetry.core.errors import InputError
from pixmetry.files.images import read_picture
from pixmetry.files.results import read_maps
from pixmetry.files.strict_json import parse_json

RECORDS = ("results.json", "calibration.json", "sheet.json", "truth.json")  # of a folder of results: the first that is there is its record
MOST_ROWS = 50_000  # of a table on the page
MOST_SIDE = 2048  # of a map on the page: of a larger one every so many pixels are shown
BIGGEST = 1 << 28  # bytes of a file
RESIDUALS = ("residual_x_px", "residual_y_px")


@dataclass(frozen=True)
class TableOfResult:
    """A table: where it stands in the result, its columns and its rows; ``cut`` says how many rows there are if not all are held."""

    name: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    cut: int = 0


@dataclass(frozen=True, eq=False)
class MapOfResult:
    """A map of values over pixels; ``step`` pixels of the frame lie from value to value."""

    name: str
    values: np.ndarray
    step: int = 1

    def to_record(self) -> dict[str, Any]:
        """Return the plain record: the values as base64 of little-endian float32."""
        finite = self.values[np.isfinite(self.values)]
        low, high = (float(v) for v in np.percentile(finite, (1, 99))) if finite.size else (0.0, 1.0)
        return {
            "name": self.name,
            "rows": self.values.shape[0],
            "cols": self.values.shape[1],
            "step": self.step,
            "low": low,
            "high": high if high > low else low + 1.0,
            "data": base64.b64encode(np.ascontiguousarray(self.values, "<f4").tobytes()).decode("ascii"),
        }


@dataclass(frozen=True)
class Result:
    """What there is to see of a result.

    Parameters
    ----------
    title, kind : str
        Its file, and the schema that it names.
    tables : tuple of TableOfResult
    maps : tuple of MapOfResult
        Those of its store, and the picture that was named beside it.
    """

    title: str
    kind: str
    tables: tuple[TableOfResult, ...]
    maps: tuple[MapOfResult, ...] = ()

    def to_record(self) -> dict[str, Any]:
        """Return the plain record without the values of the maps."""
        tables = [{"name": t.name, "columns": t.columns, "rows": t.rows, "cut": t.cut} for t in self.tables]
        return {"title": self.title, "kind": self.kind, "tables": tables, "maps": [m.name for m in self.maps]}


def read_result(path: str | Path, picture: str | Path | None = None) -> Result:
    """Read a result: its folder, its JSON file, or a table (CSV).

    Parameters
    ----------
    path : path
        A folder that pixmetry wrote, a JSON file of any command, or a CSV table.
    picture : path, optional
        An image that the positions of the result belong to.

    Raises
    ------
    InputError
        If there is no result, or it is damaged.
    """
    path = Path(path)
    tables: list[TableOfResult] = []
    maps: list[MapOfResult] = []
    kind = "table"
    if path.is_dir():
        record = next((path / name for name in RECORDS if (path / name).is_file()), None)
        others = sorted(path.glob("*.json")) if record is None else [record]
        for file in others[:1]:
            kind, found = _of_json(file)
            tables += found
        for file in sorted(path.glob("*.csv")):
            tables.append(_of_csv(file))
        for store in sorted([*path.glob("*.zarr.zip"), *path.glob("maps.zarr")]):
            maps += _of_maps(store)
    elif path.suffix.lower() == ".csv":
        tables.append(_of_csv(path))
    elif path.is_file():
        kind, found = _of_json(path)
        tables += found
    if not tables and not maps:
        allowed = "a folder of results, a JSON file of a command, or a CSV table"
        raise InputError("no result is found", where=str(path), allowed=allowed, remedy="check the name")
    if picture is not None:
        maps.insert(0, _shown(Path(picture).name, np.asarray(read_picture(picture), float)))
    return Result(path.name, kind, tuple(tables), tuple(maps))


def _of_json(path: Path) -> tuple[str, list[TableOfResult]]:
    if path.stat().st_size > BIGGEST:
        raise InputError("the file is too large to be shown", where=str(path), allowed=f"up to {BIGGEST >> 20} MB")
    record = parse_json(path.read_bytes(), str(path))
    if "checksums" in record:
        check_record(record, str(path))
    shown = {k: v for k, v in record.items() if k not in ("checksums", "schema")}
    return str(record.get("schema", "JSON")), [t for t in _tables_in(shown, "") if t.rows]


def _tables_in(value: Mapping[str, Any], at: str) -> Iterator[TableOfResult]:
    """Single values in a table of names and values; lists of records, and records of lists of one length, as tables of their own."""
    single = [(k, v) for k, v in value.items() if not isinstance(v, dict | list) or _is_short(v)]
    if single:
        yield TableOfResult(at or "values", ("name", "value"), tuple((k, _cell(v)) for k, v in single))
    for key, part in value.items():
        name = f"{at}.{key}" if at else str(key)
        if isinstance(part, list) and part and all(isinstance(p, dict) for p in part):
            yield _of_records(name, part)
        elif isinstance(part, dict) and _is_columns(part):
            yield _of_columns(name, part)
        elif isinstance(part, dict):
            yield from _tables_in(part, name)


def _is_short(value: Any) -> bool:
    return isinstance(value, list) and len(value) <= 4 and not any(isinstance(v, dict | list) for v in value)


def _is_columns(part: Mapping[str, Any]) -> bool:
    lists = [v for v in part.values() if isinstance(v, list)]
    return (
        len(lists) > 1
        and len({len(v) for v in lists}) == 1
        and len(lists[0]) > 1
        and all(isinstance(v, list) or v is None for v in part.values())
    )


def _of_columns(name: str, part: Mapping[str, Any]) -> TableOfResult:
    lists = {k: v for k, v in part.items() if isinstance(v, list)}
    rows = [tuple(_cell(v) for v in row) for row in zip(*lists.values(), strict=True)]
    return _table(name, tuple(lists), rows)


def _of_records(name: str, records: Sequence[Mapping[str, Any]]) -> TableOfResult:
    columns: dict[str, None] = {}
    flat = [dict(_flattened(r)) for r in records]
    for record in flat:
        columns |= dict.fromkeys(record)
    return _table(name, tuple(columns), [tuple(record.get(c) for c in columns) for record in flat])


def _flattened(record: Mapping[str, Any], at: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in record.items():
        name = f"{at}{key}"
        if isinstance(value, dict) and len(value) <= 12 and not at:
            yield from _flattened(value, f"{name}.")
        else:
            yield name, _cell(value)


def _cell(value: Any) -> Any:
    if isinstance(value, list):
        short = ", ".join(str(_cell(v)) for v in value[:4])
        return short if len(value) <= 4 else f"{short}, … ({len(value)})"
    return f"{len(value)} values" if isinstance(value, dict) else value


def _of_csv(path: Path) -> TableOfResult:
    lines = (line for line in read_text(path).splitlines() if not line.startswith("#"))
    rows = list(csv.reader(lines))
    if not rows or len(set(rows[0])) < len(rows[0]):
        raise InputError("not a table", where=str(path), remedy="name a CSV file with a heading for each column")
    wide = len(rows[0])
    body = [tuple(_number(v) for v in row) for row in rows[1:] if len(row) == wide]
    return _table(path.name, tuple(rows[0]), body)


def _number(text: str) -> Any:
    try:
        return float(text) if text else None
    except ValueError:
        return text


def _table(name: str, columns: tuple[str, ...], rows: Sequence[tuple[Any, ...]]) -> TableOfResult:
    return TableOfResult(name, columns, tuple(rows[:MOST_ROWS]), len(rows) if len(rows) > MOST_ROWS else 0)


def _of_maps(path: Path) -> Iterator[MapOfResult]:
    arrays, _ = read_maps(path)
    for name, array in arrays.items():
        if array.ndim == 2 and array.dtype.kind in "fiub" and min(array.shape) > 1:
            yield _shown(name, array)


def _shown(name: str, array: np.ndarray) -> MapOfResult:
    step = max(1, -(-max(array.shape[:2]) // MOST_SIDE))
    return MapOfResult(name, np.asarray(array[::step, ::step], np.float32), step)
