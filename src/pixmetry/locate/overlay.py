"""What was located, drawn over its image."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.marks import draw_marks
from pixmetry.locate.records import ORIGIN, Located
from pixmetry.report.drawing import own_style

STRIP_IN = 0.42  # of text under the image
DPI = 100
WANTED_PX = 1600  # small images are enlarged towards this
MOST_ZOOM = 6
MARK = re.compile(rb"\x89PNG\r\n\x1a\n.{29}tEXtSoftware\x00pixmetry", re.DOTALL)  # no other picture is replaced


def overlay_names(overlay: str | Path | None, images: Sequence[Path]) -> list[Path | None]:
    """Name the picture of each image: the file itself for one, files in a folder for several.

    Raises
    ------
    InputError
        If one file is named for several images, the ending is not ``.png``, or two images would have the same picture.
    """
    if overlay is None:
        return [None] * len(images)
    target = Path(overlay)
    is_file = target.suffix.lower() == ".png"
    if len(images) == 1 and is_file:
        if target.is_dir():
            raise InputError("is a folder", where=str(target), remedy="name the picture, such as found.png")
        return [target]
    if is_file:
        raise InputError("one picture for several images", where=str(target), remedy="name a folder")
    if target.suffix or target.is_file():
        raise InputError("a picture is written as PNG", where=str(target), allowed="a name that ends in .png, or a folder")
    names = [p.stem if not p.name.isdigit() else f"{p.parent.stem}-{p.name}" for p in images]
    double = next((n for n in names if names.count(n) > 1), None)
    if double is not None:
        raise InputError("two images would have one picture", value=double, remedy="draw them in two runs")
    return [target / f"{name}-located.png" for name in names]


def overlay_png(frame: np.ndarray, table: Located) -> bytes:
    """Draw the outlines, centres or lines of a table over its frame, as a PNG.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
    table : Located
        Of this frame.
    """
    with own_style({}):
        return _drawn(frame, table)


def _drawn(frame: np.ndarray, table: Located) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows, cols = frame.shape
    zoom = int(np.clip(-(-WANTED_PX // max(rows, cols)), 1, MOST_ZOOM))
    width, height = max(cols * zoom / DPI, 4.0), rows * zoom / DPI
    figure = Figure(figsize=(width, height + STRIP_IN), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, STRIP_IN / (height + STRIP_IN), cols * zoom / DPI / width, height / (height + STRIP_IN)))
    low, high = np.percentile(frame, [0.5, 99.5])
    axes.imshow(frame, cmap="gray", vmin=low, vmax=high if high > low else low + 1, interpolation="nearest")
    axes.set_axis_off()
    draw_marks(axes, table.columns, zoom)
    axes.set(xlim=(-0.5, cols - 0.5), ylim=(rows - 0.5, -0.5))
    flagged = int((table.flags != 0).sum()) if len(table) else 0
    text = f"{len(table)} of kind {table.kind}, {flagged} flagged (orange)    {ORIGIN}"
    figure.text(0.01, 0.5 * STRIP_IN / (height + STRIP_IN), text, fontsize=8, va="center")
    raw = io.BytesIO()
    figure.savefig(raw, format="png", metadata={"Software": "pixmetry"})
    return raw.getvalue()
