"""Common parts of the plots of an EMVA 1288 data sheet; each draws into given axes, for the page or the PDF."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.emva.page.content import time_scale
from pixmetry.report.drawing import INK, SOFT, plain_log
from pixmetry.report.numbers import NO_BREAK

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from pixmetry.emva.records import Results

Curve = Mapping[str, np.ndarray]
# how to draw it, its caption, and what it shows in words; or why it is not drawn
Drawn = tuple[Callable[["Axes"], None], str, str] | str
OPEN: dict[str, Any] = {"marker": "o", "linestyle": "none", "color": INK, "markerfacecolor": "none", "markeredgewidth": 0.7}
CROSS: dict[str, Any] = {"marker": "x", "linestyle": "none", "color": SOFT, "markeredgewidth": 0.7}
STRETCHES = 400  # of a dense curve: finer than the lines are wide
MARGINS_IN = {"left": 0.62, "right": 0.08, "bottom": 0.42, "top": 0.22}  # room for tick labels of six signs, and for the title


@dataclass(frozen=True)
class Plot:
    """One plot: its name, its description in words, and the function that draws it; without ``draw`` the caption states what it needs."""

    name: str
    group: str
    title: str
    caption: str
    alt: str = ""
    draw: Callable[[Axes], None] | None = None


def fill(plot: Plot, axes: Axes, box_in: tuple[float, float, float, float]) -> None:
    """Draw a plot with its title into a box of its figure: left, bottom, width, height in inches.

    The margins are fixed: finding them from the labels would take as long as everything else.
    """
    left, bottom, width, height = box_in
    figure: Any = axes.figure
    m, (across, up) = MARGINS_IN, figure.get_size_inches()
    inner = (width - m["left"] - m["right"], height - m["bottom"] - m["top"])
    axes.set_position(((left + m["left"]) / across, (bottom + m["bottom"]) / up, inner[0] / across, inner[1] / up))
    if plot.draw is not None:
        plot.draw(axes)
    axes.set_title(plot.title, loc="left", fontweight="bold", y=1.0)  # a place of its own spares the search for one
    middle = bottom + m["bottom"] + inner[1] / 2
    axes.yaxis.set_label_coords((left + 0.13) / across, middle / up, transform=figure.transFigure)


def make_plot(results: Results, curve: str, group: str, title: str, make: Callable[[Curve, Results], Drawn], needs: str) -> Plot:
    """The plot of a curve, or the sentence in its place where there is no such curve."""
    name = f"{title.lower().replace(' ', '-').replace(',', '')}-{results.channel.lower()}"
    found = results.curves.get(curve)
    if not found:
        return Plot(name, group, title, f"Not drawn: this plot needs {needs}.")
    drawn = make(found, results)
    if isinstance(drawn, str):
        return Plot(name, group, title, f"Not drawn: {drawn}.")
    draw, caption, alt = drawn
    caption = (
        caption.replace(" %", f"{NO_BREAK}%").replace("± ", f"±{NO_BREAK}").replace(" ±", f"{NO_BREAK}±").replace("2 u", f"2{NO_BREAK}u")
    )
    return Plot(name, group, title, caption, alt, draw)


def light_of(curve: Curve) -> tuple[np.ndarray, str]:
    """The abscissa of a series and its label: photons per pixel, else the exposure time, else the mean where the light is not known."""
    if curve.get("photons") is not None:
        return np.asarray(curve["photons"], float), "photons per pixel"
    if curve.get("exposure_s") is not None:
        return time_of(curve["exposure_s"])
    return np.asarray(curve["mean_dn"], float), "mean above dark / DN"


def time_of(exposure_s: np.ndarray) -> tuple[np.ndarray, str]:
    """Exposure times in a unit that leaves them readable, and the label."""
    factor, unit = time_scale(float(np.max(exposure_s)))
    return factor * np.asarray(exposure_s, float), f"exposure time / {unit}"


def one(curve: Curve, name: str) -> float:
    """The only element of a curve's array, NaN where it is not there."""
    return float(np.ravel(curve[name])[0]) if name in curve and np.size(curve[name]) else float("nan")


def outline(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A dense curve with few points that looks the same: of each short stretch its lowest and its highest point."""
    size = -(-len(x) // STRETCHES)
    if size <= 2:
        return x, y
    whole = len(x) // size * size
    stretches = y[:whole].reshape(-1, size)
    ends = np.stack([stretches.argmin(axis=1), stretches.argmax(axis=1)], axis=1)
    kept = np.sort(ends, axis=1) + size * np.arange(len(stretches))[:, None]
    kept = np.concatenate([kept.ravel(), np.arange(whole, len(x))])
    return x[kept], y[kept]


def used_levels(curve: Curve) -> np.ndarray:
    return np.asarray(curve.get("used", np.ones(len(curve["mean_dn"]), bool)), bool)


def log_log(axes: Axes, x_label: str, y_label: str) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    plain_log(axes.xaxis)
    plain_log(axes.yaxis)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)


def leave_room(axes: Axes) -> None:
    """A quarter more at the top of the ordinate, for the legend."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** 0.25 if axes.get_yscale() == "log" else high + 0.25 * (high - low))
