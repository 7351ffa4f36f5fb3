"""Files of other programs and odd but lawful ones: the right values, or one clear error.

Written by Pillow, OpenCV and tifffile, or byte by byte from the format's description; never by the code under test.
"""

from __future__ import annotations

import io
import logging
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from pixmetry.core.errors import InputError
from pixmetry.files import read_frame
from pixmetry.files.formats import frames_of
from pixmetry.files.images import load_frame, load_picture, picture_files, read_picture
from pixmetry.files.raw_values import RawLayout, parse_raw

GREY = np.random.default_rng(3).integers(0, 256, (40, 52), dtype=np.uint8)
DEEP = np.random.default_rng(4).integers(0, 4096, (40, 52), dtype=np.uint16)
STACK = np.random.default_rng(5).integers(0, 4096, (5, 30, 44), dtype=np.uint16)


def refused(path: Path, *words: str) -> None:
    with pytest.raises(InputError) as caught:
        read_picture(path, "green")
    message = str(caught.value)
    assert path.name in message and "\n" not in message
    for word in words:
        assert word in message


def put(path: Path, raw: bytes) -> Path:
    path.write_bytes(raw)
    return path


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(head: tuple[int, ...], rows: bytes, *extra: bytes) -> bytes:
    """A PNG from width, height, depth, colour type, compression, filter, interlace; the filter bytes stand in the rows."""
    parts = (chunk(b"IHDR", struct.pack(">IIBBBBB", *head)), *extra, chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def plain_rows(values: np.ndarray) -> bytes:
    return b"".join(b"\0" + row.tobytes() for row in values.astype(values.dtype.newbyteorder(">")))


def jpeg(image: np.ndarray, **options: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=92, **options)
    return stream.getvalue()


# PNG


def adam7(values: np.ndarray) -> bytes:
    """The seven passes of an interlaced PNG (ISO/IEC 15948, clause 8.2)."""
    passes = ((0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1))
    return b"".join(plain_rows(part) for r, c, dr, dc in passes if (part := values[r::dr, c::dc]).size)


def test_png_of_all_grey_kinds_is_read_exactly(tmp_path: Path) -> None:
    cols, rows = GREY.shape[1], GREY.shape[0]
    gamma = chunk(b"gAMA", struct.pack(">I", 45455)) + chunk(b"sRGB", b"\0")
    own = {
        "interlaced": (png((cols, rows, 8, 0, 0, 0, 1), adam7(GREY)), GREY),
        "interlaced deep": (png((cols, rows, 16, 0, 0, 0, 1), adam7(DEEP)), DEEP),
        "gamma": (png((cols, rows, 8, 0, 0, 0, 0), plain_rows(GREY), gamma), GREY),
        "16 bits": (png((cols, rows, 16, 0, 0, 0, 0), plain_rows(DEEP)), DEEP),
        "opaque": (png((cols, rows, 8, 4, 0, 0, 0), plain_rows(np.stack([GREY, np.full_like(GREY, 255)], 2).reshape(rows, -1))), GREY),
        "grey palette": (
            png((cols, rows, 8, 3, 0, 0, 0), plain_rows(GREY), chunk(b"PLTE", bytes(255 - k // 3 for k in range(768)))),
            255 - GREY,
        ),
    }
    for name, (raw, expected) in own.items():
        frame = read_frame(put(tmp_path / f"{name}.png", raw))
        np.testing.assert_array_equal(frame, expected, err_msg=name)
        if name != "gamma":  # Pillow knows nothing of our reader
            np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(raw)).convert("I"))[:2], expected[:2].astype(int), err_msg=name)


def test_png_that_shows_something_else_is_refused(tmp_path: Path) -> None:
    cols, rows = GREY.shape[1], GREY.shape[0]
    clear = np.stack([GREY, np.full_like(GREY, 254)], 2).reshape(rows, -1)
    refused(put(tmp_path / "alpha.png", png((cols, rows, 8, 4, 0, 0, 0), plain_rows(clear))), "transparent")
    trns = chunk(b"tRNS", struct.pack(">H", int(GREY[3, 3])))
    refused(put(tmp_path / "key.png", png((cols, rows, 8, 0, 0, 0, 0), plain_rows(GREY), trns)), "transparent")
    whole = png((cols, rows, 8, 0, 0, 0, 0), plain_rows(GREY))
    refused(put(tmp_path / "few.png", png((cols, rows, 8, 0, 0, 0, 0), plain_rows(GREY)[:-30])), "damaged")
    refused(put(tmp_path / "none.png", whole.replace(b"IDAT", b"IDAX")), "checksum")
    refused(put(tmp_path / "text.png", whole[:-12] + chunk(b"tEXt", b"k\0IEND")), "end of the image is missing")
    huge = png((30000, 30000, 8, 0, 0, 0, 0), plain_rows(GREY))
    refused(put(tmp_path / "huge.png", huge), "cannot hold")


# TIFF


def tiff(array: np.ndarray, **options: object) -> bytes:
    stream = io.BytesIO()
    tifffile.imwrite(stream, array, **options)
    return stream.getvalue()


def test_white_is_zero_is_inverted(tmp_path: Path) -> None:
    """TIFF 6.0, PhotometricInterpretation 0: 0 is imaged as white."""
    for name, array, bits in (("8", GREY, 8), ("16", DEEP, 16)):
        path = put(tmp_path / f"{name}.tif", tiff(array, photometric="miniswhite"))
        np.testing.assert_array_equal(read_frame(path), (1 << bits) - 1 - array.astype(int))
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "8.tif"), cv2.IMREAD_UNCHANGED), 255 - GREY)  # libtiff's word on it


