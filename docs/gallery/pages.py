"""All pages of the handbook, the front page that lists them, and ``gallery.json`` with every item."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

from gallery import error_table_page, line_jitter_page, offset_page, questions, shorts, threshold_page
from gallery.chapter import list_of_all
from gallery.item import KINDS, Item, comparison
from gallery.note import Note, record_of, stored_numbers
from gallery.page import Page, table

INDEX = """# The handbook's experiments, repeated

A handbook of camera calibration ([the handbook](../conventions.md)) shows in its chapter on image sensors, with experiments and numbers,
how a camera shifts the measured position of a target. These pages repeat the experiments, state all conditions, add pixmetry's estimators,
and compare the numbers with those of the chapter. Where the chapter contradicts itself, the page says so and shows the computation.

{pages}
Change a number and see: [five questions](questions.md), each answered by one number in a script.

All numbers are the same in every run, because the random numbers are keyed. Positions and errors are in pixels. An error is
measured minus true. Grey values are those of 8 bits.

## Every figure, table and number

The chapter has 24 figures, 3 tables and 26 numbers. Each is on a page:

{every}
## The items

Kinds: {kinds}.
"Expected" is what the chapter prints, or what follows from it or from the simulated camera: the page tells which. A value agrees if it lies
within the tolerance of that; the page tells why the others do not. {count}
The same table, with the reasons, is in [gallery.json](gallery.json).

{items}
`make handbook` writes these pages; `make handbook ONLY="sampling-clock"` writes some of them. On every page stands a script of at most 60
lines, which takes less than a minute. Four pages (thresholds, black below zero, line jitter, the error table) go further than their
script. The experiment on line jitter takes minutes; `benchmarks/study_line_jitter.py` runs it and stores its numbers.
"""

EXPERIMENTS = {  # pages with modules of their own: where in the chapter, title, what it shows
    "threshold": (
        threshold_page, "Note 8, Fig 3.10", "Thresholds", "why a hard threshold increases the error of a centroid, and what to use instead",
    ),
    "offset": (
        offset_page, "Note 13, Figs 3.13 to 3.17", "Black below zero",
        "why lines have a periodic error when the converter cuts off values below black",
    ),
    "line-jitter": (
        line_jitter_page, "Note 19, Table 3.2", "Line jitter", "whether the residuals of straight lines show the jitter of a frame grabber",
    ),
    "error-table": (
        error_table_page, "Tables 3.1 and 3.2", "The error table",
        "the chapter's 39 rows for its own camera, and its residual after a calibration",
    ),
}  # fmt: skip
ORDER = (
    "camera-data", "interline", "frame-transfer", "error-table", "grabber-warm-up", "sampling-clock", "laser-speckle", "interlace",
    "gamma", "low-pass", "video-tape", "threshold", "view-point", "unflatness", "cable", "window-offset", "offset", "camera-filter",
    "spectral-sensitivity", "camera-warm-up", "charge-transfer", "amplifier-noise", "quantisation", "line-jitter", "jitter-cost",
    "fixed-pattern", "super-resolution", "pixel-places",
)  # as in the chapter  # fmt: skip
NOTES = tuple(name for name in ORDER if name not in EXPERIMENTS)


@dataclass(frozen=True)
class Gallery:
    """All pages with their items.

    Parameters
    ----------
    pages : dict of Page
        By name; "index" is the front page.
    items : tuple of Item
    record : str
        Text of ``gallery.json``.
    """

    pages: dict[str, Page]
    items: tuple[Item, ...]
    record: str


def make_gallery(run: Collection[str] = NOTES) -> Gallery:
    """Make every page. Notes that are not to be run show their stored numbers and bring no figures."""
    numbers, pages, rows, items = stored_numbers(), {}, [], []
    for name in ORDER:
        if name in EXPERIMENTS:
            module, where, title, what = EXPERIMENTS[name]
            own, made = module.items(), module.page()
            numbers[name], drawn = shorts.note_of(name).run() if name in run or name not in numbers else (numbers[name], ())
            told = f"## Chapter, ours, and why they differ\n\n{comparison(own)}\n{shorts.section(name, numbers[name])}"
            pages[name] = replace(made, text=f"{made.text.rstrip()}\n\n{told}", pictures=(*made.pictures, *drawn))
            items += [(name, item) for item in own]
        else:
            note = Note.read(name)
            numbers[name], pictures = note.run() if name in run or name not in numbers else (numbers[name], ())
            pages[name] = note.page(numbers[name], pictures)
            items += [(name, item) for item in note.items(numbers[name])]
            where, title, what = (note.head[k] for k in ("chapter", "title", "shows"))
        rows.append([where, f"[{title}]({name}.md)", what])
    asked = questions.NAME
    numbers[asked] = questions.all_changed() if asked in run or asked not in numbers else numbers[asked]
    pages[asked] = questions.page(numbers, numbers[asked])
    index = INDEX.format(
        pages=table(["chapter", "page", "what it shows"], rows, 3),
        kinds=", ".join(f"{k}: {v}" for k, v in KINDS.items()),
        every=list_of_all(items),
        items=_summary(items),
        count=_count([item for _, item in items]),
    )
    found = [item for _, item in items]
    kept = {name: numbers[name] for name in (*ORDER, asked)}
    return Gallery({"index": Page("index", index), **pages}, tuple(found), record_of(found, kept))


def write(folder: Path, run: Collection[str] = NOTES) -> list[Path]:
    """Write the pages, their figures and ``gallery.json`` into a folder; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    made = make_gallery(run)
    files = {"gallery.json": made.record}
    for page in made.pages.values():
        files |= page.files()
    for name, content in files.items():
        (folder / name).write_text(content, encoding="utf-8")
    return [folder / name for name in files]


def _summary(items: list[tuple[str, Item]]) -> str:
    rows = [[f"[{i.id}]({page}.md)", i.what, i.kind, *i.numbers, i.verdict_head] for page, i in items]
    lines = table(["item", "quantity", "kind", "expected", "ours", "u", "verdict"], rows, 3).split("\n")
    return "\n".join([lines[0], "| --- | --- | --- | ---: | ---: | ---: | --- |", *lines[2:]])


def _count(items: list[Item]) -> str:
    counts = Counter(item.verdict_head for item in items)
    agree, inconsistent, differ = (counts[head] for head in ("agree", "chapter inconsistent", "differs"))
    return f"Of {len(items)} items {agree} agree, for {inconsistent} the chapter is inconsistent, and {differ} differ."
