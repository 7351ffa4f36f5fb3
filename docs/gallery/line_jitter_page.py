"""The page of the line-jitter experiment: its figures, tables and text. It shows the numbers that were stored when it was run in full."""

from __future__ import annotations

import numpy as np

from gallery.line_jitter import FRAMES, PIXEL_NS, Level, stored
from gallery.line_jitter_frames import AVERAGED, LENSES, LINES, POSITIONS, PRESET, VIEWS
from gallery.page import Page, show, table
from pixmetry.calibrate.lines.line_residuals import AxisResiduals, compare_axes
from pixmetry.calibrate.lines.row_jitter import Sampling, jitter_from_axes
from pixmetry.core.number import Estimates
from pixmetry.report.drawing import AMBER, BLUE, INK, RED, SOFT, canvas
from pixmetry.report.numbers import fixed, significant, uncertain
from pixmetry.report.page import Figure

COMMAND = "python benchmarks/study_line_jitter.py"
WAYS = {
    "axes": ("x against y", {"color": AMBER, "marker": "s"}),
    "rows": ("rows of one frame", {"color": RED, "marker": "o"}),
    "repeated": (f"{FRAMES} frames", {"color": BLUE, "marker": "^"}),
}
CHAPTER_UM, CHAPTER_PITCH_UM = (0.341, 0.291), (8.6, 8.3)


def predicted_x_px(level: Level, gain: float) -> float:
    """What y leaves over, brought to x, and the jitter of the averaged rows."""
    noise = level.y.rms_px**2 * level.stated_px2[0] / level.stated_px2[1]
    return float(np.sqrt(noise + (gain * level.jitter_ns / PIXEL_NS) ** 2 / AVERAGED))


def residual_figure() -> Figure:
    """Residuals of an upright and of a lying line without jitter and with 3 ns."""
    run = stored()
    levels = [level.jitter_ns for level in run.levels]
    with canvas(3.6, nrows=2, sharex=True, sharey=True) as (figure, panels):
        for axes, jitter in zip(panels, (0.0, 3.0), strict=True):
            x, y = run.example_px[levels.index(jitter)]
            axes.plot(np.arange(1, POSITIONS + 1), x, "o-", color=RED, linewidth=0.6, markersize=2, label="upright line: x")
            axes.plot(np.arange(1, POSITIONS + 1), y, "s-", color=BLUE, linewidth=0.6, markersize=2, label="lying line: y")
            axes.axhline(0, color=SOFT, linewidth=0.8)
            axes.set_title(f"line jitter {jitter:g} ns", loc="left")
            axes.set_ylabel("residual / px")
        panels[1].set_xlim(0, POSITIONS + 1)
        panels[1].set_xlabel("position along the line")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        still, shaken = (np.nanstd(run.example_px[levels.index(j)][0]) for j in (0.0, 3.0))
        alt = (
            f"Residuals along an upright and a lying line: without jitter alike; with 3 ns those in x grow from {still:.3f} to "
            f"{shaken:.3f} px."
        )
        caption = (
            f"What the calibration leaves over along one upright and one lying line, mean of {AVERAGED} rows (columns) each. Jitter shakes "
            "the rows sideways: upright lines show it, lying ones do not."
        )
        return Figure(figure, "line-jitter-residuals", alt, caption)


def size_figure() -> Figure:
    """Residuals in x and y against the jitter."""
    run = stored()
    jitter = [level.jitter_ns for level in run.levels]
    with canvas(2.6) as (figure, axes):
        axes.plot(jitter, [predicted_x_px(level, run.gain) for level in run.levels], color=SOFT, linestyle="--", label="x, predicted")
        axes.plot(jitter, [level.x.rms_px for level in run.levels], "o", color=RED, label="x, found")
        axes.plot(jitter, [level.y.rms_px for level in run.levels], "s", color=BLUE, label="y, found")
        for k, (um, pitch) in enumerate(zip(CHAPTER_UM, CHAPTER_PITCH_UM, strict=True)):
            axes.axhline(um / pitch, color=INK, linewidth=0.7, linestyle=(":", "-.")[k], label=f"the chapter's {'xy'[k]}")
        axes.set_xlabel("line jitter / ns")
        axes.set_ylabel("residual, rms / px")
        axes.set_xlim(-0.1, 5.2)
        axes.set_ylim(0, None)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        first, last = run.levels[0], run.levels[-1]
        alt = (
            f"Residuals against the jitter: x from {first.x.rms_px:.4f} px at 0 ns to {last.x.rms_px:.3f} px at {last.jitter_ns:g} ns, as "
            f"predicted; y stays at {last.y.rms_px:.4f} px."
        )
        caption = (
            "Root mean square of all residuals along x and y against the jitter of the frame grabber, and the chapter's two values. "
            "Dashed: noise as in y, and the jitter of the rows that were averaged."
        )
        return Figure(figure, "line-jitter-size", alt, caption)


