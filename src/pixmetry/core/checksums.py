"""Digests in the record of a result: of the record itself, and of the files that stand beside it.

A record that carries them has the key ``checksums``: ``record`` is the SHA-256 of all its other content, however the JSON is laid
out; ``files`` that of each file by its name relative to the record's folder. A reader that finds another digest refuses the file: a
byte that was lost or changed would else be read as a measured value.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pixmetry.core.door import open_file, read_bytes
from pixmetry.core.errors import InputError

KEY = "checksums"
RECORDS = ("results.json", "calibration.json", ".pixmetry-output.json")  # what may tell the digests of the files beside it
REMEDY = "copy or make the result again; if you changed it on purpose, save it under another name"


def file_sha256(path: str | Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits."""
    with open_file(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def sealed(record: Mapping[str, Any], folder: str | Path = "", files: Iterable[str] = ()) -> dict[str, Any]:
    """A record with its own digest and those of files.

    Parameters
    ----------
    record : mapping
        Plain values, as JSON holds them.
    folder : path
    files : iterable of str
        Names relative to the folder, with slashes.

    Returns
    -------
    dict
    """
    plain = {key: value for key, value in record.items() if key != KEY}
    digests = {name: file_sha256(Path(folder) / name) for name in sorted(files)}
    return plain | {KEY: {"files": digests, "record": _digest(plain | {KEY: digests})}}


def check_record(record: Mapping[str, Any], where: str) -> dict[str, str]:
    """Check a record against its own digest, and return the digests of files; none if it carries no digests.

    Raises
    ------
    InputError
        If something in it has changed since it was written.
    """
    if KEY not in record:
        return {}
    told = record[KEY]
    try:
        files = {str(name): str(digest) for name, digest in told["files"].items()}
        same = told["record"] == _digest({**record, KEY: files})
    except (KeyError, TypeError, AttributeError):
        same = False
    if not same:
        raise InputError("damaged: its content has changed since it was written", where=where, remedy=REMEDY)
    return files


def check_file(path: str | Path, digests: Mapping[str, str] | None = None) -> None:
    """Check a file of a result against the digest in the record that stands beside it; a file that no record names passes.

    Parameters
    ----------
    path : path
    digests : mapping of str, optional
        By name, if the record has been read; by default the records of results in the file's folder are asked.

    Raises
    ------
    InputError
        If the file, or that record, is not as it was written.
    """
    path = Path(path)
    wanted = (_digests_beside(path) if digests is None else digests).get(path.name)
    try:
        same = wanted is None or file_sha256(path) == wanted
    except OSError as problem:
        raise InputError("file cannot be read", where=str(path), value=problem.strerror, remedy="check the path") from None
    if not same:
        raise InputError("damaged: its content has changed since it was written", where=str(path), remedy=REMEDY)


def _digests_beside(path: Path) -> dict[str, str]:
    for name in RECORDS:
        beside = path.with_name(name)
        try:
            record = json.loads(read_bytes(beside))
            ours = str(record["schema"]).startswith("pixmetry/") and KEY in record and beside != path
        except (ValueError, KeyError, TypeError, RecursionError):
            continue  # not there, or somebody else's
        if ours and path.name in (digests := check_record(record, str(beside))):
            return digests
    return {}


def _digest(record: Mapping[str, Any]) -> str:
    text = json.dumps(record, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode("ascii")).hexdigest()
