"""Files that are made to exhaust the machine, or that have no end: refused in one sentence, soon, before their content is decoded."""

from __future__ import annotations

import base64
import io
import json
import os
import struct
import threading
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile

from cli.test_commands import CAMERA, DISCS, refused, run
from pixmetry.assess.judge.subjects import load_subject
from pixmetry.assess.known_geometry import _array as height_map
from pixmetry.assess.position_tables import read_positions
from pixmetry.bench.result import read_result
from pixmetry.calibrate.files.record import read_calibration, unpacked
from pixmetry.calibrate.project.cameras import read_start
from pixmetry.calibrate.project.tables import read_table
from pixmetry.camera.camera import load_camera
from pixmetry.core import door
from pixmetry.core.config import load_yaml, parse_yaml
from pixmetry.core.errors import InputError
from pixmetry.files import load_campaign, read_frame, read_maps
from pixmetry.files.assessment import load_assessment
from pixmetry.files.formats import frames_of
from pixmetry.files.images import read_picture
from pixmetry.files.raw_values import RawLayout
from pixmetry.files.told import told_by_file

SOON_S = 30.0  # to read, unpack or wait would take for ever
READERS: dict[str, Callable[[Path], object]] = {
    "x.json": read_positions,
    "subject.json": load_subject,
    "view.json": read_result,
    "results.json": load_assessment,
    "calibration.json": read_calibration,
    "start.json": lambda path: read_start(path, "a"),
    "camera.yaml": load_camera,
    "campaign.yaml": load_campaign,
    "settings.yaml": load_yaml,
    "table.csv": read_table,
    "x.csv": read_positions,
    "view.csv": read_result,
    "x.png": read_frame,
    "x.tif": read_picture,
    "x.npy": height_map,
    "set.txt": load_campaign,
    "cameras.txt": lambda path: read_start(path, "a"),
    "a.xml": lambda path: read_start(path, "a"),
    "a.cameramodel": lambda path: read_start(path, "a"),
    "sheet.xml": load_subject,
}


@contextmanager
def soon(*words: str) -> Iterator[None]:
    """What is inside is refused, with these words, in one line and without delay."""
    begin = time.monotonic()
    with pytest.raises(InputError) as caught:
        yield
    assert time.monotonic() - begin < SOON_S
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def sparse(path: Path, size: int, head: bytes = b"") -> Path:
    """A file with a hole: as large as one likes, and hardly anything on the disk."""
    with path.open("wb") as file:
        file.write(head)
        try:
            file.truncate(size)
        except OSError:
            pytest.skip("no files with holes here")
    return path


@pytest.mark.parametrize("name", READERS)
def test_a_pipe_is_not_waited_for(name: str, tmp_path: Path) -> None:
    if not hasattr(os, "mkfifo"):
        pytest.skip("no pipes with names")
    os.mkfifo(tmp_path / name)
    done: list[BaseException] = []

    def read() -> None:
        try:
            READERS[name](tmp_path / name)
        except BaseException as problem:
            done.append(problem)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(SOON_S)
    assert done and isinstance(done[0], InputError) and "\n" not in str(done[0]), done


@pytest.mark.parametrize("name", READERS)
def test_a_huge_file_with_a_hole_is_not_read(name: str, tmp_path: Path) -> None:
    head = {".json": b"{", ".png": b"\x89PNG\r\n\x1a\n", ".tif": b"II*\0", ".npy": b"\x93NUMPY", ".xml": b"<calibration>"}
    path = sparse(tmp_path / name, 4 << 40, head.get(Path(name).suffix, b""))
    with soon(name):
        READERS[name](path)
    told_by_file(path)


@pytest.mark.parametrize("name", [name for name in READERS if name.endswith(".json")])
@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, '{"schema": "x", "a": ' + "[" * 300 + "]" * 300 + "}"])
def test_json_that_is_nested_without_end_is_refused(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with soon(name):
        READERS[name](tmp_path / name)


def laughs(item: str, close: str) -> str:
    """Ten lists of ten aliases each: 10^10 values in a kilobyte."""
    lines = [f"a: &a {item}"]
    for one, other in zip("abcdefghi", "bcdefghij", strict=True):
        lines.append(f"{other}: &{other} " + close.format(", ".join([f"*{one}"] * 10)))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("a: " + "[" * 1000 + "]" * 1000, "nested too deep"),
        ("\n".join(" " * k + "a:" for k in range(100)) + " 1", "nested too deep"),
        ("a: " + "[" * 70 + "]" * 70, "nested too deep"),
        (laughs("[1, 2, 3]", "[{}]"), "aliases"),
        (laughs("{x: 1}", "{{<<: [{}], y: 1}}"), "aliases"),
        ("a: &a [*a]", "contains itself"),
        ("a: !!int ''", "not valid YAML"),
        ("a: " + "9" * 5000, "not valid YAML"),
        ("a: !!python/object/apply:os.system [ls]", "not valid YAML"),
    ],
)
def test_yaml_that_is_made_to_exhaust_is_refused(text: str, word: str) -> None:
    with soon(word):
        parse_yaml(text)


