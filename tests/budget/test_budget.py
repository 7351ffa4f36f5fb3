"""The budget as a whole: status of each row, ranking, gains, limits, uncertainty of the uncertainties, and the record."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import uniform

from budget.cameras import camera, element
from pixmetry.budget import compute_budget, make_probe
from pixmetry.budget.headline import headline
from pixmetry.budget.monte_carlo import Trials, monte_carlo
from pixmetry.budget.parameters import applies, covariance_of
from pixmetry.budget.probe import Target, facts_of
from pixmetry.camera.camera import load_camera
from pixmetry.camera.catalogue import get_source, sources
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates
from pixmetry.locate.centroids.fixed import FixedCentroid

KNOWN = {"noise_dn": 0.6}


def computed(camera, estimates=None, known=None, target=None, **options):
    """The budget with an estimator that is quick to propagate."""
    return compute_budget(camera, estimates, known, target, FixedCentroid(), **options)


def small_camera():
    return camera(
        element("sensor.prnu", pixel_std_rel=0.005),
        element("electronics.amplifier_noise", white_e=40.0),
        facts={"saturation_dn": 200.0, "bits": 8, "interface": "digital", "sensor": "cmos"},
        pitch_um=(8.0, 4.0),
    )


def prnu(value: float, u: float, **kw) -> dict[str, Estimates]:
    return {"sensor.prnu": Estimates.from_rows([("pixel_std_rel", value, u, 100.0, "1")], **kw)}


def row(budget, name):
    return next(r for r in budget.rows if r.name == name)


def test_status_of_each_source() -> None:
    budget = computed(small_camera(), prnu(0.008, 0.0004), KNOWN, trials=0)
    assert {r.source_id for r in budget.rows} == set(sources())
    assert row(budget, "sensor.prnu").status == "measured"
    assert row(budget, "electronics.amplifier_noise").status == "modelled"
    assert row(budget, "processing.threshold").status == "modelled"
    assert row(budget, "sensor.dsnu").status == "accepted"
    assert row(budget, "cable.termination").status == "not applicable"
    assert row(budget, "cable.termination").contribution is None
    assert all(r.reason for r in budget.rows if r.contribution is None)


def test_a_packaged_logarithmic_camera_has_a_budget() -> None:
    """60 mV a decade are 36 DN: offsets that scatter by 0.75 DN are 4.9 % of the light, and lead the budget."""
    cam = replace(load_camera("cmos_log_fuga15"), frame_shape=(96, 128))
    budget = compute_budget(cam, trials=0)
    assert budget.rows[0].name == "sensor.log_response" and 0.01 < budget.verdict.total_px < 0.05
    assert math.isfinite(budget.facts.gain_dn_per_e) and budget.facts.saturation_dn == 235
    assert {r.name for r in budget.rows if r.contribution is not None} >= {"sensor.shot_noise", "grabber.adc", "processing.threshold"}


def test_what_stands_in_the_chain_counts_by_monte_carlo_where_there_is_no_propagator() -> None:
    """A spread of 0.5 px alone: the camera's error with it, less that without it, lies between their difference and their sum."""
    cam = camera(element("optics.point_spread", sigma_px=0.5))
    budget = compute_budget(cam, None, KNOWN, trials=512)
    spread, itself = row(budget, "optics.point_spread"), row(budget, "processing.threshold")
    assert spread.status == "modelled" and spread.monte_carlo is not None and spread.contribution.method == spread.reason
    with_it, without_it = budget.interaction.together.total_px, itself.monte_carlo.total_px
    assert abs(with_it - without_it) <= spread.total_px <= with_it + without_it
    assert row(budget, "electronics.gain").contribution is None  # it cannot be left out
    few = row(compute_budget(cam, None, KNOWN, trials=0), "optics.point_spread")  # no other Monte Carlo, but its own
    assert few.monte_carlo is None and few.contribution.method.startswith("Monte Carlo")
    assert abs(few.total_px - spread.total_px) < 2.5 * (few.contribution.floor_px + spread.contribution.floor_px)  # five standard errors


