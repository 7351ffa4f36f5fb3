"""Decoding of image files by their content, and of the frames in files that hold several.

`TABLE` at the end says all there is to say of a format: by which first bytes it is known, its endings, and how it is opened.
``stack.tif/7`` names frame 7 (from 0) of a file with several, as ``frames.zarr/7`` names one of a store.
"""

from __future__ import annotations

import hashlib
import io
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pixmetry.core.door import check_frames, check_pixels, open_file
from pixmetry.core.errors import InputError
from pixmetry.core.memory import check_memory
from pixmetry.files import bmp, fits, jpeg, tiff
from pixmetry.files.png import PALETTE, png_head
from pixmetry.files.png import SIGNATURE as PNG
from pixmetry.files.raw_values import RawLayout

_NPY = b"\x93NUMPY"
HEAD_BYTES = 16
LONGEST_HEAD = 1 << 16  # that of NPY
_TURNS = {2: "mirrored", 3: "by 180°", 4: "mirrored, by 180°", 5: "mirrored, by 90°", 6: "by 90°", 7: "mirrored, by 270°", 8: "by 270°"}

Read = Callable[[int, int], bytes]


@dataclass(frozen=True)
class Decoded:
    """An image as its file has it.

    Parameters
    ----------
    array : ndarray, shape (rows, cols) or (rows, cols, channels)
    lossless : bool or None
        Whether its coder keeps every value; None: not known.
    notes : tuple of str
        What the reader should know: loss, or that it is to be turned for display.
    luminance_steps : tuple of int, optional
        Steps of the quantiser of a JPEG's luminance, row by row, 64 of them; of a picture by `load_picture` only where it is grey.
    """

    array: np.ndarray
    lossless: bool | None = True
    notes: tuple[str, ...] = ()
    luminance_steps: tuple[int, ...] | None = None


@dataclass(frozen=True)
class FrameFile:
    """A file with one frame or several, opened: how many there are, and how one is read."""

    count: int
    read: Callable[[int], Decoded]


@dataclass(frozen=True)
class Stored:
    """The bytes of a file, on disk or in memory: how many there are, how some are read, and the whole as a file."""

    size: int
    read: Read
    file: Callable[[], BinaryIO]

    @classmethod
    def on_disk(cls, path: Path, size: int) -> Stored:
        """The bytes of a file, of which only those are read that are asked for."""
        return cls(size, partial(_read_part, path), partial(open_file, path))

    @classmethod
    def in_memory(cls, raw: bytes) -> Stored:
        """The bytes of a file that was read."""
        return cls(len(raw), partial(_part_of, raw), partial(io.BytesIO, raw))


@dataclass(frozen=True)
class Format:
    """A format of image files.

    Parameters
    ----------
    name : str
        For messages.
    marks : tuple of bytes
        First bytes by which its files are known, `HEAD_BYTES` at most.
    endings : tuple of str
        Of the names of its files, in small letters.
    open : callable
        From the bytes of a file to its frames.
    several : bool
        Whether a file may hold several frames.
    lossy : bool
        Whether its coder changes noise, so that it is no format for frames; positions may be measured in its pictures.
    """

    name: str
    marks: tuple[bytes, ...]
    endings: tuple[str, ...]
    open: Callable[[Stored], FrameFile]
    several: bool = False
    lossy: bool = False


def format_of(head: bytes) -> Format | None:
    """Tell a format by the first bytes of a file; None where it is none that is known."""
    return next((known for known in TABLE if head.startswith(known.marks)), None)


def is_frame(path: Path) -> bool:
    """Tell whether a path names a frame in a file, as ``stack.tif/7`` does."""
    return path.name.isdecimal() and path.parent.is_file()


def frame_name(path: Path) -> str:
    """Name of an image for tables and messages: of a frame in a file with the file's name."""
    return f"{path.parent.name}/{path.name}" if is_frame(path) else path.name


def frames_of(path: Path, raw: RawLayout | None = None) -> list[Path]:
    """Names of the frames in a file; a file with one frame is its own name.

    Raises
    ------
    InputError
        If the file cannot be read, or is damaged.
    """
    if not path.is_file() or (not raw_file(path, raw) and not _may_hold_several(path)):
        return [path]
    count = opened(path, raw).count
    return [path] if count == 1 else [path / str(k) for k in range(count)]


