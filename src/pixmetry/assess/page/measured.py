"""The tables of measured camera values, with those of EMVA 1288 and of the digital twin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.core.number import Estimates, Number
from pixmetry.emva.files.keys import KEYS
from pixmetry.emva.page.content import say
from pixmetry.emva.records import Results
from pixmetry.report import Column, Run, Section, Table, Text, strong
from pixmetry.report.numbers import MINUS, NONE, PrintedNumber, limit, printed_number, significant, uncertain

if TYPE_CHECKING:
    from pixmetry.assess.self_test import SelfTest

STANDARD_ONLY = {
    "SNR_max": "Largest signal-to-noise ratio",
    "DR": "Dynamic range",
    "u_e_min": "Absolute sensitivity threshold, electrons",
    "u_p_min": "Absolute sensitivity threshold, photons",
    "u_p_sat": "Saturation, photons",
}
SMALL_PRINT = (
    "Values of EMVA 1288 Release 3.1 of the camera's frames and of the twin's; the difference in units of its standard uncertainty, that "
    "of both values together."
)
FAR_U = 3.0  # a difference beyond which twin and camera are not the same
PERCENT, PER_1000_PX = (100.0, "%"), (1e5, "%/1000 px")


@dataclass(frozen=True)
class Caption:
    """Display of one estimate: its name in words, the key of the standard's value, factor and unit."""

    title: str
    standard: str = ""
    display: tuple[float, str] | None = None


@dataclass(frozen=True)
class Row:
    """A row of the table, all as text."""

    title: str
    name: str
    number: PrintedNumber
    dof: str
    standard: str
    reason: str


TRANSFER = {
    "gain_dn_per_e": Caption("System gain K", "K"),
    "quantum_efficiency": Caption("Quantum efficiency", "QE", PERCENT),
    "responsivity_dn_per_s": Caption("Signal rate of this series, at zero signal"),
    "offset_dn": Caption("Black level"),
    "dark_noise_e": Caption("Dark noise, white", "sigma_d"),
    "row_noise_e": Caption("Row noise, temporal"),
    "column_noise_e": Caption("Column noise, temporal"),
    "dark_current_e_per_s": Caption("Dark current"),
    "saturation_dn": Caption("Saturation, stored value"),
    "full_well_e": Caption("Saturation, electrons", "u_e_sat"),
    "nonlinearity_a1": Caption("Non-linearity a₁, at the top code", "", PERCENT),
    "nonlinearity_a2": Caption("Non-linearity a₂, at the top code", "", PERCENT),
    "nonlinearity_a3": Caption("Non-linearity a₃, at the top code", "", PERCENT),
    "illumination_noise_rel": Caption("Noise of the light, level to level", "", PERCENT),
}


SPATIAL = {
    "dsnu_total_dn": Caption("DSNU, total", "DSNU1288_DN"),
    "dsnu_pixel_dn": Caption("DSNU, pixels"),
    "dsnu_row_dn": Caption("DSNU, rows"),
    "dsnu_col_dn": Caption("DSNU, columns"),
    "prnu_total_rel": Caption("PRNU, total", "PRNU1288", PERCENT),
    "prnu_pixel_rel": Caption("PRNU, pixels", "", PERCENT),
    "prnu_row_rel": Caption("PRNU, rows", "", PERCENT),
    "prnu_col_rel": Caption("PRNU, columns", "", PERCENT),
    "shading_x_per_px": Caption("Shading, gradient in x", "", PER_1000_PX),
    "shading_y_per_px": Caption("Shading, gradient in y", "", PER_1000_PX),
    "shading_corner_rel": Caption("Shading, loss to the corners", "", PERCENT),
    "shading_pp_rel": Caption("Shading, peak to peak", "", PERCENT),
}


EDGES = {
    "sfr50_x": Caption("Frequency of half response, along x"),
    "sfr50_y": Caption("Frequency of half response, along y"),
    "asymmetry_x": Caption("Asymmetry of the edge, along x"),
    "asymmetry_y": Caption("Asymmetry of the edge, along y"),
}

OPTICS = {
    "spread_var_px2": Caption("Variance of the spread: lens, pixel and plate"),
    "sigma_px": Caption("Lens, standard deviation of a Gaussian"),
    "width_x_px": Caption("Light-sensitive width of the pixel"),
    "width_y_px": Caption("Light-sensitive height of the pixel"),
    "separation_x_px": Caption("Optical low-pass filter, separation along x"),
    "separation_y_px": Caption("Optical low-pass filter, separation along y"),
}


def table(seen: Observations, standard: Results) -> dict[str, list[Row]]:
    """Rows by heading, in the order in which a data sheet gives them."""
    groups = {
        "Photon transfer": _rows(seen.photon_transfer_fit, TRANSFER, standard),
        "Fixed pattern": _rows(seen.spatial_fit, SPATIAL, standard),
        "Converter, defects, patterns": [*_codes(seen), *_defects(seen), *_patterns(seen)],
        "Slanted edges": [] if seen.edges is None else [*_rows(seen.edges.fit, EDGES), *_rows(seen.edges.optics, OPTICS)],
        "By EMVA 1288 alone": [
            Row(title, key, PrintedNumber("", NONE, ""), "", said, "")
            for key, title in STANDARD_ONLY.items()
            if (said := say(standard, key))
        ],
    }
    return {heading: rows for heading, rows in groups.items() if rows}


