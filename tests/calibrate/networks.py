"""Simulated industrial networks, and Brown's camera model written a second time: plain NumPy, without the package's projection.

`image_of` projects (both directions of the distortion); `simulate` lays out a test field, places cameras round it, measures with noise and
plants gross errors; `disturbed` gives rough start values for an adjustment.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pixmetry.calibrate.bundle.model import NAMES, CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Network, ScaleBars, State

SENSOR = Sensor(2048, 1536, 3.45, 3.45)
LENS = {"c": 8.5, "b1": 2e-4, "b2": -1.5e-4, "p1": 3e-5, "p2": -4e-5, "k1": 1.2e-3, "k2": -1.5e-5, "k3": 2e-7}  # mm, image to object
SIZE_MM = np.array([1000.0, 800.0, 400.0])


@dataclass(frozen=True)
class Simulated:
    """A network, the truth behind it, and which of its image coordinates hold a planted gross error."""

    network: Network
    truth: State
    gross: np.ndarray


def _polynomial(a, b, p1, p2, k):
    """Radial and decentring distortion at (a, b), without affinity."""
    r2 = a**2 + b**2
    radial = sum(value * r2 ** (n + 1) for n, value in enumerate(k))
    return a + a * radial + p1 * (r2 + 2 * a**2) + 2 * p2 * a * b, b + b * radial + p2 * (r2 + 2 * b**2) + 2 * p1 * a * b


def _solved(function, a0, b0, length):
    """(a, b) with function(a, b) = (a0, b0): Newton's method with difference quotients; NaN where it does not converge or has folded."""
    a, b, h = np.array(a0, float), np.array(b0, float), 1e-6 * length
    with np.errstate(all="ignore"):
        for _ in range(25):
            fa, fb = function(a, b)
            ax, bx = ((p - q) / (2 * h) for p, q in zip(function(a + h, b), function(a - h, b), strict=True))
            ay, by = ((p - q) / (2 * h) for p, q in zip(function(a, b + h), function(a, b - h), strict=True))
            det = ax * by - ay * bx
            da, db = (by * (fa - a0) - ay * (fb - b0)) / det, (ax * (fb - b0) - bx * (fa - a0)) / det
            a, b = a - da, b - db
            if np.nanmax(np.hypot(da, db), initial=0.0) < 1e-14 * length:
                break
        fa, fb = function(a, b)
        good = (np.hypot(fa - a0, fb - b0) < 1e-11 * length) & (det > 0.1)
    return np.where(good, a, np.nan), np.where(good, b, np.nan)


def distorted(interior, sensor: Sensor, direction: str, u, v):
    """Image, px, of directions u = X/Z, v = Y/Z."""
    c, xp, yp, b1, b2, p1, p2, *k = interior
    mx, my = (1.0, 1.0) if sensor.pitch_x_um is None else (sensor.pitch_x_um * 1e-3, sensor.pitch_y_um * 1e-3)
    if direction == "object_to_image":
        a, b = _polynomial(u, v, p1, p2, k)
        return xp + c * ((1 + b1) * a + b2 * b) / mx, yp + c * b / my

    def corrected(a, b):
        ideal_a, ideal_b = _polynomial(a, b, p1, p2, k)
        return ideal_a + b1 * a + b2 * b, ideal_b

    x, y = np.full(np.shape(u), np.nan), np.full(np.shape(u), np.nan)
    near = np.hypot(c * u, c * v) < 1.5 * np.hypot(mx * sensor.cols / 2, my * sensor.rows / 2)  # what else there is lies outside the frame
    a, b = _solved(corrected, c * u[near], c * v[near], c)
    x[near], y[near] = xp + a / mx, yp + b / my
    return x, y


def image_of(model: CameraModel, interior, rotation, position, xyz, *, x_scale=0.0, x_shift_px=0.0, origin_px=0.0):
    """Image, px, of object points, shape (n, 3), and their depth before the camera."""
    camera = (np.asarray(xyz) - position) @ np.asarray(rotation).T
    with np.errstate(all="ignore"):
        u, v = camera[:, 0] / camera[:, 2], camera[:, 1] / camera[:, 2]
    x, y = distorted(interior, model.sensor, model.direction, u, v)
    return origin_px + (1 + x_scale) * (x - origin_px) + x_shift_px, y, camera[:, 2]


def predicted(network: Network, state: State):
    """Image coordinates, shape (n, 2), of every observation."""
    out = np.full((len(network), 2), np.nan)
    for i, camera in enumerate(network.camera_of):
        rows = network.image == i
        out[rows, 0], out[rows, 1], _ = image_of(
            network.cameras[camera], state.interior[camera], state.rotation[i], state.position[i], state.xyz[network.point[rows]],
            x_scale=state.x_scale[i], x_shift_px=state.x_shift_px[i], origin_px=network.scale_origin_px,
        )  # fmt: skip
    return out


