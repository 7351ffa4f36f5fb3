"""Damage small valid files at random, and open them at every door of the package: each must be read, or refused in one sentence.

python scripts/fuzz.py [--seconds 60] [--cases N] [--seed 0] [--only DOOR] [--list]

Counts tracebacks (any exception but those of pixmetry), silent wrong answers (what a reference reads otherwise, or a sealed result that was
changed and is read with other values), cases longer than 20 s, and the memory that the process took. A case is named DOOR:NUMBER and is the
same in every run with the same seed. Failures stand in one line each; the exit status is 1 if there are any.
"""

from __future__ import annotations

import argparse
import faulthandler
import io
import json
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.core.errors import PixmetryError

LONGEST_S = 20
MEMORY_BYTES = 4 << 30  # beyond what the process has when it starts
STATED_BYTES = 1 << 30  # the bound on what any case may add
TOKENS = (
    *(b"]", b"[", b"{", b"}", b":", b": ", b"#", b"&a ", b"*a ", b"!!python/x ", b"|", b">", b"'", b'"', b"\t", b"\0", b"~", b"? ", b"- "),
    *(b"%", b"<<: ", b",", b";", b"\n", b"\r", b"\n\n", b"\xff", b"\xc2\x85", b"\xe2\x80\xa8", b"</", b"<a>", b"&amp;", b"]]>", b"<!--"),
    *(b"null", b"true", b"NaN", b"inf", b"-inf", b'"inf"', b"{}", b"[]", b"''", b"[" * 80, b"{" * 80, b'{"a":' * 80, b"a: " * 3),
    *(b"0", b"-1", b"1e300", b"1e999", b"-1e300", b"1e-300", b"999999999999", b"2147483648", b"18446744073709551616", b"0x10", b"1,5"),
    *(b"\xff\xff", b"\xff\xff\xff\xff", b"\0\0\0\0", b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x80\0\0\0"),
)


@dataclass(frozen=True)
class Door:
    """A way in: the valid files, which of them is damaged, and how it is read.

    Parameters
    ----------
    files : dict of bytes
        By name; the first one is damaged.
    read : callable
        From the path of the damaged file to values that can be compared, or None.
    sealed : bool
        Whether every change must be refused, or change nothing.
    reference : callable, optional
        From the damaged bytes to what another program reads; an exception where it refuses them.
    """

    files: dict[str, bytes]
    read: Callable[[Path], Any]
    sealed: bool = False
    reference: Callable[[bytes], Any] | None = None


def mutated(raw: bytes, draw: np.random.Generator) -> bytes:
    """A damaged copy: one to four changes of bytes, tokens, lines or lengths."""
    out = bytearray(raw)
    for _ in range(int(draw.integers(1, 5))):
        at, way = int(draw.integers(len(out) + 1)), int(draw.integers(9))
        near = int(min(len(out), at + draw.integers(1, 40)))
        if way == 0 and at < len(out):
            out[at] ^= 1 << int(draw.integers(8))
        elif way == 1 and at < len(out):
            out[at] = int(draw.integers(256))
        elif way == 2:
            out[at:at] = TOKENS[int(draw.integers(len(TOKENS)))]
        elif way == 3:
            token = TOKENS[int(draw.integers(len(TOKENS)))]
            out[at : at + len(token)] = token
        elif way == 4:
            del out[at:near]
        elif way == 5:
            out[at:at] = out[at:near] * int(draw.integers(1, 4))
        elif way == 6 and draw.random() < 0.3:
            del out[at:]
        elif way == 7:  # a word for a token
            end = at
            while end < len(out) and (chr(out[end]).isalnum() or out[end] in b"._+-"):
                end += 1
            out[at:end] = TOKENS[int(draw.integers(len(TOKENS)))]
        elif way == 8:  # a line that goes, or comes twice
            start, stop = out.rfind(b"\n", 0, at) + 1, out.find(b"\n", at) + 1 or len(out)
            out[start:stop] = out[start:stop] * (2 * int(draw.integers(2)))
    return bytes(out)


def _written(write: Callable[..., object], *arguments: object, **options: object) -> bytes:
    stream = io.BytesIO()
    write(stream, *arguments, **options)
    return stream.getvalue()


def _fits(image: np.ndarray) -> bytes:
    cards = ["SIMPLE  =                    T", "BITPIX  =                   16", f"NAXIS   = {image.ndim:20d}"]
    cards += [f"NAXIS{k + 1}  = {n:20d}" for k, n in enumerate(image.shape[::-1])]
    head = "".join(card.ljust(80) for card in [*cards, "BZERO   =              32768.0", "END"]).encode()
    data = (image.astype(int) - 32768).astype(">i2").tobytes()
    return head.ljust(2880) + data.ljust(2880, b"\0")


def _pillow(raw: bytes) -> np.ndarray | None:
    """The grey values as Pillow reads them; None where it has another form than ours."""
    from PIL import Image, ImageFile

    ImageFile.LOAD_TRUNCATED_IMAGES = False
    with Image.open(io.BytesIO(raw)) as image:
        if image.mode not in ("L", "I;16", "I;16B") or getattr(image, "n_frames", 1) > 1 or image.info.get("transparency") is not None:
            return None
        # Pillow leaves 16-bit WhiteIsZero as it is, and takes 0 as white where nothing is said.
        if image.format == "TIFF" and (262 not in image.tag_v2 or (image.mode != "L" and image.tag_v2[262] == 0)):
            return None
        image.load()
        return np.asarray(image)


def image_doors() -> Iterator[tuple[str, Door]]:
    """Images, as frames and as pictures; decoded by Pillow too where it knows them."""
    import imagecodecs
    import tifffile
    from PIL import Image

    from pixmetry.files.formats import frames_of
    from pixmetry.files.images import read_frame, read_picture
    from pixmetry.files.told import told_by_file

    draw = np.random.default_rng(11)
    deep, pages = draw.integers(0, 4096, (9, 13), dtype=np.uint16), draw.integers(0, 4096, (3, 9, 13), dtype=np.uint16)
    grey = (deep >> 4).astype(np.uint8)

    def read(path: Path) -> Any:
        told_by_file(path)
        names = frames_of(path)[:4]
        pictures = [read_picture(name, "green") for name in names]
        assert all(p.ndim == 2 and p.size and p.dtype in (np.uint8, np.uint16, np.float32) for p in pictures)
        if path.suffix == ".jpg":
            return pictures[0]
        return read_frame(names[0]) if len(names) == 1 else [read_frame(name) for name in names]

    found = {
        "png16": ("a.png", imagecodecs.png_encode(deep), _pillow),
        "png8": ("a.png", _written(Image.fromarray(grey).save, format="PNG"), _pillow),
        "tiff": ("a.tif", _written(tifffile.imwrite, deep, rowsperstrip=4), _pillow),
        "tiff_zlib": ("a.tif", _written(tifffile.imwrite, deep, compression="zlib", tile=(16, 16)), _pillow),
        "tiff_pages": ("a.tif", _written(tifffile.imwrite, pages, photometric="minisblack", metadata=None), None),
        "tiff_big": ("a.tif", _written(tifffile.imwrite, deep, bigtiff=True), None),
        "tiff_palette": ("a.tif", _written(tifffile.imwrite, grey, photometric="palette", colormap=np.zeros((3, 256), np.uint16)), None),
        "tiff_jpeg": ("a.tif", _written(Image.fromarray(grey).save, format="TIFF", compression="jpeg"), None),
        "jpeg": ("a.jpg", _written(Image.fromarray(grey).save, format="JPEG", quality=90), None),
        "jpeg_progressive": ("a.jpg", _written(Image.fromarray(grey).save, format="JPEG", progressive=True), None),
        "bmp": ("a.bmp", _written(Image.fromarray(grey).save, format="BMP"), _pillow),
        "npy": ("a.npy", _written(np.save, pages), lambda raw: list(np.load(io.BytesIO(raw), allow_pickle=False))),
        "fits": ("a.fits", _fits(pages), None),
    }
    for name, (file, raw, reference) in found.items():
        yield name, Door({file: raw}, read, reference=reference)


SHEET = """schema: pixmetry/data_sheet/1
name: a
rows: 64
cols: 96
pitch_um: 5
bits: 12
sensor: cmos
shutter: global
snr_max_db: 40.3
dynamic_range_db: 71.2
"""
CAMERA = """schema: pixmetry/camera/1
name: test camera
rows: 64
cols: 96
pitch_x_um: 5.0
pitch_y_um: 5.0
chain:
- source: sensor.quantum_efficiency
  parameters: {quantum_efficiency: 0.5}
- source: sensor.prnu
  parameters: {pixel_std_rel: 0.02}
- source: sensor.shot_noise
- source: electronics.gain
  parameters: {gain_dn_per_e: 0.2}
- source: grabber.adc
  parameters: {bits: 12, offset_dn: 40}
"""
CAMPAIGN = """schema: pixmetry/campaign/1
camera: {name: test camera, bits: 12, pitch_um: 5.0, sensor: cmos}
optics: {wavelength_nm: 500, light_source: LED}
frames:
  - {kind: dark, exposure_s: 0.01, files: ["d_*.png"]}
  - {kind: bright, exposure_s: 0.01, photons: 1000, files: [b_0.png, b_1.png]}
"""
DESCRIPTOR = "v 4.0\n# a set\nn 12 8 6\nd 10000000\ni d_0.png\ni d_1.png\nb 10000000 1000.5\ni b_0.png\ni b_1.png\n"
SCENE = """schema: pixmetry/scene/1
uniform: {level_photons: 300}
discs: {lattice_px: 24, peak_photons: 14000}
"""
LIMITS = """schema: pixmetry/limits/1
limits:
  quantum_efficiency: {min: 50}
  "sensor.prnu.pixel_std_rel": {max: 0.01}
"""
SCENARIO = "schema: pixmetry/scenario/1\ncount: {frames: 4, targets: 10}\n"
PROJECT = """schema: pixmetry/calibration/1
cameras: {name: a, cols: 640, rows: 480, pitch_um: 5.0, c_mm: 8.0}
observations: {table: obs.csv, u_px: 0.04}
points: {table: pts.csv, known: weighted, u: 0.1}
"""
OBSERVATIONS = "image,point,x_px,y_px\n" + "".join(
    f"i{k},p{j},{100.5 + 40 * j + k},{200.25 + 13 * j * k}\n" for k in range(2) for j in range(6)
)
POINTS = "point,X,Y,Z\n" + "".join(f"p{j},{10.0 * j},{5.0 * j * j},{j % 3}\n" for j in range(6))
POSITIONS = '# made by hand\nx_px,y_px,u_x_px,u_y_px\n1.5,2.25,0.01,0.01\n3,4,0.02,0.02\n"5",6,0.03,0.03\n'
COLMAP = "# Camera list\n1 FULL_OPENCV 640 480 900 905 320 240 0.1 0.01 0 0 0 0 0 0\n"
ROS = """image_width: 640
image_height: 480
camera_name: a
camera_matrix: {rows: 3, cols: 3, data: [900, 0, 320, 0, 905, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0.01, 0, 0, 0]}
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: [0.1, 0.01, 0, 0]
  intrinsics: [900, 905, 320, 240]
  resolution: [640, 480]
"""
MRCAL = "{'lensmodel': 'LENSMODEL_OPENCV4', 'intrinsics': [900.0, 905.0, 319.5, 239.5, 0.1, 0.01, 0, 0], 'imagersize': [640, 480]}"
METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<calibration><projection>frame</projection><width>640</width><height>480</height><f>900</f><cx>1</cx><cy>2</cy><k1>0.1</k1></calibration>
"""
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 900., 0., 320., 0., 905., 240., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.1, 0.01, 0., 0., 0. ]
"""
TIMES = "file,time_s\na.png,0.5\nb.png,1.5\n"


def text_doors() -> Iterator[tuple[str, Door]]:
    """Settings, tables, and the files of other programs."""
    import imagecodecs

    from pixmetry.assess.judge.conformity import load_limits
    from pixmetry.assess.position_tables import read_positions
    from pixmetry.bench.result import read_result
    from pixmetry.budget.scenario import read_scenario
    from pixmetry.calibrate.project.cameras import read_start
    from pixmetry.calibrate.project.project import load_project
    from pixmetry.calibrate.project.tables import read_table
    from pixmetry.camera.camera import load_camera
    from pixmetry.files import load_campaign
    from pixmetry.locate.files import read_places
    from pixmetry.scene.files import read_scene
    from pixmetry.series.job import _from_table

    frames = {
        f"{n}.png": imagecodecs.png_encode(np.full((6, 8), v, np.uint16)) for n, v in (("d_0", 60), ("d_1", 61), ("b_0", 400), ("b_1", 402))
    }
    located = {
        "schema": "pixmetry/located/1",
        "targets": [{"x_px": 1.5, "y_px": 2, "u_x_px": 0.1, "u_y_px": 0.1}, {"x_px": 3, "y_px": 4, "u_x_px": 0.1, "u_y_px": 0.2}],
    }

    def start(path: Path) -> Any:
        return read_start(path, "a")

    plain = {
        "camera": ("camera.yaml", CAMERA, load_camera),
        "data_sheet": ("sheet.yaml", SHEET, load_camera),
        "scene": ("scene.yaml", SCENE, read_scene),
        "limits": ("limits.yaml", LIMITS, load_limits),
        "scenario": ("scenario.yaml", SCENARIO, read_scenario),
        "table": ("t.csv", OBSERVATIONS, read_table),
        "positions": ("t.csv", POSITIONS, read_positions),
        "positions_json": ("t.json", json.dumps(located), read_positions),
        "places": ("t.csv", "x_px,y_px\n1,2\n3,4\n", read_places),
        "times": ("t.csv", TIMES, lambda path: _from_table([Path("a.png"), Path("b.png")], path)),
        "view_csv": ("t.csv", POSITIONS, read_result),
        "view_json": ("t.json", json.dumps({"schema": "pixmetry/x/1", "a": {"b": [1, 2], "c": [3, 4]}, "d": [{"e": 1}]}), read_result),
        "colmap": ("cameras.txt", COLMAP, start),
        "ros": ("a.yaml", ROS, start),
        "kalibr": ("a.yaml", KALIBR, start),
        "mrcal": ("a.cameramodel", MRCAL, start),
        "metashape": ("a.xml", METASHAPE, start),
        "opencv": ("a.yml", OPENCV, start),
    }
    for name, (file, text, read) in plain.items():
        yield name, Door({file: text.encode()}, read)
    yield "campaign", Door({"campaign.yaml": CAMPAIGN.encode(), **frames}, load_campaign)
    yield "descriptor", Door({"set.txt": DESCRIPTOR.encode(), **frames}, load_campaign)
    tables = {"obs.csv": OBSERVATIONS.encode(), "pts.csv": POINTS.encode()}
    yield "project", Door({"project.yaml": PROJECT.encode(), **tables}, load_project)


def result_doors() -> Iterator[tuple[str, Door]]:
    """Results that are read again: what was changed in them must be refused."""
    from pixmetry.assess.judge.subjects import load_subject
    from pixmetry.emva.files.sheets import read_sheet
    from pixmetry.emva.job import emva1288
    from pixmetry.files import read_maps, write_maps

    with tempfile.TemporaryDirectory() as folder:
        sheet, maps = Path(folder, "sheet.json"), Path(folder, "maps.zarr.zip")
        emva1288(json=sheet, xml=Path(folder, "sheet.xml"), bootstrap=0)
        small = json.loads(sheet.read_text())
        small["curves"] = dict(list(small["curves"].items())[:1])
        from pixmetry.core.checksums import sealed
        from pixmetry.files.strict_json import json_text

        text = json_text(sealed(small)).encode()
        write_maps(maps, {"a": np.arange(12.0).reshape(3, 4), "b": np.zeros((5, 5), np.uint8)}, {"camera": "a"})
        files = {"maps.zarr.zip": maps.read_bytes()}
        xml = Path(folder, "sheet.xml").read_bytes()

    def values(path: Path) -> Any:
        return [(name, repr(v.value), repr(v.u)) for result in read_sheet(path).results for name, v in result.values.items()]

    def subject(path: Path) -> Any:
        return [(name, repr(v.value), repr(v.u)) for name, v in load_subject(path).values.items()]

    yield "sheet_json", Door({"sheet.json": text}, values, sealed=True)
    yield "subject", Door({"sheet.json": text}, subject, sealed=True)
    yield "sheet_xml", Door({"sheet.xml": xml}, values)
    yield "maps", Door(files, lambda path: [(k, v.tolist()) for k, v in read_maps(path)[0].items()], sealed=True)
    without = {k: v for k, v in json.loads(text).items() if k != "checksums"}
    yield "sheet_unsealed", Door({"sheet.json": json.dumps(without).encode()}, values)


@cache
def doors() -> dict[str, Door]:
    """Every door by its name."""
    return {**dict(image_doors()), **dict(text_doors()), **dict(result_doors())}


class TooLong(BaseException):
    """A case that takes longer than `LONGEST_S`."""


def same(one: Any, other: Any) -> bool:
    """Whether two readings are equal, arrays by their values."""
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return np.array_equal(one, other)
    return bool(one == other)


def one_case(name: str, number: int, seed: int, folder: Path) -> str:
    """Run a case; the failure in one line, or nothing."""
    door = doors()[name]
    draw = np.random.default_rng([seed, number, *name.encode()])
    file = next(iter(door.files))
    raw = mutated(door.files[file], draw)
    place = folder / f"{name}-{number}"
    place.mkdir()
    try:
        for other, content in door.files.items():
            (place / other).write_bytes(content)
        path = place / file
        path.write_bytes(raw)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                found = door.read(path)
        except PixmetryError as problem:
            return f"several lines: {problem}" if "\n" in str(problem) else ""
        except TooLong:
            return f"longer than {LONGEST_S} s"
        except BaseException as problem:
            if isinstance(problem, KeyboardInterrupt):
                raise
            at = traceback.extract_tb(problem.__traceback__)
            ours = [f"{Path(f.filename).name}:{f.lineno}" for f in at if "pixmetry" in f.filename]
            return f"{type(problem).__name__}: {str(problem)[:100]!r} at {' < '.join(ours[::-1][:3])}"
        if door.sealed and raw != door.files[file]:
            path.write_bytes(door.files[file])
            if not same(found, door.read(path)):
                return "silent: a changed result is read with other values"
        if door.reference is not None:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    wanted = door.reference(raw)
            except Exception:  # it refuses what we read: that is judged by nobody
                return ""
            if wanted is not None and not same(found, wanted):
                return "silent: another program reads other values"
        return ""
    finally:
        for left in place.iterdir():
            left.unlink()
        place.rmdir()


def _alarm(*_: object) -> None:
    raise TooLong


def run(names: list[str], seed: int, seconds: float, cases: int, first: int = 0) -> Iterator[tuple[str, int, str]]:
    """Run cases over the doors in turn, until the time or the number of cases is up; yields door, number and failure."""
    stop, done = time.monotonic() + seconds, 0
    signal.signal(signal.SIGALRM, _alarm)
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        number = first
        while time.monotonic() < stop and done < cases:
            for name in names:
                signal.alarm(LONGEST_S)
                try:
                    failure = one_case(name, number, seed, Path(folder))
                finally:
                    signal.alarm(0)
                yield name, number, failure
                done += 1
                if done >= cases:
                    break
            number += 1


def _guarded(names: list[str], arguments: argparse.Namespace) -> tuple[int, dict[str, int], int]:
    """Run in children, so that what kills one of them (a fault in a C library, the limit on memory) is a failure too."""
    stop, done, number = time.monotonic() + arguments.seconds, 0, arguments.first
    failures: dict[str, int] = {}
    most = 0
    doors()
    while time.monotonic() < stop and done < arguments.cases:
        receive, send = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(receive)
            faulthandler.enable()
            taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY_BYTES,) * 2)
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            with os.fdopen(send, "w") as out:
                for name, k, failure in run(names, arguments.seed, min(stop - time.monotonic(), 60), arguments.cases - done, number):
                    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
                    out.write(json.dumps([name, k, failure, grown]) + "\n")
                    out.flush()
            os._exit(0)
        os.close(send)
        last = (names[-1], number - 1)
        with os.fdopen(receive) as lines:
            for line in lines:
                name, k, failure, grown = json.loads(line)
                last, done, most = (name, k), done + 1, max(most, grown)
                if failure:
                    failures[f"{name}: {failure}"] = failures.get(f"{name}: {failure}", 0) + 1
                    if failures[f"{name}: {failure}"] <= 3:
                        print(f"{name}:{k}  {failure}", flush=True)
        status = os.waitpid(child, 0)[1]
        number = last[1] + 1
        if status:
            what = f"after {last[0]}:{last[1]}: the process ended with status {status}"
            failures[what] = 1
            print(what, flush=True)
    return done, failures, most


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--cases", type=int, default=sys.maxsize)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--only", default="", help="doors whose names contain this")
    parser.add_argument("--list", action="store_true", help="only list the doors")
    arguments = parser.parse_args()
    names = [name for name in doors() if arguments.only in name]
    if arguments.list:
        print("\n".join(names))
        return 0
    for name in names:  # the files as they are must be read
        with tempfile.TemporaryDirectory() as folder:
            for file, raw in doors()[name].files.items():
                Path(folder, file).write_bytes(raw)
            doors()[name].read(Path(folder, next(iter(doors()[name].files))))
    done, failures, most = _guarded(names, arguments)
    print(
        f"{done} cases at {len(names)} doors: {sum(failures.values())} failures of {len(failures)} kinds; memory grew by {most >> 10} MiB"
    )
    return 1 if failures or most << 10 > STATED_BYTES else 0


if __name__ == "__main__":
    sys.exit(main())
