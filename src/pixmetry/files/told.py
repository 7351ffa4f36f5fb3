"""What an image file tells of itself beside its pixels: exposure, time, temperature, camera; in its tags and in its name."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from pixmetry.core.door import open_file
from pixmetry.files import fits
from pixmetry.files.formats import HEAD_BYTES, is_frame
from pixmetry.files.jpeg import SIGNATURE as JPEG
from pixmetry.files.png import SIGNATURE as PNG
from pixmetry.files.tiff import listening

EXIF, EXPOSURE, TAKEN, PART, MAKER, MODEL, TEXT = 0x8769, 0x829A, 0x9003, 0x9291, 0x010F, 0x0110, 0x010E  # numbers of tags (Exif 2.32)
SCALES = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "usec": 1e-6, "µs": 1e-6, "μs": 1e-6}
_UNIT = "(msec|usec|sec|ms|us|µs|μs|s)"
_NUMBER = r"(\d+(?:[.,]\d+)?(?:e[+-]?\d+)?)"
_TIME = re.compile(rf"(?<![a-z0-9.]){_NUMBER}[ _-]?{_UNIT}(?![a-z])")
_NAMED_TIME = re.compile(rf"(?<![a-z])(?:t|te|exp|texp|exposure|exptime|shutter|int|tint)[ _=-]*{_NUMBER}[ _-]?{_UNIT}(?![a-z])")
_BARE_TIME = re.compile(rf"(?<![a-z])(?:exp|texp|exposure|exptime|shutter|tint)[ _=-]*{_NUMBER}(?![a-z0-9])")
_TOLD_TIME = re.compile(rf"exposure(?:[ _]?time)?(?:[ _]?\(?{_UNIT}\)?)?['\"]?\s*[=:]\s*['\"]?{_NUMBER}\s*{_UNIT}?(?![a-z])")
_WORDS = re.compile(r"[a-z]+")
_DIGITS = re.compile(r"\d+")


@dataclass(frozen=True)
class Told:
    """What a file tells of itself; None and empty where it tells nothing.

    Parameters
    ----------
    exposure_s : float or None
    unitless : float or None
        An exposure time without its unit.
    taken_s : float or None
        When the frame was taken, seconds on any clock.
    temperature_c : float or None
        Of the sensor.
    pitch_um : float or None
    camera : str
    words : frozenset of str
        Words of the name and of the folders below the one that was given, in small letters.
    """

    exposure_s: float | None = None
    unitless: float | None = None
    taken_s: float | None = None
    temperature_c: float | None = None
    pitch_um: float | None = None
    camera: str = ""
    words: frozenset[str] = frozenset()


def told_by_name(name: str) -> Told:
    """What a name tells, with the folders in front of it.

    Examples
    --------
    >>> told_by_name("dark/cam3_exp2.5ms_007.tif").exposure_s
    0.0025
    >>> told_by_name("flat_exposure_2500_01.png").unitless
    2500.0
    """
    text = name.lower()
    words = frozenset(_WORDS.findall(text))
    for pattern in (_NAMED_TIME, _TIME):
        if found := pattern.findall(text):
            number, unit = found[-1]
            return Told(exposure_s=_plain(float(number.replace(",", ".")) * SCALES[unit]), words=words)
    bare = _BARE_TIME.findall(text)
    return Told(unitless=float(bare[-1].replace(",", ".")) if bare else None, words=words)


def counter_of(stem: str) -> int | None:
    """The last number of a name that is no exposure time; None without one.

    Examples
    --------
    >>> counter_of("img_0007_2.5ms"), counter_of("exp2.5ms_008"), counter_of("dark")
    (7, 8, None)
    """
    text = _TIME.sub("_", _NAMED_TIME.sub("_", stem.lower()))
    numbers = _DIGITS.findall(_BARE_TIME.sub("_", text)) or _DIGITS.findall(text)  # exposure_0007 may be a seventh exposure
    return int(numbers[-1]) if numbers else None


def told_by_file(path: Path) -> Told:
    """What the tags of a file tell; damaged tags tell nothing."""
    path = path.parent if is_frame(path) else path
    with suppress(Exception):  # what is behind a tag may be anything; the pixels are read by another way
        with open_file(path) as file:
            head = file.read(HEAD_BYTES)
        if head.startswith((PNG, JPEG)):
            return _by_pillow(path)
        if head.startswith((b"II", b"MM")):
            return _by_tifffile(path)
        if head.startswith(fits.SIGNATURE):
            return _by_fits(path)
    return Told()


def joined(first: Told, second: Told) -> Told:
    """What both tell; the first has priority."""
    ours = {f.name: getattr(first, f.name) for f in fields(Told)}
    return replace(first, **{name: getattr(second, name) for name, value in ours.items() if value in (None, "", frozenset())})


def _by_pillow(path: Path) -> Told:
    from PIL import Image

    with Image.open(path) as image:
        tags = image.getexif()
        return _of_tags({**tags, **tags.get_ifd(EXIF)}, " ".join(f"{k}={v}" for k, v in image.info.items() if isinstance(v, str)))


def _by_tifffile(path: Path) -> Told:
    import tifffile

    with listening(), tifffile.TiffFile(path) as file:
        page: Any = file.pages[0]
        tags = {tag.code: tag.value for tag in page.tags}
        more = tags.get(EXIF)
        named = {"ExposureTime": EXPOSURE, "DateTimeOriginal": TAKEN, "SubsecTimeOriginal": PART}
        told = {named[k]: v for k, v in more.items() if k in named} if isinstance(more, dict) else {}
        return _of_tags({**tags, **told}, str(tags.get(TEXT, "")))


def _of_tags(tags: dict[int, Any], text: str) -> Told:
    return Told(
        exposure_s=next(filter(None, (_ratio(tags.get(EXPOSURE)), *_times_in(text))), None),
        taken_s=_clock(tags.get(TAKEN) or tags.get(0x0132), tags.get(PART)),
        camera=_camera(tags.get(MAKER), tags.get(MODEL)),
    )


def _by_fits(path: Path) -> Told:
    with path.open("rb") as file:

        def read(offset: int, count: int) -> bytes:
            file.seek(offset)
            return file.read(count)

        header = fits.header_of(read, path.stat().st_size)
    number = {k: float(v) for k, v in header.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}
    first = next((number[k] for k in ("EXPTIME", "EXPOSURE") if k in number), None)
    kind = frozenset(_WORDS.findall(str(header.get("IMAGETYP", "")).lower()))
    return Told(
        exposure_s=first,
        taken_s=_clock(header.get("DATE-OBS"), None),
        temperature_c=number.get("CCD-TEMP"),
        pitch_um=number.get("XPIXSZ"),
        camera=str(header.get("INSTRUME", "")).strip(),
        words=kind,
    )


def _times_in(text: str) -> Iterator[float]:
    """Exposure times that a text tells with their unit."""
    for before, number, behind in _TOLD_TIME.findall(text.lower()):
        if unit := behind or before:
            yield _plain(float(number.replace(",", ".")) * SCALES[unit])


def _plain(value: float) -> float:
    """The number without what the last binary place adds: 0.0025, not 0.0025000000000000001."""
    return float(f"{value:.12g}")


def _ratio(value: Any) -> float | None:
    found = value[0] / value[1] if isinstance(value, tuple) else value
    return None if found is None or not math.isfinite(float(found)) or float(found) <= 0 else _plain(float(found))


def _clock(text: Any, part: Any) -> float | None:
    """Seconds of a date and time as Exif or FITS writes them."""
    digits = re.findall(r"\d+", str(text or ""))
    if len(digits) < 6 or int(digits[0]) < 1900:
        return None
    second = float(f"0.{digits[6]}") if len(digits) > 6 else float(f"0.{part}") if str(part or "").isdecimal() else 0.0
    return (datetime(*map(int, digits[:6])) - datetime(2000, 1, 1)).total_seconds() + second  # type: ignore[arg-type]


def _camera(maker: Any, model: Any) -> str:
    maker, model = (str(v or "").strip("\x00 ") for v in (maker, model))
    return model if model.lower().startswith(maker.lower()) else f"{maker} {model}".strip()
