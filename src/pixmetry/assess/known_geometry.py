"""What is known of a camera's geometry beside its description, as settings: cover glass, clock, height, speed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.assess.position_tables import read_positions
from pixmetry.camera.camera import Camera
from pixmetry.core.errors import InputError
from pixmetry.files.formats import decode
from pixmetry.files.images import image_bytes

MOST_ORDER = 6  # of the polynomials of a height map
MOST_LEVERAGE = 4.0  # at any place of the frame: there the variance of the surface over that of one height
LEAST_UM = 1e-6  # heights are not known better
COVERED = 0.8  # of the way from the frame's centre to its edges, up to where there must be heights
NAMED = {(0, 2): "bow_x_um", (2, 0): "bow_y_um", (1, 1): "twist_um", (0, 3): "skew_x_um", (3, 0): "skew_y_um"}
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


@dataclass(frozen=True)
class HeightMap:
    """A sensor's surface by a map of its height.

    Parameters
    ----------
    settings : dict
        Parameters of its unflatness, by name.
    u : dict
        Standard uncertainties of its bow, twist and skew, from the scatter of the heights about the surface.
    notes : tuple of str
    """

    settings: dict[str, Any]
    u: dict[str, float]
    notes: tuple[str, ...]


def height_map_of(path: str | Path, camera: Camera) -> HeightMap:
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
        If the file cannot be read, has too few heights, or its heights do not tell the surface all over the frame.

    Notes
    -----
    The order is that of the least n ln s² + p ln n (Schwarz 1978) with n heights and p terms, among those that the heights tell in every
    place of the frame with at most twice the standard uncertainty of one height. The plane of the map is left out: its piston is focus,
    and its slope is `sensor.tilt`, or how the map was laid.
    """
    x, y, height = _heights(Path(path), camera.frame_shape)
    rows, cols = camera.frame_shape
    u, v = (2 * x + 1) / cols - 1, (2 * y + 1) / rows - 1  # -1 to 1 from edge to edge, as sensor.unflatness has it
    most = min(MOST_ORDER, int((np.sqrt(4 * len(x) + 1) - 3) / 2), len(np.unique(x)) - 1, len(np.unique(y)) - 1)
    if most < 2:
        raise InputError("too few heights", where=str(path), value=len(x), allowed="12 or more, spread over the frame in x and y")
    side = np.linspace(-1, 1, 9)
    all_u, all_v = np.meshgrid(side, side)
    fits = []
    for order in range(2, most + 1):
        terms, basis = _terms(u, v, order)
        if np.linalg.matrix_rank(basis) < len(terms):
            break
        spread = np.linalg.inv(basis.T @ basis)
        at = _terms(all_u.ravel(), all_v.ravel(), order)[1]
        leverage = np.einsum("ni,ij,nj->n", at, spread, at).max()
        if leverage > MOST_LEVERAGE:
            break
        found = np.linalg.lstsq(basis, height, rcond=None)[0]
        square = max(float(np.sum((height - basis @ found) ** 2)), len(x) * LEAST_UM**2)
        fits.append((len(x) * np.log(square / len(x)) + len(terms) * np.log(len(x)), terms, found, spread, square))
    if not fits:
        allowed = "heights spread over the whole frame, not along a line or in a part of it"
        raise InputError("heights that do not tell the surface all over the frame", where=str(path), value=len(x), allowed=allowed)
    _, terms, found, spread, square = min(fits, key=lambda fit: fit[0])
    order = max(i for _, i in terms)
    scatter = float(np.sqrt(square / (len(x) - len(terms))))
    more = np.zeros((order + 1, order + 1))
    own, own_u = dict.fromkeys(NAMED.values(), 0.0), {}
    for k, (term, value) in enumerate(zip(terms, found, strict=True)):
        if term in NAMED:
            own[NAMED[term]] = float(value)
            own_u[NAMED[term]] = scatter * float(np.sqrt(spread[k, k]))
        elif sum(term) > 1:
            more[term] = value
    name = next((e.name for e in camera.chain if e.source.id == "sensor.unflatness"), "sensor.unflatness")
    plane = {term: float(value) for term, value in zip(terms, found, strict=True)}
    notes = [
        f"height map: polynomials of order {order} fit {len(x)} heights to {scatter:.2g} µm; left out is its plane: "
        f"{plane[0, 0]:.3g} µm of piston, {plane[0, 1]:.3g} µm and {plane[1, 0]:.3g} µm of slope from the centre to the edges in x and y"
    ]
    if more.any() and scatter > 2 * LEAST_UM:
        notes.append("height map: the covariance holds bow, twist and skew; it lacks the uncertainty of the other terms")
    if min(u.max(), -u.min(), v.max(), -v.min()) < COVERED:
        notes.append("height map: it does not reach the edges of the frame, where its surface is continued")
    told = {key: value for key, value in own_u.items() if value > LEAST_UM}
    return HeightMap(
        {f"{name}.{key}": value for key, value in (own | {"more_um": more.tolist()}).items()},
        {f"{name}.{key}": value for key, value in told.items()},
        tuple(notes),
    )


def _terms(u: np.ndarray, v: np.ndarray, order: int) -> tuple[list[tuple[int, int]], np.ndarray]:
    """Orders of P_j(v) P_i(u) up to a total order, and their values, shape (n, terms)."""
    terms = [(j, i) for j in range(order + 1) for i in range(order + 1 - j)]
    values = np.polynomial.legendre.legvander2d(v, u, [order, order])
    return terms, values[:, [j * (order + 1) + i for j, i in terms]]


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
    height = decode(image_bytes(path), path).array
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
