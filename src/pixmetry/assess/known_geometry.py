"""What is known of a camera's geometry beside its description, as settings: cover glass, clock, height, speed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.assess.position_tables import read_positions
from pixmetry.camera.camera import Camera
from pixmetry.core.errors import InputError

MOST_ORDER = 6  # of the polynomials of a height map
GLASS_MM = (0.01, 3.0)


def speed_settings(text: str) -> dict[str, Any]:
    """Motion of the targets from ``PX/S[,DEG]``."""
    values = _numbers(text, "speed", "PX/S or PX/S,DEG, such as 50,90", 2)
    return {"motion.speed_px_per_s": values[0], **({"motion.direction_deg": values[1]} if len(values) > 1 else {})}


def glass_settings(text: str) -> dict[str, Any]:
    """Cover glass from ``MM[,INDEX]``."""
    values = _numbers(text, "cover glass", "MM or MM,INDEX, such as 0.75,1.52", 2)
    if not GLASS_MM[0] <= values[0] <= GLASS_MM[1]:
        raise InputError("no cover glass is so thick", where="cover glass", value=f"{values[0]:g} mm", allowed="0.01 mm to 3 mm")
    found = {"optics.cover_glass.thickness_um": 1000 * values[0]}
    return found | ({"optics.cover_glass.index": values[1]} if len(values) > 1 else {})


def clock_settings(ratio: float, camera: Camera) -> dict[str, Any]:
    """Clock of the grabber's samples from the camera's pixel clock over it."""
    name = next((e.name for e in camera.chain if e.source.id == "grabber.sampling_clock"), "grabber.sampling_clock")
    return {f"{name}.clock_mhz": 1e-6 * camera.pixel_clock_hz / ratio}


def height_settings(path: str | Path, camera: Camera) -> dict[str, Any]:
    """Unflatness of the sensor from a map of its height, by a fit of Legendre polynomials.

    Parameters
    ----------
    path : path
        Heights in µm, positive away from the lens: an array over the whole frame (NPY or TIFF, any number of rows and columns), or a CSV
        with ``x_px``, ``y_px`` and ``height_um``.
    camera : Camera

    Raises
    ------
    InputError
        If the file cannot be read or has too few heights.
    """
    x, y, height = _heights(Path(path), camera.frame_shape)
    rows, cols = camera.frame_shape
    u, v = (2 * x + 1) / cols - 1, (2 * y + 1) / rows - 1  # -1 to 1 from edge to edge, as sensor.unflatness has it
    order = min(MOST_ORDER, int((np.sqrt(4 * len(x) + 1) - 3) / 2), len(np.unique(x)) - 1, len(np.unique(y)) - 1)
    if order < 2:
        raise InputError("too few heights", where=str(path), value=len(x), allowed="12 or more, spread over the frame in x and y")
    terms = [(j, i) for j in range(order + 1) for i in range(order + 1 - j)]
    basis = np.polynomial.legendre.legvander2d(v, u, [order, order])[:, [j * (order + 1) + i for j, i in terms]]
    found = np.linalg.lstsq(basis, height, rcond=None)[0]
    more = np.zeros((order + 1, order + 1))
    for (j, i), value in zip(terms, found, strict=True):
        more[j, i] = value
    name = next((e.name for e in camera.chain if e.source.id == "sensor.unflatness"), "sensor.unflatness")
    none = dict.fromkeys(("bow_x_um", "bow_y_um", "twist_um", "skew_x_um", "skew_y_um"), 0.0)
    return {f"{name}.{key}": value for key, value in (none | {"more_um": more.tolist()}).items()}


def _heights(path: Path, frame_shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places and heights of a map."""
    if path.suffix.lower() in (".npy", ".tif", ".tiff"):
        height = _array(path)
        rows, cols = height.shape
        y, x = np.meshgrid(
            *((np.arange(n) + 0.5) / n * side - 0.5 for n, side in zip((rows, cols), frame_shape, strict=True)), indexing="ij"
        )
        flat = x.ravel(), y.ravel(), height.ravel()
    else:
        table = read_positions(path)
        told = table.numbers("height_um")
        if told is None:
            raise InputError("no heights", where=str(path), value=", ".join(table.columns), allowed="columns x_px, y_px and height_um")
        flat = table.x_px, table.y_px, told
    known = np.isfinite(flat).all(axis=0)
    return flat[0][known], flat[1][known], flat[2][known]


def _array(path: Path) -> np.ndarray:
    try:
        if path.suffix.lower() == ".npy":
            height = np.load(path, allow_pickle=False)
        else:
            from tifffile import imread

            height = imread(path)
    except Exception as problem:  # a damaged file raises one of many
        raise InputError("a height map that cannot be read", where=str(path), value=str(problem), remedy="check the file") from None
    if height.ndim != 2 or height.dtype.kind not in "fiu":
        raise InputError("no height map", where=str(path), value=f"{height.dtype} of shape {height.shape}", allowed="numbers, (rows, cols)")
    return np.asarray(height, float)


def _numbers(text: str, where: str, form: str, most: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not 1 <= len(values) <= most or not np.isfinite(values).all():
        raise InputError("cannot be read", where=where, value=text, allowed=form)
    return values
