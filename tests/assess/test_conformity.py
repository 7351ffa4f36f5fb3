"""Pass and fail by JCGM 106: its own examples, integrals of the distributions, and what the rules promise of false decisions."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate, stats

from data_sheets import measured, value
from pixmetry.assess.judge.conformity import Limits, check, judge, judge_value, load_limits
from pixmetry.assess.judge.subjects import load_subject
from pixmetry.core.errors import InputError, ParameterError
from pixmetry.core.number import LOWER_LIMIT, UPPER_LIMIT, Number

ALPHA = 1e-6  # false failures of the statistical tests


@pytest.mark.parametrize(
    ("y", "u", "lower", "upper", "printed"),
    [
        (-5.47, 0.05, -math.inf, -5.40, 0.92),  # breakdown voltage of a Zener diode, V
        (507.1, 8.6, 490.0, math.inf, 0.98),  # bursting strength of a container, kPa
        (13.6, 1.8, 12.5, 16.3, 0.66),  # kinematic viscosity of a motor oil, mm²/s
    ],
)
def test_published_conformance_probabilities(y: float, u: float, lower: float, upper: float, printed: float) -> None:
    """The examples of JCGM 106:2012, 7.3 and 7.4, to the two digits that are printed there."""
    assert round(judge(y, u, lower=lower, upper=upper).probability, 2) == printed


@pytest.mark.parametrize("dof", [1.0, 4.0, 30.0, math.inf])
@pytest.mark.parametrize(("lower", "upper"), [(-math.inf, 1.3), (-0.4, math.inf), (-0.4, 1.3)])
def test_probability_is_the_integral_of_the_density(dof: float, lower: float, upper: float) -> None:
    density = stats.norm(0.5, 0.7).pdf if math.isinf(dof) else stats.t(dof, 0.5, 0.7).pdf
    expected = integrate.quad(density, lower, upper, epsabs=1e-12)[0]
    assert judge(0.5, 0.7, dof, lower, upper).probability == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("dof", [3.0, 25.0, math.inf])
@pytest.mark.parametrize("confidence", [0.9, 0.95, 0.99])
def test_one_limit_the_guard_band_is_the_quantile(dof: float, confidence: float) -> None:
    k = (stats.norm if math.isinf(dof) else stats.t(dof)).ppf(confidence)
    for lower, upper, sign in ((-math.inf, 8.0, -1), (8.0, math.inf, 1)):
        edge = 8.0 + sign * k * 0.3
        found = judge(edge + sign * 1e-9, 0.3, dof, lower, upper, confidence=confidence)
        assert found.verdict == "pass" and found.guard_band == pytest.approx(k * 0.3)
        assert judge(edge - sign * 1e-9, 0.3, dof, lower, upper, confidence=confidence).verdict == "undecided"
        beyond = 8.0 - sign * k * 0.3
        assert judge(beyond + sign * 1e-9, 0.3, dof, lower, upper, confidence=confidence).verdict == "undecided"
        assert judge(beyond - sign * 1e-9, 0.3, dof, lower, upper, confidence=confidence).verdict == "fail"
        assert found.acceptance == pytest.approx((lower, edge) if sign < 0 else (edge, upper))


@pytest.mark.parametrize("u", [0.01, 0.5, 0.7, 1.0])
def test_two_limits_the_acceptance_limit_conforms_with_the_confidence(u: float) -> None:
    """With a wide u one tail is not enough: 1.645 u would accept values that conform with less than 95 %."""
    found = judge(0.0, u, lower=-2.0, upper=2.0)
    low, high = found.acceptance
    assert (low, high) == pytest.approx((-high, -low))
    assert stats.norm.cdf((2 - high) / u) - stats.norm.cdf((-2 - high) / u) == pytest.approx(0.95, abs=1e-9)
    assert found.guard_band >= 1.6448536 * u


def test_limit_u_too_large_accepts_nothing() -> None:
    found = judge(0.0, 1.1, lower=-2.0, upper=2.0)  # conforms with 93 % at best
    assert found.verdict == "undecided" and math.isnan(found.acceptance[0]) and "too large" in found.reason
    assert judge(9.0, 1.1, lower=-2.0, upper=2.0).verdict == "fail"


def test_limit_without_uncertainty_all_rules_agree() -> None:
    for y, verdict in ((1.0, "pass"), (2.0, "pass"), (2.1, "fail")):
        for rule in ("guarded_acceptance", "simple_acceptance", "guarded_rejection"):
            assert judge(y, 0.0, lower=0.0, upper=2.0, rule=rule).verdict == verdict


def test_rules_differ_in_the_guard_band_only() -> None:
    for y, verdicts in ((1.5, "pass pass pass"), (1.9, "undecided pass pass"), (2.1, "undecided fail pass"), (2.4, "fail fail fail")):
        rules = ("guarded_acceptance", "simple_acceptance", "guarded_rejection")
        assert [judge(y, 0.2, lower=0.0, upper=2.0, rule=rule).verdict for rule in rules] == verdicts.split()
    assert judge(1.9, 0.2, upper=2.0, rule="guarded_rejection").guard_band == pytest.approx(-0.2 * stats.norm.ppf(0.95))


@pytest.mark.parametrize("n", [3, 8])
def test_stat_false_decisions_are_as_rare_as_promised(n: int, rng: np.random.Generator) -> None:
    """Quantities right at the limit, u from n readings: 5 % are passed and 5 % failed.

    Catches with 99 %: 3.9 % or 6.1 % instead (of 20 000 trials, standard error 0.15 %).
    """
    readings = rng.normal(2.0, 1.0, (20_000, n))
    means, u = readings.mean(axis=1), readings.std(axis=1, ddof=1) / math.sqrt(n)
    verdicts = [judge(y, s, n - 1.0, upper=2.0).verdict for y, s in zip(means, u, strict=True)]
    for verdict in ("pass", "fail"):
        assert stats.binomtest(verdicts.count(verdict), len(verdicts), 0.05).pvalue > ALPHA, verdict


def test_what_is_not_known_is_undecided() -> None:
    assert judge(math.nan, 0.1, upper=2.0).verdict == "undecided"
    assert judge(1.0, math.nan, upper=2.0).verdict == "undecided"
    assert judge(1.0, math.nan, upper=2.0, rule="simple_acceptance").verdict == "pass"


def test_upper_limits_are_held_against_limits() -> None:
    bound = Number(0.4, 0.1, 50.0, "e⁻", kind=UPPER_LIMIT)

    lower_bound = Number(0.4, 0.1, 50.0, "e⁻", kind=LOWER_LIMIT)

    def verdict(bound: Number = bound, **given: float | str) -> str:
        limits = Limits.model_validate({"schema": "pixmetry/limits/1", "limits": {"DSNU1288": {"unit": "e-", **given}}})
        (row,) = check({("mono", "DSNU1288"): bound}, limits)
        assert row.judgement == judge_value(bound, limits.limits["DSNU1288"], "guarded_acceptance", 0.95)
        return row.judgement.verdict

    assert verdict(max=0.41) == "pass"
    assert verdict(max=0.39) == "undecided"
    assert verdict(min=0.1, max=0.5) == "undecided"
    assert verdict(min=0.41) == "fail"
    assert verdict(lower_bound, min=0.39) == "pass" and verdict(lower_bound, max=0.39) == "fail"
    assert verdict(lower_bound, min=0.41) == verdict(lower_bound, min=0.1, max=0.5) == verdict(lower_bound, max=0.41) == "undecided"


@pytest.mark.parametrize(
    "wrong", [{"u": -1.0}, {"dof": 0.0}, {"lower": 3.0}, {"rule": "hope"}], ids=["negative u", "no dof", "order", "rule"]
)
def test_arguments_that_cannot_be(wrong: dict) -> None:
    with pytest.raises(ParameterError):
        judge(**{"value": 1.0, "u": 0.1, "upper": 2.0, **wrong})


GOOD = """\
schema: pixmetry/limits/1
limits:
  K: {min: 0.27, max: 0.29, unit: DN/e-}
  DR: {min: 1000}
  sigma_d: {max: 11, unit: e⁻, rule: simple_acceptance}
  PRNU1288: {max: 0.5, unit: "%"}
