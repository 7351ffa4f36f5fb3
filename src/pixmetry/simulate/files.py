"""What a simulation writes: its frames, one after the other, and their truth: where the targets are, and what every source did."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera
from pixmetry.camera.signal import Signal
from pixmetry.core.errors import InputError
from pixmetry.files.images import write_frame

ENDINGS = {"tiff": ".tif", "png": ".png"}
FORMATS = (*ENDINGS, "zarr")
STORE = "frames.zarr"
TRUTH_SCHEMA = "pixmetry/truth/1"
SCHEDULE = ("time_s", "exposure_s", "temperature_c")


class FrameWriter:
    """Writes frames into a folder.

    Parameters
    ----------
    folder : Path
        It gets an image file for each frame, or ``frames.zarr`` with the one array ``frames`` [frame, row, column] whose chunks are the
        frames, each with a check sum.
    image_format : {"tiff", "png", "zarr"}
    bits : int
        Of a stored value; up to 8 bits are stored as 8, more as 16.
    count : int
        How many frames will come.
    shape : (int, int)
    """

    def __init__(self, folder: Path, image_format: str, bits: int, count: int, shape: tuple[int, int]) -> None:
        self.folder, self.ending, self.bits = folder, ENDINGS.get(image_format), bits
        self._array: Any = None
        self._next = 0
        if self.ending is not None:
            return
        import zarr
        from zarr.codecs import BloscCodec, Crc32cCodec
        from zarr.storage import LocalStore

        group = zarr.create_group(LocalStore(folder / STORE), zarr_format=3)
        dtype = np.dtype(np.uint8 if bits <= 8 else np.uint16)
        codec = BloscCodec(cname="zstd", clevel=5, shuffle="bitshuffle", typesize=dtype.itemsize)
        # an all-black frame is stored like any other, so that a frame that is missing cannot be taken for one
        self._array = group.create_array(
            "frames",
            shape=(count, *shape),
            chunks=(1, *shape),
            dtype=dtype,
            compressors=[codec, Crc32cCodec()],
            dimension_names=("frame", "row", "column"),
            attributes={"bits": bits},
            config={"write_empty_chunks": True},
        )

    def write(self, stem: str, frame: np.ndarray) -> str:
        """Write one frame, shape (rows, cols); return its name relative to the folder (``frames.zarr/7`` is entry 7 of the array)."""
        if self.ending is not None:
            name = f"{stem}{self.ending}"
            write_frame(self.folder / name, frame, self.bits)
            return name
        if frame.size and int(frame.max()) >= 1 << self.bits:
            raise InputError(
                f"values do not fit into {self.bits} bits", where=STORE, value=int(frame.max()), allowed=f"0 to {(1 << self.bits) - 1}"
            )
        self._array[self._next] = frame
        self._next += 1
        return f"{STORE}/{self._next - 1}"


class TruthWriter:
    """Collects the truth frame by frame.

    Parameters
    ----------
    camera : Camera
    seed : int
        Of the exposures.
    count : int
        How many frames will come.
    window : (int, int, int, int), optional
        First row and column, rows and columns of what is written; by default the whole frame.
    store : Path, optional
        If given, what every source did goes into this Zarr v3 group as the frames come; see `close`.
    """

    def __init__(
        self, camera: Camera, seed: int, count: int, window: tuple[int, int, int, int] | None = None, store: Path | None = None
    ) -> None:
        self.camera, self.seed = camera, seed
        self.window = window or (0, 0, *camera.output_shape)
        self.frames: list[dict[str, Any]] = []
        self._targets: list[list[dict[str, Any]]] = []
        self._arrays = None if store is None else _Arrays(store, count)

    def add(self, file: str, scene: Any, signal: Signal, **schedule: Any) -> None:
        """Take note of one frame: the name of its file, the scene, the signal of this frame, and the schedule if it is not the camera's."""
        number = int(signal.grid.frame[0])
        times = {name: float(getattr(signal, name)[0]) for name in SCHEDULE}
        seen = targets_of(scene, times["time_s"] + 0.5 * times["exposure_s"], number)
        targets = self._placed(seen, number, schedule)
        before = self._targets[-1] if self._targets else None
        self._targets.append(before if targets == before else targets)  # targets that stand still are kept once
        if self._arrays is not None:
            self._arrays.add({"frame": number, **times}, targets)
            for name, arrays in self.camera.truth(number, self.seed, **schedule).items():
                for key, value in arrays.items():
                    self._arrays.put(f"sources/{_group_name(name)}/{key}", np.asarray(value))
        self.frames.append({"file": file, "frame": number, **times})

    def _placed(self, seen: Sequence[Mapping[str, Any]], number: int, schedule: Mapping[str, Any]) -> list[dict[str, Any]]:
        """The targets in the written image; their positions in the scene have names with ``scene_``."""
        row0, col0, rows, cols = self.window
        out: list[dict[str, Any]] = [{} for _ in seen]
        for px, py in _places(seen):
            having = [i for i, t in enumerate(seen) if px in t and py in t]
            x, y = (np.array([seen[i][key] for i in having], float) for key in (px, py))
            x, y = self.camera.true_positions(x, y, number, self.seed, **schedule)
            for i, a, b in zip(having, x - col0, y - row0, strict=True):
                found = bool(np.isfinite(a) and np.isfinite(b))
                out[i] |= {px: float(a) if found else None, py: float(b) if found else None}
                if px == "x_px":
                    out[i]["inside"] = bool(found and -0.5 <= a <= cols - 0.5 and -0.5 <= b <= rows - 0.5)
        moved = {name for pair in _places(seen) for name in pair}
        return [o | {f"scene_{k}" if k in moved else k: v for k, v in t.items()} for o, t in zip(out, seen, strict=True)]

    def targets(self) -> list[dict[str, Any]]:
        """Return the targets; a value that changes from frame to frame is a list with one entry per frame."""
        still = all(t is self._targets[0] for t in self._targets)
        if not self._targets or still:
            return self._targets[0] if self._targets else []
        most = max(map(len, self._targets))
        return [_merged([frame[k] if k < len(frame) else {} for frame in self._targets]) for k in range(most)]

    def record(self) -> dict[str, Any]:
        """Return frames and targets for ``truth.json``."""
        row0, col0, rows, cols = self.window
        return {
            "schema": TRUTH_SCHEMA,
            "camera": self.camera.name,
            "seed": self.seed,
            "unit_seed": self.camera.unit_seed,
            "sensor": {"rows": self.camera.frame_shape[0], "cols": self.camera.frame_shape[1]},
            "output": {"rows": self.camera.output_shape[0], "cols": self.camera.output_shape[1]},
            "image": {"row0": row0, "col0": col0, "rows": rows, "cols": cols},
            "targets": self.targets(),
            "frames": self.frames,
        }

    def close(self) -> None:
        """Write the arrays that are equal in all frames, and the description of the store."""
        if self._arrays is not None:
            self._arrays.close({k: v for k, v in self.record().items() if k not in ("targets", "frames")})


