"""The handbook's error table: what its stars have in mind, row by row, and why a camera's own may be others."""

from __future__ import annotations

from pixmetry.budget.table import SourceRow
from pixmetry.report.numbers import length_px

ALIKE = 1  # stars by which two judgements may differ without a word
JUDGED = {  # by row: the case that the table or its note tells
    2: "infrared light without a filter, or a filter that takes most of a red laser's light",
    3: "images that are sampled too coarsely",
    4: "pixels off their places; it finds sensors to be excellent",
    6: "medium and large sensors, unflat by 100 µm and more at the edges",
    7: "a sensor askew behind the lens, and nothing in the calibration that models it",
    8: "the first hour after switching on, up to 1/5 px",
    9: "frame transfer sensors that are not covered while they shift, and bright targets",
    10: "objects that move between two fields 1/50 s apart",
    11: "light sources so bright that charge flows over",
    12: "registers of 2048 pixels and efficiencies down to 0.9995",
    13: "images that are not corrected for it",
    14: "converters of more than 8 bits",
    16: "sensors that inject charge",
    17: "large sensors with several defects that nobody corrects",
    18: "the noise of grey values, 0.9 to 1.8 in 255; a target averages it over all its pixels",
    22: "automatic gain that is switched on while the light changes",
    23: "a gamma of 0.45",
    24: "5 m of 50 Ω cable in a line of 75 Ω, which rings",
    25: "T-pieces and signals that are used more than once",
    26: "grabbers that are exchanged, by a few pixels of the principal point",
    27: "a low-pass filter of the grabber, switched on",
    28: "signals that use a small part of the converter's range",
    29: "grabbers that find the start of a line by a phase-locked loop",
    30: "black below the converter's first code: with the factory's setting lines moved by 0.2 px and more",
    31: "a grabber with a clock of its own in its first hour: up to 4 px",
    32: "a grabber that takes 512 samples of 752 pixels: pixels 1.4 times as wide",
    33: "a pattern of 4 grey values over the frame",
    34: "a pattern that moves through the image",
    35: "blocks of strong compression",
    36: "recording on tape, which made errors 1.4 to 2.3 times as large",
    37: "hard thresholds up to half of the target's height: up to 0.14 px",
    38: "surfaces that look different from every side, naturally lit; it tells no number",
    39: "laser spots and stripes, whose speckle changes with the direction",
}


def differs(row: SourceRow) -> bool:
    """Whether the handbook's judgement and this one differ by two stars or more."""
    return abs(row.own_stars - row.stars) > ALIKE


def why_differ(row: SourceRow) -> str:
    """A sentence where they do; elsewhere nothing, or why there is no number."""
    if not differs(row):
        return row.reason if row.before is None else ""
    head = f"{'More' if row.own_stars > row.stars else 'Less'} than the handbook says"
    case = f"it has in mind {JUDGED[row.number]}" if row.number in JUDGED else "it tells no size"
    return f"{head}: {case}. Here: {_own(row)}."


def _own(row: SourceRow) -> str:
    if row.reason and not row.before_px:
        return row.reason
    if not row.before_px:
        return "the target meets nothing of it"
    return f"{length_px(row.before_px)} px before a calibration, {length_px(row.after_px)} px after it"