"""
SHEET = measured({"K": (0.28, 0.002), "DR": (1000.0, 9.0), "sigma_d": (10.9, 0.4)})


def test_file_of_limits(tmp_path: Path) -> None:
    path = tmp_path / "limits.yaml"
    path.write_text(GOOD)
    rows = {row.key: row.judgement for row in check(load_subject(SHEET).values, load_limits(path))}
    assert {key: j.verdict for key, j in rows.items()} == {"K": "pass", "DR": "undecided", "sigma_d": "pass", "PRNU1288": "undecided"}
    assert rows["DR"].probability == pytest.approx(0.5) and rows["sigma_d"].rule == "simple_acceptance"
    assert "no value" in rows["PRNU1288"].reason


def test_each_channel_is_judged() -> None:
    limits = Limits.model_validate({"schema": "pixmetry/limits/1", "limits": {"DR": {"min": 900}}})
    values = {(c, "DR"): value(x, 1.0) for c, x in (("R", 1000.0), ("B", 800.0))}
    found = {row.channel: row for row in check(values, limits)}
    assert {channel: row.judgement.verdict for channel, row in found.items()} == {"R": "pass", "B": "fail"}
    kept, broken = found["R"].finding, found["B"].finding
    assert (kept.level, kept.advice, broken.level) == ("note", "", "error") and broken.advice
    assert broken.text == "DR [B] does not keep its limits." and broken.numbers == {"value": values["B", "DR"], "min": 900}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("limits/1", "limits/2", ["another kind"]),
        ("DR: {min", "DR: {mn", ["unknown key", "line 4"]),
        ("min: 1000", "", ["neither min nor max"]),
        ("min: 0.27, max: 0.29", "min: 0.29, max: 0.27", ["not below"]),
        ("min: 1000", "min: 1 k", ["not a number"]),
        ("rule: simple_acceptance", "rule: hope", ["rule"]),
        ("schema: pixmetry/limits/1\n", "schema: pixmetry/limits/1\nconfidence: 95\n", ["confidence", "line 2", "above 0.5 and below 1"]),
        ("max: 0.29", "max: 0,29", ["line", "decimal comma", "0.29"]),
        ("unit: DN/e-", "unit: DN", ["limits.yaml, line ", ": K: ", "another unit", "DN/e⁻"]),
        (", unit: DN/e-", "", ["limits.yaml, line ", ": K: ", "lacks its unit", "DN/e⁻"]),
        ("PRNU1288:", "PRNU1289:", ["limits.yaml, line ", "no such key", "PRNU1288"]),
        (GOOD[26:], "limits: {}\n", ["limits"]),
        (GOOD, "", ["missing"]),
        (GOOD, "- 1\n", ["keys with values"]),
    ],
)
def test_bad_limits_give_one_clear_error(old: str, new: str, words: list[str], tmp_path: Path) -> None:
    assert old in GOOD
    path = tmp_path / "limits.yaml"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(InputError) as caught:
        check(load_subject(SHEET).values, load_limits(path))
    assert all(word in str(caught.value) for word in words) and "\n" not in str(caught.value), caught.value
