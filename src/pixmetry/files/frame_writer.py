"""Frames on their way to disk, one after the other: an image file each, or one Zarr array for all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.files.images import write_frame

ENDINGS = {"tiff": ".tif", "png": ".png"}
FORMATS = (*ENDINGS, "zarr")
STORE = "frames.zarr"


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
