"""Fisheye projections, rational radial terms and thin prisms: against OpenCV, against difference quotients, and calibrated from pictures of
boards that OpenCV draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibrate.distances import Pooled
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.model import CODES, NAMES, POWERS, PROJECTIONS, CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Network, State
from pixmetry.calibrate.bundle.options import Options
from pixmetry.calibrate.bundle.solve import calibrate_network
from pixmetry.core.errors import ParameterError

cv2 = pytest.importorskip("cv2")
SENSOR = Sensor(1280, 960)
LENS = {
    "c": 600, "xp": 650, "yp": 470, "b1": 1e-3, "b2": -2e-3, "p1": 1e-3, "p2": -5e-4, "k1": 0.02, "k2": -0.03, "k3": 0.01, "k4": 1e-3,
    "k5": -2e-3, "d1": 0.01, "d2": 0.02, "d3": -5e-3, "s1": 1e-3, "s2": -2e-3, "s3": 1.5e-3, "s4": 7e-4,
}  # fmt: skip
RATE = 1e-6
IDEAL = {  # distances from the principal point for c = 1, by the textbook
    "perspective": np.tan,
    "equidistant": lambda t: t,
    "equisolid": lambda t: 2 * np.sin(t / 2),
    "stereographic": lambda t: 2 * np.tan(t / 2),
    "orthographic": np.sin,
}


def _lens(direction: str, projection: str) -> CameraModel:
    unit = 600.0 if direction == "image_to_object" else 1.0
    values = {name: value if name in ("c", "xp", "yp") else value * unit ** POWERS[NAMES.index(name)] for name, value in LENS.items()}
    return CameraModel.of(SENSOR, direction, projection=projection, **values)


@pytest.mark.parametrize("direction", CODES)
@pytest.mark.parametrize("projection", PROJECTIONS)
def test_derivatives_are_those_of_difference_quotients(projection, direction, rng):
    model, h = _lens(direction, projection), 1e-6
    u, v = rng.uniform(-0.8, 0.8, (2, 100))
    u[0] = v[0] = 2e-5
    _, _, by_direction, by_interior = model.projected(u, v)
    quotients = np.stack([np.subtract(model.project(u + a, v + b), model.project(u - a, v - b)).T / 2 / h for a, b in ((h, 0), (0, h))], -1)
    np.testing.assert_allclose(by_direction, quotients, atol=2e-6 * 600)
    for place, name in enumerate(NAMES):
        step = abs(model[name]) * 1e-5
        ahead, behind = (model.with_values(**{name: model[name] + s * step}).project(u, v) for s in (1, -1))
        quotient = np.subtract(ahead, behind).T / 2 / step
        np.testing.assert_allclose(by_interior[:, :, place], quotient, atol=1e-5 * np.abs(quotient).max(), err_msg=name)
    back = model.direction_of(*model.project(u, v))
    np.testing.assert_allclose(back, [u, v], atol=1e-12)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_ideal_lenses_draw_as_the_textbook_says(projection):
    angle = np.deg2rad(np.array([0.0, 1e-4, 0.01, 1, 30, 60, 80]))
    x, y = CameraModel.of(SENSOR, "object_to_image", projection=projection, c=500).project(0.6 * np.tan(angle), 0.8 * np.tan(angle))
    np.testing.assert_allclose(np.hypot(x - 639.5, y - 479.5), 500 * IDEAL[projection](angle), rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose((x - 639.5) * 0.8, (y - 479.5) * 0.6, atol=1e-10)


def test_the_equidistant_lens_is_opencvs_fisheye(rng):
    points = np.column_stack([rng.uniform(-3, 3, (200, 2)), np.ones(200)]) * rng.uniform(1, 3, (200, 1))
    K, D = np.array([[605, 0, 650], [0, 600, 470], [0, 0, 1.0]]), np.array([0.02, -0.03, 0.01, 0.004])
    theirs = cv2.fisheye.projectPoints(points[:, None], np.zeros((3, 1)), np.zeros((3, 1)), K, D)[0][:, 0]
    k = dict(zip(("k1", "k2", "k3", "k4"), D, strict=True))
    model = CameraModel.of(SENSOR, "object_to_image", projection="equidistant", c=600, xp=650, yp=470, b1=5 / 600, **k)
    np.testing.assert_allclose(np.stack(model.project(*(points[:, :2] / points[:, 2:]).T), 1), theirs, atol=1e-9)


def test_rational_and_prism_terms_are_opencvs(rng):
    points = np.column_stack([rng.uniform(-0.8, 0.8, (200, 2)), np.ones(200)]) * rng.uniform(1, 3, (200, 1))
    K = np.array([[605, 0, 650], [0, 600, 470], [0, 0, 1.0]])
    D = np.array([0.02, -0.03, 1e-3, -2e-3, 0.01, 0.05, 0.02, 0.01, 1e-3, -2e-3, 1.5e-3, 7e-4])
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)[0][:, 0]
    names = ("k1", "k2", "p2", "p1", "k3", "d1", "d2", "d3", "s1", "s2", "s3", "s4")
    lens = dict(zip(names, D, strict=True))
    model = CameraModel.of(SENSOR, "object_to_image", c=600, xp=650, yp=470, b1=5 / 600, **lens)
    np.testing.assert_allclose(np.stack(model.project(*(points[:, :2] / points[:, 2:]).T), 1), theirs, atol=1e-9)


def test_a_place_beyond_the_half_space_has_no_direction():
    model = CameraModel.of(SENSOR, "object_to_image", projection="equidistant", c=300)
    u, _ = model.direction_of(np.array([639.5 + 300 * 1.5, 639.5 + 300 * 1.6]), np.array([479.5, 479.5]))
    assert np.isfinite(u[0]) and np.isnan(u[1])
    with pytest.raises(ParameterError, match="no such projection"):
        CameraModel.of(SENSOR, projection="fisheye")


def _fisheye_network(rng, free, projection="equidistant", noise_px=0.05, c=0.0, images=12) -> tuple[Network, State]:
    """Boards up to 65° off the axis, drawn by OpenCV."""
    grid = np.stack(np.meshgrid(np.arange(10.0), np.arange(7.0)), -1).reshape(-1, 2)
    xyz = np.column_stack([40 * (grid - grid.mean(axis=0)), np.zeros(len(grid))])
    K, D = np.array([[402.0, 0, 645], [0, 400.0, 476], [0, 0, 1]]), np.array([0.03, -0.01, 0.004, -0.001])
    parts, poses = [], []
    for i in range(images):
        turn = Rotation.from_euler("zyx", [90 * i + rng.uniform(-10, 10), *rng.uniform(-25, 25, 2)], degrees=True)
        off = Rotation.from_rotvec(np.deg2rad(rng.uniform(15, 40)) * np.array([np.cos(i), np.sin(i), 0]))
        rotation = (off * turn).as_matrix()
        t = off.apply([0, 0, rng.uniform(250, 330)])
        inside = xyz @ rotation.T + t
        pixels = cv2.fisheye.projectPoints(xyz[:, None], Rotation.from_matrix(rotation).as_rotvec()[:, None], t[:, None], K, D)[0][:, 0]
        inside_frame = (pixels > 2) & (pixels < [1277, 957])
        seen = np.flatnonzero(inside_frame.all(axis=1) & (inside[:, 2] > 0.4 * np.linalg.norm(inside, axis=1)))
        parts.append((np.full(len(seen), i), seen, pixels[seen]))
        poses.append((rotation, -rotation.T @ t))
    image, point, px = (np.concatenate(one) for one in zip(*parts, strict=True))
    px = px + noise_px * rng.standard_normal(px.shape)
    model = CameraModel.of(SENSOR, "object_to_image", free, projection=projection, **({"c": c} if c else {}))
    n = len(xyz)
    network = Network(
        (model,), tuple(f"i{k}" for k in range(images)), np.zeros(images, int), tuple(f"p{k}" for k in range(n)), *px.T, image, point,
        np.tile([noise_px**2, 0, noise_px**2], (len(px), 1)), xyz, np.zeros((n, 3)), covariance_known=True,
    )  # fmt: skip
    truth = CameraModel.of(
        SENSOR, "object_to_image", projection="equidistant", c=400, xp=645, yp=476, b1=2 / 400, k1=D[0], k2=D[1], k3=D[2], k4=D[3]
    )
    rotation, position = (np.stack(one) for one in zip(*poses, strict=True))
    return network, State(truth.values[None], rotation, position, np.zeros(images), np.zeros(images), xyz)


FISHEYE = ("c", "xp", "yp", "b1", "k1", "k2", "k3", "k4")


def test_a_fisheye_is_calibrated_without_start_values_and_errs_as_it_says(rng):
    """Parameters of 8 cameras against OpenCV's drawing: 64 degrees of freedom. The first one finds its own start."""
    network, truth = _fisheye_network(rng, FISHEYE)
    found = calibrate_network(network, Options(folds=0, snoop=False, field="fixed", variance_components=False, a_priori=True))
    pooled = Pooled(0.0, 0)
    adjustments = [found.adjustment]
    for _ in range(7):
        network, truth = _fisheye_network(rng, FISHEYE)
        adjustments.append(adjust(network, truth, a_priori=True))
    for one in adjustments:
        names, covariance = one.interior_covariance()
        error = one.state.interior[0, [NAMES.index(name) for name in names]] - truth.interior[0, [NAMES.index(name) for name in names]]
        pooled += Pooled(float(error @ np.linalg.solve(covariance, error)), len(error))
    assert pooled.dof == 64 and pooled.p > RATE, pooled