def raw_file(path: Path, raw: RawLayout | None) -> bool:
    """Whether a file has no header: if a layout is given, every file whose ending is not that of a format with a header."""
    return raw is not None and path.suffix.lower() not in PICTURE_ENDINGS


def _may_hold_several(path: Path) -> bool:
    with _told_of(path), open_file(path) as file:
        known = format_of(file.read(HEAD_BYTES))
    return known is not None and known.several


def read_stacked(path: Path, raw: RawLayout | None = None) -> tuple[Decoded, str, int]:
    """Read one frame of a file with several, the SHA-256 of its values (row by row, low byte first), and their size in bytes.

    Raises
    ------
    InputError
        If the file is damaged, or has no such frame.
    """
    found = read_one(path, raw)
    values = np.ascontiguousarray(found.array, found.array.dtype.newbyteorder("<")).tobytes()
    return found, hashlib.sha256(values).hexdigest(), len(values)


def read_one(path: Path, raw: RawLayout | None = None) -> Decoded:
    """Read one frame of a file with several; errors as of `read_stacked`."""
    file, index = opened(path.parent, raw), int(path.name)
    if index >= file.count:
        raise InputError("the file has no such frame", where=str(path.parent), value=index, allowed=f"0 to {file.count - 1}")
    with _told_of(path):
        return file.read(index)


def opened(path: Path, raw: RawLayout | None = None) -> FrameFile:
    """Open a file that may have several frames; the parsed header is kept as long as the file does not change.

    Raises
    ------
    InputError
        If it is damaged, or of no known kind.
    """
    with _told_of(path):
        stat = path.stat()
        return _opened(path, stat.st_mtime_ns, stat.st_size, raw if raw_file(path, raw) else None)


@lru_cache(maxsize=16)
def _opened(path: Path, modified_ns: int, size: int, raw: RawLayout | None) -> FrameFile:
    stored = Stored.on_disk(path, size)
    if raw is not None:
        start, length = raw.skip_bytes, raw.frame_bytes
        check_frames(raw.frames_in(size))
        return FrameFile(raw.frames_in(size), lambda k: Decoded(raw.decode(stored.read(start + k * length, length))))
    known = format_of(stored.read(0, HEAD_BYTES))
    if known is None or not known.several:
        names = ", ".join(each.name for each in TABLE if each.several)
        raise InputError("not a file with several frames", allowed=f"{names}, or raw values with their layout")
    found = known.open(stored)
    check_frames(found.count)
    return found


def _read_part(path: Path, offset: int, count: int) -> bytes:
    with open_file(path) as file:
        file.seek(offset)
        return file.read(count)


def _part_of(raw: bytes, offset: int, count: int) -> bytes:
    return raw[offset : offset + count]


def decode(raw: bytes, path: Path, *, lossy: bool = False) -> Decoded:
    """Decode an image file by its content, not by the name's ending.

    Parameters
    ----------
    raw : bytes
    path : Path
        For messages.
    lossy : bool
        Take JPEG files too.

    Raises
    ------
    InputError
        If it is damaged, of another kind, holds several images, or needs more memory than there is.
    """
    with _told_of(path):
        known = format_of(raw[:HEAD_BYTES])
        if known is None:
            what = "file is empty" if not raw else "not an image of a known format"
            remedy = "copy or export the frame again; values without a header need their layout (`raw`)"
            raise InputError(what, allowed=FORMATS, remedy=remedy)
        if known.lossy and not lossy:
            remedy = f"store frames without loss: {known.name} removes the noise to be measured"
            raise InputError(f"{known.name} image", allowed=FORMATS, remedy=remedy)
        file = known.open(Stored.in_memory(raw))
        if file.count != 1:
            remedy = f"name one of them, such as {path.name}/0, or give the file where a stack of frames is expected"
            raise InputError(f"a file with {file.count} images", allowed="one frame", remedy=remedy)
        return file.read(0)


