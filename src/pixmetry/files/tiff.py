"""TIFF files, page by page: parsed by tifffile, and every strip or tile that the header promises must be there.

tifffile fills what is missing with zeros and says so in its log; here it is an error.
"""

from __future__ import annotations

import logging
import math
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from pixmetry.core.door import check_frames
from pixmetry.core.errors import InputError
from pixmetry.files.jpeg import jpeg_facts

MARKS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_LOSSLESS = {1, 5, 8, 32773, 32946, 50000, 34925, 34926}  # none, LZW, Deflate, PackBits, Deflate, Zstandard, LZMA
_JPEG = {6, 7, 33007, 34892}
_READ = {0, 1, 2, 3, 6, 32803, 34892}  # photometric: WhiteIsZero, BlackIsZero, RGB, palette, YCbCr (of JPEG), mosaic, raw
_REDUCED, _MASK = 1, 4  # bits of NewSubfileType
_PRIVATE = 32768  # tags from here on are private
_TAG = re.compile(r"TiffTag (\d+)|tag #(\d+)")
_WHO = re.compile(r"^<[^>]*>\s*")

Read = Callable[[int, int], bytes]


class TiffPage(NamedTuple):
    """One image of a TIFF file: where its strips or tiles lie, and how they are decoded."""

    offsets: tuple[int, ...]
    counts: tuple[int, ...]
    decode: Callable[..., Any]
    tables: dict[str, bytes | None]
    shaped: tuple[int, ...]  # samples apart, depth, rows, columns, samples together
    dtype: np.dtype
    bits: int
    photometric: int
    palette: np.ndarray | None
    alpha: bool
    coder: int
    lossless: bool | None
    orientation: int

    @property
    def decoded_bytes(self) -> int:
        """Memory that the image takes."""
        return math.prod(self.shaped) * self.dtype.itemsize

    @property
    def kind(self) -> tuple[Any, ...]:
        """Properties that all frames of a stack must have in common."""
        return self.shaped, self.dtype, self.photometric, self.bits

    def image(self, read: Read) -> np.ndarray:
        """Decode the page.

        Returns
        -------
        ndarray, shape (rows, cols) or (rows, cols, channels)
            White is high, whatever the file says; a palette is looked up; a channel of opacity that is full everywhere is gone.

        Raises
        ------
        ValueError
            If strips are damaged or cut off.
        InputError
            If pixels are transparent.
        """
        out = np.zeros(self.shaped, self.dtype)
        for index, (offset, count) in enumerate(zip(self.offsets, self.counts, strict=True)):
            raw = read(offset, count)
            if self.coder in _JPEG and self.tables.get("jpegheader") is None:
                jpeg_facts(raw)
            part, (s, d, h, w, _), size = self.decode(raw, index, **self.tables)
            part = part[: self.shaped[1] - d, : self.shaped[2] - h, : self.shaped[3] - w]
            out[s, d : d + size[0], h : h + size[1], w : w + size[2]] = part
        image = np.moveaxis(out[:, 0], 0, -2).reshape(*out.shape[2:4], -1)  # samples apart or together
        if self.alpha:
            image = opaque(image)
        if self.photometric == 3:
            image = self._looked_up(image[:, :, 0])
        if image.ndim == 3 and image.shape[2] == 1:
            image = image[:, :, 0]
        if self.photometric == 0:
            if image.dtype.kind != "u":
                raise InputError("WhiteIsZero with values that are not whole numbers", remedy="export the frame again with BlackIsZero")
            image = ((1 << self.bits) - 1) - image
        return image

    def _looked_up(self, index: np.ndarray) -> np.ndarray:
        """Colours of a palette: with 8 bits if this is enough, and as grey values if all colours are grey."""
        colours = self.palette
        if colours is None:
            raise ValueError("the palette is missing")
        if not (colours % 257).any():
            colours = (colours // 257).astype(np.uint8)
        return colours[0][index] if (colours == colours[:1]).all() else np.moveaxis(colours[:, index], 0, -1)


def opaque(image: np.ndarray) -> np.ndarray:
    """An image without its last channel, which is opacity.

    Raises
    ------
    InputError
        If a pixel is not opaque: then its values are not what was seen.
    """
    alpha = image[:, :, -1]
    most = np.iinfo(alpha.dtype).max if alpha.dtype.kind == "u" else 1
    if (alpha != most).any():
        raise InputError("an image with transparent pixels", allowed="opaque pixels", remedy="store the frame without transparency")
    return image[:, :, :-1]


def pages(file: BinaryIO, size: int) -> list[TiffPage]:
    """Parse the directories of a TIFF file; previews and masks beside the images are left out.

    Raises
    ------
    ValueError
        If it is damaged or cut off.
    InputError
        If it holds images of several kinds, or of a kind that is not read.
    """
    import tifffile

    with listening() as told, tifffile.TiffFile(file) as tiff:
        check_frames(len(tiff.pages))
        every: list[Any] = list(tiff.pages)
        found = [page for page in every if not page.subfiletype & (_REDUCED | _MASK)] or every[:1]
        if not found:
            raise ValueError(_first(told) or "it contains no image")
        made = [_page(page, size) for page in found]
        if tiff.is_imagej and len(made) == 1:
            made = _of_imagej(made[0], int((tiff.imagej_metadata or {}).get("images", 1)), size)
    damage = _first(told)
    if damage:
        raise ValueError(damage)
    kinds = list(dict.fromkeys(page.kind for page in made))
    if len(kinds) > 1:
        sizes = ", ".join(dict.fromkeys(f"{k[0][3]} x {k[0][2]} {k[1]}" for k in kinds))
        remedy = "store them in files of their own"
        raise InputError(f"TIFF with images of several kinds ({sizes})", allowed="frames of one size", remedy=remedy)
    return made


def _page(page: Any, size: int) -> TiffPage:
    if page.dtype is None or math.prod(page.shaped) == 0:
        raise ValueError(f"values of {page.bitspersample} bits, sample format {page.sampleformat}, in {page.shaped[2:4]} pixels")
    if page.shaped[1] > 1:
        raise InputError("TIFF of a volume", allowed="images of one plane", remedy="store its planes as pages")
    # Some cameras' software leaves PhotometricInterpretation out. Then 0 is black, as libtiff and ImageJ take it; tifffile says white.
    photometric = int(page.photometric) if 262 in page.tags else 3 if page.colormap is not None else 1 if page.shaped[4] < 3 else 2
    coder = int(page.compression)
    if photometric not in _READ or (photometric == 6 and coder not in _JPEG):
        what = f"TIFF of a photometric kind that is not read ({photometric})"
        raise InputError(what, allowed="grey, palette or RGB", remedy="export the frame as a grey image")
    offsets, counts = tuple(map(int, page.dataoffsets)), tuple(map(int, page.databytecounts))
    promised = math.prod(page.chunked)
    if len(offsets) != promised or len(counts) != promised:
        raise ValueError(f"{min(len(offsets), len(counts))} of {promised} strips or tiles are listed")
    if any(count <= 0 or offset <= 0 or offset + count > size for offset, count in zip(offsets, counts, strict=True)):
        raise ValueError("pixel data are missing")
    palette = None
    if photometric == 3 and page.colormap is not None:
        palette = np.asarray(page.colormap, np.uint16)
        if palette.shape != (3, 1 << page.bitspersample):
            raise ValueError(f"a palette of {palette.shape[-1]} colours for {page.bitspersample} bits")
    tables = {"jpegtables": page.jpegtables, "jpegheader": page.jpegheader} if coder in _JPEG else {}
    extra = tuple(map(int, page.extrasamples))
    orientation = int(page.tags.valueof(274, 1)) if 274 in page.tags else 1
    page.init_decode() if hasattr(page, "init_decode") else page.decode
    return TiffPage(
        offsets, counts, page.decode, tables, tuple(page.shaped), page.dtype, int(page.bitspersample), photometric, palette,
        len(extra) == 1 and extra[0] in (1, 2), coder, None if coder in _JPEG else True if coder in _LOSSLESS else None, orientation,
    )  # fmt: skip


def with_coder(page: TiffPage, read: Read) -> TiffPage:
    """The page with what its first JPEG stream says of the coder."""
    if page.coder not in _JPEG:
        return page
    return page._replace(lossless=jpeg_facts(read(page.offsets[0], page.counts[0])).lossless)


def _of_imagej(page: TiffPage, count: int, size: int) -> list[TiffPage]:
    """ImageJ writes a large stack as one page, and the others right behind it."""
    if count <= 1 or page.coder != 1 or len(page.offsets) != 1:
        return [page]
    step = page.decoded_bytes
    if page.offsets[0] + count * step > size:
        raise ValueError("pixel data are missing")
    return [page._replace(offsets=(page.offsets[0] + k * step,), counts=(step,)) for k in range(count)]


_heard = threading.local()


def _listen(record: logging.LogRecord) -> bool:
    """Filter of tifffile's log: while we read, nothing of it is printed."""
    told = getattr(_heard, "told", None)
    if told is None:
        return True
    told.append((record.levelno, record.getMessage()))
    return False


@contextmanager
def listening() -> Iterator[list[tuple[int, str]]]:
    """Take note of what tifffile says instead of printing it."""
    logger = logging.getLogger("tifffile")
    if _listen not in logger.filters:
        logger.addFilter(_listen)
    before, _heard.told = getattr(_heard, "told", None), []
    try:
        yield _heard.told
    finally:
        _heard.told = before


def _first(told: list[tuple[int, str]]) -> str:
    """The first error in the log, but of private tags, which say nothing of the pixels."""
    for level, text in told:
        tag = _TAG.search(text)
        if level >= logging.ERROR and not (tag and int(tag[1] or tag[2]) >= _PRIVATE):
            return _WHO.sub("", text)
    return ""
