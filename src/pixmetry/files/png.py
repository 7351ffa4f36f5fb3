"""PNG files, and a fast way for those that cameras' frames are kept in: grey, 8 or 16 bits, not interlaced.

Most of the time of decoding goes into inflating; libdeflate does it in half the time of zlib, which PNG libraries use.
"""

from __future__ import annotations

import struct
import threading
import zlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pixmetry.files._png_kernels import join_bytes, undo_filters

SIGNATURE = b"\x89PNG\r\n\x1a\n"
MAX_RATIO = 1032  # of inflated to deflated bytes; more is not possible


PALETTE = 3  # colour type
_CHANNELS = {0: 1, 2: 3, PALETTE: 3, 4: 2, 6: 4}  # of a colour type, decoded


class PngHead(NamedTuple):
    """What a PNG says of itself."""

    cols: int
    rows: int
    depth: int
    colour: int
    transparent: bool  # pixels of some value or palette entry

    @property
    def decoded_bytes(self) -> int:
        """Memory that the image takes."""
        return self.rows * self.cols * (_CHANNELS[self.colour] + self.transparent) * (2 if self.depth == 16 else 1)


def png_head(raw: bytes) -> PngHead:
    """Go through all chunks of a PNG (ISO/IEC 15948) and compare their checksums.

    Raises
    ------
    ValueError
        If it is damaged or cut off, or promises more pixels than its data can hold.
    """
    at, head, transparent, data = len(SIGNATURE), None, False, 0
    while True:
        if at + 12 > len(raw):
            raise ValueError("end of the image is missing")
        length, kind = struct.unpack_from(">I4s", raw, at)
        end = at + 8 + length
        if end + 4 > len(raw):
            raise ValueError("end of the image is missing")
        if zlib.crc32(memoryview(raw)[at + 4 : end]) != int.from_bytes(raw[end : end + 4], "big"):
            raise ValueError(f"checksum of {kind.decode('latin-1')!r} is wrong")
        if kind == b"IHDR":
            if head is not None or length != 13:
                raise ValueError("the header is damaged")
            head = struct.unpack_from(">IIBB", raw, at + 8)
        elif kind == b"IDAT":
            data += length
        elif kind == b"IEND":
            break
        transparent = transparent or kind == b"tRNS"
        at = end + 4
    if head is None or not data:
        raise ValueError("it contains no image")
    cols, rows, depth, colour = head
    if not (cols and rows) or colour not in _CHANNELS or depth not in (1, 2, 4, 8, 16):
        raise ValueError("the header is damaged")
    samples = {0: 1, 2: 3, PALETTE: 1, 4: 2, 6: 4}[colour]
    if rows * -(-cols * depth * samples // 8) > MAX_RATIO * data:
        raise ValueError(f"{data} bytes cannot hold {cols} x {rows} pixels")
    return PngHead(cols, rows, depth, colour, transparent)


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