def test_yaml_with_aliases_and_merge_keys_is_read_as_it_is_meant() -> None:
    found = parse_yaml("a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\nc: [*a, *a]\n")
    assert found == {"a": {"x": 1, "y": 2}, "b": {"x": 1, "y": 3}, "c": [{"x": 1, "y": 2}] * 2}
    assert found.lines[("b", "y")] == 2 and found.lines[("c", 0)] == 1
    assert parse_yaml("a: " + "[" * 60 + "]" * 60)


def test_settings_that_are_too_long_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_bytes(b"#" * (door.MOST_SETTINGS_BYTES + 1))
    with soon("8 MiB"):
        load_yaml(tmp_path / "a.yaml")


def png_of(cols: int, rows: int) -> bytes:
    """The beginning and the end of a PNG of that size."""
    parts = ((b"IHDR", struct.pack(">IIBBBBB", cols, rows, 16, 0, 0, 0, 0)), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts)


@pytest.mark.parametrize("kind", ["png", "jpeg", "npy", "tiff", "bmp"])
def test_an_image_larger_than_any_sensor_is_refused_by_its_header(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{kind}"
    if kind == "png":
        path.write_bytes(png_of(60000, 60000))
    elif kind == "jpeg":
        raw = imagecodecs.jpeg8_encode(np.zeros((8, 8), np.uint8))
        at = raw.index(b"\xff\xc0")
        path.write_bytes(raw[: at + 5] + b"\xff\xff\xff\xff" + raw[at + 9 :])
    elif kind == "npy":
        text = b"{'descr': '<u2', 'fortran_order': False, 'shape': (60000, 60000), }".ljust(117) + b"\n"
        sparse(path, 128 + 2 * 60000**2, b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text)
    elif kind == "tiff":
        stream = io.BytesIO()
        tifffile.imwrite(stream, np.zeros((2, 2), np.uint16))
        raw = stream.getvalue()
        for tag in (256, 257, 278):  # width, length, rows of a strip
            at = raw.index(struct.pack("<HH", tag, 3 if raw.find(struct.pack("<HH", tag, 3)) >= 0 else 4))
            raw = raw[: at + 2] + struct.pack("<HII", 4, 1, 60000) + raw[at + 12 :]
        at = raw.index(struct.pack("<H", 279))
        raw = raw[: at + 2] + struct.pack("<HII", 4, 1, 2 * 60000**2 % 2**32 or 1) + raw[at + 12 :]
        sparse(path, 8 * 60000**2, raw)
    else:
        sparse(path, 60000**2 + 5000, b"BM" + struct.pack("<IIIIiiHHI", 0, 0, 1078, 40, 60000, 60000, 1, 8, 0).ljust(1076, b"\0"))
    with soon(path.name):
        read_picture(path)


def test_a_jpeg_that_is_cut_is_refused(tmp_path: Path) -> None:
    raw = imagecodecs.jpeg8_encode(np.random.default_rng(1).integers(0, 256, (64, 64), dtype=np.uint8))
    (tmp_path / "a.jpg").write_bytes(raw[: len(raw) * 6 // 10])
    with soon("a.jpg", "cut off"):
        read_picture(tmp_path / "a.jpg")


def test_a_tiff_that_lists_half_of_its_strips_is_refused_as_frame_and_as_height_map(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.arange(64, dtype=np.float32).reshape(8, 8), rowsperstrip=1)
    with tifffile.TiffFile(path) as file:
        places = [file.pages[0].tags[tag].offset for tag in (273, 279)]
    assert height_map(path).sum() == 2016
    raw = bytearray(path.read_bytes())
    for at in places:
        raw[at + 4 : at + 8] = struct.pack("<I", 4)
    path.write_bytes(raw)
    with soon("4 of 8 strips"):
        read_picture(path)
    with soon("4 of 8 strips"):
        height_map(path)


def test_a_tiff_that_does_not_say_what_is_white_is_black_at_zero(tmp_path: Path) -> None:
    """The tag that some recorders leave out: values rise with the light, as libtiff and ImageJ have it."""
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.arange(64, dtype=np.uint16).reshape(8, 8))
    with tifffile.TiffFile(path) as file:
        at = file.pages[0].tags[262].offset
    raw = bytearray(path.read_bytes())
    raw[at : at + 2] = struct.pack("<H", 263)
    path.write_bytes(raw)
    np.testing.assert_array_equal(read_frame(path), np.arange(64).reshape(8, 8))


def test_a_file_of_more_frames_than_are_worked_on_is_refused(tmp_path: Path) -> None:
    with soon("frames", "1000000"):
        frames_of(sparse(tmp_path / "a.raw", 40 << 30), RawLayout(2, 2, "Mono8"))


def test_what_is_packed_may_not_be_larger_than_what_is_told(tmp_path: Path) -> None:
    packed = base64.b64encode(zlib.compress(bytes(10_000_000))).decode()
    with pytest.raises(ValueError, match="more than 24 bytes"):
        unpacked({"size": 2, "data": packed})
    with pytest.raises(ValueError, match="unknowns"):
        unpacked({"size": 10**9, "data": packed})
    with pytest.raises(InputError, match="memory"):
        unpacked({"size": 10**6, "data": packed})
    with zipfile.ZipFile(tmp_path / "maps.zarr.zip", "w") as archive:
        archive.writestr("zarr.json", json.dumps({"zarr_format": 3, "node_type": "group", "attributes": {}}))
    raw = bytearray((tmp_path / "maps.zarr.zip").read_bytes())
    at = raw.index(b"PK\x01\x02")
    raw[at + 24 : at + 28] = b"\xfe\xff\xff\xff"
    (tmp_path / "maps.zarr.zip").write_bytes(raw)
    with soon("maps.zarr.zip"):
        read_maps(tmp_path / "maps.zarr.zip")


def test_a_store_that_tells_of_frames_without_end_is_refused(tmp_path: Path) -> None:
    zarr = pytest.importorskip("zarr")
    store = tmp_path / "frames.zarr"
    zarr.create_group(store, zarr_format=3).create_array("frames", data=np.ones((2, 4, 4), np.uint16), chunks=(1, 4, 4))
    text = (store / "frames" / "zarr.json").read_text()
    for shape, chunks in (
        ([1, 10**9, 10**9], [1, 10**9, 10**9]),
        ([10**9, 4, 4], [10**9, 4, 4]),
        ([1, 30000, 30000], [10**5, 30000, 30000]),
    ):
        record = json.loads(text)
        record["shape"], record["chunk_grid"]["configuration"]["chunk_shape"] = shape, chunks
        (store / "frames" / "zarr.json").write_text(json.dumps(record))
        with soon("frames.zarr"):
            read_frame(store / "0")


def test_a_store_in_large_shards_is_read_by_the_frame(tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """A shard is no chunk: it need not fit into the memory; the last one is not full."""
    zarr = pytest.importorskip("zarr")
    frames = rng.integers(0, 4096, (7, 1000, 1000)).astype(np.uint16)
    store = tmp_path / "frames.zarr"
    group = zarr.create_group(store, zarr_format=3)
    group.create_array("frames", data=frames, chunks=(1, 1000, 1000), shards=(4, 1000, 1000))
    monkeypatch.setattr("pixmetry.core.memory.available_bytes", lambda: 2 * 2 * frames[0].size + 1)
    np.testing.assert_array_equal(read_frame(store / "6"), frames[6])
    (store / "frames" / "c" / "1" / "0" / "0").unlink()
    (store / "frames" / "zarr.json").touch()
    with pytest.raises(InputError, match="frames are missing"):
        read_frame(store / "0")


def test_a_camera_that_does_not_fit_is_refused_by_every_command(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA.replace("rows: 64", "rows: 90000").replace("cols: 96", "cols: 90000"))
    (tmp_path / "scene.yaml").write_text(DISCS)
    assert "GiB of memory" in run("budget", tmp_path / "camera.yaml").output  # a row that needs whole frames is left out, and said
    refused(run("simulate", tmp_path / "camera.yaml", tmp_path / "scene.yaml", "-o", tmp_path / "out"), "memory")
    with soon("pixels"):
        replace(load_camera("imx250"), frame_shape=(600000, 600000))


def test_a_trillion_frames_are_refused_before_the_first(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "scene.yaml").write_text(DISCS)
    result = run("simulate", tmp_path / "camera.yaml", tmp_path / "scene.yaml", "-o", tmp_path / "out", "-n", 10**12)
    refused(result, "1000000000000 frames")


@pytest.mark.parametrize(
    "matrix", ["5", "[1, 2, 3]", "{rows: 3}", "!!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n   data: [ 5. ]", "~"]
)
def test_a_camera_matrix_that_is_none_is_refused(matrix: str, tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    path = tmp_path / "a.yml"
    path.write_text(f"%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: {matrix}\ndistortion_coefficients: 5\n")
    with soon("a.yml"):
        read_start(path, "a")


def test_an_error_of_a_library_is_one_sentence_and_ours_passes() -> None:
    for problem, word in (
        (KeyError("c"), "'c' is missing"),
        (IndexError("a\nb"), "(a)"),
        (RecursionError(), "deep"),
        (MemoryError(), "memory"),
    ):
        with pytest.raises(InputError, match="a.x") as caught, door.one_sentence("not a file of x", "a.x"):
            raise problem
        assert word in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(InputError, match="^mine$"), door.one_sentence("not a file of x", "a.x"):
        raise InputError("mine")
