"""Several frames of one scene, shifted by parts of a pixel, put together on a finer grid: the correction of ``sensor.pixel_aperture``."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.finer_grid import FINER_KEY, MOST_FINER, SHIFT_KEY, ShiftedFrames, finest, lost_bands
from pixmetry.camera.signal import Kind, Signal
from pixmetry.core.config import read_text
from pixmetry.core.door import one_sentence
from pixmetry.core.errors import InputError
from pixmetry.core.memory import check_memory
from pixmetry.core.random import Grid
from pixmetry.observe.frame_shifts import frame_shifts
from pixmetry.sources.sensor.pixel_aperture import transfer

APERTURE = "sensor.pixel_aperture"
FOUND = "found"  # in place of a table: by the frames themselves
MOST_U_PHASE = 0.5  # radian, at the highest frequency of the finer grid
COLUMNS = ("shift_x_px", "shift_y_px")


@dataclass(frozen=True, eq=False)
class FinerImage:
    """Shifted frames on a finer grid.

    Parameters
    ----------
    image_dn : ndarray, shape (rows, cols), float32
        Mean over each finer pixel, DN above black.
    finer : (int, int)
        Finer pixels in a pixel, along x and y.
    origin_px : (float, float)
        Where the centre of its first pixel lies in a frame whose shift is 0, in pixels of the frames: finer pixel (i, j) is at
        ``origin_px + (j / finer[0], i / finer[1])`` there, and its shift farther in another frame.
    pitch_um : (float, float) or None
        Of the finer grid.
    shifts_px, u_shifts_px : ndarray, shape (n, 2)
        Displacement of the image in each frame, along x and y; its u is 0 where a table tells none.
    noise_rel : float
        Standard deviation of a finer pixel by white noise, over that of a pixel of a frame.
    residual_dn : float
        Standard deviation of the frames about the image; NaN where there are no more frames than needed.
    lost_x_cycles, lost_y_cycles : tuple of (float, float)
        Frequencies that cannot be restored along each axis, from and to, in cycles per pixel of the frames.
    """

    image_dn: np.ndarray
    finer: tuple[int, int]
    origin_px: tuple[float, float]
    pitch_um: tuple[float, float] | None
    shifts_px: np.ndarray
    u_shifts_px: np.ndarray
    noise_rel: float
    residual_dn: float
    lost_x_cycles: tuple[tuple[float, float], ...]
    lost_y_cycles: tuple[tuple[float, float], ...]

    @property
    def text(self) -> str:
        """What was done, and what cannot be."""
        said = [f"{len(self.shifts_px)} frames on a grid {self.finer[0]} × {self.finer[1]} times as fine"]
        for axis, bands in (("x", self.lost_x_cycles), ("y", self.lost_y_cycles)):
            for low, high in bands:
                said.append(f"not restored along {axis}: {low:.2f} to {high:.2f} cycles per pixel")
        if self.u_shifts_px.any():
            u, top = float(self.u_shifts_px.max()), max(self.finer) / 2
            said.append(f"u of the shifts up to {u:.2g} px, by which a frame errs by {2 * np.pi * top * u:.2g} of what is finest")
        if np.isfinite(self.residual_dn):
            said.append(f"the frames lie about the image by {self.residual_dn:.3g} DN, which is their noise if the shifts are right")
        return "; ".join(said)

    def to_record(self) -> dict[str, Any]:
        """Plain record for JSON."""
        return {
            "finer_x": self.finer[0],
            "finer_y": self.finer[1],
            "origin_x_px": self.origin_px[0],
            "origin_y_px": self.origin_px[1],
            "pitch_um": None if self.pitch_um is None else list(self.pitch_um),
            "shifts_px": self.shifts_px.tolist(),
            "u_shifts_px": self.u_shifts_px.tolist(),
            "noise_rel": self.noise_rel,
            "residual_dn": None if np.isnan(self.residual_dn) else self.residual_dn,
            "lost_x_cycles_per_px": [list(band) for band in self.lost_x_cycles],
            "lost_y_cycles_per_px": [list(band) for band in self.lost_y_cycles],
        }


def finer_image(frames_dn: np.ndarray, camera: Camera, shifts: Any, finer: Any = None) -> FinerImage:
    """Put frames together that are corrected otherwise.

    Parameters
    ----------
    frames_dn : ndarray, shape (n, rows, cols)
    camera : Camera
        With its light-sensitive area; one without it has pixels that are sensitive all over.
    shifts : array_like of shape (n, 2), or path, or "found"
    finer : int or (int, int), optional
        By default the finest grid that the shifts part.
    """
    element = next((e for e in camera.active if e.source.id == APERTURE), None)
    source = _source(element)
    params = source.neutral if element is None else element.params
    shifts_px, u_px = _shifts_of(shifts, frames_dn)
    shape = frames_dn.shape[1], frames_dn.shape[2]
    steps = finest(shifts_px, shape) if finer is None else _pair(finer)
    if steps == (1, 1):
        remedy = "shift the image by halves, thirds or quarters of a pixel from frame to frame"
        raise InputError("the shifts allow no finer grid", where="shifts", value=f"{len(shifts_px)} frames", remedy=remedy)
    if 2 * np.pi * max(steps) / 2 * float(u_px.max()) > MOST_U_PHASE * np.sqrt(len(shifts_px)):
        allowed = f"{MOST_U_PHASE * np.sqrt(len(shifts_px)) / (np.pi * max(steps)):.2g} px for this grid"
        remedy = "ask for a coarser grid, or take a scene with more detail"
        value = f"u {u_px.max():.2g} px"
        raise InputError("the shifts are not known well enough", where="shifts", value=value, allowed=allowed, remedy=remedy)
    grid = ShiftedFrames(shifts_px, steps, shape)
    grid.check()
    n, remedy = len(frames_dn), "ask for a coarser grid, or cut the frames"
    complex_frames = 3 * n + 5 * steps[0] * steps[1]  # spectra, what is left of them and what is between; the finer ones
    check_memory(16.0 * complex_frames * shape[0] * shape[1], f"a grid of {steps[0]} × {steps[1]} from {n} frames", remedy=remedy)
    signal = Signal(frames_dn, Kind.DN, Grid.whole([0] * n, shape), shape, np.ones(n), np.zeros(n), np.full(n, camera.temperature_c))
    image = source.correct(params, signal, {SHIFT_KEY: shifts_px, FINER_KEY: np.array(steps)}).data[0]
    _, residual = grid.restored(frames_dn, lambda fx, fy: transfer(params, fx, fy)) if n > steps[0] * steps[1] else (None, float("nan"))
    zero = np.zeros(1)
    return FinerImage(
        image, steps, (grid.area.col0 - 0.5 + 0.5 / steps[0], grid.area.row0 - 0.5 + 0.5 / steps[1]),
        None if camera.pitch_um is None else (camera.pitch_um[0] / steps[0], camera.pitch_um[1] / steps[1]),
        shifts_px, u_px, grid.noise_rel(lambda fx, fy: transfer(params, fx, fy)), residual,
        tuple(lost_bands(lambda f: transfer(params, f, zero), steps[0])), tuple(lost_bands(lambda f: transfer(params, zero, f), steps[1])),
    )  # fmt: skip


def finer_camera(camera: Camera, found: FinerImage) -> Camera:
    """A camera whose frames are the finer image: its size, its pitch, its aperture and its noise, for the steps that follow.

    The noise is that of the camera by its mean grey value, times `FinerImage.noise_rel`. It is white in this camera; in the finer image
    neighbours are correlated where an aperture is undone.
    """
    from pixmetry.camera.camera import build_camera
    from pixmetry.locate.noise import camera_noise

    noise = camera_noise(camera).model
    gain = max(found.noise_rel**2 * noise.slope_dn, 1e-9)
    read_e = found.noise_rel * float(np.sqrt(noise.constant_dn2)) / gain
    rows, cols = found.image_dn.shape
    chain = [("sensor.quantum_efficiency", {"quantum_efficiency": 1.0}), ("sensor.shot_noise", {}),
             ("electronics.amplifier_noise", {"white_e": read_e}), ("electronics.gain", {"gain_dn_per_e": gain})]  # fmt: skip
    record: dict[str, Any] = {
        "schema": "pixmetry/camera/1", "name": f"{camera.name}_finer", "rows": rows, "cols": cols, "exposure_s": camera.exposure_s,
        "temperature_c": camera.temperature_c, "chain": [{"source": name, "parameters": given} for name, given in chain],
    }  # fmt: skip
    return replace(build_camera(record), pitch_um=found.pitch_um)


def _source(element: Element | None) -> Any:
    from pixmetry.camera.catalogue import get_source

    return get_source(APERTURE) if element is None else element.source


def _pair(finer: Any) -> tuple[int, int]:
    """Steps along x and y from a number, two, or text: ``4``, ``4x1``."""
    try:
        parts = finer.lower().split("x") if isinstance(finer, str) else np.atleast_1d(finer).tolist()
        values = tuple(int(v) for v in parts if isinstance(v, str) or v == int(v))
    except (TypeError, ValueError, OverflowError):
        values = ()
    if len(values) == 1:
        values = values * 2
    if len(values) != 2 or not all(1 <= v <= MOST_FINER for v in values):
        raise InputError("no such finer grid", where="finer", value=finer, allowed=f"1 to {MOST_FINER}, or two such as 4x1")
    return values[0], values[1]


def _shifts_of(shifts: Any, frames_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shifts of all frames and their u."""
    if isinstance(shifts, str) and shifts == FOUND:
        found = frame_shifts(frames_dn)
        return found.shifts_px, found.u_px
    if isinstance(shifts, str | Path):
        told, u = read_shifts(shifts)
    else:
        with one_sentence("no shifts", "shifts", allowed=f"a table, {FOUND!r}, or numbers of shape (n, 2)", remedy="check the argument"):
            told, u = np.asarray(shifts, float), None
    if told.shape != (len(frames_dn), 2) or not np.isfinite(told).all():
        raise InputError("a shift along x and y is needed for every frame", where="shifts", value=f"shape {told.shape}",
                         allowed=f"({len(frames_dn)}, 2), finite")  # fmt: skip
    return told, np.zeros_like(told) if u is None else u


def read_shifts(path: str | Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Shifts from a table, a row for each frame in the order of the frames, with the columns of `COLUMNS` and perhaps ``u_shift_px``."""
    lines = [line for line in read_text(Path(path)).splitlines() if line.strip() and not line.startswith("#")]
    rows: Sequence[dict[str, Any]] = list(csv.DictReader(io.StringIO("\n".join(lines))))
    missing = [name for name in COLUMNS if not rows or name not in rows[0]]
    if missing:
        found = ", ".join(rows[0]) if rows else "no rows"
        raise InputError(f"the table has no column {missing[0]}", where=str(path), value=found, allowed=", ".join((*COLUMNS, "u_shift_px")))
    try:
        told = np.array([[float(row[name]) for name in COLUMNS] for row in rows])
        u = np.array([[float(row["u_shift_px"])] * 2 for row in rows]) if "u_shift_px" in rows[0] else None
    except (TypeError, ValueError):
        raise InputError("a shift is not a number", where=str(path), allowed="numbers, in pixels of the frames") from None
    if u is not None and not (np.isfinite(u) & (u >= 0)).all():
        raise InputError("a u of a shift is no uncertainty", where=str(path), allowed="0 or more, in pixels of the frames")
    return told, u
