"""BMP files as cameras' programs write them: 8, 24 or 32 bits, not compressed."""

from __future__ import annotations

import struct

import numpy as np

from pixmetry.core.errors import InputError

SIGNATURE = b"BM"


def decode_bmp(raw: bytes) -> np.ndarray:
    """Decode a BMP.

    Returns
    -------
    ndarray of uint8, shape (rows, cols) or (rows, cols, 3)
        Grey where the palette is grey: the values of the palette, red first where it is in colour. The first row is the top.

    Raises
    ------
    ValueError, struct.error
        If it is damaged or cut off.
    InputError
        If it is of another kind.
    """
    start, header = struct.unpack_from("<I", raw, 10)[0], struct.unpack_from("<I", raw, 14)[0]
    if header < 40:
        raise _other(f"a header of {header} bytes")
    cols, rows, _, depth, coder = struct.unpack_from("<iiHHI", raw, 18)
    if coder not in (0, 3) or depth not in (8, 24, 32) or (coder == 3 and depth != 32):
        raise _other(f"{depth} bits, compression {coder}")
    if coder == 3 and struct.unpack_from("<III", raw, 54) != (0xFF0000, 0xFF00, 0xFF):
        raise _other("colours in other bits than usual")
    if cols <= 0 or rows == 0:
        raise ValueError(f"a size of {cols} x {rows} pixels")
    width = -(-cols * depth // 32) * 4
    if start + width * abs(rows) > len(raw):
        raise ValueError("pixel data are missing")
    lines = np.frombuffer(raw, np.uint8, width * abs(rows), start).reshape(abs(rows), width)[:, : cols * depth // 8]
    lines = lines if rows < 0 else lines[::-1]  # stored from the bottom, unless the height is negative
    if depth > 8:
        return np.ascontiguousarray(lines.reshape(abs(rows), cols, depth // 8)[:, :, 2::-1])
    used = struct.unpack_from("<I", raw, 46)[0] or 256
    if used > 256:
        raise ValueError(f"a palette of {used} colours")
    palette = np.frombuffer(raw, np.uint8, 4 * used, 14 + header).reshape(used, 4)[:, 2::-1]
    if lines.size and lines.max() >= used:
        raise ValueError("a value beyond the palette")
    return palette[:, 0][lines] if (palette == palette[:, :1]).all() else palette[lines]


def _other(what: str) -> InputError:
    allowed = "8, 24 or 32 bits, not compressed"
    return InputError(f"BMP of a kind that is not read ({what})", allowed=allowed, remedy="store it as PNG or TIFF")
