"""Variance components: planted standard deviations of x and y of two cameras come back, whatever the weights were at the start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from calibration.networks import predicted, simulate
from pixmetry.calibration.bundle import adjust
from pixmetry.calibration.variance_components import estimate_components, factors, image_sigma0, scaled

RATE = 1e-6  # false failures of each statistical test
Z = stats.norm.isf(RATE / 2)
SIGMA = np.array([[0.06, 0.03], [0.02, 0.04]])  # px: x and y of two cameras


def noisy(rng, simulated, sigma, correlation=0.0):
    """The network with new noise of these standard deviations, said to be 0.04 px."""
    network = simulated.network
    s = sigma[network.camera_of[network.image]]
    n = rng.normal(size=(len(network), 2))
    n[:, 1] = correlation * n[:, 0] + np.sqrt(1 - correlation**2) * n[:, 1]
    x, y = (predicted(network, simulated.truth) + s * n).T
    c = 0.04**2 * np.array([1.0, correlation, 1.0])
    return replace(network, x_px=x, y_px=y, covariance_px2=np.tile(c, (len(network), 1)))


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_stat_recovers_planted_standard_deviations(rng, correlation):
    """Each within its stated uncertainty; 22 % wrong would be seen."""
    simulated = simulate(rng, images=20, points=60, cameras=2)
    network = noisy(rng, simulated, SIGMA, correlation)
    found = estimate_components(adjust(network, simulated.truth, redundancy=True), adjust)
    for k, (name, record) in enumerate(found.records().items()):
        assert name == network.cameras[k].name
        for axis, letter in enumerate("xy"):
            u = record[f"u_sigma_{letter}_px"]
            assert u < 0.04 * SIGMA[k, axis]
            assert record[f"sigma_{letter}_px"] == pytest.approx(SIGMA[k, axis], abs=Z * u)
    assert found.adjustment.sigma0 == pytest.approx(1.0, abs=0.01)
    assert found.estimated.all()


def test_the_start_of_the_weights_does_not_matter(rng):
    simulated = simulate(rng, images=12, points=40, cameras=2, bars=0)
    network = noisy(rng, simulated, SIGMA)
    other = scaled(network, np.array([[100.0, 1.0], [0.5, 30.0]]))
    records = [estimate_components(adjust(n, simulated.truth, redundancy=True), adjust).records() for n in (network, other)]
    for name in records[0]:
        for key in ("sigma_x_px", "sigma_y_px"):
            assert records[0][name][key] == pytest.approx(records[1][name][key], rel=2e-3)


def test_identity_factors_are_one_where_the_estimate_has_converged(rng):
    simulated = simulate(rng, images=12, points=40, cameras=2)
    found = estimate_components(adjust(noisy(rng, simulated, SIGMA), simulated.truth, redundancy=True), adjust)
    again, dof, _ = factors(found.adjustment)
    np.testing.assert_allclose(again, 1.0, atol=2e-3)
    observations = np.bincount(simulated.network.camera_of[simulated.network.image])
    assert (dof < observations[:, None]).all()
    assert image_sigma0(found.adjustment)[1] == pytest.approx(dof.sum())


def test_stat_stated_uncertainty_is_that_of_many_estimates(rng):
    """20 networks: the scatter of errors over stated uncertainties; half or one and a half times a right one would be seen."""
    simulated = simulate(rng, images=8, points=25, bars=0)
    z = []
    for _ in range(20):
        network = noisy(rng, simulated, np.array([[0.06, 0.03]]))
        record = estimate_components(adjust(network, simulated.truth, redundancy=True), adjust).records()["camera"]
        z += [(record[f"sigma_{a}_px"] - s) / record[f"u_sigma_{a}_px"] for a, s in (("x", 0.06), ("y", 0.03))]
    scatter = np.sqrt(np.mean(np.square(z)))
    low, high = (np.sqrt(stats.chi2.isf(p, len(z)) / len(z)) for p in (1 - RATE / 2, RATE / 2))
    assert low < scatter < 1.15 * high


def test_the_correlation_of_x_and_y_stays(rng):
    simulated = simulate(rng, images=8, points=25)
    network = noisy(rng, simulated, np.array([[0.06, 0.03]]), correlation=0.5)
    after = scaled(network, np.array([[4.0, 0.25]])).covariance_px2
    np.testing.assert_allclose(after[:, 1] / np.sqrt(after[:, 0] * after[:, 2]), 0.5)
    np.testing.assert_allclose(after[:, [0, 2]], network.covariance_px2[:, [0, 2]] * [4.0, 0.25])


def test_one_factor_for_all_and_groups_with_little_redundancy(rng):
    simulated = simulate(rng, images=8, points=25)
    adjustment = adjust(noisy(rng, simulated, np.array([[0.06, 0.03]])), simulated.truth, redundancy=True)
    factor, _, estimated = factors(adjustment, by_axis=False)
    assert factor[0, 0] == factor[0, 1] == pytest.approx(image_sigma0(adjustment)[0] ** 2)
    assert not estimated.any()
    few = replace(adjustment, redundancy=adjustment.redundancy * [1.0, 1e-3])
    factor, _, estimated = factors(few)
    assert estimated.tolist() == [[True, False]]
    assert np.isfinite(factor).all() and factor[0, 1] != factor[0, 0]
    assert (factors(replace(adjustment, redundancy=adjustment.redundancy * 1e-3))[0] == 1).all()
