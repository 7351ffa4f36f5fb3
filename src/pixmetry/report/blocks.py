"""A chain of blocks in the order of the light: what each link does, and its share of the whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pixmetry.report.drawing import BLUE, INK, SOFT, canvas
from pixmetry.report.numbers import percent
from pixmetry.report.page import Figure

IN_A_ROW = 5  # blocks; more stand in two rows
ARROW = {"arrowstyle": "->", "color": SOFT, "lw": 0.8, "shrinkA": 0, "shrinkB": 0}


@dataclass(frozen=True)
class Block:
    """One link: its name, its share of the whole (0 to 1), and lines of small print."""

    name: str
    share: float
    lines: Sequence[str] = ()


def block_diagram(blocks: Sequence[Block], name: str, what: str, caption: str) -> Figure:
    """Draw the links of a chain with their shares.

    Parameters
    ----------
    blocks : sequence of Block
        In the order of the light.
    name : str
        Of the figure on its page.
    what : str
        What the shares are of, for those who do not see the figure.
    caption : str

    Returns
    -------
    Figure
        The more of the whole a link has, the darker its block is.

    Examples
    --------
    >>> drawn = block_diagram([Block("optics", 0.25, ["3 mpx"]), Block("sensor", 0.75)], "chain", "the total", "")
    >>> drawn.alt
    'Shares of the total: optics 25 %, sensor 75 %.'
    """
    rows = 1 if len(blocks) <= IN_A_ROW else 2
    cols = -(-len(blocks) // rows)
    most_lines = max((len(b.lines) for b in blocks), default=0)
    height = 0.62 + 0.16 * most_lines  # in
    with canvas(rows * height + 0.1) as (figure, axes):
        axes.set_axis_off()
        axes.set_xlim(0, cols)
        axes.set_ylim(rows, 0)
        for k, block in enumerate(blocks):
            row, col = divmod(k, cols)
            _draw_block(axes, block, col, row, height)
            if col:
                axes.annotate("", (col + 0.07, row + 0.5), (col - 0.07, row + 0.5), arrowprops=ARROW)
    words = ", ".join(f"{b.name} {percent(b.share)} %" for b in blocks)
    return Figure(figure, name, f"Shares of {what}: {words}.", caption)


def _draw_block(axes: Any, block: Block, col: int, row: int, height_in: float) -> None:
    from matplotlib.patches import FancyBboxPatch

    shade = 0.06 + 0.5 * min(max(block.share, 0.0), 1.0)
    place = (col + 0.08, row + 0.06)
    axes.add_patch(
        FancyBboxPatch(place, 0.84, 0.88, boxstyle="round,pad=0,rounding_size=0.06", facecolor=BLUE, alpha=shade, edgecolor=SOFT)
    )
    sizes = [(block.name, 6.3, INK, "normal"), (f"{percent(block.share)} %", 7.5, INK, "bold")]
    sizes += [(line, 6.0, SOFT, "normal") for line in block.lines]
    step = 0.16 / height_in
    top = row + 0.5 - 0.5 * step * (len(sizes) - 1)
    for i, (text, size, colour, weight) in enumerate(sizes):
        axes.text(col + 0.5, top + i * step, text, ha="center", va="center", color=colour, fontsize=size, fontweight=weight)
