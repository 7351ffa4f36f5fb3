"""Distortion curves and projection maps against the other projection and against repeated calibrations (failing once in a million runs)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, stats
from scipy.spatial.transform import Rotation

from calibrate.adjusted import adjusted, measured_again
from calibrate.networks import SENSOR, _polynomial, distorted, predicted, simulate
from pixmetry.calibrate.bundle.model import NAMES, CameraModel
from pixmetry.calibrate.checks import curves

RATE = 1e-6
MX = 0.00345
RADIAL = {"k1": 1.2e-3, "k2": -1.5e-5, "k3": 2e-7}
BOTH = pytest.mark.parametrize("direction", ["image_to_object", "object_to_image"])


def lens(direction, **more):
    scale = {"k1": -(8.0**2), "k2": -(8.0**4), "k3": -(8.0**6)} if direction == "object_to_image" else {}
    return CameraModel.of(SENSOR, direction, c=8.0, **{k: v * scale.get(k, 1) for k, v in RADIAL.items()}, **more)


@BOTH
def test_radial_curve_is_that_of_the_projection(direction):
    camera = lens(direction)
    tangent = np.linspace(0.01, 0.4, 30)
    x, _ = distorted(camera.values, SENSOR, direction, tangent, 0 * tangent)
    real, ideal = (x - camera["xp"]) * MX, 8.0 * tangent
    at = real if direction == "image_to_object" else ideal
    expected = ideal - real if direction == "image_to_object" else real - ideal
    np.testing.assert_allclose(curves.radial_distortion(camera, at), expected, atol=1e-10)


@BOTH
def test_balanced_lens_is_the_same_lens(direction):
    camera = lens(direction)
    radius = np.linspace(0, 4.4, 200)
    for at in (None, 3.0):
        curve, c_b = curves.balanced_distortion(camera, radius, at)
        delta = curves.radial_distortion(camera, radius)
        if direction == "image_to_object":  # tan θ of the same measured radius
            np.testing.assert_allclose((radius + curve) / c_b, (radius + delta) / 8.0, rtol=1e-12)
        else:  # the same image of the same tan θ = r/c
            np.testing.assert_allclose(c_b * radius / 8.0 + curve, radius + delta, rtol=1e-12)
        if at is not None:
            assert curves.balanced_distortion(camera, np.array([0, 1, 2, 3.0]), at)[0][3] == pytest.approx(0, abs=1e-14)


@BOTH
def test_balanced_by_least_squares_is_the_least(direction):
    camera = lens(direction)
    radius = np.linspace(0, 4.4, 200)
    delta = curves.radial_distortion(camera, radius)

    def cost(c_b):
        ratio = c_b / 8.0
        left = ratio * (radius + delta) - radius if direction == "image_to_object" else radius + delta - ratio * radius
        return np.sum(radius * left**2)

    best = optimize.minimize_scalar(cost, bounds=(7, 9), method="bounded", options={"xatol": 1e-9}).x
    assert curves.balanced_distortion(camera, radius)[1] == pytest.approx(best, abs=1e-6)


@BOTH
def test_tangential_profile_is_the_largest_sideways_part(direction):
    camera = CameraModel.of(SENSOR, direction, c=8.0, p1=3e-5, p2=-4e-5)
    angle = np.linspace(0, 2 * np.pi, 100001)
    unit = 8.0 if direction == "object_to_image" else 1.0
    a, b = 3.0 / unit * np.cos(angle), 3.0 / unit * np.sin(angle)
    moved_a, moved_b = _polynomial(a, b, 3e-5, -4e-5, [])
    sideways = np.abs(-(moved_a - a) * np.sin(angle) + (moved_b - b) * np.cos(angle)).max() * unit
    assert curves.tangential_distortion(camera, np.array([3.0]))[0] == pytest.approx(sideways, rel=1e-8)


def test_stat_bands_follow_from_the_covariance(rng):
    """Over 400 draws of the parameters, the spread of each curve at its middle and its end, and of the balanced c, within 24 %."""
    simulated = simulate(rng, images=8, points=50)
    found = adjusted(simulated.network, simulated)
    record = curves.distortion_curves(found, points=41)["camera"]
    assert record.unit == "mm" and record.radius_px[-1] == pytest.approx(record.radius[-1] / MX)
    np.testing.assert_allclose(record.radial_px, record.radial / MX)
    names, covariance = found.interior_covariance()
    camera, places, drawn = found.camera(), [NAMES.index(name) for name in names], []
    for step in rng.multivariate_normal(np.zeros(len(places)), covariance, 400, method="cholesky"):
        values = camera.with_values(**{n: camera[n] + s for n, s in zip(names, step, strict=True)})
        radial = curves.radial_distortion(values, record.radius)
        balanced, c_b = curves.balanced_distortion(values, record.radius)
        tangential = curves.tangential_distortion(values, record.radius)
        drawn.append([radial[20], radial[40], balanced[20], balanced[40], tangential[40], c_b])
    u = [record.u_radial[20], record.u_radial[40], record.u_balanced[20], record.u_balanced[40], record.u_tangential[40]]
    ratio = np.var(drawn, axis=0, ddof=1) / np.square([*u, record.u_balanced_c])
    low, high = stats.chi2.ppf([RATE / 20, 1 - RATE / 20], 399) / 399
    assert ((ratio > low) & (ratio < high)).all()


def turned_away(error: np.ndarray, interior, direction, u, v) -> np.ndarray:
    """Errors, shape (n, 2), less the best small rotation of the camera, with difference quotients of the other projection."""
    rays, slopes = np.stack([u, v, np.ones_like(u)], axis=1), []
    for axis in np.eye(3):
        ends = [Rotation.from_rotvec(s * 1e-6 * axis).apply(rays) for s in (1, -1)]
        images = [np.stack(distorted(interior, SENSOR, direction, e[:, 0] / e[:, 2], e[:, 1] / e[:, 2])).T.ravel() for e in ends]
        slopes.append((images[0] - images[1]) / 2e-6)
    matrix = np.stack(slopes, axis=1)
    return (error.ravel() - matrix @ np.linalg.lstsq(matrix, error.ravel(), rcond=None)[0]).reshape(-1, 2)


def test_stat_projection_map_covers_repeated_calibrations(rng):
    """120 calibrations of one network: squared errors of the projection over the map's variance average to 1: raw, without rotation,
    and in the middle, where hardly anything is left without it.

    Each of the 120 values has one degree of freedom or more, so their mean is held against χ² of 120. Uncertainties wrong by 35 % would be
    caught, and the raw map taken for the other (fivefold) at once.
    """
    simulated = simulate(rng, images=8, points=40)
    exact, truth = predicted(simulated.network, simulated.truth), simulated.truth.interior[0]
    x, y = np.meshgrid(np.linspace(0, SENSOR.cols - 1, 9), np.linspace(0, SENSOR.rows - 1, 7))
    u, v = CameraModel(SENSOR, values=truth).direction_of(x, y)
    aim, ratios = np.stack(distorted(truth, SENSOR, "image_to_object", u, v), axis=1), []
    for _ in range(120):
        found = adjusted(measured_again(rng, simulated, exact), simulated, a_priori=True)
        record = curves.projection_maps(found, 9, 7)["camera"]
        error = np.stack(distorted(found.state.interior[0], SENSOR, "image_to_object", u, v), axis=1) - aim
        row = [error, turned_away(error, truth, "image_to_object", u, v)]
        maps = record.u_raw_px, record.u_px
        z2 = [np.sum(e**2, axis=1) / (2 * m.ravel() ** 2) for e, m in zip(row, maps, strict=True)]
        ratios.append([z2[0].mean(), z2[1].mean(), z2[1][len(u) // 2]])
    without, raw = record.u_px, record.u_raw_px
    assert without.shape == (7, 9) and np.sum(without**2) < np.sum(raw**2)  # least squares over the map, not in each node
    assert np.median(without / raw) < 0.4  # 0.17 ± 0.02 over 100 networks
    low, high = stats.chi2.ppf([RATE / 6, 1 - RATE / 6], 120) / 120
    mean = np.mean(ratios, axis=0)
    assert ((mean > low) & (mean < high)).all(), mean
