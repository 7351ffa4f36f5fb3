"""Significance, correlations, residuals and the F-test of x against y. Statistical tests fail once in a million runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import special, stats

from calibrate.adjusted import NOISE_PX, adjusted, measured_again
from calibrate.networks import SENSOR, distorted, predicted, simulate
from pixmetry.calibrate.bundle.model import NAMES, CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Adjustment, Network, State
from pixmetry.calibrate.checks import quality

RATE = 1e-6


def by_hand(residual: np.ndarray, covariance_px2: np.ndarray, redundancy: np.ndarray, sensor: Sensor = SENSOR) -> Adjustment:
    """An adjustment of one image, with what these tests read from it."""
    n = len(residual)
    camera = CameraModel.of(sensor, c=8.0)
    whole, image = np.arange(n), np.zeros(n, int)
    network = Network(
        (camera,), ("image",), np.zeros(1, int), tuple(map(str, whole)), residual[:, 0], residual[:, 1], image, whole, covariance_px2,
        np.zeros((n, 3)), np.zeros((n, 3)),
    )  # fmt: skip
    state = State(camera.values[None], np.eye(3)[None], np.zeros((1, 3)), np.zeros(1), np.zeros(1), network.xyz)
    columns = ("camera:c", "camera:b1", "camera:k1", "image:Z0", "image:rx")
    u = np.array([0.01, 1e-5, 1e-6, 2.0, 1e-4])
    matrix = np.array(
        [[1, 0.1, -0.3, -0.97, 0], [0.1, 1, 0.05, 0, 0.5], [-0.3, 0.05, 1, 0.2, 0], [-0.97, 0, 0.2, 1, 0], [0, 0.5, 0, 0, 1]], float
    )
    covariance = matrix * np.outer(u, u)
    used = np.ones(n, bool)
    return Adjustment(
        network, state, used, residual, np.ones(n), 1.0, 2 * n - 5, columns, covariance, np.zeros((n, 3, 3)), redundancy, None, "", 1, ()
    )  # fmt: skip


@pytest.mark.parametrize(("ratio", "p"), [(1.279, 0.036), (1.373, 0.010)])
def test_published_f_test_of_the_line_experiment(ratio, p):
    """x against y of 8 lines in 27 views: F.95(216, 216) = 1.25."""
    found, critical, chance = quality.f_test(ratio * 2.0, 2.0, 216, 216)
    assert found == pytest.approx(ratio) and round(critical, 2) == 1.25 and abs(chance - p) < 6e-4


def test_f_test_against_the_incomplete_beta_function(rng):
    ratio, dof_x, dof_y = rng.uniform(0.5, 2), rng.uniform(5, 300), rng.uniform(5, 300)
    _, critical, p = quality.f_test(ratio, 1.0, dof_x, dof_y)
    assert p == pytest.approx(special.betainc(dof_y / 2, dof_x / 2, dof_y / (dof_y + dof_x * ratio)), rel=1e-9)
    assert special.betainc(dof_y / 2, dof_x / 2, dof_y / (dof_y + dof_x * critical)) == pytest.approx(0.05, rel=1e-9)


def test_unit_of_the_f_test_follows_the_pitch(rng):
    """Equal in px, pitches 8.6 and 8.3 µm: the ratio in µm² is their ratio squared."""
    residual = np.repeat([[0.04, 0.04], [-0.04, -0.04]], 200, axis=0)
    made = by_hand(residual, np.tile([0.0016, 0, 0.0016], (400, 1)), np.ones((400, 2)), Sensor(500, 500, 8.6, 8.3))
    record = quality.f_test_records(made)["camera"]
    assert record.ratio_px2 == pytest.approx(1) and record.p_px == pytest.approx(0.5)
    assert record.ratio_um2 == pytest.approx((8.6 / 8.3) ** 2) and record.p_um < record.p_px
    assert record.dof_x == record.dof_y == pytest.approx(400) and record.side == "x noisier than y"
    assert "400 and 400 degrees of freedom" in record.text and "one-sided" in record.text


def test_degrees_of_freedom_given_line_by_line():
    residual = np.repeat([[0.0397, 0.0351], [-0.0397, -0.0351]], 8640, axis=0)
    made = by_hand(residual, np.tile([0.0016, 0, 0.0016], (17280, 1)), np.ones((17280, 2)))
    record = quality.f_test_records(made, {"camera": (216, 216)})["camera"]
    assert 0.03 < record.p_px < 0.042 and (record.dof_x, record.dof_y) == (216, 216)
    assert quality.f_test_records(made)["camera"].p_px < 1e-20  # all points as if they were independent


def test_stat_f_test_is_fair_with_unequal_weights(rng):
    """p is uniform over 1000 draws of noise with standard deviations that differ fourfold (46 degrees of freedom of 120)."""
    variance = np.where(rng.random((120, 2)) < 0.3, 16.0, 1.0) * 1e-4
    covariance = np.stack([variance[:, 0], 0 * variance[:, 0], variance[:, 1]], axis=1)
    mean = variance.mean(axis=0)
    p = []
    for _ in range(1000):
        residual = np.sqrt(variance / mean) * rng.standard_normal(variance.shape)
        p.append(quality.f_test_records(by_hand(residual, covariance, np.ones((120, 2))))["camera"].p_px)
    assert stats.binomtest(int((np.array(p) < 0.05).sum()), 1000, 0.05).pvalue > RATE
    assert stats.kstest(p, "uniform").pvalue > RATE


def test_residual_records_in_both_units(rng):
    residual, redundancy = rng.standard_normal((50, 2)), rng.random((50, 2))
    record = quality.residual_records(by_hand(residual, np.tile([1.0, 0, 1], (50, 1)), redundancy))["camera"]
    assert record.rms_x_px == pytest.approx(np.sqrt((residual[:, 0] ** 2).mean())) and record.n == 50
    assert record.rms_y_um == pytest.approx(3.45 * np.sqrt((residual[:, 1] ** 2).mean()))
    assert record.dof_x == pytest.approx(redundancy[:, 0].sum())
    no_pitch = quality.residual_records(by_hand(residual, np.tile([1.0, 0, 1], (50, 1)), redundancy, Sensor(100, 100)))["camera"]
    assert no_pitch.rms_x_um is None and no_pitch.rms_x_px == record.rms_x_px


def test_one_image_point_that_is_known_to_be_poor_is_not_the_headline(rng):
    """Of 600 coordinates of 0.02 px one has a stated 26 px, and is off by as much: typical is 0.02 px (to six standard deviations)."""
    sigma = np.full((600, 2), 0.02)
    sigma[7] = 26.0
    residual = sigma * rng.standard_normal(sigma.shape)
    residual[7] = 26.0, -26.0
    covariance = np.stack([sigma[:, 0] ** 2, 0 * sigma[:, 0], sigma[:, 1] ** 2], axis=1)
    record = quality.residual_records(by_hand(residual, covariance, np.ones((600, 2))))["camera"]
    assert record.rms_x_px > 1 and record.rms_y_px > 1
    for axis in "xy":
        assert record.typical[axis].rms_px == pytest.approx(0.02, rel=6 / np.sqrt(1200))
        assert record.typical[axis].rms_um == pytest.approx(3.45 * record.typical[axis].rms_px)


def test_records_read_the_covariance(rng):
    made = by_hand(rng.standard_normal((50, 2)), np.tile([1.0, 0, 1], (50, 1)), np.ones((50, 2)))
    made = replace(made, state=replace(made.state, interior=made.network.cameras[0].with_values(b1=2e-5).values[None]))
    c, b1, k1 = quality.parameter_records(made)
    assert (c.name, c.unit, c.p_zero) == ("c", "mm", None)
    assert c.strongest.with_ == "k1" and c.strongest.r == pytest.approx(-0.3)
    assert b1.p_zero == pytest.approx(2 * special.stdtr(95, -2.0)) and b1.u == pytest.approx(1e-5)
    assert k1.unit == "1/mm²" and k1.p_zero == pytest.approx(1.0)
    assert quality.correlation_records(made)["camera"].matrix[0, 2] == pytest.approx(-0.3)
    first, second = quality.pose_correlations(made, most=2)
    assert (first.a, first.b, first.r) == ("camera:c", "image:Z0", pytest.approx(-0.97))
    assert (second.a, second.b, second.r) == ("camera:b1", "image:rx", pytest.approx(0.5))


def test_group_test_is_the_fall_of_the_sum_of_squares(rng):
    """Joint test of b1, b2: the same F as from an adjustment without them."""
    simulated = simulate(rng, images=10, points=50, interior={"b1": 1e-5, "b2": -1e-5})
    full = adjusted(simulated.network, simulated)
    camera = simulated.network.cameras[0]
    fewer = replace(camera, free=camera.free & ~np.isin(NAMES, ("b1", "b2")))
    truth = replace(simulated.truth, interior=simulated.truth.interior * ~np.isin(NAMES, ("b1", "b2")))
    without = adjusted(replace(simulated.network, cameras=(fewer,)), replace(simulated, truth=truth))
    squares = [part.sigma0**2 * part.dof for part in (without, full)]
    record = next(r for r in quality.group_records(full) if r.group == "affinity")
    assert without.dof - full.dof == 2 and record.dof == (2, full.dof)
    assert record.f == pytest.approx((squares[0] - squares[1]) / 2 / full.sigma0**2, rel=5e-3)
    assert record.p == pytest.approx(stats.f.sf(record.f, 2, full.dof))


@pytest.mark.parametrize("direction", ["image_to_object", "object_to_image"])
def test_vision_names_are_the_linear_part_of_the_projection(rng, direction):
    """Slopes on the axis, from the other projection; uncertainties from 400 draws (24 % would be caught)."""
    simulated = simulate(rng, images=6, points=40, direction=direction)
    found = adjusted(simulated.network, simulated)
    names, covariance = found.interior_covariance()
    places = [NAMES.index(name) for name in names]

    def slopes(interior):
        h = 1e-6
        x, y = distorted(interior, SENSOR, direction, np.array([0.0, h, -h, 0, 0]), np.array([0.0, 0, 0, h, -h]))
        return np.array([(x[1] - x[2]) / (2 * h), (y[3] - y[4]) / (2 * h), (x[3] - x[4]) / (2 * h), x[0], y[0]])

    record = quality.vision_records(found)["camera"]
    values = [value for _, value, _ in record.rows]
    np.testing.assert_allclose(values, slopes(found.state.interior[0]), rtol=1e-7, atol=1e-6)
    drawn = []
    for step in rng.multivariate_normal(np.zeros(len(places)), covariance, 400, method="cholesky"):
        interior = found.state.interior[0].copy()
        interior[places] += step
        drawn.append(slopes(interior))
    ratio = np.var(drawn, axis=0, ddof=1) / np.square([u for _, _, u in record.rows])
    low, high = stats.chi2.ppf([RATE / 20, 1 - RATE / 20], 399) / 399
    assert ((ratio > low) & (ratio < high)).all()


def test_images_one_by_one(rng):
    simulated = simulate(rng, images=6, points=40, per_image=("x_scale",))
    network = replace(measured_again(rng, simulated), time_s=np.arange(6) * 30.0)
    used = np.ones(len(network), bool)
    used[np.flatnonzero(network.image == 2)[:3]] = False
    found = adjusted(network, simulated, used=used)
    records = quality.image_records(found)
    assert all(r.oriented and r.measured == r.n + r.rejected for r in records)
    assert [r.rejected for r in records] == [0, 0, 3, 0, 0, 0] and records[2].n == (network.image == 2).sum() - 3
    assert [r.time_s for r in records] == [0, 30, 60, 90, 120, 150]
    z = [(r.x_scale - true) / r.u_x_scale for r, true in zip(records, simulated.truth.x_scale, strict=True)]
    assert np.abs(z).max() < stats.t.isf(RATE / 12, found.dof) and records[0].x_shift_px is None
    rows = used & (network.image == 1)
    assert records[1].rms_y_px == pytest.approx(np.sqrt(np.mean(found.residual_px[rows, 1] ** 2)))


def test_stat_noisier_x_is_found(rng):
    """x 1.5 times as noisy as y with about 700 degrees of freedom each: p below .001 in all but a millionth of the runs."""
    simulated = simulate(rng, images=10, points=50)
    exact = predicted(simulated.network, simulated.truth)
    x, y = (exact + NOISE_PX * np.array([1.5, 1.0]) * rng.standard_normal(exact.shape)).T
    record = quality.f_test_records(adjusted(replace(simulated.network, x_px=x, y_px=y), simulated))["camera"]
    assert record.p_px < 1e-3 and "x is noisier than y" in record.text
