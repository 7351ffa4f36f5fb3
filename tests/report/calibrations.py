"""Calibrations made by hand for the tests of their report: simulated geometry and noise, plain records."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Adjustment, Network, ScaleBars, State
from pixmetry.calibrate.records import Calibration, Tests, read_record
from pixmetry.core.finding import Finding

NOISE_PX = 0.04
SIZE = (1280, 1024)
LENS = {"c": 8.02, "xp": 645.1, "yp": 505.3, "b1": 1.2e-4, "b2": -3e-5, "p1": 2e-5, "p2": -1.1e-5, "k1": -2.4e-3, "k2": 4.1e-5, "k3": -3e-7}


def camera_model(name: str, pitch_um: float | None) -> CameraModel:
    sensor = Sensor(*SIZE, pitch_um, pitch_um)
    if pitch_um is not None:
        return CameraModel.of(sensor, name=name, **LENS)
    per = {"c": 1, "p1": -1, "p2": -1, "k1": -2, "k2": -4, "k3": -6}  # power of the length
    lens = {key: value * (0.0055 ** -per.get(key, 0)) for key, value in LENS.items()}
    return CameraModel.of(sensor, name=name, **lens)


def looking(at: np.ndarray, position: np.ndarray, roll: float) -> np.ndarray:
    """Rotation of a camera that looks from a position to a point."""
    z = at - position
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    turn = np.array([[np.cos(roll), np.sin(roll), 0], [-np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    return turn @ np.stack([x, y, z])


def network_and_state(
    rng: np.random.Generator, pitch_um: float | None, cameras: int, images: int, points: int, visibility: float, plane: bool
) -> tuple[Network, State, np.ndarray]:
    models = tuple(camera_model(f"camera {k + 1}" if cameras > 1 else "camera", pitch_um) for k in range(cameras))
    side = int(np.ceil(np.sqrt(points)))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:points] * (800.0 / side) - 400
    depth = np.zeros(points) if plane else rng.uniform(-150, 150, points)
    xyz = np.column_stack([grid[:, 0], depth, grid[:, 1]])
    if plane:
        xyz = np.column_stack([grid, depth])
    angle = np.linspace(-0.9, 0.9, images) + rng.normal(0, 0.03, images)
    height = rng.uniform(-500, 500, images)
    position = np.column_stack([1400 * np.sin(angle), -1400 * np.cos(angle), height])
    if plane:
        position = np.column_stack([1200 * np.sin(angle), height, 1400 * np.cos(angle)])
    rotation = np.array([looking(rng.normal(0, 30, 3), p, k % 4 * np.pi / 2) for k, p in enumerate(position)])
    camera_of = np.arange(images) % cameras
    rows: list[list[np.ndarray]] = []
    for k in range(images):
        seen = (xyz - position[k]) @ rotation[k].T
        x, y = models[camera_of[k]].project(seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2])
        inside = (x > 0) & (x < SIZE[0] - 1) & (y > 0) & (y < SIZE[1] - 1) & (rng.random(points) < visibility)
        at = np.flatnonzero(inside)
        rows.append([x[at], y[at], np.full(len(at), k), at])
    x, y, image, point = (np.concatenate(part) for part in zip(*rows, strict=True))
    residual = rng.normal(0, NOISE_PX, (len(x), 2))
    u_xyz = np.zeros_like(xyz) if plane else np.full_like(xyz, np.inf)
    net = Network(
        models,
        tuple(f"img_{k + 1:03d}.tif" for k in range(images)),
        camera_of,
        tuple(f"P{k + 1}" for k in range(points)),
        x + residual[:, 0],
        y + residual[:, 1],
        image.astype(int),
        point.astype(int),
        np.tile([NOISE_PX**2, 0.0, NOISE_PX**2], (len(x), 1)),
        xyz,
        u_xyz,
    )
    zero = np.zeros(images)
    state = State(np.array([m.values for m in models]), rotation, position, zero, zero, xyz)
    return net, state, residual


def interior_covariance(net: Network, state: State, camera: int) -> np.ndarray:
    """Of the ten free parameters, poses eliminated, points taken as known."""
    free = net.cameras[camera].free
    total = np.zeros((free.sum(), free.sum()))
    for k in np.flatnonzero(net.camera_of == camera):
        seen = net.image == k
        local = (state.xyz[net.point[seen]] - state.position[k]) @ state.rotation[k].T
        u, v, z = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2], local[:, 2]
        _, _, by_uv, by_q = net.cameras[camera].projected(u, v)
        skew = np.zeros((len(z), 3, 3))
        skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -local[:, 2], local[:, 1], -local[:, 0]
        skew -= np.swapaxes(skew, 1, 2)
        by_local = np.zeros((len(z), 2, 3))
        by_local[:, 0, 0], by_local[:, 1, 1] = 1 / z, 1 / z
        by_local[:, 0, 2], by_local[:, 1, 2] = -u / z, -v / z
        pose = np.concatenate([by_uv @ by_local @ -skew, by_uv @ by_local], axis=2).reshape(-1, 6)
        lens = by_q[:, :, free].reshape(-1, int(free.sum()))
        total += lens.T @ lens - lens.T @ pose @ np.linalg.solve(pose.T @ pose, pose.T @ lens)
    return NOISE_PX**2 * np.linalg.inv(total)


def point_covariance(net: Network, state: State) -> np.ndarray:
    """From the rays alone: each knows the two directions across itself."""
    if np.all(net.u_xyz == 0):
        return np.zeros((len(net.points), 3, 3))
    ray = state.xyz[net.point] - state.position[net.image]
    length = np.linalg.norm(ray, axis=1)
    ray /= length[:, None]
    u = length * NOISE_PX / 1458
    across = (np.eye(3) - ray[:, :, None] * ray[:, None, :]) / (u**2)[:, None, None]
    total = np.zeros((len(net.points), 3, 3))
    np.add.at(total, net.point, across)
    seen = np.bincount(net.point, minlength=len(net.points)) >= 2
    out = np.full_like(total, np.nan)
    out[seen] = np.linalg.inv(total[seen])
    return out


def bare(
    rng: np.random.Generator,
    *,
    pitch_um: float | None = 5.5,
    cameras: int = 1,
    images: int = 14,
    points: int = 81,
    visibility: float = 1.0,
    plane: bool = False,
    covariance: bool = True,
) -> Calibration:
    """A calibration without any test: only what every adjustment has."""
    net, state, residual = network_and_state(rng, pitch_um, cameras, images, points, visibility, plane)
    names, parts = [], []
    for k, model in enumerate(net.cameras):
        names += [f"{model.name}:{name}" for name, free in zip(NAMES, model.free, strict=True) if free]
        parts.append(interior_covariance(net, state, k) if covariance else np.full((10, 10), np.nan))
    whole = np.zeros((len(names), len(names)))
    for k, part in enumerate(parts):
        whole[10 * k : 10 * k + 10, 10 * k : 10 * k + 10] = part
    n = len(net)
    used = np.ones(n, bool)
    used[[5, 40]] = False
    residual[5], residual[40] = (5.2, -0.8), (-0.3, 4.1)
    adjustment = Adjustment(
        net,
        state,
        used,
        residual,
        np.ones(n),
        1.02,
        2 * n - 6 * images - 10 * cameras,
        tuple(names),
        whole,
        point_covariance(net, state),
        None,
        None,
        "all points fixed" if plane else "inner constraints over 81 points; scale from the start values",
        6,
        (5.0e4, 2.2e3, 2.1e3),
    )
    return Calibration(adjustment)


def full(rng: np.random.Generator, **kw: Any) -> Calibration:
    """A calibration with every record that its report may show."""
    plain = bare(rng, **kw)
    adj = plain.adjustment
    net = adj.network
    start, end = np.array([0, 3]), np.array([8, 40])
    length = np.linalg.norm(net.xyz[end] - net.xyz[start], axis=1) + [0.0125, -0.004]
    bars = ScaleBars(start, end, length, np.array([0.01, 0.01]))
    net = replace(net, bars=bars, time_s=60.0 * np.arange(len(net.images)), per_image=("x_scale",))
    adj = replace(adj, network=net)
    records = read_record(Tests, tests_of(rng, adj))
    findings = (
        Finding(
            "flatness",
            "The test field is not flat: its points lie 0.21 mm rms and at most 0.48 mm off their nominal plane (p < 1e-12).",
            "Calibrate with free points, as was done here, or use a rigid, flat field.",
            "warning",
        ),
        Finding("gross_error", "2 image points were rejected as gross errors.", "See the table; check them."),
        Finding("correlation", "c and the distances of the cameras correlate by 0.97.", "Add convergent and rolled images.", "note"),
    )
    provenance = {
        "pixmetry": "0.9",
        "python": "3.13",
        "libraries": {"numpy": "2.3.1", "scipy": "1.16"},
        "platform": "Linux",
        "seed": 1,
        "time_utc": "2026-01-02T03:04:05+00:00",
        "command": ["pixmetry", "calibrate", "project.yaml"],
        "inputs": [{"name": "image_coordinates.csv", "size_bytes": 51234, "sha256": "0" * 64}],
        "options": {"level": 1e-3, "field": "auto"},
    }
    return Calibration(adj, findings, records, {}, provenance)


def tests_of(rng: np.random.Generator, adj: Adjustment) -> dict[str, Any]:
    net = adj.network
    out: dict[str, Any] = {
        name: {}
        for name in (
            "vision",
            "correlations",
            "residuals",
            "f_test",
            "variance_components",
            "curves",
            "projection",
            "residual_grid",
        )
    }
    out["parameters"] = []
    for k, model in enumerate(net.cameras):
        one_camera(rng, adj, k, model, out)
    out["correlations_with_poses"] = [{"a": f"{net.cameras[0].name}:c", "b": f"{net.images[-1]}:Z0", "r": 0.971}]
    out["gross_errors"] = [
        {
            "image": net.images[net.image[i]],
            "point": net.points[net.point[i]],
            "residual_x_px": float(adj.residual_px[i, 0]),
            "residual_y_px": float(adj.residual_px[i, 1]),
            "error_x_px": 1.1 * float(adj.residual_px[i, 0]),
            "error_y_px": 1.1 * float(adj.residual_px[i, 1]),
            "statistic": 8400.0,
            "critical": 28.3,
        }
        for i in np.flatnonzero(~adj.used)
    ]
    out["hold_out"] = {
        "fixed": {"fit_rms_px": 0.081, "left_out_rms_px": 0.092, "left_out_median_px": 0.062},
        "free": {"fit_rms_px": 0.039, "left_out_rms_px": 0.044, "left_out_median_px": 0.029},
        "expected_median_px": 0.027,
        "folds": 5,
        "text": "Images left out of the fit are reproduced to 0.092 px with the nominal field and to 0.044 px with free points.",
    }
    names = list(net.points)
    xyz = adj.state.xyz
    out["field"] = {
        "verdict": "free",
        "shape": "volume",
        "rms": 0.21,
        "peak": 0.48,
        "u": 0.0,
        "unit": "mm",
        "p": 1e-13,
        "moved_xp_px": 1.81,
        "moved_yp_px": -2.43,
        "moved_c_px": 0.77,
        "u_xp_px": 0.11,
        "u_yp_px": 0.12,
        "u_c_px": 0.13,
        "points": {
            "names": names,
            "xyz": xyz,
            "axes": np.eye(3),
            "dx": rng.normal(0, 0.02, len(names)),
            "dy": rng.normal(0, 0.02, len(names)),
            "dz": 0.5 * np.cos(xyz[:, 0] / 260) * np.cos(xyz[:, 1] / 330) - 0.2,
        },
    }
    camera = net.cameras[0].name
    advice = "use larger or softer targets"
    out["patterns"] = [
        {"name": "radius", "camera": camera, "amplitude_px": 0.001, "u_px": None, "p": 0.41, "significant": False, "advice": advice},
        {
            "name": "phase_x",
            "camera": camera,
            "amplitude_px": 0.0123,
            "u_px": 0.0011,
            "p": 3e-6,
            "significant": True,
            "causes": ["pixels that see little of the light"],
            "advice": advice,
        },
    ]
    names = ["k1", "k2", "k3"]
    out["parameter_groups"] = [{"camera": camera, "group": "radial", "names": names, "f": 512.0, "dof": (3, adj.dof), "p": 0.0}]
    out["eccentricity"] = {"corrected": 1003, "largest_px": 0.0231, "possible_px": 0.0}
    out["images"] = [
        {
            "image": name,
            "camera": net.cameras[net.camera_of[k]].name,
            "oriented": True,
            "n": int((net.image == k).sum()),
            "rejected": int((~adj.used & (net.image == k)).sum()),
            "rms_x_px": float(np.sqrt(np.mean(adj.residual_px[(net.image == k) & adj.used, 0] ** 2))),
            "rms_y_px": float(np.sqrt(np.mean(adj.residual_px[(net.image == k) & adj.used, 1] ** 2))),
            "time_s": 60.0 * k,
            "x_scale": 1e-4 * np.exp(-k / 4),
            "u_x_scale": 6e-6,
            "x_shift_px": None,
            "u_x_shift_px": None,
        }
        for k, name in enumerate(net.images)
    ]
    rays = np.bincount(net.point, minlength=len(net.points))
    out["network"] = {
        "images": len(net.images),
        "points": len(net.points),
        "observations": 2 * int(adj.used.sum()),
        "redundancy": adj.dof,
        "rays_per_point": float(rays.mean()),
        "datum": adj.datum,
        "unit": net.unit,
        "scale_bars": [
            {"start": net.points[a], "end": net.points[b], "length": 700.0, "u": 0.01, "residual": 0.004}
            for a, b in zip(net.bars.start, net.bars.end, strict=True)
        ],
    }
    return out


def one_camera(rng: np.random.Generator, adj: Adjustment, k: int, model: CameraModel, out: dict[str, Any]) -> None:
    name = model.name
    names, covariance = adj.interior_covariance(k)
    u = np.sqrt(np.diag(covariance))
    r = covariance / np.outer(u, u)
    off = np.abs(r - np.eye(len(names)))
    for i, key in enumerate(names):
        j = int(np.argmax(off[i]))
        p = None if key in ("c", "xp", "yp") else float(np.exp(-0.5 * (model[key] / u[i]) ** 2))
        record = {"camera": name, "name": key, "value": model[key], "u": float(u[i]), "unit": model.units[NAMES.index(key)], "p_zero": p}
        out["parameters"].append(record | {"strongest": {"with": names[j], "r": float(r[i, j])}})
    fx, fy = model.c_px
    out["vision"][name] = {"fx": fx * (1 + model["b1"]), "fy": fy, "skew": fx * model["b2"], "cx": model["xp"], "cy": model["yp"]}
    out["vision"][name] |= {"u_fx": 0.21, "u_fy": 0.2, "u_skew": 0.01, "u_cx": 0.13, "u_cy": 0.12}
    out["correlations"][name] = {"names": names, "matrix": r}
    mine = adj.used & (adj.network.camera_of[adj.network.image] == k)
    rms = np.sqrt(np.mean(adj.residual_px[mine] ** 2, axis=0))
    pitch = model.sensor.pitch_x_um
    n = int(mine.sum())
    out["residuals"][name] = {
        "n": n,
        "rms_x_px": float(rms[0]),
        "rms_y_px": float(rms[1]),
        "rms_x_um": None if pitch is None else float(rms[0] * pitch),
        "rms_y_um": None if pitch is None else float(rms[1] * pitch),
        "dof_x": 0.9 * n,
        "dof_y": 0.88 * n,
    }
    out["f_test"][name] = {
        "ratio_px2": 1.31,
        "p_px": 0.0002,
        "ratio_um2": None if pitch is None else 1.31,
        "p_um": None if pitch is None else 0.0002,
        "dof_x": 0.9 * n,
        "dof_y": 0.88 * n,
        "critical_95": 1.12,
        "side": "x",
        "text": f"In px², x has 1.31 times the variance of y (F with {0.9 * n:.0f} and {0.88 * n:.0f} degrees of freedom, p = 0.0002).",
    }
    out["variance_components"][name] = {
        "sigma_x_px": 0.041,
        "u_sigma_x_px": 0.001,
        "sigma_y_px": 0.038,
        "u_sigma_y_px": 0.001,
        "iterations": 3,
    }
    unit = model.sensor.unit
    mx = model.sensor.per_px[0]
    radius = np.linspace(0, 800 * mx, 41)
    radial = radius * (model["k1"] * radius**2 + model["k2"] * radius**4 + model["k3"] * radius**6)
    slope = radial[30] / radius[30]
    out["curves"][name] = {
        "unit": unit,
        "radius": radius,
        "radial": radial,
        "u_radial": 0.002 * np.abs(radial) + 0.01 * mx * (radius / radius[-1]) ** 3,
        "balanced": radial - slope * radius,
        "u_balanced": 0.02 * mx * (radius / radius[-1]) ** 3,
        "balanced_c": model["c"] * (1 + slope),
        "tangential": np.hypot(model["p1"], model["p2"]) * radius**2,
        "u_tangential": 0.005 * mx * (radius / radius[-1]) ** 2,
    }
    x, y = np.linspace(0, SIZE[0] - 1, 21), np.linspace(0, SIZE[1] - 1, 17)
    r2 = ((x[None] - 640) / 640) ** 2 + ((y[:, None] - 512) / 512) ** 2
    out["projection"][name] = {"x_px": x, "y_px": y, "u_px": 0.008 + 0.02 * r2, "u_raw_px": 0.1 + 0.02 * r2}
    out["residual_grid"][name] = {
        "x_px": x[::2],
        "y_px": y[::2],
        "dx_px": 0.01 * rng.normal(size=(9, 11)),
        "dy_px": 0.01 * rng.normal(size=(9, 11)),
        "u_px": np.full((9, 11), 0.006),
        "n": np.full((9, 11), 20),
        "rms_without_px": 0.05,
        "rms_with_px": 0.04,
    }
