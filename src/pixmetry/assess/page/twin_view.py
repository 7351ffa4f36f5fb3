"""What the report says of the digital twin: its values beside the camera's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pixmetry.emva.files.keys import KEYS
from pixmetry.report.numbers import MINUS, uncertain

if TYPE_CHECKING:
    from pixmetry.assess.digital_twin import SelfTest

FAR_U = 3.0  # a difference beyond which twin and camera are not the same


def twin_content(test: SelfTest) -> dict[str, Any]:
    """Sentence and rows of the self-test, for the template."""
    rows = []
    for r in test.rows:
        own, twin = uncertain(r.camera, r.u_camera, r.unit), uncertain(r.twin, r.u_twin, r.unit)
        text = f"{r.difference_u:+.1f}".replace("-", MINUS)
        key = KEYS[r.name]
        far = abs(r.difference_u) > FAR_U
        rows.append({"title": key.title, "symbol": key.symbol, "own": own, "twin": twin, "difference": text, "far": far})
    return {"twin": {"rows": rows, "said": twin_sentence(test)}}


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
