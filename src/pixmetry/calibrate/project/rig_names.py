"""Which pictures belong to which camera of a rig, and to which instant: by the numbers in their names, a column, or a list."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pixmetry.calibrate.project.tables import Table, first_few, index_of_names
from pixmetry.core.errors import InputError

NUMBER = re.compile(r"\d+")


def instants_of_names(names: Sequence[str], camera_of: np.ndarray, where: str = "rig") -> np.ndarray:
    """Instant of each image, from the one number in the names that differs from image to image of every camera.

    Parameters
    ----------
    names : sequence of str
    camera_of : ndarray of int, shape (images,)
    where : str

    Raises
    ------
    InputError
        If no number in the names tells the images of each camera apart, or no two cameras have one in common.

    Examples
    --------
    >>> instants_of_names(["left01", "left02", "right01", "right03"], np.array([0, 0, 1, 1])).tolist()
    [0, 1, 0, 2]
    >>> instants_of_names(["0001_cam0", "0002_cam0", "0002_cam1"], np.array([0, 0, 1])).tolist()
    [0, 1, 1]
    """
    stems = [Path(name).stem for name in names]
    runs = [[int(part) for part in NUMBER.findall(stem)] for stem in stems]
    fewest = min((len(run) for run in runs), default=0)
    for place in (*range(-1, -fewest - 1, -1), *range(fewest)):
        numbers = np.array([run[place] for run in runs])
        own = [numbers[camera_of == k] for k in np.unique(camera_of)]
        if all(len(np.unique(part)) == len(part) for part in own) and len(np.unique(numbers)) < len(numbers):
            return np.unique(numbers, return_inverse=True)[1]
    what = "the names of the images do not tell which were taken at the same instant"
    allowed = "names of which a number is the same for images of one instant: left01, right01"
    remedy = "add a table of images with the column `instant`, or list the images of each instant under `rig`"
    raise InputError(what, where=where, value=first_few(names), allowed=allowed, remedy=remedy)


def instants_of_table(images: Table, names: Sequence[str]) -> np.ndarray | None:
    """The same from the column ``instant`` of the table of images: equal texts are one instant, empty ones none; None without it."""
    if "instant" not in images:
        return None
    rows, told = index_of_names(images, "image"), images.columns["instant"]
    number: dict[str, int] = {}
    texts = [told[rows[name]].strip() for name in names]
    return np.array([-1 if not text else number.setdefault(text, len(number)) for text in texts], np.int64)


def instants_of_lists(lists: Sequence[Sequence[str]], names: Sequence[str], where: str) -> np.ndarray:
    """The same from lists of the images of each instant.

    Raises
    ------
    InputError
        If an image is listed twice, or unknown.
    """
    out, index = np.full(len(names), -1, np.int64), {name: i for i, name in enumerate(names)}
    for t, one in enumerate(lists):
        for name in one:
            if name not in index:
                remedy = "correct the name, or leave it out"
                raise InputError(f"no image '{name}'", where=where, allowed=first_few(index), remedy=remedy)
            if out[index[name]] >= 0:
                raise InputError(f"image '{name}' is of two instants", where=where, allowed="one", remedy="delete one of the two")
            out[index[name]] = t
    return out


def check_instants(instant: np.ndarray, camera_of: np.ndarray, names: Sequence[str], where: str) -> np.ndarray:
    """The instants, if no camera has two images of one of them.

    Raises
    ------
    InputError
        Otherwise.
    """
    seen: dict[tuple[int, int], str] = {}
    for name, t, k in zip(names, instant, camera_of, strict=True):
        if t >= 0 and (int(t), int(k)) in seen:
            what = f"images '{seen[int(t), int(k)]}' and '{name}' are of one camera and one instant"
            raise InputError(what, where=where, allowed="one image of each camera", remedy="correct the instants")
        seen[int(t), int(k)] = name
    return instant


def cameras_of_files(files: Sequence[Path]) -> dict[str, list[str]]:
    """Pictures by the camera that their names tell: what is left of folder and name without the number of the instant.

    Raises
    ------
    InputError
        If the names tell no two cameras.

    Examples
    --------
    >>> cameras_of_files([Path("left01.jpg"), Path("left02.jpg"), Path("right01.jpg"), Path("right02.jpg")])
    {'left': ['left01.jpg', 'left02.jpg'], 'right': ['right01.jpg', 'right02.jpg']}
    >>> list(cameras_of_files([Path(f"a/cam{k}/{n}.png") for k in (0, 1) for n in (17, 18)]))
    ['cam0', 'cam1']
    """
    spans = [list(NUMBER.finditer(path.stem)) for path in files]
    fewest = min((len(one) for one in spans), default=0)
    best: dict[tuple[str, str], list[Path]] = {}
    for place in (*range(-1, -fewest - 1, -1), *range(fewest)):
        groups: dict[tuple[str, str], list[Path]] = {}
        for path, found in zip(files, spans, strict=True):
            stem = path.stem[: found[place].start()] + "\0" + path.stem[found[place].end() :]
            groups.setdefault((str(path.parent), stem), []).append(path)
        if len(groups) > 1 and (not best or len(groups) < len(best)):
            best = groups
    if not best or len(best) > len(files) / 2:
        what, value = "the names of the pictures do not tell the cameras of a rig", first_few(str(path) for path in files)
        allowed = "left01.png, right01.png; or cam0/01.png, cam1/01.png"
        raise InputError(what, where="rig", value=value, allowed=allowed, remedy="write a project with `cameras`")
    return {_camera_name(key, best): [str(path) for path in sorted(own)] for key, own in best.items()}


def _camera_name(key: tuple[str, str], groups: Mapping[tuple[str, str], object]) -> str:
    stem = key[1].replace("\0", "").strip("-_. ")
    folder = Path(key[0]).name
    if len({other[1] for other in groups}) == len(groups) and stem:
        return stem
    if len({Path(other[0]).name for other in groups}) == len(groups) and folder:
        return folder
    return f"{folder}-{stem}".strip("-") or "camera"
