"""Files damaged byte by byte and cut at every place: an image of the right form, or one `InputError`; never another exception.

Deterministic. Where the content of a damaged file may still be lawful it is not asked what it shows, but a cut file is never read as whole.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import Image

from files.campaign_files import FRAMES, HEAD, put_campaign
from files.test_formats import UNSIGNED, fits, jpeg
from pixmetry.calibrate.project.tables import read_table
from pixmetry.core.errors import InputError
from pixmetry.files import load_campaign
from pixmetry.files.formats import frames_of
from pixmetry.files.images import read_frame, read_picture

IMAGE = np.random.default_rng(11).integers(0, 4096, (9, 13), dtype=np.uint16)
PAGES = np.random.default_rng(12).integers(0, 4096, (3, 9, 13), dtype=np.uint16)
CHANGES: tuple[Callable[[int], int], ...] = (lambda b: 0, lambda b: 255, lambda b: b ^ 0x80, lambda b: (b + 1) % 256)


def written(write: Callable[..., object], *arguments: object, **options: object) -> bytes:
    stream = io.BytesIO()
    write(stream, *arguments, **options)
    return stream.getvalue()


def samples() -> dict[str, tuple[bytes, int]]:
    """A small file of each kind, and how many bytes at its head are changed one by one (its structure)."""
    grey = (IMAGE >> 4).astype(np.uint8)
    signed = (PAGES.astype(int) - 32768).astype(np.int16)
    found = {
        "a.png": imagecodecs.png_encode(IMAGE),
        "plain.tif": written(tifffile.imwrite, IMAGE, rowsperstrip=4),
        "zlib.tif": written(tifffile.imwrite, IMAGE, compression="zlib", tile=(16, 16)),
        "pages.tif": written(tifffile.imwrite, PAGES, photometric="minisblack", metadata=None),
        "big.tif": written(tifffile.imwrite, IMAGE, bigtiff=True),
        "palette.tif": written(tifffile.imwrite, grey, photometric="palette", colormap=np.zeros((3, 256), np.uint16)),
        "jpeg.tif": written(Image.fromarray(grey).save, format="TIFF", compression="jpeg"),
        "a.jpg": jpeg(grey),
        "p.jpg": jpeg(grey, progressive=True),
        "a.bmp": written(Image.fromarray(grey).save, format="BMP"),
        "a.npy": written(np.save, PAGES),
        "a.fits": fits(signed, *UNSIGNED),
    }
    return {name: (raw, min(len(raw), 700 if name.endswith((".tif", ".jpg")) else 400)) for name, raw in found.items()}


def read(path: Path) -> None:
    """Read all frames of a file as a stack and as a picture: right in form, or refused in one line."""
    for way in (read_frame, lambda one: read_picture(one, "green")):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                for frame in frames_of(path)[:4]:
                    found = way(frame)
                    assert found.ndim == 2 and found.size and found.dtype in (np.uint8, np.uint16, np.float32)
        except InputError as problem:
            assert path.name in str(problem) and "\n" not in str(problem)


def damaged(raw: bytes, count: int) -> Iterator[bytes]:
    for at in range(count):
        # each byte in one way, by its place; over all bytes every way
        change = CHANGES[at % len(CHANGES)]
        yield raw[:at] + bytes([change(raw[at])]) + raw[at + 1 :]


@pytest.mark.parametrize("name", samples())
def test_a_changed_byte_brings_no_other_exception(name: str, tmp_path: Path) -> None:
    raw, count = samples()[name]
    for k, bad in enumerate(damaged(raw, count)):
        path = tmp_path / f"{k}-{name}"  # the parsed structure of a file is kept by its name
        path.write_bytes(bad)
        read(path)


@pytest.mark.parametrize("name", samples())
def test_a_cut_file_is_never_read(name: str, tmp_path: Path) -> None:
    raw, _ = samples()[name]
    needed = len(raw)
    if name == "a.fits":
        needed = 2880 + PAGES.nbytes  # what follows is padding
    elif name.endswith(".tif"):
        needed = len(raw) - 24 if name == "pages.tif" else len(raw)  # the name of a program ends the last directory
    for count in {*range(0, needed, max(needed // 150, 1)), needed - 1}:
        path = tmp_path / f"{count}-{name}"
        path.write_bytes(raw[:count])
        with pytest.raises(InputError):
            [read_picture(frame, "green") for frame in frames_of(path)]


MANIFEST = HEAD + "optics: {wavelength_nm: 500, light_source: LED}\nraw: {width: 8, height: 6, pixel_format: Mono12}\n" + FRAMES
JUNK = (
    "]",
    "[",
    "{",
    "}",
    ":",
    ": ",
    "#",
    "&a ",
    "*a ",
    "!!python/x ",
    "|",
    ">",
    "'",
    '"',
    "\t",
    "\0",
    "1e999",
    "0x",
    "~",
    "? ",
    "- ",
    "%",
    "<<: ",
    "\u2028",
)


def test_a_damaged_manifest_brings_no_other_exception(tmp_path: Path) -> None:
    manifest = put_campaign(tmp_path, MANIFEST)
    for at in range(0, len(MANIFEST), 2):
        for text in (MANIFEST[:at], MANIFEST[:at] + JUNK[at // 2 % len(JUNK)] + MANIFEST[at + at % 3 :]):
            manifest.write_text(text, encoding="utf-8")
            try:
                load_campaign(manifest)
            except InputError as problem:
                assert "\n" not in str(problem)


@pytest.mark.parametrize("key", ["a]", "]", "[0]", "exposure_s]", "5", "true", "~", "1.5", "2020-01-01", "''", "? [a]", "? {a: b}", "<<"])
@pytest.mark.parametrize("place", ["", "camera: {name: x, bits: 12, ", "frames: [{kind: dark, ", "optics: {"])
def test_any_key_of_yaml_is_refused_in_one_line(key: str, place: str, tmp_path: Path) -> None:
    close = {"": "", "f": "}]", "c": "}", "o": "}"}[place[:1]]
    text = f"schema: pixmetry/campaign/1\n{place}{key}: 3{close}\n"
    with pytest.raises(InputError) as caught:
        load_campaign(put_campaign(tmp_path, text))
    assert "\n" not in str(caught.value) and "campaign.yaml" in str(caught.value)


def test_a_damaged_table_brings_no_other_exception(tmp_path: Path) -> None:
    path, text = tmp_path / "t.csv", 'image,point,x_px,y_px\nim0,p1,1.5,2\nim1,"p,2",3,4\n# a comment\nim2,p3,5,6\n'
    for at in range(len(text)):
        for other in ('"', "\0", "\r", ";", "#", "\x85", ""):
            path.write_text(text[:at] + other + text[at + 1 :], encoding="utf-8", newline="")
            try:
                read_table(path)
            except InputError as problem:
                assert "\n" not in str(problem)
    path.write_bytes(text.encode("utf-16"))
    assert len(read_table(path)) == 3
