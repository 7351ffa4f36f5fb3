"""The one writer of results. Its rule: they appear whole or not at all, and replace nothing but earlier results of the same kind.

`write_together` writes files beside whatever else stands in their folders: how a file begins tells whether it is an earlier result.
`staged_output` writes a folder of its own: a note in it tells what was written, and by its digests whether somebody changed it since.
Both write under temporary names beside the wanted ones, swap when all is there, and put back what was there before if that fails.
"""

from __future__ import annotations

import errno
import hashlib
import json
import mmap
import os
import re
import secrets
import shutil
import socket
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from pixmetry.core.checksums import check_record, file_sha256, sealed
from pixmetry.core.errors import InputError
from pixmetry.files.strict_json import json_text

MARKER = ".pixmetry-output.json"
OUTPUT_SCHEMA = "pixmetry/output/2"
_SYSTEM_FILES = {".DS_Store", "Thumbs.db", "desktop.ini"}  # file managers leave these in every folder that is looked at
_SHOWN = 3
_LONGEST = 100  # bytes of the wanted name that stand in a temporary one; most disks hold 255
OLD, MOVED = ".old", ".moved"  # the earlier result: the folder as it was, or its files one by one
_HEAD = (
    rb"\s*<!DOCTYPE html>\s*<html\b[^>]*>\s*<head>(?:(?!<style|</head>|<body).)*"
    rb'<meta name="generator" content="pixmetry (?:(?!<style|</head>|<body).)*'
)
PDF_MARK = re.compile(rb"%PDF-1\.\d.*\n\d+ 0 obj\s*<< /Creator \(pixmetry\)", re.DOTALL)  # a PDF says at its end who made it


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
        raise _unwritable(output.path, problem, "file", "place") from None


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
    of them whole, and the old ones beside them under names that end in ``.old``; the next run to the same names removes these.

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
            step.clear_stale()
            step.prepare(raw)
        for step in steps:
            step.take_place()
    except BaseException as problem:
        for step in reversed(steps):
            step.undo()
        if isinstance(problem, OSError):
            name, what = (outputs[0].path.parent, "files") if len(outputs) > 1 else (outputs[0].path, "file")
            raise _unwritable(name, problem, what, "place") from None
        raise
    try:
        for step in steps:
            step.finish()
    except BaseException:
        for step in steps:
            step.finish()
        raise


@contextmanager
def streamed_file(output: Output, inputs: Iterable[Path] = ()) -> Iterator[BinaryIO]:
    """Write a file bit by bit, so that it appears whole or not at all, however long it gets.

    Yields
    ------
    binary file
        To write into; it takes its place when the block ends well.

    Raises
    ------
    InputError
        As `check_files` does, or if the file cannot be written.
    """
    check_files([output], inputs)
    step = _Step(Path(os.path.realpath(output.path)))
    try:
        if output.make_folder:
            step.path.parent.mkdir(parents=True, exist_ok=True)
        step.clear_stale()
        with step.partial.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        step.keep_earlier()
        step.take_place()
    except BaseException as problem:
        step.undo()
        if isinstance(problem, OSError):
            raise _unwritable(output.path, problem, "file", "place") from None
        raise
    step.finish()


def replace_file(path: Path, raw: bytes) -> None:
    """Write one file into a folder that is this run's own, so that it is never there in part."""
    step = _Step(path)
    try:
        step.prepare(raw)
        step.take_place()
    except BaseException:
        step.undo()
        raise
    step.finish()


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
        name = f".{_stem(path)}.partial-{_host()}-{os.getpid()}-{secrets.token_hex(4)}"
        self.path, self.partial, self.old = path, path.with_name(name), path.with_name(f"{name}.old")
        self.earlier, self.prepared = path.exists(), False

    def clear_stale(self) -> None:
        """Remove what runs on this machine that were killed have left for this file."""
        form = re.compile(re.escape(f".{_stem(self.path)}.partial-{_host()}-") + rf"(\d+)-[0-9a-f]{{8}}({re.escape(OLD)})?")
        with suppress(OSError):
            for path in self.path.parent.iterdir():
                match = form.fullmatch(path.name)
                if (
                    match and not _runs(int(match[1])) and (self.path.exists() or not match[2])
                ):  # an earlier result is kept where no other is
                    path.unlink()

    def prepare(self, raw: bytes) -> None:
        """Write the content, and keep the earlier file under a second name."""
        with self.partial.open("xb") as file:
            file.write(raw)
            file.flush()
            os.fsync(file.fileno())
        self.keep_earlier()

    def keep_earlier(self) -> None:
        """Keep the earlier file under a second name, once the new one is written."""
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


