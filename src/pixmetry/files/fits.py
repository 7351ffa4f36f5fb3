"""FITS images (FITS Standard 4.0): the primary array and image extensions, planes of a cube as frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from pixmetry.core.door import check_frames
from pixmetry.core.errors import InputError

SIGNATURE = b"SIMPLE  ="
BLOCK = 2880
_TYPES = {8: "u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}
MOST_CARDS = 100_000  # of one header; a loop through garbage ends here

Read = Callable[[int, int], bytes]


@dataclass(frozen=True)
class Plane:
    """One image of a FITS file: where it lies, and how its numbers are meant."""

    offset: int
    rows: int
    cols: int
    bitpix: int
    scale: float
    zero: float
    blank: int | None
    bottom_up: bool

    @property
    def stored_bytes(self) -> int:
        """Length in the file."""
        return self.rows * self.cols * abs(self.bitpix) // 8

    def decode(self, raw: bytes) -> np.ndarray:
        """Values of the plane; rows in the order of the file, the first on top, unless ROWORDER says that the file begins below.

        Returns
        -------
        ndarray, shape (rows, cols)
            uint8 or uint16 where the numbers are whole and fit, else float64, or float32 as stored. A pixel without a value is refused
            in a whole-number image, and NaN in the others.
        """
        stored = np.frombuffer(raw, _TYPES[self.bitpix]).reshape(self.rows, self.cols)
        if self.blank is not None and (stored == self.blank).any():
            remedy = "fill them, or export the frame again"
            raise InputError("pixels without a value (BLANK)", allowed="a value in every pixel", remedy=remedy)
        stored = stored[::-1] if self.bottom_up else stored
        if self.bitpix > 0 and self.scale == 1 and float(self.zero).is_integer():
            wide = np.uint8 if self.bitpix == 8 and self.zero == 0 else np.uint16
            low, high = int(stored.min()) + int(self.zero), int(stored.max()) + int(self.zero)
            if low >= 0 and high <= np.iinfo(wide).max:
                return (stored.astype(np.int64) + int(self.zero)).astype(wide)
        if self.scale == 1 and self.zero == 0 and self.bitpix < 0:
            return stored.astype(stored.dtype.newbyteorder("="))
        return stored * self.scale + self.zero


def planes(read: Read, size: int) -> list[Plane]:
    """Find all images of a FITS file.

    Parameters
    ----------
    read : callable (offset, count) -> bytes
    size : int
        Of the file.

    Raises
    ------
    ValueError
        If a header is damaged or data are cut off.
    InputError
        If there is no image, or it is compressed.
    """
    found: list[Plane] = []
    at = 0
    while at < size:
        header, start = _header(read, at, size)
        if header is None:  # special records after the last unit, or padding
            break
        axes = [_whole(header, f"NAXIS{k + 1}") for k in range(_whole(header, "NAXIS"))]
        bitpix = _whole(header, "BITPIX")
        if bitpix not in _TYPES or any(n < 0 for n in axes):
            raise ValueError(f"BITPIX = {bitpix} with axes {axes}")
        groups = _whole(header, "GCOUNT", 1) * (math.prod(axes) + _whole(header, "PCOUNT", 0)) if axes else 0
        length = abs(bitpix) // 8 * groups
        if start + length > size:
            raise ValueError("pixel data are missing")
        if header.get("ZIMAGE") is True:
            remedy = "unpack it (funpack), or store it as TIFF or PNG"
            raise InputError("a FITS image that is compressed in tiles", allowed="FITS without compression", remedy=remedy)
        if header.get("SIMPLE") is True or header.get("XTENSION") == "IMAGE":
            found += _planes_of(header, axes, bitpix, start)
        at = start + -(-length // BLOCK) * BLOCK
    if not found:
        raise InputError("a FITS file without an image", allowed="an image of two axes, or a cube of them", remedy="check the file")
    return found


def header_of(read: Read, size: int) -> dict[str, object]:
    """Keywords of the first header, by name; ValueError if it is damaged."""
    return _header(read, 0, size)[0] or {}


def _planes_of(header: dict[str, object], axes: list[int], bitpix: int, start: int) -> Iterator[Plane]:
    while len(axes) > 2 and axes[-1] == 1:
        axes = axes[:-1]
    if len(axes) < 2 or 0 in axes:
        return
    if len(axes) > 3:
        raise InputError(f"a FITS image with {len(axes)} axes", allowed="two, or three: a cube of frames", remedy="store frames one by one")
    cols, rows = axes[:2]
    scale, zero = (_number(header, name, default) for name, default in (("BSCALE", 1.0), ("BZERO", 0.0)))
    blank = _whole(header, "BLANK") if "BLANK" in header and bitpix > 0 else None
    bottom_up = str(header.get("ROWORDER", "")).upper() == "BOTTOM-UP"
    check_frames(axes[-1] if len(axes) == 3 else 1)
    for k in range(axes[2] if len(axes) == 3 else 1):
        yield Plane(start + k * rows * cols * abs(bitpix) // 8, rows, cols, bitpix, scale, zero, blank, bottom_up)


def _header(read: Read, at: int, size: int) -> tuple[dict[str, object] | None, int]:
    """Keywords of the header that begins there, and where its data begin."""
    values: dict[str, object] = {}
    for k in range(MOST_CARDS):
        if k % 36 == 0:
            block = read(at + k * 80, BLOCK)
            if k == 0 and not block.startswith((SIGNATURE, b"XTENSION=")):
                if at == 0:
                    raise ValueError("the header is damaged")
                return None, size
            if len(block) < BLOCK:
                raise ValueError("the header is cut off")
        card = block[k % 36 * 80 : k % 36 * 80 + 80]
        name = card[:8].rstrip().decode("latin-1")
        if name == "END":
            return values, at + (k // 36 + 1) * BLOCK
        if card[8:10] == b"= ":
            values.setdefault(name, _value(card[10:].decode("latin-1")))
    raise ValueError("the header has no end")


def _value(text: str) -> object:
    text = text.strip()
    if text.startswith("'"):
        return text[1:].split("'")[0].rstrip()
    text = text.split("/")[0].strip()
    if text in ("T", "F"):
        return text == "T"
    try:
        return int(text)
    except ValueError:
        pass
    try:
        return float(text.upper().replace("D", "E"))
    except ValueError:
        return text


def _whole(header: dict[str, object], name: str, default: int | None = None) -> int:
    value = header.get(name, default)
    if not isinstance(value, int) or isinstance(value, bool) or abs(value) > 1 << 48:
        raise ValueError(f"{name} is {'missing' if value is None else value!r}")
    return value


def _number(header: dict[str, object], name: str, default: float) -> float:
    value = header.get(name, default)
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise ValueError(f"{name} is {value!r}")
    return float(value)
