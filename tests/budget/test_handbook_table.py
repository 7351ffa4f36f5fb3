"""The handbook's error table: every row has its case, and differences of two stars are told with it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pixmetry.budget.handbook import JUDGED, differs, why_differ
from pixmetry.budget.table import ABSENT, DESCRIBED, Parts, SourceRow
from pixmetry.camera.catalogue import sources

NUMBERED = {s.number: s.stars for s in sources().values() if s.number and s.stars}


def row(number: int, stars: int, px: float | None, reason: str = "") -> SourceRow:
    parts = None if px is None else Parts(place_px=(px, px))
    status = ABSENT if px is None else DESCRIBED
    return SourceRow("a", "a", "A", number, stars, status, "F", parts, parts, reason=reason)


def test_there_are_39_rows_and_all_with_stars_tell_their_case() -> None:
    assert {s.number for s in sources().values()} - {0} == set(range(1, 40))
    assert set(NUMBERED) <= set(JUDGED) <= set(range(1, 40))


@pytest.mark.parametrize(
    ("own", "words"),
    [
        (row(31, 5, None, "the camera is described without it"), ("Less", "clock of its own", "described without it")),
        (row(30, 2, 0.0016), ("Less", "below the converter's first code", "0.0016 px before")),
        (row(8, 1, 0.2), ("More", "1/5 px", "0.200 px before")),
        (row(11, 2, 0.0), ("Less", "flows over", "meets nothing")),
    ],
)
def test_two_stars_are_told_with_the_case_and_what_is_here(own: SourceRow, words: tuple[str, ...]) -> None:
    assert differs(own) and all(w in why_differ(own) for w in words), why_differ(own)


def test_one_star_is_no_difference() -> None:
    near = row(18, 2, 0.01)
    assert not differs(near) and why_differ(near) == ""
    gone = replace(near, stars=1, before=None, after=None, reason="not there")
    assert why_differ(gone) == "not there"