FRAME_SIZES = [(240, 320), (480, 640), (1024, 1280), (2048, 2448), (4096, 5120)]


@pytest.mark.parametrize("source_id", [i for i, s in sources().items() if s.propagate and not s.option and Kind.LIGHT not in s.consumes])
def test_no_bound_explodes_or_vanishes_with_the_size_of_the_frame(source_id: str) -> None:
    """What is accepted at its bound: over frames of 77 kpx to 21 Mpx it neither grows to several times that of 640 × 480 pixels, nor is it
    ever the size of a pixel. The clock that is not warm stretches the row, by a share of its length: that grows as rows do.
    """
    source = get_source(source_id)
    cam = small_camera()
    probe = make_probe(facts_of(cam, Target(), KNOWN), Target(), FixedCentroid(), 4)
    totals = np.array([source.propagate(source.bound_of(s), replace(probe, frame_shape=s)).total_px for s in FRAME_SIZES])
    if source_id != "grabber.clock_warm_up":
        assert (totals[1:] <= 2 * totals[1]).all() and (totals[:2] <= 3 * totals[1]).all()
    if source_id in ("optics.shading", "sensor.charge_transfer"):
        assert 0.001 < totals[3] < 0.03 and totals[-1] > 5e-4


def test_what_files_and_measurements_rule_out_is_not_accepted() -> None:
    """Frames stored without loss had no JPEG coder; what a spectrum shows of the supply was measured as a pattern, and counts once."""
    cam = small_camera()
    for lossless, status in ((True, "not applicable"), (False, "accepted"), (None, "accepted")):
        facts = cam.facts if lossless is None else {**cam.facts, "lossless": lossless}
        assert row(computed(replace(cam, facts=facts), None, KNOWN, trials=0), "storage.jpeg").status == status
    assert row(computed(cam, None, KNOWN, trials=0), "electronics.supply_pickup").status == "accepted"
    pattern = Estimates.from_rows([("amplitude_dn", 0.05, 0.01, 99.0, "DN")], limits=frozenset({"amplitude_dn"}))
    got = row(computed(cam, {"grabber.phase_pattern": pattern}, KNOWN, trials=0), "electronics.supply_pickup")
    assert got.status == "not applicable" and got.contribution is None and "measured" in got.reason


def test_the_verdict_is_the_root_sum_of_squares_of_what_is_decided() -> None:
    budget = computed(small_camera(), prnu(0.008, 0.0004), KNOWN, trials=0)
    decided = [r.total_px**2 for r in budget.of_status("measured", "modelled")]
    accepted = [r.total_px**2 for r in budget.of_status("accepted")]
    assert budget.verdict.total_px == pytest.approx(math.sqrt(sum(decided)))
    assert budget.with_accepted[0].total_px == pytest.approx(math.sqrt(sum(decided) + sum(accepted)))
    assert sum(r.share for r in budget.of_status("measured", "modelled")) == pytest.approx(1.0)
    totals = [[r.total_px for r in rows] for rows in (budget.largest, budget.accepted)]
    assert all(group == sorted(group, reverse=True) for group in totals)
    assert [r.name for r in budget.rows[: len(budget.largest)]] == [r.name for r in budget.largest]  # what is only accepted comes after
    x_um, y_um = budget.um(budget.verdict)
    assert x_um == pytest.approx(8 * budget.verdict.total_x_px) and y_um == pytest.approx(4 * budget.verdict.total_y_px)


def test_frames_lower_only_the_temporal_part() -> None:
    budget = computed(small_camera(), None, KNOWN, trials=0, frames=(1, 4, 10**12))
    names = ("electronics.amplifier_noise", "sensor.shot_noise", "sensor.prnu")  # light has its shot noise, named in the chain or not
    noise, shot, fixed = (row(budget, name).total_px for name in names)
    one, four, many = (v.total_px**2 for v in budget.verdicts)
    assert one - four == pytest.approx(0.75 * (noise**2 + shot**2))
    assert one - many == pytest.approx(noise**2 + shot**2, rel=1e-6) and many > fixed**2


