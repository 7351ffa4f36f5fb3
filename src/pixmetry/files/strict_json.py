"""JSON (RFC 8259) of records, written and read, with one rule for numbers that it does not have: NaN, a number that is not known, is
``null``, and an infinite one the word ``"inf"`` or ``"-inf"``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from pixmetry.core.door import check_depth
from pixmetry.core.errors import InputError

_INFINITE = {"inf": math.inf, "-inf": -math.inf}
SHORT = 130  # characters of a record that stays on one line


def plain(value: Any, at: str = "$") -> Any:
    """A value in a form for JSON: NumPy values become plain ones, records mappings, tuples lists.

    Raises
    ------
    TypeError
        If a value has no form in JSON; the message names its place.

    Examples
    --------
    >>> plain({"u": float("nan"), "dof": float("inf"), "n": np.int64(3)})
    {'u': None, 'dof': 'inf', 'n': 3}
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if is_dataclass(value) and not isinstance(value, type):
        value = {f.name: getattr(value, f.name) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item, f"{at}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, f"{at}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ("inf" if value > 0 else "-inf")
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(f"{at} is a {type(value).__name__}, which JSON cannot hold")


def json_text(value: Any) -> str:
    """The text of a file: a line for each row of numbers and each short record, indented by one blank a level.

    Raises
    ------
    TypeError
        As of `plain`.
    """
    return _laid_out(plain(value), "") + "\n"


def _laid_out(value: Any, indent: str) -> str:
    one = json.dumps(value, ensure_ascii=False, allow_nan=False)
    items = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    flat = not any(isinstance(item, dict | list) for item in items)
    if not items or (flat and indent and (len(one) <= SHORT or isinstance(value, list))):
        return one
    inner = indent + " "
    if isinstance(value, dict):
        parts = [f"{json.dumps(key, ensure_ascii=False)}: {_laid_out(item, inner)}" for key, item in value.items()]
    else:
        parts = [_laid_out(item, inner) for item in value]
    left, right = "{}" if isinstance(value, dict) else "[]"
    return f"{left}\n{inner}" + f",\n{inner}".join(parts) + f"\n{indent}{right}"


def parse_json(raw: bytes, where: str, remedy: str = "check the file") -> dict[str, Any]:
    """Read one JSON object; NaN, infinities and keys that are given twice are refused.

    Parameters
    ----------
    raw : bytes
    where : str
        The file's name, for errors.
    remedy : str
        What to do where it holds no JSON object at all.

    Raises
    ------
    InputError
        If it is something else.

    Examples
    --------
    >>> parse_json(b'{"u": null, "dof": "inf"}', "a.json")
    {'u': None, 'dof': 'inf'}
    """
    if not starts_with(raw, b"{"):
        what = "a JSON list, not an object" if starts_with(raw, b"[") else "neither JSON nor XML"
        raise InputError(what, where=where, remedy=remedy)
    try:
        record: dict[str, Any] = json.loads(raw, object_pairs_hook=_once, parse_constant=_no_constant)
    except _RefusedError as problem:
        raise InputError(str(problem), where=where, remedy="correct the file") from None
    except json.JSONDecodeError as problem:
        raise InputError(f"not valid JSON: {problem.msg}", where=f"{where}, line {problem.lineno}", remedy="make the file again") from None
    except (ValueError, RecursionError):  # not UTF-8, or nested without end
        raise InputError("not valid JSON", where=where, remedy="make the file again") from None
    check_depth(record, where)
    return record


def starts_with(raw: bytes, mark: bytes) -> bool:
    """Whether a text in any encoding begins with a mark, apart from blanks."""
    return raw[:64].lstrip(b"\x00 \t\r\n\xef\xbb\xbf\xff\xfe").startswith(mark)


def number_in(value: Any, where: str) -> float:
    """The number that JSON holds as a number, ``null`` (NaN) or ``"inf"``: the inverse of `plain`.

    Raises
    ------
    InputError
        If it is none.
    """
    if value is None:
        return math.nan
    if isinstance(value, str) and value in _INFINITE:
        return _INFINITE[value]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError("is not a number", where=where, value=value, allowed='a number, null or "inf"', remedy="correct the file")
    try:
        return float(value)
    except OverflowError:
        raise InputError("is too large a number", where=where, allowed="up to 1e308", remedy="correct the file") from None


class _RefusedError(ValueError):
    """What Python's reader would take, and JSON or a record of ours does not have."""


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    record = dict(pairs)
    if len(record) < len(pairs):
        names = [name for name, _ in pairs]
        raise _RefusedError(f"'{next(n for n in names if names.count(n) > 1)}' is given twice")
    return record


def _no_constant(name: str) -> float:
    raise _RefusedError(f"contains {name}, which is not a number in JSON")
