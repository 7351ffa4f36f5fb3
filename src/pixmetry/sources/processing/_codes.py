"""Common parts of a camera's digital processing: codes with a border for filters, and results stored as codes."""

from __future__ import annotations

from typing import Any

import numpy as np

from pixmetry.camera.signal import Windows
from pixmetry.camera.source import quantity


def bits_of_camera() -> Any:
    """The parameter ``bits``: the range of the codes that a step takes and gives."""
    return quantity(8, "bit", "the codes run from 0 to 2^bits − 1", ge=1, le=16)


def bordered(codes: np.ndarray, reach: int) -> np.ndarray:
    """Codes with ``reach`` more pixels on each side, mirrored about the outermost ones: so a mosaic keeps its phase. uint16."""
    return np.pad(codes.astype(np.uint16, copy=False), ((0, 0), (reach, reach), (reach, reach)), mode="reflect")


def stored(values: np.ndarray, bits: int) -> np.ndarray:
    """Round once, halves up, and clip to the range; uint16."""
    return np.clip(np.floor(np.asarray(values, float) + 0.5), 0, 2**bits - 1).astype(np.uint16)


def surround(windows: Windows, reach: int, frame_shape: tuple[int, int]) -> Windows:
    """Windows enlarged by a number of pixels on each side, as far as the frame reaches."""
    return windows.expand(reach, reach, reach, reach, frame_shape)
