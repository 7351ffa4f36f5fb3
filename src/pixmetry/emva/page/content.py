"""Text and numbers of a data sheet by EMVA 1288, with camera and conditions; HTML page and PDF have the same text."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.emva.files.keys import KEYS, NONLINEAR, PTC_LIMIT_PERCENT, Key, key_of
from pixmetry.emva.linear_model import CURVED, FAILS, HOLDS, OPEN, UNKNOWN, linear_model
from pixmetry.report.numbers import NO_BREAK, NONE, PrintedNumber, fixed, pretty_unit, printed_number, short, significant

if TYPE_CHECKING:
    from pixmetry.core.number import Number
    from pixmetry.emva.records import DataSheet, Results

HEADLINE = ("QE", "sigma_d", "u_e_sat", "DR_dB")
GENERAL_HEADLINE = ("general_u_p_min", "general_u_p_sat", "general_SNR_max_dB", "general_DR_dB")
GRAVITY = (HOLDS, UNKNOWN, OPEN, FAILS, CURVED)  # of what is found of a camera's channels the last counts
MAIN = (
    *("QE", "R", "K", "inverse_K", "sigma_y_dark", "sigma_d", "u_p_min", "u_e_min", "u_p_sat", "u_e_sat", "SNR_max", "SNR_max_dB"),
    *("DR_dB", "LE", "u_I_mean", "u_I_var", "DSNU1288", "DSNU1288_row", "DSNU1288_col", "DSNU1288_pixel"),
    *("PRNU1288", "PRNU1288_row", "PRNU1288_col", "PRNU1288_pixel", "SNR_total_max"),
)
GENERAL = ("general_u_p_min", "general_u_p_sat", "general_SNR_max_dB", "general_DR_dB", "general_DSNU", "general_PRNU")
SECTIONS = {
    "sensitivity": "Sensitivity and temporal noise",
    "linearity": "Linearity",
    "dark_current": "Dark current",
    "spatial": "Spatial non-uniformity",
    "general": "Camera without a model (General)",
    "info": "The series",
    "other": "Other",
}
MANY_DOF = 1000
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w])")
RELEASE_TITLES = {"4.0": "Release 4.0", "3.1": "Release 3.1", "reference": "as the public reference implementation 1.0.2 computes it"}
UNITS = {
    **{"um2": "µm²", "um": "µm", "mm": "mm", "nm": "nm", "c": "°C", "s": "s", "ms": "ms", "hz": "Hz", "mhz": "MHz"},
    **{"dn": "DN", "db": "dB", "rel": ""},
}
LABELS = {
    "sweep": "Series",
    "photons": "Photons per pixel",
    "exposures_s": "Exposure times",
    "dark_stack_frames": "Frames, dark stack",
    "bright_stack_frames": "Frames, bright stack",
    "stack_exposure_s": "Exposure of the stacks",
    "cfa": "Colour filter",
    "photons_u_rel": "u of the photon scale",
    "irradiance_uw_per_cm2": "Irradiance / µW/cm²",
    "f_number": "f-number",
    "sensor_cols": "Columns of the sensor",
    "sensor_rows": "Rows of the sensor",
    "first_col": "First column on the sensor",
    "first_row": "First row on the sensor",
}
SHOWN_APART = {"release", "name", "rows", "cols", "bits", "pitch_x_um", "pitch_y_um", "temperature_c", "wavelength_nm", "sensor"}


@dataclass(frozen=True)
class Row:
    """One value of one channel, all as text; ``method`` holds numbers into the list of methods."""

    key: str
    title: str
    symbol: tuple[str, str]  # base and subscript
    number: PrintedNumber
    dof: str
    nonlinear: str
    clause: str
    method: str
    reason: str


@dataclass(frozen=True)
class MainRow:
    """One main value of all channels."""

    key: str
    title: str
    symbol: tuple[str, str]
    cells: tuple[PrintedNumber, ...]
    unit: str


def release_title(release: str) -> str:
    """The document of the standard that applies, in words."""
    return RELEASE_TITLES.get(release, release)


def symbol_parts(symbol: str) -> tuple[str, str]:
    """Base and subscript of a symbol: ``σ_y.dark`` gives ``σ`` and ``y.dark``."""
    if symbol.startswith("1/"):
        base, sub = symbol_parts(symbol[2:])
        return f"1/{base}", sub
    base, _, sub = symbol.replace("₁₂₈₈", "_1288").partition("_")
    return base, sub


def describe(name: str, unit: str) -> Key:
    """Meaning of a key; an unknown key is returned unchanged."""
    return key_of(name) if name.removesuffix(NONLINEAR) in KEYS else Key("other", name, "", unit)


def say(results: Results, key: str) -> str:
    """A value of a channel in one string; nothing where there is none."""
    value = results.values.get(key)
    return printed_number(value).joined() if value is not None and isfinite(value.value) else ""


def dof_text(value: Number) -> str:
    """Degrees of freedom; above a thousand they make no difference. A dash if there is no uncertainty."""
    if value.dof != value.dof or not value.u > 0:
        return NONE
    if value.dof > MANY_DOF:
        return f">{NO_BREAK}{MANY_DOF}" if isfinite(value.dof) else "∞"
    return significant(value.dof, 2 if value.dof < 100 else 3)


def main_rows(channels: Sequence[Results], keys: Sequence[str]) -> list[MainRow]:
    """The main values of all channels, side by side; only those that some channel has."""
    rows = []
    for key in keys:
        values = [r.values.get(key) for r in channels]
        units = [v.unit for v in values if v is not None]
        if not units:
            continue
        known, unit = describe(key, units[0]), pretty_unit(units[0])
        cells = tuple(PrintedNumber(NONE, "", "") if v is None else _without_unit(printed_number(v), unit) for v in values)
        rows.append(MainRow(key, known.title, symbol_parts(known.symbol), cells, unit))
    return rows


def _without_unit(number: PrintedNumber, unit: str) -> PrintedNumber:
    """A power of ten that stands before the unit goes behind the number, for the unit has a column of its own."""
    power = number.unit.removesuffix(unit).strip(NO_BREAK)
    return PrintedNumber(number.value, f"{number.u} ×{NO_BREAK}{power}".strip() if power else number.u, "")


def main_keys(channels: Sequence[Results]) -> tuple[str, ...]:
    """Values of the first page; those of General as well if it applies to a channel."""
    linearity = () if any("LE" in r.values for r in channels) else ("LE_min", "LE_max")
    return (*MAIN, *linearity, *(GENERAL if any(departs(r) for r in channels) else ()))


def departs(results: Results) -> bool:
    """Whether the photon transfer bends more than the linear model allows, or may do so."""
    return linear_model(results) in (FAILS, OPEN, CURVED)


def methods_of(sheet: DataSheet) -> list[str]:
    """Each method once, in the order of its first use."""
    return list(dict.fromkeys(m for r in sheet.results for name, v in r.values.items() if (m := _method(name, v))))


def _method(name: str, value: Number) -> str:
    """The method without the clause, which has a column of its own."""
    clause = describe(name, value.unit).clause
    return value.method.replace(f" {clause}", "", 1) if clause else value.method


def all_rows(results: Results, methods: Sequence[str]) -> dict[str, list[Row]]:
    """All values of a channel by section; a ``_nonlinear`` value is in the row of the standard's value."""
    sections: dict[str, list[Row]] = {title: [] for title in SECTIONS.values()}
    for name, value in results.values.items():
        if name.endswith(NONLINEAR) and name.removesuffix(NONLINEAR) in results.values:
            continue
        known, beside = describe(name, value.unit), results.values.get(name + NONLINEAR)
        number, used = printed_number(value), [_method(name, value)]
        if name.startswith("index_") and isfinite(value.value):
            number = PrintedNumber(fixed(value.value, 0), "", "")  # one level or the next: no value with a u
        reasons, curved = [value.reason], ""
        if beside is not None:
            found = printed_number(beside)
            curved = found.joined(with_unit=found.unit != number.unit)
            used.append(_method(name + NONLINEAR, beside))
            reasons.append(beside.reason and f"with the non-linearity: {beside.reason}")
        sections[SECTIONS.get(known.section, SECTIONS["other"])].append(
            Row(
                key=name,
                title=known.title,
                symbol=symbol_parts(known.symbol),
                number=number,
                dof=NONE if name.startswith("index_") else dof_text(value),
                nonlinear=curved,
                clause=known.clause,
                method=", ".join(str(methods.index(m) + 1) for m in dict.fromkeys(used) if m),
                reason="; ".join(r for r in reasons if r),
            )
        )
    return {title: rows for title, rows in sections.items() if rows}


