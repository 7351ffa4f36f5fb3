"""The section of an assessment's page on a lossy coder: the quality that its traces tell, and the quantiser's steps."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.jpeg_tables import steps
from pixmetry.camera.observations import Storage, StoredBlocks
from pixmetry.report import Section
from pixmetry.report.drawing import BLUE, INK, canvas, line
from pixmetry.report.numbers import significant
from pixmetry.report.page import Figure


def blocks_section(found: StoredBlocks, storage: Storage) -> Section:
    """What the files or the frames tell, and a figure of the steps."""
    section = Section("Traces of a coder", name="blocks").add_text(blocks_sentence(found, storage))
    table = np.array(storage.table).reshape(8, 8) if storage.table is not None else found.table
    return section.add(steps_figure(table)) if table.any() else section


def blocks_sentence(found: StoredBlocks, storage: Storage) -> str:
    """The quality, or why it is not told."""
    own = "The files are JPEG, and state their quantiser." if storage.table is not None else ""
    if "quality" in found.fit:
        quality = found.fit["quality"]
        what = f"JPEG of quality {quality.value:.0f}" + (" or finer" if quality.is_lower_limit else "")
        at = "" if found.offset == (0, 0) else f" Its blocks begin at row {found.offset[0]}, column {found.offset[1]}."
        frames = f"The coefficients of the frames' blocks lie on the comb of {what} ({found.coefficients} that are not zero).{at}"
    else:
        frames = f"The frames do not tell a quality: {found.fit.reasons.get('quality', 'no frames')}."
    repeated = ""
    if np.isfinite(found.repeated_share) and found.repeated_share > 0:
        repeated = f"{significant(100 * found.repeated_share, 2)} % of blocks of 16 px are the same in successive frames."
    return " ".join(filter(None, (own, frames, repeated)))


def steps_figure(table: np.ndarray) -> Figure:
    """Steps of the luminance against the frequency, beside those of some qualities."""
    u, v = np.meshgrid(np.arange(8), np.arange(8), indexing="ij")
    order = np.argsort((u + v).ravel(), kind="stable")[1:]
    with canvas(2.6) as (figure, axes):
        for quality in (50, 75, 90, 95):
            line(axes, np.arange(1, 64), steps(quality).ravel()[order], color=INK, linewidth=0.5, alpha=0.5)
            axes.annotate(str(quality), (63, steps(quality).ravel()[order][-1]))
        known = table.ravel()[order] > 0
        line(axes, np.arange(1, 64)[known], table.ravel()[order][known], color=BLUE, marker=".", linestyle="none")
        axes.set_yscale("log")
        axes.set_xlabel("coefficient, by rising frequency")
        axes.set_ylabel("step / DN")
        alt = f"Quantiser steps of {int(known.sum())} coefficients of the JPEG luminance."
        caption = "Quantiser steps of this camera (points), and those of qualities 50, 75, 90 and 95 (lines)."
        return Figure(figure, "blocks", alt, caption)
