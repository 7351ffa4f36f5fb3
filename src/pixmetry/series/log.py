"""The log of a series: a line for each frame, on the disk before the next one is worked on, so that a run that was killed goes on."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from pixmetry.core.door import read_bytes
from pixmetry.core.errors import InputError
from pixmetry.files.strict_json import plain
from pixmetry.series.track import FrameTargets

LOG_SCHEMA = "pixmetry/series-log/1"


class SeriesLog:
    """Targets of the frames so far, in a file of JSON lines.

    Parameters
    ----------
    path : Path, optional
        Made if it does not exist; else the frames in it are taken over. Without one nothing is written.
    options : mapping
        What the positions depend on. A log that was begun with others is refused.

    Raises
    ------
    InputError
        If it cannot be written, is no log, or was begun with other options.
    """

    def __init__(self, path: Path | None = None, options: Mapping[str, Any] | None = None) -> None:
        self.done: dict[str, FrameTargets] = {}
        self.shape: tuple[int, int] | None = None
        self.texture_of = ""  # the frame that chose the places of a texture; none where targets are found
        self._file: BinaryIO | None = None
        if path is None:
            return
        self.path = path
        self.written_s = path.stat().st_mtime if path.exists() else 0.0  # when the last run wrote it
        head = {"schema": LOG_SCHEMA, "options": plain(dict(options or {}))}
        whole = self._read(head) if path.exists() and path.stat().st_size else 0
        try:
            self._file = path.open("r+b" if whole else "wb")
            self._file.truncate(whole)  # a line that was cut off when a run was killed
            self._file.seek(whole)
            if not whole:
                self._write(head)
        except OSError as problem:
            raise InputError("the log cannot be written", where=str(path), value=problem.strerror, remedy="choose another folder") from None

    def _read(self, head: Mapping[str, Any]) -> int:
        """Take over the frames of an earlier run; return how many bytes of it are whole lines."""
        remedy = "choose another output, or delete it to begin anew"
        raw = read_bytes(self.path)
        lines = raw.splitlines(keepends=True)
        if not lines[-1].endswith(b"\n"):
            lines = lines[:-1]
        if not lines and not raw.startswith(b'{"schema": "pixmetry/'):
            raise InputError("not a log of a series", where=str(self.path), remedy=remedy)
        for number, line in enumerate(lines):
            try:
                record = json.loads(line)
                if number == 0:
                    known = record["schema"] == LOG_SCHEMA
                elif "rows" in record:
                    self.shape, self.texture_of = (int(record["rows"]), int(record["cols"])), str(record.get("texture_of", ""))
                    if self.texture_of:  # chosen anew: the places of the frames before are others
                        self.done.clear()
                    continue
                else:
                    found = FrameTargets.from_record(record)
                    self.done[found.name] = found
                    continue
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
                raise InputError(f"line {number + 1} is no line of a log", where=str(self.path), remedy=remedy) from None
            if not known:
                raise InputError("not a log of a series", where=str(self.path), remedy=remedy)
            if record["options"] != head["options"]:
                raise InputError("the log was begun with other options", where=str(self.path), value=record["options"], remedy=remedy)
        return sum(len(line) for line in lines)

    def put_shape(self, shape: tuple[int, int], *, texture_of: str) -> None:
        """Note the size of the frames, and which of them chose the places of a texture."""
        if (self.shape, self.texture_of) != (shape, texture_of):
            self.shape, self.texture_of = shape, texture_of
            self._write({"rows": shape[0], "cols": shape[1], "texture_of": texture_of})

    def put(self, found: FrameTargets) -> None:
        """Add a frame; it is on the disk when this returns."""
        self.done[found.name] = found
        self._write(found.to_record())

    def forget(self, name: str) -> None:
        """Forget a frame that was taken anew; all of them where it chose the places of a texture."""
        if name == self.texture_of:
            self.done.clear()
            self.texture_of = ""
        self.done.pop(name, None)

    def _write(self, record: Mapping[str, Any]) -> None:
        if self._file is not None:
            self._file.write(json.dumps(record).encode() + b"\n")
            self._file.flush()
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