@contextmanager
def staged_output(directory: str | Path, kind: str, of: Sequence[str | Path] = (), inputs: Iterable[str | Path] = ()) -> Iterator[Path]:
    """Write a folder of results so that it appears whole or not at all.

    Inside the ``with`` block, files go into a temporary folder beside the wanted one; when the block ends well, the folders are
    swapped. Where a folder cannot be swapped (the mount point of a disk, the folder in which a shell stands, one whose parent cannot be
    written to) its files are, one by one. After an error or an interruption the old result stands as it was.

    Parameters
    ----------
    directory : str or Path
        The wanted folder. If it exists it must be empty or hold nothing but the files of an earlier result of the same, unchanged.
    kind : str
        What is written, in a word (``"assessment"``): a result of another kind is never replaced, for it may be the input.
    of : sequence of str or Path
        What the result is of, such as a camera and a scene: names or files. A result of something else is never replaced.
    inputs : iterable of str or Path
        Files and folders that are read and must not be replaced.

    Yields
    ------
    Path
        The folder to write into.

    Raises
    ------
    InputError
        If something would be lost, the folder cannot be made, or another run is writing it.
    """
    target, inputs = Path(os.path.realpath(directory)), tuple(inputs)
    check_output(directory, kind, of, inputs)
    partial = None
    try:
        try:
            place = _place(target)
            place.mkdir(parents=True, exist_ok=True)
            _clean_stale(target)
            check_output(directory, kind, of, inputs)
            partial = place / f"{_stem(target)}.partial-{_host()}-{os.getpid()}-{secrets.token_hex(4)}"
            partial.mkdir()
            lock = _locked(partial)
        except OSError as problem:
            raise _unwritable(directory, problem) from None
        try:
            yield partial
            record = {"schema": OUTPUT_SCHEMA, "kind": kind, "of": _names(of), "job": _job(target, of)}
            replace_file(partial / MARKER, json_text(sealed(record, partial, files_in(partial))).encode())
            check_output(directory, kind, of, inputs, own=partial)  # somebody may have put a file there in the meantime
            _swap(partial, target)
        finally:
            if lock is not None:
                os.close(lock)
    finally:
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)


def check_output(
    directory: str | Path, kind: str, of: Sequence[str | Path] = (), inputs: Iterable[str | Path] = (), *, own: Path | None = None
) -> None:
    """Refuse a folder that cannot be written, or in which something would be lost that no earlier run of the same wrote.

    Parameters
    ----------
    directory, kind, of, inputs
        As of `staged_output`.
    own : Path, optional
        The temporary folder of this run.

    Raises
    ------
    InputError
        If it is a file, holds other files (at any depth), a file that was changed since it was written, an input, or a result of
        another kind or of something else, cannot be written to, or if another run is writing there.
    """
    target = Path(os.path.realpath(directory))
    where = str(directory)
    try:
        marker = _check_earlier(target, where, kind) if target.exists() else None
        for path in (Path(os.path.realpath(given)) for given in inputs):
            if path.is_relative_to(target):
                remedy = "choose another folder for the results"
                raise InputError("the folder holds a file that is read", where=where, value=path.name, remedy=remedy)
        if marker is not None:
            _check_same(target, where, marker, of)
        _check_alone(target, where, own)
        if own is None:
            _probe(target)
    except OSError as problem:
        raise _unwritable(directory, problem) from None


def _check_earlier(target: Path, where: str, kind: str) -> dict[str, Any] | None:
    """Refuse a folder with files that no earlier run of the same kind wrote; return what that one noted."""
    if not target.is_dir():
        raise InputError("is a file, not a folder", where=where, remedy="choose another folder for the results")
    marker = _marker(target)
    written = {} if marker is None else marker["checksums"]["files"]
    foreign = [name for name in files_in(target) if name not in written and (name != MARKER or marker is None)]
    if marker is not None and marker["kind"] != kind:
        there = marker["kind"]
        raise InputError(f"folder holds the result of another command ({there})", where=where, remedy="choose another folder")
    if foreign:
        remedy = "choose another folder, or move these files away"
        raise InputError(f"folder holds files that are not results of pixmetry ({_few(foreign)})", where=where, remedy=remedy)
    return marker


