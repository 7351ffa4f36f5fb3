"""Frames: exact values in and out, every kind of damage refused, memory bounded."""

from __future__ import annotations

import hashlib
import io
import threading
import weakref
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from files.campaign_files import FRAMES, HEAD, put_campaign, put_frame
from pixmetry.core import door
from pixmetry.core.errors import InputError
from pixmetry.files import FrameReader, images, iter_frames, load_campaign, read_frame, write_frame
from pixmetry.files.images import picture_files
from pixmetry.files.raw_values import RawLayout


def refused(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_frame(path)
    message = str(caught.value)
    assert path.name in message
    assert "Traceback" not in message
    assert "\n" not in message
    return message


def tiff_bytes(array: np.ndarray, **kw: object) -> bytes:
    stream = io.BytesIO()
    tifffile.imwrite(stream, array, **kw)
    return stream.getvalue()


NOISE = np.random.default_rng(1).integers(0, 4096, (40, 50), dtype=np.uint16)


@settings(max_examples=30, deadline=None)
@given(
    bits=st.integers(1, 16),
    ending=st.sampled_from([".png", ".tif", ".TIFF"]),
    rows=st.integers(1, 20),
    cols=st.integers(1, 20),
    seed=st.integers(0, 2**32),
)
def test_inverse_write_then_read(tmp_path_factory: pytest.TempPathFactory, bits: int, ending: str, rows: int, cols: int, seed: int) -> None:
    path = tmp_path_factory.mktemp("frames") / f"a{ending}"
    array = np.random.default_rng(seed).integers(0, 1 << bits, (rows, cols))
    write_frame(path, array, bits)
    again = read_frame(path)
    assert again.dtype == (np.uint8 if bits <= 8 else np.uint16)
    np.testing.assert_array_equal(again, array)


@pytest.mark.parametrize(
    "kw", [{}, {"compression": "zlib", "predictor": True}, {"compression": "lzw"}, {"byteorder": ">"}, {"tile": (16, 16)}]
)
def test_other_programs_tiffs_are_read_exactly(kw: dict[str, object], tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(tiff_bytes(NOISE, **kw))
    again = read_frame(path)
    np.testing.assert_array_equal(again, NOISE)
    assert again.dtype == np.dtype("=u2")
    assert again.flags.c_contiguous


def test_npy_and_wrong_endings_are_read_by_content(tmp_path: Path) -> None:
    for order in "<>":
        np.save(tmp_path / "a.npy", NOISE.astype(f"{order}u2"))
        np.testing.assert_array_equal(read_frame(tmp_path / "a.npy"), NOISE)
        assert read_frame(tmp_path / "a.npy").dtype == np.dtype("=u2")
    (tmp_path / "b.tif").write_bytes(imagecodecs.png_encode(NOISE))
    np.testing.assert_array_equal(read_frame(tmp_path / "b.tif"), NOISE)


@pytest.mark.parametrize(
    "raw", [imagecodecs.png_encode(NOISE), tiff_bytes(NOISE), tiff_bytes(NOISE, compression="zlib")], ids=["png", "tiff", "zlib"]
)
@pytest.mark.parametrize("share", [0.1, 0.5, 0.99, -4])
def test_cut_off_files_are_refused(raw: bytes, share: float, tmp_path: Path) -> None:
    path = tmp_path / "a.img"
    path.write_bytes(raw[: int(len(raw) * share)] if share > 0 else raw[:-12])
    assert "damaged or cut off" in refused(path)


def test_hidden_files_beside_images_are_no_images(tmp_path: Path) -> None:
    write_frame(tmp_path / "a.tif", NOISE, 16)
    (tmp_path / "._a.tif").write_bytes(b"what a system keeps beside it")
    (tmp_path / ".DS_Store").write_bytes(b"x")
    (tmp_path / "b.raw").write_bytes(bytes(6))
    assert picture_files([tmp_path]) == [tmp_path / "a.tif"]
    assert picture_files([tmp_path], raw=RawLayout(3, 2, "Mono8")) == [tmp_path / "a.tif", tmp_path / "b.raw"]


def test_png_without_its_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(imagecodecs.png_encode(NOISE)[:-12])  # all pixels are there, the closing IEND chunk is not
    assert "damaged or cut off (end of the image is missing)" in refused(path)


def test_changed_byte_in_a_png_is_refused(tmp_path: Path) -> None:
    raw = bytearray(imagecodecs.png_encode(NOISE))
    raw[len(raw) // 2] ^= 0x10
    path = tmp_path / "a.png"
    path.write_bytes(raw)
    assert "damaged" in refused(path)


def test_tiff_with_a_missing_strip_is_not_filled_with_zeros(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(tiff_bytes(NOISE, rowsperstrip=10))
    with tifffile.TiffFile(path, mode="r+") as tiff:
        counts = list(tiff.pages[0].databytecounts)
        tiff.pages[0].tags["StripByteCounts"].overwrite([*counts[:-1], 0])
    assert "pixel data are missing" in refused(path)


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        (b"", ["empty"]),
        (b"hello", ["not an image", "PNG, TIFF"]),
        (b"\xff\xd8\xff\xe0", ["JPEG", "without loss"]),
        (imagecodecs.png_encode(np.zeros((4, 5, 3), np.uint8)), ["colour", "4x5x3", "one grey channel"]),
        (imagecodecs.png_encode(np.full((4, 5, 4), 65535, np.uint16)), ["colour"]),
        (imagecodecs.png_encode(np.zeros((4, 5, 4), np.uint16)), ["transparent"]),
        (tiff_bytes(np.zeros((4, 5, 3), np.uint16), photometric="rgb"), ["colour"]),
        (tiff_bytes(np.zeros((3, 24, 25), np.uint16), photometric="minisblack"), ["a file with 3 images", "a.dat/0"]),
        (tiff_bytes(np.zeros((4, 5), np.float32)), ["float32", "integer"]),
        (tiff_bytes(np.zeros((4, 5), np.int16)), ["int16"]),
    ],
)
def test_what_is_not_a_frame_is_refused(raw: bytes, words: list[str], tmp_path: Path) -> None:
    path = tmp_path / "a.dat"
    path.write_bytes(raw)
    for word in words:
        assert word in refused(path)


def test_missing_file_is_refused(tmp_path: Path) -> None:
    assert "missing" in refused(tmp_path / "none.png")


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        ({"shape": (6, 9)}, ["9 x 6 pixels", "8 x 6", "one size"]),
        ({"dtype": "uint8"}, ["8-bit file", "12 bits are declared"]),
        ({"value": 4093}, ["value above the range of 12 bits", "4096", "0 to 4095", "at least 13"]),
        ({"shape": (6, 8, 3), "dtype": "uint8"}, ["colour"]),
    ],
)
def test_a_frame_that_does_not_fit_stops_the_stream(frame: dict[str, object], words: list[str], tmp_path: Path) -> None:
    campaign = load_campaign(put_campaign(tmp_path))
    put_frame(tmp_path / "b_1.png", **frame)
    with pytest.raises(InputError) as caught:
        for _ in FrameReader(campaign).frames(campaign.groups[1]):
            pass
    for word in ["b_1.png", *words]:
        assert word in str(caught.value)


