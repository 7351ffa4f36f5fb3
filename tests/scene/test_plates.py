"""Plates in perspective against projected points."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pixmetry.core.errors import ParameterError
from pixmetry.core.random import Grid
from pixmetry.scene.plates import Pose, chessboard, circle_images, dot_plate

POSE = Pose(2000.0, 63.5, 47.5, omega_deg=25.0, phi_deg=-40.0, kappa_deg=12.0, x_mm=3.0, y_mm=-5.0, z_mm=1500.0)


def projected(pose: Pose, x, y):
    """Points of the plate through rotation, translation and pinhole, one after the other; turned about x first, then y, then z."""
    turn = Rotation.from_euler("xyz", [pose.omega_deg, pose.phi_deg, pose.kappa_deg], degrees=True)
    p = turn.apply(np.stack([x, y, np.zeros_like(x)], axis=-1)) + [pose.x_mm, pose.y_mm, pose.z_mm]
    c = pose.principal_distance_px
    return pose.principal_x_px + c * p[:, 0] / p[:, 2], pose.principal_y_px + c * p[:, 1] / p[:, 2]


def centre_of_area(x, y):
    """Of a polygon."""
    xn, yn = np.roll(x, -1), np.roll(y, -1)
    w = x * yn - xn * y
    return ((x + xn) * w).sum() / (3 * w.sum()), ((y + yn) * w).sum() / (3 * w.sum())


def test_points_are_seen_where_a_pinhole_sees_them() -> None:
    x, y = np.array([0.0, 30.0, -20.0, 11.0]), np.array([0.0, -10.0, 25.0, 40.0])
    np.testing.assert_allclose(POSE.seen(x, y), projected(POSE, x, y), atol=1e-9)


def test_a_circle_is_seen_as_the_outline_of_its_projected_points() -> None:
    plate = dot_plate(POSE, 3, 4, 15.0, 9.0)
    turn = 2 * np.pi * np.arange(4000) / 4000
    for told, oval in zip(plate.targets(0.0, 0), plate.oval, strict=True):
        x, y = projected(POSE, told["x_mm"] + 4.5 * np.cos(turn), told["y_mm"] + 4.5 * np.sin(turn))
        u, v = np.linalg.solve(np.array([[oval[2], oval[4]], [oval[3], oval[5]]]), np.stack([x - oval[0], y - oval[1]]))
        np.testing.assert_allclose(np.hypot(u, v), 1.0, atol=1e-10)
        centre = centre_of_area(x, y)
        assert (told["ellipse_x_px"], told["ellipse_y_px"]) == pytest.approx(centre, abs=1e-5)
        middle = projected(POSE, np.array([told["x_mm"]]), np.array([told["y_mm"]]))
        assert (told["x_px"], told["y_px"]) == pytest.approx((middle[0][0], middle[1][0]), abs=1e-9)
        assert np.hypot(told["x_px"] - centre[0], told["y_px"] - centre[1]) > 2e-3  # there is something to tell


def test_eccentricity_of_the_plainest_perspective() -> None:
    """Of x/(1 + κx), y/(1 + κx), a circle about the origin has its ellipse's centre at −κR²/(1 − κ²R²): −.0245 px at R = 3.5, κ = .002."""
    for radius, kappa in ((3.5, 0.002), (30.0, 0.002), (3.5, -0.01)):
        plain = np.array([[1.0, 0, 0], [0, 1, 0], [kappa, 0, 1]])
        oval = circle_images(plain, np.zeros(1), np.zeros(1), np.full(1, radius))[0]
        truth = -kappa * radius**2 / (1 - (kappa * radius) ** 2)
        assert oval[0] == pytest.approx(truth, rel=1e-9)
        assert oval[1] == pytest.approx(0.0, abs=1e-12)
    assert circle_images(np.array([[1.0, 0, 0], [0, 1, 0], [0.002, 0, 1]]), np.zeros(1), np.zeros(1), np.full(1, 3.5))[
        0, 0
    ] == pytest.approx(-0.0245, abs=1e-4)


def test_the_image_of_a_dot_has_its_centre_of_gravity_at_the_ellipse() -> None:
    plate = dot_plate(POSE, 1, 1, 1.0, 12.0, 1000.0, 0.7)
    shape = (96, 128)
    seen = plate.render(Grid.whole([0], shape), shape, np.zeros(1), np.full(1, 0.01), False)[0, 0]
    y, x = np.indices(shape)
    (told,) = plate.targets(0.0, 0)
    assert (seen * x).sum() / seen.sum() == pytest.approx(told["ellipse_x_px"], abs=2e-5)
    assert (seen * y).sum() / seen.sum() == pytest.approx(told["ellipse_y_px"], abs=2e-5)
    area = np.pi / 4 * told["width_px"] * told["height_px"]
    assert seen.sum() == pytest.approx(1000 * area, rel=1e-6)


def test_a_chessboard_covers_its_squares_and_tells_its_corners() -> None:
    board = chessboard(POSE, 5, 6, 8.0, 1.0, 0.0)
    shape = (96, 128)
    seen = board.render(Grid.whole([0], shape), shape, np.zeros(1), np.full(1, 0.01), False)[0, 0]
    told = board.targets(0.0, 0)
    assert len(told) == 4 * 5
    x, y = projected(POSE, *(np.array([t[k] for t in told]) for k in ("x_mm", "y_mm")))
    np.testing.assert_allclose([t["x_px"] for t in told], x, atol=1e-9)
    np.testing.assert_allclose([t["y_px"] for t in told], y, atol=1e-9)
    # 16 samples a pixel and axis, taken back to the plate
    n = 16
    at_x, at_y = ((np.arange(s * n) + 0.5) / n - 0.5 for s in (shape[1], shape[0]))
    p = np.linalg.inv(POSE.homography) @ np.stack([v.ravel() for v in np.broadcast_arrays(at_x[None], at_y[:, None], 1.0)])
    u, v = (p[0] / p[2] + 24.0) / 8.0, (p[1] / p[2] + 20.0) / 8.0
    bright = (u >= 0) & (u < 6) & (v >= 0) & (v < 5) & ((np.floor(u) + np.floor(v)) % 2 == 0)
    truth = bright.reshape(shape[0], n, shape[1], n).mean(axis=(1, 3))
    assert np.abs(seen - truth).max() < 0.04  # half a sample along the side of a square
    assert (seen - truth).std() < 4e-3


@pytest.mark.parametrize("wrong", [{"z_mm": 0.0}, {"principal_distance_px": -1.0}, {"phi_deg": np.nan}], ids=str)
def test_a_pose_that_cannot_be_is_refused(wrong) -> None:
    with pytest.raises(ParameterError, match="allowed"):
        Pose(**({"principal_distance_px": 900.0, "principal_x_px": 0.0, "principal_y_px": 0.0} | wrong))
