"""The plots of an EMVA 1288 data sheet from the bright levels: sensitivity, photon transfer, signal-to-noise ratio, linearity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pixmetry.emva.page.content import say
from pixmetry.emva.page.figures import (
    CROSS,
    OPEN,
    STRETCHES,
    Curve,
    Drawn,
    Plot,
    leave_room,
    light_of,
    log_log,
    make_plot,
    one,
    used_levels,
)
from pixmetry.report.drawing import AMBER, BLUE, INK, RED, SOFT, plain_log
from pixmetry.report.numbers import significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from pixmetry.emva.records import Results

BETWEEN = "three levels or more from 5 % to 95 % of saturation"
CHANNELS = ((RED, "^"), (BLUE, "o"), (AMBER, "s"), (INK, "D"))  # colour and marker by the place of the channel


def series_plots(results: Results) -> list[Plot]:
    """Plots of one channel from its bright levels, in the order of the standard's data sheet."""
    made = (
        ("sensitivity", "Sensitivity", "Sensitivity", _sensitivity, "two bright frames at several levels"),
        ("PTC", "Sensitivity", "Photon transfer", _photon_transfer, "two bright frames at several levels"),
        ("PTC", "Sensitivity", "Photon transfer, off the line", _off_the_line, "two bright frames at several levels"),
        ("SNR", "Sensitivity", "Signal-to-noise ratio", _signal_to_noise, "two bright frames at several levels"),
        ("linearity", "Linearity", "Linearity", _linearity, BETWEEN),
        ("linearity", "Linearity", "Deviation from linearity", _deviation, BETWEEN),
    )
    return [make_plot(results, *m) for m in made]


def _points(axes: Axes, x: np.ndarray, y: np.ndarray, used: np.ndarray) -> None:
    axes.plot(x[used], y[used], label="measured, fitted", **OPEN)
    if not used.all():
        axes.plot(x[~used], y[~used], label="not fitted", **CROSS)


def _line(axes: Axes, x: np.ndarray, y: np.ndarray, used: np.ndarray, label: str) -> None:
    """A fitted line, dashed beyond the levels that it was fitted to; its kink at saturation is drawn straight."""
    order = np.argsort(x)
    axes.plot(x[order], y[order], "--", color=BLUE, linewidth=0.8)
    inside = order[used[order]]
    axes.plot(x[inside], y[inside], color=BLUE, label=label)


def _sensitivity(c: Curve, r: Results) -> Drawn:
    x, label = light_of(c)
    mean, used = np.asarray(c["mean_dn"], float), used_levels(c)

    def draw(axes: Axes) -> None:
        _points(axes, x, mean, used)
        _line(axes, x, np.asarray(c["fit_dn"], float), used, "responsivity")
        axes.set_xlabel(label)
        axes.set_ylabel("mean above dark / DN")
        axes.set_ylim(bottom=min(0.0, float(mean.min())), top=1.08 * float(mean.max()))
        axes.legend(loc="lower right")

    slope = f"the responsivity {say(r, 'R')}" if say(r, "R") else "the responsivity"
    caption = f"Mean above dark against the light: the slope up to 70 % of saturation is {slope}; where it bends, the camera saturates."
    return draw, caption, f"Mean above dark of {len(x)} levels against {label}, with the fitted line; its slope is {slope}."


def _photon_transfer(c: Curve, r: Results) -> Drawn:
    mean, var, used, saturation = np.asarray(c["mean_dn"], float), np.asarray(c["var_dn2"], float), used_levels(c), one(c, "saturation")

    def draw(axes: Axes) -> None:
        if "u_var_dn2" in c:
            axes.errorbar(mean, var, yerr=2 * np.asarray(c["u_var_dn2"], float), fmt="none", ecolor=SOFT, elinewidth=0.6)
        _points(axes, mean, var, used)
        _line(axes, mean, np.asarray(c["fit_dn2"], float), used, "system gain")
        if np.isfinite(saturation):
            axes.axvline(saturation, color=AMBER, linestyle="-.", linewidth=0.9, label=_end(r))
        axes.set_xlabel("mean above dark / DN")
        axes.set_ylabel("variance above dark / DN²")
        axes.set_ylim(min(0.0, float(var.min())), 1.15 * float(var.max()))
        axes.legend(loc="upper left")

    gain = f"K = {say(r, 'K')}" if say(r, "K") else "the gain"
    caption = f"Temporal variance against the mean, both above dark: the slope up to 70 % of saturation is {gain}; bars are ± 2 u."
    return draw, caption, f"Photon transfer of {len(mean)} levels with the fitted line, {gain}."


