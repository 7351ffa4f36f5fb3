"""What a source says of a verb that it lacks reaches the report: it speaks to its reader, not to a developer."""

from __future__ import annotations

import re

import pytest

from pixmetry.camera.catalogue import sources

FOR_DEVELOPERS = re.compile(r"\b(later|todo|fixme|not (yet )?implemented|to be done)\b", re.I)


def test_reasons_are_for_the_reader_of_a_report() -> None:
    assert FOR_DEVELOPERS.search("later: needs the slanted-edge experiment")
    said = {f"{s.id}.{verb}": text for s in sources().values() for verb, text in s.reasons.items()}
    assert not {name: text for name, text in said.items() if FOR_DEVELOPERS.search(text)}


CANNOT = [(s.id, verb) for s in sources().values() for verb in ("measure", "correct") if getattr(s, verb) is None]


@pytest.mark.parametrize(("source_id", "verb"), CANNOT, ids=[f"{verb} {i}" for i, verb in CANNOT])
def test_what_frames_cannot_tell_or_give_back_is_said_in_two_sentences(source_id: str, verb: str) -> None:
    """Which other parameters, or which other image, leave the frames as they are; and what to do instead, or why nothing is lost."""
    reason = sources()[source_id].reasons[verb]
    parts = reason.split(". ")
    assert len(parts) >= 2 and all(len(part.split()) >= 4 for part in parts), reason
    assert not reason.endswith("."), "it stands within a sentence"


def test_every_source_is_measured_and_corrected_or_says_why_not() -> None:
    held = {verb: [s.id for s in sources().values() if getattr(s, verb) is not None] for verb in ("measure", "correct")}
    assert len(held["measure"]) + sum(verb == "measure" for _, verb in CANNOT) == len(sources())
    assert len(held["correct"]) + sum(verb == "correct" for _, verb in CANNOT) == len(sources())
    assert len(held["measure"]) >= 72 and len(held["correct"]) >= 28
