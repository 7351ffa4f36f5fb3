"""Locating: from an image to a table of positions with covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera, load_camera
from pixmetry.core.errors import InputError
from pixmetry.core.progress import Progress, no_progress
from pixmetry.core.threads import imap_tiles
from pixmetry.files.formats import frame_name, raw_file
from pixmetry.files.images import PICTURE_ENDINGS, load_picture, picture_files
from pixmetry.files.output import own_files
from pixmetry.files.raw_values import RawLayout, parse_raw
from pixmetry.files.staged_files import Output, check_files, write_together
from pixmetry.locate.detect.targets import Flag, Positions, Targets
from pixmetry.locate.noise import ROUNDING_DN2, NoiseModel, parse_noise
from pixmetry.locate.records import LAST, Located, checked_table_name, joined
from pixmetry.locate.target_estimator import FEW_ELECTRONS

FITS = {
    "template": "least squares with the target's own shape, integrated over the pixel; at the Cramér–Rao bound",
    "poisson_gaussian": "maximum likelihood with the same shape; for few electrons",
}
MOMENTS = {
    "soft_threshold": "centroid of what exceeds a threshold; fast and nearly as good under white noise",
    "squared_centroid": "centroid of squared grey values; good for small targets under read noise",
    "centroid": "centroid of grey values above the background; best for small targets under shot noise",
    "hard_threshold": "centroid of grey values where they exceed a threshold; depends on the sub-pixel phase",
    "windowed_centroid": "centroid under a Gaussian window that follows it",
}
OPERATORS = {
    "gaussian": "unweighted least-squares fit of a Gaussian",
    "ellipse_edges": "ellipse through edge points along rays",
    "forstner": "intersection of the gradients' lines (Förstner operator)",
    "perimeter": "average of the points of the perimeter",
}
ROWS = {
    "template": "the whole line by least squares, integrated over the pixel; at the Cramér–Rao bound",
    "row_squared_centroid": "squared centroid of each row (or column), then a straight line through them",
    "row_centroid": "centroid of each row (or column), then a straight line through them",
    "row_soft_threshold": "centroid above a threshold of each row (or column), then a straight line through them",
    "row_template": "a profile fitted to each row (or column), then a straight line through them",
}
AUTO = {"auto": "chooses shape and likelihood of the template by what the image shows, and says why"}
SPOTS = ("disc", "ellipse", "ring", "spot")
FAINTEST = 0.05  # height of lines and edges over that of the frame's strongest
TILTED, TILTED_PX = 0.91, 0.3  # ratio of the axes below which, difference of half axes above which discs are fitted as ellipses
PILED = 10  # pixels in 4 of one value at the top of an image before it is asked whether they were cut off there
LARGE_PX = 2.0  # radius from which that ratio can be told from a look at the region


def estimators(kind: str) -> dict[str, str]:
    """Return the estimators there are for a kind of target, each with a line on what it is.

    Raises
    ------
    InputError
        If there is no such kind.
    """
    if kind in SPOTS or kind == "coded":
        return {**AUTO, **FITS, **MOMENTS, **OPERATORS}
    if kind == "line":
        return {**AUTO, **ROWS}
    if kind in ("edge", "cross", "chessboard"):
        return {**AUTO, "template": "least squares with the target's own shape, integrated over the pixel"}
    raise InputError("no such kind of target", value=kind, allowed=", ".join((*SPOTS, "line", "edge", "cross", "chessboard", "coded")))


def locate(
    frame: np.ndarray,
    *,
    kind: str = "disc",
    estimator: str = "auto",
    polarity: str = "auto",
    grid: str | tuple[int, int] | None = None,
    noise: NoiseModel | Camera | str | Path | None = None,
    bits: int | None = None,
    aperture_px: float = 1.0,
    light_on: str = "surface",
    threads: int | None = None,
    name: str = "frame",
) -> Located:
    """Find the targets in one frame and measure where they are.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
        Grey values: integers of up to 16 bits, or floats.
    kind : {"disc", "ellipse", "ring", "spot", "line", "edge", "cross", "chessboard", "coded"}
    estimator : str
        ``"auto"`` or one of `estimators(kind)`.
    polarity : {"auto", "bright", "dark"}
        Of the targets on their ground; ``"auto"`` finds both.
    grid : "COLSxROWS", (cols, rows) or "any", optional
        Inner corners of a chessboard; or number the dots of a plate (columns ``grid_col``, ``grid_row``).
    noise : NoiseModel, Camera, path, or str, optional
        What weights the fits and fills the covariances: a model, a camera (preset, ``camera.yaml``), or ``"read=…,gain=…,black=…"``
        (see `parse_noise`). By default it is measured in the image.
    bits : int, optional
        Bits of a stored value; its greatest value is where the scale saturates. By default told from the image.
    aperture_px : float
        Side of the pixel's light-sensitive square, 0 for point samples.
    light_on : {"surface", "image"}
        Whether light that falls off across a target acts before the lens's blur or after it.
    threads : int, optional
    name : str
        Of the image, for the table.

    Returns
    -------
    Located
        A row a target; empty if there is none.

    Raises
    ------
    InputError
        If the frame or an option cannot be used.
    """
    known = estimators(kind)
    if estimator not in known:
        raise InputError(f"no such estimator for kind {kind}", value=estimator, allowed=", ".join(known))
    if polarity not in ("auto", "bright", "dark"):
        raise InputError("no such polarity", value=polarity, allowed="auto, bright, dark")
    if light_on not in ("surface", "image"):
        raise InputError("light cannot act there", where="light_on", value=light_on, allowed="surface, image")
    if not 0 <= aperture_px <= 1:
        raise InputError("the pixel's aperture cannot be used", where="aperture_px", value=aperture_px, allowed="0 to 1 pixel")
    if aperture_px < 1 and (estimator in OPERATORS or estimator in MOMENTS):
        what = f"the uncertainty of {estimator} is known for pixels without gaps only"
        remedy = "take the template, whose model has the aperture"
        raise InputError(what, where="aperture_px", value=aperture_px, allowed="1", remedy=remedy)
    image = checked_frame(frame, name)
    model = noise_model(noise)
    low, high = scale_ends(image, bits, model)
    task = Task(image, kind, estimator, polarity, _grid_size(grid, kind), model, low, high, aperture_px, light_on, threads)
    columns, notes = _WORK.get(kind, _spots)(task)
    about = {"name": name, "rows": image.shape[0], "cols": image.shape[1], "targets": len(columns["x_px"]), **notes}
    return Located(columns, kind, (about,))


def locate_files(
    images: Sequence[str | Path],
    output: str | Path | None = None,
    *,
    overlay: str | Path | None = None,
    channel: str | None = None,
    raw: str | RawLayout | None = None,
    progress: Progress | None = None,
    noise: NoiseModel | Camera | str | Path | None = None,
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
    noise, **options
        As in `locate`.

    Raises
    ------
    InputError
        If a file or an option cannot be used; nothing is written then.
    """
    from pixmetry.locate.overlay import MARK, overlay_names, overlay_png

    layout = parse_raw(raw) if isinstance(raw, str) else raw
    files = picture_files([frames_inside(path) for path in images], PICTURE_ENDINGS, layout)
    pictures = overlay_names(overlay, files)
    written = [Output(picture, MARK, True) for picture in pictures if picture is not None]
    tables_at = [] if output is None else [checked_table_name(output)]
    check_files([*tables_at, *written], files)  # before the work
    model = noise_model(noise)
    told = progress or no_progress

    def work(path: Path) -> tuple[Located, bytes]:
        name = frame_name(path)
        try:
            picture = load_picture(path, channel, layout)
            table = locate(picture.array, noise=model, name=name, **options)
        except InputError as problem:
            if str(path) in problem.where:
                raise
            where = f"{path}: {problem.where}" if problem.where and problem.where != name else str(path)
            raise InputError(problem.what, where=where, value=problem.value, allowed=problem.allowed, remedy=problem.remedy) from None
        drawn = overlay_png(picture.array, table) if overlay is not None else b""
        if not picture.notes:
            return table, drawn
        return Located(table.columns, table.kind, tuple({**image, "file": "; ".join(picture.notes)} for image in table.images)), drawn

    tables: list[Located] = []
    drawings: list[bytes] = []
    results = map(work, files) if len(files) == 1 else imap_tiles(work, files)  # the threads share the images, or the one image
    for i, (table, drawing) in enumerate(results):
        drawings.append(drawing)
        tables.append(Located({"image": np.full(len(table), frame_name(files[i])), **table.columns}, table.kind, table.images))
        told("locating", i + 1, len(files))
    found = joined(tables)
    contents = [found.content(one.path.suffix) for one in tables_at]
    write_together([*tables_at, *written], [*contents, *drawings[: len(written)]], files)
    return found


