"""Errors against covariances, over many networks: a short form of ``benchmarks/study_bundle_coverage.py``."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.distances import Pooled, each_point, interior_distance, jointly, points_distance
from calibrate.networks import disturbed, simulate
from pixmetry.calibrate.bundle.bundle import adjust

RATE = 1e-6
NETWORKS = 20


@pytest.mark.parametrize("direction", ["image_to_object", "object_to_image"])
def test_errors_are_as_large_as_the_covariance_says(direction, rng):
    """Over 20 networks of 12 images × 30 points with correlated unknowns: 200 degrees of freedom in interior parameters, 1680 in points.

    Standard deviations wrong by −32 % or +51 % (interior), −13 % or +15 % (points) fail with a probability of 99.9 %. Distances of single
    points, three on average, hang together within a network: their mean over the networks scatters by 0.17 (2000 networks), with a tail
    that passes 4.3 once in 10⁷ runs; standard deviations wrong by 30 % would be caught there.
    """
    interior = points = Pooled(0.0, 0)
    single = []
    for _ in range(NETWORKS):
        simulated = simulate(rng, images=12, points=30, direction=direction, bars=2)
        network, start = jointly(simulated.network), disturbed(rng, simulated, 0.003)
        found = adjust(network, start, a_priori=True)
        interior += interior_distance(found, simulated)
        points += points_distance(found, simulated)
        single.append(each_point(found, simulated).mean())
    assert interior.dof == 10 * NETWORKS and points.dof == 84 * NETWORKS
    assert interior.p > RATE, interior
    assert points.p > RATE, points
    plain = adjust(simulated.network, start, a_priori=True)  # points eliminated: the same blocks
    np.testing.assert_allclose(plain.point_covariance, found.point_covariance, rtol=1e-4, atol=1e-9)
    assert 2.2 < np.mean(single) < 4.3


def test_sigma0_is_that_of_the_noise(rng):
    """Weighted sum of squares against chi-squared with the stated degrees of freedom, 10 000: sigma0 wrong by 6 % fails with 99.9 %."""
    squared = dof = 0
    for _ in range(5):
        simulated = simulate(rng, images=12, points=60, per_image=("x_scale",), cameras=2)
        found = adjust(simulated.network, disturbed(rng, simulated))
        squared, dof = squared + found.cost[-1], dof + found.dof
    assert Pooled(squared, dof).p > RATE


def test_a_wrong_factor_would_be_seen(rng):
    """The test of coverage is not vacuous: standard deviations 30 % too small give a p below the rate."""
    z = rng.standard_normal(84 * NETWORKS)
    assert Pooled(float((z**2).sum()), len(z)).p > RATE > Pooled(float((z**2).sum()) / 0.7**2, len(z)).p
    low, high = Pooled(0.0, len(z)).caught(RATE)
    assert 0.85 < low < 0.9 and 1.1 < high < 1.2