def test_a_fisheye_agrees_with_opencvs_calibration(rng):
    """The same image points through cv2.fisheye.calibrate, which minimises the same sum: equal to a tenth of u."""
    network, truth = _fisheye_network(rng, FISHEYE)
    found = adjust(network, truth)
    rows = [np.flatnonzero(network.image == i) for i in range(len(network.images))]
    objects = [network.xyz[network.point[r]][None] for r in rows]
    pixels = [np.column_stack([network.x_px, network.y_px])[r][None] for r in rows]
    names = ("CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW", "CALIB_USE_INTRINSIC_GUESS")  # where they are depends on OpenCV's version
    flags = sum(getattr(cv2 if hasattr(cv2, name) and hasattr(cv2, "CALIB_FIX_SKEW") else cv2.fisheye, name) for name in names)
    K = np.array([[400.0, 0, 640], [0, 400, 480], [0, 0, 1]])
    _, K, D, *_ = cv2.fisheye.calibrate(objects, pixels, (1280, 960), K, np.zeros((4, 1)), flags=flags, criteria=(3, 200, 1e-12))
    names, covariance = found.interior_covariance()
    u = dict(zip(names, np.sqrt(np.diag(covariance)), strict=True))
    model = found.camera()
    theirs = {"c": K[1, 1], "xp": K[0, 2], "yp": K[1, 2], **dict(zip(("k1", "k2", "k3", "k4"), D.ravel(), strict=True))}
    for name, value in theirs.items():
        assert abs(model[name] - value) < 0.1 * u[name], name


