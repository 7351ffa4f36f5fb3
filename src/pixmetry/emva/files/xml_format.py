"""The public XML format of EMVA 1288 results, with uncertainties beside the values.

Below the root ``results`` stand sections, below a section one element a key with ``value``, or with ``data`` that holds the arrays of
a curve, their numbers separated by blanks. Ours adds ``u``, ``dof``, ``method`` and ``reason`` to a key, one element ``sheet`` to the
section ``info``, and the attribute ``schema`` to the root; programs that know nothing of them skip them. Where there is only a limit,
``value`` is ``nan`` and the limit stands in ``upper_limit`` or ``lower_limit``, so that no program takes it for a value. Sections of one
channel of several carry its name: ``spatial.Gr``.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.number import Number
from pixmetry.emva.files.json_format import SCHEMA, checked, kind_of
from pixmetry.emva.files.keys import KEYS, NONLINEAR, key_of, plain_unit
from pixmetry.emva.records import MONO, DataSheet, Results
from pixmetry.files.strict_json import parse_json, plain

_CURVE_SECTIONS = {"histogram": "defect_pixel", "linearity": "linearity", "dark_signal": "dark_current", "general": "general"}
_CURVE_SECTIONS |= {"horizontal": "spatial", "vertical": "spatial"}  # else the section is sensitivity
_CURVES = (
    *("sensitivity", "dark_signal", "PTC", "SNR", "linearity", "general"),
    *(f"{way}_{what}_{of}" for way in ("horizontal", "vertical") for what in ("spectrogram", "profile") for of in ("DSNU", "PRNU")),
    *(f"histogram_{of}{tail}" for of in ("DSNU", "PRNU") for tail in ("", "_accumulated")),
)
_NAMES = {name.lower(): name for key in KEYS for name in (key, key + NONLINEAR)} | {name.lower(): name for name in _CURVES}
_NOT_XML = re.compile("[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?inf")


def xml_text(sheet: DataSheet) -> str:
    """Return a data sheet as XML."""
    root = ET.Element("results", schema=SCHEMA)
    for result in sheet.results:
        tail = "" if result.channel == MONO else f".{result.channel}"
        for name, value in result.values.items():
            _write_value(_section(root, _about(name)[0] + tail), name, value)
        for name, curve in result.curves.items():
            section = next((s for start, s in _CURVE_SECTIONS.items() if name.startswith(start)), "sensitivity")
            data = ET.SubElement(_entry(_section(root, section + tail), name, section, name.replace("_", " ")), "data")
            for part, array in curve.items():
                _write_array(data, part, np.atleast_1d(array))
    _write_sheet(_section(root, "info"), sheet)
    root[:] = sorted(root, key=lambda section: section.tag)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _about(name: str) -> tuple[str, str, str]:
    """Section, title and symbol of a key."""
    if name.removesuffix(NONLINEAR) not in KEYS:
        return "other", name.replace("_", " "), ""
    key = key_of(name)
    return key.section, key.title, key.symbol


def _section(root: ET.Element, name: str) -> ET.Element:
    found = root.find(f"./{name}")
    return ET.SubElement(root, name) if found is None else found


def _entry(section: ET.Element, name: str, section_name: str, title: str) -> ET.Element:
    entry = ET.SubElement(section, name)
    _put(entry, "section", section_name)
    _put(entry, "short", title)
    return entry


def _put(parent: ET.Element, name: str, text: str) -> None:
    ET.SubElement(parent, name).text = _NOT_XML.sub("\ufffd", text)


def _write_value(section: ET.Element, name: str, value: Number) -> None:
    section_name, title, symbol = _about(name)
    entry = _entry(section, name, section_name, title)
    if symbol:
        _put(entry, "symbol", symbol)
    _put(entry, "unit", value.unit)
    limit = value.kind if value.is_limit else ""
    _put(entry, "value", "nan" if limit or math.isnan(value.value) else repr(float(value.value)))
    if limit:
        _put(entry, limit, repr(float(value.value)))
    for part, number in (("u", value.u), ("dof", value.dof)):
        if not math.isnan(number):
            _put(entry, part, repr(float(number)))
    for part, text in (("method", value.method), ("reason", value.reason)):
        if text:
            _put(entry, part, text)


def _write_array(data: ET.Element, part: str, array: np.ndarray) -> None:
    element = ET.SubElement(data, part)
    if array.dtype.kind in "bi" or array.dtype.kind == "u":
        element.set("type", "bool" if array.dtype.kind == "b" else "int")
        array = array.astype(np.int64)
    element.text = " ".join(repr(item) for item in array.tolist()) or " "  # other readers want a text, even of nothing


def _write_sheet(info: ET.Element, sheet: DataSheet) -> None:
    entry = _entry(info, "sheet", "info", "Conditions of the values")
    _put(entry, "value", "None")  # other readers want one
    head = {
        "release": sheet.results[0].release if sheet.results else "",
        "channels": [result.channel for result in sheet.results],
        "camera": sheet.camera,
        "conditions": sheet.conditions,
        "provenance": sheet.provenance,
        "licence": sheet.licence,
        "notes": {result.channel: list(result.notes) for result in sheet.results},
    }
    for name, value in head.items():
        _put(entry, name, value if isinstance(value, str) else json.dumps(plain(value), ensure_ascii=False, allow_nan=False))


class _Builder(ET.TreeBuilder):
    """Builds the tree of a document without a type definition, for such a definition can make a short file endless."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise InputError("holds a document type definition", allowed="XML without <!DOCTYPE …>", remedy="delete the definition")


