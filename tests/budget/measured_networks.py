"""Networks of a camera's own images, adjusted by `pixmetry.calibrate`: a calibration field first, then an object, interior parameters held.

Nothing here uses what the budget computes, except the noise of an image point. Points are projected by a pinhole, displaced by the camera's
maps (`Camera.true_positions`) in the state of the calibration or of the measurement, and get noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

import pixmetry
from calibrate.networks import looking
from pixmetry.budget.setting import Setting
from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Network, Poses, ScaleBars
from pixmetry.camera.camera import Camera

FREE = {
    "principal_point_and_scale": ("c", "xp", "yp", "b1"),
    "lens": ("c", "xp", "yp", "b1", "b2", "p1", "p2", "k1", "k2", "k3"),
    "five_terms": ("c", "xp", "yp", "b1", "b2", "p1", "p2", "k1", "k2", "k3", "k4", "k5"),
    "residual_grid": ("c", "xp", "yp", "b1", "b2", "p1", "p2", "k1", "k2", "k3"),
}
GOLDEN = np.pi * (3 - np.sqrt(5))  # turns by this angle stand evenly all round, whatever their number
QUICK = {"snoop": False, "folds": 0, "variance_components": False, "loss": "none", "eccentricity": False}


@dataclass(frozen=True)
class Shots:
    """Where images stand, and points with which of them each image sees."""

    rotation: np.ndarray
    position: np.ndarray
    points: np.ndarray
    seen: np.ndarray


@dataclass(frozen=True)
class Measured:
    """A camera in a setting, and the standard deviation of the noise of an image point in x and y."""

    setting: Setting
    noise_px: tuple[float, float]

    @property
    def sensor(self) -> Sensor:
        camera = self.setting.described
        rows, cols = camera.frame_shape
        return Sensor(cols, rows, *camera.pitch_um)

    @property
    def c_mm(self) -> float:
        return self.setting.c_px * 1e-3 * self.setting.described.pitch_um[0]

    def pinhole(self, shots: Shots) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places on the sensor, px, shape (m, n) each, and which are in the frame."""
        at = np.einsum("mij,mnj->mni", shots.rotation, shots.points[None] - shots.position[:, None])
        sensor = self.sensor
        (mx, my), (x0, y0) = sensor.per_px, sensor.centre
        x, y = x0 + self.c_mm / mx * at[..., 0] / at[..., 2], y0 + self.c_mm / my * at[..., 1] / at[..., 2]
        inside = (np.abs(x - x0) < 0.47 * sensor.cols) & (np.abs(y - y0) < 0.47 * sensor.rows) & (at[..., 2] > 0)
        return x, y, inside

    def network(self, shots: Shots, camera: Camera, model: CameraModel, noise: np.ndarray) -> Network:
        """What is measured; ``noise`` of shape (2, m, n) in standard deviations. Poses are told, as start values."""
        x, y, inside = self.pinhole(shots)
        image, point = np.nonzero(inside & shots.seen)
        seen = np.array(camera.true_positions(x[image, point], y[image, point], temperature_c=camera.temperature_c))
        start, end = (np.array(camera.layout([v], [v])) for v in (0.0, 1.0))
        measured = (seen - start) / (end - start) + noise[:, image, point] * np.array(self.noise_px)[:, None]
        variance = np.square(self.noise_px)
        n = len(shots.points)
        return Network(
            cameras=(model,), images=tuple(f"I{i}" for i in range(len(shots.position))), camera_of=np.zeros(len(shots.position), int),
            points=tuple(f"P{j}" for j in range(n)), x_px=measured[0], y_px=measured[1], image=image, point=point,
            covariance_px2=np.tile([variance[0], 0.0, variance[1]], (len(image), 1)), xyz=np.full((n, 3), np.nan),
            u_xyz=np.full((n, 3), np.inf),
            bars=ScaleBars.none(), covariance_known=True, poses=Poses(shots.rotation, shots.position),
        )  # fmt: skip

    def calibrated(self, model: str, shots: Shots, rng: np.random.Generator) -> pixmetry.calibrate.Calibration | None:
        """A calibration from these images by `pixmetry.calibrate`, in the state of the calibration."""
        nominal = CameraModel.of(self.sensor, free=FREE[model], c=self.c_mm)
        noise = rng.standard_normal((2, len(shots.position), len(shots.points)))
        network = self.network(shots, self.setting.calibrated, nominal, noise)
        return pixmetry.calibrate(network, options={**QUICK, "residual_grid": model == "residual_grid"})

    def points(self, shots: Shots, calibration, noise: np.ndarray) -> np.ndarray:
        """Points found less the true ones, after the best similarity, shape (n, 3); interior parameters held."""
        model = CameraModel.of(self.sensor, c=self.c_mm) if calibration is None else calibration.adjustment.camera(0)
        network = self.network(shots, self.setting.camera, model, noise)
        grid = None if calibration is None else calibration.grids.get(model.name)
        if grid is not None:
            dx, dy = grid.at(network.x_px, network.y_px)
            network = replace(network, x_px=network.x_px - dx, y_px=network.y_px - dy)
        found = pixmetry.calibrate(network, free="none", options=QUICK).adjustment.state.xyz
        good = np.isfinite(found).all(axis=1)
        left = np.full_like(found, np.nan)
        left[good] = similar(found[good], shots.points[good]) - shots.points[good]
        return left


