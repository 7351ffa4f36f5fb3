"""The section of an assessment's page on slanted edges: their frequency response, and a table of them."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from pixmetry.camera.observations import SlantedEdge, SlantedEdges
from pixmetry.report import Column, Section, Table
from pixmetry.report.drawing import BLUE, GRID, INK, RED, SOFT, canvas, line
from pixmetry.report.numbers import printed_number, significant, uncertain
from pixmetry.report.page import Figure

MOST_ROWS = 60  # of the table; the record has all
MOST_DRAWN = 24  # edges that are drawn one by one
SHOWN_PX = 6.0
WORDS = (
    "e-SFR by ISO 12233:2023, along the normal of each edge, corrected for the bins of 1/4 px and their differences. It is the response of "
    "everything from the lens to the stored value, of the printed edge too."
)


def edges_section(found: SlantedEdges) -> Section:
    """Figure, table of the measured edges, and why others were refused."""
    section = Section("Slanted edges", name="edges").add_text(summary_sentence(found))
    if found.edges:
        section.add_text(WORDS, style="small soft")
        section.add(response_figure(found))
        columns: list[Column | str] = ["Step along", Column("x, y / px"), Column("Angle / °", "right"), Column("Rows", "right")]
        columns += [Column(title, "right") for title in ("Levels / DN", "SFR50 / cycles/px", "Asymmetry", "Noise / DN")]
        title = f"The {len(found.edges)} edges" if len(found.edges) <= MOST_ROWS else f"The first {MOST_ROWS} of {len(found.edges)} edges"
        folded = section.add_section("Edge by edge", fold=True)
        folded.add(Table(title, columns, [_row(e) for e in found.edges[:MOST_ROWS]]))
    if found.refused:
        reasons = Counter(r.reason.split(":")[0] for r in sorted(found.refused, key=lambda r: -r.rows))
        folded = section.add_section("Edges that were found and not measured", fold=True)
        folded.add(Table("Refused edges", ["Reason", Column("Edges", "right")], [[why, str(n)] for why, n in reasons.most_common(12)]))
    return section


def summary_sentence(found: SlantedEdges) -> str:
    """How many edges there are, and where their response is one half."""
    counts = [f"{response.edges} along {axis}" for axis, response in (("x", found.x), ("y", found.y)) if response is not None]
    halves = []
    for axis in "xy":
        if (name := f"sfr50_{axis}") in found.fit:
            number = uncertain(found.fit[name].value, found.fit[name].u, "cycles/px")
            halves.append(f"{number.value} ± {number.u} cycles/px in {axis}")
    if not counts:
        return f"No edge could be measured; {len(found.refused)} were refused." if found.refused else "No edge was found."
    half = f" The response falls to one half at {' and '.join(halves)}." if halves else ""
    shares = [f"{100 * found.fit[n].value:.0f} % in {n[-1]}" for n in ("sampling_efficiency_x", "sampling_efficiency_y") if n in found.fit]
    half += f" Sampling efficiency (frequency of a response of 10 %, over the limit of sampling): {' and '.join(shares)}." if shares else ""
    told = f"{len(found.edges)} edges were measured ({', '.join(counts)}); {len(found.refused)} were refused.{half}"
    return " ".join([told, *_parts_of_blur(found), *_line_words(found)])


def _parts_of_blur(found: SlantedEdges) -> list[str]:
    """What the joint fit says of lens, pixel and plate, in a sentence; or why it cannot."""
    optics = found.optics
    if "airy_px" not in optics and "sigma_px" not in optics:
        why = optics.reasons.get("spread_var_px2", "")
        return [f"Lens and pixel are not told apart: {why}."] if why else []
    words = {"sigma_px": "lens", "airy_px": "lens limited by diffraction, λN", "width_x_px": "pixel in x", "width_y_px": "pixel in y"}
    words |= {"separation_x_px": "low-pass filter in x", "separation_y_px": "low-pass filter in y"}
    parts = []
    for name, word in words.items():
        if name in optics:
            value = optics[name]
            number = printed_number(value) if value.is_limit else uncertain(value.value, value.u, "px")
            parts.append(f"{word} {number.value}{'' if value.is_limit else f' ± {number.u}'} px")
    return [f"Fitted together: {', '.join(parts)}."]


def _line_words(found: SlantedEdges) -> list[str]:
    """How much the video line of an analogue camera delays, and what was told apart in it."""
    if found.line is None:
        return []
    if "delay_px" not in found.line:
        return [f"The video line is not told: {next(iter(found.line.reasons.values()), 'no edge could be measured')}."]
    delay = uncertain(found.line["delay_px"].value, found.line["delay_px"].u, "px")
    words = {"cutoff_rel": "a low-pass filter", "natural_rel": "the video amplifier", "ghost_rel": "an echo of the cable"}
    words |= {"branch_px": "an open branch"}
    parts = [word for name, word in words.items() if name in found.line]
    told = f"; measured in it: {', '.join(parts)}" if parts else ""
    return [f"The video line delays by {delay.value} ± {delay.u} px{told}."]


def _row(edge: SlantedEdge) -> list[Any]:
    half = "–" if not np.isfinite(edge.sfr50) else uncertain(edge.sfr50, edge.u_sfr50, "")
    skew = uncertain(edge.asymmetry, edge.u_asymmetry, "")
    angle = f"{edge.angle_deg:.2f}".replace("-", "−")
    levels = f"{significant(edge.low_dn)} to {significant(edge.high_dn)}"
    return [edge.across, f"{edge.x_px:.1f}, {edge.y_px:.1f}", angle, str(edge.rows), levels, half, skew, significant(edge.noise_dn, 2)]


def response_figure(found: SlantedEdges) -> Figure:
    """Frequency response of both directions with ± 2 u, and the edge spread of single edges below."""
    drawn = found.edges[:: max(1, len(found.edges) // MOST_DRAWN)]
    with canvas(4.1, nrows=2, height_ratios=[3, 2]) as (figure, (top, low)):
        for edge in drawn:
            line(top, found.frequency, edge.sfr, color=GRID, linewidth=0.6)
        for axis, response, colour, dash in (("x", found.x, BLUE, "-"), ("y", found.y, RED, "--")):
            if response is None:
                continue
            u = np.sqrt(np.diag(response.covariance))
            top.fill_between(found.frequency, response.sfr - 2 * u, response.sfr + 2 * u, color=colour, alpha=0.2, linewidth=0)
            line(top, found.frequency, response.sfr, color=colour, linestyle=dash, label=f"along {axis}, {response.edges} edges")
        top.axvline(0.5, color=SOFT, linewidth=0.6, linestyle=":")
        top.axhline(0, color=SOFT, linewidth=0.6)
        top.set_xlim(0, 1.5)
        top.set_ylim(-0.05, 1.1)
        top.set_xlabel("frequency / cycles/px")
        top.set_ylabel("response")
        top.legend(loc="upper right")
        for edge in drawn:
            near = np.abs(edge.distance_px) <= SHOWN_PX
            colour = BLUE if edge.across == "x" else RED
            line(low, edge.distance_px[near], edge.spread_rel[near], color=colour if len(drawn) < 4 else SOFT, linewidth=0.6)
        low.axhline(0.5, color=INK, linewidth=0.4, linestyle=":")
        low.set_xlabel("distance from the edge / px")
        low.set_ylabel("share of the step")
        alt = f"Spatial frequency response of {len(found.edges)} slanted edges, and their edge spread functions. {summary_sentence(found)}"
        caption = (
            "Response to slanted edges: mean of each direction with ± 2 u, single edges in grey; the dotted line is the limit of sampling "
            "(0.5 cycles/px), above which detail is aliased. Below: the edges themselves; a curve that overshoots is sharpened."
        )
        return Figure(figure, "edges", alt, caption)
