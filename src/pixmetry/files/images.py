"""Frames on disk: each file is read once, hashed, decoded from memory, and checked before it is used."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pixmetry.camera.observations import Storage
from pixmetry.core.arguments import typed
from pixmetry.core.door import open_file
from pixmetry.core.errors import InputError
from pixmetry.core.memory import check_memory
from pixmetry.core.threads import imap_tiles
from pixmetry.files.formats import (
    ENDINGS,
    FORMATS,
    HEAD_BYTES,
    LONGEST_HEAD,
    Decoded,
    check_head,
    decode,
    format_of,
    frames_of,
    is_frame,
    raw_file,
    read_one,
    read_stacked,
)
from pixmetry.files.jpeg import SIGNATURE as JPEG
from pixmetry.files.jpeg import luminance_of, luminance_table
from pixmetry.files.png import SIGNATURE, PlainPng
from pixmetry.files.provenance import InputHashes
from pixmetry.files.raw_values import RawLayout
from pixmetry.files.records import LOCATED, LOSSY, Campaign, FrameGroup
from pixmetry.files.zarr_frames import entries, is_entry, lossless_store, read_entry

CHANNELS = {"red": 0, "green": 1, "blue": 2}


class LoadedFrame(NamedTuple):
    """A decoded frame with the digest of its file, and whether the file's coder is lossless (None: not known)."""

    array: np.ndarray
    sha256: str
    size_bytes: int
    lossless: bool | None = True
    table: tuple[int, ...] | None = None  # luminance quantiser of a JPEG


@typed
def read_frame(path: str | Path) -> np.ndarray:
    """Read one frame.

    Returns
    -------
    ndarray, shape (rows, cols), uint8 or uint16
        The stored values, unchanged.

    Raises
    ------
    InputError
        If the file is missing, damaged, not an image of an accepted kind, in colour, or holds several images.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> path = tempfile.mkdtemp() + "/frame.png"
    >>> write_frame(path, np.full((4, 6), 1000, np.uint16), 12)
    >>> read_frame(path).shape
    (4, 6)
    """
    return load_frame(Path(path)).array


def load_frame(
    path: Path, plain_png: PlainPng | None = None, raw: RawLayout | None = None, *, lossy: bool = False, channel: str | None = None
) -> LoadedFrame:
    """Read one frame and the SHA-256 of its file from the same bytes; errors as in `read_frame`.

    Of a frame in a store or in a file with several, the digest is that of its values. With ``lossy`` JPEG files are taken too: their
    luminance. With ``channel`` colour images are taken too: that channel.
    """
    if is_entry(path):
        array, sha256, size = read_entry(path)
        return LoadedFrame(_checked(array, path), sha256, size, lossless_store(path))
    if is_frame(path) or raw_file(path, raw):
        found, sha256, size = read_stacked(path if is_frame(path) else path / "0", raw)
        return LoadedFrame(_checked(_channel_of(found.array, channel), path), sha256, size, found.lossless)
    data = image_bytes(path)
    sha256 = hashlib.sha256(data).hexdigest()
    if plain_png is not None and data.startswith(SIGNATURE) and (png := plain_png.decode(data)) is not None:
        return LoadedFrame(png, sha256, len(data))
    found = decode(data, path, lossy=lossy)
    if lossy and data.startswith(JPEG) and found.lossless is False:
        array = _channel_of(found.array, channel)
        array = array if array.ndim == 2 else luminance_of(data)
        return LoadedFrame(_checked(array, path), sha256, len(data), False, luminance_table(data))
    return LoadedFrame(_checked(_channel_of(found.array, channel), path), sha256, len(data), found.lossless)


def _channel_of(array: np.ndarray, channel: str | None) -> np.ndarray:
    """One channel of a colour image; a grey one, and where no channel is named, the image as it is."""
    colour = channel is not None and array.ndim == 3 and array.shape[2] in (3, 4)
    return array[:, :, CHANNELS[channel]] if colour and channel is not None else array


def read_picture(path: str | Path, channel: str | None = None, raw: RawLayout | None = None) -> np.ndarray:
    """Read a picture to measure positions in: as `read_frame`, and also JPEG, floats, and one channel of a colour image.

    Parameters
    ----------
    path : str or Path
    channel : {"red", "green", "blue"}, optional
        Which one of a colour image; ignored for a grey one.
    raw : RawLayout, optional
        Of files without a header.

    Returns
    -------
    ndarray, shape (rows, cols), uint8, uint16 or float32

    Raises
    ------
    InputError
        As in `read_frame`, or if the image is in colour and no channel is named.
    """
    return load_picture(Path(path), channel, raw).array


