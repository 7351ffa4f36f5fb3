"""Data sheets as JSON, with everything; all numbers are written so that reading gives the same bits."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.core import door
from pixmetry.core.checksums import sealed
from pixmetry.core.errors import InputError
from pixmetry.core.number import LOWER_LIMIT, UPPER_LIMIT, VALUE, Number
from pixmetry.emva.records import MONO, DataSheet, Results
from pixmetry.files.strict_json import json_text, number_in, plain, starts_with

SCHEMA = "pixmetry/emva1288/1"
WHAT_TO_NAME = "name a data sheet (.json or .xml) or the results of an assessment"
LARGEST_BYTES = 1 << 28  # a sheet with all its curves has less than 1 MB


def sheet_json(sheet: DataSheet) -> str:
    """Return a data sheet as JSON (RFC 8259)."""
    return json_text(sealed(to_record(sheet)))


def read_bytes(path: str | Path) -> bytes:
    """Read a file whole.

    Raises
    ------
    InputError
        If it cannot be read, is empty, or larger than any data sheet.
    """
    raw = door.read_bytes(path, LARGEST_BYTES)
    if not raw.strip(b"\x00 \t\r\n\xef\xbb\xbf\xff\xfe"):
        raise InputError("the file is empty", where=str(path), remedy="make the data sheet again")
    return raw


def is_xml(raw: bytes) -> bool:
    """Whether a file's bytes begin as XML does, in any encoding."""
    return starts_with(raw, b"<")


def to_record(sheet: DataSheet) -> dict[str, Any]:
    """Return the plain record of a data sheet, ready for JSON."""
    parts = {result.channel: _result_record(result) for result in sheet.results}
    head = {
        "schema": SCHEMA,
        "release": sheet.results[0].release if sheet.results else "",
        "camera": plain(sheet.camera),
        "conditions": plain(sheet.conditions),
        "provenance": plain(sheet.provenance),
        "licence": sheet.licence,
    }
    return head | (parts[MONO] if list(parts) == [MONO] else {"channels": parts})


def _result_record(result: Results) -> dict[str, Any]:
    return {
        "results": {key: value_record(value) for key, value in result.values.items()},
        "curves": {name: {part: plain(np.atleast_1d(data)) for part, data in curve.items()} for name, curve in result.curves.items()},
        "notes": list(result.notes),
    }


def value_record(value: Number) -> dict[str, Any]:
    """Return the plain record of one value."""
    return {
        "value": plain(value.value),
        "u": plain(value.u),
        "dof": plain(value.dof),
        "unit": value.unit,
        "method": value.method,
        "reason": value.reason,
        "is_limit": value.is_upper_limit,
        "is_lower_limit": value.is_lower_limit,
    }


def sheet_of_record(record: Mapping[str, Any], where: str = "") -> DataSheet:
    """Return the data sheet of a record from JSON.

    Raises
    ------
    InputError
        If it is of another kind, or something in it cannot be used.
    """
    if record.get("schema") != SCHEMA:
        found = record.get("schema", "no schema")
        raise InputError("not a data sheet", where=where, value=found, allowed=SCHEMA, remedy="name a file of `pixmetry emva1288 --json`")
    release = _of_type(record, "release", str, where)
    channels = _of_type(record, "channels", dict, where) if "channels" in record else {MONO: record}
    results = tuple(_result_of(part, release, channel, where) for channel, part in channels.items())
    camera, conditions, provenance = (_of_type(record, name, dict, where) for name in ("camera", "conditions", "provenance"))
    return DataSheet(results, camera, conditions, provenance, _of_type(record, "licence", str, where))


def _of_type(record: Any, name: str, kind: type, where: str) -> Any:
    value = record.get(name) if isinstance(record, Mapping) else None
    if not isinstance(value, kind):
        allowed = {str: "a text", dict: "keys with values", list: "a list", bool: "true or false"}[kind]
        raise InputError(f"'{name}' is missing or of the wrong kind", where=where, allowed=allowed, remedy="make the file again")
    return value


def _result_of(record: Any, release: str, channel: str, where: str) -> Results:
    values = {k: value_of(v, f"{where}: {k}") for k, v in _of_type(record, "results", dict, where).items()}
    curves = {
        name: {part: _array_of(data, f"{where}: {name}.{part}") for part, data in _of_type({name: curve}, name, dict, where).items()}
        for name, curve in _of_type(record, "curves", dict, where).items()
    }
    return Results(release, values, curves, tuple(str(note) for note in _of_type(record, "notes", list, where)), channel)


def value_of(record: Any, where: str) -> Number:
    """Return the value of its record.

    Raises
    ------
    InputError
        If something in it cannot be used.
    """
    if not isinstance(record, Mapping):
        raise InputError("is not a value with its uncertainty", where=where, remedy="make the file again")
    value, u, dof = (number_in(record.get(name), f"{where}.{name}") for name in ("value", "u", "dof"))
    unit, method, reason = (_of_type(record, name, str, where) for name in ("unit", "method", "reason"))
    upper, lower = (_of_type(record, name, bool, where) for name in ("is_limit", "is_lower_limit"))
    return checked(Number(value, u, dof, unit, method, reason, kind_of(upper, lower)), where)


def kind_of(upper: bool, lower: bool) -> str:
    """The kind of a number by the two marks of a data sheet on disk."""
    return UPPER_LIMIT if upper else LOWER_LIMIT if lower else VALUE


def checked(value: Number, where: str) -> Number:
    """Return the value if its uncertainty can be one.

    Raises
    ------
    InputError
        If ``u`` is negative or ``dof`` is not positive.
    """
    if value.u < 0:
        raise InputError("negative uncertainty", where=where, value=value.u, allowed="0 or more", remedy="correct the file")
    if value.dof <= 0:
        raise InputError("degrees of freedom are not positive", where=where, value=value.dof, allowed="above 0", remedy="correct the file")
    return value


def _array_of(data: Any, where: str) -> np.ndarray:
    if not isinstance(data, list):
        raise InputError("is not a list of numbers", where=where, remedy="make the file again")
    kinds = {type(item) for item in data}
    if kinds == {bool} or (kinds == {int} and max(map(abs, data)) < 1 << 63):
        return np.array(data)
    return np.array([number_in(item, where) for item in data], dtype=float)
