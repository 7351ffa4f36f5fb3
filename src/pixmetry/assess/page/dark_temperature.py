"""The section of an assessment's page on the dark current at several temperatures."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.observations import DarkTemperatures
from pixmetry.core.number import Number
from pixmetry.report import Column, Section, Table
from pixmetry.report.drawing import BLUE, INK, canvas, line
from pixmetry.report.numbers import printed_number, significant
from pixmetry.report.page import Figure


def dark_temperature_section(found: DarkTemperatures) -> Section:
    """Sentence, figure and table."""
    section = Section("Dark current and temperature", name="dark-temperature").add_text(summary_sentence(found))
    if found.temperature_c.size:
        if np.any(found.rate_dn_per_s > 0):
            section.add(law_figure(found))
        each = zip(found.temperature_c, found.rate_dn_per_s, found.u_rate_dn_per_s, strict=True)
        rows = [[significant(float(t)), printed_number(Number(float(rate), float(u))).joined()] for t, rate, u in each]
        section.add(Table("Dark signal", [Column("Temperature / °C", "right"), Column("Dark signal / DN/s", "right")], rows))
    return section


def summary_sentence(found: DarkTemperatures) -> str:
    """The doubling temperature, or why there is none."""
    name = "doubling_temperature_k"
    if name not in found.fit:
        return f"The temperature step that doubles the dark current is not measured: {found.fit.reasons[name]}."
    value = found.fit[name]
    remark = f" ({value.reason})" if value.reason else ""
    return f"The dark current doubles every {printed_number(value).joined()}{remark}."


def law_figure(found: DarkTemperatures) -> Figure:
    """Dark signal against temperature, with the law."""
    with canvas(2.6) as (figure, axes):
        shown = found.rate_dn_per_s > 0
        rate, u = found.rate_dn_per_s[shown], found.u_rate_dn_per_s[shown]
        axes.errorbar(
            found.temperature_c[shown], rate, np.minimum(2 * u, 0.9 * rate), color=BLUE, marker="o", markersize=3, linestyle="none"
        )
        if "doubling_temperature_k" in found.fit:
            at, step = found.fit["dark_current_ref"].value, found.fit["doubling_temperature_k"].value
            t = np.linspace(found.temperature_c.min(), found.temperature_c.max(), 50)
            line(axes, t, at * 2 ** ((t - found.reference_c) / step), color=INK, linestyle="--", linewidth=0.8)
        axes.set_yscale("log")
        axes.set_xlabel("temperature of the sensor / °C")
        axes.set_ylabel("dark signal / DN/s")
        alt = f"Dark signal against temperature. {summary_sentence(found)}"
        return Figure(figure, "dark-temperature", alt, "Dark signal a second against temperature, ± 2 u. Dashed: the fitted doubling.")
