"""JSON (RFC 8259) of records, with one rule for numbers that it does not have: NaN, a number that is not known, is ``null``, and an
infinite one the word ``"inf"`` or ``"-inf"``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

SHORT = 130  # characters of a record that stays on one line


def plain(value: Any, at: str = "$") -> Any:
    """A value as JSON can hold it: NumPy's become plain, records mappings, tuples lists.

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
