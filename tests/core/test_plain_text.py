"""Names on a terminal and in tables: harmless, and the same after reading."""

from __future__ import annotations

import itertools
import json
import re

import pytest

from pixmetry.core.plain_text import cell, json_shown, name_of, shown, shown_lines

PARTS = [*"=+-@'\t\r\n\x1b\x9b\u202e\\1a \xa0,;\"#", "x1b", "x5c", "u202e"]


def test_every_name_comes_back_and_none_is_a_formula_or_a_command() -> None:
    """All texts of up to three of these parts; a spreadsheet computes what begins with =, +, -, @ or a control character, but numbers."""
    seen = {}
    for n in range(4):
        for parts in itertools.product(PARTS, repeat=n):  # some 13 000
            name = "".join(parts)
            text = cell(name)
            assert name_of(text) == name
            assert seen.setdefault(text, name) == name
            assert not re.search(r"[\x00-\x1f\x7f-\x9f\u202e]", text) and text.strip() == text and text[:1] != "#"
            assert text[:1] not in ("=", "+", "-", "@") or float(text) is not None


@pytest.mark.parametrize("text", ["P1", "-5", "+3.5e-7", "1", "dots 9×6", "C:\\new\\x.png", "it's", "'quoted'", "ümläut", "100_1"])
def test_plain_names_and_numbers_stay_as_they_are(text: str) -> None:
    assert cell(text) == text == shown(text)


def test_terminals_get_no_commands() -> None:
    assert shown("a\x1b[31mb\nc\u202ed") == r"a\x1b[31mb\x0ac\u202ed"
    assert shown_lines("a\x1b\n\tb") == "a\\x1b\n\tb"
    record = {"name": "a\x1b\x9b\u202e\x7f\n"}
    text = json_shown(json.dumps(record, ensure_ascii=False, indent=1))
    assert json.loads(text) == record and not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u202e]", text)
