"""A result of any kind as tables, maps and points, to be looked at: what its files hold, under the names that they have there."""

from __future__ import annotations

import base64
import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.core.checksums import check_record
from pixmetry.core.config import read_text
from pixmetry.core.door import one_sentence, read_bytes
from pixmetry.core.errors import InputError
from pixmetry.files.images import read_picture
from pixmetry.files.results import read_maps
from pixmetry.files.strict_json import parse_json

RECORDS = ("results.json", "calibration.json", "sheet.json", "truth.json")  # of a folder of results: the first that is there is its record
MOST_ROWS = 50_000  # of a table on the page
MOST_SIDE = 2048  # of a map on the page: of a larger one every so many pixels are shown
BIGGEST = 1 << 28  # bytes of a file
MOST_PICTURES = 1000
LEAST_SIDE = 8  # of a matrix that is shown as a map
MAIN = ("budget.rows", "rows", "results", "steps", "tests.parameters", "targets", "estimates")  # tables that say most of their result


@dataclass(frozen=True)
class TableOfResult:
    """A table: where it stands in the result, its columns and its rows; ``cut`` says how many rows there are if not all are held."""

    name: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    cut: int = 0


@dataclass(frozen=True, eq=False)
class MapOfResult:
    """A map of values over pixels; ``step`` pixels of the frame lie from value to value; ``frame``: positions may be drawn over it."""

    name: str
    values: np.ndarray
    step: int = 1
    frame: bool = True

    def to_record(self) -> dict[str, Any]:
        """Return the plain record: the values as base64 of little-endian float32."""
        finite = self.values[np.isfinite(self.values)]
        low, high = (float(v) for v in np.percentile(finite, (1, 99))) if finite.size else (0.0, 1.0)
        return {
            "name": self.name,
            "rows": self.values.shape[0],
            "cols": self.values.shape[1],
            "step": self.step,
            "frame": self.frame,
            "low": low,
            "high": high if high > low else low + 1.0,
            "data": base64.b64encode(np.ascontiguousarray(self.values, "<f4").tobytes()).decode("ascii"),
        }


@dataclass(frozen=True)
class PictureOfResult:
    """An image file that positions belong to; it is read when it is looked at."""

    name: str
    path: Path

    def to_record(self) -> dict[str, Any]:
        """Return the plain record, as of `MapOfResult`.

        Raises
        ------
        InputError
            If it cannot be read as a picture.
        """
        values = np.asarray(read_picture(self.path), float)
        if values.ndim != 2:
            raise InputError("not a picture of one channel", where=str(self.path), remedy="name a grey picture")
        return _shown(self.name, values).to_record()


@dataclass(frozen=True)
class Result:
    """What there is to see of a result.

    Parameters
    ----------
    title, kind : str
        Its file, and the schema that it names.
    tables : tuple of TableOfResult
        The one that says most first.
    maps : tuple of MapOfResult or PictureOfResult
        The pictures that its positions belong to, those of its store, and the matrices of its record.
    """

    title: str
    kind: str
    tables: tuple[TableOfResult, ...]
    maps: tuple[MapOfResult | PictureOfResult, ...] = ()

    def to_record(self) -> dict[str, Any]:
        """Return the plain record without the values of the maps."""
        tables = [{"name": t.name, "columns": t.columns, "rows": t.rows, "cut": t.cut} for t in self.tables]
        return {"title": self.title, "kind": self.kind, "tables": tables, "maps": [m.name for m in self.maps]}


def read_result(path: str | Path, pictures: Sequence[str | Path] = ()) -> Result:
    """Read a result: its folder, its JSON file, or a table (CSV).

    Parameters
    ----------
    path : path
        A folder that pixmetry wrote, a JSON file of any command, or a CSV table.
    pictures : sequence of path
        Images that the positions of the result belong to, or folders of them. Those of the result's own folder are found without.

    Raises
    ------
    InputError
        If there is no result, or it is damaged, or a picture is missing.
    """
    path = Path(path)
    tables: list[TableOfResult] = []
    maps: list[MapOfResult | PictureOfResult] = []
    kind = "table"
    if path.is_dir():
        record = next((path / name for name in RECORDS if (path / name).is_file()), None)
        others = sorted(path.glob("*.json")) if record is None else [record]
        for file in others[:1]:
            kind, tables, maps = _of_json(file)
        for file in sorted(path.glob("*.csv")):
            tables.append(_of_csv(file))
        for store in sorted([*path.glob("*.zarr.zip"), *path.glob("maps.zarr")]):
            maps = [*_of_maps(store), *maps]
    elif path.suffix.lower() == ".csv":
        tables.append(_of_csv(path))
    elif path.suffix.lower() in (".html", ".pdf") and path.is_file():
        raise InputError("a page for a browser is no result", where=str(path), remedy="open it in a browser, or name the JSON beside it")
    elif path.is_file():
        kind, tables, maps = _of_json(path)
    if not tables and not maps:
        allowed = "a folder of results, a JSON file of a command, or a CSV table"
        raise InputError("no result is found", where=str(path), allowed=allowed, remedy="check the name")
    tables.sort(key=lambda t: MAIN.index(t.name) if t.name in MAIN else len(MAIN))
    own = path if path.is_dir() else path.parent
    return Result(path.name, kind, tuple(tables), (*_pictures(tables, own, [Path(p) for p in pictures]), *maps))


