"""The log of a capture: a line for every frame and fault, on the disk before the next frame is asked for."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from pixmetry.core.errors import InputError

LOG_SCHEMA = "pixmetry/capture-log/1"
NAME = "capture.jsonl"
REMEDY = "choose another folder, or delete this one to begin anew"


class CaptureLog:
    """What was taken so far, in a file of JSON lines that only grows.

    Parameters
    ----------
    folder : Path
        Made if it is not there. With the log of an earlier run that run goes on.
    head : mapping
        What the frames depend on: camera and steps. A log that was begun with another one is refused.

    Attributes
    ----------
    frames : dict of list
        Records of the good frames, by the number of their step.
    faults : dict of Counter
        How many were missed, damaged and doubled, by the number of the step.
    facts : dict of dict
        What became known of each step: exposure time, extra frames, answers.
    runs : int
        How often it was begun.

    Raises
    ------
    InputError
        If it cannot be written, is no log, was begun with another head, or another process is at it.
    """

    def __init__(self, folder: Path, head: Mapping[str, Any]) -> None:
        self.path = folder / NAME
        self.frames: dict[int, list[dict[str, Any]]] = {}
        self.faults: dict[int, Counter[str]] = {}
        self.facts: dict[int, dict[str, Any]] = {}
        self.runs = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file: BinaryIO = self.path.open("a+b")
        except OSError as problem:
            raise InputError("the log cannot be written", where=str(self.path), value=problem.strerror, remedy=REMEDY) from None
        try:
            self._lock()
            whole = self._read({"schema": LOG_SCHEMA, **json.loads(json.dumps(head))})
            self._file.truncate(whole)  # a line that was cut off when a run was killed
        except BaseException:
            self._file.close()
            raise
        if not whole:
            self.put({"schema": LOG_SCHEMA, **head})
        self.runs += 1
        self.put({"run": self.runs})

    def _lock(self) -> None:
        """Keep other processes out as long as this one lives, where the system can."""
        try:
            import fcntl
        except ImportError:
            return
        try:
            fcntl.flock(self._file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError("another process is taking frames into this folder", where=str(self.path), remedy="wait for its end") from None

    def _read(self, head: Mapping[str, Any]) -> int:
        """Take over an earlier run; return how many bytes of the log are whole lines."""
        self._file.seek(0)
        lines = self._file.read().splitlines(keepends=True)
        if lines and not lines[-1].endswith(b"\n"):
            if len(lines) == 1 and not lines[0].startswith(b'{"schema": "pixmetry/'[: len(lines[0])]):
                raise InputError("not a log of a capture", where=str(self.path), remedy=REMEDY)
            lines = lines[:-1]
        for number, line in enumerate(lines, start=1):
            try:
                record = json.loads(line)
                known = record["schema"] == LOG_SCHEMA if number == 1 else self._take(record)
            except (ValueError, KeyError, TypeError):
                known = False
            if not known:
                what = "not a log of a capture" if number == 1 else f"line {number} is no line of a log"
                raise InputError(what, where=str(self.path), remedy=REMEDY)
            if number == 1 and record != head:
                other = next(key for key in {**head, **record} if head.get(key) != record.get(key))
                what = f"the capture was begun with another {other}"
                raise InputError(what, where=str(self.path), remedy="give the options it was begun with, or another folder")
        return sum(map(len, lines))

    def _take(self, record: dict[str, Any]) -> bool:
        if "run" in record:
            self.runs = int(record["run"])
            return True
        step = int(record["step"])
        if "frame" in record:
            self.frames.setdefault(step, []).append(record)
        elif "fault" in record:
            self.faults.setdefault(step, Counter())[str(record["fault"])] += int(record["count"])
        else:
            self.facts.setdefault(step, {}).update(record["facts"])
        return True

    def put(self, record: Mapping[str, Any]) -> None:
        """Add a record; it is on the disk when this returns."""
        self._file.write(json.dumps(record).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def put_frame(self, step: int, name: str, **told: Any) -> None:
        """Note a good frame, whose file is on the disk."""
        self._put_of({"step": step, "frame": name, **told})

    def put_fault(self, step: int, fault: str, count: int, why: str) -> None:
        """Note frames that were missed, or one that was damaged or doubled."""
        self._put_of({"step": step, "fault": fault, "count": count, "why": why})

    def put_facts(self, step: int, **facts: Any) -> None:
        """Note what became known of a step."""
        self._put_of({"step": step, "facts": facts})

    def _put_of(self, record: dict[str, Any]) -> None:
        self.put(record)
        self._take(record)

    def close(self) -> None:
        """Close the file."""
        with suppress(OSError):
            self._file.close()
