"""Files that belong together: all new or all as before, whatever fails; nobody else's file is replaced."""

from __future__ import annotations

import errno
import io
import os
import re
from pathlib import Path
from typing import Any

import pytest

from files.failing import FAULTS, Failing
from pixmetry.core.errors import InputError
from pixmetry.files.output import Output, check_files, write_page, write_together

MARK = re.compile(rb"ours ")
NAMES = ("a.json", "b.xml", "c.html")
CALLS = ("replace", "link", "fsync", "unlink", "chmod", "open", "mkdir", "rename")


def outputs(folder: Path) -> list[Output]:
    return [Output(folder / name, MARK, make_folder=True) for name in NAMES]


def contents(word: str) -> list[bytes]:
    return [f"ours {word} {name}".encode() for name in NAMES]


def state(folder: Path) -> list[bytes | None]:
    return [path.read_bytes() if (path := folder / name).exists() else None for name in NAMES]


@pytest.mark.parametrize(("problem", "after"), FAULTS, ids=["fails", "interrupted before", "interrupted after"])
@pytest.mark.parametrize("links", [True, False], ids=["links", "no links"])
@pytest.mark.parametrize("earlier", [NAMES, NAMES[1:], ()], ids=["over all", "over two", "new"])
def test_all_or_none_whatever_call_fails(
    earlier: tuple[str, ...], links: bool, problem: BaseException, after: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = set()
    for call in (*CALLS, "write", "close"):
        for at in range(1, 40):
            folder = tmp_path / f"{call}{at}" / "new"
            if earlier:
                write_together(outputs(folder)[-len(earlier) :], contents("old")[-len(earlier) :])
            before = state(folder)
            with monkeypatch.context() as patch:
                if not links:
                    patch.setattr(os, "link", _no_links)
                failing = _failing(call, at, problem, after, patch)
                raised: BaseException | None = None
                try:
                    write_together(outputs(folder), contents("new"))
                except (InputError, KeyboardInterrupt) as told:
                    raised = told
            found = state(folder)
            assert found in (before, contents("new")), (call, at, found)
            assert raised is not None or found == contents("new"), (call, at)
            left = {p.name for p in folder.iterdir()} - set(NAMES) if folder.exists() else set()
            if call == "unlink" and isinstance(problem, OSError):  # what cannot be removed stays
                left = {name for name in left if not name.endswith(".old")}
            assert not left, (call, at)
            ends.add(found == before)
            if failing.calls < at:
                break
        else:
            pytest.fail("more calls than were tried")
    assert ends == {True, False}


def _no_links(*_: Any) -> None:
    raise OSError(errno.EPERM, "no links here")


def _failing(call: str, at: int, problem: BaseException, after: bool, patch: pytest.MonkeyPatch) -> Failing:
    if call in ("write", "close"):
        real = Path.open
        method = {"write": io.BufferedWriter.write, "close": io.BufferedWriter.close}[call]
        failing = Failing(method, at, problem, after)

        class Writer(io.BufferedWriter):
            pass

        setattr(Writer, call, lambda self, *args: failing(self, *args))

        def opened(path: Path, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
            return Writer(io.FileIO(path, "x")) if mode == "xb" else real(path, mode, *args, **kwargs)

        patch.setattr(Path, "open", opened)
        return failing
    failing = Failing(getattr(os, call), at, problem, after)
    patch.setattr(os, call, failing)
    return failing


@pytest.mark.parametrize("there", [b"mine", b"x ours ", b"\x00"])
def test_another_file_of_that_name_is_kept(there: bytes, tmp_path: Path) -> None:
    (tmp_path / "b.xml").write_bytes(there)
    with pytest.raises(InputError, match="b.xml: file exists and is no result of this kind"):
        write_together(outputs(tmp_path), contents("new"))
    assert state(tmp_path) == [None, there, None]


def test_an_empty_file_may_be_filled_and_permissions_stay(tmp_path: Path) -> None:
    (tmp_path / "b.xml").touch(0o600)
    (tmp_path / "b.xml").chmod(0o600)
    write_together(outputs(tmp_path), contents("new"))
    assert (tmp_path / "b.xml").stat().st_mode & 0o777 == 0o600


def test_an_input_is_found_under_any_of_its_names(tmp_path: Path) -> None:
    (tmp_path / "in").write_bytes(b"ours ")
    os.link(tmp_path / "in", tmp_path / "hard")
    (tmp_path / "soft").symlink_to("in")
    for name in ("in", "hard", "soft"):
        with pytest.raises(InputError, match="would overwrite an input"):
            check_files([Output(tmp_path / name, MARK)], [tmp_path / "in"])


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "a.json").symlink_to(tmp_path / "real" / "kept.json")
    for word in ("first", "second"):
        write_together(outputs(tmp_path), contents(word))
    assert (tmp_path / "a.json").is_symlink() and (tmp_path / "real" / "kept.json").read_bytes() == b"ours second a.json"


def test_a_page_replaces_pages_of_its_own_kind(tmp_path: Path) -> None:
    head = '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta name="generator" content="pixmetry 1">\n<title>{}</title>\n<style></style>'
    path = write_page(tmp_path / "page.html", head.format("camera a: one target through the chain"))
    write_page(path, head.format("b: c: one target through the chain"))
    text = path.read_text()
    for other in ("a: calibration", "one target through the chain: calibration"):
        with pytest.raises(InputError, match="no result of this kind"):
            write_page(path, head.format(other))
    assert path.read_text() == text


def test_a_page_as_pdf_replaces_pages_of_ours_alone(tmp_path: Path) -> None:
    from pixmetry.report import Page, pdf_of

    path = write_page(tmp_path / "page.pdf", pdf_of(Page("a")))
    assert write_page(path, pdf_of(Page("b"))).read_bytes() == pdf_of(Page("b"))
    path.write_bytes(b"%PDF-1.4\nanother program's\n")
    with pytest.raises(InputError, match="no result of this kind"):
        write_page(path, pdf_of(Page("a")))


@pytest.mark.parametrize("name", ["with blanks.json", "ünï€☃.json", "two\nlines.json", "x" * 245 + ".json"])
def test_any_name_that_a_disk_holds(name: str, tmp_path: Path) -> None:
    for word in (b"ours first", b"ours second"):
        write_together([Output(tmp_path / name, MARK)], [word])
    assert (tmp_path / name).read_bytes() == b"ours second" and len(list(tmp_path.iterdir())) == 1
