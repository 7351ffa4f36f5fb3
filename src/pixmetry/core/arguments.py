"""Arguments of public functions: numbers and choices, refused by name where they are something else.

A function that takes an argument from a user calls one of these first, so that a wrong type, NaN or an array in place of a number is one
clear `InputError`, and no error of the interpreter's from somewhere below.
"""

from __future__ import annotations

import ast
import inspect
import math
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import wraps
from typing import Any, ParamSpec, TypeVar, get_origin

import numpy as np

from pixmetry.core.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")
LARGEST = 1 << 62  # of a whole number
WORDS = {"str": "a text", "Path": "a path", "int": "a whole number", "float": "a number", "bool": "True or False", "None": "None"}
CONTAINERS: dict[str, Any] = {"Sequence": Sequence, "list": list, "tuple": tuple, "Iterable": Iterable, "Mapping": Mapping, "dict": dict}


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


def typed(function: Callable[P, R], but: Collection[str] = ()) -> Callable[P, R]:
    """A public function whose arguments are refused by their names where they are not what its annotations say.

    ``but`` names arguments that the function refuses in words of its own.

    Texts, paths, numbers, truth values, records, collections of them, functions and classes are checked; ``Any`` is not. A number is no
    NaN, and a truth value is no number. What a value must be besides, the function checks itself.

    Examples
    --------
    >>> from pixmetry.core.arguments import typed
    >>> @typed
    ... def scaled(length_px: float, factor: int = 1) -> float:
    ...     return length_px * factor
    >>> scaled(2.5, factor="3")
    Traceback (most recent call last):
    ...
    pixmetry.core.errors.InputError: factor: an argument of another type; found '3'; allowed: a whole number
    """
    parameters = inspect.signature(function).parameters
    told = {name: one for name, one in parameters.items() if one.annotation is not one.empty and name not in but}
    kinds = {name: ast.parse(str(one.annotation), mode="eval").body for name, one in told.items()}
    plain = {name for name, one in parameters.items() if one.kind in (one.VAR_POSITIONAL, one.VAR_KEYWORD)}
    order, known = list(parameters), function.__globals__

    @wraps(function)
    def checked(*args: P.args, **options: P.kwargs) -> R:
        given = {**dict(zip(order, args, strict=False)), **options}
        for name, value in given.items():
            told = name in kinds and name not in plain and value is not parameters[name].default
            if told and not _is(value, kinds[name], known):
                found = value if isinstance(value, str | int | float) and len(repr(value)) < 80 else type(value).__name__
                raise InputError("an argument of another type", where=name, value=found, allowed=_words(kinds[name]))
        return function(*args, **options)

    return checked


def _members(kind: ast.expr) -> Iterator[ast.expr]:
    if isinstance(kind, ast.BinOp):
        yield from _members(kind.left)
        yield from _members(kind.right)
    else:
        yield kind


def _name(kind: ast.expr) -> str:
    if isinstance(kind, ast.Subscript):
        return _name(kind.value)
    if isinstance(kind, ast.Attribute):
        return kind.attr
    return kind.id if isinstance(kind, ast.Name) else str(getattr(kind, "value", "Any"))


def _words(kind: ast.expr) -> str:
    names = []
    for member in _members(kind):
        name = _name(member)
        if isinstance(member, ast.Subscript) and name in CONTAINERS:
            name = "a mapping" if name in ("Mapping", "dict") else "several of these"
        names.append({"Callable": "a function", "Progress": "a function", "ndarray": "an array"}.get(name, WORDS.get(name, name)))
    return ", ".join(dict.fromkeys(names))


def _is(value: Any, kind: ast.expr, known: Mapping[str, Any]) -> bool:
    return any(_is_one(value, member, known) for member in _members(kind))


def _is_one(value: Any, kind: ast.expr, known: Mapping[str, Any]) -> bool:
    name = _name(kind)
    if name in ("Any", "object"):
        return True
    if name == "None":
        return value is None
    if name == "bool":
        return isinstance(value, bool | np.bool_)
    if name in ("int", "float"):
        real = isinstance(value, int | np.integer) or (isinstance(value, float | np.floating) and (name == "float" or value == value // 1))
        return real and not isinstance(value, bool) and value == value and (name == "float" or abs(value) < LARGEST)
    if name in ("str", "Path"):
        return isinstance(value, str if name == "str" else os.PathLike) and "\0" not in str(value)
    if name == "Literal" and isinstance(kind, ast.Subscript):
        among = ast.literal_eval(kind.slice)
        return isinstance(value, str | int | None) and value in (among if isinstance(among, tuple) else (among,))
    if name in CONTAINERS:
        return _is_collection(value, kind, name, known)
    meant = known.get(name)
    if isinstance(meant, type) and not getattr(meant, "_is_protocol", False):
        return isinstance(value, meant)
    if name in ("Callable", "Progress") or get_origin(meant) is Callable:
        return callable(value)
    stands_for = get_origin(meant)  # of a name for tuple[int, int, int, int], say
    if isinstance(stands_for, type):
        return isinstance(value, (tuple, list) if stands_for is tuple else stands_for)
    if name == "ndarray":
        return isinstance(value, np.ndarray)
    return type(value).__module__.partition(".")[0] not in ("builtins", "numpy")  # a class that is imported where it is needed


def _is_collection(value: Any, kind: ast.expr, name: str, known: Mapping[str, Any]) -> bool:
    of_numpy = isinstance(value, np.ndarray) and value.ndim > 0 and name in ("Sequence", "Iterable")
    if isinstance(value, str | bytes) or not (of_numpy or isinstance(value, CONTAINERS[name])):
        return False
    if not isinstance(kind, ast.Subscript) or not isinstance(value, Collection):
        return True
    inner = list(kind.slice.elts) if isinstance(kind.slice, ast.Tuple) else [kind.slice]
    if isinstance(value, Mapping) and name in ("Mapping", "dict"):
        return all(_is(key, inner[0], known) for key in value) and all(_is(item, inner[1], known) for item in value.values())
    if name == "tuple" and not (len(inner) == 2 and _name(inner[1]) == "Ellipsis"):
        return len(value) == len(inner) and all(_is(item, one, known) for item, one in zip(value, inner, strict=True))
    return all(_is(item, inner[0], known) for item in value)