def _check_same(target: Path, where: str, marker: Mapping[str, Any], of: Sequence[str | Path]) -> None:
    """Refuse to replace a result of something else, or files that were changed since they were written."""
    if of and marker.get("job") and marker["job"] != _job(target, of):
        what = f"folder holds the {marker['kind']} of something else ({', '.join(marker['of'])})"
        raise InputError(what, where=where, remedy="choose another folder, or delete this one if it is not needed any more")
    written = marker["checksums"]["files"]
    changed = [name for name in written if os.path.lexists(target / name) and file_sha256(target / name) != written[name]]
    if changed:
        remedy = "choose another folder, or move these files away"
        raise InputError(f"folder holds files that were changed since they were written ({_few(changed)})", where=where, remedy=remedy)


def _check_alone(target: Path, where: str, own: Path | None) -> None:
    """Refuse a folder that another run on this machine is writing."""
    for path, pid, _ in _temporary(target):
        if path != own and _alive(path, pid):
            remedy = "wait until it has finished, or choose another folder"
            raise InputError("another run is writing this folder", where=where, value=f"process {pid}", remedy=remedy)


def _probe(target: Path) -> None:
    """Make and remove a folder where the temporary one will be: OSError if that cannot be done."""
    place = _place(target)
    while not place.exists():
        place = place.parent
    probe = place / f"{_stem(target)}.probe-{secrets.token_hex(4)}"
    probe.mkdir()
    probe.rmdir()


def _unwritable(where: str | Path, problem: OSError, what: str = "folder", place: str = "folder") -> InputError:
    remedies = {errno.ENAMETOOLONG: "choose a shorter name", errno.ENOSPC: f"make room, or choose another {place}"}
    remedy = remedies.get(problem.errno or 0, f"choose another {place}")
    return InputError(f"{what} cannot be written", where=str(where), value=problem.strerror, remedy=remedy)


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")


def files_in(folder: Path) -> list[str]:
    """Names of all files in a folder and below, with slashes, and of links; files of file managers are left out."""
    own = re.compile(_form(folder))
    found = []
    for at, folders, files in os.walk(folder, onerror=_raised):
        here = Path(at)
        linked = [name for name in folders if (here / name).is_symlink()]
        folders[:] = [name for name in folders if name not in linked and not (here == folder and own.fullmatch(name))]
        names = [name for name in (*files, *linked) if name not in _SYSTEM_FILES]
        found += [(here / name).relative_to(folder).as_posix() for name in names]
    return sorted(found)


def _raised(problem: OSError) -> None:
    raise problem


def own_files(folder: str | Path) -> frozenset[str]:
    """Names of the files in a folder that pixmetry wrote as a result, relative to it; none if it holds no result."""
    marker = _marker(Path(folder))
    return frozenset() if marker is None else frozenset(marker["checksums"]["files"])


def _marker(target: Path) -> dict[str, Any] | None:
    """Record of an earlier run about the files that it wrote; None if there is none, or another kind of record."""
    try:
        marker = json.loads((target / MARKER).read_text(encoding="utf-8"))
        check_record(marker, MARKER)
        return marker if marker["schema"] == OUTPUT_SCHEMA and isinstance(marker["kind"], str) and marker["checksums"] else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _names(of: Sequence[str | Path]) -> list[str]:
    return [Path(one).name if isinstance(one, Path) else one for one in of]


def _job(target: Path, of: Sequence[str | Path]) -> str:
    """A digest of the inputs of a result: names, and paths relative to the result, so that both can be moved together."""
    if not of:
        return ""
    try:
        places = [[os.path.relpath(os.path.realpath(one), target)] if isinstance(one, Path) else one for one in of]
    except ValueError:  # on another drive
        places = [[os.path.realpath(one)] if isinstance(one, Path) else one for one in of]
    return hashlib.sha256(json.dumps(places).encode()).hexdigest()[:16]


def _place(target: Path) -> Path:
    """Place of the temporary folder: beside the wanted folder, or inside of it if that one cannot be swapped."""
    here = Path(os.path.realpath(os.curdir))
    fixed = target.is_dir() and (os.path.ismount(target) or here.is_relative_to(target) or not os.access(target.parent, os.W_OK | os.X_OK))
    return target if fixed else target.parent


def _swap(partial: Path, target: Path) -> None:
    """Put the new result in the place of the old one: the whole folder, or its files where that cannot be done."""
    old = partial.with_name(partial.name + OLD)
    try:
        if partial.parent == target:
            raise OSError(errno.EBUSY, "cannot be renamed", str(target))
        if target.exists():
            shutil.copymode(target, partial)
            os.replace(target, old)
        os.replace(partial, target)
    except BaseException as problem:
        if old.exists() and not target.exists():
            os.replace(old, target)
        if not isinstance(problem, OSError) or not target.is_dir():
            raise
        _move_in(partial, target, partial.with_name(partial.name + MOVED))
    finally:
        if not partial.exists():
            shutil.rmtree(old, ignore_errors=True)


