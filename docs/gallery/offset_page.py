"""The page of the offset experiment: its figures, tables and text."""

from __future__ import annotations

import numpy as np

from gallery import offset as experiment
from gallery.item import Item
from gallery.offset import (
    BLACK_DN,
    NOISE_DN,
    OFFSET_DN,
    PEAK_DN,
    PIECE_ROWS,
    ROWS,
    SAMPLES,
    SIGMA_PX,
    predicted,
    predicted_rms,
    swing,
)
from gallery.page import Page, show, table
from pixmetry.locate.bound.closed_bounds import line_read
from pixmetry.report.drawing import AMBER, BLUE, INK, RED, SOFT, canvas
from pixmetry.report.numbers import MINUS, fixed
from pixmetry.report.page import Figure

WAYS = {
    "centroid": {"color": RED, "marker": "o"},
    "squared centroid": {"color": BLUE, "marker": "s"},
    "soft threshold": {"color": AMBER, "linestyle": "--", "marker": "^"},
    "fit": {"color": INK, "linestyle": ":", "marker": "D"},
}
NAMES = {"soft threshold": "black subtracted, soft threshold", "fit": "fit with known cut-off"}


def error_figure() -> Figure:
    """Error while the line moves through three pixels, with and without the offset."""
    with canvas(3.9, nrows=2, sharex=True, sharey=True) as (figure, panels):
        for axes, offset in zip(panels, (OFFSET_DN, 0.0), strict=True):
            c = experiment.centres()
            axes.plot(c, swing(offset, "rounded").error_px, color=RED, linewidth=0.6, label="rounded to 8 bits")
            axes.plot(c, swing(offset).error_px, color=BLUE, label="not rounded")
            axes.set_title(f"offset {offset:g} grey values", loc="left")
            axes.set_ylabel("error / px")
        panels[1].set_xlim(-1.5, 1.5)
        panels[1].set_ylim(-0.02, 0.02)
        panels[1].set_xlabel("true position of the line / px")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        six, none = swing(OFFSET_DN), swing(0.0, "rounded")
        alt = (
            f"Error of the centroid over three pixels: with an offset of 6 a wave of three periods, ±{six.half_range_px:.4f} px; without "
            f"offset a flat line or, with rounding, scatter of ±{none.half_range_px:.4f} px."
        )
        caption = (
            "Error of the row's centroid while the line moves through three pixels. Top: six grey values are lost at the foot of the "
            "line. Bottom: none is lost. Blue: grey values that are not rounded; red: whole numbers."
        )
        return Figure(figure, "offset-error", alt, caption)


def depth_figure() -> Figure:
    """First amplitude against the offset."""
    fine, coarse = np.arange(0.25, 40.1, 0.25), np.arange(2.0, 41.0, 2.0)
    with canvas(2.7) as (figure, axes):
        for power, colour, marker, name in ((1, RED, "o", "centroid"), (2, BLUE, "s", "squared centroid")):
            axes.plot(fine, experiment.against_offset(fine, power)[1], color=colour, label=f"{name}, predicted")
            dots = experiment.against_offset(coarse, power)[0]
            axes.plot(coarse, dots, marker, color=INK, markerfacecolor="none", markeredgewidth=0.7, markersize=3, label=f"{name}, found")
        axes.axhline(0, color=SOFT, linewidth=0.8)
        axes.set_xlim(0, 40)
        axes.set_xlabel("offset / grey values")
        axes.set_ylabel("amplitude a₁ / px")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
        low, high = (swing(o).first_px for o in (30.0, 15.0))
        alt = (
            f"Amplitude of the error against the offset: it changes its sign repeatedly and grows, {high:+.3f} px at 15, {low:+.3f} "
            f"px at 30."
        )
        caption = (
            "Amplitude of the first wave, sin 2πc, against the offset. The sign gives the direction of the error. Lines: from the "
            "integral below; marks: from the rows. A larger offset can cause a smaller error."
        )
        return Figure(figure, "offset-depth", alt, caption)


def cures_figure() -> Figure:
    """Error with noise against the black level for each way to locate the line."""
    found = experiment.cures()
    with canvas(2.9) as (figure, axes):
        for way, look in WAYS.items():
            axes.plot(BLACK_DN, found[way].total_px, label=NAMES.get(way, way), **look)
        axes.set_yscale("log")
        axes.set_ylim(0.002, 0.5)
        ticks = ["0.002", "0.005", "0.01", "0.02", "0.05", "0.1", "0.2", "0.5"]
        axes.set_yticks([float(t) for t in ticks], ticks)
        axes.minorticks_off()
        axes.set_xticks(BLACK_DN)
        axes.set_xlabel("black level / grey values")
        axes.set_ylabel(f"error of {PIECE_ROWS} rows, rms / px")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
        plain, fit = found["centroid"].total_px, found["fit"].total_px
        alt = (
            f"Error of a piece of the line against the black level: the centroid from {plain[0]:.3f} px at −12 to {plain[-1]:.2f} px at "
            f"+12; the fit at most {fit.max():.4f} px throughout."
        )
        caption = (
            f"Error of pieces of {PIECE_ROWS} rows, with noise (σ {NOISE_DN:g} grey values), against the level at which black is stored. "
            f"Negative values are lost. Centroids of the original grey values are better if black is lost, the soft threshold is better "
            "if it is kept, and the fit is independent of it."
        )
        return Figure(figure, "offset-cures", alt, caption)


