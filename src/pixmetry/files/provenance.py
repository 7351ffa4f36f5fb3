"""Where a result comes from: versions, command, time, and the digests of all files that went in."""

from __future__ import annotations

import hashlib
import platform
import re
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from pixmetry import __version__
from pixmetry.core.door import read_bytes

PROVENANCE_SCHEMA = "pixmetry/provenance/1"


class InputHashes:
    """Digests of input files, named relative to a base folder; a file elsewhere is named without its folder.

    Parameters
    ----------
    base : Path
        Folder of the manifest.
    """

    def __init__(self, base: Path) -> None:
        self.base = Path(base)
        self._records: dict[Path, tuple[str, int]] = {}

    def add(self, path: Path, sha256: str, size_bytes: int) -> None:
        """Take note of one file."""
        self._records[Path(path)] = (sha256, size_bytes)

    def add_file(self, path: Path) -> None:
        """Read a small file, such as a manifest, and take note of it."""
        raw = read_bytes(path)
        self.add(path, hashlib.sha256(raw).hexdigest(), len(raw))

    def _name(self, path: Path) -> str:
        try:
            return path.relative_to(self.base).as_posix()
        except ValueError:
            return path.name

    def __len__(self) -> int:
        return len(self._records)

    def records(self) -> list[dict[str, Any]]:
        """Return one plain record a file (name, sha256, size_bytes), sorted by name."""
        named = sorted((self._name(path), *digest) for path, digest in self._records.items())
        return [{"name": name, "sha256": sha256, "size_bytes": size} for name, sha256, size in named]


def provenance_record(
    inputs: InputHashes | None = None,
    *,
    command: Sequence[str] | None = None,
    seed: int | None = None,
    libraries: Sequence[str] = ("numpy",),
) -> dict[str, Any]:
    """Return the record that is stored with a result; it names no folder of the machine.

    Parameters
    ----------
    inputs : InputHashes, optional
    command : sequence of str, optional
        Default: this process's command line. Folders are taken out of its arguments.
    seed : int, optional
        The seed of random numbers, where some were drawn.
    libraries : sequence of str
        Installed packages whose versions are recorded.
    """
    return {
        "schema": PROVENANCE_SCHEMA,
        "pixmetry": __version__,
        "python": platform.python_version(),
        "libraries": {name: _version(name) for name in libraries},
        "platform": f"{platform.system()} {platform.machine()}",
        "time_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": [_without_folder(part) for part in (sys.argv if command is None else command)],
        "seed": seed,
        "inputs": [] if inputs is None else inputs.records(),
    }


@cache
def _version(name: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:  # the same library under another name
        return "not installed"


def _without_folder(argument: str) -> str:
    """Keep the last name of a path, also in ``--option=path``."""
    option, equals, value = argument.rpartition("=") if argument.startswith("-") else ("", "", argument)
    return option + equals + re.split(r"[/\\]", value.rstrip("/\\"))[-1]
