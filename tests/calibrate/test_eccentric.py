"""Eccentricity: against the closed form of a circle under a pinhole, against counted sub-pixels, and against polygons of many corners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pixmetry.calibrate.bundle.eccentric import eccentricity, without_eccentricity
from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Network, State
from pixmetry.locate.circles.eccentricity import circle_seen

LENS = {"b1": 3e-4, "b2": -2e-4, "p1": 2e-4, "p2": -1e-4, "k1": -4e-3, "k2": 3e-5}  # mm: 30 px at the corners of this sensor


def turn(rng: np.random.Generator, largest: float) -> np.ndarray:
    """A rotation about a random axis, by at most so many radians."""
    axis = rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    angle, cross = rng.uniform(-largest, largest), np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def plate(rng: np.random.Generator, direction: str = "image_to_object", diameter: float = 20.0, **lens: float) -> tuple[Network, State]:
    """Six images of 7 × 7 targets, 40 mm apart on a plate, from about 500 mm with a lens of 8 mm."""
    camera = CameraModel.of(Sensor(1280, 1024, 5.0, 5.0), direction, c=8.0, **lens)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-3, 4) * 40.0, np.arange(-3, 4) * 40.0))
    xyz, images = np.column_stack([x, y, np.zeros(49)]), 6
    rotation = np.stack([turn(rng, 0.6) for _ in range(images)])
    position = np.stack([-(r.T @ np.append(rng.uniform(-30, 30, 2), rng.uniform(450, 550))) for r in rotation])
    n = images * len(xyz)
    image, point = np.repeat(np.arange(images), len(xyz)), np.tile(np.arange(len(xyz)), images)
    network = Network(
        cameras=(camera,),
        images=tuple(f"i{k}" for k in range(images)),
        camera_of=np.zeros(images, int),
        points=tuple(f"p{k}" for k in range(len(xyz))),
        x_px=np.zeros(n),
        y_px=np.zeros(n),
        image=image,
        point=point,
        covariance_px2=np.tile([1.0, 0.0, 1.0], (n, 1)),
        xyz=xyz,
        u_xyz=np.zeros_like(xyz),
        diameter=np.full(len(xyz), diameter),
    )
    return network, State(camera.values[None], rotation, position, np.zeros(images), np.zeros(images), xyz)


def polynomial(camera: CameraModel, a: np.ndarray, b: np.ndarray, affine: bool) -> tuple[np.ndarray, np.ndarray]:
    """Brown's polynomial, written once more."""
    r2 = a**2 + b**2
    radial = 1 + camera["k1"] * r2 + camera["k2"] * r2**2
    x = a * radial + camera["p1"] * (r2 + 2 * a**2) + 2 * camera["p2"] * a * b
    y = b * radial + camera["p2"] * (r2 + 2 * b**2) + 2 * camera["p1"] * a * b
    return (x + camera["b1"] * a + camera["b2"] * b, y) if affine else (x, y)


def projected_object_to_image(camera: CameraModel, p: np.ndarray) -> np.ndarray:
    """Images of points in the camera's frame, px."""
    a, b = polynomial(camera, p[..., 0] / p[..., 2], p[..., 1] / p[..., 2], affine=False)
    c_px = camera["c"] / 0.005
    return np.stack([camera["xp"] + c_px * ((1 + camera["b1"]) * a + camera["b2"] * b), camera["yp"] + c_px * b], axis=-1)


def centroid(polygon: np.ndarray) -> np.ndarray:
    """Centre of area of a polygon."""
    about = polygon[0]
    x, y = (polygon - about).T
    xn, yn = np.roll(x, -1), np.roll(y, -1)
    cross = x * yn - xn * y
    return about + np.array([((x + xn) * cross).sum(), ((y + yn) * cross).sum()]) / (3 * cross.sum())


def test_limit_pinhole_agrees_with_the_closed_form_of_the_ellipse(rng):
    network, state = plate(rng)
    found = eccentricity(network, state)
    for k in range(len(network.images)):
        rows = network.image == k
        camera = np.array([[1600.0, 0, 639.5], [0, 1600.0, 511.5], [0, 0, 1]])
        r = state.rotation[k]
        homography = camera @ np.column_stack([r[:, 0], r[:, 1], -r @ state.position[k]])
        _, centres = circle_seen(homography, network.xyz[:, 0], network.xyz[:, 1], 10.0)
        expected = -np.column_stack([centres.shift_x_px, centres.shift_y_px])
        np.testing.assert_allclose(found.shift_px[rows], expected, atol=1e-8)
    assert found.corrected.all() and found.possible_px == 0
    assert 0.02 < found.largest_px < 1.5  # below 0.1 where all six happen to be frontal: 5 of 4000


