"""Distortion curves with their bands, and the uncertainty of a projection over the sensor."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, CameraModel
from pixmetry.calibrate.bundle.network import Adjustment
from pixmetry.calibrate.checks.quality import propagated
from pixmetry.calibrate.records import DistortionCurves, ProjectionMap
from pixmetry.core.arrays import Array

RADIAL, BELOW = ("k1", "k2", "k3", "k4", "k5"), ("d1", "d2", "d3")


def distortion_curves(adjustment: Adjustment, balanced_at: float | None = None, points: int = 101) -> dict[str, DistortionCurves]:
    """Radial, balanced and tangential distortion against the radius, from the principal point to the farthest corner.

    From image to object these are corrections of the measured radius r: Δr = K1 r³ + K2 r⁵ + …. From object to image they are what the lens
    adds to the ideal radius r = c tan θ, or that of the fisheye's projection. The balanced form has another principal distance c_b, and the
    rest as distortion: of the same lens, with Δr_b = (c_b/c)(r + Δr) − r (image to object) or r + Δr − (c_b/c) r. Its band holds c_b, a
    function of the same parameters.

    Parameters
    ----------
    adjustment : Adjustment
    balanced_at : float, optional
        Radius in the unit of the image plane at which the balanced curve vanishes; by default its mean square over the circle of the
        frame's corners is least.
    points : int

    Returns
    -------
    dict
        By camera.
    """
    out = {}
    for k in range(len(adjustment.network.cameras)):
        camera = adjustment.camera(k)
        radius = np.linspace(0.0, _farthest(camera), points)
        per_px = camera.sensor.per_px[0]
        made: dict[str, Any] = {}
        forms: dict[str, Callable[[CameraModel], np.ndarray]] = {
            "radial": partial(radial_distortion, radius=radius),
            "balanced": partial(_balanced_curve, radius=radius, balanced_at=balanced_at),
            "tangential": partial(tangential_distortion, radius=radius),
        }
        for name, form in forms.items():
            values, covariance = propagated(adjustment, k, form)
            u = np.sqrt(np.maximum(np.diag(covariance), 0.0))
            made |= {name: values, f"u_{name}": u, f"{name}_px": values / per_px, f"u_{name}_px": u / per_px}
        c_b, variance = propagated(adjustment, k, partial(_balanced_c, radius=radius, balanced_at=balanced_at))
        u_c_b = float(np.sqrt(max(variance[0, 0], 0.0)))
        balanced: dict[str, Any] = {"balanced_c": float(c_b[0]), "u_balanced_c": u_c_b}
        out[camera.name] = DistortionCurves(camera.sensor.unit, radius, radius / per_px, **made, **balanced)
    return out


def radial_distortion(camera: CameraModel, radius: np.ndarray) -> np.ndarray:
    """Δr at a radius, both in the unit of the image plane; see `distortion_curves`."""
    to_image = camera.direction == "object_to_image"
    q = np.asarray(radius, float) / (camera["c"] if to_image else 1.0)
    square = q * q

    def polynomial(names: tuple[str, ...]) -> Array:
        out = np.zeros_like(q)
        for value in camera.values[[NAMES.index(name) for name in reversed(names)]].tolist():
            out = square * (value + out)
        return 1 + out

    return q * (polynomial(RADIAL) / polynomial(BELOW) - 1) * (camera["c"] if to_image else 1.0)


def tangential_distortion(camera: CameraModel, radius: Array) -> Array:
    """Profile of the decentring distortion, √(p1² + p2²) r², in the unit of the image plane (Brown 1971)."""
    size = float(np.hypot(camera["p1"], camera["p2"]))
    return size * np.asarray(radius, float) ** 2 / (camera["c"] if camera.direction == "object_to_image" else 1.0)


def balanced_distortion(camera: CameraModel, radius: np.ndarray, balanced_at: float | None = None) -> tuple[np.ndarray, float]:
    """Balanced curve and its principal distance. ``radius`` is evenly spaced and covers the frame; see `distortion_curves`.

    Raises
    ------
    ValueError
        If the radius at which the curve shall vanish is not above 0.
    """
    if balanced_at is not None and not balanced_at > 0:
        raise ValueError(f"balanced at radius {balanced_at}")
    where = np.asarray(radius, float) if balanced_at is None else np.array([balanced_at])
    real, weight = where + radial_distortion(camera, where), where  # rings of a circle count by their circumference
    moved = radius + radial_distortion(camera, radius)
    if camera.direction == "image_to_object":
        ratio = np.sum(weight * real * where) / np.sum(weight * real**2)
        return ratio * moved - radius, float(ratio * camera["c"])
    ratio = np.sum(weight * real * where) / np.sum(weight * where**2)
    return moved - ratio * radius, float(ratio * camera["c"])


def _balanced_curve(camera: CameraModel, radius: np.ndarray, balanced_at: float | None) -> np.ndarray:
    return balanced_distortion(camera, radius, balanced_at)[0]


def _balanced_c(camera: CameraModel, radius: np.ndarray, balanced_at: float | None) -> np.ndarray:
    return np.array([balanced_distortion(camera, radius, balanced_at)[1]])


def _farthest(camera: CameraModel) -> float:
    """Distance of the farthest corner from the principal point, in the unit of the image plane."""
    (mx, my), sensor = camera.sensor.per_px, camera.sensor
    dx = max(camera["xp"] + 0.5, sensor.cols - 0.5 - camera["xp"]) * mx
    dy = max(camera["yp"] + 0.5, sensor.rows - 0.5 - camera["yp"]) * my
    return float(np.hypot(dx, dy))


def projection_maps(adjustment: Adjustment, cols: int = 25, rows: int = 19) -> dict[str, ProjectionMap]:
    """How surely a direction is known over the sensor, as the standard uncertainty of a coordinate in the image (the mean of x and y).

    Another principal point is almost the same as another rotation of the camera, which every use of the camera finds anew. In ``u_px`` the
    best small rotation is therefore fitted out of each possible error, by least squares over the map; ``u_raw_px`` still holds it.

    Returns
    -------
    dict
        By camera.
    """
    out = {}
    for k in range(len(adjustment.network.cameras)):
        camera = adjustment.camera(k)
        names, covariance = adjustment.interior_covariance(k)
        x, y = np.linspace(0, camera.sensor.cols - 1, cols), np.linspace(0, camera.sensor.rows - 1, rows)
        u, v = camera.direction_of(*(part.ravel() for part in np.meshgrid(x, y)))
        good = np.isfinite(u + v)
        raw, fitted = np.full(rows * cols, np.nan), np.full(rows * cols, np.nan)
        by_parameter, by_rotation = _slopes(camera, names, u[good], v[good])
        taken = by_rotation @ np.linalg.lstsq(by_rotation, by_parameter, rcond=None)[0]
        raw[good], fitted[good] = (_coordinate_u(slopes, covariance) for slopes in (by_parameter, by_parameter - taken))
        out[camera.name] = ProjectionMap(x, y, fitted.reshape(rows, cols), raw.reshape(rows, cols))
    return out


def _slopes(camera: CameraModel, names: tuple[str, ...], u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the image of directions by the parameters and by a rotation of the camera, x and y in turn."""
    _, _, by_direction, by_interior = camera.projected(u, v)
    turned = np.empty((len(u), 2, 3))  # (u, v) of (u, v, 1) + w × (u, v, 1)
    turned[:, 0] = np.stack([-u * v, 1 + u * u, -v], axis=1)
    turned[:, 1] = np.stack([-(1 + v * v), u * v, u], axis=1)
    by_parameter = by_interior[:, :, [NAMES.index(name) for name in names]]
    return by_parameter.reshape(2 * len(u), len(names)), np.einsum("nij,njk->nik", by_direction, turned).reshape(-1, 3)


def _coordinate_u(slopes: Array, covariance: Array) -> Array:
    variance = np.einsum("ij,jk,ik->i", slopes, covariance, slopes).reshape(-1, 2)
    u: Array = np.sqrt(np.maximum(variance.mean(axis=1), 0.0))
    return u
