"""Data snooping and tests of bars and control points: planted errors are found and sized, good ones stay, the level is as stated."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from calibrate.networks import disturbed, image_of, simulate
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.network import ScaleBars
from pixmetry.calibrate.checks.few_rays import mend
from pixmetry.calibrate.checks.known_residuals import bar_residuals, contradicted, control_residuals, group_record
from pixmetry.calibrate.checks.snooping import critical_values, gross_error_records, remove_gross_errors, statistics
from pixmetry.calibrate.checks.variance_components import image_sigma0

RATE = 1e-6  # false failures of each statistical test
Z = stats.norm.isf(RATE / 2)


def test_critical_values_are_those_of_beta_and_f():
    for alpha in (0.05, 1e-3, 1e-7):
        for dof in (5, 40, 20000):
            inside, outside = critical_values(alpha, dof)
            assert inside == pytest.approx(dof * stats.beta.isf(alpha, 1, dof / 2 - 1), rel=1e-6)
            assert outside == pytest.approx(2 * stats.f.isf(alpha, 2, dof), rel=1e-6)
    assert critical_values(0.01, 2)[0] == np.inf
    assert critical_values(0.01, 0) == (np.inf, np.inf)


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
    assert all(np.isfinite([v for v in vars(r).values() if isinstance(v, float)]).all() and r.statistic > r.critical for r in records)
    listed = {(r.image, r.point) for r in records}
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
    assert lost and lost == {r.point for r in records if r.point in {network.points[k] for k in range(20)}}
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
    said = {r.point: r.swapped_with for r in gross_error_records(snooped.adjustment, snooped.alpha, snooped.rejected)}
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
    assert [(r.image, r.point) for r in records[:2]] == [
        (network.images[network.image[i]], network.points[network.point[i]]) for i in (111, 7)
    ]
    assert records[0].error_x_px == pytest.approx(-8.0, abs=8 * 0.05) and abs(records[0].error_y_px) < 8 * 0.05
    assert records[0].statistic > records[0].critical


# --- points of few rays


CONTROL = 40  # points, fixed and in many images, so that poses do not hang on the others


def of_few_rays(rng, points=240):
    """A network most of whose points have two, three or four rays, and which rows are off: one by 5 to 100 px in a third of the points of
    three or four."""
    simulated = simulate(rng, images=24, points=CONTROL + points, visibility=0.5, bars=0)
    network, truth = simulated.network, simulated.truth
    few = [rng.permutation(np.flatnonzero(network.point == k))[: rng.choice([2, 3, 4])] for k in range(CONTROL, CONTROL + points)]
    kept = np.sort(np.concatenate([np.flatnonzero(network.point < CONTROL), *few]))
    rows = {name: getattr(network, name)[kept] for name in ("x_px", "y_px", "image", "point", "covariance_px2")}
    control = np.arange(CONTROL + points)[:, None] < CONTROL
    error = np.zeros((len(kept), 2))
    for k in range(CONTROL, CONTROL + points):
        mine = np.flatnonzero(rows["point"] == k)
        if len(mine) > 2 and rng.random() < 1 / 3:
            size, angle = 5 * 20 ** rng.random(), rng.uniform(0, 2 * np.pi)
            error[rng.choice(mine)] = size * np.cos(angle), size * np.sin(angle)
    rows["x_px"], rows["y_px"] = rows["x_px"] + error[:, 0], rows["y_px"] + error[:, 1]
    known = {"xyz": np.where(control, truth.xyz, np.nan), "u_xyz": np.where(control, 0.0, np.inf) * np.ones(3)}
    return replace(simulated, network=replace(network, **rows, **known)), error


def seen(simulated, row, xyz):
    network, truth = simulated.network, simulated.truth
    i, k = network.image[row], network.camera_of[network.image[row]]
    x, y, _ = image_of(network.cameras[k], truth.interior[k], truth.rotation[i], truth.position[i], xyz[None])
    return np.array([x[0], y[0]])


def across(simulated, good, bad, error, noise_px=0.04):
    """By how many standard deviations an error takes a ray out of the plane that it shares with another ray of its point."""
    network, truth = simulated.network, simulated.truth
    xyz, (a, c) = truth.xyz[network.point[bad]], truth.position[network.image[[good, bad]]]
    up = np.cross(xyz - a, c - a)
    up /= np.linalg.norm(up)
    off = []
    for row, along in ((bad, xyz - a), (good, xyz - c)):
        line, step = (seen(simulated, row, xyz + 1e-5 * v) - seen(simulated, row, xyz) for v in (along, np.linalg.norm(along) * up))
        line = np.array([-line[1], line[0]]) / np.linalg.norm(line)
        off.append((line @ step, line))
    (to_bad, line), (to_good, _) = off
    return abs(line @ error) / noise_px / np.hypot(1.0, to_bad / to_good)


def test_stat_good_rays_of_points_with_one_bad_ray_come_back(rng):
    """One of three or four rays off by 5 px and more in noise of 0.04 px. Where a bad ray leaves the plane of each good one (of four rays,
    of all but one) by so much that it cannot be taken for good, exactly the good ones take part; the coordinates have the scatter stated.

    Of 0.01 wrong choices and 0.01 false alarms expected, 3 come once in 10⁶ runs; without the choice of rays about 10 points are not right.
    """
    simulated, error = of_few_rays(rng)
    network, gross = simulated.network, error.any(axis=1)
    snooped = remove_gross_errors(network, disturbed(rng, simulated, 0.005), adjust)
    adjustment, records = snooped.adjustment, gross_error_records(snooped.adjustment, snooped.alpha, snooped.rejected)
    used, state = adjustment.used, adjustment.state
    surely = 1.2 * (np.sqrt(critical_values(snooped.alpha, adjustment.dof)[1]) + Z)
    listed = {(r.image, r.point) for r in records}
    wrong = unique = 0
    for bad in np.flatnonzero(gross):
        rays = np.flatnonzero(network.point == network.point[bad])
        good = rays[rays != bad]
        distance = np.sort([across(simulated, i, bad, error[bad]) for i in good])
        if distance[len(good) - 2] > surely * np.sqrt(len(good) - 1):
            unique += 1
            names = [(network.images[network.image[i]], network.points[network.point[i]]) in listed for i in rays]
            wrong += not (used[good].all() and not used[bad] and names == list(rays == bad))
    assert unique > 25 and wrong < 3
    assert (used & gross).sum() < 3
    untouched = ~np.isin(network.point, network.point[gross]) & (np.bincount(network.point)[network.point] > 1)
    assert (~used & untouched).sum() < 3
    free = np.isin(np.arange(len(network.points)), network.point[gross & used], invert=True) & np.isinf(network.u_xyz[:, 0])
    free &= np.isfinite(state.xyz[:, 0])
    off = (state.xyz - simulated.truth.xyz)[free]
    distance = np.einsum("ni,nij,nj->", off, np.linalg.inv(adjustment.point_covariance[free]), off)
    dof = 3 * free.sum()
    assert 0.9 * stats.chi2.isf(1 - RATE / 2, dof) < distance < 1.1 * stats.chi2.isf(RATE / 2, dof)


def one_point_of_three_rays(rng, along_px, across_px):
    """A network with a point that three images see without noise; the third ray is off along the line on which the first one lies in its
    image, and across it. The rows of the three."""
    simulated = simulate(rng, images=12, points=60, bars=0)
    network, k = simulated.network, 59
    away = simulated.truth.xyz[k] - simulated.truth.position
    away /= np.linalg.norm(away, axis=1)[:, None]
    widest = max(combinations(range(12), 3), key=lambda images: abs(np.linalg.det(away[list(images)])))
    others = np.flatnonzero(network.point != k)
    mine = rng.permutation(np.flatnonzero((network.point == k) & np.isin(network.image, widest)))
    kept = np.append(others, mine)
    rows = {name: getattr(network, name)[kept] for name in ("x_px", "y_px", "image", "point", "covariance_px2")}
    simulated = replace(simulated, network=replace(network, **rows))
    network, three = simulated.network, len(others) + np.arange(3)
    place = np.array([seen(simulated, i, simulated.truth.xyz[k]) for i in three])
    line = seen(simulated, three[2], simulated.truth.xyz[k] + 1e-3 * away[network.image[three[0]]]) - place[2]
    nearer = simulated.truth.xyz[k] + 1e-3 * along_px / np.linalg.norm(line) * away[network.image[three[0]]]
    place[2] = seen(simulated, three[2], nearer) + across_px * np.array([-line[1], line[0]]) / np.linalg.norm(line)
    x, y = network.x_px.copy(), network.y_px.copy()
    x[three], y[three] = place.T
    return replace(simulated, network=replace(network, x_px=x, y_px=y)), three


def search_from(simulated, rows, there):
    """Search, with some of these rows; which of them take part, and the images where the point is listed."""
    used = np.ones(len(simulated.network), bool)
    used[rows] = there
    snooped = remove_gross_errors(simulated.network, simulated.truth, adjust, used=used, loss="none")
    adjustment, name = snooped.adjustment, simulated.network.points[simulated.network.point[rows[0]]]
    again = remove_gross_errors(simulated.network, adjustment.state, adjust, used=adjustment.used, loss="none", rejected=snooped.rejected)
    np.testing.assert_array_equal(again.adjustment.used, adjustment.used)
    records = [r for r in gross_error_records(again.adjustment, again.alpha, again.rejected) if r.point == name]
    assert all(r.statistic > r.critical for r in records)
    return adjustment.used[rows].tolist(), {r.image for r in records}


@pytest.mark.parametrize("there", [[1, 1, 1], [1, 0, 1], [1, 1, 0], [1, 0, 0], [0, 0, 0]])
def test_where_it_cannot_be_told_which_rays_are_right_none_takes_part(rng, there):
    """The third ray agrees with the first one as well as the second does. These two contradict each other, and are listed; whatever took
    part to begin with."""
    simulated, rows = one_point_of_three_rays(rng, 30.0, 0.0)
    used, listed = search_from(simulated, rows, there)
    assert used == [False, False, False]
    assert listed == {simulated.network.images[i] for i in simulated.network.image[rows[1:]]}


@pytest.mark.parametrize("there", [[1, 1, 1], [1, 0, 1], [0, 1, 1], [0, 0, 1], [0, 0, 0]])
def test_the_pair_that_agrees_is_found_from_any_start(rng, there):
    """The third ray 3 px off the line of the first one, 50 standard deviations."""
    simulated, rows = one_point_of_three_rays(rng, 30.0, 3.0)
    used, listed = search_from(simulated, rows, there)
    assert used == [True, True, False]
    assert listed == {simulated.network.images[simulated.network.image[rows[2]]]}


def test_two_rays_that_agree_come_back(rng):
    simulated, rows = one_point_of_three_rays(rng, 0.0, 500.0)
    network, first = simulated.network, np.arange(len(simulated.network)) != rows[2]
    names = ("x_px", "y_px", "image", "point", "covariance_px2")
    simulated = replace(simulated, network=replace(network, **{n: getattr(network, n)[first] for n in names}))
    assert search_from(simulated, rows[:2], [1, 0]) == ([True, True], set())


def test_what_a_ray_is_rejected_for_is_its_test_in_the_adjustment_without_it(rng):
    """Statistic and residual predicted from the rays that agree, with poses as they stand, and those of the adjustment that follows: an
    error of 30 px is linear to 1 %, and the poses' uncertainty lowers the statistic a little."""
    simulated, rows = one_point_of_three_rays(rng, 30.0, 3.0)
    used = np.ones(len(simulated.network), bool)
    used[rows[0]] = False
    snooped = remove_gross_errors(simulated.network, simulated.truth, adjust, used=used, loss="none")
    statistic, error = statistics(snooped.adjustment)
    assert snooped.rejected.statistic[rows[2]] == pytest.approx(statistic[rows[2]], rel=0.3)
    np.testing.assert_allclose(snooped.rejected.residual_px[rows[2]], error[rows[2]], rtol=0.03, atol=0.3)


