"""The section of an assessment's page on the response to light: the curve, what deviates from it, and the patches."""

from __future__ import annotations

from collections import Counter

import numpy as np

from pixmetry.camera.response import BT709, CUBIC, KNEE, LINEAR, LOG, POWER, Response
from pixmetry.report import Column, Section, Table
from pixmetry.report.drawing import BLUE, INK, RED, canvas, line
from pixmetry.report.numbers import printed_number, significant, uncertain
from pixmetry.report.page import Figure

MOST_ROWS = 60
WORDS = (
    "OECF as in ISO 14524, of one camera with its lens and light: uneven light, glare and the errors of the densities are unknowns of the "
    "fit, so they are in u. Light 1 is the brightest patch."
)
CURVE_WORDS = {
    LINEAR: "a straight line",
    CUBIC: "a straight line with a cubic bend",
    POWER: "a power curve",
    BT709: "a power curve with a straight toe",
    LOG: "a logarithm",
    KNEE: "two straight lines with a knee",
}
VALUES = {
    "gamma": "exponent",
    "reference_dn": "reference",
    "switch_dn": "knee at",
    "mismatch_rel": "relative change of the slope",
    "foot_e": "foot",
    "gain_dn_per_v": "slope for kT/q",
    "gain_dn_per_e": "gain",
    "black_dn": "black",
}


def response_section(found: Response) -> Section:
    """Figure, patches, and why others were refused."""
    section = Section("Response to light", name="response").add_text(response_sentence(found))
    if found.curve:
        section.add_text(WORDS, style="small soft")
        section.add(response_figure(found))
        columns: list[Column | str] = ["Curve", Column("χ²", "right"), Column("dof", "right"), Column("BIC", "right")]
        rows = [[CURVE_WORDS[f.curve], significant(f.chi2, 3), str(f.dof), significant(f.bic, 3)] for f in found.tried]
        section.add_section("Curves that were tried", fold=True).add(Table("Curves, the chosen one first", columns, rows))
    if found.patches:
        columns = [Column("Picture", "right"), "x, y / px", Column("Light", "right"), Column("Value / DN", "right"), Column("± u", "u")]
        columns.append(Column("Noise / DN", "right"))
        rows = []
        for p in found.patches[:MOST_ROWS]:
            number = uncertain(p.mean_dn, p.u_mean_dn, "DN")
            noise = "–" if not np.isfinite(p.var_dn2) else significant(np.sqrt(p.var_dn2), 2)
            rows.append([str(p.picture + 1), f"{p.x}, {p.y}", significant(p.light_rel, 3), number.value, f"± {number.u}", noise])
        title = "The patches" if len(found.patches) <= MOST_ROWS else f"The first {MOST_ROWS} of {len(found.patches)} patches"
        section.add_section("Patch by patch", fold=True).add(Table(title, columns, rows))
    if found.refused:
        counts = Counter(found.refused)
        table = Table("Not used", ["Reason", Column("Times", "right")], [[why, str(n)] for why, n in counts.most_common(12)])
        section.add_section("Patches that were not used", fold=True).add(table)
    return section


def response_sentence(found: Response) -> str:
    """Which curve the patches follow, and its numbers."""
    if not found.curve:
        why = next(iter(found.fit.reasons.values()), "no patches")
        return f"The response was not measured: {why}."
    parts = []
    for name, word in VALUES.items():
        if name in found.fit:
            number = found.fit[name]
            shown = printed_number(number) if number.is_limit else uncertain(number.value, number.u, number.unit)
            parts.append(f"{word} {shown.value}{'' if number.is_limit else f' ± {shown.u}'} {shown.unit}".strip().removesuffix(" 1"))
    return f"{len(found.patches)} patches follow {CURVE_WORDS[found.curve]}: {', '.join(parts)}."


def response_figure(found: Response) -> Figure:
    """The curve over the logarithm of the light, and its uncertainty below."""
    with canvas(4.1, nrows=2, height_ratios=[3, 2]) as (figure, (top, low)):
        line(top, found.light_rel, found.level_dn, color=BLUE, label=CURVE_WORDS[found.curve])
        if len({p.place for p in found.patches}) > 0 and found.pictures < 3:
            light = np.array([p.light_rel for p in found.patches])
            line(
                top,
                light / light.max(),
                np.array([p.mean_dn for p in found.patches]),
                color=INK,
                marker=".",
                linestyle="none",
                label="patches",
            )
        top.set_xscale("log")
        top.set_xlabel("light, of the brightest")
        top.set_ylabel("stored value / DN")
        top.legend(loc="upper left")
        line(low, found.level_dn, 100 * found.u_light_rel, color=BLUE, label="u of the light / %")
        if np.isfinite(found.gain_dn_per_e).any():
            line(low, found.level_dn, 100 * found.gain_dn_per_e, color=RED, linestyle="--", label="local gain / (DN per 100 e⁻)")
        low.set_xlabel("stored value / DN")
        low.set_yscale("log")
        low.legend(loc="upper right")
        alt = f"Response of the camera to light. {response_sentence(found)}"
        caption = (
            "Stored value against light. Below: standard uncertainty of the light that a stored value stands for, relative to that of the "
            "brightest patch, and the local gain: stored values per electron."
        )
        return Figure(figure, "response", alt, caption)