def load_picture(path: Path, channel: str | None = None, raw: RawLayout | None = None) -> Decoded:
    """As `read_picture`, with notes on the file: stored with loss, or to be rotated for display."""
    if channel is not None and channel not in CHANNELS:
        raise InputError("no such channel", value=channel, allowed=", ".join(CHANNELS))
    if is_entry(path):
        found = Decoded(read_entry(path)[0], lossless_store(path))
    elif is_frame(path) or raw_file(path, raw):
        found = read_one(path if is_frame(path) else path / "0", raw)
    else:
        found = decode(image_bytes(path), path, lossy=True)
    array = found.array
    if array.ndim == 3 and array.shape[2] in (3, 4):
        if channel is None:
            what = f"colour image ({'x'.join(map(str, array.shape))})"
            keys = "`--channel green`; in a project `channel: green` under `pictures`"
            remedy = f"name the channel to measure in ({keys}), or store the sensor's raw values"
            raise InputError(what, where=str(path), allowed="one grey channel", remedy=remedy)
        if not (array[:, :, :3] == array[:, :, :1]).all():  # a channel is luminance and chroma, each with steps of its own
            found = replace(found, luminance_steps=None)
        array = array[:, :, CHANNELS[channel]]
    if array.dtype.kind == "f" and array.ndim == 2 and array.size:
        return replace(found, array=np.ascontiguousarray(array, np.float32))
    return replace(found, array=_checked(array, path))


def picture_files(frames: Iterable[str | Path], endings: tuple[str, ...] = ENDINGS, raw: RawLayout | None = None) -> list[Path]:
    """Name the images meant by files, folders of them, and Zarr stores of frames; a file with several has a name for each.

    Raises
    ------
    InputError
        If there are none.
    """
    given, files = [Path(f) for f in frames], []
    for path in given:
        if path.is_dir():
            shown = (p for p in path.iterdir() if not p.name.startswith("."))  # not what systems put beside images, such as ._a.tif
            inside = sorted(p for p in shown if p.suffix.lower() in endings or (p.is_file() and raw_file(p, raw)))
            files += entries(path) or [name for p in inside for name in frames_of(p, raw)]
        else:
            files += frames_of(path, raw)
    if not files:
        where = ", ".join(map(str, given))
        raise InputError("no image files", where=where, allowed=", ".join(endings), remedy="name files or a folder of them")
    return files


def image_bytes(path: Path) -> bytes:
    """The bytes of an image file; of a file of no known format its first ones, which tell so."""
    try:
        with open_file(path) as file:
            head = file.read(LONGEST_HEAD)
            if format_of(head) is None:
                return head[:HEAD_BYTES]
            check_head(head, path)
            size = os.fstat(file.fileno()).st_size
            check_memory(size, "the file", where=str(path), remedy="check that it is the right file")
            return head + file.read(size)
    except FileNotFoundError:
        raise InputError("file is missing", where=str(path), remedy="check the name") from None
    except OSError as problem:
        raise InputError("file cannot be read", where=str(path), value=problem.strerror, remedy="check the permissions") from None


def _checked(array: np.ndarray, path: Path) -> np.ndarray:
    if array.ndim != 2:
        what = f"colour image ({'x'.join(map(str, array.shape))})"
        raise InputError(what, where=str(path), allowed="one grey channel", remedy="store the sensor's raw values, not a colour picture")
    native = array.dtype.newbyteorder("=")
    if native not in (np.uint8, np.uint16):
        raise InputError(f"values of type {array.dtype}", where=str(path), allowed=FORMATS, remedy="store the camera's integer values")
    if array.size == 0:
        raise InputError("image has no pixels", where=str(path), remedy="export the frame again")
    return np.ascontiguousarray(array, native)


