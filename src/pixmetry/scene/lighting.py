"""How brightly a flat surface looks to the camera from place to place: lamp, direction of view, and kind of surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import ParameterError

Surface = Literal["gradient", "lambert", "glossy", "retro"]


@dataclass(frozen=True)
class Lighting:
    """A factor on the light of a scene.

    The surface is a plane through (x_px, y_px), measured in pixels at its image scale; z points to the camera. Its irradiance from a point
    lamp is cos θ / r² (inverse squares). On top of a diffuse reflection of 1 comes a lobe: (m + 8)/8 · (n·h)^m of Blinn and Phong (SIGGRAPH
    1977; normalised as in Akenine-Möller et al., Real-Time Rendering), or exp(−α²/2σ²) of the angle α between lamp and camera for a
    retro-reflector.

    Parameters
    ----------
    surface : {"gradient", "lambert", "glossy", "retro"}
        ``gradient`` is the linear factor itself.
    x_px, y_px : float
        Middle of the surface.
    gradient_x_per_px, gradient_y_per_px : float
        Of ``gradient``.
    lamp_px : (float, float, float)
        Place of the lamp from the middle of the surface.
    camera_distance_px : float
        From the camera's projection centre to the middle, along z.
    tilt_x_deg, tilt_y_deg : float
        The surface's normal is turned from z by these angles towards x and towards y.
    lobe_gain : float
        Strength of the lobe against the diffuse reflection.
    lobe_exponent : float
        m of ``glossy``.
    lobe_width_deg : float
        σ of ``retro``.
    relative_to : {"centre", "facing"}
        Where the factor is 1: in the middle, or for a matt surface there that faces the lamp.
    """

    surface: Surface = "gradient"
    x_px: float = 0.0
    y_px: float = 0.0
    gradient_x_per_px: float = 0.0
    gradient_y_per_px: float = 0.0
    lamp_px: tuple[float, float, float] = (0.0, 0.0, 1e5)
    camera_distance_px: float = 1e5
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0
    lobe_gain: float = 1.0
    lobe_exponent: float = 20.0
    lobe_width_deg: float = 0.5
    relative_to: Literal["centre", "facing"] = "centre"

    def __post_init__(self) -> None:
        usable = self.lamp_px[2] > 0 and self.camera_distance_px > 0 and max(abs(self.tilt_x_deg), abs(self.tilt_y_deg)) < 89
        if not usable or not (self.lobe_gain >= 0 and self.lobe_exponent > 0 and self.lobe_width_deg > 0):
            raise ParameterError(
                "a lighting cannot be used",
                where="lighting",
                allowed="lamp and camera in front of the surface (z above 0), tilt below 89°, lobe_gain 0 or more, a lobe of some width",
            )
        if self.surface != "gradient" and self._brightness(np.zeros(1), np.zeros(1))[0] <= 0:
            raise ParameterError(
                "the lamp stands behind the surface", where="lighting.lamp_px", value=self.lamp_px, remedy="tilt the surface less"
            )

    def factor(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The factor at places on the image plane."""
        u, v = np.asarray(x, float) - self.x_px, np.asarray(y, float) - self.y_px
        if self.surface == "gradient":
            return np.maximum(1 + self.gradient_x_per_px * u + self.gradient_y_per_px * v, 0.0)
        zero = np.zeros(1)
        if self.relative_to == "centre":
            relative: Array = self._brightness(u, v) / self._brightness(zero, zero)[0]
            return relative
        return self._brightness(u, v) * float(np.dot(self.lamp_px, self.lamp_px))

    def with_slopes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The factor and its derivatives along x and y, per pixel."""
        h = 0.5
        along_x = (self.factor(x + h, y) - self.factor(x - h, y)) / (2 * h)
        along_y = (self.factor(x, y + h) - self.factor(x, y - h)) / (2 * h)
        return self.factor(x, y), along_x, along_y

    def _brightness(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Irradiance times reflection, in px⁻²."""
        normal = np.array([np.tan(np.deg2rad(self.tilt_x_deg)), np.tan(np.deg2rad(self.tilt_y_deg)), 1.0])
        # the camera looks at the plane along straight rays: the place on the plane lies on the ray through (u, v, 0)
        depth = self.camera_distance_px
        stretch = 1.0 / (1.0 - (normal[0] * u + normal[1] * v) / depth)
        place = np.stack([u * stretch, v * stretch, depth * (1.0 - stretch)], axis=-1)
        normal = normal / np.linalg.norm(normal)
        lamp, distance = _unit(np.asarray(self.lamp_px, float) - place)
        view, _ = _unit(np.array([0.0, 0.0, depth]) - place)
        facing = np.maximum(lamp @ normal, 0.0)
        if self.surface == "glossy":
            half, _ = _unit(lamp + view)
            lobe = (self.lobe_exponent + 8) / 8 * np.maximum(half @ normal, 0.0) ** self.lobe_exponent
        elif self.surface == "retro":
            between = 2 * np.arcsin(np.minimum(0.5 * np.linalg.norm(lamp - view, axis=-1), 1.0))
            lobe = np.exp(-0.5 * (between / np.deg2rad(self.lobe_width_deg)) ** 2)
        else:
            lobe = np.zeros_like(facing)
        brightness: Array = facing / distance**2 * (1 + self.lobe_gain * lobe)
        return brightness


def _unit(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = np.sqrt((v * v).sum(axis=-1))
    return v / length[..., None], length