def _end(r: Results) -> str:
    """What the brightest level is that counts: saturation, or just the last one."""
    capacity = r.values.get("u_p_sat")
    return "last level" if capacity is not None and capacity.is_lower_limit else "saturation"


def _off_the_line(c: Curve, r: Results) -> Drawn:
    mean, var, fit, used = np.asarray(c["mean_dn"], float), np.asarray(c["var_dn2"], float), np.asarray(c["fit_dn2"], float), used_levels(c)
    top = one(c, "saturation")
    shown = (fit > 0) & (mean < 0.98 * top) if np.isfinite(top) else fit > 0

    def draw(axes: Axes) -> None:
        off = 100 * (var[shown] / fit[shown] - 1)
        bars = 200 * np.asarray(c.get("u_var_dn2", np.zeros_like(var)), float)[shown] / fit[shown]
        axes.axhline(0, color=BLUE, linewidth=0.9)
        axes.errorbar(mean[shown], off, yerr=bars, fmt="none", ecolor=SOFT, elinewidth=0.6)
        _points(axes, mean[shown], off, used[shown])
        inner = mean[shown] >= 0.1 * mean[shown].max(initial=0.0)
        span = 1.4 * max(float((np.abs(off) + bars)[inner].max(initial=0.0)), 0.2)
        axes.set_ylim(-span, 1.4 * span)  # the darkest levels may stick out: their relative error has no bound
        axes.set_xlabel("mean above dark / DN")
        axes.set_ylabel("variance off the line / %")
        axes.legend(loc="upper center", ncols=2)

    departure = say(r, "PTC_linearity")
    words = f", whose local slope departs by up to {departure}" if departure else ""
    caption = f"Variance relative to the photon transfer's line{words}: a bow says that the camera is not linear; bars are ± 2 u."
    return draw, caption, f"Variance of {int(shown.sum())} levels in percent off the photon transfer's line{words}."


def _below_saturation(r: Results, size: int) -> np.ndarray:
    """The levels up to saturation: a clipped pixel has no noise, and its ratio means nothing."""
    c = r.curves.get("PTC", {})
    top = one(c, "saturation")
    if not np.isfinite(top) or len(c["mean_dn"]) != size:
        return np.ones(size, bool)
    return np.asarray(c["mean_dn"], float) <= top


LIGHT = "light"
SNR_LINES = (
    ("ideal", "ideal camera, √photons", {"color": SOFT, "linestyle": ":"}),
    ("model", "linear model", {"color": BLUE}),
    ("shot_limit", "shot-noise limit", {"color": BLUE, "linestyle": "--", "linewidth": 0.8}),
    ("dark_limit", "dark-noise limit", {"color": AMBER, "linestyle": "--", "linewidth": 0.8}),
    ("total", "with non-uniformity", {"color": RED, "linestyle": "-."}),
)


