"""Result files that appear all together and whole, or not at all."""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pixmetry.core.errors import InputError

LARGEST_BYTES = 1 << 28  # no result is larger


@dataclass(frozen=True)
class Output:
    """Name of a result file, and the pattern that every earlier result of its kind begins with: nothing else is replaced."""

    path: Path
    mark: re.Pattern[bytes]


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
    read = {Path(os.path.realpath(path)) for path in inputs}
    for output in outputs:
        real = Path(os.path.realpath(output.path))
        if real in seen:
            raise InputError("one file for two results", where=str(output.path), remedy="give each its own name")
        seen.add(real)
        if real in read:
            raise InputError("would overwrite an input", where=str(output.path), remedy="choose another name")
        _check_one(real, output)


def _check_one(real: Path, output: Output) -> None:
    folder, where = real.parent, str(output.path)
    try:
        if real.is_dir():
            raise InputError("is a folder, not a file", where=where, remedy="name the file in it")
        if not folder.is_dir():
            raise InputError("the folder does not exist", where=where, value=str(output.path.parent), remedy="make it, or choose another")
        if not os.access(folder, os.W_OK | os.X_OK):
            raise InputError("the folder cannot be written to", where=where, remedy="choose another")
        if real.exists() and not (real.is_file() and _is_earlier(real, output.mark)):
            raise InputError("file exists and is no result of this kind", where=where, remedy="choose another name")
    except OSError as problem:
        raise InputError("file cannot be written", where=where, value=problem.strerror, remedy="choose another place") from None


def _is_earlier(path: Path, mark: re.Pattern[bytes]) -> bool:
    if path.stat().st_size > LARGEST_BYTES:
        return False
    raw = path.read_bytes()
    return not raw.strip() or mark.match(raw) is not None


def write_together(outputs: Sequence[Output], contents: Sequence[bytes], inputs: Iterable[Path] = ()) -> None:
    """Write files so that all of them appear whole, or none.

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
    tag = f"partial-{os.getpid()}-{secrets.token_hex(4)}"
    real = [Path(os.path.realpath(output.path)) for output in outputs]
    partial = [path.with_name(f".{path.name}.{tag}") for path in real]
    try:
        for path, raw in zip(partial, contents, strict=True):
            path.write_bytes(raw)
        for written, path in zip(partial, real, strict=True):
            os.replace(written, path)
    except OSError as problem:
        name = str(outputs[0].path.parent)
        raise InputError("files cannot be written", where=name, value=problem.strerror, remedy="choose another place") from None
    finally:
        for written in partial:
            written.unlink(missing_ok=True)