def frames_inside(path: str | Path) -> Path:
    """Name the folder or store that holds the frames: a folder without images of its own may be what `simulate` wrote."""
    folder = Path(path)
    if not folder.is_dir() or folder.suffix.lower() == ".zarr" or any(p.suffix.lower() in PICTURE_ENDINGS for p in folder.iterdir()):
        return folder
    return next((inside for inside in (folder / "frames", folder / "frames.zarr") if inside.is_dir()), folder)


def skipped_files(images: Sequence[str | Path], raw: RawLayout | str | None = None) -> list[str]:
    """Names of the files in the given folders that are taken for no images; ``raw`` as of `locate_files`."""
    layout = parse_raw(raw) if isinstance(raw, str) else raw
    folders = [folder for folder in map(frames_inside, images) if folder.is_dir() and folder.suffix.lower() != ".zarr"]
    written = {folder / name for folder in folders for name in own_files(folder)}  # what `simulate` wrote beside its frames
    others = (p for folder in folders for p in sorted(folder.iterdir()) if p.suffix.lower() not in PICTURE_ENDINGS and p.is_file())
    return [p.name for p in others if not p.name.startswith(".") and p not in written and not raw_file(p, layout)]


def checked_frame(frame: np.ndarray, name: str = "frame") -> np.ndarray:
    """Return a frame as the kernels want it: C-contiguous uint8, uint16 or float32.

    Raises
    ------
    InputError
        If it is no grey image of finite real numbers.
    """
    array = np.asarray(frame)
    if array.ndim == 3 and array.shape[2] in (3, 4):
        remedy = "measure in one channel, such as frame[:, :, 1] (green)"
        raise InputError("a colour image", where=name, value=array.shape, allowed="one grey channel, two axes", remedy=remedy)
    if array.ndim != 2 or array.size == 0:
        raise InputError("not a grey image", where=name, value=array.shape, allowed="two axes (row, column), at least one pixel")
    if array.dtype.kind not in "buif":
        raise InputError("grey values are not real numbers", where=name, value=str(array.dtype), allowed="integers or floats")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        bad = ~np.isfinite(array)
        row, col = np.argwhere(bad)[0]
        remedy = "replace them, for instance by the median of their neighbours"
        what = f"{int(bad.sum())} pixels are not finite, the first in row {row}, column {col}"
        raise InputError(what, where=name, allowed="finite grey values", remedy=remedy)
    if array.dtype in (np.uint8, np.uint16):
        return np.ascontiguousarray(array, array.dtype.newbyteorder("="))
    if array.dtype.kind in "bui" and (array.dtype.kind == "b" or (array.min() >= 0 and array.max() < 1 << 16)):
        return np.ascontiguousarray(array, np.uint16)
    if array.dtype.kind == "f" and array.dtype.itemsize > 4 and np.abs(array).max() > np.finfo(np.float32).max:
        raise InputError("grey values are too large", where=name, value=float(np.abs(array).max()), allowed="up to 3e38 (single precision)")
    return np.ascontiguousarray(array, np.float32)