def _signal_to_noise(c: Curve, r: Results) -> Drawn:
    x, label = light_of(c)
    snr, dense = np.asarray(c["snr"], float), _down_to_threshold(c, r)
    ends = {"the threshold, where it is 1,": r.values.get("u_p_min"), _end(r): r.values.get("u_p_sat")}
    marks = {words: v.value for words, v in ends.items() if v is not None and v.value > 0 and c.get("photons") is not None}

    def draw(axes: Axes) -> None:
        shown = np.isfinite(snr) & (snr > 0) & (x > 0) & _below_saturation(r, x.size)
        for name, words, style in SNR_LINES:
            if name in dense:
                at, y = dense[LIGHT], dense[name]
                good = np.isfinite(y) & (y > 0) & (at > 0)
                if good.any():
                    axes.plot(at[good], y[good], label=words, **style)
        axes.plot(x[shown], snr[shown], label="measured", **OPEN)
        for mark in marks.values():
            axes.axvline(mark, color=SOFT, linewidth=0.7, linestyle=(0, (1, 2)))
        log_log(axes, label, "signal-to-noise ratio")
        if shown.any():
            least = float(snr[shown].min())
            axes.set_ylim(0.5 * min(least, 1.0) if dense[LIGHT][0] < x[shown].min() else max(0.1, 0.5 * least), 6 * axes.get_ylim()[1])
            plain_log(axes.yaxis)
        axes.legend(loc="upper left", bbox_to_anchor=(0.1, 1.02), fontsize=6.3, ncols=2, handlelength=1.6, columnspacing=1.0)

    best = f"SNR_max = √µ_e.sat = {say(r, 'SNR_max')} ({say(r, 'SNR_max_dB')})".replace("= >", ">").replace("= <", "<")
    if not say(r, "SNR_max"):
        best = "SNR_max is not known"
    dotted = f"; dotted: {' and '.join(marks)}" if marks else ""
    caption = f"Signal-to-noise ratio of one pixel, below the ideal camera's{dotted}; {best}, of shot noise alone."
    return draw, caption, f"Signal-to-noise ratio against {label}, with ideal, model, limits and total; {best}."


def _down_to_threshold(c: Curve, r: Results) -> dict[str, np.ndarray]:
    """The SNR plot's curves over the light, begun below the threshold of the camera, where no level need be.

    The curves hold what they were made of: electrons e (the square of the shot limit), the dark noise σ (e over the dark limit) and what
    the total has more than the model, s² + q² e², from its two ends.
    """
    x = light_of(c)[0]
    order = np.argsort(x)[np.sort(x) > 0]
    known = {LIGHT: x[order]} | {name: np.asarray(c[name], float)[order] for name, *_ in SNR_LINES if name in c}
    threshold = r.values.get("u_p_min")
    if threshold is None or not 0 < threshold.value < known[LIGHT][0] or not {"shot_limit", "dark_limit"} <= set(known):
        return known
    light = np.geomspace(0.5 * threshold.value, known[LIGHT][-1], STRETCHES)
    measured_e = known["shot_limit"] ** 2
    electrons, sigma = light * measured_e[-1] / known[LIGHT][-1], measured_e[-1] / known["dark_limit"][-1]
    dense = {LIGHT: light, "ideal": np.sqrt(light), "shot_limit": np.sqrt(electrons), "dark_limit": electrons / sigma}
    dense["model"] = electrons / np.sqrt(sigma**2 + electrons)
    if "total" in known:
        more = (measured_e / known["total"]) ** 2 - sigma**2 - measured_e
        q2, s2 = np.polyfit(measured_e[[0, -1]] ** 2, more[[0, -1]], 1) if measured_e.size > 1 else (0.0, more[0])
        dense["total"] = electrons / np.sqrt(sigma**2 + electrons + max(s2, 0.0) + max(q2, 0.0) * electrons**2)
    return {name: dense[name] for name in known}


def _linearity(c: Curve, r: Results) -> Drawn:
    x, label = light_of(c)
    mean, used = np.asarray(c["mean_dn"], float), used_levels(c)

    def draw(axes: Axes) -> None:
        _points(axes, x, mean, used)
        _line(axes, x, np.asarray(c["fit_dn"], float), used, "line of least relative squares")
        axes.set_xlabel(label)
        axes.set_ylabel("mean above dark / DN")
        axes.set_ylim(top=1.08 * float(mean.max()))
        axes.legend(loc="lower right")

    caption = (
        f"Mean above dark with the line of the linearity test, offset {significant(one(c, 'fit_offset'))} DN: "
        "levels from 5 % to 95 % of saturation, each with the weight of its relative error."
    )
    return draw, caption, f"Mean above dark against {label} with the line of the linearity test through {int(used.sum())} levels."


