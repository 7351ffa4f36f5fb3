"""The pixel grid of a preset's stored frames: its size, the distance of its samples, and whether it is the sensor's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pixmetry.camera.camera import Camera
from pixmetry.camera.chain_order import Element
from pixmetry.core.errors import InputError

CLOCK, READ_OUT, WINDOW = "grabber.sampling_clock", "sensor.read_out", "grabber.window_offset"


@dataclass(frozen=True)
class StoredGrid:
    """The samples of a stored frame.

    Parameters
    ----------
    cols, rows : int
    pitch_um : (float, float) or None
        Distance of samples on the sensor; None where the sensor's pixel pitch is not known.
    changed : str
        What makes them others than the sensor's pixels; empty if they are the same.
    """

    cols: int
    rows: int
    pitch_um: tuple[float, float] | None
    changed: str


def stored_grid(camera: Camera) -> StoredGrid:
    """The grid of the frames that a camera stores.

    A grabber that samples with a clock f_s of its own has samples f_pixel/f_s pixels apart along the row (R. Lenz, D. Fritsch, ISPRS
    J. Photogramm. 45, 1990, 90); single fields have rows two pixels apart.
    """
    rows, cols = camera.output_shape
    scale, changes = np.ones(2), []
    for element in camera.active:
        step, change = _changed(camera, element)
        scale *= step
        changes += [change] * bool(change)
    if not changes and (rows, cols) != camera.frame_shape:
        changes.append(f"it stores {cols} x {rows} of the sensor's {camera.frame_shape[1]} x {camera.frame_shape[0]} pixels")
    pitch = None if camera.pitch_um is None else (camera.pitch_um[0] * float(scale[0]), camera.pitch_um[1] * float(scale[1]))
    return StoredGrid(cols, rows, pitch, " and ".join(changes))


def _changed(camera: Camera, element: Element) -> tuple[tuple[float, float], str]:
    """Distance of samples in x and y, in samples of before; and what an element does to the grid, in words."""
    params, name = element.params, element.source.id
    if name == CLOCK and params != element.source.neutral:
        ratio = camera.pixel_clock_hz / (1e6 * params.clock_mhz) if params.clock_mhz else 1.0
        if ratio != 1 or params.start_ns:
            return (ratio, 1.0), f"its grabber samples with a clock of its own ({ratio:.6g} pixels a sample)"
    if name == READ_OUT and params.mode == "field":
        return (1.0, 2.0), "it stores single fields (rows two pixels apart)"
    if name == WINDOW and (params.inactive_rows or params.row_offset or params.col_offset):
        row, col = params.row_offset, params.col_offset
        return (1.0, 1.0), f"its grabber stores a window from row {row}, column {col} on"
    return (1.0, 1.0), ""


def check_size(camera: Camera, size: Sequence[int], where: str, what: str) -> None:
    """Refuse pictures or a project whose frame is not the one that the camera stores.

    Raises
    ------
    InputError
        With both sizes.
    """
    rows, cols = camera.output_shape
    if tuple(size) != (cols, rows):
        remedy = "name the camera that took them, or leave the preset away"
        found, allowed = f"{size[0]} x {size[1]} pixels", f"{cols} x {rows} pixels"
        raise InputError(f"{what} another size than the frames of {camera.name}", where=where, value=found, allowed=allowed, remedy=remedy)
