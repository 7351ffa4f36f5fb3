"""Names as terminals and spreadsheets may see them: control characters and formulas made harmless, and taken back on reading.

A file may be called ``\\x1b[2Jx.png`` and a point ``=1+2``. On a terminal the first is a command, in a spreadsheet the second. Written by
`cell` and read by `name_of`, every name comes back as it was.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

# C0, DEL, C1, line and paragraph separators, and what turns the direction of writing
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
_EDGE = re.compile(r"^[\s#]|\s$")  # blanks that a reader of tables takes off, and what begins a comment
_LIKE_WRITTEN = re.compile(r"\\(?=x[0-9a-f]{2}|u[0-9a-f]{4})")  # text that looks like a character written by us
_WRITTEN = re.compile(r"\\(?:x([0-9a-f]{2})|u([0-9a-f]{4}))")
_FORMULA = re.compile(r"'*[=+\-@]")
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_IN_COMMENT = re.compile(rf"([,;]\s*)(?=[=+\-@])(?!{_NUMBER.pattern}\s*(?:[,;]|$))")


def shown(text: object) -> str:
    """A text for one line of a terminal: control characters as ``\\x1b``."""
    return _CONTROL.sub(_code, str(text))


def shown_lines(text: str) -> str:
    """The same for several lines, whose ends and tabs stay."""
    return _CONTROL.sub(lambda found: found[0] if found[0] in "\n\t" else _code(found), text)


def json_shown(text: str) -> str:
    """Strict JSON for a terminal: what JSON lets pass of control characters becomes an escape of JSON."""
    return _CONTROL.sub(lambda found: found[0] if found[0] == "\n" else f"\\u{ord(found[0]):04x}", text)


def cell(text: str) -> str:
    """A text for a cell of a table: control characters and blanks at its ends as ``\\x1b``, an apostrophe before a formula, no number."""
    text = _EDGE.sub(_code, _CONTROL.sub(_code, _LIKE_WRITTEN.sub(r"\\x5c", text)))
    return f"'{text}" if _FORMULA.match(text) and not _NUMBER.fullmatch(text) else text


def comment(text: str) -> str:
    """A text for a line of comment in a table: as `cell` for each part of it that a spreadsheet would take for a cell."""
    return _IN_COMMENT.sub(r"\1'", shown(" ".join(text.split())))


def name_of(text: str) -> str:
    """The text that `cell` wrote."""
    if text.startswith("'") and _FORMULA.match(text) and not _NUMBER.fullmatch(text[1:]):
        text = text[1:]
    return _WRITTEN.sub(_char, text)


def ends_of_paths(names: Sequence[str]) -> list[str]:
    """The shortest ends of the paths that still differ from each other."""
    parts = [Path(name).parts for name in names]
    for n in range(1, max(map(len, parts), default=0)):
        short = ["/".join(p[-n:]) for p in parts]
        if len(set(short)) == len(set(names)):
            return short
    return list(names)


def _code(found: re.Match[str]) -> str:
    number = ord(found[0])
    return f"\\x{number:02x}" if number < 0x100 else f"\\u{number:04x}"


def _char(found: re.Match[str]) -> str:
    char = chr(int(found[1] or found[2], 16))
    return char if char in "\\#" or char.isspace() or _CONTROL.match(char) else found[0]
