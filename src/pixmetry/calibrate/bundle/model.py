"""Camera models of the bundle adjustment: interior parameters, their names and units, and the two directions of the distortion.

Photogrammetry corrects what was measured (``image_to_object``): about the principal point, in millimetres on the sensor,

    x̄ = (x − xp) pitch_x,  ȳ = (y − yp) pitch_y,
    c X/Z = x̄ (1 + B1 + K1 r² + K2 r⁴ + …) + B2 ȳ + P1 (r² + 2 x̄²) + 2 P2 x̄ ȳ,
    c Y/Z = ȳ (1 + K1 r² + K2 r⁴ + …) + P2 (r² + 2 ȳ²) + 2 P1 x̄ ȳ.

Vision distorts what is ideal (``object_to_image``): with u = X/Z, v = Y/Z and dimensionless coefficients,

    a = u (1 + K1 r² + K2 r⁴ + …) + P1 (r² + 2 u²) + 2 P2 u v,   b = v (1 + K1 r² + …) + P2 (r² + 2 v²) + 2 P1 u v,
    x = xp + c ((1 + B1) a + B2 b) / pitch_x,   y = yp + c b / pitch_y.

The camera looks along z, x to the right and y down; pixel (0, 0) is the centre of the top-left pixel. Without a pitch the unit of the
image plane is the pixel. OpenCV's p1 and p2 are P2 and P1 of the second form.

References
----------
D. C. Brown, Close-range camera calibration, Photogrammetric Engineering 37 (1971) 855–866 (image to object); C. S. Fraser, Digital camera
self-calibration, ISPRS J. 52 (1997) 149–159 (B1, B2); Z. Zhang, IEEE PAMI 22 (2000) 1330–1334 (object to image).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from pixmetry.calibrate.bundle._model_kernels import IMAGE_TO_OBJECT, INTERIOR, OBJECT_TO_IMAGE, Lens, directions, image_points
from pixmetry.core.errors import ParameterError

Direction = Literal["image_to_object", "object_to_image"]
NAMES = ("c", "xp", "yp", "b1", "b2", "p1", "p2", "k1", "k2", "k3", "k4", "k5")
TEN = ("c", "xp", "yp", "b1", "b2", "p1", "p2", "k1", "k2", "k3")  # the parameters that are estimated unless others are asked for
CODES = {"image_to_object": IMAGE_TO_OBJECT, "object_to_image": OBJECT_TO_IMAGE}
assert len(NAMES) == INTERIOR


@dataclass(frozen=True)
class Sensor:
    """The pixel grid of a camera.

    Parameters
    ----------
    cols, rows : int
    pitch_x_um, pitch_y_um : float, optional
        None: the image plane is measured in pixels.
    """

    cols: int
    rows: int
    pitch_x_um: float | None = None
    pitch_y_um: float | None = None

    def __post_init__(self) -> None:
        if not (self.cols >= 1 and self.rows >= 1):
            size = (self.cols, self.rows)
            raise ParameterError("not the size of a sensor", where="sensor", value=size, allowed="cols and rows of at least 1")
        if (self.pitch_x_um is None) != (self.pitch_y_um is None):
            remedy = "give pitch_x_um and pitch_y_um, or neither"
            raise ParameterError("one of the two pixel pitches is missing", where="sensor", remedy=remedy)
        pitch = self.pitch_x_um, self.pitch_y_um
        if any(one is not None and not 0 < one < 1000 for one in pitch):
            raise ParameterError("not a pixel pitch", where="sensor", value=pitch, allowed="above 0, in µm")

    @property
    def unit(self) -> str:
        """Unit of lengths in the image plane: ``"mm"`` or ``"px"``."""
        return "px" if self.pitch_x_um is None else "mm"

    @property
    def per_px(self) -> tuple[float, float]:
        """Length units per pixel along x and y."""
        if self.pitch_x_um is None or self.pitch_y_um is None:
            return 1.0, 1.0
        return self.pitch_x_um / 1000, self.pitch_y_um / 1000

    @property
    def centre(self) -> tuple[float, float]:
        """Middle of the frame, px."""
        return (self.cols - 1) / 2, (self.rows - 1) / 2


@dataclass(frozen=True)
class CameraModel:
    """Interior parameters of one camera.

    Parameters
    ----------
    sensor : Sensor
    direction : {"image_to_object", "object_to_image"}
        What the distortion takes to what; see the head of this module.
    values : ndarray, shape (12,)
        In the order of `NAMES`: c in mm (px without a pitch); xp, yp in px; b1, b2 dimensionless; p1, p2 in 1/mm and k_n in 1/mm²ⁿ
        (image to object, px without a pitch) or dimensionless (object to image).
    free : ndarray of bool, shape (12,)
        Which of them an adjustment estimates.
    name : str
    interface : {"digital", "analogue"} or None
        Whether a frame grabber samples its lines; None: not told.
    """

    sensor: Sensor
    direction: Direction = "image_to_object"
    values: np.ndarray = field(default_factory=lambda: np.zeros(INTERIOR))
    free: np.ndarray = field(default_factory=lambda: np.isin(NAMES, TEN))
    name: str = "camera"
    interface: str | None = None

    def __post_init__(self) -> None:
        if self.direction not in CODES:
            raise ParameterError("no such direction of the distortion", where="camera", value=self.direction, allowed=", ".join(CODES))
        if self.values.shape != (INTERIOR,) or self.free.shape != (INTERIOR,):
            raise ValueError("shapes do not agree")

    @classmethod
    def of(
        cls, sensor: Sensor, direction: Direction = "image_to_object", free: tuple[str, ...] = TEN, name: str = "camera", **values: float
    ) -> CameraModel:
        """A model from named values; the principal point is the middle of the frame unless it is given."""
        row = np.zeros(INTERIOR)
        row[1:3] = sensor.centre
        for key, value in values.items():
            row[NAMES.index(key)] = value
        return cls(sensor, direction, row, np.isin(NAMES, free), name)

    def __getitem__(self, key: str) -> float:
        return float(self.values[NAMES.index(key)])

    def with_values(self, **values: float) -> CameraModel:
        """The same model with some other values."""
        row = self.values.copy()
        for key, value in values.items():
            row[NAMES.index(key)] = value
        return replace(self, values=row)

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each parameter, in the order of `NAMES`."""
        unit = self.sensor.unit
        lens = ("1", "1", *("1" for _ in range(5)))
        if self.direction == "image_to_object":
            powers = "²⁴⁶⁸"
            lens = (f"1/{unit}", f"1/{unit}", *(f"1/{unit}{powers[k]}" for k in range(4)), f"1/{unit}¹⁰")
        return (unit, "px", "px", "1", "1", *lens)

    @property
    def c_px(self) -> tuple[float, float]:
        """Principal distance in pixels along x and y, without affinity."""
        mx, my = self.sensor.per_px
        return self.values[0] / mx, self.values[0] / my

    @property
    def _lens(self) -> Lens:
        return Lens(self.values, CODES[self.direction], *self.sensor.per_px)

    def project(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places in the image, px, of directions u = X/Z, v = Y/Z; NaN where the distortion has no inverse."""
        x, y, _, _ = self.projected(u, v)
        return x, y

    def projected(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Like `project`, flat, with the derivatives by (u, v), shape (n, 2, 2), and by the parameters, shape (n, 2, 12)."""
        return image_points(_flat(u), _flat(v), self._lens)

    def direction_of(self, x_px: np.ndarray, y_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Directions u = X/Z, v = Y/Z in which places in the image look; NaN where the distortion has no inverse."""
        u, v, _ = directions(_flat(x_px), _flat(y_px), self._lens)
        return u, v


def _flat(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.atleast_1d(values), dtype=float).ravel()