def test_the_wrong_projection_is_seen_in_the_residuals(rng):
    """Without radial terms an equisolid lens cannot stand for an equidistant one: sigma0 tells."""
    network, truth = _fisheye_network(rng, ("c", "xp", "yp", "b1"), projection="orthographic")
    assert adjust(network, truth).sigma0 > 10


def test_a_rational_lens_is_calibrated(rng):
    """Points of a volume drawn by OpenCV with eight coefficients; the image of the lens is found to 6 u everywhere."""
    xyz = rng.uniform(-1, 1, (150, 3)) * [500, 400, 150]
    K = np.array([[500.0, 0, 645], [0, 500, 476], [0, 0, 1]])
    D = np.array([0.3, 0.02, 5e-4, -3e-4, 0.0, 0.6, 0.0, 0.0])
    image, point, px, poses = [], [], [], []
    for i in range(12):
        turn = Rotation.from_euler("zyx", [90 * i, *rng.uniform(-30, 30, 2)], degrees=True)
        t = np.array([0, 0, 600.0])
        pixels = cv2.projectPoints(xyz, turn.as_rotvec(), t, K, D)[0][:, 0]
        seen = np.flatnonzero(((pixels > 2) & (pixels < [1277, 957])).all(axis=1))
        image, point, px = image + [np.full(len(seen), i)], point + [seen], px + [pixels[seen]]
        poses.append((turn.as_matrix(), -turn.as_matrix().T @ t))
    pixels = np.concatenate(px) + 0.05 * rng.standard_normal((sum(map(len, px)), 2))
    free = ("c", "xp", "yp", "b1", "p1", "p2", "k1", "k2", "d1")
    model = CameraModel.of(SENSOR, "object_to_image", free, c=500.0)
    network = Network(
        (model,), tuple(map(str, range(12))), np.zeros(12, int), tuple(map(str, range(150))), *pixels.T, np.concatenate(image),
        np.concatenate(point), np.tile([0.0025, 0, 0.0025], (len(pixels), 1)), xyz, np.zeros((150, 3)), covariance_known=True,
    )  # fmt: skip
    rotation, position = (np.stack(one) for one in zip(*poses, strict=True))
    start = State(model.values[None], rotation, position, np.zeros(12), np.zeros(12), xyz)
    found = adjust(network, start)
    assert found.sigma0 == pytest.approx(1, abs=6 / np.sqrt(2 * found.dof))
    x, y = np.meshgrid(np.linspace(150, 1130, 7), np.linspace(100, 860, 7))
    u, v = found.camera().direction_of(x.ravel(), y.ravel())
    theirs = cv2.projectPoints(np.column_stack([u, v, np.ones(len(u))]), np.zeros(3), np.zeros(3), K, D)[0][:, 0]
    names, covariance = found.interior_covariance()
    slopes = found.camera().projected(u, v)[3][:, :, [NAMES.index(name) for name in names]]
    spread = np.sqrt(np.einsum("nai,ij,naj->na", slopes, covariance, slopes))
    assert np.all(np.abs(theirs - np.column_stack([x.ravel(), y.ravel()])) < 7 * spread + 1e-3)
