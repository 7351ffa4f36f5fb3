"""All pages of the handbook, and the front page that lists them."""

from __future__ import annotations

from pathlib import Path

from gallery import line_jitter_page, offset_page, threshold_page
from gallery.page import Page, table

INDEX = """# The handbook's experiments, made again

The chapter on image sensors of the [handbook](../conventions.md) shows with simulated experiments how a camera moves a target. These pages
repeat the experiments, state all conditions, add pixmetry's estimators, and compare the numbers with those of the chapter.

{pages}
`make handbook` writes the numbers (`benchmarks/study_line_jitter.py` writes those of line jitter, which take minutes). They are the
same each time, because every draw has its key. Positions and errors are in pixels. An error is found minus true. Grey values are those of
8 bits.
"""

EXPERIMENTS = (
    ("Note 8, Fig 3.10", "threshold", "Thresholds", "why a threshold spoils a centroid, and what to use instead"),
    ("Note 13, Figs 3.13 to 3.17", "offset", "Black below zero", "why lines wander when the converter cuts off their feet"),
    ("Note 19, Table 3.2", "line-jitter", "Line jitter", "whether the residuals of straight lines tell how steadily a grabber samples"),
)


def all_pages() -> list[Page]:
    """Run every experiment; the front page comes first."""
    rows = [[where, f"[{title}]({name}.md)", what] for where, name, title, what in EXPERIMENTS]
    index = Page("index", INDEX.format(pages=table(["chapter", "page", "what it shows"], rows, 3)))
    return [index, threshold_page.page(), offset_page.page(), line_jitter_page.page()]


def write(folder: Path) -> list[Path]:
    """Write the pages and their figures into a folder; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for page in all_pages():
        for name, content in page.files().items():
            (folder / name).write_text(content, encoding="utf-8")
            written.append(folder / name)
    return written