def _frame_in_memory(campaign: Campaign, path: Path) -> np.ndarray:
    """One frame of a campaign in memory, uint8 or uint16 as the campaign's frames are.

    Raises
    ------
    InputError
        If a value is negative or above 65535.
    """
    assert campaign.arrays is not None  # a campaign of files has none
    frame = campaign.arrays[path.parent][int(path.name)]
    low, high = int(frame.min()), int(frame.max())
    if low < 0 or high > 65535:
        raise InputError("values that a frame cannot store", where=str(path), value=f"{low} to {high}", allowed="0 to 65535")
    return np.ascontiguousarray(frame, campaign.frame_dtype)


def check_frame(array: np.ndarray, where: str, *, bits: int, shape: tuple[int, int] | None = None, dtype: str | None = None) -> None:
    """Refuse a frame that does not fit its campaign.

    Parameters
    ----------
    array : ndarray, shape (rows, cols), uint8 or uint16
    where : str
        Name of the file.
    bits : int
        Bits of a stored value.
    shape, dtype : optional
        Those of the campaign's first frame.

    Raises
    ------
    InputError
        If size or depth differ, if an 8-bit file is declared to hold more bits, or if a value exceeds the declared bits.
    """
    if shape is not None and array.shape != tuple(shape):
        what = f"frame has {array.shape[1]} x {array.shape[0]} pixels, the campaign {shape[1]} x {shape[0]} (columns x rows)"
        raise InputError(
            what, where=where, allowed="one size for all frames", remedy="remove the frame or use one window for the whole campaign"
        )
    depth = array.dtype.itemsize * 8
    if depth < bits:
        remedy = f"export the frames with 16 bits, or declare bits: {depth} if the camera delivered {depth}"
        raise InputError(
            f"{depth}-bit file, but {bits} bits are declared", where=where, allowed="16-bit files for more than 8 bits", remedy=remedy
        )
    if dtype is not None and array.dtype != np.dtype(dtype):
        what = f"{depth}-bit file in a campaign of {np.dtype(dtype).itemsize * 8}-bit files"
        raise InputError(what, where=where, allowed="one depth for all frames", remedy="export all frames in the same way")
    highest = (1 << bits) - 1
    if depth > bits and (found := int(array.max())) > highest:
        raise _too_high(array, found, bits, where)


def _too_high(array: np.ndarray, found: int, bits: int, where: str) -> InputError:
    spare = array.dtype.itemsize * 8 - bits
    used = int(np.bitwise_or.reduce(array, axis=None))
    remedy = f"declare the true number of bits (at least {found.bit_length()})"
    if used & ((1 << spare) - 1) == 0:
        remedy = f"the values are shifted to the left by {spare} bits: store them in the lowest {bits} bits"
    return InputError(f"value above the range of {bits} bits", where=where, value=found, allowed=f"0 to {(1 << bits) - 1}", remedy=remedy)


def iter_frames(
    paths: Iterable[Path],
    *,
    bits: int,
    shape: tuple[int, int] | None = None,
    dtype: str | None = None,
    threads: int | None = None,
    raw: RawLayout | None = None,
) -> Iterator[np.ndarray]:
    """Read frames in order, decoding ahead in threads; only a few frames (at most twice the threads) are in memory.

    Parameters
    ----------
    paths : iterable of Path
    bits, shape, dtype
        As in `check_frame`, applied to every frame.
    threads : int, optional
    raw : RawLayout, optional
        Of files without a header.

    Yields
    ------
    ndarray, shape (rows, cols), uint8 or uint16

    Raises
    ------
    InputError
        As in `read_frame` and `check_frame`, when the frame's turn comes.
    """
    plain_png = PlainPng()

    def load(path: Path) -> np.ndarray:
        array = load_frame(path, plain_png, raw).array
        check_frame(array, str(path), bits=bits, shape=shape, dtype=dtype)
        return array

    return imap_tiles(load, paths, threads)