def _deviation(c: Curve, r: Results) -> Drawn:
    x, label = light_of(c)
    off, used = np.asarray(c["relative_deviation"], float), used_levels(c)
    if used.sum() < 3:
        return f"this plot needs {BETWEEN}"
    low, high = one(c, "linearity_error_min"), one(c, "linearity_error_max")
    mean_error = r.values.get("LE")

    def draw(axes: Axes) -> None:
        axes.axhline(0, color=SOFT, linewidth=0.8)
        if np.isfinite([low, high]).all():
            for y in (low, high):
                axes.axhline(y, color=AMBER, linewidth=0.8, linestyle="-.", label="LE_min, LE_max" if y == low else None)
        if mean_error is not None and np.isfinite(mean_error.value):
            axes.axhspan(-mean_error.value, mean_error.value, color=BLUE, alpha=0.15, linewidth=0, label="± LE")
        good = used & np.isfinite(off)
        axes.plot(x[good], off[good], "-", color=BLUE, linewidth=0.6)
        axes.plot(x[good], off[good], label="measured", **OPEN)
        axes.set_xlabel(label)
        axes.set_ylabel("deviation / %")
        axes.margins(y=0.1)
        leave_room(axes)
        axes.legend(loc="upper center", ncols=3)

    error = f"LE = {say(r, 'LE')}" if say(r, "LE") else f"LE_min = {say(r, 'LE_min')}, LE_max = {say(r, 'LE_max')}"
    caption = f"Relative deviation from that line, {error}: a bow is non-linearity, scatter is the setting of the light."
    return draw, caption, f"Relative deviation from the line in percent against {label}; {error}."


def together(channels: Sequence[Results]) -> Plot:
    """Photon transfer of all channels of a colour camera in one plot."""

    def draw(axes: Axes) -> None:
        for r, (colour, marker) in zip(channels, CHANNELS * len(channels), strict=False):
            c = r.curves["PTC"]
            points = dict(OPEN, color=colour, marker=marker, markersize=2.4)
            axes.plot(c["mean_dn"], c["var_dn2"], label=r.channel, **points)
            used = used_levels(c)
            axes.plot(np.asarray(c["mean_dn"])[used], np.asarray(c["fit_dn2"])[used], color=colour, linewidth=0.8)
        axes.set_xlabel("mean above dark / DN")
        axes.set_ylabel("variance above dark / DN²")
        axes.legend(loc="upper left")

    names = ", ".join(r.channel for r in channels)
    caption = f"Photon transfer of the channels {names}: channels that share a converter share the slope."
    return Plot("photon-transfer-together", "Sensitivity", "Photon transfer", caption, f"Photon transfer of the channels {names}.", draw)


def snr_together(channels: Sequence[Results]) -> Plot:
    """Signal-to-noise ratio of all channels of a colour camera in one plot."""

    def draw(axes: Axes) -> None:
        for r, (colour, marker) in zip(channels, CHANNELS * len(channels), strict=False):
            x, _ = light_of(r.curves["SNR"])
            snr = np.asarray(r.curves["SNR"]["snr"], float)
            good = (x > 0) & (snr > 0) & _below_saturation(r, x.size)
            axes.plot(x[good], snr[good], label=r.channel, **dict(OPEN, color=colour, marker=marker, markersize=2.4))
        log_log(axes, light_of(channels[0].curves["SNR"])[1], "signal-to-noise ratio")
        axes.legend(loc="lower right")

    names = ", ".join(r.channel for r in channels)
    caption = f"Signal-to-noise ratio of the channels {names}: at equal light the more efficient channel lies higher."
    return Plot("snr-together", "Sensitivity", "Signal-to-noise ratio", caption, f"Signal-to-noise ratio of the channels {names}.", draw)
