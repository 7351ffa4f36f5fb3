"""What was located, drawn over its image."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.files.staged_files import Output, write_together
from pixmetry.locate.records import ORIGIN, Located
from pixmetry.report.drawing import own_style

CLEAN, FLAGGED, CROSS = "#00b4d8", "#ff9f1c", "#ff2e63"
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


def write_overlay(path: str | Path, frame: np.ndarray, table: Located) -> Path:
    """Draw the outlines, centres or lines of a table over its frame and write a PNG; parameters as of `overlay_png`.

    Raises
    ------
    InputError
        If it cannot be written, or there is a file that is no such picture.
    """
    write_together([Output(Path(path), MARK, True)], [overlay_png(frame, table)])
    return Path(path)


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
    draw_marks(axes, table, zoom)
    axes.set(xlim=(-0.5, cols - 0.5), ylim=(rows - 0.5, -0.5))
    flagged = int((table.flags != 0).sum()) if len(table) else 0
    text = f"{len(table)} of kind {table.kind}, {flagged} flagged (orange)    {ORIGIN}"
    figure.text(0.01, 0.5 * STRIP_IN / (height + STRIP_IN), text, fontsize=8, va="center")
    raw = io.BytesIO()
    figure.savefig(raw, format="png", metadata={"Software": "pixmetry"})
    return raw.getvalue()


def draw_marks(axes: Any, table: Located, zoom: float = 1.0) -> None:
    """Draw what was located into Matplotlib axes whose unit is the pixel; ``zoom``: how much larger than the frame they are."""
    from matplotlib.collections import EllipseCollection, LineCollection

    good = np.isfinite(table.x_px) & np.isfinite(table.y_px)
    if not good.any():
        return
    x, y = table.x_px[good], table.y_px[good]
    colours = np.where(table.flags[good] != 0, FLAGGED, CLEAN)
    arm, ink, width = 3.0 / zoom, [CROSS], 0.8
    if "length_px" in table.columns and "angle_deg" in table.columns:
        angle, half = np.deg2rad(table.angle_deg[good]), 0.5 * table.length_px[good]
        along = np.stack([half * np.cos(angle), half * np.sin(angle)], axis=1)
        middle = np.stack([x, y], axis=1)
        axes.add_collection(LineCollection(list(np.stack([middle - along, middle + along], axis=1)), colors=list(colours), linewidths=1.2))
    else:
        major, minor, angle = _axes_of(table, good)
        shown = np.isfinite(major)
        if not shown.any():  # nothing to draw around them: the cross alone shows place and flags
            arm, ink, width = 7.0 / zoom, list(np.tile(colours, 2)), 1.4
        if shown.any():
            axes.add_collection(
                EllipseCollection(
                    2 * major[shown],
                    2 * minor[shown],
                    angle[shown],
                    units="xy",
                    offsets=np.stack([x, y], axis=1)[shown],
                    transOffset=axes.transData,
                    facecolors="none",
                    edgecolors=list(colours[shown]),
                    linewidths=1.0,
                )
            )
    level, upright = np.array([[-arm, 0.0], [arm, 0.0]]), np.array([[0.0, -arm], [0.0, arm]])
    middle = np.stack([x, y], axis=1)[:, None, :]
    axes.add_collection(LineCollection(list(np.concatenate([middle + level, middle + upright])), colors=ink, linewidths=width))
    if len(x) <= 500 and "code" in table.columns:
        for xi, yi, code in zip(x, y, table.code[good], strict=True):
            if code >= 0:
                axes.annotate(str(int(code)), (xi, yi), (6, -6), textcoords="offset points", color=CROSS, fontsize=8)


def _axes_of(table: Located, good: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Semi axes and angle of what is drawn around each target; NaN where the table tells no size."""
    columns = table.columns
    nothing = np.full(int(good.sum()), np.nan)
    if "semi_major_px" in columns:
        return columns["semi_major_px"][good], columns["semi_minor_px"][good], columns.get("angle_deg", nothing * 0)[good]
    for name in ("radius_px", "sigma_px"):
        if name in columns:
            return columns[name][good], columns[name][good], np.zeros_like(nothing)
    return nothing, nothing, nothing
