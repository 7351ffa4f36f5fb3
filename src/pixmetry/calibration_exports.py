"""Calibrated cameras as files of OpenCV and COLMAP, with what is lost said in pixels."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from pixmetry.calibration.exchange import COLMAP, EXACT_PX, OPENCV, STORAGES, colmap_line, converted, opencv_form, write_opencv
from pixmetry.calibration.model import CameraModel
from pixmetry.core.errors import InputError

KINDS = ("PINHOLE", "OPENCV", "FULL_OPENCV")  # of COLMAP, the simplest that loses nothing is taken
COLMAP_HEAD = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"


def check_exports(opencv: Path | None, colmap: Path | None, output: Path, sources: Iterable[Path] = ()) -> None:
    """Refuse names that files cannot be written to, before any work is done.

    Raises
    ------
    InputError
        If a file has another ending, is a folder, lies in the folder of results, or is one of the sources.
    """
    if opencv is not None and opencv.suffix.lower() not in STORAGES:
        raise InputError("not a file of OpenCV's storage", where=str(opencv), allowed=", ".join(STORAGES))
    files = [path for path in (opencv, colmap) if path is not None]
    if len({path.resolve() for path in files}) < len(files):
        raise InputError("is to be two files at once", where=str(opencv), remedy="give --opencv and --colmap different names")
    for path in files:
        if path.resolve().is_relative_to(output.resolve()):
            remedy = "choose a place beside it"
            raise InputError("lies in the folder of results, which is replaced as a whole", where=str(path), remedy=remedy)
        if path.is_dir() or not path.absolute().parent.is_dir():
            what = "is a folder" if path.is_dir() else "lies in a folder that does not exist"
            raise InputError(what, where=str(path), allowed="a file in a folder that exists")
        if path.resolve() in {source.resolve() for source in sources}:
            raise InputError("is read and cannot be written as well", where=str(path), remedy="choose another name")


def write_exports(models: Iterable[CameraModel], opencv: Path | None, colmap: Path | None, may_lose_px: float = 0.0) -> list[str]:
    """Write the files, all or none.

    Parameters
    ----------
    models : iterable of CameraModel
    opencv : Path, optional
        For OpenCV's FileStorage; of several cameras each has a file of its own, ``NAME`` before the ending.
    colmap : Path, optional
        A ``cameras.txt`` with all cameras, numbered from 1.
    may_lose_px : float
        How far a point may move, anywhere in the frame, by what a program has no place for.

    Returns
    -------
    list of str
        A sentence for each file, with what it lost.

    Raises
    ------
    InputError
        If more would be lost, or the principal distance is not known.
    """
    cameras = list(models)
    unknown = next((model.name for model in cameras if not model["c"] > 0), None)
    if unknown is not None:
        remedy = "calibrate with a test field, or give c_mm or c_px"
        raise InputError("cannot be exported without a principal distance, which straight lines do not tell", where=unknown, remedy=remedy)
    places = _opencv_places(cameras, opencv)
    lines, told = [], []
    for k, model in enumerate(cameras):
        if opencv is not None:
            opencv_form(model, may_lose_px)
        if colmap is not None:
            kind, lost = _simplest(model)
            lines.append(f"# {model.name}\n{colmap_line(model, k + 1, kind, may_lose_px)}\n")
            told.append(_sentence(colmap, f"{model.name} as camera {k + 1}, {kind}", lost))
    if colmap is not None:
        colmap.write_text(f"{COLMAP_HEAD}# Number of cameras: {len(cameras)}\n{''.join(lines)}", encoding="utf-8", newline="\n")
    for model, path in zip(cameras, places, strict=False):
        write_opencv(model, path, may_lose_px)
        told.append(_sentence(path, f"{model.name} for OpenCV", converted(model, "object_to_image", OPENCV).largest_px))
    return told


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
