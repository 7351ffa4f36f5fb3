"""A fast way for the PNG files that cameras' frames are kept in: grey, 8 or 16 bits, not interlaced.

Most of the time of decoding goes into inflating; libdeflate does it in half the time of zlib, which PNG libraries use.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable

import numpy as np

from pixmetry.campaign._png_kernels import join_bytes, undo_filters

SIGNATURE = b"\x89PNG\r\n\x1a\n"
MAX_RATIO = 1032  # of inflated to deflated bytes; more is not possible


class PlainPng:
    """Decodes grey PNG files; the memory for inflated bytes is kept from file to file, one piece for each thread."""

    def __init__(self) -> None:
        self._own = threading.local()

    def decode(self, raw: bytes) -> np.ndarray | None:
        """Decode a file whose checksums are right.

        Returns
        -------
        ndarray, shape (rows, cols), uint8 or uint16
            None if the file is of another kind or damaged: then a complete decoder has to say what it is.
        """
        import imagecodecs

        try:
            parts = _image_data(raw, imagecodecs.deflate_crc32)
            if parts is None:
                return None
            rows, cols, depth, data = parts
            lines = self._memory(rows, 1 + cols * depth // 8, MAX_RATIO * len(data))
            # it compares the checksum of what comes out
            if lines is None or len(imagecodecs.deflate_decode(data, out=lines.reshape(-1).data)) != lines.size:
                return None
        except (struct.error, imagecodecs.DeflateError):
            return None
        if lines[:, 0].any() and not undo_filters(lines, depth // 8):
            return None
        if depth == 8:
            return lines[:, 1:].copy()
        frame = np.empty((rows, cols), np.uint16)
        join_bytes(lines, frame)
        return frame

    def _memory(self, rows: int, width: int, most: int) -> np.ndarray | None:
        if rows * width > most:
            return None
        kept = getattr(self._own, "lines", None)
        if kept is None or kept.shape != (rows, width):
            kept = self._own.lines = np.empty((rows, width), np.uint8)
        return kept


def _image_data(raw: bytes, crc32: Callable[..., int]) -> tuple[int, int, int, bytes] | None:
    """Rows, columns, bits per pixel and the deflated data; None unless the file is plain and whole."""
    view, at, header, parts = memoryview(raw), len(SIGNATURE), None, []
    while True:
        length, kind = struct.unpack_from(">I4s", raw, at)
        end = at + 8 + length
        (checksum,) = struct.unpack_from(">I", raw, end)
        if kind in (b"IHDR", b"IDAT", b"IEND") and crc32(view[at + 4 : end]) != checksum:
            return None
        if kind == b"IHDR":
            header = struct.unpack_from(">IIBBBBB", raw, at + 8)
        elif kind == b"IDAT":
            parts.append(view[at + 8 : end])
        elif kind == b"IEND":
            break
        elif kind == b"tRNS" or not kind[0] & 32:  # transparency; or something that must be understood, such as a palette
            return None
        at = end + 4
    if header is None or not parts:
        return None
    cols, rows, depth, *rest = header
    return (rows, cols, depth, b"".join(parts)) if depth in (8, 16) and rest == [0, 0, 0, 0] and rows and cols else None
