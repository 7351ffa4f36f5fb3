"""The section of an assessment's page on upright lines, row by row: what all lines of a row have in common."""

from __future__ import annotations

from collections import Counter

import numpy as np

from pixmetry.camera.observations import LineRows
from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates
from pixmetry.observe.line_jitter import series_of
from pixmetry.report import Column, Section, Table
from pixmetry.report.drawing import BLUE, GRID, RED, SOFT, canvas, line
from pixmetry.report.numbers import printed_number, significant, uncertain
from pixmetry.report.page import Figure

MOST_ROWS = 40  # of the table
MOST_LAG = 24  # lines of a field
WORDS = (
    "Each row of each frame is compared with its own mean over the frames, so the shape of the lines and the pattern of the pixels have no "
    "part in it. Motion of the picture from field to field is left out. What the noise of the pixels adds is known and subtracted."
)


def lines_section(found: LineRows) -> Section:
    """Figure, table of the lines, and why others were refused."""
    section = Section("Rows of upright lines", name="lines").add_text(summary_sentence(found))
    if found.lines:
        section.add_text(WORDS, style="small soft")
        section.add(jitter_figure(found))
        columns: list[Column | str] = ["Kind", Column("Picture", "right"), Column("x / px", "right"), Column("Rows", "right")]
        columns += [Column(t, "right") for t in ("Frames", "Height / DN", "u of a row by noise / px", "rms of the rows / px")]
        rows = [
            [
                part.kind, str(part.picture + 1), f"{np.median(part.place_px):.1f}", str(len(part.row)), str(len(part.shift_px)),
                significant(part.height_dn), significant(float(np.sqrt((part.u_px**2).mean())), 2),
                significant(float(part.shift_px.std()), 2),
            ]
            for part in found.lines[:MOST_ROWS]
        ]  # fmt: skip
        section.add_section("Line by line", fold=True).add(Table(f"The {len(rows)} lines", columns, rows))
    if found.refused:
        reasons = Counter(r.reason for r in found.refused)
        folded = section.add_section("Lines that were found and not measured", fold=True)
        folded.add(Table("Refused lines", ["Reason", Column("Lines", "right")], [[why, str(n)] for why, n in reasons.most_common(12)]))
    return section


def summary_sentence(found: LineRows) -> str:
    """What the rows do, in words."""
    if not found.lines:
        return "No upright line could be measured. " + " ".join(filter(None, (found.jitter.reasons.get("white_px", ""), *found.notes)))
    told = [f"{len(found.lines)} lines and edges were followed row by row; {len(found.refused)} were refused."]
    for fit, which in ((found.jitter, ""), (found.taped, "Played from tape: ")):
        if len(fit):
            told.append(which + _in_words(fit))
    return " ".join(told)


def _in_words(fit: Estimates) -> str:
    parts = []
    words = {"white_px": "each row jumps by {} px by itself", "loop_px": "{} px are alike from line to line of a field"}
    words["settling_px"] = "the first row is off by {} px"
    for name, text in words.items():
        if name in fit:
            number = fit[name]
            shown = printed_number(number).value if number.is_limit else "{0.value} ± {0.u}".format(uncertain(number.value, number.u, "px"))
            parts.append(text.format(shown))
    sentence = "; ".join(parts)
    return f"{sentence[:1].upper()}{sentence[1:]}."


def jitter_figure(found: LineRows) -> Figure:
    """Shifts of the rows of some frames, and how alike rows are, against the fit."""
    picture = max({part.picture for part in found.lines}, key=lambda p: sum(len(part.row) for part in found.lines if part.picture == p))
    series = series_of([part for part in found.lines if part.picture == picture])
    assert series is not None  # there are lines
    fit = found.taped if found.recorded[picture] else found.jitter
    stride = 1 if "interlaced" in fit and not fit["interlaced"].value else 2
    lag, seen = _autocovariance(series.shift_px, series.row, stride)
    with canvas(4.4, nrows=2, height_ratios=[3, 2]) as (figure, (top, low)):
        for shift in series.shift_px[:8]:
            line(top, series.row, shift, color=GRID, linewidth=0.5)
        line(top, series.row, series.shift_px[0], color=BLUE, linewidth=0.7, label="first frame")
        noise = float(np.sqrt(series.noise_px2))
        top.axhspan(-noise, noise, color=SOFT, alpha=0.2, linewidth=0, label="± u by the noise of the pixels")
        top.set_xlabel("row")
        top.set_ylabel("shift / px")
        top.legend(loc="upper right")
        low.plot(lag, 1e6 * seen, "o", color=BLUE, markersize=3, label="measured")
        low.plot(lag, 1e6 * _fitted(fit, lag, series.noise_px2), color=RED, linewidth=0.8, label="fitted")
        low.axhline(0, color=SOFT, linewidth=0.6)
        low.set_xlabel("lines of a field apart")
        low.set_ylabel("covariance / 10⁻⁶ px²")
        low.legend(loc="upper right")
        caption = (
            "Shifts of the rows of one picture against their mean over the frames, without each frame's mean. Below: covariance of rows "
            "some lines of a field apart; at 0 it holds the noise of the pixels too, and a slow tail is cut, as each field's drift is "
            "left out."
        )
        return Figure(figure, "lines", f"Shifts of the rows of upright lines. {summary_sentence(found)}", caption)


def _autocovariance(shift: Array, row: np.ndarray, stride: int) -> tuple[Array, Array]:
    """Mean product of rows some lines of a field apart, less a line through each frame, shape (lags,)."""
    frames = len(shift)
    t = row - row.mean()
    left = shift - shift.mean(axis=1, keepdims=True) - np.outer(shift @ t / (t @ t), t)
    lags = np.arange(min(MOST_LAG, len(row) // (2 * stride)))
    values = []
    for k in lags:
        _, a, b = np.intersect1d(row, row - k * stride, return_indices=True)
        values.append(float((left[:, a] * left[:, b]).mean()) * frames / (frames - 1) if len(a) else np.nan)
    return lags.astype(float), np.array(values)


def _fitted(fit: Estimates, lag: Array, noise_px2: float) -> Array:
    white = fit["white_px"].value ** 2 if "white_px" in fit and not fit["white_px"].is_limit else 0.0
    loop = fit["loop_px"].value ** 2 if "loop_px" in fit and not fit["loop_px"].is_limit else 0.0
    length = fit["loop_rows"].value if "loop_rows" in fit else 1.0
    return np.asarray(loop * np.exp(-lag / length) + (lag == 0) * (white + noise_px2), float)
