"""Measured maps of one unit of a camera, by pixel or by code, in place of random patterns; and their file.

The arrays stand beside the camera file in an NPZ archive. The camera file names each with a digest of its content, so that the archive of
another camera, or a damaged one, is found out.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.core.door import check_archive
from pixmetry.core.errors import InputError

if TYPE_CHECKING:
    from pixmetry.camera.chain_order import Element


@dataclass(frozen=True)
class MeasuredUnit:
    """The unit whose maps the elements of a camera contain. They replace the random patterns of its seed; other seeds draw patterns.

    Parameters
    ----------
    unit_seed : int
    frame_shape : (int, int)
        Rows and columns of the maps.
    """

    unit_seed: int
    frame_shape: tuple[int, int]


def digest(array: np.ndarray) -> str:
    """Digest of an array's type, shape and values: ``sha256:…``."""
    found = hashlib.sha256(f"{array.dtype.str} {array.shape} ".encode())
    found.update(np.ascontiguousarray(array).tobytes())
    return f"sha256:{found.hexdigest()}"


def check_maps(element: Element, where: str) -> None:
    """Refuse maps that the element's source does not know.

    Raises
    ------
    InputError
    """
    for name in element.maps:
        if name not in element.source.maps:
            allowed = ", ".join(element.source.maps) or "none"
            raise InputError(f"{element.source.id} takes no map {name!r}", where=where, allowed=allowed, remedy="delete it")


def maps_file(camera_file: str | Path) -> Path:
    """Path of the maps of a camera file: ``camera.maps.npz`` beside ``camera.yaml``."""
    return Path(camera_file).with_suffix(".maps.npz")


def write_unit_maps(path: Path, elements: Iterable[Element]) -> None:
    """Write the maps of a chain's elements."""
    arrays: dict[str, Any] = {f"{e.name}/{name}": array for e in elements for name, array in e.maps.items()}
    np.savez(path, **arrays)


def read_unit_maps(path: Path, wanted: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, np.ndarray]]:
    """Read maps and check their digests.

    Parameters
    ----------
    path : Path
        As written by `write_unit_maps`.
    wanted : mapping
        By the element's name: its maps by name, with their digests.

    Raises
    ------
    InputError
        If the file is missing or damaged, or holds other maps.
    """
    remedy = "copy it from the folder of the original camera file, or assess the camera again"
    try:
        check_archive(path)
        with np.load(path, allow_pickle=False) as stored:
            found = {name: {key: stored[f"{name}/{key}"] for key in maps} for name, maps in wanted.items()}
    except FileNotFoundError:
        raise InputError("the measured maps of this camera are missing", where=str(path), remedy=remedy) from None
    except InputError:
        raise
    except Exception as problem:  # a damaged archive raises one of many
        raise InputError("the measured maps of this camera cannot be read", where=str(path), value=str(problem), remedy=remedy) from None
    for name, maps in wanted.items():
        for key, told in maps.items():
            if digest(found[name][key]) != told:
                raise InputError(f"the map {key} of {name} is not the one named in the camera file", where=str(path), remedy=remedy)
    return found


def check_frame(measured: MeasuredUnit, frame_shape: tuple[int, int], where: str) -> None:
    """Refuse a frame of another size than the maps'.

    Raises
    ------
    InputError
    """
    if tuple(frame_shape) != tuple(measured.frame_shape):
        raise InputError(
            "the maps of this unit have another frame size",
            where=where,
            value=f"{frame_shape[0]} × {frame_shape[1]}",
            allowed=f"{measured.frame_shape[0]} × {measured.frame_shape[1]} rows and columns",
            remedy="cut a window out of the frame, or simulate another unit of the type: set unit_seed to another number than "
            f"{measured.unit_seed}",
        )


def listing(maps: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The plain record of an element's maps: their digests by name."""
    return {name: digest(array) for name, array in maps.items()}