def _micro(value: float) -> str:
    """In thousandths of a pixel."""
    return fixed(1e3 * abs(value), 2)


def _swings() -> str:
    """Every variant: amplitude, half range and rms, and the values of the integral."""
    rows = []
    for offset in (OFFSET_DN, 0.0):
        for integrated in (False, True):
            for power in (1, 2):
                said = predicted(offset, power, integrated)
                for conversion in ("unquantised", "rounded", "truncated"):
                    one = swing(offset, conversion, power, integrated)
                    theory = [_micro(said[0]), _micro(predicted_rms(said))] if conversion == "unquantised" else ["", ""]
                    what = ["squared" if power == 2 else "centroid", "averaged" if integrated else "at the middle", WORDS[conversion]]
                    rows.append([f"{offset:g}", *what, *map(_micro, (one.first_px, one.half_range_px, one.rms_px)), *theory])
    head = ["offset", "estimator", "light in the pixel", "grey values", "a₁", "half range", "rms", "a₁ predicted", "rms predicted"]
    return table(head, rows, 4)


WORDS = {"unquantised": "not rounded", "rounded": "rounded", "truncated": "truncated"}


def _claims() -> str:
    """The statements of the chapter, and the results here."""
    six, six_8, six_cut = (swing(OFFSET_DN, c) for c in ("unquantised", "rounded", "truncated"))
    none, none_8 = swing(0.0), swing(0.0, "rounded")
    square = swing(OFFSET_DN, power=2)
    depths = np.arange(0.25, 30.1, 0.25)
    largest = [float(np.abs(experiment.against_offset(depths, power)[1]).max()) for power in (1, 2)]
    rows = [
        [
            "Fig 3.13, offset 6: a wave, on an axis of ±0.02 px",
            f"three periods, amplitude {abs(six.first_px):.4f} px, largest error {six.half_range_px:.4f} px; rounded "
            f"{six_8.half_range_px:.4f}, truncated {six_cut.half_range_px:.4f} px",
        ],
        [
            "Fig 3.14, offset 0: no wave",
            f"{'below 1e-12' if none.half_range_px < 1e-12 else f'{none.half_range_px:.1e}'} px without rounding; with rounding, "
            f"scatter of ±{none_8.half_range_px:.4f} px (rms {none_8.rms_px:.4f} px), because rounding removes the part of the feet below "
            "half a grey value",
        ],
        [
            "a symmetric line has no error",
            "yes: the error is zero if the line is in the middle of a pixel or between two pixels",
        ],
        [
            "the squared centroid has a smaller error",
            f"yes: amplitude {abs(square.first_px):.5f} px at 6. Up to an offset of 30 the largest amplitude is {largest[1]:.4f} "
            f"px, that of the centroid {largest[0]:.4f} px",
        ],
        ["the error is systematic", "yes; averaging frames does not reduce it, averaging over positions within the pixel does"],
        [
            "no such error with the background above zero",
            "yes, if the background is subtracted; otherwise it shifts the centroid (see below)",
        ],
        [
            "best setting: just below the first step of the converter",
            "yes for centroids of the original grey values; not otherwise (see below)",
        ],
    ]
    return table(["the chapter", "here"], rows, 2)