def true_poses(rng, rays, points=1500):
    """An adjustment whose state is the truth, of points with so many rays each, as a table of rows."""
    simulated = simulate(rng, images=8, points=points, bars=0)
    network = simulated.network
    table = np.array([rng.permutation(np.flatnonzero(network.point == k))[:rays] for k in range(points)])
    flat = table.ravel()
    rows = {name: getattr(network, name)[flat] for name in ("x_px", "y_px", "image", "point", "covariance_px2")}
    simulated = replace(simulated, network=replace(network, **rows))
    found = adjust(simulated.network, simulated.truth, covariance=False)
    return simulated, replace(found, state=simulated.truth, dof=10**9), np.arange(len(flat)).reshape(-1, rays)


def chosen(found, table, critical, allowed=0.01):
    """Which rays of each point take part, where none did."""
    mended = mend(found, np.zeros(table.size, bool), np.ones(len(table), bool), 1.0, critical, allowed)
    return mended.used[table]


def test_stat_rays_agree_as_often_as_stated(rng):
    """χ² of one degree of freedom of 1500 pairs: a variance wrong by a sixth would be seen. Of three good rays, each is rejected with the
    probability of two degrees of freedom: at least one of them is with more than that, and with less than three times that."""
    _, found, table = true_poses(rng, 2)
    used, p = chosen(found, table, 2.0), stats.chi2.cdf(2.0, 1)
    np.testing.assert_array_equal(used[:, 0], used[:, 1])
    assert abs(used[:, 0].sum() - p * len(table)) < Z * np.sqrt(p * (1 - p) * len(table))
    _, found, table = true_poses(rng, 3)
    fewer, one = (~chosen(found, table, 4.0).all(axis=1)).sum(), np.exp(-2.0)
    assert stats.binom.cdf(fewer, len(table), one) > RATE and stats.binom.sf(fewer - 1, len(table), 3 * one) > RATE


