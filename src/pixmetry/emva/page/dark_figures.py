"""The plots of an EMVA 1288 data sheet from the dark levels, and those of the General model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pixmetry.emva.files.keys import EQUAL_EXPOSURE
from pixmetry.emva.page.content import say
from pixmetry.emva.page.figures import OPEN, Curve, Drawn, Plot, leave_room, light_of, log_log, make_plot, one, time_of
from pixmetry.report.drawing import BLUE, RED, SOFT, plain_log
from pixmetry.report.numbers import significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from pixmetry.emva.records import Results


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
    caption = f"Light over the noise at the input, without a model of the camera{words}: a linear camera shows the curve of its output."
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

    caption = f"Noise of the output over the slope of the characteristic curve, in {unit}: it soars where the output saturates."
    return draw, caption, f"Temporal and spatial noise in {unit} at the input against {label}."
