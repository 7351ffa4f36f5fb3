"""The page of the line-jitter experiment: its figures, tables and text. It shows the numbers that were stored when it was run in full."""

from __future__ import annotations

import numpy as np

from gallery.item import Item
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
    """The residual of y, scaled to the noise of x, with the jitter of the averaged rows."""
    noise = level.y.rms_px**2 * level.stated_px2[0] / level.stated_px2[1]
    return float(np.sqrt(noise + (gain * level.jitter_ns / PIXEL_NS) ** 2 / AVERAGED))


def residual_figure() -> Figure:
    """Residuals of a vertical and of a horizontal line without jitter and with 3 ns."""
    run = stored()
    levels = [level.jitter_ns for level in run.levels]
    with canvas(3.6, nrows=2, sharex=True, sharey=True) as (figure, panels):
        for axes, jitter in zip(panels, (0.0, 3.0), strict=True):
            x, y = run.example_px[levels.index(jitter)]
            axes.plot(np.arange(1, POSITIONS + 1), x, "o-", color=RED, linewidth=0.6, markersize=2, label="vertical line: x")
            axes.plot(np.arange(1, POSITIONS + 1), y, "s-", color=BLUE, linewidth=0.6, markersize=2, label="horizontal line: y")
            axes.axhline(0, color=SOFT, linewidth=0.8)
            axes.set_title(f"line jitter {jitter:g} ns", loc="left")
            axes.set_ylabel("residual / px")
        panels[1].set_xlim(0, POSITIONS + 1)
        panels[1].set_xlabel("position along the line")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        still, shaken = (np.nanstd(run.example_px[levels.index(j)][0]) for j in (0.0, 3.0))
        alt = (
            f"Residuals along a vertical and a horizontal line: similar without jitter; with 3 ns those in x grow from {still:.3f} to "
            f"{shaken:.3f} px."
        )
        caption = (
            f"Residuals of the calibration along one vertical and one horizontal line, each the mean of {AVERAGED} rows (columns). Jitter "
            "shifts rows sideways: vertical lines show it, horizontal lines do not."
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
            axes.axhline(um / pitch, color=INK, linewidth=0.7, linestyle=(":", "-.")[k], label=f"{'xy'[k]} of the chapter")
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
            "Dashed: noise as in y plus the jitter of the averaged rows."
        )
        return Figure(figure, "line-jitter-size", alt, caption)


def found_figure() -> Figure:
    """Measured minus simulated jitter, by each method."""
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
        axes.set_xlabel("simulated jitter / ns")
        axes.set_ylabel("measured minus simulated / ns")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        worst = max(abs(found(run.levels[-1], way)["jitter_ns"].value - run.levels[-1].jitter_ns) for way in WAYS)
        alt = (
            "Measured minus simulated jitter, three methods: zero within two standard uncertainties; at 5 ns the error is at most "
            f"{worst:.2f} ns."
        )
        caption = (
            "Measured minus simulated jitter, with two standard uncertainties. If the jitter is not significant, the table gives a limit "
            "instead."
        )
        return Figure(figure, "line-jitter-found", alt, caption)


def found(level: Level, way: str) -> Estimates:
    """The jitter of one level by one method."""
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
    return table(["simulated / ns", *(name for name, _ in WAYS.values()), "check: columns of horizontal lines"], rows)


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

A frame grabber detects the start of every line of the video signal. Each time it is slightly early or late, and the whole row shifts
sideways, by {1e3 / PIXEL_NS:.1f} thousandths of a pixel for every nanosecond. Is this visible in the residuals of straight lines?

## The experiment

Three cameras with three lenses image {LINES} white wires in front of a dark background from three distances. There are {len(VIEWS)} frames
with vertical wires, and {len(VIEWS)} with the camera rolled by 90°. Each wire has {POSITIONS} positions, each the mean of {AVERAGED}
neighbouring rows (columns). Each pair of frames is calibrated with plumb lines: straight wires must become straight lines, with K1, K2,
P1 and P2 of Brown's polynomial. The residuals along x, from vertical wires, are compared with those along y, from horizontal wires.
Jitter acts on x only, so y is the control.

The whole chain of `{PRESET}` is simulated: lens distortion (K1
{", ".join(significant(lens["k1_per_mm2"], 2) for lens in LENSES)} /mm², centres some pixels away from the middle), a sensor that is not
exactly flat, interlaced read-out, noise, fixed patterns, video amplifier, cable, clamp, 8 bits. Only the grabber's own jitter is
replaced by {", ".join(f"{level.jitter_ns:g}" for level in run.levels)} ns, independent from row to row. This grabber uses the camera's
pixel clock, because the chapter's 0.341 µm equal its 1/25 pixel only if a pixel of the image is 8.5 µm wide, as on the sensor (8.6 µm).
With a clock of 10 MHz it would be 12.2 µm wide.

