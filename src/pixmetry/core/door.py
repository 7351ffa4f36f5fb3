"""The door for every file that comes in: what it may hold is limited before it is decoded, and what a library makes of it is one sentence.

Limits are far above what cameras and campaigns need. They are there for files that are damaged, or made to exhaust the machine.
"""

from __future__ import annotations

import io
import os
import stat
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pixmetry.core.errors import InputError, PixmetryError
from pixmetry.core.memory import check_memory

MOST_SETTINGS_BYTES = 1 << 23  # of YAML: a manifest that names 200 000 frames one by one
MOST_TEXT_BYTES = 1 << 30  # of tables, JSON and XML: some 10 million rows
MOST_PIXELS = 1 << 30  # of one frame: 32768 x 32768
MOST_OF_CAMERA = 1 << 36  # of a simulated sensor, which may be seen through windows
MOST_FRAMES = 1_000_000  # in one file or store
MOST_DEPTH = 64  # of lists and records in each other
MOST_NODES = 4_000_000  # values in a file of settings, each alias counted as what it stands for
MOST_ARRAYS_BYTES = 1 << 36  # of all arrays in one store of maps


def read_bytes(path: str | Path, most_bytes: int = MOST_TEXT_BYTES, *, remedy: str = "check the path") -> bytes:
    """Read a file whole, if it is a file and not larger than what is meant can be.

    Parameters
    ----------
    path : path
    most_bytes : int
    remedy : str
        What to do where the file cannot be read.

    Raises
    ------
    InputError
        If it cannot be read, is a folder, a pipe or a device (which may have no end), or too large.

    Examples
    --------
    >>> Path("a.txt").write_bytes(b"12")
    2
    >>> read_bytes("a.txt")
    b'12'
    """
    try:
        with open_file(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size <= most_bytes:
                check_memory(size, "the file", where=str(path), remedy="check that it is the right file")
                raw: bytes = file.read(size + 1)  # it may grow while it is read
                size = len(raw)
            if size > most_bytes:
                allowed = f"up to {most_bytes >> 20} MiB"
                raise InputError(
                    f"a file of {size >> 20} MiB is too large for this", where=str(path), allowed=allowed, remedy="check the file"
                )
    except ValueError as problem:
        if isinstance(problem, PixmetryError):
            raise
        raise InputError("not a name of a file", value=str(path), remedy=remedy) from None  # a name with a zero byte
    except OSError as problem:
        raise InputError("file cannot be read", where=str(path), value=problem.strerror or str(problem), remedy=remedy) from None
    return raw


def open_file(path: str | Path) -> io.BufferedReader:
    """Open a regular file for reading, without waiting for the other end of a pipe.

    Raises
    ------
    OSError
        As of `open`.
    InputError
        If it is a pipe, a socket or a device.
    """
    file = open(path, "rb", opener=_without_waiting)  # noqa: SIM115
    kind = os.fstat(file.fileno()).st_mode
    if not stat.S_ISREG(kind):
        file.close()
        raise InputError("is a pipe, a socket or a device, not a file", where=str(path), remedy="name a file")
    return file


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


@contextmanager
def one_sentence(what: str, where: str, *, allowed: str = "", remedy: str = "check the file") -> Iterator[None]:
    """Turn any failure of a library that decodes a file into one `InputError`; errors of pixmetry pass as they are.

    Parameters
    ----------
    what, where, allowed, remedy : str
        Of the error: what is wrong, the file, what it could hold, what to do.
    """
    try:
        yield
    except PixmetryError:
        raise
    except MemoryError:
        raise InputError("needs more memory than is available", where=where, remedy=remedy) from None
    except RecursionError:
        raise InputError(f"{what} (nested too deep)", where=where, allowed=allowed, remedy=remedy) from None
    except Exception as problem:  # every library has its own, and all of them mean that the file is not what it should be
        lines = str(problem).splitlines()
        reason = lines[0][:160] if lines and lines[0] else type(problem).__name__
        reason = f"{reason} is missing" if isinstance(problem, KeyError) else reason
        raise InputError(f"{what} ({reason})", where=where, allowed=allowed, remedy=remedy) from None


def check_depth(value: Any, where: str, most: int = MOST_DEPTH) -> None:
    """Refuse lists and records that lie deeper in each other than any of pixmetry's do.

    Raises
    ------
    InputError
    """
    level = [value] if isinstance(value, Mapping | list) else []
    for _ in range(most):
        if not level:
            return
        inner: list[Any] = []
        for part in level:
            inner += (v for v in (part.values() if isinstance(part, Mapping) else part) if isinstance(v, dict | list))
        level = inner
    if level:
        raise InputError("nested too deep", where=where, allowed=f"up to {most} levels", remedy="check the file")


def check_pixels(cols: int, rows: int, where: str = "", most: int = MOST_PIXELS) -> None:
    """Refuse the size of an image that no sensor has.

    Raises
    ------
    InputError
    """
    if cols * rows > most:
        what = f"an image of {cols} x {rows} pixels"
        raise InputError(what, where=where, allowed=f"up to {most} pixels", remedy="check the file, or cut the image into parts")


def check_frames(count: int, where: str = "") -> None:
    """Refuse more frames in one file or store than are worked on.

    Raises
    ------
    InputError
    """
    if count > MOST_FRAMES:
        remedy = "check the file, or divide it"
        raise InputError(f"a file of {count} frames", where=where, allowed=f"up to {MOST_FRAMES}", remedy=remedy)


def check_archive(path: str | Path) -> None:
    """Refuse a zip archive whose parts would fill the memory, or whose listing is damaged.

    Raises
    ------
    InputError, zipfile.BadZipFile
    """
    with open_file(path) as file, zipfile.ZipFile(file) as archive:
        parts = archive.infolist()
    check_frames(len(parts), str(path))
    needed = sum(part.file_size for part in parts)
    if needed > MOST_ARRAYS_BYTES:
        raise InputError(f"holds {needed >> 20} MiB when unpacked", where=str(path), allowed=f"up to {MOST_ARRAYS_BYTES >> 20} MiB")
    check_memory(needed, "the content of the archive", where=str(path), remedy="check that it is the right file")


def inflated(raw: bytes, most_bytes: int) -> bytes:
    """Unpack a zlib stream that must not be longer than so many bytes.

    Raises
    ------
    ValueError
        If it is longer, cut off or damaged.
    """
    unpacker = zlib.decompressobj()
    try:
        out = unpacker.decompress(raw, most_bytes + 1)
    except zlib.error as problem:
        raise ValueError(str(problem)) from None
    if len(out) > most_bytes:
        raise ValueError(f"more than {most_bytes} bytes when unpacked")
    if not unpacker.eof:
        raise ValueError("packed values are cut off")
    return out
