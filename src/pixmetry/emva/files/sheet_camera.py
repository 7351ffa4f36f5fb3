"""The camera of a data sheet of EMVA 1288: what the test measured, in the chain, with its uncertainties."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pixmetry.camera.camera import SHEET_SCHEMA, Camera
from pixmetry.camera.data_sheet import UNITS, DataSheetRecord, build_sheet_camera
from pixmetry.camera.provenance import MEASURED
from pixmetry.core.config import validate
from pixmetry.core.errors import InputError
from pixmetry.core.number import ONE_SIDED_95, UPPER_LIMIT, Number
from pixmetry.emva.records import MONO, DataSheet, Results

USED = {
    "quantum_efficiency": ("QE",),
    "gain_dn_per_e": ("K",),
    "read_noise_e": ("sigma_d",),
    "saturation_capacity_e": ("u_e_sat",),
    "dark_current_e_per_s": ("u_I_ref", "u_I_mean", "u_I_var"),
    "dsnu_e": ("DSNU1288",),
    "dsnu_pixel_e": ("DSNU1288_pixel",),
    "dsnu_row_e": ("DSNU1288_row",),
    "dsnu_col_e": ("DSNU1288_col",),
    "prnu_rel": ("PRNU1288",),
    "prnu_pixel_rel": ("PRNU1288_pixel",),
    "prnu_row_rel": ("PRNU1288_row",),
    "prnu_col_rel": ("PRNU1288_col",),
    "nonlinearity_rel": ("LE",),
}
"""Keys of the public result format by the name of the number in a data-sheet file; the first that has a value is taken."""
FORMAT = ("bits", "rows", "cols")
GREEN = "Gr"  # the channel of a colour camera that is taken, where none is named


def camera_of_sheet(sheet: DataSheet, channel: str = "", told: Mapping[str, Any] | None = None) -> Camera:
    """Build a camera of the result of a test by EMVA 1288.

    Parameters
    ----------
    sheet : DataSheet
        From `pixmetry.emva.files.sheets.read_sheet`, or of `pixmetry.emva1288`.
    channel : str
        Of a colour camera: ``R``, ``Gr``, ``Gb`` or ``B``; by default ``Gr``.
    told : mapping, optional
        What is known of the camera from elsewhere, as ``bits``, ``rows``, ``cols``, ``pitch_x_um``, ``name``; what the sheet says of these
        goes before it.

    Returns
    -------
    Camera
        Its elements are known from ``measured`` where the sheet has a value, with u and degrees of freedom; limits stay limits. The
        rest is ``typical``, as in `pixmetry.camera.data_sheet.camera_of_data_sheet`. Its frames are those of the whole sensor, where the
        sheet tells its size beside that of the frames of the test.

    Raises
    ------
    InputError
        If nothing tells bits, rows and columns (the sheet of another program may not), or a value cannot be a camera's.

    Examples
    --------
    >>> from pixmetry.core.number import Number
    >>> from pixmetry.emva.records import DataSheet, Results
    >>> values = {"K": Number(0.38, 0.002, 40.0, "DN/e⁻"), "sigma_d": Number(2.3, 0.01, 300.0, "e⁻")}
    >>> sheet = DataSheet((Results("4.0", values),), {"name": "K", "bits": 12, "rows": 480, "cols": 640}, {}, {})
    >>> camera = camera_of_sheet(sheet)
    >>> camera["electronics.gain"].known_from, camera.estimates["electronics.gain"]["gain_dn_per_e"].u
    ('measured', 0.002)
    """
    about = {**(told or {}), **{key: value for key, value in sheet.camera.items() if value is not None}}
    about |= {key: about[f"sensor_{key}"] for key in ("rows", "cols") if about.get(f"sensor_{key}") is not None}
    name = str(about.get("name") or about.get("model") or "camera of a data sheet")
    missing = [key for key in FORMAT if about.get(key) is None]
    if missing:
        remedy = "name a data-sheet file or a preset of the camera beside it, or the JSON or XML of `pixmetry emva1288`"
        raise InputError(f"a data sheet that does not say {' and '.join(missing)}", where=name, remedy=remedy)
    results = _results_of(sheet, channel, name)
    same = ("bits", "rows", "cols", "interface", "sensor", "temperature_c", "wavelength_nm")
    head: dict[str, Any] = {key: about[key] for key in same if about.get(key) is not None}
    if about.get("cfa") in ("RGGB", "GRBG", "GBRG", "BGGR"):
        head["colour"] = about["cfa"]
    exposure = sheet.conditions.get("stack_exposure_s")
    if isinstance(exposure, int | float) and exposure > 0:
        head["exposure_s"] = exposure
    said = f"EMVA 1288 Release {results.release}" if results.release else "EMVA 1288"
    record = {"schema": SHEET_SCHEMA, "name": name, "source": f"measured by {said}"} | head
    x, y = about.get("pitch_x_um"), about.get("pitch_y_um")
    pitch = None if x is None else (float(x), float(x if y is None else y))
    return build_sheet_camera(validate(DataSheetRecord, record, name), _numbers(results), pitch, MEASURED, name)


def _results_of(sheet: DataSheet, channel: str, where: str) -> Results:
    """The values of one channel."""
    there = {results.channel: results for results in sheet.results}
    wanted = channel or (MONO if MONO in there else GREEN if GREEN in there else next(iter(there), MONO))
    if wanted not in there:
        raise InputError("no such channel", where=where, value=wanted, allowed=", ".join(there) or "none: the sheet is empty")
    return there[wanted]


def _numbers(results: Results) -> dict[str, Number]:
    """The values by the names of a data-sheet file, in its units."""
    found = {}
    for name, keys in USED.items():
        value = next((results.values[key] for key in keys if key in results.values and results.values[key].is_available), None)
        if value is not None:
            share = 0.01 if value.unit == "%" else 1.0
            total = name.replace("_pixel", "")
            found[name] = _possible(replace(value, value=share * value.value, u=share * value.u, unit=UNITS[total]))
    return found


def _possible(number: Number) -> Number:
    """The number, or where it lies below 0 the upper limit that it gives."""
    if number.value >= 0:
        return number
    limit = ONE_SIDED_95 * number.u if number.u > 0 else 0.0
    reason = f"{number.value:.3g} ± {number.u:.2g}: not significant" if math.isfinite(number.u) else f"{number.value:.3g}: not significant"
    return replace(number, value=limit, kind=UPPER_LIMIT, reason=reason)
