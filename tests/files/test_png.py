"""The fast way of reading grey PNG files, beside complete decoders; what it does not know it leaves to them."""

from __future__ import annotations

import hashlib
import struct
import zlib
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pixmetry.core.errors import InputError
from pixmetry.files import read_frame
from pixmetry.files.images import load_frame
from pixmetry.files.png import SIGNATURE, PlainPng


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def filtered(rows: np.ndarray, kind: int, step: int) -> bytes:
    """Filter rows of bytes by the definition of the format, in exact integers."""
    out, above = [], [0] * rows.shape[1]
    for row in rows.tolist():
        line = [kind]
        for i, value in enumerate(row):
            left = row[i - step] if i >= step else 0
            up, corner = above[i], above[i - step] if i >= step else 0
            paeth = min((left, up, corner), key=lambda guess: abs(left + up - corner - guess))
            line.append((value - (0, left, up, (left + up) // 2, paeth)[kind]) % 256)
        out.append(bytes(line))
        above = row
    return b"".join(out)


def png(image: np.ndarray, kinds: list[int], pieces: int = 1, extra: bytes = b"", header: bytes = b"\0\0\0") -> bytes:
    """Write a grey PNG with a filter for each row, the data in several pieces, and other chunks in front."""
    depth = image.dtype.itemsize
    rows = np.frombuffer(image.astype(image.dtype.newbyteorder(">")).tobytes(), np.uint8).reshape(image.shape[0], -1)
    lines = []
    for r, kind in enumerate(kinds):
        both = rows[max(r - 1, 0) : r + 1]
        encoded = filtered(both, kind, depth)
        lines.append(encoded[-(1 + rows.shape[1]) :])
    data = zlib.compress(b"".join(lines))
    cuts = np.linspace(0, len(data), pieces + 1).astype(int)
    ihdr = struct.pack(">IIBB", image.shape[1], image.shape[0], 8 * depth, 0) + header
    parts = b"".join(chunk(b"IDAT", data[a:b]) for a, b in zip(cuts, cuts[1:], strict=False))
    return SIGNATURE + chunk(b"IHDR", ihdr) + extra + parts + chunk(b"IEND", b"")


@settings(deadline=None, max_examples=60)
@given(
    rows=st.integers(1, 7),
    cols=st.integers(1, 9),
    seed=st.integers(0, 2**32 - 1),
    deep=st.booleans(),
    few=st.booleans(),
    pieces=st.integers(1, 3),
    data=st.data(),
)
def test_all_filters_decode_to_what_was_stored(rows, cols, seed, deep, few, pieces, data):
    """Few different values make predictions that are equally good, of which the format names the one to take."""
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 4 if few else 65536 if deep else 256, (rows, cols)).astype(np.uint16 if deep else np.uint8)
    kinds = data.draw(st.lists(st.integers(0, 4), min_size=rows, max_size=rows))
    raw = png(image, kinds, pieces, chunk(b"tEXt", b"a\0b"))
    assert np.array_equal(imagecodecs.png_decode(raw).reshape(image.shape), image)  # the file itself is right
    got = PlainPng().decode(raw)
    assert got is not None and got.dtype == image.dtype and np.array_equal(got, image)


def test_frames_do_not_share_memory():
    reader, images = PlainPng(), [np.full((5, 6), v, d) for d in (np.uint8, np.uint16) for v in (3, 200)]
    frames = [reader.decode(png(image, [0] * 5)) for image in images]
    assert all(np.array_equal(frame, image) for frame, image in zip(frames, images, strict=True))


@pytest.mark.parametrize("channels", [2, 3, 4])
def test_other_kinds_are_left_to_a_complete_decoder(channels):
    raw = imagecodecs.png_encode(np.arange(60 * channels, dtype=np.uint8).reshape(6, 10, channels))
    assert PlainPng().decode(raw) is None


def test_transparency_and_interlacing_are_left_to_a_complete_decoder():
    image = np.arange(60, dtype=np.uint8).reshape(6, 10)
    assert PlainPng().decode(png(image, [0] * 6, extra=chunk(b"tRNS", b"\0\1"))) is None
    assert PlainPng().decode(png(image, [0] * 6, header=b"\0\0\1")) is None


def test_damage_is_found_wherever_it_is(tmp_path: Path, rng: np.random.Generator):
    """Any byte of header, data and end changed, or the file cut off anywhere: never a frame that differs without an error."""
    image = rng.integers(0, 4096, (9, 11)).astype(np.uint16)
    raw = png(image, [0, 1, 2, 3, 4, 0, 1, 2, 3])
    for at in rng.integers(len(SIGNATURE), len(raw), 60):
        broken = bytearray(raw)
        broken[at] ^= 1 << int(rng.integers(8))
        assert PlainPng().decode(bytes(broken)) is None
        assert PlainPng().decode(raw[:at]) is None
    (tmp_path / "a.png").write_bytes(raw[:-40])
    with pytest.raises(InputError, match="damaged or cut off"):
        load_frame(tmp_path / "a.png", PlainPng())


def test_a_header_that_claims_too_much_is_not_believed():
    image = np.zeros((4, 4), np.uint8)
    raw = bytearray(png(image, [0] * 4))
    raw[16:24] = struct.pack(">II", 60000, 60000)
    raw[29:33] = struct.pack(">I", zlib.crc32(bytes(raw[12:29])))
    assert PlainPng().decode(bytes(raw)) is None


def test_the_digest_is_that_of_the_file(tmp_path: Path):
    raw = png(np.arange(60, dtype=np.uint16).reshape(6, 10), [4] * 6)
    (tmp_path / "a.png").write_bytes(raw)
    loaded = load_frame(tmp_path / "a.png", PlainPng())
    assert loaded.sha256 == hashlib.sha256(raw).hexdigest() and loaded.size_bytes == len(raw)
    assert np.array_equal(loaded.array, read_frame(tmp_path / "a.png"))
