"""A folder that fills, as a camera: frames of any recorder, taken when they are whole."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from pixmetry.capture.camera import Grabbed
from pixmetry.core.errors import InputError
from pixmetry.files.files import natural
from pixmetry.files.formats import PICTURE_ENDINGS, frames_of
from pixmetry.files.images import load_picture
from pixmetry.files.raw_values import RawLayout
from pixmetry.files.told import counter_of, joined, told_by_file, told_by_name

LOOK_S = 0.05  # from one look into the folder to the next
SETTLED_S = 0.3  # a file that has not changed for so long has been written
DAMAGED_S = 2.0  # one that cannot be read after so long never will be


def _order(path: Path) -> tuple[int, Any]:
    return counter_of(path.stem) or 0, natural(path)


class FolderCamera:
    """A folder into which another program writes frames.

    Parameters
    ----------
    folder : path
    bits : int
        Of a stored value.
    raw : RawLayout, optional
        Of files without a header.
    name, serial_number : str
        Of the camera.

    Notes
    -----
    The last number in a name that is no exposure time is the counter of the frames; they come in its order. Files that are there when a
    run is started belong to no run. A file that cannot be decoded counts as damaged when it has not changed for two seconds.
    """

    sets_exposure = False
    exposure_range_s = (1e-9, 1e6)

    def __init__(self, folder: str | Path, bits: int, *, raw: RawLayout | None = None, name: str = "", serial_number: str = "") -> None:
        self.folder, self.bits, self.raw = Path(folder), bits, raw
        if not self.folder.is_dir():
            raise InputError("no such folder", where=str(folder), remedy="name the folder that the recorder writes into")
        self.name, self.serial_number = name or self.folder.resolve().name, serial_number
        self._done: set[Path] = set()
        self._seen: dict[Path, tuple[tuple[int, int], float]] = {}
        self._ready: list[Grabbed] = []

    def set_exposure(self, exposure_s: float) -> float:
        """Return it as it is: the recorder sets it."""
        return exposure_s

    def start(self) -> None:
        """Begin with the files that come from now on."""
        self._done, self._seen, self._ready = set(self._files()), {}, []

    def stop(self) -> None:
        """End the run."""

    def close(self) -> None:
        """Nothing is held."""

    def frame(self, timeout_s: float) -> Grabbed | None:
        """The next frame, in the order of names; None if no file became whole in time."""
        until = time.monotonic() + timeout_s
        while not self._ready:
            self._look()
            if self._ready:
                break
            if time.monotonic() > until:
                return None
            time.sleep(LOOK_S)
        return self._ready.pop(0)

    def _files(self) -> list[Path]:
        def wanted(path: Path) -> bool:
            return not path.name.startswith(".") and (self.raw is not None or path.suffix.lower() in PICTURE_ENDINGS)

        return sorted((p for p in self.folder.iterdir() if wanted(p) and p.is_file()), key=_order)

    def _look(self) -> None:
        """Take the first file that has come, if it is whole; those behind it wait for it."""
        now = time.monotonic()
        for path in self._files():
            if path in self._done:
                continue
            try:
                stat = path.stat()
            except FileNotFoundError:  # renamed by the recorder
                continue
            state = (stat.st_size, stat.st_mtime_ns)
            if self._seen.get(path, (None, 0.0))[0] != state:
                self._seen[path] = (state, now)
            age = now - self._seen[path][1]
            if age < SETTLED_S:
                return
            frames = self._read(path, stat.st_mtime)
            if all(frame.complete for frame in frames) or age > DAMAGED_S:
                self._done.add(path)
                self._ready += frames
            return

    def _read(self, path: Path, written_s: float) -> list[Grabbed]:
        counted = counter_of(path.stem)
        try:
            parts = frames_of(path, self.raw)
            number = counted if len(parts) == 1 else None
            told = joined(told_by_file(path), told_by_name(path.name))
            time_s = told.taken_s if told.taken_s is not None else written_s
            return [
                Grabbed(load_picture(part, None, self.raw).array, number, time_s, told.temperature_c, told.exposure_s) for part in parts
            ]
        except InputError as problem:
            return [Grabbed(None, counted, written_s, complete=False, why=problem.what)]