def test_the_estimate_replaces_the_cameras_parameter_and_its_uncertainty_propagates() -> None:
    """PRNU's contribution is proportional to its standard deviation, so the relative uncertainties are equal."""
    budget = computed(small_camera(), prnu(0.008, 0.0004), KNOWN, trials=0)
    before = row(computed(small_camera(), None, KNOWN, trials=0), "sensor.prnu")
    got = row(budget, "sensor.prnu")
    assert got.total_px == pytest.approx(before.total_px * 0.008 / 0.005)
    assert got.u_of_total_px == pytest.approx(got.total_px * 0.0004 / 0.008, rel=1e-6)
    assert before.u_of_total_px == 0


def test_an_upper_limit_enters_as_a_rectangular_distribution() -> None:
    """A value that may be anywhere from 0 to L has the root mean square L/√3; checked against numbers spread over it."""
    limit = 0.012
    got = row(computed(small_camera(), prnu(limit, 0.001, limits=frozenset({"pixel_std_rel"})), KNOWN, trials=0), "sensor.prnu")
    cam = small_camera()
    probe = make_probe(facts_of(cam, Target(), KNOWN), Target(), FixedCentroid())
    spread = (np.arange(1000) + 0.5) / 1000 * limit
    source = get_source("sensor.prnu")
    unit = source.propagate(source.make({"pixel_std_rel": limit}), probe).total_px / limit
    assert got.total_px == pytest.approx(unit * math.sqrt((spread**2).mean()), rel=1e-5)


def test_covariance_between_parameters_counts() -> None:
    """Two parameters of one source, fully correlated: with equal slopes the uncertainty is that of their sum, not of its quadrature.

    If one is larger by as much as the other is smaller (4 %), the root of the sum of their squares changes in second order only.
    """
    names, values = ("row_e", "column_e"), np.array([5.0, 5.0])

    def u(rho: float) -> float:
        cov = 0.04 * np.array([[1, rho], [rho, 1]])
        measured = {"electronics.row_noise": Estimates(names, values, cov, np.full(2, 99.0), ("e-", "e-"))}
        return row(computed(small_camera(), measured, KNOWN, trials=0), "electronics.row_noise").u_of_total_px

    assert u(0.999999) / u(0.0) == pytest.approx(math.sqrt(2), rel=1e-3)
    assert u(-0.999999) / u(0.0) == pytest.approx(0.5 * 0.04**2 / (0.04 / math.sqrt(2)), rel=0.01)


def test_advice_names_the_largest_and_tells_the_gain() -> None:
    budget = computed(small_camera(), None, KNOWN, trials=0)
    known = [a for a in budget.advice if a.status != "accepted"]
    assert [a.name for a in known] == [r.name for r in budget.largest][:5]
    assert [a.name for a in budget.advice] == [a.name for a in known] + [r.name for r in budget.accepted][:3]
    for advice in budget.advice:
        whole = budget.with_accepted[0] if advice.status == "accepted" else budget.verdict
        assert advice.combined_px == whole.total_px
        assert advice.removed_px == pytest.approx(math.sqrt(whole.total_px**2 - advice.total_px**2), rel=1e-6)
        assert advice.removed_px <= advice.halved_px <= advice.combined_px
        finding = advice.finding
        assert finding.kind == ("to_measure" if advice.status == "accepted" else "to_lower")
        assert finding.text.startswith(advice.title) and finding.advice == get_source(advice.source_id).advice
        record = advice.to_record()
        assert record["total_px"] == finding.numbers["total_px"] and record["text"] == finding.text and record["level"] == finding.level
    forced = computed(small_camera(), None, KNOWN, trials=0, accepted=["sensor.prnu"])
    assert row(forced, "sensor.prnu").status == "accepted"


def test_monte_carlo_stands_beside_and_independent_sources_do_not_interact() -> None:
    """White noise and PRNU: together they are their root sum of squares. False alarm 1e-6, and 4 % of the total beyond that."""
    said = []
    budget = computed(small_camera(), None, KNOWN, trials=4096, progress=said.append)
    for name in ("sensor.prnu", "electronics.amplifier_noise", "processing.threshold"):
        r = row(budget, name)
        error = 5 * r.monte_carlo.se_total_px + r.contribution.model_error * r.total_px + r.contribution.floor_px
        assert abs(r.monte_carlo.total_px - r.total_px) < error
    together = budget.interaction
    assert abs(together.difference_px) < 4.9 * together.se_px + 0.04 * together.sum_px
    assert together.se_px < 0.05 * together.sum_px
    assert any("Monte Carlo" in text for text in said)


