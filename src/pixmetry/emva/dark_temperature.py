"""Campaigns of one camera at several temperatures, and the law of their dark currents."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import Estimates, Number
from pixmetry.core.progress import Progress
from pixmetry.emva.files.keys import OVER_TEMPERATURES
from pixmetry.emva.files.sheets import check_names, named
from pixmetry.emva.job import Options, tested, write_sheet
from pixmetry.emva.records import DataSheet
from pixmetry.files import Campaign, load_campaign
from pixmetry.observe.dark_temperature import check_temperatures, fit_dark_temperature, law_at


def dark_current_law(
    campaigns: Sequence[str | Path | Campaign],
    *,
    release: str = "4.0",
    bayer: str | None = None,
    photons_u_rel: float = 0.0,
    bootstrap: int = 0,
    progress: Progress | None = None,
    json: str | Path | None = None,
    xml: str | Path | None = None,
    report: str | Path | None = None,
    pdf: str | Path | None = None,
) -> tuple[DataSheet, Estimates]:
    """Test a camera at several temperatures; parameters as of `pixmetry.emva1288`.

    Returns
    -------
    tuple
        The data sheet of the first campaign, with the values ``u_I_ref`` and ``T_d``, the curve ``dark_temperature`` and the files of all
        campaigns among its inputs, and the law of the dark current (of the first channel) as
        `pixmetry.observe.dark_temperature.fit_dark_temperature` gives it, for the temperature of the first campaign.

    Raises
    ------
    InputError, MeasureError
        As from `pixmetry.emva1288`; before any frame is read, if a temperature is not known, there are fewer than three, or they are too
        near to each other; and if a campaign gives no dark current.
    """
    options = Options(release, bayer, photons_u_rel, bootstrap)
    files = named(json=json, xml=xml, report=report, pdf=pdf)
    check_names(files)
    loaded = [c if isinstance(c, Campaign) else load_campaign(c) for c in campaigns]
    _check_same_camera(loaded, bayer)
    temperature_c = np.array([_temperature_c(c) for c in loaded])
    check_temperatures(temperature_c)
    inputs = [path for c in loaded for path in c.files]
    check_names(files, inputs)
    sheets, currents = [], []
    for campaign in loaded:
        sheets.append(tested(campaign, options, progress))
        currents.append(_current(sheets[-1], campaign))
    sheet, law = _with_law(sheets[0], temperature_c, currents)
    names = list(dict.fromkeys(c.camera.name for c in loaded))
    if len(names) > 1:
        note = f"the data sets at different temperatures name different cameras: {', '.join(names)}"
        sheet = replace(sheet, results=tuple(replace(r, notes=(*r.notes, note)) for r in sheet.results))
    sheet = replace(sheet, provenance={**sheet.provenance, "inputs": _inputs(loaded, sheets)})
    write_sheet(sheet, files, inputs, progress)
    return sheet, law


def _check_same_camera(campaigns: Sequence[Campaign], bayer: str | None) -> None:
    """Refuse campaigns that cannot be of one camera."""
    for campaign in campaigns[1:]:
        for what, (found, first) in {
            "size of the frames": (campaign.frame_shape[::-1], campaigns[0].frame_shape[::-1]),
            "bits": (campaign.bits, campaigns[0].bits),
            "colour filter": (bayer or campaign.camera.cfa, bayer or campaigns[0].camera.cfa),
        }.items():
            if found != first:
                raise InputError(
                    f"another camera: the {what} differs from that of {campaigns[0].source_path}",
                    where=str(campaign.source_path),
                    value=found,
                    allowed=str(first),
                    remedy="name campaigns of one camera",
                )


def _temperature_c(campaign: Campaign) -> float:
    found = campaign.camera.temperature_c
    if found is None:
        remedy = "write camera: temperature_c into its manifest"
        raise InputError("the temperature is not known", where=str(campaign.source_path), remedy=remedy)
    return found


def _current(sheet: DataSheet, campaign: Campaign) -> Number:
    found = sheet.results[0].values["u_I_mean"]
    if not (math.isfinite(found.value) and found.u > 0):
        remedy = "take dark levels at three exposure times or more, or leave this campaign out"
        raise MeasureError("no dark current was measured", where=str(campaign.source_path), value=found.reason or None, remedy=remedy)
    return found


def _with_law(sheet: DataSheet, temperature_c: Array, currents: Sequence[Number]) -> tuple[DataSheet, Estimates]:
    """Fit the dark currents against temperature, and add values, curve and a note to the sheet of the first temperature."""
    current, u = np.array([v.value for v in currents]), np.array([v.u for v in currents])
    reference_c = float(temperature_c[0])
    law = fit_dark_temperature(temperature_c, current, u, reference_c=reference_c)
    found = dict(zip(OVER_TEMPERATURES, (law["dark_current_ref"], law["doubling_temperature_k"]), strict=True))
    values = {key: replace(e, name="") for key, e in found.items()}
    curve = {
        "temperature_c": temperature_c,
        "current_e_per_s": current,
        "u_e_per_s": u,
        "fit_e_per_s": law_at(law, temperature_c, reference_c=reference_c),
        "doubling_k": np.array([values["T_d"].value]),
    }
    first, *others = sheet.results
    temperatures = ", ".join(f"{t:g}" for t in temperature_c)
    note = f"u_I_ref, the dark current at {reference_c:g} °C, and T_d follow from {len(currents)} data sets, at {temperatures} °C"
    curves, notes = {**first.curves, "dark_temperature": curve}, (*first.notes, note)
    first = replace(first, values={**first.values, **values}, curves=curves, notes=notes)
    return replace(sheet, results=(first, *others)), law


def _inputs(campaigns: Sequence[Campaign], sheets: Sequence[DataSheet]) -> list[dict[str, object]]:
    """Records of the files of all campaigns, named by the last name of their folder, numbered where two are the same."""
    bases = list(dict.fromkeys(c.base for c in campaigns))
    names = [base.resolve().name for base in bases]
    labels = {base: name if names.count(name) == 1 else f"{name}-{k}" for k, (base, name) in enumerate(zip(bases, names, strict=True), 1)}
    found = {}
    for campaign, sheet in zip(campaigns, sheets, strict=True):
        for record in sheet.provenance["inputs"]:
            name = f"{labels[campaign.base]}/{record['name']}"
            found[name] = {**record, "name": name}
    return list(found.values())
