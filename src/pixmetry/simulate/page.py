"""The page of one target in a camera: its image after every source, and the shift of its centre."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pixmetry.camera.catalogue import STAGES
from pixmetry.report import Answer, Column, Figure, Page, Reading, Run, Section, Table, Text, html_of, strong
from pixmetry.report.blocks import Block, block_diagram
from pixmetry.report.drawing import BLUE, INK, RED, SOFT, canvas
from pixmetry.report.numbers import NONE, length_px, significant

if TYPE_CHECKING:
    from pixmetry.simulate.chain import Step, Walk

SHOWN = 5  # movers in the summary
SPREAD_SHOWN, SMALL_PX = 12, 1e-6  # sources in the table of what varies, and from which size on
KIND = "one target through the chain"
TITLE = f"<title>: {KIND}</title>"  # ends so
KEY = "blue +: true centre; red ×: centre found; blue line: the row through it; red dashes: the column through it"
HOW = (
    " The centre is the centroid of what stands out of the background by more than a fifth of the target's contrast. The true centre is "
    "that of the scene, carried through what only lays out the frame (clock of the samples, offsets, fields); what bends the image, as "
    "distortion does, counts as a move. Lengths are in pixels of the frame as it is after the source."
)


def write_chain_page(walk: Walk, path: str | Path) -> Path:
    """Write the page and return its path; only an earlier page of this kind is replaced."""
    from pixmetry.files import write_page

    return write_page(path, html_of(page_of(walk)))


def page_of(walk: Walk) -> Page:
    """The page of one target through a camera.

    Parameters
    ----------
    walk : Walk
        As `pixmetry.chain` gives it.

    Returns
    -------
    Page
    """
    page = Page(walk.camera.name, KIND, "pixmetry image chain", _facts(walk))
    _result(page.add_section("How far the centre has moved", name="result"), walk)
    found = bool(walk.target["found"])
    page.add_section(
        "The image after every source",
        Text(KEY if found else KEY.replace("; red ×: centre found", ""), "soft small"),
        *(_card(i, step, found) for i, step in enumerate(walk.steps)),
        name="steps",
    )
    return page


def _result(section: Section, walk: Walk) -> None:
    """The move of the centre, the sources that made it, and its path."""
    last = walk.steps[-1]
    if not walk.target["found"]:
        section.add_text("The scene has no target with a centre; the page shows what becomes of the middle of the frame.")
        return
    if last.error is None:
        section.add(Answer([Text("The target cannot be told from its background in the stored frame.")]))
    else:
        parts: list[Text | list[Reading]] = [Text("Centre found in the stored frame less the true centre:"), _readings(last.error)]
        if last.expected_error is not None:
            x, y = (length_px(v) for v in last.expected_error)
            words = "Expected of this unit, every temporal draw at its mean: "
            parts.append(Text((words, strong(f"x {x} px"), ", ", strong(f"y {y} px"), ". The rest is this frame's noise."), "second"))
        section.add(Answer(parts))
    movers = walk.movers()[:SHOWN]
    if movers:
        section.add_table(
            "The sources that moved the centre most",
            ["Source", *(Column(heading, "right") for heading in ("x", "y", "x, expected", "y, expected"))],
            [[(s.title + " ", Run(s.name, "chip")), *_pair(s.moved), *_pair(s.expected_moved)] for s in movers],
            caption="The sources that moved the centre most in this frame, in px.",
        )
    if walk.spread:
        section.add(*_spread(walk))
    section.add(_path(walk))
    section.add_text(strong("How it is measured."), HOW, style="soft")


def _spread(walk: Walk) -> list[Figure | Table]:
    """What is constant and what varies, by link and by source."""
    whole = sum(s.square for s in walk.spread) or 1.0
    parts = {stage: sum(s.square for s in walk.spread if s.source_id.split(".")[0] == stage) for stage in STAGES}
    there = {s.source_id.split(".")[0] for s in walk.spread}
    blocks = [
        Block(stage, parts[stage] / whole, [f"{length_px(float(np.sqrt(0.5 * parts[stage])))} px"]) for stage in STAGES if stage in there
    ]
    caption = "Share of each link in the sum of squares of all moves, constant and varying; below, the root mean square of x and y."
    largest = sorted((s for s in walk.spread if s.square > SMALL_PX**2), key=lambda s: -s.square)[:SPREAD_SHOWN]
    groups = ("Constant", "From target to target ±", "From frame to frame ±")
    columns: list[Column | str] = ["Source", *(Column(axis, "right", group=group) for group in groups for axis in "xy")]
    rows = [
        [(s.title + " ", Run(s.name, "chip")), *(length_px(v) for pair in (s.constant, s.place, s.time) for v in pair)] for s in largest
    ]
    words = f"What is constant and what varies, in px, over {walk.draws} exposures, each of another target; so few give rough deviations."
    return [block_diagram(blocks, "chain", "the links of the chain", caption), Table("Constant and varying moves", columns, rows, words)]


def _facts(walk: Walk) -> list[tuple[str, str]]:
    rows, cols = walk.camera.frame_shape
    out_rows, out_cols = walk.camera.output_shape
    size = f"{cols} × {rows} pixels" + ("" if (rows, cols) == (out_rows, out_cols) else f", stored {out_cols} × {out_rows}")
    kind = str(walk.target.get("kind", "target")) if walk.target["found"] else "no target: the middle of the frame"
    return [
        ("Frame", size),
        ("Shown", kind),
        ("True centre in the scene", f"x {walk.target['x_px']:.3f}, y {walk.target['y_px']:.3f} px"),
        ("Frame number, seed", f"{walk.frame}, {walk.seed}"),
        ("Sources that are on", str(len(walk.camera.active))),
    ]


def _readings(pair: tuple[float, float]) -> list[Reading]:
    return [Reading(axis, f"{length_px(v)} px") for axis, v in zip("xy", pair, strict=True)]


def _pair(pair: tuple[float, float] | None) -> tuple[str, str]:
    return (NONE, NONE) if pair is None else (length_px(pair[0]), length_px(pair[1]))


def _card(number: int, step: Step, has_target: bool) -> Figure:
    """The image after a source, with what that source moved and how far the centre is off by now."""
    words = ""
    if has_target and number:
        (x, y), (mean_x, mean_y) = _pair(step.moved), _pair(step.expected_moved)
        words = f"This source: x {x}, y {y} px (expected x {mean_x}, y {mean_y} px). "
    if has_target:
        x, y = _pair(step.error)
        words += f"So far: x {x}, y {y} px."
    return replace(_picture(number, step), caption=words, title=(f"{number}. {step.title} ", Run(step.name, "chip")))


def _picture(number: int, step: Step) -> Figure:
    """The window with the true and the found centre, and the row and column through the found one."""
    col0, row0 = step.origin
    rows, cols = step.image.shape
    extent = (col0 - 0.5, col0 + cols - 0.5, row0 + rows - 0.5, row0 - 0.5)
    x, y = step.reference
    with canvas(1.75, nrows=1, ncols=2, width_ratios=(1, 1.25)) as (figure, (left, right)):
        left.imshow(step.image, cmap="gray", interpolation="none", extent=extent)
        left.grid(False)
        left.tick_params(length=2)
        left.locator_params(nbins=4)
        left.plot([x], [y], "+", color=BLUE, markersize=7, markeredgewidth=1.0)
        if step.error is not None:
            left.plot([x + step.error[0]], [y + step.error[1]], "x", color=RED, markersize=5, markeredgewidth=1.0)
        dx, dy = step.error or (0.0, 0.0)
        r, c = (int(np.clip(np.rint(v) - o, 0, n - 1)) for v, o, n in ((y + dy, row0, rows), (x + dx, col0, cols)))
        right.step(np.arange(cols) + col0 - x, step.image[r], where="mid", color=BLUE)
        right.step(np.arange(rows) + row0 - y, step.image[:, c], where="mid", color=RED, linestyle=(0, (3, 1.5)))
        right.set_xlabel("px from the true centre")
        right.set_ylabel(step.unit)
        low, high = float(step.image.min()), float(step.image.max())
        alt = f"{step.title}: image of {cols} by {rows} pixels from {significant(low)} to {significant(high)} {step.unit}, and its profiles"
        return Figure(figure, f"source-{number}", alt, "")


def _path(walk: Walk) -> Figure:
    """How far the centre has moved, source by source."""
    steps = walk.steps
    at = np.arange(len(steps))
    with canvas(1.1 + 0.17 * len(steps)) as (figure, axes):
        axes.axvline(0.0, color=SOFT, linewidth=0.6)
        for axis, colour, marker in ((0, BLUE, "o"), (1, RED, "s")):
            name = "xy"[axis]
            seen = [np.nan if s.error is None else s.error[axis] for s in steps]
            hoped = [np.nan if s.expected_error is None else s.expected_error[axis] for s in steps]
            axes.plot(hoped, at, color=colour, linestyle=(0, (3, 1.5)), label=f"{name}, expected")
            axes.plot(seen, at, color=colour, marker=marker, linestyle="none", label=f"{name}, this frame")
        axes.set_yticks(at, [s.name for s in steps], color=INK, fontsize=6.5)
        axes.invert_yaxis()
        axes.locator_params(axis="x", nbins=5)
        axes.set_xlabel("centre found less true centre / px")
        figure.legend(loc="outside upper center", ncols=2, handlelength=2)
        last = steps[-1]
        end = "not found" if last.error is None else f"x {length_px(last.error[0])} px, y {length_px(last.error[1])} px"
        alt = f"Error of the centre after each of {len(steps)} steps; at the end {end}"
        return Figure(
            figure,
            "path",
            alt,
            "How far the target's centre has moved after each source. Lines: as expected of this unit, every temporal draw at its mean; "
            "marks: in this frame.",
        )