def test_stat_choices_are_wrong_as_often_as_stated(rng):
    """2000 points of three rays, the third 50 px along the line of the first, and evenly up to 5 standard deviations across it. Of all
    that are decided 54 may be wrong, and about 45 are. With Δχ² or Δχ²/4 in place of Δχ²/2 in the odds it would be 130 or 10."""
    simulated, found, table = true_poses(rng, 3, points=2000)
    network, truth = simulated.network, simulated.truth
    x, y = network.x_px.copy(), network.y_px.copy()
    for k, (a, _, c) in enumerate(table):
        nearer = truth.xyz[k] + 1e-3 * (truth.xyz[k] - truth.position[network.image[a]])
        line = seen(simulated, c, nearer) - seen(simulated, c, truth.xyz[k])
        line /= np.linalg.norm(line)
        x[c], y[c] = np.array([x[c], y[c]]) + 50 * line + rng.uniform(-0.2, 0.2) * np.array([-line[1], line[0]])
    found = replace(found, network=replace(network, x_px=x, y_px=y))
    used = chosen(found, table, -2 * np.log(1e-6), allowed=54.0)
    wrong, right = ((used == pair).all(axis=1).sum() for pair in ([True, False, True], [True, True, False]))
    assert stats.poisson.sf(wrong - 1, 54.0) > RATE and wrong > 12 and right > 700


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
    assert gross[0].name == known.name[0] and len(gross) < 3
    assert gross[0].error == pytest.approx(1.0, abs=Z * 0.02 * np.sqrt(2))
    right = adjust(with_bars(rng, simulated), simulated.truth, redundancy=True)
    assert len(contradicted(bar_residuals(right), *image_sigma0(right))) < 3