def _real() -> str:
    """Figs 3.15 to 3.17: the same model for the chapter's real lines and targets."""
    shares = (0.02, 0.1, 0.2, 0.3, 0.5, 0.6, 0.7, 0.8)
    rows = []
    for sigma in (0.8, 1.0, 1.2, 1.5):
        rows.append([f"{sigma:g}", *(fixed(swing(s * PEAK_DN, sigma_px=sigma).first_px, 3) for s in shares)])
    deep = table(["σ of the line / px", *(f"{100 * s:.0f} %" for s in shares)], rows)
    seen = experiment.exposures()
    lines = [
        [f"{offset:g}", *(f"{fixed(e, 4)} ± {u:.4f}" for e, u in zip(seen.error_px[offset], seen.u_px[offset], strict=True))]
        for offset in seen.error_px
    ]
    still = table(["offset", *(f"peak {p:g}" for p in seen.peak_dn)], lines)
    stray, rule = experiment.outlier_shift()
    return f"""**Fig 3.15** shows a real line before the adjustment; its error oscillates within ±0.3 px. Such an error needs an offset
of a large share of the peak. The amplitude a₁ in px for offsets of 2 to 80 % of the peak (not rounded, light at the pixel's middle):

{deep}
Amplitudes of 0.1 to 0.3 px occur, but several offsets give the same amplitude: without the width of the line, the offset cannot be
computed from the amplitude. Fit the line with its cut-off instead.

**Fig 3.16** shows the same line after the adjustment; single rows are outliers. A stray grey value v at a distance d shifts a centroid by
v·d over the sum of the row's grey values. A stray value of 1 at 10 px from a line with peak {PEAK_DN:g} and σ {SIGMA_PX:g} px shifts it by
{stray:.4f} px (by the rule: {rule:.4f} px).

**Fig 3.17** shows a target at rest, at several exposures. Here it is a round Gaussian spot of σ 1 px at 0.35 px from the middle of its
pixel, in 21 × 21 px, with noise of the variance 0.81 + 0.0097 I. Mean error in x of 800 frames, px:

{still}
If much is cut off, the target moves when the light changes. This shows without any test chart whether black is set too low.
"""


def _cured() -> str:
    """Random and systematic errors at three black levels."""
    found = experiment.cures()
    at = [int(np.flatnonzero(black == BLACK_DN)[0]) for black in (-6.0, 0.0, 6.0)]
    rows = []
    for way in WAYS:
        cure = found[way]
        cells = [f"{v[j]:.4f}" for j in at for v in (cure.random_px, cure.lasting_px)]
        rows.append([NAMES.get(way, way), *cells])
    head = ["px"] + [f"{name}, black {fixed(BLACK_DN[j], 0)}" for j in at for name in ("random", "systematic")]
    return table(head, rows)


def page() -> Page:
    """Run the experiment and write it up."""
    pictures = error_figure(), depth_figure(), cures_figure()
    found = experiment.cures()
    soft, fit = found["soft threshold"], found["fit"]
    above = int(np.flatnonzero(BLACK_DN == 6.0)[0])
    bound = line_read(SIGMA_PX, PEAK_DN, float(np.sqrt(NOISE_DN**2 + 1 / 12)), PIECE_ROWS)
    said = predicted(OFFSET_DN)
    waves = ", ".join(fixed(1e3 * a, 2) for a in said[:4])
    text = f"""# Black below zero (Note 13, Figs 3.13 and 3.14)

A converter stores no values below zero. If the black level is below zero, the converter cuts off the feet of every target. The images
look cleaner than they should, and the centroids have an error: the cut-off acts like a threshold.

## The experiment

A line has a Gaussian profile with σ {SIGMA_PX:g} px and a peak of {PEAK_DN:g} grey values. It shifts by {experiment.SKEW_PX:g} px over
{ROWS} rows: its position in the row goes from −1.5 to 1.5 px about the middle of {SAMPLES} pixels (±{experiment.MIDDLE} px, wide enough
that nothing is lost at the ends). There is no noise and no background. From every grey value {OFFSET_DN:g} is subtracted (Fig 3.13), or
nothing (Fig 3.14); negative values become 0. The centroid of each row is compared with the truth. Variants: light at the middle of the
pixel, as in the chapter's formula, or averaged over the pixel, as in a sensor; grey values not rounded, rounded, or truncated; centroid or
squared centroid.

## The result

{show(pictures[0])}
{_claims()}
The same value is subtracted on both sides of the line. Why does the line move? Only a line that is symmetric on its pixels loses the same
amount on both sides. Otherwise one foot ends just before a pixel centre and the other just behind one. This averages out when the line
moves by one pixel. The error is therefore a wave with a period of one pixel.

The error can be computed without a simulation. With the remaining profile h, the error at a position c is

    e(c) = −2 Σ S_k sin(2πkc) / ∫h,   S_k = ∫ x h(x) sin(2πkx) dx,   k = 1, 2, 3 …

A profile without frequencies of one cycle per pixel and above therefore has no error at any position. A Gaussian of σ {SIGMA_PX:g} px is
such a profile; the cut at its feet adds these frequencies. Here the first four amplitudes are {waves} thousandths of a pixel. They depend
on the positions where the feet end:

{show(pictures[1])}
In thousandths of a pixel (a₁: amplitude of sin 2πc; half range: half the difference between the largest and the smallest error; both
without sign):

{_swings()}
Rounding alone causes errors of up to {swing(0.0, "rounded").half_range_px:.3f} px, without any offset: many small jumps and no wave. Noise
of half a grey value or more turns these jumps into noise; it does not remove the wave.

## What to do about it

Now there is noise of σ {NOISE_DN:g} grey values, values are rounded, light is averaged over the pixel, and the stored black level goes from
−12 to 12. A line is rarely measured in a single row, so {PIECE_ROWS} rows are one piece: the mean of the centroids of its rows, or one
fit. There are {ROWS // PIECE_ROWS} pieces in 20 frames:

{show(pictures[2])}
{_cured()}
"Random" is the part that changes from frame to frame. "Systematic" is the error of the mean of infinitely many frames (below 0.0005 px
it is not significant here).

- **Keep black above zero** by three standard deviations of the noise or more, so that nothing is cut off. **Subtract it**, and use a
  **soft threshold** of three standard deviations. Then the error is {soft.total_px[above]:.4f} px at every such level, of which
  {soft.lasting_px[above]:.4f} px are systematic. This threshold also cuts off the feet, but it is low and known.
- **If black was lost, do not add a threshold**: both cut-offs act together, and the systematic error grows to {soft.lasting_px.max():.4f}
  px at {fixed(BLACK_DN[soft.lasting_px.argmax()], 0)}.
- **The squared centroid** is hardly sensitive to the cut-off, because squares are small at the feet. It is sensitive to a background that
  is not subtracted.
- A plain centroid over all {SAMPLES} pixels, without a threshold, is best with black *below* zero, because this removes the background
  and its noise: here the chapter's advice is right. A background above zero that is not subtracted shifts the centroid towards the middle
  of the window.
- **Best: fit the line.** The template of a straight line knows the noise and that the scale ends at 0. Its error is at most
  {fit.total_px.max():.5f} px at any black level, also in frames in which black was lost; it states {fit.stated_px.min():.5f} to
  {fit.stated_px.max():.5f} px. No estimator can be better: the Cramér–Rao bound of such a piece, without cut-off, is {bound:.5f} px.

## The chapter's real lines and targets

{_real()}
Written by `scripts/make_handbook.py` from `gallery.offset`; it writes the same numbers in every run.
"""
    return Page("offset", text.replace("px, -", f"px, {MINUS}"), pictures)


