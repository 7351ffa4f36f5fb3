"""Plates with dots or squares seen in perspective by a pinhole camera: exact ellipses, and the images of the circles' centres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import ParameterError
from pixmetry.scene.motion import STILL, Motion
from pixmetry.scene.outlines import Outline, polygon
from pixmetry.scene.shapes import Shapes


@dataclass(frozen=True)
class Pose:
    """Pose of a plate in front of the camera.

    The camera looks along z, x to the right and y down. A point X of the plate (X, Y, 0) lies at R X + t, with R = Rz(κ) Ry(φ) Rx(ω), and
    is seen at principal point + c (x/z, y/z).

    Parameters
    ----------
    principal_distance_px, principal_x_px, principal_y_px : float
    omega_deg, phi_deg, kappa_deg : float
    x_mm, y_mm, z_mm : float
        t, the place of the plate's middle in front of the camera.
    """

    principal_distance_px: float
    principal_x_px: float
    principal_y_px: float
    omega_deg: float = 0.0
    phi_deg: float = 0.0
    kappa_deg: float = 0.0
    x_mm: float = 0.0
    y_mm: float = 0.0
    z_mm: float = 1000.0

    def __post_init__(self) -> None:
        if not (np.isfinite(list(vars(self).values())).all() and self.principal_distance_px > 0 and self.z_mm > 0):
            raise ParameterError("a pose cannot be used", where="pose", allowed="finite numbers, principal distance and z_mm above 0")

    @property
    def homography(self) -> np.ndarray:
        """Matrix H with (x, y, 1) ~ H (X, Y, 1), shape (3, 3)."""
        (sw, cw), (sp, cp), (sk, ck) = ((np.sin(a), np.cos(a)) for a in np.deg2rad([self.omega_deg, self.phi_deg, self.kappa_deg]))
        about_x = np.array([[1, 0, 0], [0, cw, -sw], [0, sw, cw]])
        about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        about_z = np.array([[ck, -sk, 0], [sk, ck, 0], [0, 0, 1]])
        turn = about_z @ about_y @ about_x
        c = self.principal_distance_px
        camera = np.array([[c, 0, self.principal_x_px], [0, c, self.principal_y_px], [0, 0, 1]])
        plane_to_image: Array = camera @ np.column_stack([turn[:, 0], turn[:, 1], [self.x_mm, self.y_mm, self.z_mm]])
        return plane_to_image

    def seen(self, x_mm: np.ndarray, y_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Images of points of the plate.

        Raises
        ------
        ParameterError
            If a point lies behind the camera.
        """
        p = np.einsum("ij,j...->i...", self.homography, np.stack([x_mm, y_mm, np.ones_like(x_mm)]))
        if (p[2] <= 1e-6 * self.z_mm).any():
            raise ParameterError("a part of the plate is behind the camera", where="pose", remedy="tilt it less or move it away (z_mm)")
        return p[0] / p[2], p[1] / p[2]


