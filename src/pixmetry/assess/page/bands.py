"""The section of an assessment's page on targets in light of several wavelengths."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.colour_bands import ColourBands
from pixmetry.core.number import Number
from pixmetry.report import Column, Section, Table
from pixmetry.report.drawing import BLUE, RED, canvas
from pixmetry.report.numbers import significant, uncertain
from pixmetry.report.page import Figure

TITLES = {
    "scale_per_nm": ("Lateral colour: change of the scale per nm", "1/nm"),
    "diffusion_length_um": ("Diffusion length in silicon", "µm"),
    "peak_rel": ("Transmittance of the filter in its band", "1"),
    "cut_nm": ("End of the filter's band", "nm"),
    "plate_um": ("Thickness of the filter's plate", "µm"),
}


def bands_section(found: ColourBands) -> Section:
    """Sentence, figure, values, and a table of the bands."""
    section = Section("Light of several wavelengths", name="bands").add_text(summary_sentence(found)).add(bands_figure(found))
    rows = []
    for fit in (found.colour, found.diffusion, found.filter):
        rows += [[TITLES[n.name][0], n, n.reason] for n in fit if n.name in TITLES]
        rows += [[TITLES[n][0], Number.not_available(TITLES[n][1], why), why] for n, why in fit.reasons.items() if n not in fit]
    section.add(Table("What the bands tell", ["Quantity", Column("Value", "number"), "Note"], rows))
    columns: list[Column | str] = ["Band", Column("Targets", "right"), Column("Blur / px", "right"), Column("Off focus / µm", "right")]
    columns += [Column("Scale, ppm", "right"), Column("Light / DN/s", "right")]
    each = []
    for k, nm in enumerate(found.wavelength_nm):
        name = " ".join(filter(None, (f"{nm:g} nm", found.names[k], "with filter" if found.filtered[k] else "")))
        values = (np.sqrt(np.maximum(found.blur_var_px2[k], 0.0)), found.focus_um[k], 1e6 * found.scale_rel[k], found.level_dn_per_s[k])
        each.append([name, str(found.targets[k]), *(significant(float(v), 3) if np.isfinite(v) else "–" for v in values)])
    section.add(Table("The bands", columns, each))
    if found.transmittance.size:
        through = zip(found.transmittance_nm, found.transmittance, found.u_transmittance, strict=True)
        ratios = [[f"{nm:g} nm", Number(float(value), float(u)), ""] for nm, value, u in through]
        section.add(Table("Light with the filter over that without it", ["Band", Column("Transmittance", "number"), "Note"], ratios))
    return section


def summary_sentence(found: ColourBands) -> str:
    """How many bands, and what moves with the wavelength."""
    text = f"Targets in {len(found.wavelength_nm)} bands from {found.wavelength_nm.min():g} to {found.wavelength_nm.max():g} nm. "
    if "scale_per_nm" in found.colour:
        slope = found.colour["scale_per_nm"]
        return text + f"The scale of the image changes by {uncertain(1e9 * slope.value, 1e9 * slope.u, 'ppb per nm').joined()}."
    return text + f"Lateral colour is not told: {found.colour.reasons['scale_per_nm']}."


def bands_figure(found: ColourBands) -> Figure:
    """Scale and blur over the wavelength."""
    with canvas(2.6, ncols=2) as (figure, (left, right)):
        for own, colour, label in ((~found.filtered, BLUE, "without filter"), (found.filtered, RED, "with filter")):
            if not own.any():
                continue
            nm = found.wavelength_nm[own]
            left.errorbar(nm, 1e6 * found.scale_rel[own], 2e6 * found.u_scale_rel[own], fmt="o", markersize=3, color=colour, label=label)
            right.errorbar(nm, found.blur_var_px2[own], 2 * found.u_blur_var_px2[own], fmt="o", markersize=3, color=colour, label=label)
        left.set_xlabel("wavelength / nm")
        left.set_ylabel("scale against the mean / ppm")
        right.set_xlabel("wavelength / nm")
        right.set_ylabel("variance of the blur / px²")
        right.legend(loc="best")
        caption = "Left: scale of the field of targets. Right: variance of the blur of their edges along an axis. Bars are ± 2 u."
        return Figure(figure, "bands", f"Scale and blur by the wavelength. {summary_sentence(found)}", caption)