def items() -> list[Item]:
    """The chapter's statements with a number."""
    six, none, rounded = swing(OFFSET_DN, "rounded"), swing(0.0), swing(0.0, "rounded")
    stray, rule = experiment.outlier_shift()
    periods = float(np.abs(np.fft.rfft(swing(OFFSET_DN).error_px)).argmax())
    seen = experiment.exposures()
    before, after = (float(np.ptp(seen.error_px[offset])) for offset in (40.0, 6.0))
    u_before, u_after = (float(np.hypot(seen.u_px[o][0], seen.u_px[o][-1])) for o in (40.0, 6.0))
    deep = max(abs(swing(share * PEAK_DN, sigma_px=sigma).first_px) for sigma in (0.8, 1.0, 1.2) for share in (0.5, 0.6, 0.7, 0.8))
    tails = "differs because rounding also cuts off the feet below half a grey value; without it the line is straight"
    weak = (
        "differs because its band of 0.4 px needs a larger share cut off than 40 of 220 to 60 grey values; "
        f"amplitudes of up to {deep:.2f} px, as in Fig 3.15, come from more than half of the peak"
    )
    return [
        Item.judged("Fig 3.13", "largest error with an offset of 6, rounded / px", "S", 0.01, six.half_range_px, 0.01,
                    why="expected: a wave within the axis of ±0.02 px"),
        Item.judged("N13", "periods of the wave while the line shifts by 3 px", "S", 3.0, periods, 0,
                    why="strongest wave of the error without rounding; one period a pixel"),
        Item.judged("Fig 3.14a", "largest error without an offset, not rounded / px", "S", 0.0, round(none.half_range_px, 12), 1e-12),
        Item.judged("Fig 3.14b", "the same, rounded to 8 bits / px", "S", 0.0, rounded.half_range_px, 0.005, otherwise=tails),
        Item.judged("Fig 3.15", "largest amplitude, half to four fifths of the peak cut off / px", "S", 0.3, deep, 0.05,
                    why="expected: the axis, ±0.3 px; tolerance: half a step of it"),
        Item.judged("Fig 3.16", "shift of a row by a stray value of 1 at 10 px / px", "S", rule, stray, 0.001,
                    why="expected: value · distance / sum"),
        Item.judged("Fig 3.17a", "range of the places of a target at four exposures, 40 cut off / px", "S", 0.4, before, 0.05, u_before,
                    otherwise=weak),
        Item.judged("Fig 3.17b", "the same, 6 cut off / px", "S", 0.0, after, 0.02, u_after,
                    why="levels of the three exposures differ little"),
    ]  # fmt: skip
