"""The report's figures: photon transfer and noise with what was fitted to them, and the budget's shares and sources."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pixmetry.budget.job import Budget, BudgetRow
from pixmetry.budget.monte_carlo import Crop
from pixmetry.camera.observations import CodeHistogram, Observations, Spectra
from pixmetry.core.number import Estimates
from pixmetry.emva.records import Results
from pixmetry.emva.temporal import linearity_line
from pixmetry.observe.photon_transfer_levels import USABLE_FRACTION, light_scale
from pixmetry.observe.photon_transfer_model import QUANTISATION_DN2, signal_from_mean, stored_moments
from pixmetry.report.drawing import AMBER, BLUE, INK, RED, SOFT, canvas, draw_map, line, plain_log
from pixmetry.report.numbers import length_px, percent, significant
from pixmetry.report.page import Figure

MOST_BARS = 10
SHOWN_DIAMETERS = 1.0  # of the target, to each side of its centre
ELLIPSE_SHARE = 0.7  # of the target's diameter, up to which the semi-axis of its uncertainty is enlarged
LONG_TITLE = 34  # characters of a source's title that have room beside its bar


@dataclass(frozen=True)
class Curve:
    """The fitted camera: what mean and temporal variance it stores at a linear signal in DN above black."""

    gain: float
    dark_var_dn2: float
    a: np.ndarray
    x_ref: float
    offset_dn: float

    @classmethod
    def of(cls, fit: Estimates, bits: int) -> Curve:
        """Read it from the joint fit."""
        gain = fit["gain_dn_per_e"].value
        noise = _size(fit, "dark_noise_e") * gain
        a = np.array([fit[f"nonlinearity_a{k}"].value for k in (1, 2, 3)])
        return cls(gain, noise**2, a, 2.0**bits - 1, fit["offset_dn"].value)

    def moments(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean above black in DN and temporal variance in DN², white part."""
        zero = np.zeros_like(x)
        mean, variance = stored_moments(x, self.dark_var_dn2 + self.gain * x, self.gain, x, zero, self.a, self.x_ref)
        return mean, variance

    def signal(self, mean_above_dn: np.ndarray) -> np.ndarray:
        """Linear signal in DN of a mean above black."""
        return signal_from_mean(np.asarray(mean_above_dn, float), self.a, self.x_ref, np.zeros_like(mean_above_dn, dtype=float))


def _size(fit: Estimates | None, name: str) -> float:
    """A value; of an upper limit its rms; 0 where it was not measured."""
    if fit is None or name not in fit:
        return 0.0
    return fit[name].representative


def _top(seen: Observations) -> float:
    """Mean above black of saturation, or of the brightest level."""
    pt, fit = seen.series, seen.fit
    level = fit["saturation_dn"].value if "saturation_dn" in fit else float(pt.bright.mean_dn.max())
    return level - fit["offset_dn"].value


def _unsaturated(seen: Observations) -> np.ndarray:
    """Bright levels below the peak of the variance and without pixels at the top code."""
    pt = seen.series
    peak = pt.bright.mean_dn[np.argmax(pt.bright.var_total_dn2)]
    stuck = float(pt.dark.fraction_max.max(initial=0.0))  # hot pixels are at the top code in the dark already
    usable: np.ndarray = (pt.bright.mean_dn <= peak) & (pt.bright.fraction_max <= max(USABLE_FRACTION, stuck))
    return usable


