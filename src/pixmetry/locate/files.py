"""Image files in, one table out: selection of the files, and output that is written whole or not at all."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera
from pixmetry.core.config import read_text
from pixmetry.core.errors import InputError
from pixmetry.core.progress import Progress, no_progress
from pixmetry.core.threads import imap_tiles
from pixmetry.files.formats import PICTURE_ENDINGS, frame_name, raw_file
from pixmetry.files.images import load_picture, picture_files
from pixmetry.files.output import Output, check_files, own_files, write_together
from pixmetry.files.raw_values import RawLayout, layout_of
from pixmetry.locate.job import locate
from pixmetry.locate.known_camera import KnownCamera, known_camera
from pixmetry.locate.noise import NoiseModel, noise_model
from pixmetry.locate.records import Located, checked_table_name, joined


def locate_files(
    images: Sequence[str | Path],
    output: str | Path | None = None,
    *,
    overlay: str | Path | None = None,
    channel: str | None = None,
    raw: str | RawLayout | None = None,
    progress: Progress | None = None,
    noise: NoiseModel | Camera | str | Path | None = None,
    with_: KnownCamera | Camera | str | Path | None = None,
    mask: np.ndarray | str | Path | None = None,
    places_px: np.ndarray | str | Path | None = None,
    **options: Any,
) -> Located:
    """Locate targets in image files; one table for all, with a column ``image``.

    Parameters
    ----------
    images : sequence of path
        Image files (PNG, TIFF, BMP, FITS, NPY, JPEG, raw), folders of them in the order of their names, folders that `simulate` wrote,
        or Zarr stores of frames. A file with several frames is as many images.
    output : path, optional
        Where the table goes: ``.csv``, ``.parquet`` or ``.json``.
    overlay : path, optional
        A PNG that shows what was found; a folder for several images.
    channel : {"red", "green", "blue"}, optional
        Of colour images.
    raw : str or RawLayout, optional
        Of files without a header: ``"1920x1200:Mono12p"``, size and GenICam's pixel format.
    progress : callable (what, done, of), optional
    noise, with_, **options
        As in `locate`.
    mask : ndarray or path, optional
        As in `locate`, or an image that is not 0 where targets may be.
    places_px : ndarray or path, optional
        As in `locate`, or a CSV file with columns ``x_px`` and ``y_px``, such as an earlier table.

    Raises
    ------
    InputError
        If a file or an option cannot be used; nothing is written then.
    """
    from pixmetry.locate.overlay import MARK, overlay_names, overlay_png

    layout = layout_of(raw)
    files = picture_files([frames_inside(path) for path in images], PICTURE_ENDINGS, layout)
    pictures = overlay_names(overlay, files)
    written = [Output(picture, MARK, True) for picture in pictures if picture is not None]
    tables_at = [] if output is None else [checked_table_name(output)]
    check_files([*tables_at, *written], files)  # before the work
    model = noise_model(noise)
    known = None if with_ is None else known_camera(with_)
    report = progress or no_progress
    if isinstance(mask, str | Path):
        mask = load_picture(Path(mask)).array != 0
    if isinstance(places_px, str | Path):
        places_px = read_places(Path(places_px))
    options |= {"mask": mask, "places_px": places_px}

    def work(path: Path) -> tuple[Located, bytes]:
        name = frame_name(path)
        try:
            picture = load_picture(path, channel, layout)
            steps = picture.luminance_steps if picture.array.dtype == np.uint8 else None
            table = locate(picture.array, noise=model, with_=known, name=name, jpeg_steps=steps, **options)
        except InputError as problem:
            if str(path) in problem.where:
                raise
            where = f"{path}: {problem.where}" if problem.where and problem.where != name else str(path)
            raise InputError(problem.what, where=where, value=problem.value, allowed=problem.allowed, remedy=problem.remedy) from None
        drawn = overlay_png(picture.array, table) if overlay is not None else b""
        if not picture.notes:
            return table, drawn
        return replace(table, images=tuple({**image, "file": "; ".join(picture.notes)} for image in table.images)), drawn

    tables: list[Located] = []
    drawings: list[bytes] = []
    results = map(work, files) if len(files) == 1 else imap_tiles(work, files)  # the threads share the images, or the one image
    for i, (table, drawing) in enumerate(results):
        drawings.append(drawing)
        tables.append(replace(table, columns={"image": np.full(len(table), frame_name(files[i])), **table.columns}))
        report("locating", i + 1, len(files))
    found = joined(tables)
    contents = [found.content(one.path.suffix) for one in tables_at]
    write_together([*tables_at, *written], [*contents, *drawings[: len(written)]], files)
    return found


def read_places(path: Path) -> np.ndarray:
    """Read x and y, shape (n, 2), from a CSV file with columns ``x_px`` and ``y_px``; lines that begin with ``#`` are left out.

    Raises
    ------
    InputError
        If there is no such file, or no such columns of numbers in it.
    """
    try:
        rows = list(csv.DictReader(line for line in read_text(path).splitlines() if not line.startswith("#")))
        return np.array([(float(row["x_px"]), float(row["y_px"])) for row in rows]).reshape(-1, 2)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, csv.Error) as problem:
        allowed = "columns x_px and y_px, a number in each row"
        raise InputError("not a table of places", where=str(path), value=str(problem), allowed=allowed) from None


def frames_inside(path: str | Path) -> Path:
    """The folder or store with the frames; a folder without images may be the output of `simulate`."""
    folder = Path(path)
    if not folder.is_dir() or folder.suffix.lower() == ".zarr" or any(p.suffix.lower() in PICTURE_ENDINGS for p in folder.iterdir()):
        return folder
    return next((inside for inside in (folder / "frames", folder / "frames.zarr") if inside.is_dir()), folder)


def skipped_files(images: Sequence[str | Path], raw: RawLayout | str | None = None) -> list[str]:
    """Names of the files in the given folders that are taken for no images; ``raw`` as of `locate_files`."""
    layout = layout_of(raw)
    folders = [folder for folder in map(frames_inside, images) if folder.is_dir() and folder.suffix.lower() != ".zarr"]
    written = {folder / name for folder in folders for name in own_files(folder)}  # what `simulate` wrote beside its frames
    others = (p for folder in folders for p in sorted(folder.iterdir()) if p.suffix.lower() not in PICTURE_ENDINGS and p.is_file())
    return [p.name for p in others if not p.name.startswith(".") and p not in written and not raw_file(p, layout)]