def _move_in(partial: Path, target: Path, moved: Path) -> None:
    """Swap the files of two folders, all or none; the note of what was written is the first to go and the last to come."""
    marker = _marker(target)
    earlier = [] if marker is None else [MARKER, *(name for name in marker["checksums"]["files"] if os.path.lexists(target / name))]
    new = [*(name for name in files_in(partial) if name != MARKER), MARKER]
    try:
        moved.mkdir()
        _move(earlier, target, moved)
        _remove_empty(target, earlier)
        _move(new, partial, target)
    except BaseException:
        _move_back(partial, target, moved)
        raise
    shutil.rmtree(moved, ignore_errors=True)


def _move(names: Iterable[str], source: Path, goal: Path) -> None:
    for name in names:
        (goal / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(source / name, goal / name)


def _move_back(partial: Path, target: Path, moved: Path) -> None:
    """Undo `_move_in`, whatever it had done; nothing is to be undone once the note has come."""
    if (partial / MARKER).exists():
        marker = _marker(partial)
        new = [] if marker is None else [*marker["checksums"]["files"]]
        for name in new:
            if os.path.lexists(target / name) and not os.path.lexists(partial / name):
                os.unlink(target / name)
        _remove_empty(target, new)
        if moved.exists():
            _move(sorted(files_in(moved), key=MARKER.__eq__), moved, target)
    shutil.rmtree(moved, ignore_errors=True)


def _remove_empty(target: Path, names: Iterable[str]) -> None:
    """Remove folders below that held these files and are empty now."""
    below = {parent for name in names for parent in Path(name).parents if parent != Path()}
    for folder in sorted(below, key=lambda p: -len(p.parts)):
        with suppress(OSError):
            (target / folder).rmdir()


def _host() -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", socket.gethostname()) or "host"


def _stem(target: Path) -> str:
    """How a temporary name begins: the wanted name, shortened where the disk would not hold it."""
    raw = os.fsencode(target.name)
    return target.name if len(raw) <= _LONGEST else f"{target.name[:20]}-{hashlib.sha256(raw).hexdigest()[:16]}"


def _form(target: Path) -> str:
    """Pattern of the names of temporary folders of runs on this machine."""
    return re.escape(_stem(target)) + rf"\.partial-{_host()}-(\d+)-[0-9a-f]{{8}}({OLD}|{MOVED})?"


def _temporary(target: Path) -> list[tuple[Path, int, str]]:
    """Temporary folders of runs on this machine for a result: path, process, and what it holds (``""``, `OLD` or `MOVED`)."""
    form = re.compile(_form(target))
    found = []
    for place in (target.parent, target):
        with suppress(OSError):  # not there, or not to be listed
            found += [(path, match) for path in place.iterdir() if (match := form.fullmatch(path.name))]
    return [(path, int(match[1]), match[2] or "") for path, match in found]


def _clean_stale(target: Path) -> None:
    """Remove the temporary folders of killed runs on this machine; a result that was moved away and not replaced is moved back."""
    left = [item for item in _temporary(target) if not _alive(item[0], item[1])]
    for path, _, what in sorted(left, key=lambda item: not item[2]):  # what was set aside first
        partial = path.with_name(path.name.removesuffix(what))
        if what and _alive(partial, 0):
            continue
        if what == MOVED:
            _move_back(partial, target, path)
        elif what == OLD and not target.exists():
            os.replace(path, target)
        else:
            shutil.rmtree(path, ignore_errors=True)


def _locked(folder: Path) -> int | None:
    """Lock a folder as long as this process lives; None where that is not possible."""
    try:
        import fcntl

        handle = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(handle)
            return None
        return handle
    except (ImportError, OSError):
        return None


def _alive(folder: Path, pid: int) -> bool:
    """Whether the run that made a temporary folder is still active: by its lock, or by its process if there are no locks."""
    if not folder.exists():
        return False
    try:
        import fcntl

        handle = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return False
        except BlockingIOError:
            return True
        finally:
            os.close(handle)
    except (ImportError, OSError):
        return _runs(pid)


def _runs(pid: int) -> bool:
    if os.name == "nt":  # there, signal 0 would end the process instead of asking after it
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
