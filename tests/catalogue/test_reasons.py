"""What a source says of a verb that it lacks reaches the report: it speaks to its reader, not to a developer."""

from __future__ import annotations

import re

from pixmetry.camera.catalogue import sources

FOR_DEVELOPERS = re.compile(r"\b(later|todo|fixme|not (yet )?implemented|to be done)\b", re.I)


def test_reasons_are_for_the_reader_of_a_report() -> None:
    assert FOR_DEVELOPERS.search("later: needs the slanted-edge experiment")
    said = {f"{s.id}.{verb}": text for s in sources().values() for verb, text in s.reasons.items()}
    assert not {name: text for name, text in said.items() if FOR_DEVELOPERS.search(text)}
