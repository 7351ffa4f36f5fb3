"""Settings from YAML 1.2: read safely, validated into frozen models, refused with a line number and a remedy.

Numbers carry their unit in the key (`exposure_s`), so a forgotten or a different unit shows up as an unknown key, and the message
names the key that is meant.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from pixmetry.core.door import MOST_DEPTH, MOST_NODES, MOST_SETTINGS_BYTES, MOST_TEXT_BYTES, one_sentence, read_bytes
from pixmetry.core.errors import InputError

_UNIT = re.compile(r"_(?:[pnumk]?(?:m|s|hz|w|v)|mhz|ghz|c|k|f|e|dn|dn2|px|db|deg|rad|percent|bit|bits)(?:_per_[a-z0-9]+)*$")


class Model(BaseModel):
    """Base of all validated settings: unknown keys, NaN and infinities are refused, and the result cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


AnyModel = TypeVar("AnyModel", bound=BaseModel)


class Settings(dict[str, Any]):
    """A mapping read from YAML that knows the line of each value.

    Attributes
    ----------
    lines : dict
        Line numbers from 1, by the path of keys and list positions, e.g. ``("frames", 0, "exposure_s")``.
    """

    lines: dict[tuple[str | int, ...], int]


def read_text(path: str | Path, most_bytes: int = MOST_TEXT_BYTES) -> str:
    """Read a text file as UTF-8 (or UTF-16 if it says so by its mark); a byte-order mark is dropped.

    Raises
    ------
    InputError
        If the file cannot be opened, is not text, or has more bytes than ``most_bytes``.
    """
    raw = read_bytes(path, most_bytes)
    encoding = "utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        return raw.decode(encoding)
    except UnicodeDecodeError as problem:
        line = raw[: problem.start].count(b"\n") + 1
        raise InputError("not a text file in UTF-8", where=f"{path}, line {line}", remedy="save the file as UTF-8 text") from None


def load_yaml(path: str | Path) -> Settings:
    """Read one YAML 1.2 mapping.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Settings
        The mapping with its line numbers; empty if the file holds nothing.

    Raises
    ------
    InputError
        If the file cannot be read, is not YAML, repeats a key, or holds something else than a mapping.
    """
    return parse_yaml(read_text(path, MOST_SETTINGS_BYTES), path)