def test_counted_subpixels_of_a_distorted_circle_have_that_centre(rng):
    network, state = plate(rng, **LENS)
    camera, row = network.cameras[0], int(rng.integers(len(network)))
    r, x0, centre = state.rotation[network.image[row]], state.position[network.image[row]], network.xyz[network.point[row]]
    p = r @ (centre - x0)
    at = np.array(camera.project(p[0] / p[2], p[1] / p[2])).ravel()
    # 1600 × 1600 sub-pixels of a window about it: each is looked through to the plate; circles are up to 115 px wide
    t = 2 * np.pi * np.arange(60) / 60
    rim = (centre + 10 * np.column_stack([np.cos(t), np.sin(t), 0 * t]) - x0) @ r.T
    size, count = 2.1 * np.abs(np.array(camera.project(rim[:, 0] / rim[:, 2], rim[:, 1] / rim[:, 2])) - at[:, None]).max(), 1600
    grid = (np.arange(count) + 0.5) / count * size - size / 2
    gx, gy = np.meshgrid(at[0] + grid, at[1] + grid)
    a, b = polynomial(camera, (gx - camera["xp"]) * 0.005, (gy - camera["yp"]) * 0.005, affine=True)
    ray = np.stack([a / camera["c"], b / camera["c"], np.ones_like(a)], axis=-1) @ r
    plane = x0 - x0[2] / ray[..., 2:] * ray
    inside = np.hypot(plane[..., 0] - centre[0], plane[..., 1] - centre[1]) < 10.0
    assert not (inside[0].any() or inside[-1].any() or inside[:, 0].any() or inside[:, -1].any())
    shift = np.array([(gx[inside] - at[0]).mean(), (gy[inside] - at[1]).mean()])
    # a cell on the outline (2πR of them, of area a²) counts wholly or not: u = R √(2πR a³ / 24) / (πR²) px along an axis, times 5
    edge = np.sqrt(inside.sum() / np.pi)
    tolerance = 5 * edge * np.sqrt(2 * np.pi * edge / 24) / (np.pi * edge**2) * size / count
    assert tolerance < 4e-3
    np.testing.assert_allclose(eccentricity(network, state).shift_px[row], shift, atol=tolerance)


@pytest.mark.parametrize("shape", ["circle", "square"])
def test_polygons_of_many_corners_have_that_centre_object_to_image(rng, shape):
    network, state = plate(rng, "object_to_image", k1=-0.25, k2=0.1, p1=2e-3, p2=-1e-3, b1=1e-3, b2=-5e-4)
    found = eccentricity(network, state, shape)
    t = np.arange(40000) / 10000  # 4 turns of a quarter
    if shape == "circle":
        outline = np.column_stack([np.cos(t * np.pi / 2), np.sin(t * np.pi / 2)])
    else:
        side, s = np.floor(t), 2 * (t % 1) - 1
        one = np.ones_like(s)
        which = [side == 0, side == 1, side == 2]
        outline = np.column_stack([np.select(which, [one, -s, -one], s), np.select(which, [s, one, -s], -one)])
    for row in rng.choice(len(network), 12, replace=False):
        r, x0, centre = state.rotation[network.image[row]], state.position[network.image[row]], network.xyz[network.point[row]]
        corners = projected_object_to_image(network.cameras[0], (centre + np.column_stack([10 * outline, np.zeros(len(t))]) - x0) @ r.T)
        seen = projected_object_to_image(network.cameras[0], (centre - x0) @ r.T)
        np.testing.assert_allclose(found.shift_px[row], centroid(corners) - seen, atol=1e-6)


def test_distortion_over_the_target_is_in_it(rng):
    """Frontal, in the corner: perspective shifts nothing, the lens does; for radial distortion K r³ the shift is K ∇²(r² x) R²/8 px."""
    network, state = plate(rng, diameter=8.0, k1=1e-6)
    straight = np.broadcast_to(np.eye(3), state.rotation.shape).copy()
    state = replace(state, rotation=straight, position=np.tile([0.0, 0.0, -500.0], (len(straight), 1)))
    found = eccentricity(network, state)
    row = 0
    x = 8.0 * np.array([-120.0, -120.0]) / 500  # mm in the image
    radius = 8.0 * 4 / 500
    # a' = a (1 + k1 r²) is what is ideal, so the image is moved by −k1 r² a; area counts: mean of δ (1 + div δ) over the disc, second order
    expected = -1e-6 * radius**2 * (8 * x / 8 + 8 * x / 4) / 0.005
    np.testing.assert_allclose(found.shift_px[row], expected, rtol=1e-3)


def test_scale_of_an_image_stretches_the_shift(rng):
    network, state = plate(rng, **LENS)
    stretched = eccentricity(network, replace(state, x_scale=np.full(6, 0.01)))
    plain = eccentricity(network, state)
    np.testing.assert_allclose(stretched.shift_px, plain.shift_px * [1.01, 1.0], rtol=1e-12)


def test_without_normals_nothing_is_corrected_and_the_largest_shift_is_told(rng):
    """A circle on the axis of a pinhole, tilted by 45°, is shifted by c (r/Z)²/2."""
    network, state = plate(rng, diameter=4.0)
    xyz = network.xyz * 0.02 + np.append(np.zeros((49, 2)), rng.uniform(-60, 60, (49, 1)), axis=1)
    state = replace(state, xyz=xyz, rotation=np.stack([np.eye(3)] * 6), position=np.tile([0, 0, -500.0], (6, 1)))
    found = eccentricity(network, state)
    assert not found.corrected.any() and (found.shift_px == 0).all()
    assert found.possible_px == pytest.approx((1600 * (2.0 / (500 + xyz[:, 2])) ** 2 / 2).max(), rel=0.02)
    given = replace(network, normal=np.tile([0.0, 0.0, 2.0], (49, 1)))
    assert eccentricity(given, state).corrected.all()


def test_unknown_sizes_stay_as_they_are(rng):
    network, state = plate(rng, **LENS)
    some = network.diameter.copy()
    some[::2] = np.nan
    part = replace(network, diameter=some)
    found, whole = eccentricity(part, state), eccentricity(network, state)
    sized = np.isfinite(some[network.point])
    assert (found.corrected == sized).all()
    np.testing.assert_array_equal(found.shift_px[sized], whole.shift_px[sized])
    centres = without_eccentricity(part, found)
    np.testing.assert_array_equal(centres.x_px[~sized], part.x_px[~sized])
    np.testing.assert_allclose(centres.y_px, part.y_px - found.shift_px[:, 1])
    assert not eccentricity(replace(network, diameter=None), state).corrected.any()