def targets_of(scene: Any, time_s: float, frame: int) -> list[dict[str, Any]]:
    """Targets of a scene at a time: records with ``x_px`` and ``y_px`` in the scene's plane; none if it has none."""
    return [dict(t) for t in scene.targets(time_s, frame)] if hasattr(scene, "targets") else []


def _places(seen: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Names of the values that are places: ``x_px`` and ``y_px``, also with something before them (``ellipse_x_px``)."""
    keys = dict.fromkeys(k for target in seen for k in target)
    return [(k, k[:-4] + "y_px") for k in keys if re.search(r"(^|_)x_px$", k) and k[:-4] + "y_px" in keys]


def _merged(entries: list[dict[str, Any]]) -> dict[str, Any]:
    keys = dict.fromkeys(k for entry in entries for k in entry)
    columns = {k: [entry.get(k) for entry in entries] for k in keys}
    return {k: v[0] if all(e == v[0] for e in v) else v for k, v in columns.items()}


def _group_name(name: str) -> str:
    """A name of a source as that of a group: letters, digits, points, dashes."""
    return re.sub(r"[^\w.-]", "_", name).strip("._") or "source"


class _Arrays:
    """A Zarr v3 group with arrays of one entry per frame, written as they come, and arrays of the unit, written once."""

    def __init__(self, store: Path, count: int) -> None:
        import zarr
        from zarr.storage import LocalStore

        self.group = zarr.create_group(LocalStore(store), zarr_format=3)
        self.count, self.at = count, -1
        self.fixed: dict[str, np.ndarray] = {}
        self.changing: dict[str, Any] = {}
        self.columns: dict[str, np.ndarray] = {}

    def add(self, schedule: Mapping[str, Any], targets: Sequence[Mapping[str, Any]]) -> None:
        """Begin the next frame: its schedule, and the places of its targets."""
        self.at += 1
        for key, value in schedule.items():
            self.columns.setdefault(f"frames/{key}", np.zeros(self.count, np.asarray(value).dtype))[self.at] = value
        for px, py in _places(targets):
            for key in (px, py):
                place = np.array([np.nan if t.get(key) is None else t[key] for t in targets], float)
                column = self.columns.setdefault(f"targets/{key}", np.full((self.count, len(place)), np.nan))
                column[self.at, : len(place)] = place[: column.shape[1]]

    def put(self, name: str, value: np.ndarray) -> None:
        """Take one array of this frame: what has a first axis of one frame, or is another than before, changes from frame to frame."""
        of_frame = value.ndim > 0 and value.shape[0] == 1
        if name not in self.changing:
            before = self.fixed.get(name)
            if not of_frame and (before is None and self.at == 0 or before is not None and _equal(before, value)):
                self.fixed[name] = value
                return
            entry = value[0] if of_frame else value
            self.changing[name] = self._create(name, (self.count, *entry.shape), (1, *entry.shape), entry.dtype, "frame")
            if before is not None:
                del self.fixed[name]
                for i in range(self.at):
                    self.changing[name][i] = before
        self.changing[name][self.at] = value[0] if of_frame else value

    def close(self, attributes: Mapping[str, Any]) -> None:
        for name, value in self.columns.items():
            self._create(name, value.shape, value.shape, value.dtype, "frame")[...] = value
        for name, value in self.fixed.items():
            self._create(name, value.shape, value.shape, value.dtype, "unit")[...] = value
        self.group.attrs.update(attributes)

    def _create(self, name: str, shape: tuple[int, ...], chunks: tuple[int, ...], dtype: Any, one_per: str) -> Any:
        chunks = tuple(max(1, c) for c in chunks)
        return self.group.create_array(name, shape=shape, chunks=chunks, dtype=dtype, attributes={"one_per": one_per})


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
