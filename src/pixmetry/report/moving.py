"""Drawings in motion: SVG whose parts move by style rules alone, so that it moves in a page, as a file of its own and inside an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.report.drawing import escape

SHORTEST_S = 1e-8  # a step of this duration would be shown for no time
STYLE = "text{font:8.5px var(--sans);fill:var(--ink)}@media(prefers-reduced-motion:reduce){*{animation:none!important}}"


@dataclass(frozen=True)
class Step:
    """What happens next.

    Parameters
    ----------
    words : str
        Shown while it lasts.
    duration_s : float
        In truth, above 10 ns. It is shown in proportion to its logarithm.
    moves : sequence of (float, float)
        How far each group of dots moves along x and y, in units of the drawing.
    """

    words: str
    duration_s: float
    moves: Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Box:
    """A rectangle that stands still: left upper corner, size, and the name of a colour of the page (``blue``, ``soft``, ``grid`` …)."""

    x: float
    y: float
    width: float
    height: float
    colour: str


def moving_svg(
    boxes: Sequence[Box], dots: Sequence[Sequence[tuple[float, float, float]]], steps: Sequence[Step], decade_s: float = 0.35
) -> str:
    """Draw groups of dots that move step by step, again and again, over boxes that stand still.

    A reader who asked for less motion sees the first moment of it.

    Parameters
    ----------
    boxes : sequence of Box
    dots : sequence of sequence of (x, y, radius)
        One sequence for each group, at the first step.
    steps : sequence of Step
    decade_s : float
        How long each factor of ten in a duration is shown.

    Returns
    -------
    str
        An ``svg`` element that takes its colours from the page around it.

    Raises
    ------
    InputError
        If a step does not say how each group moves, or is shorter than 10 ns.

    Examples
    --------
    >>> svg = moving_svg([Box(0, 0, 20, 10, "blue")], [[(5, 5, 3)]], [Step("40 ms: wait", 0.04, [(0, 0)]), Step("go", 6.4e-5, [(10, 0)])])
    >>> svg.count("<circle"), svg.count("@keyframes")
    (1, 3)
    """
    for k, step in enumerate(steps):
        if len(step.moves) != len(dots) or not step.duration_s > SHORTEST_S:
            allowed = f"{len(dots)} moves and more than 10 ns"
            raise InputError("a step cannot be drawn", where=f"steps[{k}]", value=(len(step.moves), step.duration_s), allowed=allowed)
    ends = np.cumsum([0.0, *(decade_s * np.log10(step.duration_s / SHORTEST_S) for step in steps)])
    at, time = 100 * ends / ends[-1], f"{ends[-1]:.1f}s linear infinite"
    wide = max(box.x + box.width for box in boxes) + 8
    high = max(box.y + box.height for box in boxes) + 24
    rules, drawn = [STYLE], [
        f'<rect x="{b.x:g}" y="{b.y + 18:g}" width="{b.width:g}" height="{b.height:g}" fill="var(--{b.colour})"/>' for b in boxes
    ]  # fmt: skip
    for group, own in enumerate(dots):
        way = np.cumsum([(0.0, 0.0), *(step.moves[group] for step in steps)], axis=0)
        frames = "".join(f"{t:.2f}%{{transform:translate({x:g}px,{y:g}px)}}" for t, (x, y) in zip(at, way, strict=True))
        rules.append(f"@keyframes g{group}{{{frames}}}")
        circles = "".join(f'<circle cx="{x:g}" cy="{y + 18:g}" r="{r:.1f}"/>' for x, y, r in own)
        drawn.append(f'<g fill="var(--red)" style="animation:g{group} {time}">{circles}</g>')
    for k, step in enumerate(steps):
        shown = f"{at[k] + 0.01:.2f}%,{at[k + 1] - 0.01:.2f}%{{opacity:1}}"
        rules.append(f"@keyframes w{k}{{0%,{at[k]:.2f}%,{at[k + 1]:.2f}%,100%{{opacity:0}}{shown}}}")
        drawn.append(f'<text x="6" y="12" opacity="{int(k == 0)}" style="animation:w{k} {time}">{escape(step.words)}</text>')
    return f'<svg class="figure" viewBox="0 0 {wide:g} {high:g}"><style>{"".join(rules)}</style>{"".join(drawn)}</svg>'