def worst_of(channels: Sequence[Results]) -> Results:
    """The channel that decides on the document of a camera: the one with the largest departure from a linear camera."""

    def gravity(results: Results) -> tuple[int, float]:
        departure = results.values.get("PTC_linearity")
        return GRAVITY.index(linear_model(results)), departure.value if departure is not None and isfinite(departure.value) else 0.0

    return max(channels, key=gravity)


def document_lines(channels: Sequence[Results]) -> list[str]:
    """Which document of the standard applies: one verdict for the camera, that of its worst channel."""
    worst = worst_of(channels)
    if len(channels) == 1 or worst.release != "4.0":
        return [document(worst).replace(" %", f"{NO_BREAK}%")]
    verdicts = [linear_model(r) for r in channels]
    few = verdicts.count(linear_model(worst)) < len(channels)
    line = f"{document(worst)[:-1]} (channel {worst.channel}, the farthest{', decides for the camera' if few else ''})."
    return [line.replace(" %", f"{NO_BREAK}%")]


def headline_keys(channels: Sequence[Results]) -> tuple[str, ...]:
    """The values that a reader looks for first: those of the document that applies."""
    return GENERAL_HEADLINE if linear_model(worst_of(channels)) in (FAILS, CURVED) else HEADLINE


def document(results: Results) -> str:
    """The document of the standard that applies to this camera, and the reason."""
    if results.release == "3.1":
        return "Release 3.1 has one document, for linear cameras."
    if results.release == "reference":
        return "The reference implementation 1.0.2 states Release 4.0 but keeps most rules of Release 3.1; these values are for comparison."
    judgement = linear_model(results)
    if judgement == CURVED:
        return f"Release 4.0 General applies: {results.values['PTC_linearity'].reason}."
    if judgement == UNKNOWN:
        return "Release 4.0 Linear, and General beside it; the test of the photon transfer's linearity gave no answer."
    departs_by = f"the photon transfer's local slope departs from its line by {say(results, 'PTC_linearity')}"
    low, high = (significant(float(np.ravel(results.curves["PTC"][f"departure_{end}"])[0]), 3) for end in ("low", "high"))
    at_limit = (
        f"the {low if low == high else f'{low} to {high}'} % that such frames show of a camera at the allowed {PTC_LIMIT_PERCENT:g} %"
    )
    if judgement == OPEN:
        return f"Release 4.0: {departs_by}, within {at_limit}: they do not decide whether Linear or General applies, and both are given."
    if judgement == FAILS:
        return f"Release 4.0 General applies: {departs_by}, more than {at_limit}; the values of Linear are given beside it."
    return f"Release 4.0 Linear applies: {departs_by}, less than {at_limit}."