def found_figure() -> Figure:
    """Jitter found less jitter put in, by each way."""
    run = stored()
    with canvas(2.6) as (figure, axes):
        for k, (way, (name, look)) in enumerate(WAYS.items()):
            at, error, u = [], [], []
            for level in run.levels:
                e = level.jitters(run.gain)[way]["jitter_ns"]
                if e.kind == "value":
                    at.append(level.jitter_ns + 0.08 * (k - 1))
                    error.append(e.value - level.jitter_ns)
                    u.append(2 * e.u)
            axes.errorbar(at, error, u, linestyle="none", label=name, capsize=2, linewidth=0.8, **look)
        axes.axhline(0, color=SOFT, linewidth=0.8)
        axes.set_xlabel("jitter put in / ns")
        axes.set_ylabel("found less put in / ns")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        worst = max(abs(found(run.levels[-1], way)["jitter_ns"].value - run.levels[-1].jitter_ns) for way in WAYS)
        alt = f"Jitter found less jitter put in, three ways: zero within two standard uncertainties; at 5 ns at most {worst:.2f} ns off."
        caption = (
            "Jitter found less jitter put in, with two standard uncertainties. Where it is not significant there is a limit instead "
            "(table)."
        )
        return Figure(figure, "line-jitter-found", alt, caption)


def found(level: Level, way: str) -> Estimates:
    """The jitter of one level by one way."""
    return level.jitters(stored().gain)[way]


def _residual_table() -> str:
    """In the form of the chapter's table, for each jitter."""
    rows = []
    for level in stored().levels:
        for name, axis in (("σx", level.x), ("σy", level.y)):
            size = [fixed(axis.rms_um, 4), fixed(axis.rms_px, 5), f"1/{1 / axis.rms_px:.0f}"]
            rows.append([f"{level.jitter_ns:g}", name, *size, fixed(_stated(level, name), 5)])
    return table(["jitter / ns", "", "µm", "pixels", "1/n px", "noise alone / px"], rows, 2)


def _stated(level: Level, name: str) -> float:
    return float(np.sqrt(level.stated_px2[0 if name == "σx" else 1]))


def _test_table() -> str:
    rows = []
    for level in stored().levels:
        test = level.f_test
        p = [_p(getattr(test, f"p_{unit}")[kind]) for unit in ("px", "um") for kind in ("positions", "effective", "lines")]
        rows.append([f"{level.jitter_ns:g}", fixed(test.ratio_px2, 3), *p[:3], fixed(test.ratio_um2, 3), *p[3:]])
    kinds = ["p, positions", "p, effective", "p, lines"]
    return table(["jitter / ns", "ratio in px²", *kinds, "ratio in µm²", *kinds], rows)


def _p(p: float) -> str:
    return "< 1e-6" if p < 1e-6 else significant(p, 2)


def _value(estimates: Estimates) -> str:
    e = estimates["jitter_ns"]
    if e.kind == "upper_limit":
        return f"< {fixed(e.value, 2)}"
    number = uncertain(e.value, e.u, "ns")
    return f"{number.value} ± {number.u}"


def _jitter_table() -> str:
    rows = [[f"{level.jitter_ns:g}", *(_value(found(level, way)) for way in (*WAYS, "columns"))] for level in stored().levels]
    return table(["put in / ns", *(name for name, _ in WAYS.values()), "check: columns of lying lines"], rows)


