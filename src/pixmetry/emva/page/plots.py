"""The plots of an EMVA 1288 data sheet: from the bright levels, from the dark ones, without a model, and from the stacks of frames."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.emva.files.keys import EQUAL_EXPOSURE
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
    outline,
    time_of,
    used_levels,
)
from pixmetry.report.drawing import AMBER, BLUE, INK, RED, SOFT, plain_log
from pixmetry.report.numbers import percent, significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from pixmetry.emva.records import Results

BETWEEN = "three levels or more from 5 % to 95 % of saturation"
CHANNELS = ((RED, "^"), (BLUE, "o"), (AMBER, "s"), (INK, "D"))  # colour and marker by the place of the channel
LIGHT = "light"
SNR_LINES = (
    ("ideal", "ideal camera, √photons", {"color": SOFT, "linestyle": ":"}),
    ("model", "linear model", {"color": BLUE}),
    ("shot_limit", "shot-noise limit", {"color": BLUE, "linestyle": "--", "linewidth": 0.8}),
    ("dark_limit", "dark-noise limit", {"color": AMBER, "linestyle": "--", "linewidth": 0.8}),
    ("total", "with non-uniformity", {"color": RED, "linestyle": "-."}),
)
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
    caption = (
        f"Mean above dark against the light: the slope up to 70 % of saturation is {slope}; where it becomes flat, the camera saturates."
    )
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
    """Name of the brightest level that counts: saturation, or the last level."""
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
    caption = (
        f"Variance relative to the photon transfer's line{words}: a curved course shows that the camera is not linear; bars are ± 2 u."
    )
    return draw, caption, f"Variance of {int(shown.sum())} levels in percent from the photon transfer's line{words}."


def _below_saturation(r: Results, size: int) -> np.ndarray:
    """The levels up to saturation: a clipped pixel has no noise, and its ratio means nothing."""
    c = r.curves.get("PTC", {})
    top = one(c, "saturation")
    if not np.isfinite(top) or len(c["mean_dn"]) != size:
        return np.ones(size, bool)
    return np.asarray(c["mean_dn"], float) <= top


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
        "levels from 5 % to 95 % of saturation, weighted by their relative errors."
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
    caption = f"Relative deviation from that line, {error}: a curved course is non-linearity, scatter comes from the setting of the light."
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


def dark_and_general_plots(results: Results) -> list[Plot]:
    """Plots of one channel from its dark levels, and of what is seen at the input without a model."""
    made = [
        ("dark_signal", "Dark signal", "Dark signal against exposure time", _dark_mean, "dark frames at several exposure times"),
        ("dark_signal", "Dark signal", "Dark variance against exposure time", _dark_variance, "dark frames at several exposure times"),
        ("dark_temperature", "Dark signal", "Dark current against temperature", _dark_temperature, "dark currents at several temperatures"),
    ]
    if results.release == "4.0":  # the only one that has General
        light, group = "the light of at least eight levels", "General, without a model"
        made.append(("general", group, "Signal-to-noise ratio at the input", _input_snr, light))
        made.append(("general", group, "Noise at the input", _input_noise, light))
    return [make_plot(results, *m) for m in made]


def _dark_mean(c: Curve, r: Results) -> Drawn:
    x, label = time_of(c["exposure_s"])
    return _dark(c, x, label, "mean_dn", "fit_dn", "dark mean / DN", say(r, "u_I_mean") or say(r, "u_I_mean_DN"), "mean")


def _dark_variance(c: Curve, r: Results) -> Drawn:
    x, label = time_of(c["exposure_s"])
    current = say(r, "u_I_var") or say(r, "u_I_var_DN")
    return _dark(c, x, label, "var_dn2", "var_fit_dn2", "dark variance / DN²", current, "temporal variance")


def _dark(c: Curve, x: np.ndarray, label: str, measured: str, fit: str, y_label: str, current: str, what: str) -> Drawn:
    if np.ptp(x) <= EQUAL_EXPOSURE * x.max():
        return "all dark frames have one exposure time"
    y = np.asarray(c[measured], float)

    def draw(axes: Axes) -> None:
        axes.plot(x, y, label="measured", **OPEN)
        if fit in c and current:
            order = np.argsort(x)
            axes.plot(x[order], np.asarray(c[fit], float)[order], color=BLUE, label="line")
        axes.set_xlabel(label)
        axes.set_ylabel(y_label)
        axes.margins(y=0.1)
        leave_room(axes)
        axes.ticklabel_format(axis="y", useOffset=False)
        axes.legend(loc="upper center", ncols=2)

    slope = f"the line's slope gives a dark current of {current}" if current else "too few exposure times for a line"
    return draw, f"Dark {what} against exposure time: {slope}.", f"Dark {what} of {len(x)} levels against exposure time; {slope}."


def _dark_temperature(c: Curve, r: Results) -> Drawn:
    temperature, current = np.asarray(c["temperature_c"], float), np.asarray(c["current_e_per_s"], float)

    def draw(axes: Axes) -> None:
        good = current > 0
        u = np.asarray(c["u_e_per_s"], float)[good] if "u_e_per_s" in c else None
        axes.errorbar(temperature[good], current[good], yerr=u, ecolor=SOFT, elinewidth=0.6, label="measured", **OPEN)
        order = np.argsort(temperature)
        axes.plot(temperature[order], np.asarray(c["fit_e_per_s"], float)[order], color=BLUE, label="doubling law")
        axes.set_yscale("log")
        plain_log(axes.yaxis)
        axes.set_xlabel("temperature / °C")
        axes.set_ylabel("dark current / e⁻/s")
        axes.legend(loc="upper left")

    step = say(r, "T_d") or f"{significant(one(c, 'doubling_k'))} K"
    caption = f"Dark current against temperature: it doubles every {step}."
    return draw, caption, f"Dark current at {len(current)} temperatures with the fitted law; it doubles every {step}."


def _input_snr(c: Curve, r: Results) -> Drawn:
    x, label = light_of(c)

    def draw(axes: Axes) -> None:
        positive = x > 0
        if c.get("photons") is not None:
            axes.plot(x[positive], np.sqrt(x[positive]), ":", color=SOFT, label="ideal camera, √photons")
        for name, words, colour, dash in (("snr_p", "temporal noise", BLUE, "-"), ("snr_p_total", "with non-uniformity", RED, "--")):
            if name in c:
                y = np.asarray(c[name], float)
                good = positive & np.isfinite(y) & (y > 0)
                axes.plot(x[good], y[good], dash, color=colour, marker="o", markersize=2, linewidth=0.9, label=words)
        log_log(axes, label, "SNR at the input")
        leave_room(axes)
        axes.legend(loc="upper left")

    best = say(r, "general_SNR_max_dB")
    words = f", at its maximum {best}" if best else ""
    caption = f"Light over the noise at the input, without a model of the camera{words}: for a linear camera it is the curve of the output."
    return draw, caption, f"Signal-to-noise ratio at the input against {label}{words}."


def _input_noise(c: Curve, r: Results) -> Drawn:
    x, label = light_of(c)
    if c.get("photons") is not None:
        factor, unit = 1.0, "photons"
    else:
        factor, unit = float(x[-1] / c["exposure_s"][-1]), label.rpartition(" ")[2]

    def draw(axes: Axes) -> None:
        for name, words, colour, marker in (("sigma_p", "temporal", BLUE, "o"), ("s_p", "spatial", RED, "^")):
            if name in c:
                y = factor * np.asarray(c[name], float)
                good = (x > 0) & np.isfinite(y) & (y > 0)
                axes.plot(x[good], y[good], color=colour, marker=marker, markersize=2, linewidth=0.9, label=words)
        log_log(axes, label, f"noise at the input / {unit}")
        leave_room(axes)
        axes.legend(loc="upper left")

    caption = f"Noise of the output over the slope of the characteristic curve, in {unit}: it rises steeply where the output saturates."
    return draw, caption, f"Temporal and spatial noise in {unit} at the input against {label}."


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

    caption = (
        f"Share of pixels that deviate by at least so much in the {kind} image: it shows how many pixels exceed the limit of an "
        "application."
    )
    return draw, caption, f"Percentage of pixels that deviate at least so far from the mean of the {kind} image, logarithmic axis."