def scale_ends(frame: np.ndarray, bits: int | None, noise: NoiseModel | None) -> tuple[float, float]:
    """Tell at which grey values the scale ends: from the noise model, the bits, or the image itself.

    Without bits, an integer image is taken to end at the greatest value of 8, 10, 12, 14 or 16 bits if it reaches it, or at its own
    greatest value if far more pixels have this one than the few values below: they were cut off there.

    Raises
    ------
    InputError
        If there are no such bits, or the image has more.
    """
    if frame.dtype.kind == "f":
        return (-np.inf, np.inf) if noise is None else (noise.low_dn, noise.high_dn)
    if bits is not None:
        if bits not in range(1, 17):
            raise InputError("the bits of a value cannot be used", where="bits", value=bits, allowed="1 to 16")
        high = float((1 << int(bits)) - 1)
        if frame.max() > high:
            raise InputError("grey values that have more bits", where="bits", value=int(frame.max()), allowed=f"up to {high:.0f}")
        return 0.0, high
    if noise is not None and np.isfinite(noise.high_dn):
        return max(0.0, noise.low_dn), noise.high_dn
    top = int(frame.max())
    if any(top == (1 << n) - 1 for n in (8, 10, 12, 14, 16)) or _cut_off_at(frame, top):
        return 0.0, float(top)
    return 0.0, float("inf")


