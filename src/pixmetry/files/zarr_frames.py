"""Frames in a Zarr store: ``frames.zarr/7`` names entry 7 of its array ``frames`` [frame, row, column]."""

from __future__ import annotations

import hashlib
import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.core.door import check_frames, check_pixels, one_sentence
from pixmetry.core.errors import InputError
from pixmetry.core.memory import check_memory

ARRAY = "frames"
LOSSLESS = {"bytes", "transpose", "blosc", "zstd", "gzip", "crc32c", "sharding_indexed"}


def is_entry(path: Path) -> bool:
    """Tell whether a path names an entry of a Zarr store that there is."""
    return path.name.isdigit() and path.parent.suffix.lower() == ".zarr" and path.parent.is_dir()


def entries(store: Path) -> list[Path]:
    """Name all frames of a Zarr store; none if the folder is not one."""
    if store.suffix.lower() != ".zarr" or not store.is_dir():
        return []
    return [store / str(i) for i in range(_opened(store).shape[0])]


def read_entry(path: Path) -> tuple[np.ndarray, str, int]:
    """Read one frame, the SHA-256 of its values (row by row, low byte first), and their size in bytes.

    Raises
    ------
    InputError
        If the store holds no such array or entry, or is damaged or incomplete.
    """
    store = path.parent
    frames = _opened(store)
    if int(path.name) >= frames.shape[0]:
        raise InputError("the store has no such frame", where=str(store), value=int(path.name), allowed=f"0 to {frames.shape[0] - 1}")
    try:
        values = np.asarray(frames[int(path.name)])
    except Exception as problem:  # every codec has its own exceptions, and all of them mean a damaged store here
        reason = str(problem).splitlines()[0] if str(problem) else type(problem).__name__
        raise InputError(f"frame is damaged ({reason})", where=str(path), remedy="copy or make the store again") from None
    raw = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()
    return values, hashlib.sha256(raw).hexdigest(), len(raw)


def lossless_store(path: Path) -> bool | None:
    """Whether the coders of an entry's store keep every value; None if one of them is not known."""
    codecs = [codec.to_dict() for codec in _opened(path.parent).metadata.codecs]
    inner = [part for codec in codecs for part in codec.get("configuration", {}).get("codecs", ())]  # of a shard
    return True if {codec["name"] for codec in (*codecs, *inner)} <= LOSSLESS else None


def _opened(store: Path) -> Any:
    try:
        return _frames(store, (store / ARRAY / "zarr.json").stat().st_mtime_ns)
    except OSError:
        raise InputError("no array of frames", where=str(store), allowed=f"a Zarr v3 store with the array {ARRAY!r}") from None


@lru_cache(maxsize=8)
def _frames(store: Path, modified_ns: int) -> Any:
    """Open the array; what is not stored would be read as zeros, so everything must be there."""
    import zarr
    from zarr.storage import LocalStore

    with one_sentence("not a store of frames", str(store), remedy="copy or make the store again"):
        frames = zarr.open_array(LocalStore(store, read_only=True), path=ARRAY, mode="r", zarr_format=3)
        stored = frames.shards or frames.chunks  # files of the store; the last along an axis may reach beyond the frames
        files = math.prod(-(-length // step) for length, step in zip(frames.shape, stored, strict=True))
        complete = frames.nchunks_initialized == files * math.prod(stored) // math.prod(frames.chunks)
    if frames.ndim != 3:
        raise InputError("the array of frames has wrong axes", where=str(store), value=frames.shape, allowed="frame, row, column")
    check_frames(frames.shape[0], str(store))
    check_pixels(frames.shape[2], frames.shape[1], str(store))
    needed = 2 * math.prod(frames.chunks) * frames.dtype.itemsize  # of a shard only the chunks of a frame are read
    check_memory(
        needed, f"a chunk of {frames.chunks} values", where=str(store), remedy="check the store, or make it again with chunks of one frame"
    )
    if not complete:
        raise InputError("frames are missing in the store", where=str(store), remedy="copy or make the store again, empty chunks included")
    return frames