def variance_against_mean(seen: Observations, standard: Results) -> Figure:
    """Photon-transfer curve with the joint fit, the standard's line and the residuals of the fit."""
    pt, fit = seen.series, seen.fit
    curve, good = Curve.of(fit, pt.bits), _unsaturated(seen)
    mean, var = pt.bright.mean_dn - curve.offset_dn, pt.bright.ms_pixel_dn2
    x = np.linspace(0, curve.signal(np.array([mean[good].max()]))[0], 200)
    fit_mean, fit_var = curve.moments(x)
    slope, dark = standard.values["K"], standard.values["sigma_y_dark"]
    with canvas(3.5, nrows=2, sharex=True, height_ratios=[3, 1.2]) as (figure, (top, low)):
        top.plot(mean[good], var[good], "o", color=INK, markerfacecolor="none", markeredgewidth=0.7, label="measured")
        top.plot(mean[~good], var[~good], "x", color=SOFT, markeredgewidth=0.7, label="saturated, not used")
        top.plot(fit_mean, fit_var, color=BLUE, label="joint fit")
        linear = slope.value * fit_mean + dark.value**2
        top.plot(fit_mean, linear, "--", color=RED, label="EMVA 1288 line")
        top.set_ylim(bottom=0)
        top.set_ylabel("temporal variance / DN²")
        top.legend(loc="upper left")
        model = curve.moments(curve.signal(mean[good]))[1]
        u_rel = 100 * np.sqrt(2 / ((pt.bright.n_frames[good] - 1) * (pt.frame_shape[0] - 1) * (pt.frame_shape[1] - 1)))
        low.axhline(0, color=BLUE)
        low.errorbar(mean[good], 100 * (var[good] / model - 1), yerr=2 * u_rel, fmt="o", color=INK, markersize=2, elinewidth=0.6)
        order = np.argsort(fit_mean)
        low.plot(fit_mean[order], 100 * (linear / fit_var - 1)[order], "--", color=RED)
        span = max(4 * float(u_rel.max()), 1.15 * float(np.abs(100 * (var[good] / model - 1)).max()))
        low.set_ylim(-span, span)
        low.set_ylabel("off the fit / %")
        low.set_xlabel("mean above black / DN")
        gains = f"{significant(curve.gain, 4)} DN/e⁻ by the joint fit, {significant(slope.value, 4)} DN/e⁻ by the line"
        alt = f"Temporal variance against mean of {good.sum()} unsaturated levels, with the joint fit and the EMVA 1288 line; gain {gains}."
        caption = (
            "Photon transfer. The light's own noise makes the variance grow with the mean; the slope at zero is the gain "
            f"({gains}). Below: the same relative to the joint fit; bars are ±2 u of sampling. Where the dashed line leaves the "
            "points, the camera is not linear."
        )
        return Figure(figure, "transfer", alt, caption)


def _light_as_signal(seen: Observations) -> np.ndarray:
    """Mean of each bright level in a linear camera, DN above black."""
    pt, fit = seen.series, seen.fit
    bright = pt.bright
    if bright.photons is None or light_scale(bright)[1]:
        return fit["responsivity_dn_per_s"].value * bright.exposure_s
    return fit["quantum_efficiency"].value * fit["gain_dn_per_e"].value * bright.photons


def nonlinearity(seen: Observations) -> Figure:
    """Means against a straight line, in percent of the line, with the fitted curve."""
    pt, fit = seen.series, seen.fit
    curve, light = Curve.of(fit, pt.bits), _light_as_signal(seen)
    mean = pt.bright.mean_dn - curve.offset_dn
    use = _unsaturated(seen) & (mean >= 0.05 * _top(seen)) & (mean <= 0.95 * _top(seen))
    use = use if use.sum() >= 3 else _unsaturated(seen)
    order = np.argsort(light[use])
    light, mean = light[use][order], mean[use][order]
    fitted = curve.moments(light)[0]
    measured_off, fitted_off = _off_line(light, mean), _off_line(light, fitted)
    worst = float(np.abs(fitted_off).max())
    with canvas(2.6) as (figure, axes):
        axes.axhline(0, color=SOFT, linewidth=0.8)
        axes.plot(mean, measured_off, "o", color=INK, markerfacecolor="none", markeredgewidth=0.7, label="measured")
        axes.plot(mean, fitted_off, color=BLUE, label="joint fit (cubic)")
        axes.set_xlabel("mean above black / DN")
        axes.set_ylabel("off a straight line / %")
        axes.margins(y=0.2)
        axes.legend(loc="best")
        alt = f"Deviation of the mean from a straight line against the mean; the fitted curve departs by at most {significant(worst, 2)} %."
        caption = (
            "Non-linearity. The best straight line from 5 % to 95 % of saturation is taken away; the fitted curve departs from it by at "
            f"most {significant(worst, 2)} %. Points that scatter about the curve are noise of the lamp from level to level."
        )
        return Figure(figure, "linearity", alt, caption)


