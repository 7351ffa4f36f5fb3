"""Result files that appear all together and whole, or not at all."""

from __future__ import annotations

import errno
import mmap
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pixmetry.core.errors import InputError

_HEAD = (
    rb"\s*<!DOCTYPE html>\s*<html\b[^>]*>\s*<head>(?:(?!<style|</head>|<body).)*"
    rb'<meta name="generator" content="pixmetry (?:(?!<style|</head>|<body).)*'
)
PDF_MARK = re.compile(rb"%PDF-1\.\d.*\n\d+ 0 obj\s*<< /Creator \(pixmetry\)", re.DOTALL)  # a PDF says at its end who made it
_LONGEST = 100  # bytes of the wanted name that stand in the name of a temporary file; most disks hold 255


@dataclass(frozen=True)
class Output:
    """Where a result file goes.

    Parameters
    ----------
    path : Path
    mark : re.Pattern
        What every earlier result of its kind begins with: nothing else is replaced.
    make_folder : bool
        Whether its folder is made if it does not exist.
    """

    path: Path
    mark: re.Pattern[bytes]
    make_folder: bool = False


def page_mark(page: str) -> re.Pattern[bytes]:
    """The pattern of pages of pixmetry of one kind: those whose title ends as that of this one does."""
    head = page.partition("</title>")[0]
    kind = head[head.rfind("<title>") + len("<title>") :].rpartition(": ")[2]
    return re.compile(_HEAD + re.escape(kind.encode()) + rb"</title>", re.DOTALL)


def check_files(outputs: Sequence[Output], inputs: Iterable[Path] = ()) -> None:
    """Refuse names under which result files cannot be written, or under which something would be lost.

    Parameters
    ----------
    outputs : sequence of Output
    inputs : iterable of Path
        Files that must not be touched.

    Raises
    ------
    InputError
        If a name is given twice, is that of an input, a folder or another file, or its folder is missing or cannot be written to.
    """
    seen: set[Path] = set()
    read: set[Path] = set()
    if any(output.path.exists() for output in outputs):  # what is not there is no input
        files = (path if path.exists() else path.parent for path in map(Path, inputs))  # a frame in a file: that file
        read = {Path(os.path.realpath(file)) for file in files}
    for output in outputs:
        real = Path(os.path.realpath(output.path))
        if real in seen:
            raise InputError("one file for two results", where=str(output.path), remedy="give each its own name")
        seen.add(real)
        if real in read or any(_same(real, path) for path in read):
            raise InputError("would overwrite an input", where=str(output.path), remedy="choose another name")
        _check_one(real, output)


def _same(one: Path, other: Path) -> bool:
    """Whether two names are those of one file (hard links, upper and lower case)."""
    try:
        return os.path.samefile(one, other)
    except OSError:
        return False


def _check_one(real: Path, output: Output) -> None:
    folder, where = real.parent, str(output.path)
    try:
        if real.is_dir():
            raise InputError("is a folder, not a file", where=where, remedy="name the file in it")
        while output.make_folder and not folder.exists():
            folder = folder.parent
        if not folder.is_dir():
            raise InputError("the folder does not exist", where=where, value=str(output.path.parent), remedy="make it, or choose another")
        if not os.access(folder, os.W_OK | os.X_OK):
            raise InputError("the folder cannot be written to", where=where, remedy="choose another")
        if real.exists() and not (real.is_file() and _is_earlier(real, output.mark)):
            raise InputError("file exists and is no result of this kind", where=where, remedy="choose another name")
    except OSError as problem:
        raise InputError("file cannot be written", where=where, value=problem.strerror, remedy="choose another place") from None


def _is_earlier(path: Path, mark: re.Pattern[bytes]) -> bool:
    """Whether a file begins as results of its kind do, or is empty."""
    with path.open("rb") as file:
        if not file.read(1):
            return True
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
            return mark.match(raw) is not None


def write_together(outputs: Sequence[Output], contents: Sequence[bytes], inputs: Iterable[Path] = ()) -> None:
    """Write files so that all of them appear whole, or none.

    Each is written under another name first; then all take their places. If one cannot, those that had taken theirs give way to the files
    that were there before. A run that is killed between the first and the last of these steps can leave new files beside old ones, each
    of them whole, and the old ones beside them under names that end in ``.old``.

    Parameters
    ----------
    outputs : sequence of Output
    contents : sequence of bytes
        What goes into each.
    inputs : iterable of Path
        Files that must not be touched.

    Raises
    ------
    InputError
        As `check_files` does, or if the files cannot be written.
    """
    check_files(outputs, inputs)
    steps = [_Step(Path(os.path.realpath(output.path))) for output in outputs]
    try:
        for output, step in zip(outputs, steps, strict=True):
            if output.make_folder:
                step.path.parent.mkdir(parents=True, exist_ok=True)
        for step, raw in zip(steps, contents, strict=True):
            step.prepare(raw)
        for step in steps:
            step.take_place()
    except BaseException as problem:
        for step in reversed(steps):
            step.undo()
        if isinstance(problem, OSError):
            name, what = (outputs[0].path.parent, "files") if len(outputs) > 1 else (outputs[0].path, "file")
            remedy = "make room, or choose another place" if problem.errno == errno.ENOSPC else "choose another place"
            raise InputError(f"{what} cannot be written", where=str(name), value=problem.strerror, remedy=remedy) from None
        raise
    try:
        for step in steps:
            step.finish()
    except BaseException:
        for step in steps:
            step.finish()
        raise


def write_page(path: str | Path, page: str | bytes) -> Path:
    """Write one page, HTML or the bytes of a PDF, so that it appears whole or not at all.

    Only an earlier HTML page of the same kind is ever replaced, or an earlier PDF of pixmetry.

    Raises
    ------
    InputError
        If there is something else of that name, or it cannot be written.
    """
    target = Path(path)
    mark, raw = (page_mark(page), page.encode()) if isinstance(page, str) else (PDF_MARK, page)
    write_together([Output(target, mark)], [raw])
    return target


class _Step:
    """One file on its way: written under another name, put in its place, and taken back if another one fails.

    What has been done is read off the disk, as an interruption may come right after it.
    """

    def __init__(self, path: Path) -> None:
        stem = path.name if len(os.fsencode(path.name)) <= _LONGEST else path.name[:20]
        name = f".{stem}.partial-{os.getpid()}-{secrets.token_hex(4)}"
        self.path, self.partial, self.old = path, path.with_name(name), path.with_name(f"{name}.old")
        self.earlier, self.prepared = path.exists(), False

    def prepare(self, raw: bytes) -> None:
        """Write the content, and keep the earlier file under a second name."""
        with self.partial.open("xb") as file:
            file.write(raw)
            file.flush()
            os.fsync(file.fileno())
        if self.earlier:
            shutil.copymode(self.path, self.partial)
            try:
                os.link(self.path, self.old)
            except OSError:  # a file system without links
                shutil.copy2(self.path, self.old)
        self.prepared = True

    def take_place(self) -> None:
        os.replace(self.partial, self.path)

    def undo(self) -> None:
        """Put the earlier file back, or remove the new one where there was none."""
        with suppress(OSError):  # the others are to be taken back all the same
            if self.prepared and not self.partial.exists():
                if self.earlier:
                    os.replace(self.old, self.path)
                else:
                    self.path.unlink(missing_ok=True)
            self.partial.unlink(missing_ok=True)
            self.old.unlink(missing_ok=True)

    def finish(self) -> None:
        """Remove the earlier file."""
        with suppress(OSError):
            self.old.unlink(missing_ok=True)