def looking(position, target, roll_rad: float) -> np.ndarray:
    """Rotation of a camera that looks from one place to another; without roll its rows lie level (z of the object is up)."""
    z = np.subtract(target, position)
    z = z / np.linalg.norm(z)
    up = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(z, up)
    x = x / np.linalg.norm(x)
    level = np.stack([x, np.cross(z, x), z])
    return Rotation.from_euler("z", roll_rad).as_matrix() @ level


def object_points(rng, field: str, points: int, size=SIZE_MM) -> tuple[np.ndarray, np.ndarray]:
    """Points, shape (points, 3), and the normals of their targets: volume, plane (a grid), panels, or all round a body."""
    up = np.tile([0.0, 0.0, 1.0], (points, 1))
    if field == "volume":
        return (rng.random((points, 3)) - 0.5) * size, up
    if field == "plane":
        cols = max(2, int(np.ceil(np.sqrt(points * size[0] / size[1]))))
        grid = np.stack(np.divmod(np.arange(points), cols), axis=1)[:, ::-1]
        step = size[0] / (cols - 1)
        return np.column_stack([grid * step - grid.max(axis=0) * step / 2, np.zeros(points)]), up
    if field == "panels":  # three panels like a shallow screen, the outer ones turned towards the middle
        where = rng.integers(0, 3, points)
        x, y = (rng.random(points) - 0.5) * size[0] / 3, (rng.random(points) - 0.5) * size[1]
        angle = np.deg2rad(35.0) * (where - 1)
        base = (where - 1) * size[0] / 3
        z = np.abs(where - 1) * size[2] * 0.25 + np.sin(np.abs(angle)) * x * np.sign(where - 1.0)
        return np.column_stack([base + x * np.cos(angle), y, z]), np.column_stack([-np.sin(angle), 0 * x, np.cos(angle)])
    if field == "around":  # a body with targets on all sides
        direction = rng.standard_normal((points, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return direction * size / 2 * (0.85 + 0.15 * rng.random((points, 1))), direction
    raise ValueError(field)


def _stand(rng, look: str, image: int, images: int, oblique_deg: float) -> np.ndarray:
    """Unit vector from the field to a camera."""
    turn = 2 * np.pi * (image + 0.3 * rng.random()) / images
    if look == "convergent":
        tilt = np.deg2rad(oblique_deg * (0.3 + 0.7 * rng.random()))
        turn = 2 * np.pi * rng.random() if images > 8 else turn
    elif look == "ring":  # all round a body, three heights
        tilt = np.deg2rad(90 - (10, 40, -10)[image % 3] - 5 * rng.standard_normal())
    elif look == "frontal":
        tilt = np.deg2rad(0.3 * rng.random())
    else:
        raise ValueError(look)
    return np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])


def _lens(rng, sensor: Sensor, direction: str, interior: Mapping[str, float] | None) -> np.ndarray:
    mx = 1.0 if sensor.pitch_x_um is None else sensor.pitch_x_um * 1e-3
    scale = LENS["c"] / (mx * sensor.cols / (2048 * 0.00345) * LENS["c"])  # the same lens on a frame of another size
    values = dict(LENS)
    for name, power in (("c", -1), ("p1", 1), ("p2", 1), ("k1", 2), ("k2", 4), ("k3", 6)):
        values[name] *= scale**power
    if direction == "object_to_image":
        for name, power in (("p1", 1), ("p2", 1), ("k1", 2), ("k2", 4), ("k3", 6)):
            values[name] *= -(values["c"] ** power)
    row = CameraModel.of(sensor, direction, **values).values
    row[0] *= 1 + 0.02 * rng.standard_normal()
    row[1:3] += rng.uniform(-0.006, 0.006, 2) * sensor.cols
    row[3:10] *= rng.uniform(0.5, 1.5, 7)
    for name, value in (interior or {}).items():
        row[NAMES.index(name)] = value
    return row