def _off_line(light: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Deviation in percent from the line of least relative squares (EMVA 1288 R4.0, section 6.7)."""
    last = np.array(light.size - 1)
    return linearity_line(light, mean, last, last)["relative_deviation"]


def signal_to_noise(seen: Observations) -> Figure:
    """Signal-to-noise ratio of one pixel against its electrons, with the two limits that no camera passes."""
    pt, fit, spatial = seen.series, seen.fit, seen.spatial_fit
    curve, good = Curve.of(fit, pt.bits), _unsaturated(seen)
    mean = pt.bright.mean_dn[good] - curve.offset_dn
    lit = mean > 0
    mean, var = mean[lit], pt.bright.var_total_dn2[good][lit]
    electrons = np.geomspace(1.0, max(_top(seen) / curve.gain, 10.0), 200)
    noise = np.sqrt((curve.dark_var_dn2 + QUANTISATION_DN2) / curve.gain**2 + electrons)
    prnu, dsnu_e = _size(spatial, "prnu_total_rel"), _size(spatial, "dsnu_total_dn") / curve.gain
    with canvas(2.9) as (figure, axes):
        axes.plot(electrons, np.sqrt(electrons), ":", color=SOFT, label="ideal, √electrons")
        axes.plot(electrons, electrons / noise, color=BLUE, label="this camera, temporal")
        words = ""
        if prnu > 0:
            total = np.sqrt(noise**2 + dsnu_e**2 + (prnu * electrons) ** 2)
            axes.plot(electrons, electrons / total, "--", color=RED, label="with DSNU and PRNU")
            limit = f"1/PRNU = {significant(1 / prnu, 2)}"
            axes.axhline(1 / prnu, color=AMBER, linewidth=0.8, linestyle="-.", label=limit)
            words = f" Uncorrected, fixed patterns hold it below {limit}."
        axes.plot(
            mean[var > 0] / curve.gain,
            mean[var > 0] / np.sqrt(var[var > 0]),
            "o",
            color=INK,
            markerfacecolor="none",
            markeredgewidth=0.7,
            label="measured",
        )
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylim(bottom=max(0.03, float((electrons / noise)[0])))
        plain_log(axes.xaxis)
        plain_log(axes.yaxis)
        axes.set_xlabel("electrons")
        axes.set_ylabel("signal-to-noise ratio")
        axes.legend(loc="lower right")
        best = significant(float((electrons / noise)[-1]), 3)
        alt = f"Signal-to-noise ratio against electrons on logarithmic axes; {best} at saturation.{words}"
        caption = f"Signal-to-noise ratio of one pixel. Dark noise bends it off the ideal line; at saturation it is {best}.{words}"
        return Figure(figure, "snr", alt, caption)


def spectra(found: Spectra, kind: str, fixed_frames: int, unit_dn: float, unit: str) -> Figure:
    """Spatial spectra of one stack along rows and columns; ``unit_dn`` DN are one ``unit``."""
    parts = (
        ("along x (rows)", found.frequency_h, found.fixed_h_dn2, found.temporal_h_dn2),
        ("along y (columns)", found.frequency_v, found.fixed_v_dn2, found.temporal_v_dn2),
    )
    with canvas(3.3, nrows=2, sharex=True, sharey=True) as (figure, both):
        for axes, (title, frequency, fixed, temporal) in zip(both, parts, strict=True):
            # frequency 0 is the mean, which was taken away
            line(axes, frequency[1:], np.sqrt(temporal[1:]) / unit_dn, color=BLUE, linewidth=0.8, label="temporal, one frame")
            line(axes, frequency[1:], np.sqrt(fixed[1:]) / unit_dn, color=RED, linewidth=0.8, label=f"mean of {fixed_frames} frames")
            rest = np.sqrt(np.mean(temporal[1:]) / fixed_frames) / unit_dn
            axes.axhline(rest, color=SOFT, linestyle=":", linewidth=0.9, label="temporal noise left in the mean")
            axes.set_yscale("log")
            axes.set_title(title, loc="left")
            axes.set_ylabel(f"noise / {unit}")
        for axes in both:
            plain_log(axes.yaxis)
        both[0].set_xlim(0, 0.5)
        figure.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        both[1].set_xlabel("frequency / cycles per pixel")
        what = f"Spatial spectra of the {kind} frames, along x and y: temporal noise of one frame and the mean of {fixed_frames} frames."
        share = "" if unit == "DN" else f" in {unit} of the signal"
        caption = (
            f"{kind.capitalize()} frames: noise by spatial frequency{share}. A flat line is white noise; a single peak is a stripe "
            "pattern; a rise towards zero is shading. The red line above the dotted one is fixed pattern, which averaging does not lower."
        )
        return Figure(figure, f"spectrum-{kind}", what, caption)


def map_picture(values: np.ndarray, name: str, title: str, unit: str, words: str) -> Figure:
    """Thumbnail of a map."""
    height = 0.6 + 0.82 * 3.7 * min(max(values.shape[0] / values.shape[1], 0.4), 1.15) * 0.86
    with canvas(height) as (figure, axes):
        low, high, block = draw_map(figure, axes, values, unit)
        axes.set_xlabel("x / px")
        axes.set_ylabel("y / px")
        blocks = "" if block == 1 else f" One dot is the mean of {block} × {block} pixels."
        alt = f"{title} as a map over the sensor; 98 % of it lies between {significant(low)} and {significant(high)} {unit}."
        return Figure(figure, name, alt, f"{title}. {words}{blocks} Colours run from the 1st to the 99th percentile.")


def dark_codes(histogram: CodeHistogram) -> Figure:
    """Histogram of all dark codes with the normal distribution of the same spread."""
    counts = np.asarray(histogram.dark_counts, float)
    present = np.flatnonzero(counts)
    codes = np.arange(present[0], present[-1] + 1)
    mean = float((codes * counts[codes]).sum() / counts.sum())
    # from the middle half of the codes, so that a few hot pixels do not widen the law that they are compared with
    cumulative = np.cumsum(counts[codes]) / counts.sum()
    quartiles = np.interp([0.25, 0.75], cumulative, codes + 0.5)
    sigma = max(float(np.diff(quartiles)[0] / 1.349), 0.3)
    centre = float(np.interp(0.5, cumulative, codes + 0.5))
    normal = counts.sum() / (sigma * np.sqrt(2 * np.pi)) * np.exp(-0.5 * ((codes - centre) / sigma) ** 2)
    with canvas(2.6) as (figure, axes):
        shown = np.where(counts[codes] > 0, counts[codes], np.nan)
        line(axes, codes, shown, color=BLUE, drawstyle="steps-mid", label="dark frames")
        axes.plot(codes[normal > 0.5], normal[normal > 0.5], "--", color=RED, label="normal law of the middle half")
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.5)
        plain_log(axes.yaxis)
        axes.set_xlabel("code / DN")
        axes.set_ylabel("count")
        axes.legend(loc="best")
        alt = f"Histogram of all dark codes on a logarithmic axis; mean {significant(mean, 4)} DN, spread {significant(sigma, 2)} DN."
        caption = (
            "Codes of all dark frames, temporal noise and fixed pattern together. A tail to the right of the dashed line is hot pixels; a "
            "comb, or a gap, is the converter; a cut on the left is a black level set too low."
        )
        return Figure(figure, "dark-codes", alt, caption)


def all_pictures(seen: Observations, standard: Results, maps: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """Every figure that these observations can give, by name."""
    fitted = seen.photon_transfer_fit is not None and "nonlinearity_a1" in seen.photon_transfer_fit
    made = [variance_against_mean(seen, standard), nonlinearity(seen), signal_to_noise(seen)] if fitted else []
    if seen.dark_spectra is not None and seen.dark_stack is not None:
        made.append(spectra(seen.dark_spectra, "dark", seen.dark_stack.n_frames, 1.0, "DN"))
    if seen.bright_spectra is not None and seen.bright_stack is not None:
        fit = seen.photon_transfer_fit
        level = seen.bright_stack.mean_dn - (fit["offset_dn"].value if fit is not None and "offset_dn" in fit else 0.0)
        made.append(spectra(seen.bright_spectra, "bright", seen.bright_stack.n_frames, level / 100, "%"))
    if "dark_dn" in maps and seen.dark_stack is not None:
        stack = seen.dark_stack
        left = significant(np.sqrt(stack.ms_pixel_dn2 / stack.n_frames), 2)
        words = f"Mean of {stack.n_frames} dark frames above black. A pixel still holds {left} DN rms of temporal noise; the rest is fixed."
        made.append(map_picture(maps["dark_dn"], "map-dark", "Dark signal, pixel by pixel (DSNU)", "DN", words))
    if "prnu_rel" in maps:
        words = "Relative to the surroundings: slow change of the light and remaining temporal noise are taken out. Division takes it away."
        values = 100 * (np.asarray(maps["prnu_rel"], float) - 1)
        made.append(map_picture(values, "map-prnu", "Response, pixel by pixel (PRNU)", "%", words))
    if seen.histogram is not None and seen.histogram.dark_counts.sum() > 0:
        made.append(dark_codes(seen.histogram))
    return {p.name: p for p in made}


def target_picture(crop: Crop, budget: Budget) -> Figure:
    """The pixels of the budget's target as the twin shows it, its measured centre, and the ellipse of its uncertainty, enlarged."""
    from matplotlib.patches import Ellipse

    rows, cols = crop.data_dn.shape
    u_x, u_y = budget.verdict.total_x_px, budget.verdict.total_y_px
    largest = max(u_x, u_y)
    times = 10.0 ** np.floor(np.log10(ELLIPSE_SHARE * budget.target.diameter_px / largest)) if largest > 0 else 1.0
    where = (crop.x_hat_px, crop.y_hat_px)
    with canvas(3.1) as (figure, axes):
        image = axes.imshow(crop.data_dn, cmap="gray", interpolation="none", extent=(-0.5, cols - 0.5, rows - 0.5, -0.5))
        bar = figure.colorbar(image, ax=axes, shrink=0.85, aspect=18, pad=0.02)
        bar.set_label("DN")
        bar.outline.set_linewidth(0.4)
        half = min(SHOWN_DIAMETERS * budget.target.diameter_px + 2, 0.5 * min(rows, cols))
        axes.set_xlim(max(crop.x_px - half, -0.5), min(crop.x_px + half, cols - 0.5))
        axes.set_ylim(min(crop.y_px + half, rows - 0.5), max(crop.y_px - half, -0.5))
        axes.plot(crop.x_px, crop.y_px, "+", color=RED, markersize=11, markeredgewidth=1.4, label="true centre")
        if np.isfinite(where).all():
            axes.plot(*where, "x", color=BLUE, markersize=8, markeredgewidth=1.4, label="measured centre")
            axes.add_patch(Ellipse(where, 2 * times * u_x, 2 * times * u_y, fill=False, color=BLUE, linewidth=1.2))
        axes.grid(False)
        axes.tick_params(length=2)
        axes.set_xlabel("x / px")
        axes.set_ylabel("y / px")
        figure.legend(loc="outside upper center", ncols=2)
        off = length_px(float(np.hypot(where[0] - crop.x_px, where[1] - crop.y_px)))
        found, ellipse = "The target was not found here.", ""
        if np.isfinite(where).all():
            found = f"The measured centre is {off} px from the true one."
            ellipse = f" The ellipse is its standard uncertainty (k = 1){f', enlarged {times:g} times' if times != 1 else ''}."
        caption = f"The target of the budget in one frame, simulated with the digital twin of the camera. {found}{ellipse}"
        alt = f"Pixels of a simulated target, {cols} × {rows}. {found}"
        return Figure(figure, "target", alt, caption)


def link_shares(budget: Budget) -> Figure | None:
    """The chain from the light to the file: what each link takes of the square of the sum; None where nothing counts."""
    stages = budget.stages
    if not stages:
        return None
    at = np.arange(len(stages), dtype=float)
    share = np.array([max(s.share, 0.0) for s in stages])
    with canvas(0.75 + 0.3 * len(stages)) as (figure, axes):
        axes.barh(at, 100 * share, 0.5, color=BLUE)
        for k, stage in enumerate(stages):
            bound = f", accepted at most {length_px(stage.accepted_px)} px" if stage.accepted_px else ""
            words = f"{percent(stage.share)} %, {length_px(stage.total_px)} px" if stage.total_px else "nothing measured"
            axes.text(100 * share[k] + 1.5, at[k], words + bound, va="center", fontsize=6.3)
        along = axes.get_yaxis_transform()  # across: shares of the axes; upright: links
        axes.plot(np.full(len(at), -0.035), at, color=SOFT, linewidth=0.8, marker="v", markersize=3.6, clip_on=False, transform=along)
        axes.set_yticks(at, [s.stage for s in stages])
        axes.tick_params(axis="y", length=0, pad=13)
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.set_axisbelow(True)
        axes.set_xlim(0, max(100 * float(share.max()) * 1.9, 10.0))
        axes.set_xlabel("share of the square of the sum / %")
        told = ", ".join(f"{s.stage} {percent(s.share)} %" for s in stages)
        caption = (
            "The chain in the order of the light: what each link takes of the square of the sum, and what its sources come to together. "
            "What was accepted at its bound is told beside it and is no part of the sum."
        )
        return Figure(figure, "links", f"Share of each link of the chain in the square of the sum: {told}.", caption)


def pareto(budget: Budget) -> Figure | None:
    """The sources of the verdict by size, with what they come to together; None where there are none."""
    rows = [r for r in budget.rows if r.counts and r.status != "accepted"]
    shown = rows[:MOST_BARS]
    if not shown:
        return None
    at = np.arange(len(shown), dtype=float)
    u, bias = (np.array([_rms(r, part) for r in shown]) for part in ("u", "bias"))
    together = np.cumsum([max(r.share, 0.0) for r in shown])
    with canvas(0.75 + 0.3 * len(shown)) as (figure, axes):
        axes.barh(at - 0.14, u, 0.26, color=BLUE, label="standard uncertainty")
        axes.barh(at + 0.14, np.abs(bias), 0.26, color=RED, label="bias")
        longest = float(max(u.max(), np.abs(bias).max()))
        for k, part in enumerate(together):
            axes.text(max(u[k], abs(bias[k])) + 0.02 * longest, at[k], f"{percent(float(part))} %", va="center", fontsize=6.3, color=INK)
        axes.set_yticks(at, [_short(r.title) for r in shown], fontsize=6.3)
        axes.tick_params(axis="y", length=0)
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.set_axisbelow(True)
        axes.set_xlim(0, 1.25 * longest)
        axes.locator_params(axis="x", nbins=4)
        axes.set_xlabel("rms of x and y / px")
        figure.legend(loc="outside upper center", ncols=2)
        more = "" if len(rows) == len(shown) else f" {len(rows) - len(shown)} smaller ones are in the table of all sources."
        caption = f"The sources by size. The percentage is what a bar and all above it make of the square of the sum.{more}"
        alt = (
            f"The {len(shown)} largest of {len(rows)} sources by size; the largest is {shown[0].title}, {length_px(shown[0].total_px)} px."
        )
        return Figure(figure, "pareto", alt, caption)


def _rms(row: BudgetRow, part: str) -> float:
    """Root mean square over x and y of the standard uncertainty (``u``) or of the bias."""
    c = row.contribution
    return float(np.hypot(getattr(c, f"{part}_x_px"), getattr(c, f"{part}_y_px")) / np.sqrt(2))


def _short(title: str) -> str:
    return title if len(title) <= LONG_TITLE else title[: LONG_TITLE - 1].rstrip() + "…"
