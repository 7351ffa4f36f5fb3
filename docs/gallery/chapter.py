"""Everything that the chapter shows: its figures, tables, numbers and notes, and the items of the gallery that belong to each."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable

from gallery.item import Item
from gallery.page import table

ENTRIES = {  # the chapter's own order; what stands there, in our words
    "Fig 3.1": "interline transfer",
    "Fig 3.2": "the camera",
    "Fig 3.3": "frame transfer",
    "Fig 3.4": "test field for the warm-up",
    "Fig 3.5": "image of the test field",
    "Fig 3.6": "shifts in 60 min of the grabber's warm-up",
    "Fig 3.7": "RMS shift over time",
    "Fig 3.8": "speckle: places of a laser spot",
    "Fig 3.9": "response at gamma 0.45 and 1",
    "Fig 3.10": "error against threshold",
    "Fig 3.11": "line behind 5 m of cable",
    "Fig 3.12": "line behind 2 m of cable",
    "Fig 3.13": "line error, six grey values below black",
    "Fig 3.14": "line error without an offset",
    "Fig 3.15": "line of a grabber as delivered",
    "Fig 3.16": "the same, adjusted",
    "Fig 3.17": "target at several exposures",
    "Fig 3.18": "spectral sensitivity of sensor and lens",
    "Fig 3.19": "shifts of three cameras in 60 min",
    "Fig 3.20": "noise against grey value",
    "Fig 3.21": "noise against time in a freezer",
    "Fig 3.22": "histogram of noise",
    "Fig 3.23": "residuals of lines, and rounding",
    "Fig 3.24": "flat field, enhanced",
    "T3.1": "data of the camera",
    "T3.1 errors": "the error table (printed as Table 3.1 too)",
    "T3.2": "RMS residuals",
    "N1": "64.0 µs of transfer, 40.0 ms of accumulation",
    "N2": "fields 1/50 s apart",
    "N3": "three modes of a progressive camera",
    "N4": "progressive sensors of 1280 × 1024",
    "N5": "16 targets, 25 mm, 665 mm, 60 and 90 min, 4 px",
    "N6": "10 MHz, 512 × 512, pixels 752/512 as large",
    "N7": "a laser of 670 nm behind a filter",
    "N8": "exposures of 1/25 to 1/10 000 s",
    "N9": "gamma 0.45 or 1",
    "N10": "tape: 100 % a stage, factors of 1.4 to 2.3",
    "N11": "unflatness of more than 100 µm",
    "N12": "steps of 4 in y",
    "N13": "σ 1.5, peak 150, 3 px over 500 rows, 6 grey values",
    "N14": "silicon: 200 to 1100 nm, peak at 750 nm",
    "N15": "1/5 px by the sensor's expansion",
    "N16": "transfer efficiency 0.9995 to 0.99999, 92 %",
    "N17": "50 × 50 pixels, 13 grey values, doubling in 8 °C, −3 °C",
    "N18": "14.3 MHz for the CCIR standard",
    "N19": "752 pixels sampled by 512",
    "N20": "8 lines, 80 positions, 27 images, two directions",
    "N21": "lines of four to five pixels",
    "N22": "rounding is one third of the error",
    "N23": "4 grey values at 180",
    "N24": "up to 4 times the resolution",
    "N25": "1/100 px, and the places of the pixels",
    "N26": "jitter of nanoseconds",
}
NOTES = (  # the page of each note, the first first
    "grabber-warm-up", "sampling-clock", "laser-speckle", "interlace", "gamma", "low-pass", "video-tape", "threshold", "view-point",
    "unflatness", "cable", "window-offset", "offset", "camera-filter", "camera-warm-up", "charge-transfer", "amplifier-noise",
    "quantisation", "line-jitter", "fixed-pattern", "super-resolution", "pixel-places",
)  # fmt: skip


def entry_of(item_id: str) -> str:
    """The entry of the chapter to which an item belongs: its id without the letters of its parts; "Note 6a" belongs to the note only."""
    return item_id if item_id in ENTRIES else re.sub(r"(?<=\d)[a-z]+$", "", item_id)


def list_of_all(items: Iterable[tuple[str, Item]]) -> str:
    """The complete list, with pages and verdicts: one row for each figure, table and number of the chapter.

    Parameters
    ----------
    items : iterable of (str, Item)
        Page and item.
    """
    found: dict[str, list[tuple[str, Item]]] = {}
    for page, item in items:
        found.setdefault(entry_of(item.id), []).append((page, item))
    rows = []
    for entry, what in ENTRIES.items():
        own = found.get(entry, [])
        pages = ", ".join(f"[{page}]({page}.md)" for page in dict.fromkeys(page for page, _ in own))
        counts = Counter(item.verdict_head for _, item in own)
        rows.append([entry, what, pages, ", ".join(f"{n} {verdict}" if len(own) > 1 else verdict for verdict, n in counts.items())])
    return table(["chapter", "what it is", "page", "verdicts"], rows, 4)
