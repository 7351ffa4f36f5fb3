"""Facts and provenance of a data sheet as label and text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from pixmetry.emva.page.content import short, time_scale
from pixmetry.report.numbers import significant

if TYPE_CHECKING:
    from pixmetry.emva.records import DataSheet

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
