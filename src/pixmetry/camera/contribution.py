"""Effect of an error source on a target's position: the linear response of an estimator, and the resulting contribution.

A contribution has four parts. What is *constant* over the frame and in time moves the principal point; what changes *smoothly* over the
frame deforms the image: a calibration of the camera takes up both. What changes from *place* to place within a few pixels (with the phase
in the pixel, with the pixels that a target falls on) and what changes in *time* stay.

Classes, by what averages a contribution: ``T`` temporal, pixel by pixel or frame by frame, and ``Tr`` temporal, common to a row: over
frames and targets; ``F`` fixed, changes with the sub-pixel phase or the place on the sensor: over targets; ``G`` smooth geometric
mapping: by neither, self-calibration absorbs part; ``D`` drift: by neither; ``O`` object and illumination: by neither.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from pixmetry.camera.line import Held
from pixmetry.core.arrays import Array

CLASSES = ("T", "Tr", "F", "G", "D", "O")


UNSTEADY = ("D", "O")  # classes of which a calibration takes nothing up: the next image has them otherwise
BY_CLASS = (float("nan"), float("nan"))  # parts that are not given: the class says which they are
SMOOTH_ORDER = 3  # of the polynomial in the place that a calibration is taken to follow


@dataclass(frozen=True)
class Contribution:
    """What one source adds to the position of one target in one frame, k = 1.

    ``bias_*`` is the mean shift over all phases and places, constant in time; ``u_*`` the standard deviation about it. ``model_error`` is
    the relative error that the propagator declares for its ``u`` and ``bias`` (the larger of it and ``floor_px`` holds).

    ``time_px`` and ``smooth_px`` are the parts of ``u`` in x and y that change in time and smoothly over the frame; by default all of it,
    or nothing, as the class says: T, Tr, D and O change in time, G is smooth, F neither.

    ``kurtosis`` is the fourth moment of the shift over the square of the second: 3 of a normal distribution, hundreds of a shift that few
    targets have.
    """

    u_x_px: float
    u_y_px: float
    gum_class: str
    bias_x_px: float = 0.0
    bias_y_px: float = 0.0
    model_error: float = 0.1
    floor_px: float = 2e-4
    method: str = ""
    time_px: tuple[float, float] = BY_CLASS
    smooth_px: tuple[float, float] = BY_CLASS
    kurtosis: float = 3.0

    def __post_init__(self) -> None:
        smooth, time = self.smooth_px, self.time_px
        if smooth is BY_CLASS:
            smooth = self.u_px if self.gum_class == "G" and time is BY_CLASS else (0.0, 0.0)
        if time is BY_CLASS:
            (u_x, u_y), (smooth_x, smooth_y) = self.u_px, smooth
            time = (0.0, 0.0) if self.gum_class in ("F", "G") else (_less(u_x, smooth_x), _less(u_y, smooth_y))
        object.__setattr__(self, "smooth_px", smooth)
        object.__setattr__(self, "time_px", time)

    @property
    def u_px(self) -> tuple[float, float]:
        """Standard deviation in x and y."""
        return self.u_x_px, self.u_y_px

    @property
    def bias_px(self) -> tuple[float, float]:
        """Mean shift in x and y."""
        return self.bias_x_px, self.bias_y_px

    @property
    def place_px(self) -> tuple[float, float]:
        """Part of ``u`` in x and y that changes from place to place, and not smoothly."""
        parts = zip(self.u_px, self.time_px, self.smooth_px, strict=True)
        x, y = (_less(u, float(np.hypot(time, smooth))) for u, time, smooth in parts)
        return x, y

    @property
    def total_px(self) -> float:
        """Root mean square over x and y of random part and bias together."""
        return float(np.sqrt(0.5 * (self.u_x_px**2 + self.u_y_px**2 + self.bias_x_px**2 + self.bias_y_px**2)))

    @property
    def calibrated_px(self) -> float:
        """Remaining total after a calibration, without the constant and the smooth part; for the classes D and O, the whole total."""
        if self.gum_class in UNSTEADY:
            return self.total_px
        return float(np.sqrt(0.5 * sum(v**2 for v in (*self.place_px, *self.time_px))))


def _less(whole: float, part: float) -> float:
    return float(np.sqrt(max(whole**2 - part**2, 0.0)))


def smooth_part(values: np.ndarray, *places: np.ndarray, order: int = SMOOTH_ORDER) -> np.ndarray:
    """What a polynomial of all places follows of values that belong to them, by least squares; shape of the values.

    ``places`` are coordinates, one array for each axis, of the values' shape; with fewer different ones along an axis the order is lower.
    """
    flat = [np.ravel(p).astype(float) for p in places]
    scaled = [(p - p.mean()) / (np.ptp(p) or 1.0) for p in flat]
    powers = [range(min(order, len(np.unique(p)) - 1) + 1) for p in flat]
    columns = [np.prod([p**k for p, k in zip(scaled, ks, strict=True)], axis=0) for ks in product(*powers) if sum(ks) <= order]
    basis = np.stack(columns, axis=1)
    smooth: Array = (basis @ np.linalg.lstsq(basis, np.ravel(values).astype(float), rcond=None)[0]).reshape(np.shape(values))
    return smooth


@dataclass(frozen=True)
class Probe:
    """A target seen through an estimator, noise-free, at several places within the pixel.

    Parameters
    ----------
    signal_dn : ndarray, shape (p, rows, cols), float64
        Linear signal above black (background and target) in DN, at p sub-pixel phases.
    background_dn : float
        Linear signal of the background.
    x_px, y_px : ndarray, shape (p,)
        True positions in window coordinates (0 is the centre of the window's first pixel).
    x_hat_px, y_hat_px : ndarray, shape (p,)
        What the estimator gives without any error source.
    gx, gy : ndarray, shape (p, rows, cols)
        Change of the estimated x and y per DN added to a pixel: the estimator's gradient.
    gain_dn_per_e, exposure_s, temperature_c, bits : float
        Of the camera under which the target is seen.
    frame_shape : (int, int)
    locate : callable, optional
        The estimator itself, (p, rows, cols) DN to x and y in window coordinates, for changes that are too large for its gradient. With
        ``held`` it takes the phase as well, for windows that all belong to one.
    saturation_dn : float
        Where the scale ends, above black: no pixel is seen brighter.
    pixel_clock_hz : float
        Of the camera.
    pedestal_dn : float
        By how much black lies above code 0 at the converter without what the source that is asked for adds: what lies deeper is cut off.
        Infinite where nothing is.
    held : Held, optional
        The windows on the camera's video line, for the sources of the line (`camera.line`).

    Notes
    -----
    The windows are those that the source meets: pixels ahead of the video line, samples behind it. All that the camera's line does after
    the source belongs to the estimator: what a filter behind a noise smooths is in ``gx`` and ``locate``. Shifts are in pixels of the
    sensor everywhere.
    """

    signal_dn: np.ndarray
    background_dn: float
    x_px: np.ndarray
    y_px: np.ndarray
    x_hat_px: np.ndarray
    y_hat_px: np.ndarray
    gx: np.ndarray
    gy: np.ndarray
    gain_dn_per_e: float
    exposure_s: float
    temperature_c: float
    bits: int
    frame_shape: tuple[int, int]
    locate: Callable[..., tuple[np.ndarray, np.ndarray]] | None = None
    saturation_dn: float = float("inf")
    pixel_clock_hz: float = 14.1875e6
    pedestal_dn: float = float("inf")
    held: Held | None = None

    def white(self, sigma_dn: np.ndarray | float) -> tuple[float, float]:
        """u_x, u_y from independent errors of standard deviation ``sigma_dn`` (scalar or per pixel) in every pixel."""
        var = np.broadcast_to(np.asarray(sigma_dn, float) ** 2, self.gx.shape)
        u_x, u_y = (float(np.sqrt((g**2 * var).sum(axis=(1, 2)).mean())) for g in (self.gx, self.gy))
        return u_x, u_y

    def rows(self, sigma_dn: np.ndarray | float) -> tuple[float, float]:
        """u_x, u_y from errors common to each row; ``sigma_dn`` scalar, or per pixel for one that scales with the signal."""
        return self._lines(sigma_dn, axis=2)

    def columns(self, sigma_dn: np.ndarray | float) -> tuple[float, float]:
        """u_x, u_y from errors common to each column."""
        return self._lines(sigma_dn, axis=1)

    def _lines(self, sigma_dn: np.ndarray | float, axis: int) -> tuple[float, float]:
        weight = np.broadcast_to(np.asarray(sigma_dn, float), self.gx.shape)
        u_x, u_y = (float(np.sqrt(((g * weight).sum(axis=axis) ** 2).sum(axis=1).mean())) for g in (self.gx, self.gy))
        return u_x, u_y

    def field(self, error_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shift in x and y, shape (p,), from a given error field (p, rows, cols) or (rows, cols) in DN (first order)."""
        return (self.gx * error_dn).sum(axis=(1, 2)), (self.gy * error_dn).sum(axis=(1, 2))

    def moved(self, signal_dn: np.ndarray, phase: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Shift in x and y, shape (p,), when the signal becomes this one; by the estimator itself, or to first order if it is not given.

        With a ``phase``, any number of windows (n, rows, cols) in which the target lies at that one, and n shifts.
        """
        which: Any = slice(None) if phase is None else phase
        if self.locate is None:
            change = signal_dn - self.signal_dn[which]
            return (self.gx[which] * change).sum(axis=(1, 2)), (self.gy[which] * change).sum(axis=(1, 2))
        x, y = self.locate(signal_dn) if phase is None or self.held is None else self.locate(signal_dn, phase)
        return x - self.x_hat_px[which], y - self.y_hat_px[which]

    def contribution(self, u: tuple[float, float], gum_class: str, **kw: Any) -> Contribution:
        """Shorthand for a contribution without bias."""
        return Contribution(u_x_px=u[0], u_y_px=u[1], gum_class=gum_class, **kw)

    def from_shifts(
        self, dx: np.ndarray, dy: np.ndarray, gum_class: str, beside: tuple[float, float] = (0.0, 0.0), **kw: Any
    ) -> Contribution:
        """Contribution from shifts at each phase: their mean is the bias, their scatter the uncertainty, with that of ``beside`` (x, y)."""
        return Contribution(
            u_x_px=float(np.hypot(np.std(dx), beside[0])),
            u_y_px=float(np.hypot(np.std(dy), beside[1])),
            bias_x_px=float(np.mean(dx)),
            bias_y_px=float(np.mean(dy)),
            gum_class=gum_class,
            **kw,
        )