def similar(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """The found points, shifted, turned and scaled onto the true ones."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    turn, _ = Rotation.align_vectors(b, a)
    a = turn.apply(a)
    return a * np.sum(a * b) / np.sum(a * a) + true.mean(axis=0)


def field_of_targets(rng: np.random.Generator, half_mm: np.ndarray, points: int, flat: bool) -> np.ndarray:
    """Points all over a field, in its own frame: as on a test field, one at random in each cell of a lattice."""
    rows = max(1, round(np.sqrt(points * half_mm[1] / half_mm[0])))
    row, place = np.arange(points) % rows, np.arange(points) // rows
    in_row = np.bincount(row)[row]
    x, y = (place + rng.uniform(size=points)) / in_row, (row + rng.uniform(size=points)) / rows
    at = np.stack([2 * x - 1, 2 * y - 1, rng.uniform(-1, 1, points)], -1)
    return at * [*half_mm, 0.0 if flat else 0.3 * half_mm.max()]


def calibration_shots(
    rng: np.random.Generator, images: int, points: int, distance_mm: float, half_mm: np.ndarray, flat: bool, oblique_deg=(25, 45)
) -> Shots:
    """Oblique images all round a field, rolled by quarters."""
    position = []
    for i in range(images):
        turn, tilt = GOLDEN * i + rng.uniform(-0.3, 0.3), np.radians(rng.uniform(*oblique_deg))
        position.append(-distance_mm * np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]))
    rotation = np.stack([looking(p, 0.02 * half_mm.max() * rng.standard_normal(3), i * np.pi / 2) for i, p in enumerate(position)])
    return Shots(rotation, np.array(position), field_of_targets(rng, half_mm, points, flat), np.ones((images, points), bool))


def measuring_shots(
    rng: np.random.Generator, rays: int, base_to_height: float, arrangement: str, points: int, distance_mm: float, half_mm: np.ndarray
) -> Shots:
    """Images towards an object, at stations that are off their places by a few percent."""
    half = 0.5 * base_to_height
    if arrangement == "row" or rays == 2:
        at = np.stack([np.linspace(-half, half, rays), np.zeros(rays)])
    else:
        angle = 2 * np.pi * np.arange(rays) / rays
        at = half * np.stack([np.cos(angle), np.sin(angle)])
    at = at * rng.uniform(0.97, 1.03, at.shape)
    position = distance_mm * np.stack([at[0], at[1], -rng.uniform(0.97, 1.03, rays)], -1)
    level = [Rotation.from_matrix(_level(p)).as_matrix() for p in position]
    shape = rng.uniform(-1, 1, (points, 3)) * [*half_mm, 0.25 * half_mm.max()]
    return Shots(np.stack(level), position, shape, np.ones((rays, points), bool))


def _level(position: np.ndarray) -> np.ndarray:
    """Rotation of a camera that looks at the origin, its rows along X."""
    z = -position / np.linalg.norm(position)
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