def check_head(head: bytes, path: Path) -> None:
    """Refuse an image that is too large, by the beginning of its file, so that the rest need not be read; of PNG, BMP and NPY.

    Raises
    ------
    InputError
    """
    with _told_of(path):
        if head.startswith(PNG) and len(head) >= 24:
            cols, rows = struct.unpack_from(">II", head, 16)
            check_pixels(cols, rows)
        elif head.startswith(bmp.SIGNATURE) and len(head) >= 26:
            cols, rows = struct.unpack_from("<ii", head, 18)
            check_pixels(abs(cols), abs(rows))
        elif head.startswith(_NPY):
            shape = _npy_head(partial(_part_of, head), None)[1]
            rows, cols = (1, 1) if len(shape) < 2 else shape[-2:] if len(shape) < 4 else shape[1:3]
            check_pixels(cols, rows)


@contextmanager
def _told_of(path: Path) -> Iterator[None]:
    """Name the file in errors; every decoder has its own exceptions, and all of them mean a damaged file here."""
    try:
        yield
    except InputError as problem:
        where = problem.where or str(path)
        raise InputError(problem.what, where=where, value=problem.value, allowed=problem.allowed, remedy=problem.remedy) from None
    except FileNotFoundError:
        raise InputError("file is missing", where=str(path), remedy="check the name") from None
    except OSError as problem:
        raise InputError("file cannot be read", where=str(path), value=problem.strerror, remedy="check the permissions") from None
    except MemoryError:
        raise InputError("the image needs more memory than is available", where=str(path), remedy="cut the image into parts") from None
    except Exception as problem:
        reason = str(problem).splitlines()[0] if str(problem) else type(problem).__name__
        raise InputError(f"image is damaged or cut off ({reason})", where=str(path), remedy="copy or export the frame again") from None


def _png(raw: bytes) -> Decoded:
    import imagecodecs

    head = png_head(raw)
    _check_size(head.decoded_bytes, head.cols, head.rows)
    image: np.ndarray = imagecodecs.png_decode(raw)
    if image.ndim == 3 and image.shape[2] in (2, 4):
        image = tiff.opaque(image)
    if head.colour == PALETTE and image.ndim == 3 and (image == image[:, :, :1]).all():  # a palette of greys
        image = image[:, :, 0]
    return Decoded(image[:, :, 0] if image.ndim == 3 and image.shape[2] == 1 else image)


def _jpeg(raw: bytes) -> Decoded:
    import imagecodecs

    facts = jpeg.jpeg_facts(raw)
    if facts.components not in (1, 3):
        remedy = "export the image in RGB, or as PNG"
        raise InputError(f"JPEG with {facts.components} colours", allowed="grey or colour (RGB)", remedy=remedy)
    needed = facts.rows * facts.cols * facts.components * (1 if facts.bits <= 8 else 2)
    _check_size(needed, facts.cols, facts.rows)
    coder = "JPEG, without loss" if facts.lossless else "JPEG: its coder has changed noise and fine structure"
    steps = None if facts.lossless else jpeg.luminance_table(raw)
    return Decoded(imagecodecs.jpeg_decode(raw), facts.lossless, (coder, *_turned(facts.orientation)), steps)


def _turned(orientation: int) -> tuple[str, ...]:
    turn = _TURNS.get(orientation)
    return () if turn is None else (f"the file asks for a rotation on display ({turn}): positions are those of the stored rows",)


def _check_size(needed_bytes: int, cols: int, rows: int) -> None:
    """Refuse an image that no sensor has, or for which there is no memory."""
    check_pixels(cols, rows)
    check_memory(needed_bytes, f"an image of {cols} x {rows} pixels", remedy="cut the image into parts")


def _one(decoder: Callable[[bytes], Decoded]) -> Callable[[Stored], FrameFile]:
    """Open a file of a format that holds one frame, which is decoded from all of its bytes."""

    def open_file(stored: Stored) -> FrameFile:
        return FrameFile(1, lambda _: decoder(stored.read(0, stored.size)))

    return open_file


