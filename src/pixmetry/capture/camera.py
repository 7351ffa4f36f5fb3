"""What a live camera is: exposure set, started, asked for frames, stopped. Every make is one module behind this protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Grabbed:
    """What a camera delivered.

    Parameters
    ----------
    array : ndarray, shape (rows, cols), or None
        Grey values; None where there is nothing to be decoded.
    number : int or None
        Of the camera's own counter, which counts frames that were lost on the way too; None without one.
    time_s : float or None
        Time stamp, seconds on any clock; None without one.
    temperature_c : float or None
        Of the sensor.
    exposure_s : float or None
        Exposure time that the frame itself tells.
    complete : bool
        Whether all of it has arrived.
    why : str
        What is wrong with one that is not complete.
    """

    array: np.ndarray | None
    number: int | None = None
    time_s: float | None = None
    temperature_c: float | None = None
    exposure_s: float | None = None
    complete: bool = True
    why: str = ""


class LiveCamera(Protocol):
    """A camera of any make.

    Attributes
    ----------
    name : str
        Make and model.
    serial_number : str
        Empty where it is not known.
    bits : int
        Of a stored value.
    sets_exposure : bool
        Whether the program sets the exposure time; if not, the operator is asked to.
    exposure_range_s : (float, float)
        Shortest and longest exposure time.
    """

    name: str
    serial_number: str
    bits: int
    sets_exposure: bool
    exposure_range_s: tuple[float, float]

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure time while the camera is stopped, and return what the camera made of it."""
        ...

    def start(self) -> None:
        """Start a run of frames; what was exposed before is not delivered."""
        ...

    def frame(self, timeout_s: float) -> Grabbed | None:
        """The next frame, damaged ones too; None if none came in time."""
        ...

    def stop(self) -> None:
        """End the run."""
        ...

    def close(self) -> None:
        """Give the camera back."""
        ...
