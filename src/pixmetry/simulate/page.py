"""The page that walks one target through a camera: its image after every source, and where its centre goes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry import __version__
from pixmetry.report.drawing import BLUE, INK, RED, SOFT, Picture, canvas, picture
from pixmetry.report.numbers import NONE, length_px, significant
from pixmetry.report.templates import filled

if TYPE_CHECKING:
    from pixmetry.simulate.walk import Step, Walk

SHOWN = 5  # movers in the summary
TITLE = "<title>: one target through the chain</title>"  # ends so


def write_chain_page(walk: Walk, path: str | Path) -> Path:
    """Write the page and return its path; only an earlier page of this kind is replaced."""
    from pixmetry.files import write_page

    return write_page(path, render(walk))


def render(walk: Walk) -> str:
    """Return the page as text."""
    return filled("chain.html.jinja", _content(walk))


def _content(walk: Walk) -> dict[str, Any]:
    last = walk.steps[-1]
    found = last.error is not None
    return {
        "version": __version__,
        "name": walk.camera.name,
        "facts": _facts(walk),
        "has_target": walk.target["found"],
        "total": _pair(last.error) if found else None,
        "total_expected": _pair(last.expected_error) if found and last.expected_error is not None else None,
        "lost": walk.target["found"] and not found,
        "movers": [
            {"title": s.title, "name": s.name, "moved": _pair(s.moved), "expected": _pair(s.expected_moved)}
            for s in walk.movers()[:SHOWN]
        ],
        "path": _path(walk) if walk.target["found"] else None,
        "steps": [_card(i, s, walk.target["found"]) for i, s in enumerate(walk.steps)],
    }


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


def _pair(pair: tuple[float, float] | None) -> dict[str, str]:
    if pair is None:
        return {"x": NONE, "y": NONE}
    return {axis: length_px(v) for axis, v in zip(("x", "y"), pair, strict=True)}


def _card(number: int, step: Step, has_target: bool) -> dict[str, Any]:
    return {
        "number": number,
        "name": step.name,
        "title": step.title,
        "moved": _pair(step.moved) if has_target and number else None,
        "expected": _pair(step.expected_moved) if has_target and number else None,
        "error": _pair(step.error) if has_target else None,
        "picture": _picture(number, step),
    }


def _picture(number: int, step: Step) -> Picture:
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
        return picture(figure, f"step-{number}", alt, "")


def _path(walk: Walk) -> Picture:
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
        return picture(
            figure,
            "path",
            alt,
            "How far the target's centre has moved after each source. Lines: as expected of this unit, every temporal draw at its mean; "
            "marks: in this frame.",
        )
