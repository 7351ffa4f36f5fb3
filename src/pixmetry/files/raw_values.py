"""Raw values without a header, in the layouts of GenICam's pixel formats.

By the GenICam Pixel Format Naming Convention (PFNC): ``Mono8``; ``Mono10`` … ``Mono16``, two bytes a pixel, low byte first; ``Mono10p``,
``Mono12p`` …, a stream of bits without gaps in which each pixel begins with its lowest bit. By GigE Vision: ``Mono10Packed`` and
``Mono12Packed``, two pixels in three bytes, the high eight bits of the first, the low bits of both (the first one's in the low half), the
high eight of the second. A mosaic (``BayerRG12p``) is stored as the grey image of its name.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from pixmetry.core.errors import InputError

_FORMAT = re.compile(r"(?:Mono|Bayer(?:RG|GR|GB|BG))(?:(8|10|12|14|16)|(10|12|14)p|(10|12)Packed)")
ALLOWED = "Mono8, Mono10, Mono12, Mono14, Mono16, Mono10p, Mono12p, Mono14p, Mono10Packed, Mono12Packed, and Bayer… for Mono"
_TEXT = re.compile(r"\s*(\d+)\s*[x×]\s*(\d+)\s*:\s*(\w+)\s*(?:\+\s*(\d+)\s*)?")


@dataclass(frozen=True)
class RawLayout:
    """How the values of frames lie in files without a header.

    Parameters
    ----------
    width, height : int
        Columns and rows of a frame.
    pixel_format : str
        Name by GenICam, such as ``"Mono12p"``.
    skip_bytes : int
        Before the first frame of each file.

    Raises
    ------
    InputError
        If a number or the name cannot be used.
    """

    width: int
    height: int
    pixel_format: str
    skip_bytes: int = 0

    def __post_init__(self) -> None:
        if _FORMAT.fullmatch(self.pixel_format) is None:
            raise InputError("no such pixel format", where="pixel_format", value=self.pixel_format, allowed=ALLOWED)
        for name, least in (("width", 1), ("height", 1), ("skip_bytes", 0)):
            if getattr(self, name) < least:
                raise InputError(f"{name} cannot be used", value=getattr(self, name), allowed=f"{least} or more")

    @property
    def _parts(self) -> tuple[int, str]:
        found = _FORMAT.fullmatch(self.pixel_format)
        assert found is not None  # checked when it was made
        plain, stream, packed = found.groups()
        return int(plain or stream or packed), "plain" if plain else "stream" if stream else "packed"

    @property
    def bits(self) -> int:
        """Bits of a value."""
        return self._parts[0]

    @property
    def frame_bytes(self) -> int:
        """Length of a frame."""
        count, (bits, way) = self.width * self.height, self._parts
        if way == "plain":
            return count * (1 if bits == 8 else 2)
        return -(-count * bits // 8) if way == "stream" else -(-count // 2) * 3

    def frames_in(self, size: int) -> int:
        """Number of frames in a file of this size.

        Raises
        ------
        InputError
            If it holds no whole number of them.
        """
        count, rest = divmod(size - self.skip_bytes, self.frame_bytes)
        if count < 1 or rest:
            what = f"a file of {size} bytes does not contain a whole number of frames of {self.width} x {self.height} {self.pixel_format}"
            allowed = f"{self.skip_bytes} + n x {self.frame_bytes} bytes"
            raise InputError(what, allowed=allowed, remedy="correct width, height, pixel_format or skip_bytes, or copy the file again")
        return count

    def decode(self, raw: bytes) -> np.ndarray:
        """Values of one frame from its bytes.

        Returns
        -------
        ndarray, shape (height, width), uint8 or uint16
        """
        count, (bits, way) = self.width * self.height, self._parts
        data = np.frombuffer(raw, np.uint8, self.frame_bytes)
        if way == "plain":
            values = data if bits == 8 else data.view("<u2").astype(np.uint16)
        elif way == "packed":
            values = _packed(data, bits)
        else:
            values = _stream(data, bits)
        return values[:count].reshape(self.height, self.width)


def _packed(data: np.ndarray, bits: int) -> np.ndarray:
    low = bits - 8
    first, both, second = data.reshape(-1, 3).astype(np.uint16).T
    mask = (1 << low) - 1
    return np.stack([first << low | both & mask, second << low | both >> 4 & mask], axis=1).ravel()


def _stream(data: np.ndarray, bits: int) -> np.ndarray:
    """A group of pixels that ends with a byte has ``bits`` bytes of eight pixels, or half or a quarter of that."""
    pixels = 8 // np.gcd(bits, 8)
    width = bits * pixels // 8
    whole = np.zeros(-(-len(data) // width) * width, np.uint8)
    whole[: len(data)] = data
    groups = whole.reshape(-1, width)
    out = np.empty((len(groups), pixels), np.uint16)
    for k in range(pixels):
        byte, shift = divmod(k * bits, 8)
        value = np.zeros(len(groups), np.uint32)
        for j in range(-(-(shift + bits) // 8)):
            value |= groups[:, byte + j].astype(np.uint32) << 8 * j
        out[:, k] = value >> shift & (1 << bits) - 1
    return out.ravel()


def parse_raw(text: str) -> RawLayout:
    """Read ``"1920x1200:Mono12p"``, with ``"+64"`` behind it where 64 bytes are to be skipped.

    Raises
    ------
    InputError
        If it is not of that form.
    """
    found = _TEXT.fullmatch(text)
    if found is None:
        raise InputError("not a layout of raw values", value=text, allowed="WIDTHxHEIGHT:PIXELFORMAT, such as 1920x1200:Mono12p")
    return RawLayout(int(found[1]), int(found[2]), found[3], int(found[4] or 0))


def layout_of(raw: str | RawLayout | None) -> RawLayout | None:
    """The layout of an option ``raw``: a layout is returned unchanged, a text is read by `parse_raw`, None stays None."""
    return parse_raw(raw) if isinstance(raw, str) else raw
