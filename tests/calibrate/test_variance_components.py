"""Variance components: planted standard deviations of x and y of two cameras come back, whatever the weights were at the start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from calibrate.networks import predicted, simulate
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.checks.variance_components import estimate_components, estimated_sizes, groups, image_sigma0, scaled

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
    """Each within its stated uncertainty; 25 % wrong would be seen.

    Correlated noise is to be multiplied: what is added to known variances is taken for uncorrelated, which would be off by 1.5 u here.
    """
    simulated = simulate(rng, images=20, points=60, cameras=2)
    network = replace(noisy(rng, simulated, SIGMA, correlation), covariance_known=not correlation)
    found = estimate_components(adjust(network, simulated.truth, redundancy=True), adjust)
    for k, (name, record) in enumerate(found.records().items()):
        assert name == network.cameras[k].name
        for axis, letter in enumerate("xy"):
            u = record.axes[letter].u_sigma_px
            assert u < 0.05 * SIGMA[k, axis]  # 0.032 ± 0.002: 480 degrees of freedom
            assert record.axes[letter].sigma_px == pytest.approx(SIGMA[k, axis], abs=Z * u)
    assert found.adjustment.sigma0 == pytest.approx(1.0, abs=0.01)
    assert found.sizes.estimated.all()


def test_the_start_of_the_weights_does_not_matter(rng):
    simulated = simulate(rng, images=12, points=40, cameras=2, bars=0)
    network = noisy(rng, simulated, SIGMA)
    other = scaled(network, np.array([[100.0, 1.0], [0.5, 30.0]]))
    records = [estimate_components(adjust(n, simulated.truth, redundancy=True), adjust).records() for n in (network, other)]
    for name in records[0]:
        for axis, one in records[0][name].axes.items():
            assert one.sigma_px == pytest.approx(records[1][name].axes[axis].sigma_px, rel=1e-2)


def test_identity_factors_are_one_where_the_estimate_has_converged(rng):
    simulated = simulate(rng, images=12, points=40, cameras=2)
    found = estimate_components(adjust(noisy(rng, simulated, SIGMA), simulated.truth, redundancy=True), adjust)
    _, again, dof = estimated_sizes(found.adjustment, found.given_px2, found.group)
    np.testing.assert_allclose(again, 1.0, atol=3e-3)
    observations = np.bincount(simulated.network.camera_of[simulated.network.image])
    assert (dof < observations[:, None]).all()
    assert image_sigma0(found.adjustment)[1] == pytest.approx(dof.sum())


def test_stat_stated_uncertainty_is_that_of_many_estimates(rng):
    """20 networks: the scatter of errors over stated uncertainties; half or one and a half times a right one would be seen."""
    simulated = simulate(rng, images=8, points=50, bars=0)
    z = []
    for _ in range(20):
        network = noisy(rng, simulated, np.array([[0.06, 0.03]]))
        record = estimate_components(adjust(network, simulated.truth, redundancy=True), adjust).records()["camera"]
        z += [(record.axes[a].sigma_px - s) / record.axes[a].u_sigma_px for a, s in (("x", 0.06), ("y", 0.03))]
    scatter = np.sqrt(np.mean(np.square(z)))
    low, high = (np.sqrt(stats.chi2.isf(p, len(z)) / len(z)) for p in (1 - RATE / 2, RATE / 2))
    assert low < scatter < 1.15 * high


def test_the_correlation_of_x_and_y_stays(rng):
    simulated = simulate(rng, images=8, points=25)
    network = noisy(rng, simulated, np.array([[0.06, 0.03]]), correlation=0.5)
    after = scaled(network, np.array([[4.0, 0.25]])).covariance_px2
    np.testing.assert_allclose(after[:, 1] / np.sqrt(after[:, 0] * after[:, 2]), 0.5)
    np.testing.assert_allclose(after[:, [0, 2]], network.covariance_px2[:, [0, 2]] * [4.0, 0.25])


def test_one_size_for_all_and_groups_with_little_redundancy(rng):
    simulated = simulate(rng, images=8, points=25)
    adjustment = adjust(noisy(rng, simulated, np.array([[0.06, 0.03]])), simulated.truth, redundancy=True)
    given, apart = adjustment.network.covariance_px2, np.array([[0, 1]])
    sizes, factor, _ = estimated_sizes(adjustment, given, np.zeros((1, 2), int))
    assert factor[0, 0] == factor[0, 1] == pytest.approx(image_sigma0(adjustment)[0] ** 2)
    np.testing.assert_allclose(sizes.factor * 0.04**2 + sizes.added_px2, factor * 0.04**2)
    few = replace(adjustment, redundancy=adjustment.redundancy * [1.0, 1e-3])
    sizes, factor, _ = estimated_sizes(few, given, apart)
    assert sizes.estimated.tolist() == [[True, False]]
    assert np.isfinite(factor).all() and factor[0, 1] != factor[0, 0]
    assert (estimated_sizes(replace(adjustment, redundancy=adjustment.redundancy * 1e-3), given, apart)[1] == 1).all()


def unequal(rng, simulated, beyond, stated):
    """New noise: what is stated of each image point, and beyond it some that is not; the network says what was stated."""
    network = simulated.network
    noise = np.sqrt(stated**2 + np.square(beyond)) * rng.normal(size=(len(network), 2))
    x, y = (predicted(network, simulated.truth) + noise).T
    return replace(network, x_px=x, y_px=y, covariance_px2=np.column_stack([stated[:, 0] ** 2, 0 * x, stated[:, 1] ** 2]))


def test_stat_what_is_beyond_stated_noise_is_added_to_it(rng):
    """τ within its uncertainty; 30 % wrong would be seen. A factor in its place does not find the standard deviations of good points."""
    simulated = simulate(rng, images=20, points=60)
    network = unequal(rng, simulated, (0.08, 0.05), 10 ** rng.uniform(-2, -1, (len(simulated.network), 2)))
    found = estimate_components(adjust(network, simulated.truth, redundancy=True), adjust)
    record = found.records()["camera"]
    for letter, beyond in zip("xy", (0.08, 0.05), strict=True):
        assert record.axes[letter].u_beyond_px < 0.06 * beyond
        assert record.axes[letter].beyond_px == pytest.approx(beyond, abs=Z * record.axes[letter].u_beyond_px)
        total = record.axes[letter].given_px ** 2 + record.axes[letter].beyond_px ** 2
        assert record.axes[letter].sigma_px ** 2 == pytest.approx(total, rel=5e-3)  # weights and sizes differ by the last step
        assert record.axes[letter].factor == 1
    assert found.adjustment.sigma0 == pytest.approx(1.0, abs=0.01)


def test_stat_added_variances_cover_and_are_worth_more_than_factors(rng):
    """12 networks, 10 parameters each: errors as their covariance says, and smaller than those with multiplied variances.

    A tenth of the image points is stated to be 20 times as good as the others. The sum of squares of normalised errors is χ² but for the
    share that sigma estimates add (5 %); uncertainties 30 % too small would be seen. The other weights make variances of parameters 2.3
    times as large (1.6 to 3.1 in 14 runs of 8 networks); that they won by chance needs 5 standard deviations.
    """
    simulated = simulate(rng, images=10, points=30)
    squares, variances = [], []
    free = simulated.network.cameras[0].free
    for _ in range(12):
        network = unequal(rng, simulated, 0.1, rng.choice([0.005, 0.1], (len(simulated.network), 2), p=[0.1, 0.9]))
        added, factor = (
            estimate_components(adjust(n, simulated.truth, redundancy=True), adjust).adjustment
            for n in (network, replace(network, covariance_known=False))
        )
        covariance = added.interior_covariance()[1]
        off, other = ((a.state.interior - simulated.truth.interior)[0, free] for a in (added, factor))
        squares.append(off @ np.linalg.solve(covariance, off))
        variances.append(other @ np.linalg.solve(covariance, other))
    dof = 12 * free.sum()
    assert 0.95 * stats.chi2.isf(1 - RATE / 2, dof) < np.sum(squares) < 1.05 * stats.chi2.isf(RATE / 2, dof)
    assert np.sum(variances) > np.sum(squares)


def test_residuals_smaller_than_stated_and_guessed_covariances_are_multiplied(rng):
    """A factor of x and y together has a standard uncertainty of 6 % (600 degrees of freedom); where they differ by chance, of 8 %."""
    simulated = simulate(rng, images=10, points=40)
    network = noisy(rng, simulated, np.array([[0.02, 0.02]]))
    record = estimate_components(adjust(network, simulated.truth, redundancy=True), adjust).records()["camera"]
    assert record.x.factor == pytest.approx(0.25, rel=0.35) and record.x.beyond_px is None
    guess = replace(noisy(rng, simulated, np.array([[0.08, 0.08]])), covariance_known=False)
    record = estimate_components(adjust(guess, simulated.truth, redundancy=True), adjust).records()["camera"]
    assert record.x.factor == pytest.approx(4, rel=0.35) and record.x.beyond_px is None


def test_x_and_y_have_one_size_unless_the_images_agree_that_they_differ(rng):
    """Errors that are common to an image, in one image large in x and in the next large in y; or always larger in y."""
    simulated = simulate(rng, images=8, points=40)
    network = simulated.network
    truth = predicted(network, simulated.truth)

    def grouped(sigma):
        x, y = (truth + sigma[network.image] * rng.normal(size=truth.shape)).T
        adjustment = adjust(replace(network, x_px=x, y_px=y), simulated.truth, redundancy=True)
        return groups(adjustment, network.covariance_px2).ravel().tolist()

    by_image = np.tile([[0.2, 0.05], [0.1, 0.1], [0.05, 0.1], [0.05, 0.15]], (2, 1))
    assert grouped(by_image) == [0, 0]
    assert grouped(np.tile([[0.05, 0.1]], (8, 1))) == [0, 1]