def circle_images(homography: np.ndarray, x: np.ndarray, y: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Ellipses as which circles of a plane are seen: (cx, cy, ux, uy, vx, vy), shape (k, 6).

    A circle is the conic pᵀ C p = 0, its image H⁻ᵀ C H⁻¹ (Hartley and Zisserman, Multiple View Geometry, 2.13).
    """
    # in coordinates about the image of each circle's centre, where the numbers stay small
    one = np.ones_like(x)
    image = np.einsum("ij,jk->ik", homography, np.stack([x, y, one]))
    px, py = image[0] / image[2], image[1] / image[2]
    local = np.tile(np.eye(3), (len(x), 1, 1))
    local[:, 0, 0] = local[:, 1, 1] = radius
    local[:, 0, 2], local[:, 1, 2] = x, y
    back = np.tile(np.eye(3), (len(x), 1, 1))
    back[:, 0, 2], back[:, 1, 2] = -px, -py
    inverse = np.linalg.inv(back @ homography @ local)
    conic = inverse.swapaxes(1, 2) @ np.diag([1.0, 1.0, -1.0]) @ inverse
    a, b = conic[:, :2, :2], conic[:, :2, 2]
    centre = -np.linalg.solve(a, b[..., None])[..., 0]
    size = -(conic[:, 2, 2] + (b * centre).sum(axis=1))
    values, axes = np.linalg.eigh(a / size[:, None, None])
    if not (values > 0).all():
        raise ParameterError("the image of a circle is not an ellipse", where="pose", remedy="tilt the plate less or move it away (z_mm)")
    u, v = axes[:, :, 0] / np.sqrt(values[:, :1]), axes[:, :, 1] / np.sqrt(values[:, 1:])
    turned = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] < 0
    v[turned] *= -1
    return np.column_stack([px + centre[:, 0], py + centre[:, 1], u, v])


def dot_plate(
    pose: Pose,
    rows: int,
    columns: int,
    pitch_mm: float,
    diameter_mm: float,
    height_photons: float = 1000.0,
    blur_px: float = 0.0,
    motion: Motion = STILL,
) -> Shapes:
    """A plate with a grid of round dots about its middle.

    `Shapes.targets` gives of each dot the image of its centre (x_px, y_px) and the centre of its ellipse (ellipse_x_px, ellipse_y_px): they
    differ by the eccentricity of perspective.
    """
    if not (rows >= 1 and columns >= 1 and rows * columns <= 1_000_000 and diameter_mm > 0 and pitch_mm > 0):
        raise ParameterError(
            "a dot plate cannot be used",
            where="plate",
            value=(rows, columns, pitch_mm, diameter_mm),
            allowed="1 to 1e6 dots, pitch and diameter above 0",
        )
    j, i = (v.ravel() for v in np.meshgrid(np.arange(columns), np.arange(rows)))
    x, y = (j - 0.5 * (columns - 1)) * pitch_mm, (i - 0.5 * (rows - 1)) * pitch_mm
    reach = 0.5 * diameter_mm
    pose.seen(np.concatenate([x - reach, x + reach, x - reach, x + reach]), np.concatenate([y - reach, y - reach, y + reach, y + reach]))
    ovals = circle_images(pose.homography, x, y, np.full(x.size, reach))
    px, py = pose.seen(x, y)
    told = [
        {"kind": "dot", "x_px": float(a), "y_px": float(b), "ellipse_x_px": float(o[0]), "ellipse_y_px": float(o[1])}
        | {"width_px": float(2 * np.hypot(*o[2:4])), "height_px": float(2 * np.hypot(*o[4:]))}
        | {"row": int(r), "column": int(c), "x_mm": float(mx), "y_mm": float(my)}
        for a, b, o, r, c, mx, my in zip(px, py, ovals, i, j, x, y, strict=True)
    ]
    return Shapes.of_ovals(ovals, np.full(x.size, float(height_photons)), blur_px, motion, told)


def chessboard(
    pose: Pose, rows: int, columns: int, square_mm: float, height_photons: float = 1000.0, blur_px: float = 0.0, motion: Motion = STILL
) -> Shapes:
    """A plate of bright and dark squares about its middle, the first (top left) bright; targets are the inner corners."""
    if not (rows >= 2 and columns >= 2 and rows * columns <= 1_000_000 and square_mm > 0):
        raise ParameterError(
            "a chessboard cannot be used",
            where="plate",
            value=(rows, columns, square_mm),
            allowed="2 or more rows and columns, square above 0",
        )
    across, down = (np.arange(columns + 1) - 0.5 * columns) * square_mm, (np.arange(rows + 1) - 0.5 * rows) * square_mm
    x, y = pose.seen(*np.meshgrid(across, down))

    def square(r: int, c: int) -> Outline:
        corners = ([r, r, r + 1, r + 1], [c, c + 1, c + 1, c])
        return polygon(x[corners], y[corners], height_photons)

    outlines = [square(r, c) for r in range(rows) for c in range(columns) if (r + c) % 2 == 0]
    told = [
        {"kind": "corner", "x_px": float(x[r, c]), "y_px": float(y[r, c]), "row": r - 1, "column": c - 1}
        | {"x_mm": float(across[c]), "y_mm": float(down[r])}
        for r in range(1, rows)
        for c in range(1, columns)
    ]
    made = Shapes.of(outlines, blur_px, motion)
    return Shapes(made.segments, made.start, made.height_photons, made.oval, blur_px, motion, told)