def test_estimated_error_of_a_bar_is_that_of_prediction_without_it(rng):
    """To first order; of errors of some 5 µm in 500 mm the second order is below 0.3 nm, and grows with their square."""
    simulated = simulate(rng, images=10, points=40, bars=0, noise_px=0.004)
    network = with_bars(rng, simulated, wrong=0.003, u=0.001)
    known = bar_residuals(adjust(network, simulated.truth, redundancy=True))
    b = network.bars
    without = adjust(replace(network, bars=ScaleBars(b.start[1:], b.end[1:], b.length[1:], b.u[1:])), simulated.truth)
    length = np.linalg.norm(without.state.xyz[b.end[0]] - without.state.xyz[b.start[0]])
    assert known.residual[0] / known.redundancy[0] == pytest.approx(b.length[0] - length, abs=2e-6)
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
    assert 15 < group.dof < 23  # 30 coordinates less 7 of the datum
    low, high = (stats.chi2.isf(p, group.dof) / group.dof for p in (1 - RATE / 2, RATE / 2))
    assert 0.9 * low < group.factor < 1.1 * high
    xyz[3, 1] += 2.0
    adjustment = adjust(replace(network, xyz=xyz), simulated.truth, redundancy=True)
    gross = contradicted(control_residuals(adjustment), *image_sigma0(adjustment))
    assert gross[0].name == f"{network.points[3]} Y"
    assert gross[0].error == pytest.approx(2.0, abs=0.5)
