"""Calibrated cameras as files of OpenCV and COLMAP, with what is lost said in pixels."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from pixmetry import __version__
from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.calibrate.exchange import COLMAP, EXACT_PX, OPENCV, STORAGES, colmap_line, converted, opencv_text
from pixmetry.core.errors import InputError
from pixmetry.files.staged_files import Output, check_files, write_together

KINDS = ("PINHOLE", "OPENCV", "FULL_OPENCV")  # of COLMAP, the simplest that loses nothing is taken
COLMAP_HEAD = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
# How a file that pixmetry wrote begins: no other one is replaced.
COLMAP_MARK = re.compile(rb"# Written by pixmetry ")
OPENCV_MARKS = {
    ".yaml": re.compile(rb'%YAML[: ]1\.[0-9]\s+(---\s+)?written_by: "?pixmetry '),
    ".xml": re.compile(rb'<\?xml version="1\.0"\?>\s*<opencv_storage>\s*<written_by>"?pixmetry '),
    ".json": re.compile(rb'\{\s*"written_by": "pixmetry '),
}
OPENCV_MARKS[".yml"] = OPENCV_MARKS[".yaml"]


def check_exports(opencv: Path | None, colmap: Path | None, folder: Path, sources: Iterable[Path] = ()) -> None:
    """Refuse names that files cannot be written to, before any work is done.

    Raises
    ------
    InputError
        If a file has another ending, is a folder, lies in the folder of results, is one of the sources, or exists and was not written by
        an earlier export.
    """
    if opencv is not None and opencv.suffix.lower() not in STORAGES:
        raise InputError("not a file of OpenCV's storage", where=str(opencv), allowed=", ".join(STORAGES))
    outputs = _outputs([opencv] if opencv is not None else [], colmap)
    for path in (output.path for output in outputs):
        if path.resolve().is_relative_to(folder.resolve()):
            remedy = "choose a place beside it"
            raise InputError("lies in the folder of results, which is replaced as a whole", where=str(path), remedy=remedy)
    check_files(outputs, sources)


def write_exports(
    models: Iterable[CameraModel], opencv: Path | None, colmap: Path | None, may_lose_px: float = 0.0, sources: Iterable[Path] = ()
) -> list[str]:
    """Write the files, all or none; of those that exist, only earlier exports are replaced.

    Parameters
    ----------
    models : iterable of CameraModel
    opencv : Path, optional
        For OpenCV's FileStorage; of several cameras each has a file of its own, ``NAME`` before the ending.
    colmap : Path, optional
        A ``cameras.txt`` with all cameras, numbered from 1.
    may_lose_px : float
        How far a point may move, anywhere in the frame, by what a program has no place for.
    sources : iterable of Path
        Files that must not be replaced.

    Returns
    -------
    list of str
        A sentence for each file, with what it lost.

    Raises
    ------
    InputError
        If more would be lost, the principal distance is not known, a file cannot be written, or another one would be replaced.
    """
    cameras = list(models)
    unknown = next((model.name for model in cameras if not model["c"] > 0), None)
    if unknown is not None:
        remedy = "calibrate with a test field, or give c_mm or c_px"
        raise InputError("cannot be exported without a principal distance, which straight lines do not tell", where=unknown, remedy=remedy)
    places = _opencv_places(cameras, opencv)
    lines, told, texts = [f"# Written by pixmetry {__version__}\n{COLMAP_HEAD}# Number of cameras: {len(cameras)}\n"], [], []
    for k, model in enumerate(cameras):
        if opencv is not None:
            texts.append(opencv_text(model, opencv.suffix, may_lose_px))
        if colmap is not None:
            kind, lost = _simplest(model)
            lines.append(f"# {' '.join(model.name.split())}\n{colmap_line(model, k + 1, kind, may_lose_px)}\n")
            told.append(_sentence(colmap, f"{model.name} as camera {k + 1}, {kind}", lost))
    texts += ["".join(lines)] if colmap is not None else []
    write_together(_outputs(places, colmap), [text.encode() for text in texts], sources)
    for model, path in zip(cameras, places, strict=False):
        told.append(_sentence(path, f"{model.name} for OpenCV", converted(model, "object_to_image", OPENCV).largest_px))
    return told


def _outputs(opencv: Iterable[Path], colmap: Path | None) -> list[Output]:
    found = [Output(path, OPENCV_MARKS[path.suffix.lower()]) for path in opencv]
    return found + ([Output(colmap, COLMAP_MARK)] if colmap is not None else [])


def _opencv_places(cameras: list[CameraModel], opencv: Path | None) -> list[Path]:
    """The file of each camera; of several, its name stands before the ending."""
    if opencv is None or len(cameras) == 1:
        return [] if opencv is None else [opencv]
    owns = [re.sub(r"[^A-Za-z0-9._-]+", "_", model.name) for model in cameras]
    twice = next((own for own in owns if owns.count(own) > 1), None)
    if twice is not None:
        remedy = "give the cameras names that differ in letters and digits"
        raise InputError("would be the file of two cameras", where=f"{opencv.stem}-{twice}{opencv.suffix}", remedy=remedy)
    return [opencv.with_name(f"{opencv.stem}-{own}{opencv.suffix}") for own in owns]


def _simplest(model: CameraModel) -> tuple[str, float]:
    """COLMAP's simplest model that loses nothing, else the one with the most parameters; and what that loses, px."""
    lost = 0.0
    for kind in KINDS:
        lost = converted(model, "object_to_image", ("c", "xp", "yp", *COLMAP[kind])).largest_px
        if lost <= EXACT_PX:
            return kind, lost
    return KINDS[-1], lost


def _sentence(path: Path, what: str, lost: float) -> str:
    return f"{path}: {what}; " + ("nothing is lost" if lost <= EXACT_PX else f"up to {lost:.2g} px are lost")
