"""Arguments of public functions: numbers and choices, refused by name where they are something else.

A function that takes an argument from a user calls one of these first, so that a wrong type, NaN or an array in place of a number is one
clear `InputError`, and no error of the interpreter's from somewhere below.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from pixmetry.core.errors import InputError


def number(
    value: Any, where: str, what: str, *, least: float = -math.inf, most: float = math.inf, above: float = -math.inf, allowed: str
) -> float:
    """A finite number within limits, ``above`` being one that it must exceed.

    Raises
    ------
    InputError
        If it is none; no text, truth value, or array is a number.

    Examples
    --------
    >>> from pixmetry.core.arguments import number
    >>> number(3, "search_px", "no distance", above=0, allowed="above 0 px")
    3.0
    """
    real = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    try:
        found = float(value) if real else math.nan
    except OverflowError:
        found = math.inf
    if not (math.isfinite(found) and least <= found <= most and found > above):
        raise InputError(what, where=where, value=value, allowed=allowed)
    return found


def whole_number(value: Any, where: str, what: str, *, least: float, most: float = math.inf, allowed: str) -> int:
    """A whole number within limits; 3.0 is one.

    Raises
    ------
    InputError
        If it is none.

    Examples
    --------
    >>> from pixmetry.core.arguments import whole_number
    >>> whole_number(3.0, "frames", "not so many frames", least=1, allowed="1 or more")
    3
    """
    found = number(value, where, what, least=least, most=most, allowed=allowed)
    if found != int(found):
        raise InputError(what, where=where, value=value, allowed=allowed)
    return int(found)


def choice(value: Any, among: Iterable[str], where: str, what: str) -> str:
    """One of some words.

    Raises
    ------
    InputError
        If it is none of them.

    Examples
    --------
    >>> from pixmetry.core.arguments import choice
    >>> choice("bright", ("bright", "dark"), "polarity", "no such polarity")
    'bright'
    """
    words = tuple(among)
    if not (isinstance(value, str) and value in words):
        raise InputError(what, where=where, value=value, allowed=", ".join(words))
    return str(value)
