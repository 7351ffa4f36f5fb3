"""Heights and tilts of the sensor: rays traced in space, and the numbers of the handbook."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from light_scenes import MEAN, Wave, camera, mapped, signal_of
from pixmetry.sources.sensor.tilt import SOURCE as TILT
from pixmetry.sources.sensor.tilt import Tilt
from pixmetry.sources.sensor.tilt import pull_of as tilt_pull
from pixmetry.sources.sensor.unflatness import SOURCE as UNFLAT
from pixmetry.sources.sensor.unflatness import Unflatness, height_um
from source_signals import stream


@pytest.mark.parametrize(("height", "angle", "expected_um"), [(100.0, 30.0, 57.7), (10.0, 20.0, 3.6), (10.0, 8.2, 1.4)])
def test_displacement_is_the_height_times_the_tangent(height, angle, expected_um):
    """A constant height, at the end of a row whose chief ray has that angle."""
    params = Unflatness(more_um=((height,),), chief_ray_deg=angle, pitch_x_um=8.6, pitch_y_um=8.6)
    (x,), _ = mapped(UNFLAT, params, [2000.0], [0.0], (1, 2001))
    assert (x - 2000) * 8.6 == pytest.approx(expected_um, abs=0.05)
    assert (x - 2000) * 8.6 == pytest.approx(height * np.tan(np.radians(angle)), rel=1e-6)


def test_rays_meet_the_surface_where_they_should():
    """A ray through the exit pupil, intersected with the surface by bisection."""
    params = Unflatness(bow_x_um=80, bow_y_um=-50, twist_um=30, skew_x_um=10, skew_y_um=-5, chief_ray_deg=25, pitch_x_um=10, pitch_y_um=10)
    shape = (301, 401)
    pupil_px = np.hypot(200, 150) / np.tan(np.radians(25))
    u, v = np.array([180.0, -120.0, 30.0]), np.array([-140.0, 90.0, 10.0])
    low, high = np.full(3, 0.9), np.full(3, 1.1)  # how far along the ray, in units of the pupil's distance
    for _ in range(60):
        t = 0.5 * (low + high)
        above = (t - 1) * pupil_px > height_um(params, 200 + u * t, 150 + v * t, shape) / 10
        low, high = np.where(above, low, t), np.where(above, t, high)
    x, y = mapped(UNFLAT, params, 200 + u, 150 + v, shape)
    assert x == pytest.approx(200 + u * t, abs=1e-6) and y == pytest.approx(150 + v * t, abs=1e-6)


def test_a_lens_that_is_telecentric_on_the_image_side_knows_no_heights(rng: np.random.Generator):
    params = Unflatness(bow_x_um=100, chief_ray_deg=0)
    told = UNFLAT.truth(params, signal_of(UNFLAT, params, (11, 21)), stream(rng))
    assert np.abs(told["shift_x_px"]).max() == 0
    assert told["height_um"][5, 10] == pytest.approx(-50) and told["height_um"][5, 0] == pytest.approx(1.5 * 100 * (20 / 21) ** 2 - 50)


@pytest.mark.parametrize("f", [0.2, 0.4])
def test_defocus_spreads_by_a_quarter_of_the_height_over_the_f_number(f):
    params = Unflatness(more_um=((15.0,),), chief_ray_deg=0, f_number=4, pitch_x_um=5, pitch_y_um=5)
    seen = camera((3, 3), (UNFLAT, params)).expose(Wave(f, 0.0, 1.0, 1.0)).data[0, 1, 1] / MEAN - 1
    sigma = 15 / 16 / 5
    assert seen == pytest.approx(np.exp(-2 * (np.pi * sigma * f) ** 2) * np.sinc(f), abs=3e-4)


@pytest.mark.parametrize(("c", "expected_um"), [(25.0, 3.6), (8.0, 11.2)])
def test_half_a_degree_of_tilt_at_three_millimetres(c, expected_um):
    params = Tilt(tilt_x_deg=0.5, principal_distance_mm=c, pitch_x_um=10, pitch_y_um=10)
    (x,), _ = mapped(TILT, params, [640.0], [0.0], (1, 641))
    assert (x - 640) * 10 == pytest.approx(expected_um, abs=0.25)


@pytest.mark.parametrize(("c", "shift_um"), [(8.0, 70.0), (25.0, 218.0)])
def test_a_tilted_sensor_is_a_turned_camera_with_its_principal_point_moved(c, shift_um):
    """Fit of rotation, principal point and principal distance to the map leaves nothing; the point moves by c tan α."""
    pitch = 8.0
    pull = tilt_pull(Tilt(tilt_x_deg=0.5, principal_distance_mm=c, pitch_x_um=pitch, pitch_y_um=pitch), (601, 801))
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(0, 800, 9), np.linspace(0, 600, 7)))
    u, v = ((q - q0) * pitch for q, q0 in zip(pull(x, y), (400, 300), strict=True))

    def turned(p):
        angle, xp, yp, length = p
        ray = np.array([(x - 400) * pitch - xp, (y - 300) * pitch - yp, np.full(x.size, length)])
        z = np.cos(angle) * ray[2] + np.sin(angle) * ray[0]
        return np.concatenate([(np.cos(angle) * ray[0] - np.sin(angle) * ray[2]) / z * c * 1000 - u, ray[1] / z * c * 1000 - v])

    fit = least_squares(turned, [0.0, 0.0, 0.0, c * 1000], x_scale=[1e-3, 10, 10, 1e3], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.abs(fit.fun).max() < 1e-5
    assert abs(fit.x[1]) == pytest.approx(shift_um, abs=1)
    assert abs(fit.x[1]) == pytest.approx(c * 1000 * np.tan(np.radians(0.5)), rel=1e-3)


def test_the_side_that_is_farther_from_the_lens_sees_a_larger_image():
    (left, right), _ = mapped(TILT, Tilt(tilt_x_deg=2.0), [0.0, 700.0], [250.0, 250.0], (501, 701))
    assert right > 700 and left > 0


def test_focus_runs_through_the_image():
    params = Tilt(tilt_y_deg=3.0, f_number=2.0, pitch_x_um=5, pitch_y_um=5, principal_distance_mm=1e4)
    shape, f = (401, 3), 0.25
    seen = [camera(shape, (TILT, params)).expose(Wave(f, 0.0, 1.0, row)).data[0, row, 1] / MEAN - 1 for row in (200, 260)]
    sigma = 60 * np.sin(np.radians(3)) / 8
    assert seen == pytest.approx([np.sinc(f), np.exp(-2 * (np.pi * sigma * f) ** 2) * np.sinc(f)], abs=1e-3)
