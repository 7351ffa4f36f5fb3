"""Scripts of at most 60 lines for the pages that have modules of their own: the heart of each, to change and run again.

A script ``docs/gallery/notes/name.py`` has a function ``run()`` as those of the notes. Its numbers stand on the page.
"""

from __future__ import annotations

from dataclasses import dataclass

from gallery.item import number
from gallery.note import MOST_LINES, NOTES, Note, how_to_run
from gallery.page import table
from pixmetry.core.errors import InputError


@dataclass(frozen=True)
class Short:
    """What a script shows.

    Parameters
    ----------
    chapter, title, alt, caption : str
        Of the page, and of the script's figure.
    told : dict of str
        Numbers of the script, and what they are.
    """

    chapter: str
    title: str
    alt: str
    caption: str
    told: dict[str, str]


SHORTS = {
    "threshold": Short(
        "Note 8, Fig 3.10", "Thresholds", "Error against threshold: hard, squared and soft centroid of a disc.",
        "800 discs of the script, with other draws than those of the page.",
        {"hard_0": "centroid, threshold 0 / px", "hard_25": "the same, threshold 25 / px", "hard_100": "the same, threshold 100 / px",
         "squared_25": "squared centroid, threshold 25 / px", "soft_25": "soft threshold of 25 / px", "best": "best hard threshold"},
    ),
    "offset": Short(
        "Note 13, Fig 3.13", "Black below zero", "Error of each row: a wave with six grey values cut off, nothing without.",
        "Error of each row without rounding.",
        {"first_unrounded": "amplitude of the wave, not rounded / px", "half_unrounded": "half of the range / px",
         "rms_unrounded": "RMS / px", "rms_rounded": "RMS, rounded / px", "half_rounded": "half of the range, rounded / px",
         "rms_without": "RMS without an offset / px"},
    ),
    "line-jitter": Short(
        "Note 19", "Line jitter", "Scatter of a row against jitter: it grows along x and stays along y.",
        "Scatter of a single row from frame to frame, noise on.",
        {"x_0": "scatter along x, no jitter / px", "y_0": "the same along y / px", "x_5": "scatter along x, 5 ns / px",
         "y_5": "the same along y / px", "told_ns_13": "jitter told by the script, 1.3 ns put in / ns",
         "told_ns_5": "the same, 5 ns put in / ns"},
    ),
    "error-table": Short(
        "Tables 3.1 and 3.2", "The error table", "Largest contributions after a calibration, beside those of a modern camera.",
        "The largest contributions to a round target with the chapter's camera, and those of a modern one.",
        {"chapter_x": "the chapter's camera, after a calibration, x / px", "chapter_y": "the same, y / px",
         "modern_x": "a modern camera, x / px", "modern_y": "the same, y / px", "rows": "rows of the handbook's table"},
    ),
}  # fmt: skip


def note_of(name: str) -> Note:
    """The script as a note without a text of its own."""
    short, file = SHORTS[name], name.replace("-", "_")
    script = (NOTES / f"{file}.py").read_text(encoding="utf-8")
    if (lines := len(script.splitlines())) > MOST_LINES:
        raise InputError("the script is too long", where=name, value=lines, allowed=f"{MOST_LINES} lines")
    figures = {f"{name}-script": {"alt": short.alt, "caption": short.caption}}
    return Note(name, {"title": short.title, "chapter": short.chapter, "figures": figures, "slow": True}, "", script)


def section(name: str, numbers: dict[str, float]) -> str:
    """What stands at the end of the page."""
    note, short = note_of(name), SHORTS[name]
    rows = [[what, number(numbers[key])] for key, what in short.told.items()]
    figure = note.picture(f"{name}-script", note.head["figures"][f"{name}-script"], numbers)
    return (
        f"## The script\n\nThe heart of the experiment, to change and run again.\n{how_to_run(name)}\n\nIt gives\n\n"
        f"{table(['', 'the script'], rows)}\n{figure}\n```python\n{note.script}```\n"
    )