`find_lines` finds the wires and `line_rows` measures them, without any settings.

## The residuals

{show(pictures[0])}
In the form of the chapter's Table 3.2 (whose values are 0.341 µm, 1/25 pixel in x and 0.291 µm, 1/28 pixel in y):

{_residual_table()}
{show(pictures[1])}
"Noise alone" is the uncertainty that the estimator states for the noise of the pixels. Even without jitter the residuals are larger:
sensitivities and offsets differ from pixel to pixel, and four lens parameters do not describe everything. Still they are six times smaller
than those of the chapter. The chapter's lines were a few pixels wide, unevenly lit and with ringing; the number of averaged rows and the
estimator are unknown. Its y residuals, at least, cannot be line jitter. Jitter that would explain its x residuals alone, about
{_needed_ns():.1f} ns here, would make x several times as large as y.

The residuals do not contain all errors. The measured K1 is on average {1e5 * off:.1f}·10⁻⁵ /mm² below that of the lens (u of one pair
about {1e5 * u_k1:.1f}·10⁻⁵): oblique light hits a bowed sensor at a shifted position, and lines cannot separate this from distortion. In
the same way P1 and P2 include most of the effect of the shifted centre.

## x against y

Jitter can only increase x, so the F-test is one-sided. How many degrees of freedom are there? The {none.x.n} positions in x would give
{none.x.dof:.0f} if all were independent ({POSITIONS} − 2 for each line, minus the lens parameters). But the errors of neighbours on a line
are correlated. From the correlations of the residuals along the lines (first neighbours {fixed(none.x.correlation[0], 2)} in x,
{fixed(none.y.correlation[0], 2)} in y) an effective number of {none.x.dof_effective:.0f} in x and {none.y.dof_effective:.0f} in y follows,
by dof/(1 + 2 Σ ρ²). The most cautious choice is one for each line, {none.x.lines}. It is right if all errors of a line have one common
cause, such as its light or its blur.

{_test_table()}
Without jitter, the variance of x is still a tenth larger than that of y, because pixel and video amplifier blur x more. If all positions
count as independent, which their correlations nearly allow, this is significant: a real difference, but not jitter (see below). A test
with many degrees of freedom detects any difference, whatever its cause. With one degree of freedom for each line (critical value
{fixed(none.f_test.critical_95["lines"], 2)}) it is not significant, while 1 ns is. The unit matters, too, if pixels are not square:
equal in pixels is not equal in micrometres.

The chapter's own numbers, tested in this way: {fixed(test.ratio_px2, 3)} in px² (p = {fixed(test.p_px["lines"], 3)}),
{fixed(test.ratio_um2, 3)} in µm² (p = {fixed(test.p_um["lines"], 3)}), both significant at 5 %. If jitter were the only cause, and
each position were a single row that moves with the line: {fixed(px.value, 2)} ns from pixels and {fixed(um.value, 2)} ns from micrometres,
{px.reason.replace("(one-sided 95 %)", "").strip()} and {um.reason.replace("(one-sided 95 %)", "").strip()} respectively (one-sided, 95 %).
The chapter's statement that jitter is not visible holds for the size of the residuals, but not for the test.

## The jitter in nanoseconds

A position is the mean of {AVERAGED} rows with independent jitter: its jitter is that of a row over √{AVERAGED}. Moreover, a delay moves
the line by more than the delay itself, because the amplifier's steps are still rising when the grabber samples them. A delay of one pixel
moves the position by {", ".join(fixed(g, 2) for g in run.gains)} pixels (wires near, farther, far; measured by shearing a noise-free frame
by a known delay). With both factors, three methods give the jitter:

- **x against y**: the difference of the variances, with the ratio of noise that the estimator states for x and y. One degree of freedom
  for each line is assumed for the noise.
- **Rows of one frame**: a row crosses all eight wires and shifts them together. The common part of the eight residuals of a row is jitter,
  the rest is not (one-way analysis of variance). This needs no horizontal wires, and a single frame is enough.
- **{FRAMES} frames** of one view: the same after subtraction of the mean of the frames, so that fixed patterns do not count.