def _rows(found: Estimates | None, shown: Mapping[str, Caption], standard: Results | None = None) -> list[Row]:
    if found is None:
        return []
    others = {e.name: Caption(e.name) for e in found if e.name not in shown}
    return [
        _row(found[name], caption, standard) if name in found else _missing(name, caption, found.reasons[name], standard)
        for name, caption in {**shown, **others}.items()
        if name in found or name in found.reasons
    ]


def _missing(name: str, caption: Caption, reason: str, standard: Results | None) -> Row:
    """A value that was looked for and cannot be had."""
    return Row(caption.title, name, PrintedNumber(NONE, NONE, ""), "", "" if standard is None else say(standard, caption.standard), reason)


def _row(e: Number, caption: Caption, standard: Results | None) -> Row:
    scale, unit = caption.display or (1.0, e.unit)
    shown = replace(e, value=e.value * scale, u=e.u * scale, unit=unit)
    number = replace(printed_number(shown), u=NONE) if e.is_limit else uncertain(shown.value, shown.u, unit)
    return Row(caption.title, e.name, number, _dof(e.dof), "" if standard is None else say(standard, caption.standard), e.reason)


def _dof(dof: float) -> str:
    return "∞" if not np.isfinite(dof) or dof >= 1e6 else significant(dof, 2 if dof < 100 else 3)


def _codes(seen: Observations) -> list[Row]:
    found = seen.code_errors
    if found is None:
        return []
    rows = _rows(found.fit, {"dnl_rms_lsb": Caption("Differential non-linearity, rms")})
    worst = f"{len(found.codes)} codes tested"
    if len(found.dnl_lsb):
        k = int(np.argmax(np.abs(found.dnl_lsb)))
        worst += f"; the widest departure is code {found.codes[k]}, {significant(float(found.dnl_lsb[k]), 2)} LSB"
    return [*rows, _count("Missing codes", "missing_codes", len(found.missing_codes), worst)]


def _defects(seen: Observations) -> list[Row]:
    if seen.defects is None:
        return []
    kinds = {kind: seen.defects.kind.count(kind) for kind in sorted(set(seen.defects.kind))}
    words = ", ".join(f"{n} {kind}" for kind, n in kinds.items())
    words += f"{'; ' if words else ''}{significant(seen.defects.expected_false, 2)} false alarms expected"
    return [_count("Defect pixels", "defects", len(seen.defects), words)]


def _patterns(seen: Observations) -> list[Row]:
    found = seen.patterns
    if found is None:
        return []
    rows = [_count("Periodic patterns found", "patterns", len(found), f"among {found.n_searched} places of the spectrum")]
    for k in range(min(len(found), 3)):
        where = f"at {found.frequency_x[k]:.4f}, {found.frequency_y[k]:.4f} cycles/px, {'moving' if found.moving[k] else 'fixed'}"
        amplitude = uncertain(float(found.amplitude_dn[k]), float(found.u_amplitude_dn[k]), "DN")
        rows.append(Row(f"Pattern {k + 1}, amplitude", f"pattern_{k + 1}", amplitude, "", "", where))
    words = "amplitude that would be found in half of all cases"
    rows.append(Row("Fixed pattern, weakest to be found", "fixed_limit_dn", limit(found.fixed_limit_dn, "DN"), "", "", words))
    return rows


def _count(title: str, name: str, count: int, reason: str) -> Row:
    return Row(title, name, PrintedNumber(str(count), NONE, ""), "", "", reason)


def twin_section(test: SelfTest) -> Section:
    """The self-test: a sentence, and all values of camera and twin folded away."""
    section = Section("The digital twin beside the camera", [Text(twin_sentence(test))])
    if not test.rows:
        return section
    rows = []
    for r in test.rows:
        far, text = abs(r.difference_u) > FAR_U, f"{r.difference_u:+.1f}".replace("-", MINUS)
        key = KEYS[r.name]
        title = [key.title, *([Run(f" {key.symbol}", "soft")] if key.symbol else [])]
        pair = [printed_number(Number(value, u, unit=r.unit)) for value, u in ((r.camera, r.u_camera), (r.twin, r.u_twin))]
        rows.append([title, *pair, strong(text) if far else text])
    both = [Column("Value", "number", group=whose) for whose in ("Camera", "Twin")]
    columns: list[Column | str] = ["Quantity", *both, Column("Difference / u", "right")]
    folded = section.add_section("All values of camera and twin", Text(SMALL_PRINT, "small soft"), fold=True)
    folded.add(Table("Values of camera and twin", columns, rows))
    return section


def twin_sentence(test: SelfTest) -> str:
    """The outcome in a sentence or two."""
    worst = test.worst
    if worst is None:
        return f"The twin was not tested: {test.reason}." if test.reason else "The twin was not tested."
    far = [KEYS[r.name].title for r in test.rows if abs(r.difference_u) > FAR_U]
    outcome = (
        f"{len(far)} of {len(test.rows)} values differ by more than {FAR_U:g} u of the difference: {', '.join(far)}."
        if far
        else f"All {len(test.rows)} values agree within {FAR_U:g} u of the difference; the farthest is {KEYS[worst.name].title} "
        f"({abs(worst.difference_u):.1f} u)."
    )
    taken = f"It took {test.frames} frames" + ("" if test.frames == test.of else f", where the campaign has {test.of}")
    if test.window is not None:
        taken += f", and of each the {test.window[3]} × {test.window[2]} pixels in the middle"
    return f"The digital twin was put through the same campaign, and its frames were evaluated as the camera's were. {taken}. {outcome}"
