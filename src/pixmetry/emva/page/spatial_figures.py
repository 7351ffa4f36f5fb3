"""The plots of an EMVA 1288 data sheet from the stacks of frames: spectrograms, profiles, histograms."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.emva.page.content import say
from pixmetry.emva.page.figures import Curve, Drawn, Plot, make_plot, one, outline
from pixmetry.report.drawing import AMBER, BLUE, INK, RED, SOFT, plain_log
from pixmetry.report.numbers import percent, significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from pixmetry.emva.records import Results

KINDS = ("DSNU", "PRNU")
ALONG = {"horizontal": ("row", "x"), "vertical": ("column", "y")}
NEEDS = "a stack of dark frames and one of bright frames"
NEEDS_BOX = f"{NEEDS}, of 5 × 5 pixels or more"
LEVELS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("total", "total", {"color": INK, "linestyle": "-"}),
    ("nonuniformity", "{kind}", {"color": RED, "linestyle": "--"}),
    ("temporal", "temporal, one frame", {"color": AMBER, "linestyle": "-."}),
    ("white_floor", "temporal, mean", {"color": SOFT, "linestyle": ":"}),
)


def spatial_plots(results: Results) -> list[Plot]:
    """Plots of one channel from its stacks of frames."""
    plots = []
    for kind in KINDS:
        for way in ALONG:
            title = f"{way.capitalize()} spectrogram {kind}"
            plots.append(make_plot(results, f"{way}_spectrogram_{kind}", "Spectrograms", title, partial(_spectrogram, kind, way), NEEDS))
    for kind in KINDS:
        for way in ALONG:
            title = f"{way.capitalize()} profiles {kind}"
            plots.append(make_plot(results, f"{way}_profile_{kind}", "Profiles", title, partial(_profiles, kind, way), NEEDS))
    for kind in KINDS:
        needs = NEEDS if kind == "DSNU" else NEEDS_BOX
        plots.append(make_plot(results, f"histogram_{kind}", "Histograms", f"Histogram {kind}", partial(_histogram, kind), needs))
        title = f"Accumulated histogram {kind}"
        plots.append(make_plot(results, f"histogram_{kind}_accumulated", "Histograms", title, partial(_accumulated, kind), needs))
    return plots


def _spectrogram(kind: str, way: str, c: Curve, r: Results) -> Drawn:
    frequency, amplitude = np.asarray(c["frequency"], float), np.asarray(c["amplitude"], float)
    along, axis = ALONG[way]
    unit = "DN" if kind == "DSNU" else "% of the signal"
    compared = kind == "DSNU" or r.release != "reference"
    if not compared:
        unit = "√DN"  # it divides the power by the mean once: no level compares with that

    def draw(axes: Axes) -> None:
        good = (amplitude > 0) & (frequency > 0)  # the mean was taken away
        axes.plot(*outline(frequency[good], amplitude[good]), color=BLUE, linewidth=0.8, zorder=3, label="spectrum")
        low, high = float(amplitude[good].min()), float(amplitude[good].max())
        least = 0.2 * low  # of a level farther below the legend says so
        for name, words, style in LEVELS if compared else ():
            level = one(c, name)
            if level > 0:
                where = ", below" if level < least else ""
                axes.axhline(level, linewidth=0.8, zorder=2, label=f"{words.format(kind=kind)} {significant(level, 2)}{where}", **style)
                low, high = min(low, max(level, least)), max(high, level)
        axes.set_yscale("log")
        span = max(high / low, 2.0)
        axes.set_ylim(low / span**0.06, low * span**1.7)  # room for the legend
        plain_log(axes.yaxis)
        axes.set_xlim(0, 0.5)
        axes.set_xlabel("frequency / cycles per pixel")
        axes.set_ylabel(f"amplitude / {unit}")
        if compared:
            axes.legend(loc="upper right", ncols=2, fontsize=6.3, handlelength=1.6, columnspacing=1.0)

    share = one(c, "white_share")
    white = f"; {percent(share)} % of the variance is white" if np.isfinite(share) else ""
    caption = f"{kind} along the {along}s by spatial frequency{white}; a peak is a pattern of stripes, a rise to the left is shading."
    return draw, caption, f"Amplitude of the {kind} pattern in {unit} against frequency along {axis}, with reference lines{white}."


def _profiles(kind: str, way: str, c: Curve, r: Results) -> Drawn:
    position = np.asarray(c["position"], float)
    along, axis = ALONG[way]

    def draw(axes: Axes) -> None:
        for name, words, style in (
            ("max", "largest, smallest", {"color": SOFT, "linewidth": 0.6}),
            ("min", None, {"color": SOFT, "linewidth": 0.6}),
            ("mid", f"middle {along}", {"color": AMBER, "linewidth": 0.6}),
            ("mean", "mean", {"color": BLUE}),
        ):
            axes.plot(*outline(position, np.asarray(c[name], float)), label=words, **style)
        axes.set_xlim(position.min(), position.max())
        axes.set_ylim(*_profile_limits(c))
        axes.set_xlabel(f"{axis} / px")
        axes.set_ylabel("dark mean / DN" if kind == "DSNU" else "bright minus dark / DN")
        axes.ticklabel_format(axis="y", useOffset=False)
        axes.legend(loc="upper right", ncols=3, handlelength=1.4, columnspacing=1.0)

    mean = np.asarray(c["mean"], float)
    span = f"{significant(float(mean.min()), 4)} to {significant(float(mean.max()), 4)} DN"
    what = "the dark image" if kind == "DSNU" else "the bright image minus the dark one"
    caption = f"Profiles of {what} along {axis}: the mean over all {along}s runs from {span}."
    return draw, caption, f"Mean, middle, smallest and largest value against {axis}; the mean runs from {span}."


def _profile_limits(c: Curve) -> tuple[float, float]:
    """0.9 to 1.1 of the mean as the standard draws it, wider where nearly all extremes would be cut off; a hot pixel may stick out."""
    mean = float(np.mean(c["mean"]))
    low = min(float(np.quantile(c["min"], 0.005)), float(np.min(c["mid"])), float(np.min(c["mean"])))
    high = max(float(np.quantile(c["max"], 0.995)), float(np.max(c["mid"])), float(np.max(c["mean"])))
    room = 0.08 * (high - low) or 0.5
    low, high = low - room, high + 4.5 * room
    return min(low, 0.9 * mean, 1.1 * mean), max(high, 0.9 * mean, 1.1 * mean)


def _histogram(kind: str, c: Curve, r: Results) -> Drawn:
    bins, counts, model = (np.asarray(c[name], float) for name in ("bins", "values", "model"))

    def draw(axes: Axes) -> None:
        axes.plot(bins, np.maximum(counts, 0.3), color=BLUE, drawstyle="steps-mid", linewidth=0.9, label="pixels")
        shown = model > 0.5
        axes.plot(bins[shown], model[shown], "--", color=RED, linewidth=0.9, label="normal law of the same spread")
        axes.set_yscale("log")
        axes.set_ylim(0.5, 60 * float(counts.max()))
        plain_log(axes.yaxis)
        axes.set_xlabel("deviation from the mean / DN" if bins.min(initial=0.0) < 0 else "difference from its surroundings / DN")
        axes.set_ylabel("pixels per bin")
        axes.legend(loc="upper right")

    value = say(r, f"{kind}1288_DN") or say(r, f"{kind}1288") if kind == "DSNU" else say(r, f"{kind}1288")
    words = f" ({kind} {value})" if value else ""
    caption = f"Logarithmic histogram of the {kind} image{words}: pixels outside the dashed normal law are candidates for defects."
    return draw, caption, f"Histogram of {significant(float(counts.sum()), 4)} pixels on a logarithmic axis beside the normal law{words}."


def _accumulated(kind: str, c: Curve, r: Results) -> Drawn:
    bins, share = np.asarray(c["bins"], float), np.asarray(c["values"], float)

    def draw(axes: Axes) -> None:
        good = share > 0
        axes.plot(bins[good], share[good], color=BLUE, drawstyle="steps-post", linewidth=1.0)
        axes.set_yscale("log")
        axes.set_ylim(top=200)
        plain_log(axes.yaxis)
        axes.set_xlabel("least deviation from the mean / DN")
        axes.set_ylabel("pixels / %")

    caption = f"Share of pixels that deviate by at least so much in the {kind} image: read off how many an application's limit would stop."
    return draw, caption, f"Percentage of pixels that deviate at least so far from the mean of the {kind} image, logarithmic axis."
