"""Results of an adjustment as columns by name: what the CSV files of a calibration and its data frames hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment


def parameter_columns(a: Adjustment) -> dict[str, Any]:
    """Interior parameters of all cameras: ``value``, standard uncertainty ``u`` (0: held), ``unit``, ``estimated``."""
    rows = []
    for k in range(len(a.network.cameras)):
        camera = a.camera(k)
        free, covariance = a.interior_covariance(k)
        u = dict(zip(free, np.sqrt(np.diag(covariance)).tolist(), strict=True))
        for name, value, unit, _ in camera.parameters:
            rows.append((camera.name, name, value, u.get(name, 0.0), unit, name in u))
    return dict(zip(("camera", "parameter", "value", "u", "unit", "estimated"), map(list, zip(*rows, strict=True)), strict=True))


def point_columns(a: Adjustment) -> dict[str, Any]:
    """Object points with their uncertainties and covariances in the unit of the object, and in how many images each was used."""
    c = a.point_covariance
    return {
        "point": a.network.points,
        **dict(zip("XYZ", a.state.xyz.T, strict=True)),
        **{f"u_{axis}": np.sqrt(c[:, k, k]) for k, axis in enumerate("XYZ")},
        **{f"cov_{'XYZ'[i]}{'XYZ'[j]}": c[:, i, j] for i, j in ((0, 1), (0, 2), (1, 2))},
        "images": np.bincount(a.network.point[a.used], minlength=len(a.network.points)),
    }


def pose_columns(a: Adjustment) -> dict[str, Any]:
    """Projection centres and rotations of the images with their uncertainties."""
    network, state = a.network, a.state
    u = dict(zip(a.free_columns, np.sqrt(np.maximum(np.diag(a.covariance), 0.0)), strict=True))

    def of(name: str) -> list[float]:
        return [float(u.get(f"{image}:{name}", np.nan)) for image in network.images]

    columns: dict[str, Any] = {
        "image": network.images,
        "camera": [network.cameras[k].name for k in network.camera_of],
        **{f"{axis}0": state.position[:, k] for k, axis in enumerate("XYZ")},
        **{f"r{i + 1}{j + 1}": state.rotation[:, i, j] for i in range(3) for j in range(3)},
        **{f"u_{axis}0": of(f"{axis}0") for axis in "XYZ"},
        **{f"u_{axis}_rad": of(axis) for axis in ("rx", "ry", "rz")},
    }
    if "x_scale" in network.per_image:
        columns |= {"x_scale": state.x_scale, "u_x_scale": of("x_scale")}
    if "x_shift" in network.per_image:
        columns |= {"x_shift_px": state.x_shift_px, "u_x_shift_px": of("x_shift")}
    return columns


def residual_columns(a: Adjustment) -> dict[str, Any]:
    """Image coordinates with their variances as they were used, and residuals: measured less computed."""
    network = a.network
    columns: dict[str, Any] = {
        "image": [network.images[k] for k in network.image],
        "point": [network.points[k] for k in network.point],
        "x_px": network.x_px,
        "y_px": network.y_px,
        "var_x_px2": network.covariance_px2[:, 0],
        "cov_xy_px2": network.covariance_px2[:, 1],
        "var_y_px2": network.covariance_px2[:, 2],
        "residual_x_px": a.residual_px[:, 0],
        "residual_y_px": a.residual_px[:, 1],
        "used": a.used.astype(int),
    }
    if a.redundancy is not None:
        columns |= {"redundancy_x": a.redundancy[:, 0], "redundancy_y": a.redundancy[:, 1]}
    return columns


TABLES: dict[str, Callable[[Adjustment], dict[str, Any]]] = {
    "parameters": parameter_columns,
    "points": point_columns,
    "poses": pose_columns,
    "residuals": residual_columns,
}
