"""What the report says of the digital twin: its values beside the camera's."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pixmetry.core.number import Number
from pixmetry.emva.files.keys import KEYS
from pixmetry.report import Column, Run, Section, Table, Text, strong
from pixmetry.report.numbers import MINUS, printed

if TYPE_CHECKING:
    from pixmetry.assess.digital_twin import SelfTest

SMALL_PRINT = (
    "Values of EMVA 1288 Release 3.1 of the camera's frames and of the twin's; the difference in units of its standard uncertainty, that "
    "of both values together."
)
FAR_U = 3.0  # a difference beyond which twin and camera are not the same


def twin_section(test: SelfTest) -> Section:
    """The self-test: a sentence, and all values of camera and twin folded away."""
    section = Section("The digital twin beside the camera", [Text(twin_sentence(test))])
    if not test.rows:
        return section
    rows = []
    for r in test.rows:
        far, text = abs(r.difference_u) > FAR_U, f"{r.difference_u:+.1f}".replace("-", MINUS)
        key = KEYS[r.name]
        title = [key.title, *([Run(f" {key.symbol}", "soft")] if key.symbol else [])]
        pair = [printed(Number(value, u, unit=r.unit)) for value, u in ((r.camera, r.u_camera), (r.twin, r.u_twin))]
        rows.append([title, *pair, strong(text) if far else text])
    both = [Column("Value", "number", group=whose) for whose in ("Camera", "Twin")]
    columns: list[Column | str] = ["Quantity", *both, Column("Difference / u", "right")]
    folded = section.add_section("All values of camera and twin", Text(SMALL_PRINT, "small soft"), fold=True)
    folded.add(Table("Values of camera and twin", columns, rows))
    return section


def twin_sentence(test: SelfTest) -> str:
    """The outcome in a sentence or two."""
    worst = test.worst
    if worst is None:
        return f"The twin was not tested: {test.reason}." if test.reason else "The twin was not tested."
    far = [KEYS[r.name].title for r in test.rows if abs(r.difference_u) > FAR_U]
    outcome = (
        f"{len(far)} of {len(test.rows)} values differ by more than {FAR_U:g} u of the difference: {', '.join(far)}."
        if far
        else f"All {len(test.rows)} values agree within {FAR_U:g} u of the difference; the farthest is {KEYS[worst.name].title} "
        f"({abs(worst.difference_u):.1f} u)."
    )
    taken = f"It took {test.frames} frames" + ("" if test.frames == test.of else f", where the campaign has {test.of}")
    if test.window is not None:
        taken += f", and of each the {test.window[3]} × {test.window[2]} pixels in the middle"
    return f"The digital twin was put through the same campaign, and its frames were evaluated as the camera's were. {taken}. {outcome}"