def _cut_off_at(frame: np.ndarray, top: int) -> bool:
    """Whether far more pixels have the greatest value than the few values below it, in an image that has noise."""
    part = frame[::2, ::2]
    piled = int(np.count_nonzero(part == top))
    if piled < PILED or piled <= 3 * int(np.count_nonzero(part >= max(top - 3, 0))) - 3 * piled:
        return False
    usual = int(np.median(part[::4, ::4]))
    without_noise = usual > 0 and np.count_nonzero(part[::4, ::4] == usual) > 0.5 * part[::4, ::4].size
    return top > int(part.min()) and not without_noise


def noise_model(noise: NoiseModel | Camera | str | Path | None) -> NoiseModel | None:
    """Return the noise model that is meant: a model, a camera, the name of one, or ``"read=…,gain=…,black=…"``; None stays None.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    if noise is None or isinstance(noise, NoiseModel):
        return noise
    if not isinstance(noise, Camera):
        text = str(noise)
        if "=" in text:
            return parse_noise(text)[0]
        noise = load_camera(text)
    from pixmetry.locate.camera_noise import camera_noise

    return camera_noise(noise).model


@dataclass(frozen=True)
class Task:
    """One frame and what is wanted of it, as `locate` was told."""

    frame: np.ndarray
    kind: str
    estimator: str
    polarity: str
    grid: Any  # (cols, rows), "any" or None
    noise: NoiseModel | None
    low_dn: float
    high_dn: float
    aperture_px: float
    light_on: str
    threads: int | None


def _spots(task: Task) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Targets that are regions: discs, ellipses, rings, spots, with or without a code, on a plate or not."""
    from pixmetry.locate.detect.detection import detect, select

    found = detect(task.frame, polarity=task.polarity, high_dn=task.high_dn, low_dn=task.low_dn, threads=task.threads)
    shape = "ellipse" if task.kind == "coded" else task.kind
    targets = found.targets[select(found.targets, shape)]
    estimator, reason = task.estimator, "as was asked for"
    seen, why = seen_shape(shape, targets)
    noise = _noise_for(task, seen, targets)  # with the targets' own shape, whatever measures them: what it does not explain is noise
    if estimator == "auto":
        shape = seen
        estimator, reason = chosen_estimator(targets, noise, why)
    positions = measured(task, targets, noise, estimator, shape)
    columns = _columns(positions, estimator if shape == task.kind else f"{estimator} ({shape})", noise)
    notes = _notes(estimator, reason, noise, found.polarity if len(targets) else "none found")
    if task.kind == "coded":
        columns = _coded(task, positions, columns)
    if task.grid is not None:
        from pixmetry.locate.detect.grids import order_grid

        placed = order_grid(positions.x_px, positions.y_px, pattern=None if task.grid == "any" else task.grid)
        columns = _beside(columns, grid_col=placed.col, grid_row=placed.row)
        notes["grid"] = placed.message or f"{placed.cols} x {placed.rows}, {int(placed.placed.sum())} of {len(positions)} targets placed"
    return columns, notes


def measured(task: Task, targets: Targets, noise: NoiseModel, estimator: str, shape: str) -> Positions:
    """Measure detected targets with one estimator."""
    if estimator in FITS:
        from pixmetry.locate.template.template import fit_template

        likelihood = "least_squares" if estimator == "template" else estimator
        planes: Any = False if task.kind == "coded" else "auto"  # the rings would pass for slopes
        return fit_template(
            task.frame,
            targets,
            noise,
            shape,
            likelihood=likelihood,
            background_plane=planes,
            light_plane=planes,
            light_on=task.light_on,
            aperture_px=task.aperture_px,
            threads=task.threads,
        )
    if estimator in MOMENTS:
        from pixmetry.locate.centroids.moments import moment_positions

        return moment_positions(task.frame, targets, noise, estimator, threads=task.threads)
    from pixmetry.locate.centroids.operators import operator_positions

    return operator_positions(task.frame, targets, noise, estimator, threads=task.threads)


def seen_shape(kind: str, targets: Targets) -> tuple[str, str]:
    """Choose the shape of the template for the targets of one frame, and say why: discs that are seen tilted are ellipses."""
    large = (targets.semi_major_px > LARGE_PX) & ((targets.flags & Flag.BORDER) == 0)
    if kind != "disc" or not large.any():
        return kind, "at the Cramér–Rao bound for every size and noise"
    major, minor = targets.semi_major_px[large], targets.semi_minor_px[large]
    flat = float(np.median(minor / major))
    if flat < TILTED or float(np.median(major - minor)) > TILTED_PX:
        return "ellipse", f"the discs are seen as ellipses, axes 1 : {flat:.2f}"
    return kind, "at the Cramér–Rao bound for every size and noise"