def notes_of(sheet: DataSheet) -> list[str]:
    """Each note once, with the channels where not all share it; notes that differ in numbers alone give those of one after the other."""
    found: dict[tuple[str, int], dict[str, list[str]]] = {}  # by what they say but for the numbers: the numbers of each channel
    for r in sheet.results:
        said: list[str] = []
        for note in dict.fromkeys(r.notes):
            words = NUMBER.sub("\0", note)
            found.setdefault((words, said.count(words)), {})[r.channel] = NUMBER.findall(note)
            said.append(words)
    notes = []
    for (words, _), by_channel in found.items():
        numbers = [" / ".join(ns if len(set(ns)) > 1 else ns[:1]) for ns in zip(*by_channel.values(), strict=True)]
        note = "".join(part + number for part, number in zip(words.split("\0"), [*numbers, ""], strict=True))
        few = len(by_channel) < len(sheet.results)
        whose = f"Channel{'s' if len(by_channel) > 1 else ''} {', '.join(by_channel)}: " if few else ""
        notes.append(f"{whose}{note}" if few else _sentence(note))
    return notes


def _sentence(note: str) -> str:
    """A note with a capital at its beginning, unless it begins with a key."""
    return note if "_" in note.partition(" ")[0] else note[:1].upper() + note[1:]


