"""Simulated rigs: cameras that stand still against each other before a test field, measured with noise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calibrate.networks import LENS, SENSOR, image_of, looking
from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Network, ScaleBars, State


@dataclass(frozen=True)
class SimulatedRig:
    """A network of a rig, the truth behind it, and the relative poses against the first camera."""

    network: Network
    truth: State
    rotation: np.ndarray  # (cameras, 3, 3)
    place: np.ndarray  # (cameras, 3)


def simulated_rig(
    rng: np.random.Generator, *, cameras: int = 2, instants: int = 10, noise_px: float = 0.05, known: str = "fixed",
    missing: tuple[tuple[int, int], ...] = (), free: tuple[str, ...] = ("c", "xp", "yp", "k1", "k2"), bars: int = 0,
    direction: str = "image_to_object", moved_deg: float = 0.0, sensor: Sensor = SENSOR, flat: bool = True,
) -> SimulatedRig:  # fmt: skip
    """Cameras 120 mm apart in a row, turned against each other, that look at a field of 9 × 7 points, 60 mm apart.

    Parameters
    ----------
    known : {"fixed", "free"}
        Whether the coordinates of the field are known.
    missing : tuple of (int, int)
        Camera and instant of images that were not taken.
    moved_deg : float
        Standard deviation of turns of the second camera between instants: then the rig is none.
    flat : bool
        Whether the field is a plane.
    """
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0)), axis=-1).reshape(-1, 2) - (4, 3)
    depth = np.zeros(len(grid)) if flat else rng.uniform(-60, 60, len(grid))
    xyz = np.column_stack([60 * grid, depth])
    values = dict(LENS, k3=0.0, p1=0.0, p2=0.0, b1=0.0, b2=0.0)
    if direction == "object_to_image":
        values |= {"k1": -0.08, "k2": 0.02}
    models = [CameraModel.of(sensor, direction, free=free, name=f"cam{k}", c=values["c"] * 1.01) for k in range(cameras)]
    interior = np.stack([CameraModel.of(sensor, direction, **values).values for _ in range(cameras)])
    interior[:, 0] *= 1 + 0.01 * rng.standard_normal(cameras)
    interior[:, 1:3] += 5 * rng.standard_normal((cameras, 2))
    turn = Rotation.from_rotvec(np.column_stack([0.03 * rng.standard_normal((cameras, 1)), -0.1 * np.arange(cameras), np.zeros(cameras)]))
    relative, place = turn.as_matrix(), np.column_stack([120.0 * np.arange(cameras), 10 * rng.standard_normal((cameras, 2))])
    relative[0], place[0] = np.eye(3), 0.0
    images, camera_of, instant, poses, lists = [], [], [], [], []
    for t in range(instants):
        tilt, round_ = np.deg2rad(rng.uniform(15, 40)), 2 * np.pi * (t + rng.random()) / instants
        stand = np.array([np.sin(tilt) * np.cos(round_), np.sin(tilt) * np.sin(round_), -np.cos(tilt)])
        base = looking(stand, np.zeros(3), (t % 4) * np.pi / 2)
        middle = place.mean(axis=0)
        at = 1100 * rng.uniform(0.95, 1.15) * stand - base.T @ middle
        for k in range(cameras):
            if (k, t) in missing:
                continue
            own = relative[k] if k != 1 else Rotation.from_rotvec(np.deg2rad(moved_deg) * rng.standard_normal(3)).as_matrix() @ relative[k]
            rotation, position = own @ base, at + base.T @ place[k]
            x, y, depth = image_of(models[k], interior[k], rotation, position, xyz)
            seen = np.flatnonzero((depth > 0) & (x > 2) & (x < sensor.cols - 3) & (y > 2) & (y < sensor.rows - 3))
            lists.append((np.full(len(seen), len(images)), seen, x[seen], y[seen]))
            images.append(f"cam{k}-{t:02d}")
            camera_of.append(k)
            instant.append(t)
            poses.append((rotation, position))
    image, point, x, y = (np.concatenate(part) for part in zip(*lists, strict=True))
    x, y = x + noise_px * rng.standard_normal(len(x)), y + noise_px * rng.standard_normal(len(y))
    n = len(xyz)
    start, end = np.arange(bars), n - 1 - np.arange(bars)
    length = np.linalg.norm(xyz[start] - xyz[end], axis=1) + 0.01 * rng.standard_normal(bars)
    network = Network(
        cameras=tuple(models), images=tuple(images), camera_of=np.array(camera_of), points=tuple(f"P{j}" for j in range(n)),
        x_px=x, y_px=y, image=image, point=point, covariance_px2=np.tile([noise_px**2, 0.0, noise_px**2], (len(x), 1)),
        xyz=xyz if known == "fixed" else np.full((n, 3), np.nan), u_xyz=np.full((n, 3), 0.0 if known == "fixed" else np.inf),
        bars=ScaleBars(start, end, length, np.full(bars, 0.01)), covariance_known=True, instant=np.array(instant),
    )  # fmt: skip
    rotation, position = (np.stack(part) for part in zip(*poses, strict=True))
    zero = np.zeros(len(images))
    return SimulatedRig(network, State(interior, rotation, position, zero, zero, xyz), relative, place)


def relative_error(found, simulated: SimulatedRig) -> np.ndarray:
    """Found less true relative poses, shape (6 n,), in the order of their covariance."""
    out = []
    for k, name in enumerate(found.cameras):
        true = int(name.removeprefix("cam"))
        turn = Rotation.from_matrix(found.rotation[k] @ simulated.rotation[true].T).as_rotvec()
        out.append(np.concatenate([turn, found.place[k] - simulated.place[true]]))
    return np.concatenate(out)


def written(folder: Path, sim: SimulatedRig, rig: str) -> Path:
    """The project of a rig with its tables; instants by a column or by a line of the project."""
    net = sim.network
    rows = zip(net.image, net.point, net.x_px, net.y_px, strict=True)
    lines = [f"{net.images[i]},{net.points[j]},{x:.4f},{y:.4f}" for i, j, x, y in rows]
    (folder / "obs.csv").write_text("image,point,x_px,y_px\n" + "\n".join(lines))
    points = [f"{name},{a},{b},{c}" for name, (a, b, c) in zip(net.points, net.xyz, strict=True)]
    (folder / "points.csv").write_text("point,X,Y,Z\n" + "\n".join(points))
    column = "instant" in rig
    rows = [f"{name},cam{k}" + (f",{t}" if column else "") for name, k, t in zip(net.images, net.camera_of, net.instant, strict=True)]
    (folder / "images.csv").write_text("image,camera" + (",instant" if column else "") + "\n" + "\n".join(rows))
    cameras = "".join(f"- {{name: cam{k}, cols: 2048, rows: 1536, pitch_um: 3.45, free: 'c, xp, yp, k1, k2'}}\n" for k in range(2))
    text = f"schema: pixmetry/calibration/1\ncameras:\n{cameras}observations: {{table: obs.csv, u_px: 0.05}}\nimages: images.csv\n"
    text += "points: {table: points.csv, known: fixed}\noptions: {folds: 0}\n" + ("" if column else rig)
    (folder / "project.yaml").write_text(text)
    return folder / "project.yaml"