def chosen_estimator(targets: Targets, noise: NoiseModel, why: str) -> tuple[str, str]:
    """Choose the estimator for the targets of one frame, and say why; ``why`` is what `seen_shape` says.

    The template is at the Cramér–Rao bound for every size and noise (that is what the other rules would trade for speed), so what is to
    be chosen is its shape and its likelihood.
    """
    if not len(targets):
        return "template", "no target was found"
    known = noise.slope_dn and noise.slope_clear
    electrons = float(np.median(np.abs(targets.amplitude_dn))) / noise.slope_dn if known else np.inf
    if electrons < FEW_ELECTRONS:
        return "poisson_gaussian", f"{electrons:.0f} electrons at the peak: grey values are not normally distributed; {why}"
    return "template", why


def _lines(task: Task) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Lines, edges, and crosses of two lines."""
    from pixmetry.locate.lines.line_detection import find_edges, find_lines

    if task.kind == "edge":
        found = find_edges(task.frame, noise=task.noise, threads=task.threads)
    else:
        found = find_lines(task.frame, polarity=task.polarity, noise=task.noise, threads=task.threads)
    height = np.abs(found.amplitude_dn)
    found = found[height >= FAINTEST * height.max(initial=0.0)]  # beside a strong one, what a coder or a halo draws is no line
    noise = _noise_for(task, task.kind, found.sigma_dn)
    estimator, reason = ("template", FITS["template"]) if task.estimator == "auto" else (task.estimator, "as was asked for")
    if task.kind == "cross":
        from pixmetry.locate.lines.crosses import cross_positions, crossings

        crosses = crossings(found, task.frame.shape)
        positions = cross_positions(task.frame, crosses, noise, aperture_px=task.aperture_px, threads=task.threads)
    else:
        from pixmetry.locate.lines.lines import line_positions

        positions = line_positions(task.frame, found, noise, task.kind, estimator, aperture_px=task.aperture_px, threads=task.threads)
    columns = _columns(_with_variance_factor(positions, noise), estimator, noise)
    return columns, _notes(estimator, reason if len(positions) else f"no {task.kind} was found", noise, _polarity(positions))


def _with_variance_factor(positions: Positions, noise: NoiseModel) -> Positions:
    """Covariances times the a posteriori variance factor (median χ²/dof) where the noise was measured in the image beside the targets.

    Noise that rises with the light is seen there only through the residuals. A noise model that was given stands as it is.
    """
    chi2 = positions.more.get("chi2_per_dof", np.empty(0))
    factor = max(1.0, float(np.nanmedian(chi2))) if noise.origin == "image" and np.isfinite(chi2).any() else 1.0
    scaled = {name: v * factor for name, v in positions.more.items() if name.startswith(("var_", "cov_"))}
    return replace(
        positions,
        var_x_px2=positions.var_x_px2 * factor,
        cov_xy_px2=positions.cov_xy_px2 * factor,
        var_y_px2=positions.var_y_px2 * factor,
        more={**positions.more, **scaled},
    )


def _polarity(positions: Positions) -> str:
    signs = np.sign(positions.more.get("amplitude_dn", np.empty(0)))
    return "none found" if not len(positions) else "bright" if (signs > 0).all() else "dark" if (signs < 0).all() else "both"


def _chessboard(task: Task) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Inner corners of a chessboard of a given size."""
    from pixmetry.locate.detect.background import background
    from pixmetry.locate.template.corners import chessboard_reach_px, corner_positions, find_chessboard

    found = find_chessboard(task.frame, task.grid)
    noise = _noise_for(task, "corner", background(task.frame, low_dn=task.low_dn, high_dn=task.high_dn, threads=task.threads).sigma_dn)
    reach = chessboard_reach_px(found) if len(found) else 0.0

    def place() -> Positions:
        return corner_positions(
            task.frame, found.x_px, found.y_px, noise, reach_px=reach, aperture_px=task.aperture_px, threads=task.threads
        )

    positions = place()
    chi2 = positions.more["chi2_per_dof"]
    if noise.origin == "image" and np.isfinite(chi2).any():
        # the background's noise has the board's edges in it: the residuals of a first fit know better
        noise = replace(noise, constant_dn2=noise.constant_dn2 * float(np.nanmedian(chi2)))
        positions = place()
    columns = _columns(positions, "template", noise)
    reason = found.message or "two crossing edges, integrated over the pixel; at the Cramér–Rao bound"
    columns = _beside(columns, grid_col=found.col, grid_row=found.row)
    return columns, _notes("template", reason, noise, "none found" if found.message else "both")