def _bmp(raw: bytes) -> Decoded:
    return Decoded(bmp.decode_bmp(raw))


def _tiff_file(stored: Stored) -> FrameFile:
    with stored.file() as file:
        pages = tiff.pages(file, stored.size)

    def one(k: int) -> Decoded:
        page = tiff.with_coder(pages[k], stored.read)
        _check_size(page.decoded_bytes, page.shaped[3], page.shaped[2])
        loss = ("JPEG inside a TIFF: its coder has changed noise and fine structure",) if page.lossless is False else ()
        return Decoded(page.image(stored.read), page.lossless, (*loss, *_turned(page.orientation)))

    return FrameFile(len(pages), one)


def _fits_file(stored: Stored) -> FrameFile:
    planes = fits.planes(stored.read, stored.size)

    def one(k: int) -> Decoded:
        plane = planes[k]
        _check_size(2 * plane.stored_bytes, plane.cols, plane.rows)
        return Decoded(plane.decode(stored.read(plane.offset, plane.stored_bytes)))

    return FrameFile(len(planes), one)


def _npy_file(stored: Stored) -> FrameFile:
    read = stored.read
    start, shape, dtype, fortran = _npy_head(read, stored.size)
    if len(shape) == 3 and shape[2] in (3, 4) and shape[1] > 4:  # a colour image, not frames of three columns
        shape = (1, *shape)
    if len(shape) not in (2, 3, 4) or 0 in shape:
        raise InputError(f"an array of shape {shape}", allowed="rows and columns, or frames, rows and columns", remedy="store it so")
    frames = 1 if len(shape) == 2 else shape[0]
    one_shape = shape if len(shape) == 2 else shape[1:]
    step = int(np.prod(one_shape, dtype=np.int64)) * dtype.itemsize

    def one(k: int) -> Decoded:
        _check_size(2 * step, one_shape[1], one_shape[0])
        if not fortran:
            return Decoded(np.frombuffer(read(start + k * step, step), dtype).reshape(one_shape))
        whole = np.frombuffer(read(start, frames * step), dtype).reshape(shape, order="F")
        return Decoded(whole if len(shape) == 2 else whole[k])

    return FrameFile(frames, one)


def _npy_head(read: Read, size: int | None) -> tuple[int, tuple[int, ...], np.dtype, bool]:
    """Where the values begin, their shape and type, and whether columns are stored one by one; a size of None is not compared."""
    from numpy.lib import format as npy

    head = io.BytesIO(read(0, LONGEST_HEAD))
    version = npy.read_magic(head)
    reader = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
    if reader is None:
        raise ValueError(f"version {version} of the format")
    shape, fortran, dtype = reader(head)
    if dtype.hasobject:
        raise InputError("an array of objects", allowed="an array of numbers", remedy="store numbers")
    start = head.tell()
    if size is None:
        return start, tuple(int(n) for n in shape), dtype, fortran
    if start + int(np.prod([int(n) for n in shape], dtype=object) if shape else 1) * dtype.itemsize > size or any(n < 0 for n in shape):
        raise ValueError("values are missing")
    return start, tuple(int(n) for n in shape), dtype, fortran


TABLE = (
    Format("PNG", (PNG,), (".png",), _one(_png)),
    Format("TIFF", tiff.MARKS, (".tif", ".tiff"), _tiff_file, several=True),
    Format("BMP", (bmp.SIGNATURE,), (".bmp",), _one(_bmp)),
    Format("FITS", (fits.SIGNATURE,), (".fits", ".fit", ".fts"), _fits_file, several=True),
    Format("NPY", (_NPY,), (".npy",), _npy_file, several=True),
    Format("JPEG", (jpeg.SIGNATURE,), (".jpg", ".jpeg"), _one(_jpeg), lossy=True),
)
*_MOST, _LAST = (known.name for known in TABLE if not known.lossy)
FORMATS = f"grey {', '.join(_MOST)} or {_LAST} with 8 or 16 bits"
ENDINGS = tuple(ending for known in TABLE if not known.lossy for ending in known.endings)  # of frames
PICTURE_ENDINGS = tuple(ending for known in TABLE for ending in known.endings)