def _seen(rng, model, row, rotation, stand, target, xyz, normals, share, facing):
    """Distance at which the asked share of the points lies in the frame, and which points those are."""
    cols, rows = model.sensor.cols, model.sensor.rows

    def inside(distance):
        position = target + distance * stand
        x, y, depth = image_of(model, row, rotation, position, xyz)
        return (depth > 0.25 * distance) & (x > 4) & (x < cols - 5) & (y > 4) & (y < rows - 5)

    size = np.ptp(xyz, axis=0).max()
    mx = 1.0 if model.sensor.pitch_x_um is None else model.sensor.pitch_x_um * 1e-3
    near, far = 0.05 * size * row[0] / (mx * cols), 12 * size * row[0] / (mx * cols)
    enough = len(xyz) if share >= 1 or facing else share * len(xyz)
    for _ in range(18):
        middle = np.sqrt(near * far)
        near, far = (near, middle) if np.count_nonzero(inside(middle)) >= enough else (middle, far)
    distance = far * rng.uniform(1.0, 1.02 if share < 1 and not facing else 1.2)
    good = inside(distance)
    if facing:
        ray = target + distance * stand - xyz
        good &= np.einsum("ij,ij->i", ray, normals) > np.cos(np.deg2rad(65.0)) * np.linalg.norm(ray, axis=1)
    return distance, good