_WORK = {"line": _lines, "edge": _lines, "cross": _lines, "chessboard": _chessboard}


def _noise_for(task: Task, kind: str, targets: Targets | np.ndarray) -> NoiseModel:
    """The noise model that was given, with the scale's ends; else what the image tells, at targets or by the spread beside them."""
    if task.noise is not None:
        given = replace(task.noise, low_dn=max(task.low_dn, task.noise.low_dn), high_dn=min(task.high_dn, task.noise.high_dn))
        if not isinstance(targets, Targets) or not len(targets):
            return given
        from pixmetry.locate.template.image_noise import row_shifts_from_image

        return row_shifts_from_image(task.frame, targets, given, kind, aperture_px=task.aperture_px, threads=task.threads)
    if isinstance(targets, Targets) and len(targets):
        from pixmetry.locate.template.image_noise import noise_from_image

        return noise_from_image(
            task.frame,
            targets,
            kind,
            low_dn=task.low_dn,
            high_dn=task.high_dn,
            aperture_px=task.aperture_px,
            threads=task.threads,
        )
    least = ROUNDING_DN2 if task.frame.dtype.kind == "u" else 1e-12
    sigma = 0.0 if isinstance(targets, Targets) or not len(targets) else float(np.median(targets))
    return NoiseModel(max(sigma**2, least), low_dn=task.low_dn, high_dn=task.high_dn, origin="image")


def _columns(positions: Positions, estimator: str, noise: NoiseModel) -> dict[str, np.ndarray]:
    n = len(positions)
    return {
        "target": np.arange(n),
        "x_px": positions.x_px,
        "y_px": positions.y_px,
        "var_x_px2": positions.var_x_px2,
        "cov_xy_px2": positions.cov_xy_px2,
        "var_y_px2": positions.var_y_px2,
        **positions.more,
        "estimator": np.full(n, estimator),
        "noise_model": np.full(n, noise.origin),
        "flags": positions.flags,
    }


def _notes(estimator: str, reason: str, noise: NoiseModel, polarity: str) -> dict[str, Any]:
    return {"polarity": polarity, "estimator": estimator, "reason": reason, "noise_model": noise.describe()}


def _coded(task: Task, positions: Positions, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns with each target's code, without the segments of the rings; a target that was lost has the code −1."""
    from pixmetry.locate.detect.coded import read_codes, ring_members

    x, y, more = positions.x_px, positions.y_px, positions.more
    major, minor, angle = more["semi_major_px"], more["semi_minor_px"], more["angle_deg"]
    codes = read_codes(task.frame, x, y, major, minor, angle, more["amplitude_dn"], threads=task.threads)
    whole = ~ring_members(x, y, major, minor, angle, codes.number)
    columns = {name: values[whole] for name, values in columns.items()} | {"target": np.arange(int(whole.sum()))}
    return _beside(columns, code=codes.number[whole], code_margin=codes.margin[whole])


def _beside(columns: dict[str, np.ndarray], **more: np.ndarray) -> dict[str, np.ndarray]:
    """The columns with some more before the last three."""
    first = {name: values for name, values in columns.items() if name not in LAST}
    return {**first, **more, **{name: columns[name] for name in LAST}}


def _grid_size(grid: str | tuple[int, int] | None, kind: str) -> tuple[int, int] | str | None:
    if kind == "chessboard" and grid is None:
        raise InputError("the size of the chessboard is missing", where="grid", allowed="COLSxROWS of its inner corners, such as 9x6")
    if grid is not None and kind not in (*SPOTS, "chessboard"):
        raise InputError(f"targets of kind {kind} stand in no grid", where="grid", allowed="disc, ellipse, ring, spot, chessboard")
    if grid is None or (grid == "any" and kind != "chessboard"):
        return grid
    size = tuple(grid.lower().split("x")) if isinstance(grid, str) else tuple(grid)
    try:
        cols, rows = (int(v) for v in size)
    except (TypeError, ValueError):
        cols = rows = 0
    if cols < 2 or rows < 2:
        allowed = "COLSxROWS, such as 9x6, both at least 2" + ("" if kind == "chessboard" else "; or any")
        raise InputError("not the size of a grid", where="grid", value=grid, allowed=allowed)
    return cols, rows
