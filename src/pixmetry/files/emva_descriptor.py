"""Read the descriptor file that goes with EMVA 1288 image sets (Release 3.0 and later).

One record a line: ``v`` version, ``n`` bits width height, ``b`` exposure in ns and photons per pixel of the bright frames that
follow, ``d`` (or ``dc``, of a run for the dark current) exposure in ns of the dark frames that follow, ``i`` path of one frame; ``#``
begins a comment. As in the public reference implementation, a number may have a decimal comma, and a record of another kind is passed
over with the images that follow it; it is named in the notes.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path

from pixmetry.core.errors import InputError

_RECORDS = ("v", "n", "b", "d", "dc", "i")
_THOUSANDS = re.compile(r"[1-9]\d{0,2}(,\d{3})+")  # 40,000: a comma that may stand for nothing


@dataclass
class DescriptorGroup:
    """The frames that follow one ``b`` or ``d`` record; ``files`` holds each name with its line number."""

    kind: str
    exposure_s: float
    photons: float | None
    line: int
    files: list[tuple[str, int]] = field(default_factory=list)


@dataclass
class Descriptor:
    """A parsed descriptor; ``header`` is the comment before the first record, where the licence stands, ``notes`` what was passed over."""

    version: str = ""
    bits: int = 0
    width: int = 0
    height: int = 0
    groups: list[DescriptorGroup] = field(default_factory=list)
    header: str = ""
    notes: list[str] = field(default_factory=list)


def is_descriptor(text: str) -> bool:
    """Tell whether the first record of a text is one of a descriptor."""
    first = next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    return re.match(r"\s*[vnbdi]\s+\S", first, re.IGNORECASE) is not None


def decode_descriptor(raw: bytes) -> str:
    """Decode a descriptor: UTF-8 with or without its mark, UTF-16 with its mark, else Windows' Latin alphabet."""
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16", errors="replace")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def parse_descriptor(path: Path, raw: bytes) -> Descriptor:
    """Read a descriptor.

    Parameters
    ----------
    path : Path
        Name for messages.
    raw : bytes
        The file's content.

    Raises
    ------
    InputError
        If a record is unknown, incomplete, not a number, or in a place where it has no meaning.
    """
    descriptor = Descriptor()
    header: list[str] = []
    passed_over = False
    for number, line in enumerate(decode_descriptor(raw).splitlines(), start=1):
        where = f"{path}, line {number}"
        text = line.strip()
        if text.startswith("#"):
            if not (descriptor.version or descriptor.bits or descriptor.groups):
                header.append(text.strip("# \t"))
        elif text:
            passed_over = _read_record(descriptor, text, number, where, passed_over)
    if not descriptor.bits:
        remedy = "add the line `n BITS WIDTH HEIGHT`, e.g. `n 12 640 480`"
        raise InputError("no record of bits, width and height", where=str(path), remedy=remedy)
    for group in descriptor.groups:
        if not group.files:
            what = f"no image follows this {group.kind} record"
            raise InputError(what, where=f"{path}, line {group.line}", remedy="add its `i` lines, or delete it")
    descriptor.header = re.sub(r"\n{3,}", "\n\n", "\n".join(header)).strip()
    return descriptor


def _read_record(descriptor: Descriptor, text: str, number: int, where: str, passed_over: bool) -> bool:
    """Read one record; tells whether images that follow belong to a record that was passed over."""
    letter, rest = (*text.split(maxsplit=1), "")[:2]
    letter = letter.lower()
    if letter != "i":
        rest = rest.split("#")[0].strip()
    elif passed_over:
        return True
    if letter not in _RECORDS:
        descriptor.notes.append(f"record '{letter}' of line {number} is not known: it and the images that follow it are left out")
        return True
    if letter == "v":
        descriptor.version = rest
    elif letter == "n":
        if descriptor.bits:
            raise InputError("a second record of bits, width and height", where=where, remedy="delete one of the two")
        values = _numbers(rest, where, "n bits width height", 3, 3)
        if any(v != int(v) or v < 1 for v in values) or values[0] > 16:
            raise InputError("bits, width and height cannot be used", where=where, value=rest, allowed="whole numbers; 1 to 16 bits")
        descriptor.bits, descriptor.width, descriptor.height = (int(v) for v in values)
    elif letter == "b":
        exposure_ns, *photons = _numbers(rest, where, "b exposure photons", 1, 2)
        if exposure_ns < 0 or (photons and photons[0] < 0):
            raise InputError("exposure or photons cannot be used", where=where, value=rest, allowed="0 or more")
        descriptor.groups.append(DescriptorGroup("bright", exposure_ns / 1e9, photons[0] if photons else None, number))
    elif letter in ("d", "dc"):
        (exposure_ns,) = _numbers(rest, where, "d exposure", 1, 1)
        if exposure_ns < 0:
            raise InputError("exposure cannot be used", where=where, value=rest, allowed="0 or more")
        descriptor.groups.append(DescriptorGroup("dark", exposure_ns / 1e9, 0.0, number))
    elif letter == "i":
        if not descriptor.groups:
            raise InputError("an image before the first b or d record", where=where, remedy="put the exposure before its images")
        if not rest:
            raise InputError("an image record without a name", where=where, remedy="add the path of the image, or delete the line")
        descriptor.groups[-1].files.append((rest.strip('"'), number))
    return False


def _numbers(text: str, where: str, form: str, fewest: int, most: int) -> list[float]:
    try:
        values = [_number(part) for part in text.split()]
    except ValueError:
        what, remedy = "not a number", "write decimals with a point" if "," in text else "correct the line"
        if any(_THOUSANDS.fullmatch(part) for part in text.split()):
            what, remedy = "a comma that may separate thousands or decimals", "leave it out, or write a point for it"
        raise InputError(what, where=where, value=text, allowed=form, remedy=remedy) from None
    if not fewest <= len(values) <= most:
        raise InputError(f"{len(values)} numbers in this record", where=where, value=text, allowed=form, remedy="correct the line")
    if not all(map(math.isfinite, values)):
        raise InputError("not a finite number", where=where, value=text, allowed=form, remedy="give a value")
    return values


def _number(text: str) -> float:
    """A number with decimal point or comma; what may be a comma between thousands is no number."""
    if _THOUSANDS.fullmatch(text):
        raise ValueError(text)
    return float(text.replace(",", ".") if "." not in text else text)
