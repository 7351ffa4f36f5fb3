"""How targets move: their displacement as a function of time, or frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.core.errors import ParameterError


@dataclass(frozen=True)
class Motion:
    """Displacement v t + a t²/2 + A sin(2π f t + φ), plus a place of each frame.

    Parameters
    ----------
    velocity_px_per_s, acceleration_px_per_s2 : (float, float)
        In x and in y, at time 0.
    amplitude_px : (float, float)
        Of a sinusoidal vibration in x and in y.
    frequency_hz, phase_deg : float
        Of the vibration.
    table_px : ndarray, shape (frames, 2), optional
        Displacement in x and y of each frame, added; beyond its end it repeats.
    """

    velocity_px_per_s: tuple[float, float] = (0.0, 0.0)
    acceleration_px_per_s2: tuple[float, float] = (0.0, 0.0)
    amplitude_px: tuple[float, float] = (0.0, 0.0)
    frequency_hz: float = 0.0
    phase_deg: float = 0.0
    table_px: np.ndarray | None = None

    def __post_init__(self) -> None:
        numbers = [*self.velocity_px_per_s, *self.acceleration_px_per_s2, *self.amplitude_px, self.frequency_hz, self.phase_deg]
        if not np.isfinite(numbers).all() or self.frequency_hz < 0:
            raise ParameterError("a motion cannot be used", where="motion", value=numbers, allowed="finite numbers, frequency 0 or more")
        if self.table_px is not None:
            table = np.asarray(self.table_px, float)
            if table.ndim != 2 or table.shape[1] != 2 or not len(table) or not np.isfinite(table).all():
                raise ParameterError(
                    "a table of displacements cannot be used", where="motion.table_px", allowed="a list of [x, y], one per frame"
                )
            object.__setattr__(self, "table_px", table)

    @property
    def still(self) -> bool:
        """Whether nothing moves."""
        return self.table_px is None and not any((*self.velocity_px_per_s, *self.acceleration_px_per_s2, *self.amplitude_px))

    def offset(self, time_s: ArrayLike, frame: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Displacement in x and y, in pixels, at these times of these frames."""
        t, number = np.asarray(time_s, float), np.asarray(frame)
        return self._along(0, t, number), self._along(1, t, number)

    def _along(self, axis: int, t: np.ndarray, frame: np.ndarray) -> np.ndarray:
        out: Any = np.float64(0)  # what is 0 is not computed at millions of points
        if self.velocity_px_per_s[axis]:
            out = out + self.velocity_px_per_s[axis] * t
        if self.acceleration_px_per_s2[axis]:
            out = out + 0.5 * self.acceleration_px_per_s2[axis] * t**2
        if self.amplitude_px[axis]:
            out = out + self.amplitude_px[axis] * np.sin(2 * np.pi * self.frequency_hz * t + np.deg2rad(self.phase_deg))
        if self.table_px is not None:
            out = out + self.table_px[:, axis][frame % len(self.table_px)]
        return np.broadcast_to(out, np.broadcast_shapes(t.shape, frame.shape))


STILL = Motion()
