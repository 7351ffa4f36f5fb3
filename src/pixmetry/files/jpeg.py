"""What a JPEG stream (ITU-T T.81) says of itself before it is decoded: decoders fill what was cut off with grey, without a word."""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

import numpy as np

SIGNATURE = b"\xff\xd8"
_MARKER = re.compile(rb"\xff+[^\x00\xff\xd0-\xd7]", re.DOTALL)  # in coded data: neither a stuffed byte nor a restart
_FRAMES = {0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF}  # SOF0 … SOF15
_LOSSLESS = {0xC3, 0xC7, 0xCB, 0xCF}
_ARITHMETIC = range(0xC9, 0xD0)
_ZIGZAG = sorted(range(64), key=lambda k: (k // 8 + k % 8, (k // 8) if (k // 8 + k % 8) % 2 else (k % 8)))  # T.81, figure A.6
_EXIF = b"Exif\0\0"
ORIENTATION = 0x0112


class JpegFacts(NamedTuple):
    """Size, components and coder of a JPEG, and how it is to be turned for display (EXIF; 1: not at all)."""

    rows: int
    cols: int
    components: int
    bits: int
    lossless: bool
    orientation: int


def jpeg_facts(raw: bytes) -> JpegFacts:
    """Read the markers of a JPEG from its beginning to its end.

    Raises
    ------
    ValueError
        If it is cut off (no EOI after the last scan), has no frame or scan, or fewer coded bits than blocks: a Huffman code of at least
        one bit stands for each block of 8 × 8 pixels, or for each pixel where it is lossless (T.81, F.1.2, G.1.2, H.1.2).
    """
    at, coded, frame, orientation = 2, 0, None, 1
    while True:
        while raw[at : at + 2] == b"\xff\xff":
            at += 1
        if at + 2 > len(raw) or raw[at] != 0xFF:
            raise ValueError("end of the image is missing" if coded or at + 2 > len(raw) else "a marker is missing")
        kind = raw[at + 1]
        if kind == 0xD9:
            break
        if kind == 0x01 or 0xD0 <= kind <= 0xD7:
            at += 2
            continue
        length = int.from_bytes(raw[at + 2 : at + 4], "big")
        body = raw[at + 4 : at + 2 + length]
        if length < 2 or len(body) < length - 2:
            raise ValueError("end of the image is missing")
        if kind in _FRAMES and frame is None:
            if len(body) < 6:
                raise ValueError("the frame header is too short")
            frame = (kind, *struct.unpack_from(">BHHB", body))
        elif kind == 0xE1 and body.startswith(_EXIF):
            orientation = _orientation(body[len(_EXIF) :])
        at += 2 + length
        if kind == 0xDA:
            found = _MARKER.search(raw, at)
            if found is None:
                raise ValueError("end of the image is missing")
            coded += found.start() - at
            at = found.end() - 2
    if frame is None or not coded:
        raise ValueError("it contains no image")
    kind, bits, rows, cols, components = frame
    if not rows or not cols:
        raise ValueError("the size of the image is missing")
    least = rows * cols if kind in _LOSSLESS else -(-rows // 8) * -(-cols // 8)
    if kind not in _ARITHMETIC and 8 * coded < least:
        raise ValueError(f"{coded} bytes cannot hold {cols} x {rows} pixels")
    return JpegFacts(rows, cols, components, bits, kind in _LOSSLESS, orientation)


def _orientation(exif: bytes) -> int:
    """The tag in the first directory of EXIF data; 1 where it is missing or makes no sense."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(exif[:4])
    try:
        (at,) = struct.unpack_from(f"{order}I", exif, 4)
        (count,) = struct.unpack_from(f"{order}H", exif, at)
        for k in range(count):
            tag, kind, _, value = struct.unpack_from(f"{order}HHIH", exif, at + 2 + 12 * k)
            if tag == ORIENTATION and kind == 3:
                return value if 1 <= value <= 8 else 1
    except struct.error:
        pass
    return 1


def luminance_table(raw: bytes) -> tuple[int, ...] | None:
    """Quantiser of the first component, row by row (T.81, B.2.4.1); None where the stream has none."""
    at, tables, first = 2, {}, 0
    while at + 4 <= len(raw) and raw[at] == 0xFF:
        kind, length = raw[at + 1], int.from_bytes(raw[at + 2 : at + 4], "big")
        body = raw[at + 4 : at + 2 + length]
        if kind == 0xDB:
            while body:
                wide, number = body[0] >> 4, body[0] & 15
                size = 64 * (2 if wide else 1)
                if len(body) < 1 + size:
                    return None
                values = struct.unpack_from(">64H" if wide else "64B", body, 1)
                table = [0] * 64
                for place, value in zip(_ZIGZAG, values, strict=True):
                    table[place] = value
                tables[number] = tuple(table)
                body = body[1 + size :]
        elif kind in _FRAMES and len(body) >= 9:
            first = body[8]
        elif kind == 0xDA:
            break
        at += 2 + length
    return tables.get(first)


def luminance_of(raw: bytes) -> np.ndarray:
    """The grey values of a JPEG of 8 bits, of a colour one its luminance as it was coded."""
    import imagecodecs

    image: np.ndarray = imagecodecs.jpeg8_decode(raw, outcolorspace="GRAYSCALE")
    return image if image.ndim == 2 else image[:, :, 0]