def hot_camera(**defects: float):
    return camera(
        element("sensor.defects", **defects),
        element("sensor.shot_noise"),
        element("electronics.amplifier_noise", white_e=40.0),
        facts={"bits": 8, "interface": "digital", "sensor": "cmos"},
        adc=True,
        pitch_um=(8.0, 8.0),
    )


@pytest.mark.parametrize(
    "defects",
    [
        {"hot_fraction": 0.02, "hot_median_e": 40_000.0, "hot_sigma_log": 0.5},  # two and more in a window: they act together
        {"hot_fraction": 0.005, "hot_median_e": 10_000.0, "hot_sigma_log": 0.9},
        {"hot_fraction": 1e-4, "hot_median_e": 6_000.0, "hot_sigma_log": 1.0},  # few targets have one: the Monte Carlo may miss them
    ],
)
def test_the_headline_is_that_of_brute_force(defects: dict[str, float], seed: int) -> None:
    """Four times as many windows of the whole camera with other draws: within 4.9 standard errors of both and 10 %.

    Without the scale's end in the formula hot pixels came out 1.7 to 4.5 times as large; 20 % would be caught in the first two cases.
    """
    cam = hot_camera(**defects)
    budget = computed(cam, None, KNOWN, trials=4096, seed=seed)
    brute = monte_carlo(cam, Target(), FixedCentroid(), trials=16_384, seed=seed + 1, facts=budget.facts)
    found, error = budget.headline, math.hypot(budget.headline.se_simulated_px, brute.se_total_px)
    assert abs(budget.verdict.total_px - brute.total_px) < 4.9 * error + 0.1 * brute.total_px, found
    assert (found.by == "Monte Carlo") == (abs(found.sum_px - found.simulated_px) > 2 * math.hypot(found.se_simulated_px, found.u_sum_px))


def test_where_sources_act_on_each_other_the_monte_carlo_is_the_headline_and_says_which(seed: int) -> None:
    """Two hot pixels and more in every window: one by one, as the formula counts them, they do more than together."""
    budget = computed(hot_camera(hot_fraction=0.05, hot_median_e=40_000.0, hot_sigma_log=0.5), None, KNOWN, trials=4096, seed=seed)
    assert budget.headline.by == "Monte Carlo" and budget.verdict.total_px == pytest.approx(budget.interaction.together.total_px, rel=0.01)
    assert budget.sums[0].total_px > 1.15 * budget.verdict.total_px
    assert "defect pixels alone" in budget.headline.why
    more = budget.verdicts[-1]
    axes = budget.interaction.together.x, budget.interaction.together.y
    fixed = math.sqrt(0.5 * sum(a.fixed**2 + a.temporal**2 / 64 + a.bias**2 for a in axes))
    assert more.frames == 64 and more.total_px == pytest.approx(fixed, rel=0.01)  # the estimator itself is in no chain: 0.0007 px
    accepted = sum(r.total_px**2 for r in budget.accepted)
    assert budget.with_accepted[0].total_px == pytest.approx(math.sqrt(budget.verdict.total_px**2 + accepted))
    assert sum(r.share for r in budget.largest) == pytest.approx(1.0)


def test_the_sum_is_the_headline_where_both_agree(seed: int) -> None:
    budget = computed(small_camera(), None, KNOWN, trials=4096, seed=seed)
    assert budget.headline.by == "sum" and budget.verdict == budget.sums[0] and "agrees" in budget.headline.why
    assert computed(small_camera(), None, KNOWN, trials=0).headline.by == "sum"


