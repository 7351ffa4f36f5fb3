"""Camera models of the bundle adjustment: interior parameters, their names and units, and the two directions of the distortion.

Photogrammetry corrects what was measured (``image_to_object``): about the principal point, in millimetres on the sensor,

    x̄ = (x − xp) pitch_x,  ȳ = (y − yp) pitch_y,
    c X/Z = x̄ (1 + B1 + K1 r² + K2 r⁴ + …) + B2 ȳ + P1 (r² + 2 x̄²) + 2 P2 x̄ ȳ,
    c Y/Z = ȳ (1 + K1 r² + K2 r⁴ + …) + P2 (r² + 2 ȳ²) + 2 P1 x̄ ȳ.

Vision distorts what is ideal (``object_to_image``): with u = X/Z, v = Y/Z and dimensionless coefficients,

    a = u (1 + K1 r² + K2 r⁴ + …) + P1 (r² + 2 u²) + 2 P2 u v,   b = v (1 + K1 r² + …) + P2 (r² + 2 v²) + 2 P1 u v,
    x = xp + c ((1 + B1) a + B2 b) / pitch_x,   y = yp + c b / pitch_y.

The radial factor may have a denominator, 1 + (K1 r² + …) becoming (1 + K1 r² + …)/(1 + D1 r² + D2 r⁴ + D3 r⁶), and thin prisms add
S1 r² + S2 r⁴ to the first and S3 r² + S4 r⁴ to the second coordinate, in both forms.

A fisheye draws the ray at the angle θ from the axis at another ideal distance than c tan θ: c θ (equidistant), 2 c sin θ/2 (equisolid),
2 c tan θ/2 (stereographic) or c sin θ (orthographic). Its distortion is that about this image: u and v above are those of the ideal image
for c = 1. So the equidistant lens from object to image with K1 … K4 is that of Kannala and Brandt, OpenCV's fisheye. Rays at 90° and more
from the axis have no place here.

The camera looks along z, x to the right and y down; pixel (0, 0) is the centre of the top-left pixel. Without a pitch the unit of the
image plane is the pixel. OpenCV's p1 and p2 are P2 and P1 of the second form.

References
----------
D. C. Brown, Close-range camera calibration, Photogrammetric Engineering 37 (1971) 855–866 (image to object); C. S. Fraser, Digital camera
self-calibration, ISPRS J. 52 (1997) 149–159 (B1, B2); Z. Zhang, IEEE PAMI 22 (2000) 1330–1334 (object to image);
J. Kannala, S. Brandt, IEEE PAMI 28 (2006) 1335–1340 (fisheye); OpenCV, module calib3d (denominator; thin prisms: J. Weng et al., IEEE
PAMI 14 (1992) 965–980).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from pixmetry.calibrate.bundle._model_kernels import (
    EQUIDISTANT,
    EQUISOLID,
    IMAGE_TO_OBJECT,
    INTERIOR,
    OBJECT_TO_IMAGE,
    ORTHOGRAPHIC,
    PERSPECTIVE,
    STEREOGRAPHIC,
    Lens,
    directions,
    image_points,
)
from pixmetry.core.errors import ParameterError

Direction = Literal["image_to_object", "object_to_image"]
Projection = Literal["perspective", "equidistant", "equisolid", "stereographic", "orthographic"]
NAMES = ("c", "xp", "yp", "b1", "b2", "p1", "p2", "k1", "k2", "k3", "k4", "k5", "d1", "d2", "d3", "s1", "s2", "s3", "s4")
TEN = ("c", "xp", "yp", "b1", "b2", "p1", "p2", "k1", "k2", "k3")  # the parameters that are estimated unless others are asked for
CODES = {"image_to_object": IMAGE_TO_OBJECT, "object_to_image": OBJECT_TO_IMAGE}
PROJECTIONS: dict[str, int] = {
    "perspective": PERSPECTIVE,
    "equidistant": EQUIDISTANT,
    "equisolid": EQUISOLID,
    "stereographic": STEREOGRAPHIC,
    "orthographic": ORTHOGRAPHIC,
}
POWERS = (1, 0, 0, 0, 0, -1, -1, -2, -4, -6, -8, -10, -2, -4, -6, -1, -3, -1, -3)  # of the unit of length, where corrections have one
SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
assert len(NAMES) == len(POWERS) == INTERIOR


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
    values : ndarray, shape (19,)
        In the order of `NAMES`: c in mm (px without a pitch); xp, yp in px; b1, b2 dimensionless; p1, p2 in 1/mm, k_n and d_n in 1/mm²ⁿ,
        s1, s3 in 1/mm and s2, s4 in 1/mm³ (image to object, px without a pitch) or dimensionless (object to image).
    free : ndarray of bool, shape (19,)
        Which of them an adjustment estimates.
    name : str
    interface : {"digital", "analogue"} or None
        Whether a frame grabber samples its lines; None: not told.
    projection : {"perspective", "equidistant", "equisolid", "stereographic", "orthographic"}
        What the lens would draw without distortion.
    """

    sensor: Sensor
    direction: Direction = "image_to_object"
    values: np.ndarray = field(default_factory=lambda: np.zeros(INTERIOR))
    free: np.ndarray = field(default_factory=lambda: np.isin(NAMES, TEN))
    name: str = "camera"
    interface: str | None = None
    projection: Projection = "perspective"

    def __post_init__(self) -> None:
        if self.direction not in CODES:
            raise ParameterError("no such direction of the distortion", where="camera", value=self.direction, allowed=", ".join(CODES))
        if self.projection not in PROJECTIONS:
            raise ParameterError("no such projection", where="camera", value=self.projection, allowed=", ".join(PROJECTIONS))
        if self.values.shape != (INTERIOR,) or self.free.shape != (INTERIOR,):
            raise ValueError("shapes do not agree")

    @classmethod
    def of(
        cls,
        sensor: Sensor,
        direction: Direction = "image_to_object",
        free: tuple[str, ...] = TEN,
        name: str = "camera",
        projection: Projection = "perspective",
        **values: float,
    ) -> CameraModel:
        """A model from named values; the principal point is the middle of the frame unless it is given."""
        row = np.zeros(INTERIOR)
        row[1:3] = sensor.centre
        for key, value in values.items():
            row[NAMES.index(key)] = value
        return cls(sensor, direction, row, np.isin(NAMES, free), name, None, projection)

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
        lens = ["1"] * len(POWERS[5:])
        if self.direction == "image_to_object":
            lens = [f"1/{unit}" + (str(-power).translate(SUPERSCRIPTS) if power < -1 else "") for power in POWERS[5:]]
        return (unit, "px", "px", "1", "1", *lens)

    @property
    def parameters(self) -> tuple[tuple[str, float, str, bool], ...]:
        """Name, value, unit, and whether it is estimated, of each; without the denominator's and the prisms' where they are not used."""
        rows = zip(NAMES, self.values.tolist(), self.units, self.free.tolist(), strict=True)
        return tuple(row for row in rows if row[0][0] not in "ds" or row[1] or row[3])

    @property
    def c_px(self) -> tuple[float, float]:
        """Principal distance in pixels along x and y, without affinity."""
        mx, my = self.sensor.per_px
        return self.values[0] / mx, self.values[0] / my

    @property
    def form(self) -> int:
        """Direction of the distortion and projection, as the kernels take them."""
        return CODES[self.direction] + 2 * PROJECTIONS[self.projection]

    @property
    def _lens(self) -> Lens:
        return Lens(self.values, self.form, *self.sensor.per_px)

    def project(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places in the image, px, of directions u = X/Z, v = Y/Z; NaN where the distortion has no inverse."""
        x, y, _, _ = self.projected(u, v)
        return x, y

    def projected(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Like `project`, flat, with the derivatives by (u, v), shape (n, 2, 2), and by the parameters, shape (n, 2, 19)."""
        return image_points(_flat(u), _flat(v), self._lens)

    def direction_of(self, x_px: np.ndarray, y_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Directions u = X/Z, v = Y/Z in which places in the image look; NaN where the distortion has no inverse."""
        u, v, _ = directions(_flat(x_px), _flat(y_px), self._lens)
        return u, v


def _flat(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.atleast_1d(values), dtype=float).ravel()