def sheet_of_xml(raw: bytes, where: str = "") -> DataSheet:
    """Return the data sheet of an XML text, ours or that of another program.

    Names are taken in upper or lower case, numbers with a decimal point or comma, ``None`` and ``nan`` as no value.

    Raises
    ------
    InputError
        If it is no XML, has a document type definition, is no result, or a number in it cannot be read.
    """
    root = _parse(raw, where)
    if root.tag.lower() != "results":
        found, allowed = _short(root.tag), "<results> as root"
        raise InputError("not a result of EMVA 1288", where=where, value=found, allowed=allowed, remedy="check the file")
    sheet = root.find("./info/sheet")
    channels: dict[str, tuple[dict[str, Number], dict[str, dict[str, np.ndarray]]]] = {}
    for channel, name, entry in _entries(root):
        if entry is sheet:
            continue
        values, curves = channels.setdefault(channel, ({}, {}))
        place = f"{where}: {name}"
        if name in values or name in curves:
            raise InputError("is given twice", where=place, remedy="delete one of the two")
        data = _child(entry, "data")
        if data is None:
            values[name] = _value_of(entry, name, place)
        else:
            keep = sheet is not None
            curves[name] = {part.tag if keep else part.tag.lower(): _array_of(part, f"{place}.{part.tag}") for part in data}
    if not channels:
        raise InputError("holds no value", where=where, allowed="<results><section><key><value>…", remedy="check the file")
    if sheet is None:
        return DataSheet(tuple(Results("", *found, channel=channel) for channel, found in channels.items()), {}, {}, {})
    if root.get("schema") != SCHEMA:
        found = _short(root.get("schema", "no schema"))
        raise InputError("a data sheet of another kind", where=where, value=found, allowed=SCHEMA, remedy="make the file again")
    return _with_head(sheet, channels, where)


def _parse(raw: bytes, where: str) -> ET.Element:
    parser = ET.XMLParser(target=_Builder())
    try:
        parser.feed(raw)
        return parser.close()
    except InputError as problem:
        raise InputError(problem.what, where=where, allowed=problem.allowed, remedy=problem.remedy) from None
    except ET.ParseError as problem:
        line = problem.position[0]
        text = str(problem).partition(":")[0]
        raise InputError(f"not valid XML: {text}", where=f"{where}, line {line}", remedy="make the file again") from None
    except (ValueError, LookupError) as problem:  # an encoding that does not exist
        raise InputError(f"not valid XML: {_short(str(problem))}", where=where, remedy="save the file as UTF-8") from None


def _short(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."


def _entries(root: ET.Element) -> Iterator[tuple[str, str, ET.Element]]:
    """Channel, name and element of each key, in sections or right below the root."""
    for section in root:
        if _child(section, "value") is not None or _child(section, "data") is not None:
            yield MONO, _name(section.tag), section
            continue
        _, _, channel = section.tag.partition(".")
        for entry in section:
            if _child(entry, "value") is not None or _child(entry, "data") is not None:
                yield channel or MONO, _name(entry.tag), entry


def _name(tag: str) -> str:
    return _NAMES.get(tag.lower(), tag)


def _child(element: ET.Element, name: str) -> ET.Element | None:
    return next((child for child in element if child.tag.lower() == name), None)


def _text(element: ET.Element, name: str) -> str:
    child = _child(element, name)
    return (child.text or "") if child is not None else ""


def _value_of(entry: ET.Element, name: str, where: str) -> Number:
    upper, lower, reason = (_text(entry, part) for part in ("upper_limit", "lower_limit", "reason"))
    text = upper or lower or _text(entry, "value")
    value = _number(text, where)
    unit = _child(entry, "unit")
    base = KEYS.get(name.removesuffix(NONLINEAR))
    given = plain_unit(unit.text if unit is not None else "") if unit is not None or base is None else base.unit
    if math.isnan(value) and not reason:
        reason = f"the file says {text.strip() or 'nothing'}"
    u, dof = (_number(_text(entry, part), f"{where}.{part}") for part in ("u", "dof"))
    return checked(Number(value, u, dof, given, _text(entry, "method"), reason, kind_of(bool(upper), bool(lower))), where)


def _number(text: str, where: str) -> float:
    text = text.strip()
    if text.lower() in ("", "none", "nan", "+nan", "-nan"):
        return math.nan
    written = text.replace(",", ".")
    if not _NUMBER.fullmatch(written):
        raise InputError("is not a number", where=where, value=_short(text), allowed="a number, None or nan", remedy="correct the file")
    return float(written)


def _array_of(part: ET.Element, where: str) -> np.ndarray:
    numbers = [_number(word, where) for word in (part.text or "").split()]
    kind = {"bool": bool, "int": np.int64}.get(part.get("type", ""), float)
    return np.array(numbers, dtype=float).astype(kind)


def _with_head(sheet: ET.Element, channels: dict[str, Any], where: str) -> DataSheet:
    """The data sheet that says of what its values are."""
    place = f"{where}: sheet"
    camera, conditions, provenance, notes = (
        parse_json((_text(sheet, name) or "{}").encode(), f"{place}.{name}") for name in ("camera", "conditions", "provenance", "notes")
    )
    order = re.findall(r'"([^"]*)"', _text(sheet, "channels")) or list(channels)
    release = _text(sheet, "release")
    results = []
    for name in order:
        values, curves = channels.get(name, ({}, {}))
        said = notes.get(name)
        results.append(Results(release, values, curves, tuple(map(str, said if isinstance(said, list) else ())), name))
    return DataSheet(tuple(results), camera, conditions, provenance, _text(sheet, "licence"))