def time_scale(longest_s: float) -> tuple[float, str]:
    """Factor from seconds and unit that leave times up to this one readable."""
    return (1.0, "s") if longest_s >= 2 else (1e3, "ms") if longest_s >= 2e-3 else (1e6, "µs")


def facts(sheet: DataSheet) -> list[tuple[str, str]]:
    """Camera and conditions, as label and text."""
    camera, rows = sheet.camera, []
    if camera.get("sensor"):
        rows.append(("Sensor", str(camera["sensor"]).upper()))
    rows.append(("Frame", f"{camera['cols']} × {camera['rows']} pixels" if "cols" in camera and "rows" in camera else "not given"))
    rows.append(("Bits per pixel", str(camera.get("bits", "not given"))))
    rows += _sizes(camera)
    for label, key, unit in (("Wavelength", "wavelength_nm", "nm"), ("Temperature", "temperature_c", "°C")):
        known = camera.get(key) if camera.get(key) is not None else sheet.conditions.get(key)
        rows.append((label, "not given" if known is None else f"{_plain(known)} {unit}"))
    rest = {k: v for part in (camera, sheet.conditions) for k, v in part.items() if k not in SHOWN_APART and v not in (None, "")}
    return rows + [(_label(key), text) for key, value in rest.items() if (text := _with_unit(key, value))]


def _sizes(camera: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Pixel pitch, sensor size and diagonal."""
    x = camera.get("pitch_x_um")
    if x is None:
        return [("Pixel pitch", "not given")]
    y = camera.get("pitch_y_um") or x
    sizes = [("Pixel pitch", f"{short(x)} × {short(y)} µm")]
    if "cols" in camera and "rows" in camera:
        width, height = camera["cols"] * x / 1000, camera["rows"] * y / 1000
        diagonal = significant((width**2 + height**2) ** 0.5)
        sizes.append(("Area of the frame", f"{significant(width)} × {significant(height)} mm, diagonal {diagonal} mm"))
    return sizes


def _suffix(key: str) -> str:
    """The unit that a name carries; nothing where it carries none."""
    last = key.rpartition("_")[2]
    return last if "_" in key and last in UNITS else ""


def _label(key: str) -> str:
    words = key.removesuffix(f"_{_suffix(key)}") if _suffix(key) else key
    return LABELS.get(key) or words.replace("_", " ").capitalize()


def _with_unit(key: str, value: Any) -> str:
    suffix = _suffix(key)
    if suffix == "rel" and isinstance(value, float):
        return f"{short(100 * value)} %" if value else "not included"
    if suffix == "s" and not isinstance(value, str | bool):
        return _times(value)
    return f"{_plain(value)} {UNITS.get(suffix, '')}".strip()


def _times(value_s: Any) -> str:
    """A time or the range of several, in a unit that leaves them readable."""
    every = [float(v) for v in value_s] if isinstance(value_s, Iterable) else [float(value_s)]
    factor, unit = time_scale(max(every, default=0.0))
    return f"{_plain([factor * v for v in every])} {unit}"


def _plain(value: Any) -> str:
    """Any fact as text; of several numbers their range."""
    if isinstance(value, Mapping):
        return ", ".join(f"{_label(str(k)).lower()} {_with_unit(str(k), v)}" for k, v in value.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | str):
        return str(value)
    if not isinstance(value, Iterable):
        return short(float(value))
    parts = list(value)
    if not parts or any(isinstance(v, str | Mapping) for v in parts):
        return ", ".join(_plain(v) for v in parts)
    low, high = short(float(min(parts))), short(float(max(parts)))
    return low if low == high else f"{low} … {high}"
