"""The data sheet of a test by EMVA 1288 as one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from pixmetry import __version__
from pixmetry.emva.page import content
from pixmetry.emva.page.facts import facts, provenance
from pixmetry.report.templates import filled, share_styles

if TYPE_CHECKING:
    from pixmetry.emva.page.figures import Plot
    from pixmetry.emva.records import DataSheet, Results
    from pixmetry.report.drawing import Picture

PLOT_HEIGHT_IN = 2.4


def render(sheet: DataSheet) -> str:
    """Return the page of a data sheet as text."""
    return share_styles(filled("emva.html.jinja", _content(sheet)))


def _content(sheet: DataSheet) -> dict[str, Any]:
    channels, methods = sheet.results, content.methods_of(sheet)
    plots = [(r, all_plots(r)) for r in channels]
    return {
        "version": __version__,
        "name": str(sheet.camera.get("name", "Camera")),
        "release": content.release_title(channels[0].release),
        "documents": content.document_lines(channels),
        "facts": facts(sheet),
        "headline": _headline(channels[0], content.headline_keys(channels)) if len(channels) == 1 else [],
        "channels": [r.channel for r in channels],
        "main": content.main_rows(channels, content.main_keys(channels)),
        "small": [_picture(p, k) for k, p in enumerate(summary_plots(channels, plots))],
        "notes": content.notes_of(sheet),
        "values": [(r.channel, content.all_rows(r, methods)) for r in channels],
        "methods": methods,
        "plots": [(r.channel, _grouped(p, 100 * (k + 1))) for k, (r, p) in enumerate(plots)],
        "provenance": provenance(sheet),
        "inputs": sheet.provenance.get("inputs", ()),
        "licence": sheet.licence,
    }


def all_plots(results: Results) -> list[Plot]:
    """Every plot of one channel, those that cannot be drawn with the sentence in their place."""
    from pixmetry.emva.page.dark_figures import dark_and_general_plots
    from pixmetry.emva.page.series_figures import series_plots
    from pixmetry.emva.page.spatial_figures import spatial_plots

    return [*series_plots(results), *dark_and_general_plots(results), *spatial_plots(results)]


def summary_plots(channels: tuple[Results, ...], plots: list[tuple[Results, list[Plot]]]) -> list[Plot]:
    """Photon transfer and signal-to-noise ratio for the first page: of a colour camera all channels in one plot."""
    from pixmetry.emva.page.series_figures import snr_together, together

    if len(channels) == 1:
        return [p for p in plots[0][1] if p.draw is not None and p.title in ("Photon transfer", "Signal-to-noise ratio")]
    every = (("PTC", together), ("SNR", snr_together))
    return [make(having) for curve, make in every if (having := [r for r in channels if r.curves.get(curve)])]


def _headline(results: Results, keys: Iterable[str]) -> list[dict[str, Any]]:
    """The values that a reader looks for first, with their u."""
    shown = []
    for key in keys:
        value = results.values.get(key)
        if value is not None and value.value == value.value:
            number = content.number_of(value)
            base, sub = content.symbol_parts(content.describe(key, value.unit).symbol)
            shown.append({"base": base, "sub": sub, "text": number.value, "u": number.u, "unit": number.unit})
    return shown


def _grouped(plots: list[Plot], first: int) -> dict[str, list[Picture | Plot]]:
    """Pictures by group, in the order of the plots; ``first`` numbers them through the page."""
    groups: dict[str, list[Picture | Plot]] = {}
    for k, p in enumerate(plots):
        groups.setdefault(p.group, []).append(p if p.draw is None else _picture(p, first + k))
    return groups


def _picture(plot: Plot, number: int) -> Picture:
    from pixmetry.emva.page.figures import fill
    from pixmetry.report.drawing import WIDTH_IN, canvas, picture

    with canvas(PLOT_HEIGHT_IN) as (figure, axes):
        figure.set_layout_engine("none")
        fill(plot, axes, (0, 0, WIDTH_IN, PLOT_HEIGHT_IN))
        return picture(figure, f"p{number}", f"{plot.title}. {plot.alt}", plot.caption)
