"""The pages docs/start-*.md: every command on them runs, every file on them is accepted, and what they print is what comes out.

A page is run from top to bottom in an empty folder. A block of YAML is written into the file that the line before it names. The lines of
a block ``sh`` are run. A block ``text`` shows lines that the commands before it printed, in their order; … stands for what is left out,
lines or the end of a line.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from glob import glob
from pathlib import Path
from typing import NamedTuple

import pytest
from click.testing import CliRunner

from pixmetry.cli import main

PAGES = sorted((Path(__file__).resolve().parents[1] / "docs").glob("start-*.md"))
BLOCK = re.compile(r"^(?:`(?P<file>[^`\n]+)`:\n+)?```(?P<language>\w+)\n(?P<body>.*?)^```$", re.M | re.S)
NUMBER = re.compile(r"[−+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


class Block(NamedTuple):
    file: str | None
    language: str
    body: str


def blocks(text: str) -> list[Block]:
    return [Block(*found.group("file", "language", "body")) for found in BLOCK.finditer(text)]


def words_agree(shown: str, printed: str) -> bool:
    """The same words; numbers to 5 % or one unit of the last digit, for other processors and library versions round otherwise."""
    if shown.endswith(" …"):  # only the beginning of the line
        words = shown.split()[:-1]
        shown, printed = " ".join(words), " ".join(printed.split()[: len(words)])
    if NUMBER.sub("0", " ".join(shown.split())) != NUMBER.sub("0", " ".join(printed.split())):
        return False
    for one, other in zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True):
        a, b = (float(v.replace("−", "-")) for v in (one, other))
        digit = 10.0 ** -len(one.partition("e")[0].partition(".")[2]) if "e" not in one else 0.0
        if abs(a - b) > max(0.05 * abs(b), 1.01 * digit):
            return False
    return True


def first_missing(shown: str, printed: str) -> str | None:
    """The first line that was not printed, or not after those before it."""
    left = iter(printed.splitlines())
    for line in filter(None, map(str.strip, shown.splitlines())):
        if line != "…" and not any(words_agree(line, other) for other in left):
            return line
    return None


def run_command(line: str) -> str:
    program, *words = shlex.split(line, comments=True)
    assert program == "pixmetry", f"the pages use no other command: {line}"
    arguments = [name for word in words for name in (sorted(glob(word)) if "*" in word else [word])]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, f"{line}\n{result.output}"
    return result.stdout


def run_python(code: str) -> str:
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(compile(code, "page", "exec"), {})
    return said.getvalue()


def test_there_are_four_pages() -> None:
    assert [page.stem for page in PAGES] == ["start-data-sheet", "start-folder-of-tiffs", "start-simulation", "start-test-field"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_runs_from_top_to_bottom(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    printed, compared = "", 0
    for block in blocks(page.read_text(encoding="utf-8")):
        if block.language == "yaml":
            assert block.file, f"the page does not name the file of\n{block.body}"
            (tmp_path / block.file).write_text(block.body, encoding="utf-8")
        elif block.language == "sh":
            lines = block.body.replace("\\\n", " ").splitlines()
            printed = "".join(run_command(line) for line in lines if line and not line.startswith("#"))
        elif block.language == "python":
            printed = run_python(block.body)
        else:
            assert block.language == "text"
            missing = first_missing(block.body, printed)
            assert missing is None, f"not printed: {missing}\nprinted:\n{printed}"
            compared += 1
    assert compared >= 2


def test_planted_changes_are_seen() -> None:
    printed = "a coordinate is worth 0.0039 px\nu 3e-05 px\nreport: r.html"
    assert first_missing("…\nu 3e-05 px\n…\nreport: r.html", printed) is None
    assert first_missing("a coordinate is worth 0.0052 px", printed) is not None
    assert first_missing("u 4e-05 px", printed) is not None
    assert first_missing("a coordinate is …", printed) is None
    assert first_missing("a position is …", printed) is not None
    assert first_missing("a place is worth 0.0039 px", printed) is not None
    assert first_missing("report: r.html\nu 3e-05 px", printed) is not None
