"""The fixed points of a network together: no alarm where they are right, and by how much they miss it where each by itself passes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import stats

from calibrate.adjusted import adjusted, measured_again
from calibrate.networks import predicted, simulate
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.network import ScaleBars
from pixmetry.calibrate.checks import known_checks
from pixmetry.calibrate.checks.findings import known_findings
from pixmetry.calibrate.checks.known_checks import fixed_record
from pixmetry.calibrate.checks.snooping import remove_gross_errors
from pixmetry.calibrate.records import KnownRecord

RATE = 1e-6
DRAWS = 60


def held(rng: np.random.Generator, fixed: int, bars: int = 0):
    """A network of 40 points of which some are fixed where they truly are."""
    simulated = simulate(rng, images=10, points=40, bars=bars)
    among = np.arange(40)[:, None] < fixed
    xyz, u = np.where(among, simulated.truth.xyz, np.nan), np.where(among, 0.0, np.full((40, 3), np.inf))
    return replace(simulated, network=replace(simulated.network, xyz=xyz, u_xyz=u))


@pytest.mark.parametrize(("fixed", "bars", "redundant"), [(4, 0, 5), (6, 2, 12), (3, 0, 2)])
def test_stat_right_points_give_a_uniform_p(rng, fixed, bars, redundant):
    """60 draws of noise: cdfs that differ by 0.35 somewhere fail it, as with F twice as large with 5 and 12 degrees of freedom."""
    simulated = held(rng, fixed, bars)
    exact, p = predicted(simulated.network, simulated.truth), []
    for _ in range(DRAWS):
        record = fixed_record(adjusted(measured_again(rng, simulated, exact), simulated), adjust)
        assert record.n == fixed and record.dof[0] == redundant
        p.append(record.p)
    assert stats.kstest(p, "uniform").pvalue > RATE


def test_f_is_that_of_the_distances_between_the_points(rng, monkeypatch):
    """Three points are held by three distances, of which the scale takes one: as scale bars without error they say the same."""
    monkeypatch.setattr(known_checks, "remove_gross_errors", partial(remove_gross_errors, false_alarms=RATE))
    simulated = held(rng, 3)
    network = simulated.network
    wrong = network.xyz + np.where(np.isfinite(network.xyz), 0.05 * rng.normal(size=network.xyz.shape), 0.0)
    record = fixed_record(adjusted(replace(network, xyz=wrong), simulated), adjust)
    start, end = np.array([0, 1, 2]), np.array([1, 2, 0])
    bars = ScaleBars(start, end, np.linalg.norm(wrong[end] - wrong[start], axis=1), np.full(3, 1e-6))
    free = replace(network, xyz=np.full_like(wrong, np.nan), u_xyz=np.full_like(wrong, np.inf))
    with_bars, without = (adjusted(n, simulated) for n in (replace(free, bars=bars), free))
    squares = with_bars.sigma0**2 * with_bars.dof - without.sigma0**2 * without.dof
    assert record.dof == (with_bars.dof - without.dof, without.dof) == (2, without.dof)
    assert record.f == pytest.approx(squares / 2 / without.sigma0**2, rel=0.01, abs=0.01)


@pytest.mark.parametrize("factor", [1.0, 50.0])
def test_points_that_are_all_wrong_are_told_with_their_size(rng, factor):
    """Six points with errors of 0.1 mm and of 5 mm; the network knows them to some 0.01 mm. Rejected image points come back."""
    simulated = held(rng, 6)
    error = 0.1 * factor * rng.normal(size=(6, 3))
    xyz = simulated.network.xyz.copy()
    xyz[:6] += error
    network = replace(simulated.network, xyz=xyz)
    adjustment = adjust(network, simulated.truth, used=(network.point > 5) | (rng.random(len(network)) < 0.7), redundancy=True)
    record = fixed_record(adjustment, adjust)
    assert record.p < 1e-9 and record.dof[0] == 11
    # 11 degrees of freedom; weights differ between directions, so within a factor of 4 at the given rate
    low, high = np.sqrt(stats.chi2.ppf([RATE / 2, 1 - RATE / 2], 11) / 11)
    assert low / 1.5 < record.miss / (0.1 * factor) < 1.5 * high
    (finding,) = known_findings(KnownRecord(fixed_points=record), "mm")
    assert finding.level == "warning" and "The 6 fixed points miss the network by about" in finding.text
    assert "known: weighted" in finding.advice


def test_a_field_that_is_fixed_and_a_free_network_are_not_tested(rng):
    for simulated in (simulate(rng, images=6, points=20, known="fixed"), simulate(rng, images=6, points=20)):
        assert fixed_record(adjusted(simulated.network, simulated), adjust) is None
