"""A series that ends before saturation, or hidden dark noise, makes values lower limits; files and comparisons keep that."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from chance import rng_of
from emva.cameras import Camera
from emva.scoring import measured
from pixmetry.assess.judge.conformity import Limit, judge_value
from pixmetry.assess.judge.differences import Subject, difference_of
from pixmetry.core.number import LOWER_LIMIT, UPPER_LIMIT, VALUE, Number
from pixmetry.emva.evaluate import evaluate
from pixmetry.emva.files.json_format import sheet_json
from pixmetry.emva.files.sheets import read_sheet
from pixmetry.emva.files.xml_format import xml_text
from pixmetry.emva.records import DataSheet, Results

SHORT = Camera(seed=21, over=0.5, shape=(48, 64), levels=20, stack_frames=16)  # the light ends at half of saturation
LONG = replace(SHORT, over=1.1)
LOWER = ("u_p_sat", "u_e_sat", "SNR_max", "SNR_max_dB", "SNR_max_bit", "DR", "DR_dB", "DR_bit", "SNR_total_max")
GENERAL_LOWER = ("general_u_p_sat", "general_SNR_max", "general_SNR_max_dB", "general_SNR_total_max", "general_DR", "general_DR_dB")


@pytest.fixture(scope="module")
def short(request: pytest.FixtureRequest) -> dict[str, Results]:
    m = measured(replace(SHORT, seed=int(rng_of(request).integers(2**31))))
    return {release: evaluate(m, release, draws=300) for release in ("4.0", "3.1", "reference")}


def test_a_series_that_ends_early_gives_lower_limits_below_what_the_longer_one_shows(short: dict[str, Results]) -> None:
    found, whole = short["4.0"].values, evaluate(measured(LONG), "4.0", draws=300).values
    for key in (*LOWER, *GENERAL_LOWER):
        assert found[key].is_lower_limit and not found[key].is_upper_limit and "ends before saturation" in found[key].reason, key
        assert found[key].value < whole[key].value and not whole[key].is_lower_limit, key
    assert found["inverse_SNR_max"].is_upper_limit and found["inverse_SNR_max"].value > whole["inverse_SNR_max"].value
    assert found["LE"].reason.startswith("the series ends before saturation") and not found["LE"].is_lower_limit
    for key in ("K", "R", "sigma_d", "u_p_min", "DSNU1288", "PRNU1288"):
        assert not found[key].is_lower_limit and not found[key].is_upper_limit, key


def test_the_limit_is_that_of_one_side_at_95_percent(short: dict[str, Results]) -> None:
    """The last level holds 0.5 of the capacity: its root, less 1.645 u; the scales of one ratio say the same."""
    v = short["4.0"].values
    assert v["u_p_sat"].value == pytest.approx(SHORT.settings[1][-1])
    assert v["SNR_max"].value == pytest.approx(math.sqrt(SHORT.settings[1][-1] * SHORT.quantum_efficiency), rel=0.03)
    assert v["DR_dB"].value == pytest.approx(20 * math.log10(v["DR"].value))
    assert v["DR_bit"].value == pytest.approx(math.log2(v["DR"].value))


def test_the_scale_of_the_light_reaches_the_limit() -> None:
    v = evaluate(replace(measured(SHORT), photons_u_rel=0.05), "4.0", draws=300).values
    for key in ("u_p_sat", "general_u_p_sat"):
        assert v[key].u == pytest.approx(0.05 * SHORT.settings[1][-1], rel=1e-3), key
        assert v[key].value == pytest.approx(SHORT.settings[1][-1] * (1 - 1.6449 * 0.05), rel=1e-4), key


def test_the_other_releases(short: dict[str, Results]) -> None:
    """3.1 has the maximum of the variance for saturation, here its last level or, by noise, one before it; reference prints its numbers."""
    last = short["3.1"].values["index_u_ysat"].value == SHORT.levels - 1
    assert short["3.1"].values["u_e_sat"].is_lower_limit == last
    reference = short["reference"].values
    assert not any(v.is_lower_limit for v in reference.values())
    if reference["index_u_ysat"].value == SHORT.levels - 1:
        assert "lower bound" in reference["u_e_sat"].reason


def test_hidden_dark_noise_makes_the_dynamic_range_a_lower_limit() -> None:
    m = measured(Camera(seed=4, read_e=0.3, dark_e_per_s=0.0, dsnu_e=(0.0, 0.0, 0.0), shape=(32, 48), levels=16, stack_frames=16))
    v = evaluate(m, "4.0", draws=300).values
    assert v["u_e_min"].is_upper_limit and v["general_u_p_min"].is_upper_limit
    truth = (0.3**2 + 0.25) ** 0.5 + 0.5  # electrons, without the rounding
    for key in ("DR", "DR_dB", "DR_bit", "general_DR", "general_DR_dB"):
        assert v[key].is_lower_limit and v[key].reason, key
    assert v["DR"].value == pytest.approx(v["u_e_sat"].value / v["u_e_min"].value, rel=0.05)
    assert v["DR"].value < v["u_e_sat"].value / truth and v["general_DR"].value < v["u_e_sat"].value / truth
    assert not v["u_e_sat"].is_lower_limit


@pytest.mark.parametrize("ending", ["json", "xml"])
def test_files_keep_a_lower_limit(tmp_path: Path, short: dict[str, Results], ending: str) -> None:
    camera = {"name": "short", "bits": 12, "rows": 48, "cols": 64}
    sheet = DataSheet((short["4.0"],), camera, {}, {})
    path = tmp_path / f"sheet.{ending}"
    path.write_text((sheet_json if ending == "json" else xml_text)(sheet), encoding="utf-8")
    got = read_sheet(path).results[0].values
    for key in LOWER:
        assert got[key].is_lower_limit and got[key].value == short["4.0"].values[key].value and got[key].reason, key


@pytest.mark.parametrize(
    ("limit", "verdict"),
    [
        ({"min": 90.0}, "pass"),
        ({"min": 110.0}, "undecided"),
        ({"max": 90.0}, "fail"),
        ({"max": 110.0}, "undecided"),
        ({"min": 90.0, "max": 110.0}, "undecided"),
        ({"min": 10.0, "max": 90.0}, "fail"),
    ],
)
def test_limits_are_judged_by_what_the_lower_limit_tells(limit: dict[str, float], verdict: str) -> None:
    value = Number(100.0, 1.0, math.inf, "1", kind=LOWER_LIMIT)
    for rule in ("guarded_acceptance", "simple_acceptance", "guarded_rejection"):
        assert judge_value(value, Limit(**limit), rule, 0.95).verdict == verdict


@pytest.mark.parametrize(
    ("a", "b", "changes"),
    [
        ((100.0, ">"), (50.0, ""), True),  # at least 100 before, 50 now
        ((100.0, ">"), (150.0, ""), False),
        ((100.0, ""), (50.0, ">"), False),
        ((100.0, ""), (150.0, ">"), True),
        ((100.0, ">"), (50.0, ">"), False),
        ((100.0, "<"), (150.0, ">"), True),
        ((100.0, "<"), (50.0, ">"), False),
        ((100.0, ">"), (50.0, "<"), True),
        ((100.0, "<"), (150.0, ""), True),
        ((100.0, "<"), (50.0, ""), False),
    ],
)
def test_only_what_lies_beyond_a_limit_is_a_difference(a: tuple[float, str], b: tuple[float, str], changes: bool) -> None:
    def subject(number: float, mark: str, u: float) -> Subject:
        value = Number(number, u, math.inf, "1", kind={"<": UPPER_LIMIT, ">": LOWER_LIMIT, "": VALUE}[mark])
        return Subject("x", "data sheet", "4.0", {}, {("mono", "DR"): value}, {})

    row = difference_of(("mono", "DR"), subject(*a, 1.0), subject(*b, 1.0), False)
    assert (row.p < 1e-6) if changes else (row.verdict == "same" or row.p == 1.0)
    bare = difference_of(("mono", "DR"), subject(*a, 0.0), subject(*b, 0.0), False)
    assert bare.verdict == ("differs" if changes else "same")