def _pictures(tables: Sequence[TableOfResult], own: Path, named: Sequence[Path]) -> list[PictureOfResult]:
    """Pictures that were named, and those of the tables that lie in the folder of the result or in a folder that was named."""
    found: dict[str, Path] = {}
    for path in named:
        if path.is_file():
            found[path.name] = path
        elif not path.is_dir():
            raise InputError("there is no such picture", where=str(path), remedy="check the name")
    of_tables = [t for t in tables if {"x_px", "y_px"} <= set(t.columns)]
    names = {str(row[t.columns.index(c)]) for t in of_tables for c in ("image", "file") if c in t.columns for row in t.rows}
    for name in sorted({Path(n).name for n in names} - {""})[:MOST_PICTURES]:
        for folder in [p for p in (*named, own) if p.is_dir()]:
            if name not in found and (folder / name).is_file():
                found[name] = folder / name
    return [PictureOfResult(name, path) for name, path in found.items()]


def _of_json(path: Path) -> tuple[str, list[TableOfResult], list[MapOfResult | PictureOfResult]]:
    record = parse_json(read_bytes(path, BIGGEST), str(path))
    check_record(record, str(path))
    shown = {k: v for k, v in record.items() if k not in ("checksums", "schema")}
    return str(record.get("schema", "JSON")), [t for t in _tables_in(shown, "") if t.rows], list(_matrices_in(shown, ""))


def _matrices_in(value: Mapping[str, Any], at: str) -> Iterator[MapOfResult]:
    """Lists of lists of numbers, all of one length, as maps."""
    for key, part in value.items():
        name = f"{at}.{key}" if at else str(key)
        if isinstance(part, dict):
            yield from _matrices_in(part, name)
        elif isinstance(part, list) and part and all(isinstance(p, dict) for p in part):
            for k, p in enumerate(part[:MOST_PICTURES]):
                yield from _matrices_in(p, f"{name}.{p.get('name', k)}")
        elif _is_matrix(part):
            yield replace(_shown(name, np.array(part, float)), frame=False)


def _is_matrix(part: Any) -> bool:
    if not isinstance(part, list) or len(part) < LEAST_SIDE or not all(isinstance(row, list) for row in part):
        return False
    wide = len(part[0])
    return wide >= LEAST_SIDE and all(len(row) == wide and all(v is None or isinstance(v, int | float) for v in row) for row in part)


def _tables_in(value: Mapping[str, Any], at: str) -> Iterator[TableOfResult]:
    """Single values in a table of names and values; lists of records, and records of lists of one length, as tables of their own."""
    single = [(k, v) for k, v in value.items() if not isinstance(v, dict | list) or _is_short(v)]
    if single:
        yield TableOfResult(at or "values", ("name", "value"), tuple((k, _cell(v)) for k, v in single))
    for key, part in value.items():
        name = f"{at}.{key}" if at else str(key)
        if _is_records(part):
            yield _of_records(name, part)
        elif isinstance(part, dict) and (named := _named_records(part)):
            yield _of_records(name, named)
        elif isinstance(part, dict) and _is_columns(part):
            yield _of_columns(name, part)
        elif isinstance(part, dict):
            yield from _tables_in(part, name)


def _is_records(part: Any) -> bool:
    return isinstance(part, list) and bool(part) and all(isinstance(p, dict) for p in part)


def _named_records(part: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The rows of records by name that are alike (or lists of such), each row with its name; none if they are not."""
    rows: list[dict[str, Any]] = []
    for name, value in part.items():
        of_name = value if _is_records(value) else [value]
        if not all(isinstance(v, dict) and not any(isinstance(x, dict | list) and not _is_short(x) for x in v.values()) for v in of_name):
            return []
        rows += [{"of": name} | v for v in of_name]
    first = set(rows[0]) if rows else set()
    alike = len(part) > 1 and len(first) > 2 and all(len(set(r) & first) > 0.5 * max(len(r), len(first)) for r in rows)
    return rows if alike else []


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
        elif not _is_matrix(value):  # it is a map
            yield name, _cell(value)


def _cell(value: Any) -> Any:
    if isinstance(value, list):
        short = ", ".join(str(_cell(v)) for v in value[:4])
        return short if len(value) <= 4 else f"{short}, … ({len(value)})"
    return f"{len(value)} values" if isinstance(value, dict) else value


def _of_csv(path: Path) -> TableOfResult:
    lines = (line for line in read_text(path).splitlines() if not line.startswith("#"))
    with one_sentence("not a table", str(path), allowed="CSV with a heading for each column"):
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
