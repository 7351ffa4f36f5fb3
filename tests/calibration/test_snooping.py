"""Data snooping and tests of bars and control points: planted errors are found and sized, good ones stay, the level is as stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from calibration.networks import disturbed, simulate
from pixmetry.calibration.bundle import adjust
from pixmetry.calibration.known_residuals import bar_residuals, contradicted, control_residuals, group_record
from pixmetry.calibration.network import ScaleBars
from pixmetry.calibration.snooping import critical_values, gross_error_records, remove_gross_errors, statistics
from pixmetry.calibration.variance_components import image_sigma0

RATE = 1e-6  # false failures of each statistical test
Z = stats.norm.isf(RATE / 2)


def test_critical_values_are_those_of_beta_and_f():
    for alpha in (0.05, 1e-3, 1e-7):
        for dof in (5, 40, 20000):
            inside, outside = critical_values(alpha, dof)
            assert inside == pytest.approx(dof * stats.beta.isf(alpha, 1, dof / 2 - 1), rel=1e-6)
            assert outside == pytest.approx(2 * stats.f.isf(alpha, 2, dof), rel=1e-6)
    assert critical_values(0.01, 2)[0] == np.inf


def test_limit_statistic_of_few_observations_has_the_stated_level(rng):
    """A straight linear model, 12 pairs and 16 unknowns, simulated 40000 times; an alarm rate of 5.6 % for 5 % would be seen."""
    alpha, trials, pairs = 0.05, 40000, 12
    design = rng.normal(size=(2 * pairs, 16))
    q = np.eye(2 * pairs) - design @ np.linalg.solve(design.T @ design, design.T)
    v = rng.normal(size=(trials, 2 * pairs)) @ q
    s2 = (v**2).sum(axis=1) / 8
    t = np.einsum("ti,ij,tj->t", v[:, :2], np.linalg.inv(q[:2, :2]), v[:, :2]) / s2
    count = (t > critical_values(alpha, 8)[0]).sum()
    assert abs(count - alpha * trials) < Z * np.sqrt(alpha * (1 - alpha) * trials)


def test_stat_good_points_are_alarms_as_often_as_stated(rng):
    """8 networks of 960 image points at 2 %; the tests of neighbours hang together by their redundancy only: 10 % of the variance."""
    alpha, alarms, total = 0.02, 0, 0
    for _ in range(8):
        simulated = simulate(rng, images=16, points=60)
        adjustment = adjust(simulated.network, simulated.truth, redundancy=True)
        statistic, _ = statistics(adjustment)
        alarms += int((statistic > critical_values(alpha, adjustment.dof)[0]).sum())
        total += len(statistic)
    assert abs(alarms - alpha * total) < Z * np.sqrt(1.1 * alpha * (1 - alpha) * total)


def unlisted(records, adjustment) -> np.ndarray:
    """Points whose rays are out without a record, one entry a ray."""
    network = adjustment.network
    assert all(np.isfinite([v for v in r.values() if isinstance(v, float)]).all() and r["statistic"] > r["critical"] for r in records)
    listed = {(r["image"], r["point"]) for r in records}
    names = zip((network.images[i] for i in network.image), (network.points[k] for k in network.point), strict=True)
    has_record = np.array([name in listed for name in names])
    assert not (has_record & adjustment.used).any()
    return network.point[~adjustment.used & ~has_record]


def assert_every_ray_left_out_is_listed(records, adjustment) -> None:
    """But for the last one of a point that has lost the others: nothing speaks against it."""
    points = unlisted(records, adjustment)
    assert len(set(points.tolist())) == len(points) and np.isnan(adjustment.state.xyz[points]).all()


@pytest.mark.parametrize("gross_px", [5.0, 20.0, 500.0])
@pytest.mark.parametrize("kind", [{}, {"known": "fixed", "field": "plane"}, {"images": 30, "points": 120, "visibility": 0.3}])
def test_recovers_gross_errors_and_their_sizes(rng, gross_px, kind):
    """1 % of 5 px and more in noise of 0.04 px: all are found where an error shows. Of 0.01 false alarms expected, 3 come once in 10⁶ runs.

    The estimated sizes are judged by χ² of their stated covariance, 10 % being left for what they share.
    """
    simulated = simulate(rng, **{"images": 16, "points": 60, **kind})
    n = len(simulated.network)
    planted, angle = np.zeros((n, 2)), rng.uniform(0, 2 * np.pi, n)
    hit = rng.choice(n, n // 100, replace=False)
    planted[hit] = gross_px * np.column_stack([np.cos(angle), np.sin(angle)])[hit]
    network = replace(simulated.network, x_px=simulated.network.x_px + planted[:, 0], y_px=simulated.network.y_px + planted[:, 1])
    snooped = remove_gross_errors(network, disturbed(rng, simulated, 0.005), adjust, false_alarms=0.01)
    adjustment = snooped.adjustment
    assert_every_ray_left_out_is_listed(gross_error_records(adjustment, snooped.alpha, snooped.rejected), adjustment)
    statistic, error = statistics(adjustment)
    determined = np.isfinite(statistic)  # a point on one ray is not
    out, gross = ~adjustment.used & determined, planted.any(axis=1)
    hidden = adjustment.used & (np.nan_to_num(adjustment.redundancy).min(axis=1) < 0.05)
    assert (gross & determined & ~out & ~hidden).sum() == 0
    assert (out & ~gross).sum() < 3
    assert (gross & out).sum() > 0.5 * len(hit)
    found = np.flatnonzero(out & gross)
    off = error[found] - planted[found]
    spread = adjustment.residual_covariance_px2[found][:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    distance = np.einsum("ni,nij,nj->", off, np.linalg.inv(spread), off)
    assert 0.9 * stats.chi2.isf(1 - RATE / 2, 2 * len(found)) < distance < 1.1 * stats.chi2.isf(RATE / 2, 2 * len(found))


@pytest.mark.parametrize(("loss", "off_px"), [("huber", 50.0), ("none", 10.0)])
def test_rays_of_points_that_nothing_is_left_of_are_listed(rng, loss, off_px):
    """Points of two rays, one of them off along no epipolar line in particular: at least one of 20 such pairs is seen.

    Plain least squares with errors of 50 px in 3 % of the rays has no minimum near the truth: one network in 30 comes to none in 64 steps.
    """
    simulated = simulate(rng, images=14, points=60)
    network = simulated.network
    two = np.concatenate([rng.permutation(np.flatnonzero(network.point == k))[:2] for k in range(20)])
    kept = np.sort(np.append(two, np.flatnonzero(network.point >= 20)))
    x, y = network.x_px.copy(), network.y_px.copy()
    x[two[::2]] += off_px
    y[two[::2]] -= off_px
    rows = {"x_px": x, "y_px": y, **{n: getattr(network, n) for n in ("image", "point", "covariance_px2")}}
    network = replace(network, bars=ScaleBars.none(), **{n: values[kept] for n, values in rows.items()})
    snooped = remove_gross_errors(network, simulated.truth, adjust, loss=loss)
    records = gross_error_records(snooped.adjustment, snooped.alpha, snooped.rejected)
    assert_every_ray_left_out_is_listed(records, snooped.adjustment)
    lost = {network.points[k] for k in np.flatnonzero(np.isnan(snooped.adjustment.state.xyz).any(axis=1))}
    assert lost and lost == {r["point"] for r in records if r["point"] in {network.points[k] for k in range(20)}}
    assert len(gross_error_records(snooped.adjustment, snooped.alpha)) < len(records)  # that is all that is known of them


def test_exchanged_names_are_called_so(rng):
    """Two names of an image exchanged; a third point there is off by itself."""
    simulated = simulate(rng, images=10, points=40)
    network = simulated.network
    a, b, c = rng.permutation(np.flatnonzero(network.image == 3))[:3]
    point, x = network.point.copy(), network.x_px.copy()
    point[[a, b]] = point[[b, a]]
    x[c] += 300.0
    network = replace(network, point=point, x_px=x)
    snooped = remove_gross_errors(network, simulated.truth, adjust)
    said = {r["point"]: r["swapped_with"] for r in gross_error_records(snooped.adjustment, snooped.alpha, snooped.rejected)}
    first, second, alone = (network.points[point[i]] for i in (a, b, c))
    assert said[first] == second and said[second] == first and said[alone] is None


def test_estimated_error_is_that_of_prediction_without_the_point(rng):
    """R⁻¹ v of a point that takes part is its residual where it does not, for a small error, in which the network is linear."""
    simulated = simulate(rng, images=8, points=30, noise_px=0.02)
    adjustment = adjust(simulated.network, simulated.truth, redundancy=True)
    statistic, error = statistics(adjustment)
    for i in rng.choice(len(simulated.network), 4, replace=False):
        used = np.ones(len(simulated.network), bool)
        used[i] = False
        without = adjust(simulated.network, simulated.truth, used=used, redundancy=True)
        np.testing.assert_allclose(error[i], without.residual_px[i], atol=5e-5)
        # the same test before and after: T/(f − T) is the external statistic over f − 2
        after, predicted_error = statistics(without)
        f = adjustment.dof
        assert after[i] == pytest.approx(statistic[i] * (f - 2) / (f - statistic[i]), rel=2e-3)
        np.testing.assert_array_equal(predicted_error[i], without.residual_px[i])


def test_nothing_is_tested_where_there_is_no_redundancy(rng):
    simulated = simulate(rng, images=8, points=30)
    adjustment = adjust(simulated.network, simulated.truth, redundancy=True)
    flat = adjustment.residual_covariance_px2.copy()
    flat[0] = [1e-9 * 0.04**2, 0.0, 0.5 * 0.04**2]
    residual = adjustment.residual_px.copy()
    residual[0] = [1.0, 0.02]  # an x without redundancy, whatever it is
    statistic, error = statistics(replace(adjustment, residual_covariance_px2=flat, residual_px=residual))
    assert statistic[0] == pytest.approx(0.02**2 / (0.5 * 0.04**2) / adjustment.sigma0**2)
    np.testing.assert_allclose(error[0], [0.0, 0.04], atol=1e-12)


def test_good_points_that_were_out_come_back(rng):
    simulated = simulate(rng, images=10, points=40)
    used = rng.random(len(simulated.network)) > 0.1
    snooped = remove_gross_errors(simulated.network, simulated.truth, adjust, used=used, loss="none", false_alarms=0.01)
    assert (~snooped.adjustment.used).sum() < 3  # 0.01 expected


def test_records_name_the_worst_first(rng):
    simulated = simulate(rng, images=10, points=40)
    x = simulated.network.x_px.copy()
    x[[7, 111]] += [3.0, -8.0]
    network = replace(simulated.network, x_px=x)
    snooped = remove_gross_errors(network, simulated.truth, adjust)
    records = gross_error_records(snooped.adjustment, snooped.alpha)
    assert [(r["image"], r["point"]) for r in records[:2]] == [
        (network.images[network.image[i]], network.points[network.point[i]]) for i in (111, 7)
    ]
    assert records[0]["error_x_px"] == pytest.approx(-8.0, abs=8 * 0.05) and abs(records[0]["error_y_px"]) < 8 * 0.05
    assert records[0]["statistic"] > records[0]["critical"]


# --- bars and control points


def with_bars(rng, simulated, wrong=0.0, u=0.01, bars=4):
    """Bars between far points, the first of them wrong."""
    pairs = rng.permutation(len(simulated.network.points))[: 2 * bars].reshape(-1, 2)
    length = np.linalg.norm(simulated.truth.xyz[pairs[:, 0]] - simulated.truth.xyz[pairs[:, 1]], axis=1) + u * rng.normal(size=bars)
    length[0] += wrong
    return replace(simulated.network, bars=ScaleBars(pairs[:, 0], pairs[:, 1], length, np.full(bars, u)))


def test_a_wrong_bar_is_named_and_sized(rng):
    """1 mm on a bar of 0.01 mm; the others, dragged along, are not named (0.01 of them expected, 3 come by chance once in 10⁶ runs)."""
    simulated = simulate(rng, images=12, points=50, bars=0)
    network = with_bars(rng, simulated, wrong=1.0)
    adjustment = adjust(network, simulated.truth, redundancy=True)
    known = bar_residuals(adjustment)
    gross = contradicted(known, *image_sigma0(adjustment))
    assert gross[0]["name"] == known.name[0] and len(gross) < 3
    assert gross[0]["error"] == pytest.approx(1.0, abs=Z * 0.02 * np.sqrt(2))
    right = adjust(with_bars(rng, simulated), simulated.truth, redundancy=True)
    assert len(contradicted(bar_residuals(right), *image_sigma0(right))) < 3


def test_estimated_error_of_a_bar_is_that_of_prediction_without_it(rng):
    simulated = simulate(rng, images=10, points=40, bars=0)
    network = with_bars(rng, simulated, wrong=0.03)
    known = bar_residuals(adjust(network, simulated.truth, redundancy=True))
    b = network.bars
    without = adjust(replace(network, bars=ScaleBars(b.start[1:], b.end[1:], b.length[1:], b.u[1:])), simulated.truth)
    length = np.linalg.norm(without.state.xyz[b.end[0]] - without.state.xyz[b.start[0]])
    assert known.residual[0] / known.redundancy[0] == pytest.approx(b.length[0] - length, abs=2e-5)
    assert 0 < known.redundancy.sum() < len(b) - 1  # one of them makes the scale


def test_one_bar_cannot_be_tested(rng):
    simulated = simulate(rng, images=10, points=40, bars=0)
    adjustment = adjust(with_bars(rng, simulated, wrong=5.0, bars=1), simulated.truth, redundancy=True)
    known = bar_residuals(adjustment)
    assert known.redundancy[0] < 1e-6
    assert contradicted(known, *image_sigma0(adjustment)) == [] and group_record(adjustment, known) is None
    none = bar_residuals(adjust(replace(simulated.network, bars=ScaleBars.none()), simulated.truth, redundancy=True))
    assert contradicted(none, *image_sigma0(adjustment)) == []


def test_a_wrong_control_point_is_named(rng):
    simulated = simulate(rng, images=12, points=50, bars=0)
    u = np.full((50, 3), np.inf)
    u[:10] = 0.05
    xyz = np.where(np.isfinite(u), simulated.truth.xyz + 0.05 * rng.normal(size=u.shape), np.nan)
    network = replace(simulated.network, xyz=xyz, u_xyz=u)
    adjustment = adjust(network, simulated.truth, redundancy=True)
    known = control_residuals(adjustment)
    assert len(known) == 30 and len(contradicted(known, *image_sigma0(adjustment))) < 3
    group = group_record(adjustment, known)
    assert 15 < group["dof"] < 23  # 30 coordinates less 7 of the datum
    low, high = (stats.chi2.isf(p, group["dof"]) / group["dof"] for p in (1 - RATE / 2, RATE / 2))
    assert 0.9 * low < group["factor"] < 1.1 * high
    xyz[3, 1] += 2.0
    adjustment = adjust(replace(network, xyz=xyz), simulated.truth, redundancy=True)
    gross = contradicted(control_residuals(adjustment), *image_sigma0(adjustment))
    assert gross[0]["name"] == f"{network.points[3]} Y"
    assert gross[0]["error"] == pytest.approx(2.0, abs=0.5)
