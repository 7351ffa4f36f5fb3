"""Find the image files that a manifest or descriptor names, whatever system it was written on."""

from __future__ import annotations

import difflib
import re
import unicodedata
from functools import lru_cache
from pathlib import Path

from pixmetry.core.errors import InputError
from pixmetry.files.formats import frames_of, is_frame
from pixmetry.files.raw_values import RawLayout
from pixmetry.files.zarr_frames import is_entry


def find_file(base: Path, text: str, where: str) -> Path:
    """Find one file by its name relative to a folder (or one frame of a store or file of frames: ``frames.zarr/7``, ``stack.tif/7``).

    Backslashes separate folders as slashes do, and where no name fits exactly, one that differs in upper and lower case fits.

    Parameters
    ----------
    base : Path
        Folder of the manifest or descriptor.
    text : str
        The name as it was written.
    where : str
        File and line, for messages.

    Raises
    ------
    InputError
        If there is no such file, or if several differ from it in upper and lower case only.
    """
    try:
        return _find(base, text, where)
    except OSError as problem:
        raise InputError(
            f"file '{text}' cannot be reached", where=where, value=problem.strerror, remedy="check name and permissions"
        ) from None


def _find(base: Path, text: str, where: str) -> Path:
    path = base / text  # an exact name first: on Linux a backslash may be part of it
    if path.is_file() or is_entry(path) or is_frame(path):
        return path
    path = base / text.replace("\\", "/")
    if path.is_file():
        return path
    parts = text.replace("\\", "/").split("/")
    path = Path("/") if parts[0] == "" else base
    for part in parts:
        path = path if part in ("", ".") else path / part if part == ".." or (path / part).exists() else _by_case(path, part, text, where)
    if not path.is_file():
        raise InputError(f"'{text}' is a folder, not an image file", where=where, remedy="name the files in it")
    return path


def _by_case(folder: Path, part: str, text: str, where: str) -> Path:
    names = _names(folder)
    fitting = names.get(_key(part), [])
    if len(fitting) > 1:
        remedy = "write the name exactly"
        raise InputError(
            f"'{text}' matches several files that differ only in upper and lower case",
            where=where,
            allowed=", ".join(fitting),
            remedy=remedy,
        )
    if fitting:
        return folder / fitting[0]
    remedy = "check the name; it is relative to the folder of the file that lists it"
    if re.match(r"[A-Za-z]:", text):
        remedy = "write the path relative to the folder of the file that lists it, not with a drive"
    near = difflib.get_close_matches(_key(part), names, n=1, cutoff=0.8)
    if near:
        remedy = f"did you mean '{names[near[0]][0]}'?"
    raise InputError(f"file '{text}' is missing", where=where, remedy=remedy)


@lru_cache(maxsize=8)
def _names_at(folder: Path, modified_ns: int) -> dict[str, list[str]]:
    names: dict[str, list[str]] = {}
    for entry in folder.iterdir():
        names.setdefault(_key(entry.name), []).append(entry.name)
    return names


def _names(folder: Path) -> dict[str, list[str]]:
    """Return the names in a folder by their form without case; a large folder is listed once."""
    return _names_at(folder, folder.stat().st_mtime_ns) if folder.is_dir() else {}


def _key(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def find_files(base: Path, patterns: list[str] | tuple[str, ...], where: str, raw: RawLayout | None = None) -> tuple[Path, ...]:
    """Find frames by names or glob patterns of files; what a pattern finds is in natural order (``a2`` before ``a10``).

    A file with several frames stands for all of them. ``raw`` is the layout of files without a header.

    Raises
    ------
    InputError
        If a name is missing or a pattern fits no file.
    """
    found: list[Path] = []
    for text in patterns:
        if not any(c in text for c in "*?[") or (base / text).is_file():
            found.append(find_file(base, text, where))
            continue
        fitting = _glob(base, text.replace("\\", "/"), where)
        if not fitting:
            raise InputError(
                f"pattern '{text}' matches no file", where=where, remedy="check it; it is relative to the folder of the manifest"
            )
        found += fitting
    return tuple(frame for path in found for frame in frames_of(path, raw))


def _glob(base: Path, pattern: str, where: str) -> list[Path]:
    either_case = "".join(f"[{c.lower()}{c.upper()}]" if c.isalpha() else c for c in pattern)
    for text in (pattern, either_case) if "[" not in pattern else (pattern,):
        try:
            fitting = [path for path in base.glob(text) if path.is_file()]
        except (OSError, ValueError, NotImplementedError):
            raise InputError(
                f"pattern '{pattern}' cannot be used", where=where, allowed="a pattern relative to the folder of the manifest"
            ) from None
        if fitting:
            return sorted(fitting, key=natural)
    return []


def natural(path: Path) -> list[tuple[int, str]]:
    """Key by which names sort as people count: frame 10 comes behind frame 9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", path.as_posix())]