def test_values_shifted_to_the_left_are_recognised(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(imagecodecs.png_encode(NOISE << 4))
    with pytest.raises(InputError, match="shifted to the left by 4 bits"):
        list(iter_frames([path], bits=12))


def test_depths_are_not_mixed_even_at_8_bits(tmp_path: Path) -> None:
    text = (HEAD + FRAMES).replace("bits: 12", "bits: 8")
    manifest = put_campaign(tmp_path, text)
    for name in ("d_0", "d_1", "b_0"):
        put_frame(tmp_path / f"{name}.png", dtype="uint8")
    put_frame(tmp_path / "b_1.png", dtype="uint16")
    campaign = load_campaign(manifest)
    assert campaign.frame_dtype == "uint8"
    with pytest.raises(InputError, match="b_1.png: 16-bit file in a campaign of 8-bit files"):
        list(FrameReader(campaign).frames(campaign.groups[1]))


def test_black_and_saturated_frames_pass_unchanged(tmp_path: Path) -> None:
    for i, value in enumerate((0, 4095)):
        (tmp_path / f"{i}.png").write_bytes(imagecodecs.png_encode(np.full((6, 8), value, np.uint16)))
        (frame,) = iter_frames([tmp_path / f"{i}.png"], bits=12)
        assert (frame == value).all()


def test_each_file_is_read_once_in_order_and_hashed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = load_campaign(put_campaign(tmp_path))
    opened: list[str] = []
    open_file = door.open_file
    for module in (door, images):
        monkeypatch.setattr(module, "open_file", lambda path: opened.append(Path(path).name) or open_file(path))
    reader = FrameReader(campaign, threads=2)
    frames = [frame for group in campaign.groups for frame in reader.frames(group)]
    assert [int(f[1, 1]) for f in frames] == [60, 61, 400, 402]
    assert sorted(opened) == ["b_0.png", "b_1.png", "campaign.yaml", "d_0.png", "d_1.png"]
    for record in reader.hashes.records():
        raw = (tmp_path / record["name"]).read_bytes()
        assert record == {"name": record["name"], "sha256": hashlib.sha256(raw).hexdigest(), "size_bytes": len(raw)}


@pytest.mark.parametrize("threads", [1, 3])
def test_memory_is_bounded_by_the_frames_in_flight(threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [put_frame(tmp_path / f"{i}.png", i) for i in range(60)]
    lock = threading.Lock()
    alive, most = 0, 0
    load_frame = images.load_frame

    def gone() -> None:
        nonlocal alive
        with lock:
            alive -= 1

    def counted(path: Path, *decoder: object) -> images.LoadedFrame:
        nonlocal alive, most
        frame = load_frame(path, *decoder)
        with lock:
            alive += 1
            most = max(most, alive)
        weakref.finalize(frame.array, gone)
        return frame

    monkeypatch.setattr(images, "load_frame", counted)
    values = [int(frame[1, 1]) for frame in iter_frames(paths, bits=12, threads=threads)]
    assert values == list(range(60))
    # 2 * threads in flight, and one each held by the generator and by the loop
    assert most <= 2 * threads + 2


def test_write_frame_refuses_what_would_be_lost(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="do not fit into 10 bits"):
        write_frame(tmp_path / "a.png", np.array([[1024]]), 10)
    with pytest.raises(InputError, match="do not fit"):
        write_frame(tmp_path / "a.png", np.array([[-1]]), 10)
    with pytest.raises(InputError, match="not a grey image of integers"):
        write_frame(tmp_path / "a.png", np.array([[0.5]]), 10)
    with pytest.raises(InputError, match="unknown ending"):
        write_frame(tmp_path / "a.jpg", np.array([[1]]), 10)
    with pytest.raises(InputError, match="bits cannot be stored"):
        write_frame(tmp_path / "a.png", np.array([[1]]), 17)
    assert list(tmp_path.iterdir()) == []


@settings(max_examples=200, deadline=None)
@given(
    raw=st.sampled_from([imagecodecs.png_encode(NOISE), tiff_bytes(NOISE), tiff_bytes(NOISE, compression="zlib")]),
    at=st.integers(0, 300),
    junk=st.binary(min_size=1, max_size=8),
)
def test_no_damage_brings_forth_any_other_exception(tmp_path_factory: pytest.TempPathFactory, raw: bytes, at: int, junk: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.img"
    path.write_bytes(raw[:at] + junk + raw[at + len(junk) :])
    try:
        frame = read_frame(path)
    except InputError:
        return
    assert frame.ndim == 2
    assert frame.dtype in (np.uint8, np.uint16)