def test_a_palette_is_looked_up(tmp_path: Path) -> None:
    colours = np.random.default_rng(7).integers(0, 256, (3, 256), dtype=np.uint16)
    path = put(tmp_path / "p.tif", tiff(GREY, photometric="palette", colormap=colours * 257))
    np.testing.assert_array_equal(read_picture(path, "green"), colours[1][GREY])
    with pytest.raises(InputError, match="colour image"):
        read_frame(path)
    ramp = np.tile(np.arange(255, -1, -1, dtype=np.uint16) * 257, (3, 1))
    np.testing.assert_array_equal(read_frame(put(tmp_path / "g.tif", tiff(GREY, photometric="palette", colormap=ramp))), 255 - GREY)


def test_colours_apart_are_colours(tmp_path: Path) -> None:
    rgb = np.stack([GREY, GREY // 2, GREY // 3])
    path = put(tmp_path / "a.tif", tiff(rgb, photometric="rgb", planarconfig="separate"))
    np.testing.assert_array_equal(read_picture(path, "green"), GREY // 2)


@pytest.mark.parametrize("options", [{"rowsperstrip": 8}, {"rowsperstrip": 8, "compression": "zlib"}, {"tile": (16, 16)}])
def test_half_of_the_strips_is_not_an_image(options: dict[str, object], tmp_path: Path) -> None:
    path = put(tmp_path / "a.tif", tiff(DEEP, **options))
    with tifffile.TiffFile(path, mode="r+") as file:
        names = ("TileOffsets", "TileByteCounts") if "tile" in options else ("StripOffsets", "StripByteCounts")
        for name in names:
            tag = file.pages[0].tags[name]
            tag.overwrite(tag.value[: len(tag.value) // 2])
    refused(path, "damaged or cut off", "strips or tiles are listed")


def test_a_strip_with_too_few_bytes_is_refused(tmp_path: Path) -> None:
    for name, options in (("plain", {}), ("zlib", {"compression": "zlib"}), ("lzw", {"compression": "lzw"})):
        path = put(tmp_path / f"{name}.tif", tiff(DEEP, rowsperstrip=8, **options))
        with tifffile.TiffFile(path, mode="r+") as file:
            tag = file.pages[0].tags["StripByteCounts"]
            tag.overwrite([*tag.value[:-1], tag.value[-1] // 2])
        refused(path, "damaged")


def test_jpeg_in_a_tiff_is_known_as_lossy(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    Image.fromarray(GREY).save(path, compression="jpeg", quality=90)
    picture = load_picture(path)
    assert picture.lossless is False and "JPEG inside a TIFF" in picture.notes[0]
    assert np.abs(picture.array.astype(int) - GREY).max() > 0
    assert load_frame(path).lossless is False
    raw = path.read_bytes()
    with tifffile.TiffFile(path) as file:
        end = file.pages[0].dataoffsets[-1] + file.pages[0].databytecounts[-1]
    refused(put(tmp_path / "cut.tif", raw[: end - 42] + b"\0" * 42 + raw[end:]), "damaged")


def test_a_preview_beside_the_frame_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as file:
        file.write(DEEP)
        file.write(DEEP[::4, ::4], subfiletype=1)
    np.testing.assert_array_equal(read_frame(path), DEEP)


def test_tifffile_says_nothing_to_the_user(tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]) -> None:
    raw = tiff(DEEP, rowsperstrip=4)
    with caplog.at_level(logging.DEBUG):
        for share in (0.2, 0.5, 0.9, 0.999):
            refused(put(tmp_path / "a.tif", raw[: int(len(raw) * share)]))
    assert caplog.text == "" and capfd.readouterr() == ("", "")
    logging.getLogger("tifffile").warning("heard")  # outside of our reading its log is the user's
    assert "heard" in caplog.text


# JPEG


def test_a_cut_jpeg_is_refused_wherever_it_is_cut(tmp_path: Path) -> None:
    for options in ({}, {"progressive": True}):
        raw = jpeg(GREY, **options)
        np.testing.assert_array_equal(read_picture(put(tmp_path / "a.jpg", raw)), cv2.imdecode(np.frombuffer(raw, np.uint8), 0))
        for count in range(2, len(raw), 37):
            refused(put(tmp_path / "cut.jpg", raw[:count]), "damaged or cut off")
        assert load_picture(put(tmp_path / "more.jpg", raw + b"\0" * 100)).array.shape == GREY.shape  # cameras add to the end


def test_a_jpeg_header_promises_no_more_than_its_data_hold(tmp_path: Path) -> None:
    raw = jpeg(GREY)
    at = raw.index(b"\xff\xc0") + 5
    refused(put(tmp_path / "a.jpg", raw[:at] + b"\xff\xff\xff\xff" + raw[at + 4 :]), "cannot hold 65535 x 65535 pixels")


def test_a_jpeg_to_be_turned_is_measured_as_it_is_stored(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    raw = jpeg(GREY, exif=exif.tobytes())
    picture = load_picture(put(tmp_path / "a.jpg", raw))
    stored = cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    np.testing.assert_array_equal(picture.array, stored)
    assert any("by 90°" in note and "stored rows" in note for note in picture.notes)


def test_a_jpeg_for_print_is_refused(tmp_path: Path) -> None:
    stream = io.BytesIO()
    Image.fromarray(np.stack([GREY] * 4, 2), "CMYK").save(stream, "JPEG")
    refused(put(tmp_path / "a.jpg", stream.getvalue()), "4 colours")


# BMP


def test_bmp_of_other_programs(tmp_path: Path) -> None:
    Image.fromarray(GREY).save(tmp_path / "a.bmp")
    np.testing.assert_array_equal(read_frame(tmp_path / "a.bmp"), GREY)
    cv2.imwrite(str(tmp_path / "b.bmp"), GREY)
    np.testing.assert_array_equal(read_frame(tmp_path / "b.bmp"), GREY)
    colour = np.stack([GREY, GREY // 2, GREY // 3], 2)
    Image.fromarray(colour).save(tmp_path / "c.bmp")
    np.testing.assert_array_equal(read_picture(tmp_path / "c.bmp", "blue"), GREY // 3)
    indexed = Image.fromarray(GREY)
    indexed.putpalette([255 - k // 3 for k in range(768)])
    indexed.save(tmp_path / "d.bmp")
    np.testing.assert_array_equal(read_frame(tmp_path / "d.bmp"), 255 - GREY)
    raw = bytearray((tmp_path / "a.bmp").read_bytes())
    raw[22:26] = struct.pack("<i", -GREY.shape[0])  # the first row first
    np.testing.assert_array_equal(read_frame(put(tmp_path / "e.bmp", bytes(raw))), GREY[::-1])
    refused(put(tmp_path / "cut.bmp", bytes(raw[:-1])), "damaged or cut off")
    raw[30] = 1
    refused(put(tmp_path / "rle.bmp", bytes(raw)), "compression 1")


# FITS


def fits(array: np.ndarray, *more: str, extension: bool = False) -> bytes:
    """An image unit by the FITS Standard 4.0, clauses 3.3 and 4.4.1."""
    bits = array.dtype.itemsize * 8 * (-1 if array.dtype.kind == "f" else 1)
    first = "XTENSION= 'IMAGE   '" if extension else "SIMPLE  =                    T"
    cards = [first, f"BITPIX  = {bits:>20}", f"NAXIS   = {array.ndim:>20}"]
    cards += [f"NAXIS{k + 1}  = {n:>20}" for k, n in enumerate(array.shape[::-1])]
    cards += ["PCOUNT  =                    0", "GCOUNT  =                    1"] * extension + [*more, "END"]
    head = "".join(card.ljust(80) for card in cards).encode()
    data = array.astype(array.dtype.newbyteorder(">")).tobytes()
    return head.ljust(-(-len(head) // 2880) * 2880) + data.ljust(-(-len(data) // 2880) * 2880, b"\0")


UNSIGNED = ("BZERO   =                32768 / as unsigned", "BSCALE  =                    1")


def test_fits_of_all_kinds(tmp_path: Path) -> None:
    shifted = (DEEP.astype(int) + 40000 - 32768).astype(np.int16)
    cases = {
        "unsigned": (fits(shifted, *UNSIGNED), DEEP + 40000),
        "signed": (fits(DEEP.astype(np.int16)), DEEP),
        "long": (fits(DEEP.astype(np.int32)), DEEP),
        "bytes": (fits(GREY), GREY),
        "bottom": (fits(GREY, "ROWORDER= 'BOTTOM-UP'"), GREY[::-1]),
        "extension": (fits(np.zeros((0, 0), np.uint8)).replace(b"NAXIS   =                    2", b"NAXIS   =                    0"), None),
    }
    for name, (raw, expected) in cases.items():
        if name == "extension":
            raw, expected = raw[:2880] + fits(GREY, extension=True), GREY
        frame = read_frame(put(tmp_path / f"{name}.fits", raw))
        np.testing.assert_array_equal(frame, expected, err_msg=name)
        assert frame.dtype == expected.dtype
    real = read_picture(put(tmp_path / "real.fits", fits(DEEP.astype(np.float32) / 3)))
    np.testing.assert_array_equal(real, DEEP.astype(np.float32) / 3)
    scaled = read_picture(put(tmp_path / "scaled.fits", fits(GREY, "BSCALE  =                  0.5", "BZERO   =                  10.")))
    np.testing.assert_array_equal(scaled, GREY * np.float32(0.5) + 10)
    refused(put(tmp_path / "blank.fits", fits(DEEP.astype(np.int16), f"BLANK   = {int(DEEP[2, 2]):>20}")), "without a value")
    refused(put(tmp_path / "cut.fits", cases["unsigned"][0][:-2880]), "damaged or cut off")


# stacks


def stacks(folder: Path) -> dict[str, Path]:
    """The same frames as multi-page TIFF (two writers, three layouts), FITS cube, FITS extensions, NPY and raw values."""
    tifffile.imwrite(folder / "pages.tif", STACK, photometric="minisblack")
    tifffile.imwrite(folder / "packed.tif", STACK, photometric="minisblack", compression="zlib", rowsperstrip=7)
    tifffile.imwrite(folder / "imagej.tif", STACK, imagej=True)
    assert cv2.imwritemulti(str(folder / "opencv.tif"), list(STACK))
    signed = (STACK.astype(int) - 32768).astype(np.int16)
    (folder / "cube.fits").write_bytes(fits(signed, *UNSIGNED))
    (folder / "units.fits").write_bytes(b"".join(fits(s, *UNSIGNED, extension=k > 0) for k, s in enumerate(signed)))
    np.save(folder / "a.npy", STACK)
    np.save(folder / "f.npy", np.asfortranarray(STACK))
    return {path.name: path for path in sorted(folder.iterdir())}


def test_a_file_with_several_frames_is_a_stack(tmp_path: Path) -> None:
    for name, path in stacks(tmp_path).items():
        frames = frames_of(path)
        assert frames == [path / str(k) for k in range(5)], name
        for k, frame in enumerate(frames):
            np.testing.assert_array_equal(read_frame(frame), STACK[k], err_msg=f"{name}, {k}")
        with pytest.raises(InputError, match="no such frame.*0 to 4"):
            read_frame(path / "5")
        with pytest.raises(InputError, match="with 5 images"):
            read_frame(path)
    assert len(picture_files([tmp_path])) == 40


def test_a_cut_stack_loses_no_frame_in_silence(tmp_path: Path) -> None:
    for name, path in stacks(tmp_path).items():
        raw = path.read_bytes()
        for share in (0.31, 0.62, 0.93):  # nothing tells that a FITS file was cut between two units
            short = put(tmp_path / f"{share}-{name}", raw[: int(share * len(raw))])
            with pytest.raises(InputError, match="damaged or cut off"):
                [read_frame(frame) for frame in frames_of(short)]


def test_a_stack_that_changes_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, STACK)
    assert len(frames_of(path)) == 5
    np.save(path, STACK[:3] + 1)
    assert len(frames_of(path)) == 3
    np.testing.assert_array_equal(read_frame(path / "2"), STACK[2] + 1)


# raw values


def packed(values: np.ndarray, name: str) -> bytes:
    """Pack values by the bytes' own table, as text of bits; shares nothing with the reader."""
    values = values.ravel()
    if name.endswith("p"):
        bits = int(name[4:-1])
        text = "".join(format(int(v), f"0{bits}b")[::-1] for v in values)  # the lowest bit first
        text += "0" * (-len(text) % 8)
        return bytes(int(text[k : k + 8][::-1], 2) for k in range(0, len(text), 8))
    if name.endswith("Packed"):
        bits, out = int(name[4:6]), bytearray()
        low = bits - 8
        for k in range(0, len(values), 2):
            p0, p1 = (format(int(v), f"0{bits}b") for v in (*values[k : k + 2], 0)[:2])
            out += bytes([int(p0[:8], 2), int(p1[8:].zfill(4) + p0[8:].zfill(4), 2), int(p1[:8], 2)])
            assert len(p0[8:]) == low
        return bytes(out)
    return values.astype("<u2" if name != "Mono8" else "u1").tobytes()


FORMATS = [f"Mono{b}" for b in (8, 10, 12, 14, 16)] + [f"Mono{b}p" for b in (10, 12, 14)] + ["Mono10Packed", "Mono12Packed"]


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("shape", [(6, 8), (5, 7), (1, 1)])
def test_raw_values_of_genicam(name: str, shape: tuple[int, int], tmp_path: Path) -> None:
    bits = int("".join(c for c in name if c.isdigit()))
    frames = np.random.default_rng(bits).integers(0, 1 << bits, (3, *shape), dtype=np.uint16)
    path = put(tmp_path / "a.raw", b"head" + b"".join(packed(frame, name) for frame in frames))
    layout = parse_raw(f"{shape[1]}x{shape[0]}:{name}+4")
    assert layout == RawLayout(shape[1], shape[0], name, 4) and layout.bits == bits
    for k, frame in enumerate(picture_files([path], raw=layout)):
        again = load_frame(frame, raw=layout).array
        np.testing.assert_array_equal(again, frames[k])
        assert again.dtype == (np.uint8 if bits == 8 else np.uint16)
    with pytest.raises(InputError, match="not contain a whole number of frames"):
        picture_files([put(tmp_path / "b.raw", path.read_bytes()[: -1 - 2 * layout.frame_bytes])], raw=layout)


def test_published_mono12packed() -> None:
    """The table of a camera's manual: B0 = P0[11:4], B1 = P1[3:0] P0[3:0], B2 = P1[11:4] (Basler racer GigE, 9.2.3)."""
    assert RawLayout(2, 1, "Mono12Packed").decode(bytes([0xAB, 0x6C, 0x45])).tolist() == [[0xABC, 0x456]]


@pytest.mark.parametrize("text", ["", "12", "3x4", "3x4:RGB8", "3x4:Mono9", "0x4:Mono8", "3x4:Mono12Packed+", "-3x4:Mono8"])
def test_a_layout_that_cannot_be_used_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        parse_raw(text)