def simulate(
    rng: np.random.Generator, *, images: int = 50, points: int = 100, visibility: float = 1.0, noise_px: float = 0.04,
    field: str = "volume", direction: str = "image_to_object", rolled: bool = True, bars: int = 2, cameras: int = 1,
    gross_share: float = 0.0, gross_px: float = 5.0, known: str = "free", per_image: tuple[str, ...] = (),
    interior: Mapping[str, float] | None = None,
    sensor: Sensor = SENSOR, look: str | None = None, oblique_deg: float = 50.0, c_known: bool = True, size=SIZE_MM,
    swapped_share: float = 0.0, x_scale_u: float = 1e-4, x_shift_u_px: float = 0.1,
) -> Simulated:  # fmt: skip
    """A measured network.

    Parameters
    ----------
    field : {"volume", "plane", "panels", "around"}
        ``"around"``: targets on a body; each image sees those that face it, thinned to ``visibility`` of them.
    visibility : float
        Share of the points that an image sees. Below 1 it stands so close to one part of the field after the other that no more fit into
        its frame.
    known : {"free", "fixed", "rough", "partly"}
        Coordinates beforehand: none, the truth, free with coordinates good to 1 % of the field, or the truth of a third of the points.
    gross_share, gross_px
        Share of the observations (image points) that lie wrong by so much, in any direction.
    swapped_share
        Share of the observations that bear another point's name (marked as gross too).
    interior : mapping, optional
        True values by name, for every camera, in place of the drawn ones.
    look : {"convergent", "ring", "frontal"}, optional
        Default: ring for ``"around"``, else convergent within a cone of ``oblique_deg``.
    c_known : bool
        Whether the cameras' start values hold the principal distance (to 3 %).
    """
    xyz, normals = object_points(rng, field, points, np.asarray(size, float))
    look = look or ("ring" if field == "around" else "convergent")
    interiors = np.stack([_lens(rng, sensor, direction, interior) for _ in range(cameras)])
    models = []
    for k in range(cameras):
        start = {"c": interiors[k, 0] * (1 + rng.uniform(-0.03, 0.03))} if c_known else {}
        models.append(CameraModel.of(sensor, direction, name=f"camera {k + 1}" if cameras > 1 else "camera", **start))
    camera_of = np.arange(images) % cameras
    x_scale, x_shift = np.zeros(images), np.zeros(images)
    for k in range(cameras):
        mine = camera_of == k
        if "x_scale" in per_image:
            drawn = x_scale_u * rng.standard_normal(mine.sum())
            x_scale[mine] = drawn - drawn.mean()
        if "x_shift" in per_image:
            drawn = x_shift_u_px * rng.standard_normal(mine.sum())
            x_shift[mine] = drawn - drawn.mean()
    rotation, position = np.empty((images, 3, 3)), np.empty((images, 3))
    along = np.argsort(xyz[:, np.argmax(np.ptp(xyz, axis=0))])  # parts of the field that are looked at follow one another along it
    lists: list[tuple[np.ndarray, ...]] = []
    for i in range(images):
        k = camera_of[i]
        stand = _stand(rng, look, i, images, oblique_deg)
        roll = (i // cameras % 4) * np.pi / 2 + rng.uniform(-0.1, 0.1) if rolled else rng.uniform(-0.02, 0.02)
        part = visibility < 1 and field != "around"
        target = xyz.mean(axis=0) + 0.02 * np.asarray(size) * rng.standard_normal(3)
        if part:
            target = 0.85 * xyz[along[(i * 7919 % images) * points // images]]
        turned = looking(target + stand, target, roll)
        distance, seen = _seen(rng, models[k], interiors[k], turned, stand, target, xyz, normals, visibility, field == "around")
        rotation[i], position[i] = turned, target + distance * stand
        index = np.flatnonzero(seen)
        if field == "around" and visibility < 1:
            index = rng.permutation(index)[: max(6, round(visibility * len(index)))]
            index.sort()
        x, y, _ = image_of(models[k], interiors[k], turned, position[i], xyz[index], x_scale=x_scale[i], x_shift_px=x_shift[i])
        lists.append((np.full(len(index), i), index, x, y))
    image, point, x, y = (np.concatenate(part) for part in zip(*lists, strict=True))
    x, y = x + noise_px * rng.standard_normal(len(x)), y + noise_px * rng.standard_normal(len(y))
    gross = np.zeros(len(x), bool)
    hit = rng.permutation(len(x))[: round(gross_share * len(x))]
    angle = rng.uniform(0, 2 * np.pi, len(hit))
    x[hit], y[hit], gross[hit] = x[hit] + gross_px * np.cos(angle), y[hit] + gross_px * np.sin(angle), True
    _swap(rng, image, x, y, gross, swapped_share)
    known_xyz, u_xyz = _beforehand(rng, xyz, known)
    network = Network(
        cameras=tuple(models), images=tuple(f"IMG_{i + 1:04d}" for i in range(images)), camera_of=camera_of,
        points=tuple(f"T{j + 1}" for j in range(points)), x_px=x, y_px=y, image=image, point=point,
        covariance_px2=np.tile([noise_px**2, 0.0, noise_px**2], (len(x), 1)), xyz=known_xyz, u_xyz=u_xyz,
        bars=_bars(rng, xyz, image, point, bars), per_image=per_image, covariance_known=True,
    )  # fmt: skip
    return Simulated(network, State(interiors, rotation, position, x_scale, x_shift, xyz), gross)


def _swap(rng, image, x, y, gross, share):
    """Exchange the coordinates of pairs of points within images: as if they were mislabelled."""
    for _ in range(round(share * len(x) / 2)):
        rows = np.flatnonzero(image == rng.choice(image))
        if len(rows) > 1:
            pair = rng.choice(rows, 2, replace=False)
            x[pair], y[pair], gross[pair] = x[pair[::-1]], y[pair[::-1]], True


def _beforehand(rng, xyz, known):
    points = len(xyz)
    if known == "free":
        return np.full((points, 3), np.nan), np.full((points, 3), np.inf)
    if known == "fixed":
        return xyz.copy(), np.zeros((points, 3))
    if known == "rough":
        return xyz + 0.01 * np.ptp(xyz, axis=0).max() * rng.standard_normal(xyz.shape), np.full((points, 3), np.inf)
    if known == "partly":
        control = rng.permutation(points) < max(5, points // 3)
        return np.where(control[:, None], xyz, np.nan), np.where(control[:, None], 0.0, np.full((points, 3), np.inf))
    raise ValueError(known)


def _bars(rng, xyz, image, point, bars, u_mm=0.01) -> ScaleBars:
    """Bars between points that three images or more see, at least a third of the field long."""
    often = np.flatnonzero(np.bincount(point, minlength=len(xyz)) >= 3)
    if bars == 0 or len(often) < 2:
        return ScaleBars.none()
    pairs = rng.choice(often, (200 * bars, 2))
    length = np.linalg.norm(xyz[pairs[:, 0]] - xyz[pairs[:, 1]], axis=1)
    pairs = pairs[np.argsort(length < 0.33 * np.ptp(xyz, axis=0).max(), kind="stable")[:bars]]
    length = np.linalg.norm(xyz[pairs[:, 0]] - xyz[pairs[:, 1]], axis=1)
    return ScaleBars(pairs[:, 0], pairs[:, 1], length + u_mm * rng.standard_normal(bars), np.full(bars, u_mm))


def disturbed(rng, simulated: Simulated, share: float = 0.01) -> State:
    """Start values for an adjustment: the truth, wrong by ``share`` of its size (angles in rad); no distortion."""
    truth, images = simulated.truth, len(simulated.truth.position)
    interior = truth.interior.copy()
    interior[:, 0] *= 1 + share * rng.uniform(-1, 1, len(interior))
    interior[:, 1:3] = [camera.sensor.centre for camera in simulated.network.cameras]
    interior[:, 3:] = 0.0
    size = np.ptp(truth.xyz, axis=0).max()
    fixed = (simulated.network.u_xyz == 0).all(axis=1)[:, None]
    return replace(
        truth,
        interior=interior,
        rotation=Rotation.from_rotvec(share * rng.standard_normal((images, 3))).as_matrix() @ truth.rotation,
        position=truth.position + share * size * rng.standard_normal((images, 3)),
        x_scale=np.zeros(images),
        x_shift_px=np.zeros(images),
        xyz=np.where(fixed, truth.xyz, truth.xyz + share * size * rng.standard_normal(truth.xyz.shape)),
    )