def test_what_is_accepted_is_in_neither_total_although_it_stands_in_the_chain() -> None:
    """PRNU of 5 % would be four fifths of the whole; false alarm 1e-6, and 10 % of the total for what the formulas leave open."""
    cam = small_camera().with_parameters("sensor.prnu", pixel_std_rel=0.05)
    budget = computed(cam, None, KNOWN, trials=2048, accepted=["sensor.prnu"])
    together = budget.interaction.together
    assert row(budget, "sensor.prnu").status == "accepted" and budget.with_accepted[0].total_px > 1.5 * budget.verdict.total_px
    by_formula = budget.headline.sum_px
    assert abs(together.total_px - by_formula) < 4.9 * together.se_total_px + 0.1 * by_formula


def test_the_interval_holds_the_verdict_with_students_factor() -> None:
    """Parameters known to 20 % have 12.5 degrees of freedom each (JCGM 100:2008, G.4.2); Student gives the factor."""
    budget = computed(small_camera(), prnu(0.02, 0.004), KNOWN, trials=0)
    interval, one = budget.interval, budget.verdict
    assert interval.half_px == pytest.approx((interval.k[0] * one.total_x_px, interval.k[1] * one.total_y_px))
    assert 1.96 < interval.k[0] < 3 and 5 < interval.dof[0] < 100
    sharper = computed(small_camera(), prnu(0.02, 0.0001), KNOWN, trials=0)
    assert sharper.interval.dof[0] > interval.dof[0]


def test_the_stages_share_the_verdict_and_rows_that_do_not_count_come_last() -> None:
    budget = computed(small_camera(), prnu(0.008, 0.0004), KNOWN, trials=0)
    assert sum(s.share for s in budget.stages) == pytest.approx(1.0)
    assert sum(s.total_px**2 for s in budget.stages) == pytest.approx(budget.verdict.total_px**2)
    assert sum(s.accepted_px**2 for s in budget.stages) == pytest.approx(sum(r.total_px**2 for r in budget.accepted))
    counted = [r.counts for r in budget.rows]
    assert counted == sorted(counted, reverse=True)
    assert {r.name for r in budget.rows if r.in_camera} == {e.name for e in small_camera().active}


def test_a_drift_along_the_rows_is_left_by_a_calibration_in_x_alone() -> None:
    """A cold clock moves targets in x: of y a calibration leaves no more than there is of it."""
    cam = camera(element("grabber.clock_warm_up", scale_error_rel=0.02, lock_us=10.0), shape=(96, 200))
    budget = computed(cam, None, KNOWN, trials=256)
    in_x, in_y = budget.interaction.unsteady_px
    assert in_x == pytest.approx(row(budget, "grabber.clock_warm_up").contribution.bias_x_px, rel=0.1) and in_y < 0.02 * in_x
    assert budget.interaction.calibrated_px == pytest.approx(in_x / math.sqrt(2), rel=0.05)
    _, simulated = headline(
        [replace(r, contribution=replace(r.contribution, bias_x_px=0.0, model_error=0.0)) for r in budget.largest],
        budget.interaction.together, (1,), lambda name: budget.interaction.together, budget.interaction.unsteady_px,
    )  # fmt: skip
    assert simulated[0].left_x_px == pytest.approx(in_x, rel=0.05) and simulated[0].left_y_px <= 1.1 * simulated[0].total_y_px


def test_no_number_of_frames_lowers_a_drift_whichever_number_stands() -> None:
    """A stabilised sensor shifts by 0.2 px: also by Monte Carlo, which is made to stand here by a sum that is far off."""
    cam = camera()
    cam = replace(cam, chain=(element("sensor.stabilisation", shift_std_px=0.2), *cam.chain))
    budget = computed(cam, None, KNOWN, trials=1024)
    together = budget.interaction.together
    off = [replace(r, contribution=replace(r.contribution, bias_x_px=1.0)) for r in budget.largest]
    found, (one, many) = headline(off, together, (1, 64), lambda name: together, budget.interaction.unsteady_px)
    assert found.by == "Monte Carlo" and one.u_x_px == pytest.approx(together.x.u, rel=0.2)
    # 6 standard errors of a standard deviation of 512 differences; divided by 64 frames it would be 0.025 px
    assert many.u_x_px == pytest.approx(0.2, rel=0.2) and many.left_y_px == pytest.approx(0.2, rel=0.2)
    assert budget.sums[-1].u_x_px == pytest.approx(0.2, rel=0.2)