{_jitter_table()}
{show(pictures[2])}
"<" is a one-sided limit at 95 %. The analysis of rows is by far the most sensitive: without jitter its limit is
{fixed(found(none, "rows")["jitter_ns"].value, 2)} ns, while that of x against y is
{fixed(found(none, "axes")["jitter_ns"].value, 2)} ns. The same analysis of columns on the horizontal wires, where jitter has no effect,
finds nothing at any level, as it must.

## What to do about it

- Place {LINES} vertical wires, or the vertical edges of a chart, in front of the camera: **one frame** gives the jitter of
  {POSITIONS * AVERAGED} rows.
- A jitter of 1 ns moves a row by {run.gain / PIXEL_NS:.3f} px here, and a target of n rows by this value over √n. Compared with noise of
  {none.x.rms_px:.4f} px in {AVERAGED} rows, 1 ns doubles the residual, and {_equal_ns():.1f} ns are as large as everything else together.
- Sample with the camera's pixel clock, average frames, or use a digital camera.

`{COMMAND}` runs the full experiment ({len(VIEWS) * 2 * len(run.levels)} frames and the repeated ones, about two minutes on one core) and
stores the numbers that `scripts/make_handbook.py` writes here. Both give the same numbers in every run.
"""
    return Page("line-jitter", text, pictures)


def _k1() -> tuple[float, float]:
    """Simulated minus measured K1, mean over the pairs without jitter, and the standard uncertainty of one pair."""
    pairs = {name: view.k1_per_mm2 for name, view in stored().views.items() if name.endswith(" 0")}
    off = [LENSES[int(name[2])]["k1_per_mm2"] - k1 for name, (k1, _) in pairs.items()]
    return float(np.mean(off)), float(np.median([u for _, u in pairs.values()]))


def _needed_ns() -> float:
    """Jitter that would make the x residuals as large as the chapter's."""
    run = stored()
    own = run.levels[0].x.rms_px
    return float(np.sqrt(((CHAPTER_UM[0] / CHAPTER_PITCH_UM[0]) ** 2 - own**2) * AVERAGED) * PIXEL_NS / run.gain)


def _equal_ns() -> float:
    """Jitter whose contribution to the residuals equals that of everything else."""
    run = stored()
    return float(run.levels[0].x.rms_px * np.sqrt(AVERAGED) * PIXEL_NS / run.gain)


def items() -> list[Item]:
    """The chapter's numbers."""
    none, one = stored().levels[:2]
    test, _, _ = _chapter()
    rows = found(one, "rows")["jitter_ns"]
    quality = "differs because its lines were a few pixels wide, unevenly lit and with ringing, and its estimator is not told; here {}"
    shown = "noise, fixed patterns and the lens model leave {:.4f} px without jitter"
    size = [Item.judged(f"T3.2{k}", f"residual along {axis} / px", "V", 1 / n, left.rms_px, 0.01,
                        otherwise=quality.format(shown.format(left.rms_px)))
            for k, axis, n, left in (("a", "x", 25, none.x), ("b", "y", 28, none.y))]  # fmt: skip
    ratio = test.ratio_px2
    upright, lying = np.nanstd(stored().example_px[0], axis=1)
    return [
        Item.judged("Fig 3.23ab", "scatter on one upright line over that on a lying one, no jitter", "V", 1.0, upright / lying, 0.25,
                    why="the chapter sees no difference between x and y"),
        *size,
        Item.judged("T3.2c", "0.341 µm in pixels of 8.6 µm", "E", 1 / 25, CHAPTER_UM[0] / 8.6, 0.0005, why="printed: 1/25"),
        Item.judged("T3.2d", "0.291 µm in pixels of 8.3 µm", "E", 1 / 28, CHAPTER_UM[1] / 8.3, 0.0007, why="printed: 1/28; it is 1/28.5"),
        Item.judged("N20", "positions on lines in all images", "E", 34560, 2 * LINES * POSITIONS * len(VIEWS), 0, why="8 · 80 · 27 · 2"),
        Item.judged("N26a", "variance along x over that along y, its own residuals in px", "E", 1.0, ratio, 0.25,
                    otherwise=f"differs because the chapter sees no evidence in its numbers, but (0.341/8.6)² / (0.291/8.3)² = "
                    f"{ratio:.3f}; with one "
                    "degree of freedom for each line and image (216) the critical value is 1.25 (5 %, one-sided, for jitter can "
                    "only add to x; "
                    "1.31 two-sided), with one for each position (17 280) it is 1.03; the cause need not be jitter"),
        Item.judged("N26b", "jitter of 1 ns, measured from the rows of one frame / ns", "V", 1.0, rows.value, 0.05, rows.u,
                    why="expected: as simulated; a grabber's nanoseconds can be seen"),
    ]  # fmt: skip
