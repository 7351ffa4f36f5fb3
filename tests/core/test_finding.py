"""One finding: its record, with and without the numbers that it rests on."""

from __future__ import annotations

import json

import pytest

from pixmetry.core.finding import Finding
from pixmetry.core.number import Number


def test_inverse_of_the_record() -> None:
    plain = Finding("datum", "Datum: the plate.")
    assert plain.to_record() == {"kind": "datum", "text": "Datum: the plate.", "advice": "", "level": "note"}
    full = Finding("correlation", "x0 and c.", "Fix one.", "warning", {"r": Number(0.99, 0.01, 40.0), "of": "x0", "images": 3})
    for finding in (plain, full):
        assert Finding.from_record(json.loads(json.dumps(finding.to_record(), allow_nan=False))) == finding
    assert len({plain, full, Finding("datum", "Datum: the plate.")}) == 2


def test_a_level_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ValueError, match="level"):
        Finding("datum", "", level="info")