def parse_yaml(text: str, path: str | Path = "text") -> Settings:
    """Read one YAML 1.2 mapping from a text; ``path`` is what messages call it.

    Raises
    ------
    InputError
        As `load_yaml`.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError

    if len(text) > MOST_SETTINGS_BYTES:
        raise InputError("too long for settings", where=str(path), allowed=f"up to {MOST_SETTINGS_BYTES >> 20} MiB")
    with one_sentence("not valid YAML", str(path), remedy="correct the file"):
        try:
            constructor, parser = YAML(typ="safe", pure=True).get_constructor_parser(text)
            try:
                node = constructor.composer.get_single_node()
                _check_nodes(node, str(path))
                lines = dict(_lines(node, (), set()))  # before merge keys are resolved, which changes the nodes
                data = None if node is None else constructor.construct_document(node)
            finally:
                parser.dispose()
        except MarkedYAMLError as problem:
            raise _syntax_error(problem, path) from None
    if data is not None and not isinstance(data, dict):
        raise InputError(
            "the file must hold keys with values", where=str(path), value=type(data).__name__, remedy="write `key: value` lines"
        )
    settings = Settings(data or {})
    settings.lines = lines
    return settings


def _syntax_error(problem: Any, path: str | Path) -> InputError:
    mark = problem.problem_mark or problem.context_mark
    where = f"{path}, line {mark.line + 1}" if mark else str(path)
    repeated = re.search(r'found duplicate key "?([^"\s]+)"?', str(problem.problem))
    if repeated:
        return InputError(f"key '{repeated[1]}' is given twice", where=where, allowed="each key once", remedy="delete one of the two")
    if "\t" in str(problem.problem) or "\\t" in str(problem.problem):
        return InputError("a tab is used for indentation", where=where, allowed="spaces", remedy="replace the tab by spaces")
    return InputError(f"not valid YAML: {problem.problem}", where=where, remedy="check indentation, colons and quotes near this line")


def _check_nodes(node: Any, where: str) -> None:
    """Refuse a tree that is too deep, contains itself, or becomes too large once each alias is what it stands for."""
    sizes: dict[int, int] = {}  # of the nodes that are done; 0 while one is worked on
    waiting = [(node, 1, False)] if node is not None else []
    while waiting:
        one, depth, done = waiting.pop()
        items = one.value if isinstance(one.value, list) else []
        parts = [part for item in items for part in (item if isinstance(item, tuple) else (item,))]
        if done:
            sizes[id(one)] = size = 1 + sum(sizes[id(part)] for part in parts)
            if size > MOST_NODES:
                raise InputError(
                    "its aliases stand for too many values", where=where, allowed=f"up to {MOST_NODES}", remedy="correct the file"
                )
        elif depth > MOST_DEPTH:
            raise InputError("nested too deep", where=where, allowed=f"up to {MOST_DEPTH} levels", remedy="correct the file")
        elif id(one) not in sizes:
            sizes[id(one)] = 0
            waiting.append((one, depth, True))
            waiting += [(part, depth + 1, False) for part in parts]
        elif sizes[id(one)] == 0:
            raise InputError("an alias that contains itself", where=where, remedy="correct the file")


def _lines(node: Any, at: tuple[str | int, ...], seen: set[int]) -> Iterator[tuple[tuple[str | int, ...], int]]:
    """Walk a composed YAML tree and yield (path, line) pairs; a repeated alias is walked once (it may contain itself)."""
    from ruamel.yaml.nodes import MappingNode, SequenceNode

    if id(node) in seen:
        return
    seen.add(id(node))
    if isinstance(node, MappingNode):
        for key, value in node.value:
            here = (*at, str(key.value))
            yield here, key.start_mark.line + 1
            yield from _lines(value, here, seen)
    elif isinstance(node, SequenceNode):
        for i, value in enumerate(node.value):
            here = (*at, i)
            yield here, value.start_mark.line + 1
            yield from _lines(value, here, seen)


def validate(model: type[AnyModel], data: Mapping[str, Any], where: str = "") -> AnyModel:
    """Make a validated model from a mapping.

    Parameters
    ----------
    model : subclass of pydantic.BaseModel
    data : mapping
        If it comes from `load_yaml`, the line number is added to messages.
    where : str
        File or source of the data, for messages.

    Raises
    ------
    InputError
        With the most telling of the problems: a file of another kind first, then an unknown key, which often is what makes another one
        missing.
    """
    try:
        return model.model_validate(dict(data))
    except ValidationError as problem:
        problems = problem.errors(include_url=False)
        errors = sorted(problems, key=lambda e: (not _of_schema(e), e["type"] != "extra_forbidden", e["type"] == "missing"))
        lines = getattr(data, "lines", {})
        raise _explain(model, errors[0], data, lines, where) from None


def _of_schema(error: Any) -> bool:
    return (error["loc"], error["type"]) == (("schema",), "literal_error")


def _place_in(data: Any, error: Any) -> tuple[str | int, ...]:
    """Keys and positions of a problem as in the data: pydantic names the members of unions between them."""
    loc: list[str | int] = []
    parts = error["loc"]
    for k, part in enumerate(parts):
        if isinstance(data, Mapping) and part in data or isinstance(data, list | tuple) and isinstance(part, int) and part < len(data):
            loc.append(part)
            data = data[part]
        elif k == len(parts) - 1 and error["type"] in ("missing", "invalid_key"):
            loc.append(part)
    return tuple(loc)


def _explain(
    model: type[BaseModel], error: Any, data: Mapping[str, Any], lines: Mapping[tuple[str | int, ...], int], where: str
) -> InputError:
    loc = _place_in(data, error)
    line = next((lines[loc[:n]] for n in range(len(loc), 0, -1) if loc[:n] in lines), None)
    where = f"{where}, line {line}" if line else where
    name = ".".join(str(part + 1 if isinstance(part, int) else part) for part in loc)
    kind = error["type"]
    if _of_schema(error):
        allowed = error["ctx"]["expected"]
        return InputError("a file of another kind", where=where, value=error["input"], allowed=allowed, remedy="name a file of that schema")
    if kind == "extra_forbidden":
        return _unknown_key(str(loc[-1]), name, _keys_at(model, loc[:-1]), where)
    if kind == "invalid_key":
        remedy = f"put quotes around it; if a decimal comma stands before it, write a point: 0.{error['input']}"
        return InputError("a key that is not a text", where=where, value=error["input"], allowed="a text", remedy=remedy)
    if kind == "missing":
        return InputError(f"'{name}' is missing", where=where, remedy=f"add `{loc[-1]}: ...`")
    if kind == "finite_number":
        return InputError(
            f"'{name}' is not a finite number", where=where, value=error["input"], allowed="a finite number", remedy="give a value"
        )
    if kind in ("float_parsing", "float_type", "int_parsing", "int_type"):
        remedy = "write the number alone; its unit is in the name of the key" if isinstance(error["input"], str) else "give one number"
        if re.fullmatch(r"[+-]?\d*,\d+", str(error["input"])):
            remedy = f"write the decimal point as a point: {error['input'].replace(',', '.')}"
        return InputError(f"'{name}' is not a number", where=where, value=error["input"], allowed="a number", remedy=remedy)
    if kind == "value_error":
        cause = error["ctx"]["error"]
        if isinstance(cause, InputError):
            place = f"{where}: {name}".strip(": ")
            return InputError(cause.what, where=cause.where or place, value=cause.value, allowed=cause.allowed, remedy=cause.remedy)
        return InputError(f"'{name}': {cause}" if name else str(cause), where=where)
    if kind in ("model_type", "dict_type"):
        keys = ", ".join(_keys_at(model, loc))
        return InputError(f"'{name}' holds no keys", where=where, allowed=keys, remedy=f"write `key: value` lines below `{loc[-1]}:`")
    if kind in ("tuple_type", "list_type"):
        remedy = "write it in brackets, such as [0, 1], or with one `- …` line for each entry"
        return InputError(f"'{name}' is not a list", where=where, value=error["input"], allowed="a list", remedy=remedy)
    message = error["msg"][0].lower() + error["msg"][1:]
    value = error["input"] if isinstance(error["input"], str | int | float | bool) else None
    return InputError(f"'{name}' cannot be used", where=where, value=value, allowed=message.replace("input should be ", ""))


def _unknown_key(key: str, name: str, keys: list[str], where: str) -> InputError:
    """Say whether the unit of a known key is missing or other, else which key is nearest."""
    for known in keys:
        stem = _UNIT.sub("", known)
        if stem != known and key == stem:
            return InputError(
                f"key '{name}' lacks its unit", where=where, allowed=known, remedy=f"write `{known}: ...` with the value in that unit"
            )
        if stem != known and key != known and _UNIT.sub("", key) == stem:
            return InputError(
                f"key '{name}' has another unit than expected",
                where=where,
                allowed=known,
                remedy=f"convert the value and write `{known}: ...`",
            )
    near = difflib.get_close_matches(key, keys, n=1, cutoff=0.6)
    remedy = f"did you mean `{near[0]}`?" if near else "delete it"
    return InputError(f"unknown key '{name}'", where=where, allowed=", ".join(keys), remedy=remedy)


def _keys_at(model: type[BaseModel], loc: tuple[str | int, ...]) -> list[str]:
    """Return the keys allowed at a place in a model; an integer in `loc` is a position in a list."""
    for part in loc:
        if isinstance(part, str) and part in model.model_fields:
            model = _model_in(model.model_fields[part].annotation) or model
    return [field.alias or name for name, field in model.model_fields.items()]


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Find the model inside an annotation such as ``tuple[Group, ...] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for part in get_args(annotation) if (found := _model_in(part))), None)


def dump_yaml(obj: Any, path: str | Path) -> None:
    """Write a model or a mapping as YAML, keys in their order, without keys whose value is None.

    Parameters
    ----------
    obj : pydantic.BaseModel or mapping
        Values may be NumPy scalars, tuples and paths.
    path : str or Path
    """
    from ruamel.yaml import YAML

    yaml = YAML(pure=True)
    yaml.width = 140
    data = obj.model_dump() if isinstance(obj, BaseModel) else obj
    with open(path, "w", encoding="utf-8", newline="\n") as stream:
        yaml.dump(plain_values(data), stream)


def plain_values(value: Any) -> Any:
    """Mappings, lists, texts and numbers alone; keys whose value is None go."""
    if isinstance(value, Mapping):
        return {str(k): plain_values(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [plain_values(v) for v in value]
    if isinstance(value, Path):
        return value.as_posix()
    return value.tolist() if hasattr(value, "tolist") else value
