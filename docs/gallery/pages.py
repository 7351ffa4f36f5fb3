"""All pages of the handbook, and the front page that lists them."""

from __future__ import annotations

from pathlib import Path

from gallery import error_table_page, line_jitter_page, offset_page, threshold_page
from gallery.page import Page, table

INDEX = """# The handbook's experiments, repeated

A handbook of camera calibration ([the handbook](../conventions.md)) shows in its chapter on image sensors, with simulated experiments, how
a camera shifts the measured position of a target. These pages repeat the experiments, state all conditions, add pixmetry's estimators, and
compare the numbers with those of the chapter.

{pages}
`make handbook` writes these pages. The experiment on line jitter takes minutes; `benchmarks/study_line_jitter.py` runs it and stores its
numbers. All numbers are the same in every run, because the random numbers are keyed. Positions and errors are in pixels. An error is
measured minus true. Grey values are those of 8 bits.
"""

EXPERIMENTS = (
    ("Note 8, Fig 3.10", "threshold", "Thresholds", "why a hard threshold increases the error of a centroid, and what to use instead"),
    (
        "Note 13, Figs 3.13 to 3.17",
        "offset",
        "Black below zero",
        "why lines have a periodic error when the converter cuts off values below black",
    ),
    ("Note 19, Table 3.2", "line-jitter", "Line jitter", "whether the residuals of straight lines show the jitter of a frame grabber"),
    (
        "Tables 3.1 and 3.2",
        "error-table",
        "The error table",
        "the chapter's 39 rows for its own camera, and its residual after a calibration",
    ),
)


def all_pages() -> list[Page]:
    """Run every experiment; the front page comes first."""
    rows = [[where, f"[{title}]({name}.md)", what] for where, name, title, what in EXPERIMENTS]
    index = Page("index", INDEX.format(pages=table(["chapter", "page", "what it shows"], rows, 3)))
    return [index, threshold_page.page(), offset_page.page(), line_jitter_page.page(), error_table_page.page()]


def write(folder: Path) -> list[Path]:
    """Write the pages and their figures into a folder; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for page in all_pages():
        for name, content in page.files().items():
            (folder / name).write_text(content, encoding="utf-8")
            written.append(folder / name)
    return written
