"""A calibrated camera in use: covariances against draws of the parameters, differences of calibrations against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from calibrate.adjusted import measured_again
from calibrate.networks import disturbed, predicted, simulate
from pixmetry import read_calibration
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.bundle.options import Options
from pixmetry.calibrate.bundle.solve import calibrate_network
from pixmetry.calibrate.files.write import write_results
from pixmetry.calibrate.job import solve_again
from pixmetry.calibrate.projection import CalibratedCamera, calibrated_cameras, difference, pack_state, unpack_state
from pixmetry.calibrate.records import Calibration
from pixmetry.core.errors import InputError

RATE = 1e-6
NAMES = ("c", "xp", "yp", "k1", "p1")


def _camera(direction="image_to_object", projection="perspective") -> CalibratedCamera:
    unit = 700.0 if direction == "image_to_object" else 1.0
    model = CameraModel.of(Sensor(640, 480), direction, projection=projection, c=700.0, k1=-0.08 / unit**2, p1=1e-3 / unit)
    sigma = np.array([0.7, 0.5, 0.4, 2e-3 / unit**2, 2e-4 / unit])
    correlation = np.eye(5) + 0.4 * (np.eye(5, k=1) + np.eye(5, k=-1))
    return CalibratedCamera(model, NAMES, correlation * np.outer(sigma, sigma))


@pytest.mark.parametrize("direction", ["image_to_object", "object_to_image"])
def test_projected_points_scatter_as_their_covariance_says(direction, rng):
    """4000 draws of parameters and points: a variance wrong by 15 % fails; and the same the other way round for rays."""
    camera, n = _camera(direction), 4000
    point, spread = np.array([[0.3, -0.2, 1.5]]), np.diag([1e-6, 2e-6, 4e-6])
    one = camera.project(point, spread[None])
    draws = rng.multivariate_normal(camera.pack(), camera.covariance, n)
    moved = rng.multivariate_normal(point[0], spread, n)
    pixels = np.concatenate([camera.unpack(q).project(p[None]).px for q, p in zip(draws, moved, strict=True)]) - one.px
    squares = np.einsum("ni,ij,nj->n", pixels, np.linalg.inv(one.covariance_px2[0]), pixels).sum()
    assert chi2.sf(squares, 2 * n) > RATE and chi2.cdf(squares, 2 * n) > RATE
    px, spread_px = np.array([[500.0, 90.0]]), 0.2**2 * np.eye(2)
    ray = camera.unproject(px, spread_px[None])
    near = rng.multivariate_normal(px[0], spread_px, n)
    rays = np.concatenate([camera.unpack(q).unproject(p[None]).direction for q, p in zip(draws, near, strict=True)]) - ray.direction
    inverse = np.linalg.pinv(ray.covariance[0], hermitian=True, rcond=1e-9)
    squares = np.einsum("ni,ij,nj->n", rays, inverse, rays).sum()
    assert chi2.sf(squares, 2 * n) > RATE and chi2.cdf(squares, 2 * n) > RATE
    assert np.abs(ray.covariance[0] @ ray.direction[0]).max() < 1e-15


@pytest.mark.parametrize("projection", ["perspective", "equidistant"])
def test_there_and_back(projection, rng):
    camera = _camera("object_to_image", projection)
    px = np.column_stack([rng.uniform(0, 639, 50), rng.uniform(0, 479, 50)])
    rays = camera.unproject(px).direction
    np.testing.assert_allclose(camera.project(3 * rays).px, px, atol=1e-9)
    behind = camera.project(np.array([[0.1, 0.1, -1.0]]))
    assert np.isnan(behind.px).all() and np.isnan(behind.covariance_px2).all()


def test_calibrations_of_one_camera_differ_as_their_uncertainties_say(rng):
    """Two times new noise, ten times: χ² of the differences; a standard deviation wrong by 30 % fails with 99.9 %."""
    simulated = simulate(rng, images=14, points=60)
    exact = predicted(simulated.network, simulated.truth)
    statistic = dof = 0
    for _ in range(10):
        pair = []
        for _ in range(2):
            found = adjust(measured_again(rng, simulated, exact), simulated.truth, a_priori=True)
            pair.append(CalibratedCamera(found.camera(), *found.interior_covariance()))
        one = difference(*pair)
        statistic, dof = statistic + one.chi2, dof + one.dof
        assert one.rms_px < 10 * one.expected_rms_px and np.nanmax(one.u_px) < 5
    assert chi2.sf(statistic, dof) > RATE and chi2.cdf(statistic, dof) > RATE and dof == 100


def test_few_degrees_of_freedom_are_not_taken_for_many(rng):
    """k1 with a variance of 4 degrees of freedom against its truth, 200 times: p is uniform (Fisher's sum); by χ² it would be small."""
    truth, n, u, dof = _camera("object_to_image"), 200, 1e-5, 4
    exact = CalibratedCamera(truth.model, (), np.zeros((0, 0)))
    stat = as_exact = 0.0
    for _ in range(n):
        model = truth.model.with_values(k1=truth.model["k1"] + u * rng.standard_normal())
        found = CalibratedCamera(model, ("k1",), np.array([[u**2 * rng.chisquare(dof) / dof]]), dof=dof)
        stat += -2 * np.log(difference(found, exact, 9, 7, rotate=False).p)
        as_exact += -2 * np.log(difference(replace(found, dof=np.inf), exact, 9, 7, rotate=False).p)
    assert chi2.sf(stat, 2 * n) > RATE and chi2.cdf(stat, 2 * n) > RATE
    assert as_exact > 1.2 * stat


def test_a_rotation_of_the_camera_is_no_difference():
    """Another principal point is nearly a rotation: what is left of 2 px is small; without taking it out, it is 2 px."""
    camera = _camera()
    other = replace(camera, model=camera.model.with_values(xp=camera.model["xp"] + 2))
    free, held = difference(camera, other), difference(camera, other, rotate=False)
    assert held.rms_px == pytest.approx(2, abs=0.15) and free.rms_px < 0.35
    assert np.rad2deg(np.arccos((np.trace(free.rotation) - 1) / 2)) == pytest.approx(np.rad2deg(2 / 700), rel=0.1)
    same = difference(camera, camera)
    assert same.rms_px < 1e-9 and same.p > 0.999


def test_a_changed_lens_is_found():
    camera = _camera()
    moved = replace(camera, model=camera.model.with_values(k1=camera.model["k1"] * 1.3))
    assert difference(camera, moved).p < 1e-6
    with pytest.raises(InputError, match="different frames"):
        difference(camera, replace(camera, model=replace(camera.model, sensor=Sensor(800, 600))))


def test_a_stored_calibration_gives_the_same_cameras(rng, tmp_path):
    simulated = simulate(rng, images=8, points=40)
    found = Calibration(adjust(simulated.network, disturbed(rng, simulated), redundancy=True))
    own = calibrated_cameras(found)["camera"]
    assert own.names == found.adjustment.interior_covariance()[0]
    assert own.dof == found.adjustment.dof
    np.testing.assert_array_equal(own.unpack(own.pack()).model.values, own.model.values)


def test_the_state_is_one_vector_and_back(rng):
    """Order and length are those of the covariance; a step in it is the step of the state."""
    simulated = simulate(rng, images=6, points=30, bars=2, per_image=("x_scale",))
    found = adjust(simulated.network, disturbed(rng, simulated))
    names, values = pack_state(found)
    assert len(names) == len(values) == len(found.covariance)
    back = unpack_state(found, values)
    for name in ("interior", "rotation", "position", "x_scale", "xyz"):
        np.testing.assert_array_equal(getattr(back, name), getattr(found.state, name))
    step = np.zeros(len(values))
    step[names.index("camera:k1")], step[names.index("IMG_0002:rx")], step[names.index("IMG_0003:Z0")] = 1e-6, 1e-3, 2.0
    moved = unpack_state(found, values + step)
    assert moved.interior[0, 7] - found.state.interior[0, 7] == pytest.approx(1e-6)
    assert moved.position[2, 2] - found.state.position[2, 2] == pytest.approx(2.0)
    turn = moved.rotation[1] @ found.state.rotation[1].T
    np.testing.assert_allclose(turn, [[1, 0, 0], [0, 1, -1e-3], [0, 1e-3, 1]], atol=1e-6)


def test_a_calibration_is_solved_again_with_a_change(rng, tmp_path):
    """Held parameters and images left out change what they should; the inputs are those of the first run."""
    simulated = simulate(rng, images=12, points=50)
    first = calibrate_network(simulated.network, Options(folds=0, variance_components=False), start=simulated.truth)
    same = solve_again(first)
    np.testing.assert_allclose(same.adjustment.state.interior, first.adjustment.state.interior, rtol=1e-6, atol=1e-6)
    fewer = solve_again(first, free="c, xp, yp, k1, k2", without=("IMG_0003",), options={"a_priori": True})
    assert fewer.adjustment.interior_covariance()[0] == ("c", "xp", "yp", "k1", "k2")
    assert "IMG_0003" not in fewer.adjustment.network.images and len(fewer.adjustment.network.images) == 11
    with pytest.raises(InputError, match="no image"):
        solve_again(first, without=("nobody",))
    write_results(first, tmp_path / "r")
    stored = calibrated_cameras(read_calibration(tmp_path / "r"))["camera"]
    again = calibrated_cameras(first)["camera"]
    assert difference(stored, again).rms_px < 1e-9 and stored.dof == pytest.approx(again.dof)