def _chapter() -> tuple[dict, Estimates, Estimates]:
    """The chapter's own residuals, tested with one degree of freedom for each line."""

    def axis(px: float, um: float) -> AxisResiduals:
        lines = len(VIEWS) * LINES
        n = lines * POSITIONS
        return AxisResiduals(px, um, n, lines, n - 2.0 * lines, n - 2.0 * lines, np.zeros(0), np.zeros(0))

    x, y = (axis(um / pitch, um) for um, pitch in zip(CHAPTER_UM, CHAPTER_PITCH_UM, strict=True))
    in_um = axis(CHAPTER_UM[1] / CHAPTER_PITCH_UM[0], CHAPTER_UM[1])
    one = Sampling(PIXEL_NS)
    return compare_axes(x, y), jitter_from_axes(x, y, one, kind="lines"), jitter_from_axes(x, in_um, one, kind="lines")


def page() -> Page:
    """Write it from the stored numbers."""
    run = stored()
    pictures = (residual_figure(), size_figure(), found_figure())
    none = run.levels[0]
    test, in_px, in_um = _chapter()
    px, um = in_px["jitter_ns"], in_um["jitter_ns"]
    off, u_k1 = _k1()
    text = f"""# Line jitter (Note 19, Table 3.2)

A frame grabber finds the start of every line of the video signal anew. Each time it is a little early or late, and the whole row moves
sideways by as much: by {1e3 / PIXEL_NS:.1f} thousandths of a pixel for every nanosecond. Is that to be seen?

## The experiment

{LINES} white wires before a dark ground are seen by three cameras with three lenses at three distances, {len(VIEWS)} frames with the wires
upright, and {len(VIEWS)} more with the camera rolled by 90°. On each wire there are {POSITIONS} positions, each the mean of {AVERAGED}
rows (columns) next to each other. Each pair of frames is calibrated by its plumb lines: what was straight must become straight, with
K1, K2, P1 and P2 of Brown's polynomial. The residuals along x, from the upright wires, are compared with those along y, from the lying
ones. Jitter acts on x only, so the camera is its own control.

Everything runs through the whole chain of `{PRESET}`: lens distortion (K1
{", ".join(significant(lens["k1_per_mm2"], 2) for lens in LENSES)} /mm², centres some pixels off), a sensor that is not
quite flat, interlaced read-out, noise, fixed patterns, video amplifier, cable, clamp, 8 bits. Only the grabber's own jitter is
replaced by {", ".join(f"{level.jitter_ns:g}" for level in run.levels)} ns, independent from row to row. Why the grabber that is driven by
the camera's pixel clock? The chapter's 0.341 µm are its 1/25 pixel only if a pixel of the image is 8.5 µm wide, as on the sensor (8.6 µm);
with a clock of 10 MHz it would be 12.2 µm wide.

The wires are found by `find_lines` and measured by `line_rows` without being told anything.

## What is left over

{show(pictures[0])}
In the form of the chapter's Table 3.2 (it has 0.341 µm, 1/25 pixel in x and 0.291 µm, 1/28 pixel in y):

{_residual_table()}
{show(pictures[1])}
"Noise alone" is what the estimator states for the pixels' noise. Even without jitter more than that is left: sensitivities and offsets
that differ from pixel to pixel, and what four lens parameters do not describe. Yet it is six times less than the chapter's residuals. Its
lines were a few pixels wide, unevenly lit and ringing, and we do not know how many rows it averaged and by which estimator. Its y
residuals at least are no line jitter, and jitter that would explain its x residuals alone, some {_needed_ns():.1f} ns here, would make x
several times as large as y.

Not everything is left in the residuals. K1 is found {1e5 * off:.1f}·10⁻⁵ /mm² below the lens' own on average (u of one pair about
{1e5 * u_k1:.1f}·10⁻⁵): light that falls aslant on a bowed sensor lands beside its place, and lines cannot tell that from a lens. P1 and P2
likewise take up most of what the shifted centre does.

## x against y

Jitter can only make x worse, so the F-test is one-sided. How many degrees of freedom? Of {none.x.n} positions in x,
{none.x.dof:.0f} would remain if all were independent ({POSITIONS} − 2 for each line, less the lens'). Neighbours on a line err partly
alike, though; from the correlations of the residuals along the lines (first neighbours {fixed(none.x.correlation[0], 2)} in x,
{fixed(none.y.correlation[0], 2)} in y) an effective number of {none.x.dof_effective:.0f} in x and {none.y.dof_effective:.0f} in y follows,
as dof/(1 + 2 Σ ρ²). The most careful takes one for each line, {none.x.lines}: right if all errors of a line were one, such as its own
light or blur.

{_test_table()}
Without jitter, x is still worse than y by a tenth of the variance, since pixel and video amplifier blur x more. With all positions taken
for independent, which their correlations nearly allow, this is significant: a real difference, but none of jitter (see below). A test
with many degrees of freedom finds any difference, whatever it is from. With one degree of freedom a line (critical value
{fixed(none.f_test.critical_95["lines"], 2)}) it is not significant, and 1 ns is. The unit matters, too, where pixels are not square:
equal in pixels is not equal in micrometres.

The chapter's own numbers, tested so: {fixed(test.ratio_px2, 3)} in px² (p = {fixed(test.p_px["lines"], 3)}),
{fixed(test.ratio_um2, 3)} in µm² (p = {fixed(test.p_um["lines"], 3)}), both significant at 5 %. If all of it were jitter, and
each position a single row that moves as the line does: {fixed(px.value, 2)} ns from pixels and {fixed(um.value, 2)} ns from micrometres,
{px.reason.replace("(one-sided 95 %)", "").strip()} and {um.reason.replace("(one-sided 95 %)", "").strip()} respectively (one-sided, 95 %).
So "not to be seen" holds for the size, not for the test.

## The jitter in nanoseconds

A position is the mean of {AVERAGED} rows, which shake independently: its jitter is that of a row over √{AVERAGED}. And a delay moves
the line by more than its own length: the amplifier's steps are still rising when the grabber samples them, so that a delay of one pixel
moves the position by {", ".join(fixed(g, 2) for g in run.gains)} pixels (wires near, farther, far; found by shearing a frame without
noise by a known delay). With both, three ways lead to the jitter:

- **x against y**: the difference of the variances, with the ratio of noise that the estimator states for x and y; one degree of freedom a
  line for the noise.
- **Rows of one frame**: a row crosses all eight wires and takes them along together. What the eight residuals of a row share is jitter,
  what they do not share is not (one-way analysis of variance). It needs no lying wires, and each frame is one for itself.
- **{FRAMES} frames** of one view: the same, less the mean of the frames, so that fixed patterns do not count.

{_jitter_table()}
{show(pictures[2])}
"<" is a one-sided limit at 95 %. The analysis of rows is by far the sharpest without jitter: it stays below
{fixed(found(none, "rows")["jitter_ns"].value, 2)} ns where x against y cannot say more than
{fixed(found(none, "axes")["jitter_ns"].value, 2)} ns. The same analysis of columns on the lying wires, where jitter has no part, finds
nothing at any level, as it must.

## What to do about it

- Put {LINES} wires, or the edges of a chart, upright before the camera: **one frame** tells the jitter of {POSITIONS * AVERAGED} rows.
- A specified jitter of 1 ns moves a row by {run.gain / PIXEL_NS:.3f} px here; a target of some rows by that over the root of their number.
  Against noise of {none.x.rms_px:.4f} px in {AVERAGED} rows, 1 ns doubles the residual, and {_equal_ns():.1f} ns are as large as all
  the rest together.
- Sample with the camera's pixel clock, average frames, or take a digital camera.

Run in full with `{COMMAND}` ({len(VIEWS) * 2 * len(run.levels)} frames and the repeated ones, about two minutes of one core), which stores
the numbers that `scripts/make_handbook.py` writes here; run again, both give the same.
"""
    return Page("line-jitter", text, pictures)


def _k1() -> tuple[float, float]:
    """How much lower K1 is found than put in, mean over the pairs without jitter, and the standard uncertainty of one."""
    pairs = {name: view.k1_per_mm2 for name, view in stored().views.items() if name.endswith(" 0")}
    off = [LENSES[int(name[2])]["k1_per_mm2"] - k1 for name, (k1, _) in pairs.items()]
    return float(np.mean(off)), float(np.median([u for _, u in pairs.values()]))


def _needed_ns() -> float:
    """Jitter that would make the x residuals as large as the chapter's."""
    run = stored()
    own = run.levels[0].x.rms_px
    return float(np.sqrt(((CHAPTER_UM[0] / CHAPTER_PITCH_UM[0]) ** 2 - own**2) * AVERAGED) * PIXEL_NS / run.gain)


def _equal_ns() -> float:
    """Jitter whose share of the residuals equals the rest."""
    run = stored()
    return float(run.levels[0].x.rms_px * np.sqrt(AVERAGED) * PIXEL_NS / run.gain)