def test_a_bias_alone_leaves_nothing_to_chance() -> None:
    """A cold clock is the same in all frames: the error of the Monte Carlo is what its places show."""
    cam = camera(element("grabber.clock_warm_up", scale_error_rel=0.0, delay_ns=70.0), shape=(96, 200))
    budget = computed(cam, None, KNOWN, trials=256)
    assert budget.headline.sum_px > 0.5
    assert budget.headline.se_simulated_px == pytest.approx(budget.interaction.together.se_total_px, abs=1e-3)


def test_kurtosis_of_rare_defects_is_that_of_their_simulation(seed: int) -> None:
    """Shifts by hot pixels of one size against 40 000 windows, in 6000 of which there is one: the fourth moment is good to some 5 %."""
    cam = camera(element("sensor.defects", hot_fraction=1e-3, hot_median_e=3000.0, hot_sigma_log=0.0))
    known = facts_of(cam, Target(), KNOWN)
    design = Trials(cam, Target(), FixedCentroid(), known, trials=40_000, frames=1, seed=seed)
    with_it, without = (design.errors(c)[0].ravel() for c in (cam.switched(on=["sensor.defects"]), cam.switched(on=())))
    shift = with_it - without
    got = get_source("sensor.defects").propagate(cam["sensor.defects"].params, make_probe(known, Target(), FixedCentroid()))
    assert got.kurtosis == pytest.approx((shift**4).mean() / (shift**2).mean() ** 2, rel=0.3) and got.kurtosis > 8


def test_the_record_is_plain_and_complete() -> None:
    record = computed(small_camera(), prnu(0.008, 0.0004), KNOWN, trials=256).to_record()
    again = json.loads(json.dumps(record, allow_nan=False))
    assert again["schema"] == "pixmetry/budget/1" and len(again["rows"]) == len(sources())
    assert again["verdicts"][0]["total_um"] is not None and again["interaction"]["together"]["x"]["u"] > 0
    assert again["estimator"]["threshold_dn"] == pytest.approx(1.8)


def test_a_parameter_that_the_source_does_not_have_is_refused() -> None:
    wrong = {"sensor.prnu": Estimates.from_rows([("sensitivity", 1.0, 0.1, 9.0, "1")])}
    with pytest.raises(InputError, match="sensitivity"):
        computed(small_camera(), wrong, KNOWN, trials=0)


def test_applies_reads_interface_and_sensor() -> None:
    source = get_source("cable.termination")
    assert applies(source, {"interface": "analogue"}) and not applies(source, {"interface": "digital"})
    assert applies(source, {})  # not told: it may be there
    assert applies(get_source("sensor.prnu"), {"interface": "digital", "sensor": "cmos"})
    for name, sensors in (("sensor.blooming", {"ccd"}), ("sensor.smear", {"ccd"}), ("electronics.telegraph_noise", {"cmos"})):
        assert {kind for kind in ("ccd", "cmos", "cid") if applies(get_source(name), {"sensor": kind})} == sensors, name


def test_variance_of_a_limit_is_that_of_numbers_spread_evenly_below_it() -> None:
    """Against SciPy's rectangular distribution from 0 to L; what is measured keeps its covariance, and none with the limit."""
    estimates = Estimates(
        ("pixel_std_rel", "row_std_rel", "col_std_rel"),
        np.array([0.012, 0.02, 0.03]),
        np.array([[1.0, 0.5, 0.2], [0.5, 4.0, 1.0], [0.2, 1.0, 9.0]]) * 1e-8,
        np.full(3, 20.0),
        ("1", "1", "1"),
        limits=frozenset({"pixel_std_rel"}),
    )
    expected = np.array([[uniform(0, 0.012).var(), 0, 0], [0, 4e-8, 1e-8], [0, 1e-8, 9e-8]])
    assert covariance_of(estimates) == pytest.approx(expected, rel=1e-12)
