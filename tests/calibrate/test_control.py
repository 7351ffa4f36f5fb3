"""Control points and bars: wrong ones are found in networks of any size, as those few that they are, and image points stay."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import stats

from calibrate.networks import Simulated, simulate
from pixmetry.calibrate.bundle import loosened, settling
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.network import ScaleBars
from pixmetry.calibrate.bundle.solve import Options, calibrate_network
from pixmetry.calibrate.checks import known_checks, known_residuals
from pixmetry.calibrate.checks.findings import findings_of, gross_error_findings, known_findings
from pixmetry.calibrate.checks.known_checks import KnownFaults, lost_records, mostly_lost, set_free, where_seen, wrong_known
from pixmetry.calibrate.checks.known_residuals import Known, contradicted, control_residuals, group_record, jointly, rivals
from pixmetry.calibrate.checks.tests import known_record, sizes
from pixmetry.calibrate.page.tables import control_points, scale_bars
from pixmetry.calibrate.records import Calibration, Contradicted, GrossError, KnownControl, KnownRecord, record_of
from pixmetry.core.errors import InputError
from pixmetry.core.finding import Finding

RATE = 1e-6
QUICK = Options(folds=0, false_alarms=RATE)
U_MM = 0.05


@pytest.fixture(autouse=True)
def rare(monkeypatch: pytest.MonkeyPatch) -> None:
    """A right coordinate is named, and a right one in place of a wrong one, in one network of a million."""
    monkeypatch.setattr(known_checks, "contradicted", partial(contradicted, false_alarms=RATE))
    monkeypatch.setattr(known_residuals, "LIKELY", 2 * np.log(1e7))


def with_control(
    rng: np.random.Generator, *, whole: int, heights: int = 0, positions: int = 0, images: int = 16, points: int = 120,
    noise_px: float = 0.01, bars: int = 0,
) -> Simulated:  # fmt: skip
    """The first points of a network are control, good to 0.05 mm; what is not known of a point is rough."""
    simulated = simulate(rng, images=images, points=points, noise_px=noise_px, bars=bars)
    u, n = np.full((points, 3), np.inf), whole + heights + positions
    u[:whole], u[whole : whole + heights, 2], u[whole + heights : n, :2] = U_MM, U_MM, U_MM
    given = simulated.truth.xyz + np.where(np.isfinite(u), U_MM, 5.0) * rng.normal(size=u.shape)
    given[n:] = np.nan
    return replace(simulated, network=replace(simulated.network, xyz=given, u_xyz=u))


def wrong_by(simulated: Simulated, point: int, axis: int, error: float) -> Simulated:
    xyz = simulated.network.xyz.copy()
    xyz[point, axis] += error
    return replace(simulated, network=replace(simulated.network, xyz=xyz))


def calibrated(simulated: Simulated, options: Options = QUICK) -> Calibration:
    return calibrate_network(simulated.network, options, simulated.truth)


def gross(calibration: Calibration) -> list[str]:
    return [record.name for record in calibration.tests.known.control_points.gross]


def of_kind(calibration: Calibration, kind: str) -> list[Finding]:
    return [finding for finding in calibration.findings if finding.kind == kind]


def assert_points_as_stated(calibration: Calibration, simulated: Simulated) -> None:
    """All points together, in the frame of the control: an error of 3 mm in one of some ten control points makes it some hundred times as
    large as this. Points share the errors of the control, so their mean is judged as if it had the seven degrees of these."""
    a = calibration.adjustment
    off = a.state.xyz - simulated.truth.xyz
    there = np.isfinite(off).all(axis=1) & np.isfinite(a.point_covariance).all(axis=(1, 2))
    distance = np.einsum("ni,nij,nj->n", off[there], np.linalg.inv(a.point_covariance[there]), off[there])
    assert there.sum() > 0.95 * len(off) and distance.mean() / 3 < stats.chi2.isf(RATE, 7) / 7


@pytest.mark.parametrize(("point", "axis"), [(5, 2), (8, 2), (10, 0)], ids=["whole", "height only", "position only"])
def test_a_wrong_coordinate_is_found_beside_many_good_images(rng, point, axis):
    """16 images of 120 points at 0.01 px hold their shape a thousand times better than weights of a part of the field hold the datum."""
    simulated = wrong_by(with_control(rng, whole=7, heights=2, positions=2), point, axis, 3.0)
    calibration = calibrated(simulated)
    (record,) = calibration.tests.known.control_points.gross
    assert record.name == f"T{point + 1} {'XYZ'[axis]}" and record.left_out
    # 0.05 mm of its own and of the others, that carry the frame: 0.11 mm for a point at the rim
    assert record.error == pytest.approx(3.0, abs=stats.norm.isf(RATE / 2) * 0.15)
    assert calibration.adjustment.used.all()
    assert_points_as_stated(calibration, simulated)


@pytest.mark.parametrize("u", [U_MM, 0.0], ids=["weighted", "fixed"])
def test_control_stays_as_stated_where_that_is_wanted(rng, u):
    """A coordinate that is wrong by 3 mm, of seven points that are good to 0.05 mm or taken as exact: by default it is left out; as stated
    all stay, with their uncertainties, no image point goes for it, and a warning says that they contradict each other."""
    simulated = wrong_by(with_control(rng, whole=7, images=10, points=60), 5, 2, 3.0)
    network = replace(simulated.network, u_xyz=np.where(simulated.network.u_xyz == U_MM, u, simulated.network.u_xyz))
    simulated = replace(simulated, network=network)
    kept, tested = calibrated(simulated, replace(QUICK, control="as_stated")), calibrated(simulated)
    assert (kept.adjustment.network.u_xyz == network.u_xyz).all()
    assert (tested.adjustment.network.u_xyz != network.u_xyz).any()
    assert kept.adjustment.used.mean() > 0.999 and of_kind(kept, "known_uncertainty") and not gross(kept)


def test_a_wrong_bar_is_found_between_control_points(rng):
    simulated = with_control(rng, whole=7, bars=4)
    b = simulated.network.bars
    network = replace(simulated.network, bars=ScaleBars(b.start, b.end, b.length + [0, 2.0, 0, 0], b.u))
    calibration = calibrated(replace(simulated, network=network))
    (record,) = calibration.tests.known.scale_bars.gross
    names = [network.points[k] for k in (b.start[1], b.end[1])]
    assert record.name == "–".join(names) and record.left_out and not gross(calibration)
    assert calibration.adjustment.used.all()


@pytest.mark.parametrize("noise_px", [0.003, 0.3])
def test_right_control_stays(rng, noise_px):
    calibration = calibrated(with_control(rng, whole=4, heights=3, positions=3, noise_px=noise_px, images=10, points=60))
    known = calibration.tests.known
    assert not known.control_points.gross and not known.control_points.raised and known.untested is None
    assert calibration.adjustment.used.all()
    assert not {"known_untested", "gross_control_point", "lost_control"} & {f.kind for f in calibration.findings}


# --- networks that hang on their control


def in_two_parts(rng: np.random.Generator) -> Simulated:
    """Two groups of images that see no point in common: only whole control points, nine in each, hold them together."""
    simulated = with_control(rng, whole=18, images=16, points=80)
    network = simulated.network
    first = (np.arange(80) % 2).astype(bool)
    keep = first[network.point] == (network.image < 8)
    rows = {name: getattr(network, name)[keep] for name in ("x_px", "y_px", "image", "point", "covariance_px2")}
    return replace(simulated, network=replace(network, **rows), gross=simulated.gross[keep])


def test_a_network_that_hangs_on_its_control_is_tested_with_weights(rng):
    simulated = wrong_by(in_two_parts(rng), 4, 1, 3.0)
    calibration = calibrated(simulated)
    assert gross(calibration) == ["T5 Y"] and calibration.adjustment.used.all()
    assert not of_kind(calibration, "known_untested")
    assert_points_as_stated(calibration, simulated)


def test_that_control_could_not_be_tested_is_said(rng, monkeypatch):
    monkeypatch.setattr(loosened, "LOOSE", loosened.LOOSE[:1])
    calibration = calibrated(in_two_parts(rng))
    (finding,) = of_kind(calibration, "known_untested")
    assert finding.level == "warning" and "control points" in finding.text and calibration.tests.known.untested in finding.text


def test_what_only_control_determines_takes_part(rng):
    """A control point that one image sees, and an image that sees but control points that no other one sees."""
    simulated = with_control(rng, whole=16, images=10, points=60, noise_px=0.04)
    network = simulated.network
    single = np.flatnonzero(network.point == 2)[1:]
    only = (network.point >= 4) & (network.point < 12)
    drop = np.isin(np.arange(len(network)), single) | ((network.image == 4) != only)
    rows = {name: getattr(network, name)[~drop] for name in ("x_px", "y_px", "image", "point", "covariance_px2")}
    simulated = replace(simulated, network=replace(network, **rows))
    calibration = calibrated(simulated)
    assert np.isfinite(calibration.adjustment.state.position).all() and calibration.adjustment.used.all()


# --- known points that lost their image points


@pytest.mark.parametrize(("point", "axes"), [(1, (0, 1, 2)), (5, (2,))], ids=["whole", "height only"])
def test_a_weighted_point_without_image_points_is_wrong_by_what_is_known_of_it(rng, point, axes):
    """Nothing of it is left but what was said; its image points come back to where they meet, the size is that of the known axes."""
    simulated = wrong_by(with_control(rng, whole=5, heights=3, images=10, points=60), point, 2, 3.0)
    network = simulated.network
    before = adjust(network, simulated.truth, used=network.point != point, redundancy=True)
    assert list(wrong_known(network, before)) == [point]
    lost, seen, out = mostly_lost(network, before)
    assert list(lost) == [point] and seen[0] == out[0] == (network.point == point).sum()
    assert sizes(before).points == 59
    state = where_seen(network, before, np.array([point]))
    assert np.linalg.norm(state.xyz[point] - simulated.truth.xyz[point]) < 1.0
    after = adjust(set_free(network, np.array([point])), state, redundancy=True)
    (record,) = lost_records(network, after, np.array([point]))
    assert record.name == ("T2" if len(axes) == 3 else "T6 Z") and record.statistic > record.critical
    low, high = (stats.chi2.ppf(p, len(axes)) for p in (RATE / 2, 1 - RATE / 2))
    assert np.sqrt(9 + low * U_MM**2) - 0.6 < record.error < 3.0 + 2 * np.sqrt(high) * 2 * U_MM


def test_points_too_many_to_be_wrong_one_by_one_are_named(rng):
    simulated = with_control(rng, whole=4, images=10, points=60)
    network = simulated.network
    adjustment = adjust(network, simulated.truth, used=network.point > 1, redundancy=True)
    assert not len(wrong_known(network, adjustment))
    calibration = calibrated(simulated)
    (finding,) = (f for f in findings_of(adjustment, calibration.tests) if f.kind == "lost_control")
    assert finding.level == "warning" and "T1 (" in finding.text and "T2 (" in finding.text and "table of points" in finding.advice
    rows = control_points(replace(calibration, adjustment=adjustment))
    assert [row[0] for row in rows if "no image point left" in row[0]] == [f"T{k} {a} (no image point left)" for k in (1, 2) for a in "XYZ"]
    assert all(row[3:] == ["–", "–"] or row[3:] == ["—", "—"] for row in rows if "no image point left" in row[0])


def test_wrong_control_is_found_by_the_images_that_it_costs(rng, monkeypatch):
    """Where nothing could be tested, the points that lost their image points are set free after all."""
    simulated = wrong_by(with_control(rng, whole=8, heights=2, images=12, points=50, noise_px=0.04), 9, 2, 60.0)
    monkeypatch.setattr(settling, "_checked_known", lambda m, shift, s, u, loss, *_: (m, s, u, loss, known_checks.KnownFaults()))
    calibration = calibrated(simulated)
    assert gross(calibration) == ["T10 Z"] and calibration.adjustment.used.all()
    assert_points_as_stated(calibration, simulated)


# --- which one of few it is


def test_rivals_are_those_that_explain_the_residuals_nearly_as_well(rng):
    """χ² of straight linear models, each with one more unknown: the error of one observation, or of another."""
    n, likely = 12, known_residuals.LIKELY
    design, u = rng.normal(size=(n, 5)), rng.uniform(0.5, 2.0, n)
    y = np.where(np.arange(n) == 2, 20.0, 0.0) + u * rng.normal(size=n)

    def chi2(columns: list[int]) -> tuple[float, float]:
        """χ², and the redundancy of the last one: 1 over the variance of its error in units of its own."""
        A = np.column_stack([design, np.eye(n)[:, columns]]) / u[:, None]
        left = y / u - A @ np.linalg.lstsq(A, y / u, rcond=None)[0]
        return float(left @ left), float(u[columns[-1]] ** 2 / np.linalg.inv(A.T @ A)[-1, -1])

    cofactor = np.diag(u**2) - design @ np.linalg.inv(design.T @ (design / u[:, None] ** 2)) @ design.T
    known = Known(tuple("abcdefghijkl"), np.arange(n), y, cofactor @ (y / u**2), u, cofactor)
    for wrong in ([2], [5], [2, 4]):
        base, redundancy = chi2([*wrong[1:], wrong[0]])
        if redundancy < 0.02:
            continue
        found = rivals(known, wrong, 1.0)
        for j in np.setdiff1d(np.arange(n), wrong):
            other, redundancy = chi2([*wrong[1:], int(j)])
            if redundancy > 0.02:
                assert (j in found) == (other - base < likely)


def test_control_points_together_leave_seven_combinations_untested(rng):
    """Those that a similarity changes carry the frame; the bars that join the points change nothing."""
    simulated = with_control(rng, whole=4, images=10, points=50)
    network = simulated.network
    alone = adjust(network, simulated.truth, redundancy=True)
    joint = adjust(jointly(network, alone.state), alone.state, redundancy=True)
    known, apart = control_residuals(replace(joint, network=network)), control_residuals(alone)
    values = np.linalg.eigvalsh(known.cofactor) / U_MM**2
    assert np.abs(values[:7]).max() < 1e-4 and values[7:].min() > 0.5
    np.testing.assert_allclose(np.diag(known.cofactor), np.diag(apart.cofactor), rtol=1e-3, atol=1e-5 * U_MM**2)
    np.testing.assert_allclose(known.residual, apart.residual, atol=1e-3 * U_MM)


def test_of_few_points_the_wrong_coordinate_goes_and_the_rest_stays(rng):
    """Four whole points, four heights, three positions: 15 degrees of freedom tell which it is; its height stays."""
    simulated = wrong_by(with_control(rng, whole=4, heights=4, positions=3, images=14, points=60), 1, 0, 3.0)
    calibration = calibrated(simulated)
    u = calibration.adjustment.network.u_xyz
    assert gross(calibration) == ["T2 X"] and np.isinf(u[1, :2]).all() and u[1, 2] == U_MM
    assert (u[[0, 2, 3]] == U_MM).all() and "it was left out" in of_kind(calibration, "gross_control_point")[0].advice
    assert_points_as_stated(calibration, simulated)


def test_where_it_cannot_be_said_which_all_weigh_less_and_keep_what_was_stated(rng):
    """Three whole points have two degrees of freedom: without one of them nothing would tell whether the others are right."""
    simulated = wrong_by(with_control(rng, whole=3, images=10, points=50), 1, 0, 3.0)
    calibration = calibrated(simulated)
    record = calibration.tests.known.control_points
    named = {name for r in record.gross for name in (r.name, *r.rivals)}
    if not named:  # the three lie so that X of this one has next to no redundancy
        known = control_residuals(adjust(simulated.network, simulated.truth, redundancy=True))
        assert known.redundancy[known.name.index("T2 X")] < 0.02
        return
    assert "T2 X" in named and calibration.adjustment.used.all()
    assert set(record.raised.values()) <= {U_MM}
    finding = of_kind(calibration, "gross_control_point")[0]
    rows = {row[0]: row for row in control_points(calibration)}
    assert "is not clear" in finding.advice
    for one in record.gross:
        assert not one.left_out and set(one.rivals) <= set(record.raised)
        assert f"{one.name} (contradicted, weighs less)" in rows
    for name in record.raised:
        point, axis = int(name.split()[0][1:]) - 1, "XYZ".index(name.split()[1])
        (row,) = (r for key, r in rows.items() if key.startswith(f"{name} ("))
        assert calibration.adjustment.network.u_xyz[point, axis] > U_MM and row[2] == "± 0.050"
        off = simulated.network.xyz[point, axis] - calibration.adjustment.state.xyz[point, axis]
        assert float(row[4].replace("−", "-")) == pytest.approx(off / U_MM, abs=0.06)


def test_bars_that_weigh_less_keep_what_was_stated(rng):
    simulated = simulate(rng, images=10, points=50, bars=2)
    b = simulated.network.bars
    network = replace(simulated.network, bars=ScaleBars(b.start, b.end, b.length + [5.0, 0], b.u))
    calibration = calibrated(replace(simulated, network=network))
    assert (calibration.adjustment.network.bars.u > 1).all()
    assert [bar.u for bar in calibration.tests.network.scale_bars] == [0.01, 0.01]
    assert all("weighs less" in row[0] and row[2] == "± 0.010" for row in scale_bars(calibration))


def test_exchanged_control_points_are_called_so(rng):
    """Two of four whole points, far from each other; heights and positions tell which."""
    simulated = with_control(rng, whole=4, heights=4, positions=3, images=14, points=60)
    given = simulated.network.xyz.copy()
    other = 1 + int(np.argmax(np.linalg.norm(given[1:4] - given[0], axis=1)))
    given[[0, other]] = given[[other, 0]]
    calibration = calibrated(replace(simulated, network=replace(simulated.network, xyz=given)))
    said = [f.text for f in of_kind(calibration, "gross_control_point")]
    assert len(said) == 2 and calibration.adjustment.used.all()
    for a, b in ((0, other), (other, 0)):
        assert any(f"control point T{a + 1} " in text and f"lies where T{b + 1} should be" in text for text in said)


# --- held coordinates beside others


def held_beside(rng: np.random.Generator, u: np.ndarray, bars: int, images: int = 10, points: int = 50) -> Simulated:
    """The first points have these uncertainties, of which 0 is held and exact; nothing is said of coordinates that are not known."""
    simulated = simulate(rng, images=images, points=points, bars=bars)
    all_u = np.full((points, 3), np.inf)
    all_u[: len(u)] = u
    finite = np.isfinite(all_u)
    given = np.where(finite, simulated.truth.xyz + np.where(finite, all_u, 0.0) * rng.normal(size=all_u.shape), np.nan)
    return replace(simulated, network=replace(simulated.network, xyz=given, u_xyz=all_u))


def heights(n: int) -> np.ndarray:
    return np.where(np.arange(3) == 2, 0.0, np.full((n, 3), np.inf))


def one_held(n: int) -> np.ndarray:
    return np.where(np.arange(n)[:, None] == 0, 0.0, np.full((n, 3), U_MM))


def of_all_kinds() -> np.ndarray:
    """Two points held, heights and plan positions with weights, a height held beside weights, whole points with weights."""
    u = np.full((12, 3), U_MM)
    u[:2], u[2, :2], u[3, 2], u[4, 2] = 0.0, np.inf, np.inf, 0.0
    return u


MIXTURES = [(heights(10), 2, 1, 2), (heights(10), 0, 1, 2), (one_held(8), 2, 0, 0), (one_held(8), 0, 0, 1), (of_all_kinds(), 2, 1, 0)]
MIXED = ["heights and bars", "heights", "one held and bars", "one held", "of all kinds"]


@pytest.mark.parametrize(("u", "bars", "point", "axis"), MIXTURES, ids=MIXED)
def test_a_wrong_held_coordinate_is_named_and_not_what_is_right_beside_it(rng, u, bars, point, axis):
    """5 mm, some hundred times what a network of ten images at 0.04 px knows of it."""
    simulated = wrong_by(held_beside(rng, u, bars), point, axis, 5.0)
    calibration = calibrated(simulated)
    network, records = calibration.adjustment.network, calibration.tests.known.control_points.gross
    named = {name for record in records for name in (record.name, *record.rivals)}
    assert f"T{point + 1} {'XYZ'[axis]}" in named and len(records) == 1 and len(network.bars) == bars
    assert not calibration.tests.known.scale_bars.gross and calibration.adjustment.used.all()
    (record,) = records
    if record.left_out:
        assert record.error == pytest.approx(5.0, abs=stats.norm.isf(RATE / 2) * 0.15)
        others = np.arange(len(network.points)) != point
        np.testing.assert_array_equal(network.u_xyz[others], simulated.network.u_xyz[others])
    else:  # of heights that lie nearly in line it cannot be said which it is
        assert record.rivals


@pytest.mark.parametrize(("u", "bars", "point", "axis"), MIXTURES, ids=MIXED)
def test_right_held_coordinates_stay_held(rng, u, bars, point, axis):
    simulated = held_beside(rng, u, bars)
    calibration = calibrated(simulated)
    known = calibration.tests.known
    assert not known.control_points.gross and not known.control_points.raised and known.untested is None
    np.testing.assert_array_equal(calibration.adjustment.network.u_xyz, simulated.network.u_xyz)
    assert calibration.adjustment.used.all() and len(calibration.adjustment.network.bars) == bars
    fixed = known.fixed_points
    assert fixed is None or fixed.p > RATE


def in_metres(simulated: Simulated) -> Simulated:
    b = simulated.network.bars
    length = np.where(np.arange(len(b)) == 0, b.length / 1000, b.length)
    return replace(simulated, network=replace(simulated.network, bars=ScaleBars(b.start, b.end, length, b.u)))


LITTLE = [np.array([[np.inf, np.inf, U_MM]]), heights(3), np.full((1, 3), U_MM), np.zeros((1, 3))]


@pytest.mark.parametrize("u", LITTLE, ids=["a height", "three heights held", "a point", "a point held"])
def test_of_two_bars_in_different_units_neither_is_left_out_where_nothing_else_gives_the_scale(rng, u):
    with pytest.raises(InputError, match="the two scale bars contradict"):
        calibrated(in_metres(held_beside(rng, u, 2)))
    calibration = calibrated(in_metres(held_beside(rng, u, 3)))
    (record,) = calibration.tests.known.scale_bars.gross
    assert record.left_out and len(calibration.adjustment.network.bars) == 2 and not gross(calibration)


@pytest.mark.parametrize("u", [np.full((2, 3), U_MM), np.zeros((2, 3))], ids=["two points", "two points held"])
def test_two_whole_points_tell_which_bar_is_in_other_units(rng, u):
    simulated = in_metres(held_beside(rng, u, 2))
    calibration = calibrate_network(simulated.network, QUICK)  # the wrong bar has its part in the start values
    (record,) = calibration.tests.known.scale_bars.gross
    b = simulated.network.bars
    assert record.left_out and record.name == "–".join(simulated.network.points[k] for k in (b.start[0], b.end[0]))
    assert calibration.adjustment.used.all()


# --- what is said


def test_the_error_of_a_whole_point_is_told_along_the_axis_of_it(rng):
    """5 mm in X and almost as much in Y, of one held point: whichever test is worst, the larger one is said."""
    simulated = wrong_by(wrong_by(held_beside(rng, one_held(8), 2), 0, 0, 5.0), 0, 1, 4.0)
    (record,) = calibrated(simulated).tests.known.control_points.gross
    assert record.name == "T1 X" and record.left_out and set(record_of(record)) == {
        "name", "residual", "error", "statistic", "critical", "left_out", "rivals", "swapped_with"
    }  # fmt: skip
    assert record.error == pytest.approx(5.0, abs=stats.norm.isf(RATE / 2) * 0.15)


def test_what_is_left_out_in_the_end_is_said_once(rng):
    simulated = with_control(rng, whole=5, images=6, points=30, noise_px=0.04, bars=2)
    free = adjust(set_free(simulated.network, np.array([1])), simulated.truth, redundancy=True)

    def less(name: str) -> Contradicted:
        return Contradicted(name, 1.0, 1.0, 9.0, 4.0, left_out=False, rivals=("B",))

    def out(name: str) -> Contradicted:
        return Contradicted(name, 1.0, 1.0, 9.0, 4.0, left_out=True, rivals=())

    faults = KnownFaults((less("A–B"), less("C–D"), out("A–B")), (less("T1 X"), less("T2 X"), out("T2 Z")))
    found = known_record(free, faults)
    assert [(r.name, r.left_out) for r in found.scale_bars.gross] == [("C–D", False), ("A–B", True)]
    assert [(r.name, r.left_out) for r in found.control_points.gross] == [("T1 X", False), ("T2 Z", True)]


@pytest.mark.parametrize("wrong", [0.0, 5.0])
def test_bars_between_the_same_points_are_told_apart(rng, wrong):
    """The first bar again with another uncertainty, right or wrong: nothing is raised, and each keeps what was stated of it."""
    simulated = simulate(rng, images=10, points=50, bars=3)
    b = simulated.network.bars
    start, end, length = (np.append(v, v[0]) for v in (b.start, b.end, b.length))
    length[3] += wrong
    u = np.array([0.05, 0.02, 0.02, 0.03])
    calibration = calibrated(replace(simulated, network=replace(simulated.network, bars=ScaleBars(start, end, length, u))))
    known = calibration.tests.known.scale_bars
    assert known.raised == {} and not any("weighs less" in row[0] for row in scale_bars(calibration))
    bars = calibration.tests.network.scale_bars
    ends = "–".join(simulated.network.points[k] for k in (start[0], end[0]))
    assert [bar.u for bar in bars] == ([0.05, 0.02, 0.02] if wrong else [0.05, 0.02, 0.02, 0.03])
    assert [r.name for r in known.gross] == ([f"{ends} (2)"] if wrong else [])


def test_names_exchanged_throughout_are_said_once(rng):
    simulated = simulate(rng, images=10, points=40)
    network = simulated.network
    pairs = [(i, "T1", "T2") for i in range(9)] + [(3, "T5", "T7")]
    errors = [GrossError(network.images[i], a, 9.0, 0.0, 9.0, 0.0, 99.0, 20.0, b) for i, p, q in pairs for a, b in ((p, q), (q, p))]
    adjustment = adjust(network, simulated.truth)
    (finding,) = gross_error_findings(errors, adjustment, [])
    assert finding.text.count("T1 and T2") == 1 and "T1 and T2 in 9 images, more likely in the table of points" in finding.text
    assert "T5 and T7 in IMG_0004" in finding.text


def test_the_largest_of_a_group_are_named_before_new_uncertainties(rng):
    simulated = wrong_by(with_control(rng, whole=8, images=10, points=50), 6, 1, 0.6)
    adjustment = adjust(simulated.network, simulated.truth, redundancy=True)
    known = control_residuals(adjustment)
    record = group_record(adjustment, known)
    ratio = np.abs(simulated.network.xyz - adjustment.state.xyz)[:8] / U_MM
    first = np.unravel_index(np.argmax(ratio), ratio.shape)
    assert record.largest[0].name == f"T{first[0] + 1} {'XYZ'[first[1]]}"
    assert abs(record.largest[0].ratio) == pytest.approx(ratio.max(), rel=1e-6)
    (finding,) = known_findings(KnownRecord(control_points=KnownControl(replace(record, p=0.0))), "mm")
    assert finding.advice.startswith(f"Check the largest first: {record.largest[0].name}, ")


@pytest.mark.parametrize(
    ("how", "text"),
    [
        ({"whole": 3, "heights": 4, "positions": 3}, "19 coordinates of 10 points (3 complete) with weights"),
        ({"whole": 5}, "5 points with weights"),
        ({"whole": 0, "heights": 5, "bars": 2}, "5 coordinates of 5 points (none complete) with weights; 2 scale bars; inner"),
        ({"whole": 0, "positions": 4}, "8 coordinates of 4 points (none complete) with weights; inner constraints on"),
    ],
)
def test_the_datum_is_told_by_coordinates(rng, how, text):
    simulated = with_control(rng, images=6, points=30, noise_px=0.04, **how)
    datum = adjust(simulated.network, simulated.truth).datum
    assert datum.startswith(text)
    assert datum.endswith("for X, Y and the direction about Z, which are arbitrary") == ("heights" in how and not how["whole"])
    assert datum.endswith("for Z, which is arbitrary") == ("positions" in how and not how["whole"])