class FrameReader:
    """Streams the frames of a campaign, checked against it, and collects the digests of the files.

    Parameters
    ----------
    campaign : Campaign
    threads : int, optional
    """

    def __init__(self, campaign: Campaign, *, threads: int | None = None) -> None:
        self.campaign, self.threads = campaign, threads
        self.hashes = InputHashes(campaign.base)
        self._plain_png = PlainPng()
        self._coders: set[bool | None] = set()
        self._channels = {path: group.facts.channel for group in campaign.groups for path in group.paths}
        self._patterns = {path: group.kind for group in campaign.groups if group.kind in LOSSY for path in group.paths}
        self.located_with_loss: set[str] = set()  # kinds whose positions are those of a lossy coder
        self._tables: set[tuple[int, ...]] = set()
        for listing in (campaign.source_path, campaign.descriptor_path):
            if campaign.arrays is None and listing is not None and listing.is_file():
                self.hashes.add_file(listing)

    def fetch(self, path: Path, borders: Callable[[np.ndarray], object] | None = None) -> np.ndarray:
        """Read one frame in the calling thread, and take note of its digest; errors as in `iter_frames`.

        Where the camera has covered pixels, ``borders`` is called with the stored frame, and its active area comes back.
        """
        stored = self._stored(path)
        covered = self.campaign.camera.covered
        if covered is None:
            return stored
        if borders is not None:
            borders(stored)
        return np.ascontiguousarray(stored[covered.active(stored.shape)])

    def _stored(self, path: Path) -> np.ndarray:
        c = self.campaign
        if c.arrays is not None:
            array = _frame_in_memory(c, path)
            check_frame(array, str(path), bits=c.bits)
            if path not in self._patterns:
                self._coders.add(None)
            return array
        frame = load_frame(path, self._plain_png, c.raw, lossy=path in self._patterns, channel=self._channels.get(path))
        check_frame(frame.array, str(path), bits=c.bits, shape=c.stored_shape, dtype=c.frame_dtype)
        self.hashes.add(path, frame.sha256, frame.size_bytes)
        if path in self._patterns:  # they show a coder; how the others were stored is another question
            if frame.table is not None and self._patterns[path] == "pattern":
                self._tables.add(frame.table)
            elif frame.lossless is False and self._patterns[path] in LOCATED:
                self.located_with_loss.add(self._patterns[path])
            return frame.array
        self._coders.add(frame.lossless)
        if frame.lossless is False and c.camera.lossless:
            remedy = "write `lossless: false`, or store the frames without loss"
            raise InputError("stored with loss, but `lossless: true` is stated", where=str(path), remedy=remedy)
        return frame.array

    @property
    def storage(self) -> Storage:
        """Whether the frames read so far were stored without loss; a statement of the manifest has priority over the files."""
        stated = self.campaign.camera.lossless
        table = next(iter(self._tables)) if len(self._tables) == 1 else None
        if False in self._coders:
            return Storage(False, "proven", table)
        if stated is not None:
            return Storage(stated, "stated", table)
        return Storage(True, "proven", table) if self._coders == {True} else Storage(table=table)

    def frames(self, group: FrameGroup) -> Iterator[np.ndarray]:
        """Yield the frames of one group in order, decoding ahead in threads; errors as in `iter_frames`."""
        return imap_tiles(self.fetch, group.paths, self.threads)


def write_frame(path: str | Path, array: np.ndarray, bits: int) -> None:
    """Write one frame without loss, as PNG or TIFF by the name's ending; up to 8 bits as 8-bit file, else as 16-bit file.

    Parameters
    ----------
    path : str or Path
    array : ndarray, shape (rows, cols), integer
    bits : int
        Bits of a stored value, 1 to 16.

    Raises
    ------
    InputError
        If the array is not a grey integer image that fits into the bits, or the ending is neither ``.png`` nor ``.tif(f)``.
    """
    path = Path(path)
    if array.ndim != 2 or array.dtype.kind not in "ui":
        raise InputError(
            "not a grey image of integers", where=str(path), value=f"{array.dtype} {array.shape}", allowed="two axes, integers"
        )
    if not 1 <= bits <= 16:
        raise InputError("bits cannot be stored", where=str(path), value=bits, allowed="1 to 16")
    if array.size and (array.min() < 0 or array.max() >= 1 << bits):
        value = f"{array.min()} to {array.max()}"
        raise InputError(f"values do not fit into {bits} bits", where=str(path), value=value, allowed=f"0 to {(1 << bits) - 1}")
    stored = np.ascontiguousarray(array, dtype=np.uint8 if bits <= 8 else np.uint16)
    ending = path.suffix.lower()
    if ending == ".png":
        import imagecodecs

        path.write_bytes(imagecodecs.png_encode(stored, level=6))
    elif ending in (".tif", ".tiff"):
        import tifffile

        tifffile.imwrite(path, stored, photometric="minisblack", compression="zlib", software="pixmetry")
    else:
        raise InputError("unknown ending of an image file", where=str(path), value=ending, allowed=".png, .tif, .tiff")
