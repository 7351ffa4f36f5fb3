"""What changed between two measurements: the statistics, what cannot be compared, and the command."""

from __future__ import annotations

import copy
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from scipy import stats

from data_sheets import full, measured, sheet, value, written
from pixmetry.assess.judge.compare import Comparison, check_limits, compare, compare_fleet
from pixmetry.assess.judge.conformity import load_limits
from pixmetry.assess.judge.differences import SAME_THING, holm
from pixmetry.cli import main
from pixmetry.core.errors import InputError
from pixmetry.core.number import Number
from pixmetry.emva.files.keys import KEYS
from pixmetry.emva.records import DataSheet

ALPHA = 1e-6  # false failures of the statistical tests
A = {"K": (0.2800, 0.0002), "sigma_d": (10.90, 0.03), "DSNU1288": (0.55, 0.04), "QE": (45.2, 1.4), "PRNU1288": (0.4327, 0.0005)}


def verdicts(result: Comparison) -> dict[str, str]:
    return {row.key: row.verdict for row in result.rows}


def test_published_welch_test(rng: np.random.Generator) -> None:
    """Difference, degrees of freedom and chance are those of Welch's test on the readings themselves (SciPy)."""
    draw = rng
    for n, m in ((4, 9), (30, 5), (2, 2)):
        x, y = draw.normal(0, 1, n), draw.normal(0.5, 3, m)
        sheets = [measured({"K": (float(v.mean()), float(v.std(ddof=1) / math.sqrt(len(v))))}, dof=len(v) - 1.0) for v in (x, y)]
        (row,) = compare(*sheets).rows
        expected = stats.ttest_ind(y, x, equal_var=False)
        assert row.in_u == pytest.approx(expected.statistic, rel=1e-9)
        assert row.dof == pytest.approx(expected.df, rel=1e-9)
        assert row.p == pytest.approx(expected.pvalue, rel=1e-7)


def test_what_changed_is_found_in_u() -> None:
    result = compare(measured(A), measured(A | {"sigma_d": (11.20, 0.04)}))
    assert verdicts(result) == {"K": "same", "sigma_d": "changed", "DSNU1288": "same", "QE": "same", "PRNU1288": "same"}
    (row,) = result.of("changed")
    assert row.difference == pytest.approx(0.3) and row.u == pytest.approx(0.05) and row.in_u == pytest.approx(6.0)
    assert not result.same and result.decisions == 5


def test_identity_of_copies(tmp_path: Path) -> None:
    """A sheet against itself, in any format: limits, missing values, places in the series and all."""
    one = full()
    paths = [written(one, tmp_path / "a.json"), written(one, tmp_path / "a.xml")]
    for other in (one, *paths):
        result = compare(one, other)
        assert result.same and any("identical" in note for note in result.notes)
        assert {row.verdict for row in result.rows} <= {"same", "equal"}


def test_holm_is_the_step_down_of_its_definition(rng: np.random.Generator) -> None:
    draw = rng
    for _ in range(200):
        p = draw.uniform(size=7) ** 4
        expected = set()
        left = set(range(7))
        while left and (least := min(left, key=lambda i: p[i])) is not None and p[least] <= 0.05 / len(left):
            expected.add(least)
            left.discard(least)
        assert holm(p.tolist(), list(range(7)), 0.05) == (expected, 7)
    assert holm([0.03, 0.9, math.nan, 0.001], ["a", "b", "c", "a"], 0.05) == (set(), 2)
    assert holm([0.02, 0.9, math.nan, 0.9], ["a", "b", "c", "a"], 0.05) == ({0, 3}, 2)


def test_keys_that_say_the_same_are_one_decision() -> None:
    assert set(SAME_THING) | set(SAME_THING.values()) <= set(KEYS)
    numbers = {"K": (0.28, 0.0002), "inverse_K": (1 / 0.28, 0.0002 / 0.28**2), "DR": (1000.0, 10.0), "DR_dB": (60.0, 0.087)}
    result = compare(measured(numbers), measured(numbers | {"K": (0.285, 0.0002), "inverse_K": (1 / 0.285, 0.0002 / 0.285**2)}))
    assert result.decisions == 2
    assert verdicts(result) == {"K": "changed", "inverse_K": "changed", "DR": "same", "DR_dB": "same"}


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_stat_false_alarms_are_as_rare_as_promised(rho: float, rng: np.random.Generator) -> None:
    """One camera measured twice, 1500 times, 20 values, correlated or not: at most 5 % of the comparisons see a change.

    Of independent values the rate is 4.9 %, so there it is tested from both sides. Catches with 99 %: a u of the difference that is 8 % too
    small or 12 % too large.
    """
    draw = rng
    keys = [key for key in KEYS if key not in SAME_THING and not key.startswith("index_")][:20]
    alarms, trials = 0, 1500
    for _ in range(trials):
        both = []
        for u in (0.5, 0.2):
            errors = u * (math.sqrt(rho) * draw.normal() + math.sqrt(1 - rho) * draw.normal(size=20))
            both.append(measured({key: (5.0 + float(e), u) for key, e in zip(keys, errors, strict=True)}))
        alarms += not compare(*both).same
    sided = "two-sided" if rho == 0 else "greater"
    assert stats.binomtest(alarms, trials, 0.05, sided).pvalue > ALPHA, alarms


def test_common_light_is_taken_off() -> None:
    """A calibration of 3 % common to both hides a change of 1 % in QE, and not in K."""
    photons = {"conditions": {"photons_u_rel": 0.03}}
    u = math.hypot(0.03 * 45.0, 0.05)
    numbers = {"QE": (45.0, u), "K": (0.28, 0.0002), "R": (0.126, 0.126 * 0.03)}
    one, two = measured(numbers, **photons), measured(numbers | {"QE": (45.45, math.hypot(0.03 * 45.45, 0.05))}, **photons)
    assert compare(one, two).same
    result = compare(one, two, same_light=True)
    assert verdicts(result)["QE"] == "changed"
    assert result.rows[0].u == pytest.approx(math.hypot(0.05, 0.05), rel=1e-6)
    assert result.rows[1].u == pytest.approx(math.hypot(0.0002, 0.0002))


def limit(number: float, u: float = 0.1) -> Number:
    return Number(number, u, math.inf, "e⁻", "", "noise", "upper_limit")


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        (limit(0.5), limit(0.9), "same"),
        (limit(0.5), value(0.1, 0.01, unit="e⁻"), "same"),
        (limit(0.5), value(0.6, 0.01, unit="e⁻"), "same"),
        (limit(0.5), value(1.5, 0.01, unit="e⁻"), "changed"),
        (value(1.5, 0.01, unit="e⁻"), limit(0.5), "changed"),
        (value(0.1, 0.01, unit="e⁻"), limit(0.5), "same"),
        (limit(0.5, math.nan), value(0.6, 0.01, unit="e⁻"), "changed"),
        (limit(0.5), value(1.5, unit="e⁻"), "undecided"),
    ],
)
def test_beside_a_limit_only_what_lies_above_it_counts(a: Number, b: Number, expected: str) -> None:
    assert verdicts(compare(sheet({"DSNU1288": a}), sheet({"DSNU1288": b}))) == {"DSNU1288": expected}


def test_numbers_without_uncertainty_are_compared_as_numbers() -> None:
    one = {"K": 0.28, "DR": 1000.0, "R": 0.126, "index_u_ysat": 36.0, "DSNU1288_pixel": math.nan}
    two = {"K": 0.28 * (1 + 5e-10), "DR": 1000.0 * (1 + 5e-9), "R": 0.126, "index_u_ysat": 37.0, "DSNU1288_pixel": math.nan}
    plain = [sheet({k: value(v, unit=KEYS[k].unit) for k, v in numbers.items()}, release="") for numbers in (one, two)]
    result = compare(*plain)
    assert verdicts(result) == {"K": "equal", "DR": "differs", "R": "equal", "index_u_ysat": "differs", "DSNU1288_pixel": "same"}
    with_u = measured({"K": (0.28 + 1e-10, 0.001), "DR": (1001.0, 5.0), "index_u_ysat": (30.0, 0.0)})
    result = compare(with_u, plain[1])
    assert verdicts(result) == {
        "K": "equal", "DR": "undecided", "index_u_ysat": "setting", "R": "only B", "DSNU1288_pixel": "same",
    }  # fmt: skip
    assert any("releases differ" in note for note in result.notes)
    assert result.of("undecided")[0].in_u == pytest.approx(-0.2, rel=1e-4)


def test_what_cannot_be_compared_is_said() -> None:
    result = compare(sheet({"K": value(0.28, 0.01, unit="DN/e⁻")}), sheet({"K": value(0.28, 0.01, unit="e⁻/DN")}))
    assert verdicts(result) == {"K": "undecided"} and "units differ" in result.rows[0].reason
    gone = sheet({"K": value(math.nan, unit="DN/e⁻", reason="too dark")})
    (row,) = compare(sheet({"K": value(0.28, 0.01, unit="DN/e⁻")}), gone).rows
    assert (row.verdict, row.reason) == ("only A", "too dark")
    with pytest.raises(InputError, match="no channel in common"):
        compare(full(("R",)), full(("B",)))
    result = compare(full(("R", "B")), full(("R", "Gr")))
    assert {row.channel for row in result.rows} == {"R"} and any("channels B, Gr" in note for note in result.notes)
    result = compare(measured(A, camera={"name": "1", "bits": 12}), measured(A, camera={"name": "2", "bits": 12}))
    assert any("name differs: 1, 2" in note for note in result.notes) and not any("bits" in note for note in result.notes)


def fleet(draw: np.random.Generator, n: int, keys: int = 12) -> list[DataSheet]:
    names = [key for key in KEYS if key not in SAME_THING and not key.startswith("index_")][:keys]
    return [measured({key: (10.0 + float(x), 0.1) for key, x in zip(names, row, strict=True)}) for row in draw.normal(size=(n, keys))]


@pytest.mark.parametrize("n", [5, 12])
def test_stat_fleet_of_equals_has_no_odd_one(n: int, rng: np.random.Generator) -> None:
    """Of 300 normal fleets at most 5 % have a camera that stands out. Catches with 99 %: a spread of 12 cameras that is 25 % too small."""
    draw = rng
    alarms = sum(not compare_fleet(fleet(draw, n)).same for _ in range(300))
    assert stats.binomtest(alarms, 300, 0.05, "greater").pvalue > ALPHA, alarms


def test_stat_spread_is_the_standard_deviation(rng: np.random.Generator) -> None:
    """Of 3000 cameras: the standard error of three quarters of the distances is 1.7 %. Catches with 99 %: a factor wrong by 13 %."""
    for row in compare_fleet(fleet(rng, 3000, 2)).rows:
        assert abs(row.spread - 1.0) < 5.1 * 0.91 / math.sqrt(3000), row.spread


def test_fleet_names_the_odd_one(rng: np.random.Generator) -> None:
    """Two of twelve cameras are far off in one value, and do not hide each other; the others have it as evenly as none stands out."""
    sheets = fleet(rng, 12)
    for i, old in enumerate(sheets):
        even = 60.0 if i in (3, 7) else 10.0 + float(stats.norm.ppf((i + 0.5) / 12))
        values = old.results[0].values
        sheets[i] = sheet({**values, "K": value(even, 0.1, unit=values["K"].unit)})
    result = compare_fleet(sheets, names=[f"camera {i}" for i in range(12)])
    row = next(row for row in result.rows if row.key == "K")
    assert [i for i, out in enumerate(row.stands_out) if out] == [3, 7]
    assert 5 < row.median < 15 and row.scores[3] > 10


def test_small_fleet_says_what_it_cannot_tell() -> None:
    """Among three cameras, one that is 30 of their own spreads away does not stand out; a note says why. Of five there is none."""
    for n in (3, 4, 5):
        sheets = [measured({"K": (0.28 + 0.001 * i, 1e-5)}) for i in range(n - 1)] + [measured({"K": (0.31, 1e-5)})]
        result = compare_fleet(sheets)
        assert any(f"{n} cameras hardly determine their spread" in note for note in result.notes) == (n < 5)
        assert result.same or n > 3


def test_limits_from_python(tmp_path: Path) -> None:
    path = tmp_path / "limits.yaml"
    path.write_text("schema: pixmetry/limits/1\nlimits: {K: {max: 0.281, unit: DN/e-}, sigma_d: {max: 10, unit: e-}}\n")
    for limits in (path, load_limits(path)):
        assert [(row.key, row.judgement.verdict) for row in check_limits(measured(A), limits)] == [("K", "pass"), ("sigma_d", "fail")]


def test_fleet_with_holes_and_copies() -> None:
    sheets = [measured(A)] * 4 + [sheet({"K": value(math.nan, unit="DN/e⁻"), "DSNU1288": limit(0.3)})]
    result = compare_fleet(sheets)
    assert result.same
    row = next(row for row in result.rows if row.key == "K")
    assert math.isnan(row.values[4]) and math.isnan(row.scores[4]) and row.scores[:4] == (0.0,) * 4
    json.dumps(result.to_record(), allow_nan=False)
    with pytest.raises(InputError, match="three cameras"):
        compare_fleet(sheets[:2])


ESTIMATE = {
    "name": "gain_dn_per_e",
    "value": 0.28,
    "u": 0.001,
    "dof": 50.0,
    "unit": "DN/e-",
    "kind": "value",
    "method": "fit",
    "reason": "",
}
ASSESSMENT = {
    "schema": "pixmetry/results/1",
    "camera": {"name": "one", "bits": 12},
    "estimates": {
        "electronics.gain": [ESTIMATE],
        "sensor.dsnu": [ESTIMATE | {"name": "row_std_e", "value": 0.2, "kind": "upper_limit", "dof": None, "unit": "e-"}],
        "sensor.smear": [ESTIMATE | {"name": "ratio", "value": 0.01, "unit": "1"}],
    },
    "unmeasured": {},
    "photon_transfer": {"estimates": [ESTIMATE]},
    "budget": {
        "target": {"kind": "disc", "diameter_px": 7.0},
        "estimator": {"name": "template"},
        "rows": [
            {
                "name": "sensor.shot_noise",
                "status": "modelled",
                "total_px": 0.0123,
                "u_of_total_px": 0.0,
                "contribution": {"model_error": 0.1, "floor_px": 2e-4, "gum_class": "T", "time_px": [0.003, 0.003]},
            }
        ],
        "headline": {"by": "sum", "se_simulated_px": 0.001},
        "verdicts": [{"total_px": 0.0123, "frames": 1}],
        "with_accepted": [{"total_px": 0.0123, "frames": 1}],
    },
}


def assessment(folder: Path, gain: float = 0.28, smear: bool = True) -> Path:
    record = copy.deepcopy(ASSESSMENT)
    record["estimates"]["electronics.gain"][0]["value"] = gain
    if not smear:
        del record["estimates"]["sensor.smear"]
        record["unmeasured"]["sensor.smear"] = "no bright spots"
    folder.mkdir()
    (folder / "results.json").write_text(json.dumps(record))
    return folder


def test_assessments_are_compared(tmp_path: Path) -> None:
    one, two = assessment(tmp_path / "a"), assessment(tmp_path / "b", 0.29, smear=False)
    result = compare(one, two / "results.json")
    assert result.kind == "assessment"
    assert verdicts(result) == {
        "electronics.gain.gain_dn_per_e": "changed",
        "sensor.dsnu.row_std_e": "same",
        "sensor.smear.ratio": "only A",
        "photon_transfer.gain_dn_per_e": "changed",
        "budget.target.diameter_px": "equal",
        "budget.sensor.shot_noise": "same",
        "budget.verdict.1_frames": "same",
        "budget.with_accepted.1_frames": "same",
        "budget.estimator": "equal",
        "budget.target": "equal",
    }
    assert result.of("only A")[0].reason == "no bright spots"
    assert any("0.0123" in note for note in result.notes)
    assert compare(one, one).same


def test_what_a_calibration_leaves_is_compared(tmp_path: Path) -> None:
    """A row of which half is left changes by half, with the same relative u; the totals likewise; and the note says both."""
    for name, left in (("a", 0.006), ("b", 0.009)):
        budget = json.loads((assessment(tmp_path / name) / "results.json").read_text())
        for part in ("rows", "verdicts", "with_accepted"):
            budget["budget"][part][0]["calibrated_px"] = left
        (tmp_path / name / "results.json").write_text(json.dumps(budget))
    result = compare(tmp_path / "a", tmp_path / "b")
    found = {row.key: row for row in result.rows}
    assert found["budget.sensor.shot_noise"].verdict == found["budget.verdict.1_frames"].verdict == "same"
    for key in ("budget.sensor.shot_noise.calibrated", "budget.verdict.1_frames.calibrated", "budget.with_accepted.1_frames.calibrated"):
        assert found[key].verdict == "changed" and found[key].a.value == 0.006
        assert found[key].b.u == pytest.approx(0.009 * math.hypot(0.05, 0.001 / 0.28))
    assert any("0.0123, 0.0123 px, 0.006, 0.009 px after a calibration" in note for note in result.notes)


def test_the_gain_is_one_cause_for_all_rows_of_a_budget(tmp_path: Path) -> None:
    """Four equal rows scale with the gain together: it moves the total by its own 0.36 %, not by half of that."""
    record = json.loads((assessment(tmp_path / "a") / "results.json").read_text())
    row = record["budget"]["rows"][0] | {"total_px": 0.01, "status": "measured"}
    record["budget"]["rows"] = [row | {"name": f"sensor.source_{k}"} for k in range(4)]
    record["budget"]["verdicts"][0]["total_px"] = 0.02
    (tmp_path / "a" / "results.json").write_text(json.dumps(record))
    total = next(r for r in compare(tmp_path / "a", tmp_path / "a").rows if r.key == "budget.verdict.1_frames")
    assert total.a.u == pytest.approx(0.02 * 0.001 / 0.28)


def test_the_budget_of_assessments_is_compared(tmp_path: Path) -> None:
    """A worse verdict is a change in u: of a modelled row half of its declared model error, 5 %, and the gain's 0.36 %."""
    one = assessment(tmp_path / "a")
    record = json.loads((one / "results.json").read_text())
    budget = record["budget"]
    for part in (budget["rows"][0], budget["verdicts"][0], budget["with_accepted"][0]):
        part["total_px"] = 0.0200
    budget["target"]["diameter_px"], budget["estimator"] = 5.0, {"name": "fixed_soft_threshold", "window": 13, "sigma": 3.0}
    two = tmp_path / "b"
    two.mkdir()
    (two / "results.json").write_text(json.dumps(record))
    result = compare(one, two)
    found = verdicts(result)
    assert found["budget.verdict.1_frames"] == found["budget.sensor.shot_noise"] == "changed" and not result.same
    assert found["budget.target.diameter_px"] == found["budget.estimator"] == "differs"
    row = next(r for r in result.rows if r.key == "budget.verdict.1_frames")
    assert row.u == pytest.approx(math.hypot(0.0123, 0.02) * math.hypot(0.05, 0.001 / 0.28), rel=1e-6)
    assert "template" in next(r.reason for r in result.rows if r.key == "budget.estimator")
    assert not any("identical" in note for note in result.notes) and any("estimator differ" in note for note in result.notes)
    json.dumps(result.to_record(), allow_nan=False)
    assert result.decisions == 3  # gain (in two places), smear, and the total: its one row, the verdict, that with what is accepted
    budget["headline"] = {"by": "Monte Carlo", "se_simulated_px": 0.001}
    (two / "results.json").write_text(json.dumps(record))
    by_chance = next(r for r in compare(two, two).rows if r.key == "budget.verdict.1_frames")
    assert by_chance.a.u == pytest.approx(math.hypot(0.02 * math.hypot(0.05, 0.001 / 0.28), 0.001))


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["compare", *(str(a) for a in arguments)], env={"COLUMNS": "120"})


def test_command_says_what_changed(tmp_path: Path) -> None:
    one = written(measured(A), tmp_path / "a.json")
    two = written(measured(A | {"sigma_d": (11.20, 0.04)}), tmp_path / "b.xml")
    result = run(one, two, "--json", tmp_path / "out.json")
    assert result.exit_code == 1, result.output
    line = next(line for line in result.output.splitlines() if line.startswith("sigma_d"))
    assert re.search(r"10\.900 ± 0\.030\s+11\.200 ± 0\.040\s+\+0\.30\s+\+6\.0\s+changed", line), line
    record = json.loads((tmp_path / "out.json").read_text())
    rows = {row["key"]: row for row in record["comparison"]["rows"]}
    assert rows["sigma_d"]["verdict"] == "changed" and rows["sigma_d"]["in_u"] == pytest.approx(6.0)
    assert record["comparison"]["same"] is False
    assert run(one, one).exit_code == 0
    assert "PRNU1288" in run(one, one, "--all").output
    assert run(two, two).exit_code == 0


def test_command_judges_limits(tmp_path: Path) -> None:
    one = written(measured(A), tmp_path / "a.json")
    limits = tmp_path / "limits.yaml"
    limits.write_text("schema: pixmetry/limits/1\nlimits:\n  K: {min: 0.27, max: 0.29, unit: DN/e-}\n")
    good = run(one, "--limits", limits)
    assert good.exit_code == 0 and "pass" in good.output, good.output
    limits.write_text("schema: pixmetry/limits/1\nlimits:\n  DSNU1288: {max: 0.5, unit: e-}\n  K: {max: 0.1, unit: DN/e-}\n")
    bad = run(one, "--limits", limits, "--json", tmp_path / "out.json")
    assert bad.exit_code == 1 and "undecided" in bad.output and "fail" in bad.output
    rows = json.loads((tmp_path / "out.json").read_text())["limits"]
    assert [(row["key"], row["verdict"]) for row in rows] == [("DSNU1288", "undecided"), ("K", "fail")]
    assert rows[0]["probability"] == pytest.approx(stats.norm.cdf((0.5 - 0.55) / 0.04))


def test_command_shows_names_as_they_are(tmp_path: Path) -> None:
    """Brackets in names of files and colours are no mark-up."""
    path = written(full(("R", "B")), tmp_path / "[red]x.json")
    limits = tmp_path / "limits.yaml"
    limits.write_text("schema: pixmetry/limits/1\nlimits: {K: {max: 1, unit: DN/e-}}\n")
    output = run(path, path, "--all", "--limits", limits).output
    assert "[red]x.json" in output and "K [R]" in output and "K [B]" in output


def test_command_finds_who_stands_out(tmp_path: Path, rng: np.random.Generator) -> None:
    sheets = fleet(rng, 9)
    sheets[4] = sheet({**sheets[4].results[0].values, "K": value(90.0, 0.1, unit="DN/e⁻")})
    paths = [written(s, tmp_path / f"c{i}.json") for i, s in enumerate(sheets)]
    result = run(*paths, "--json", tmp_path / "out.json")
    assert result.exit_code == 1
    assert "c4.json" in next(line for line in result.output.splitlines() if line.startswith("K "))
    assert json.loads((tmp_path / "out.json").read_text())["comparison"]["schema"] == "pixmetry/fleet/1"


def test_bad_input_gives_one_line(tmp_path: Path) -> None:
    good = written(measured(A), tmp_path / "a.json")
    old = assessment(tmp_path / "old")
    broken = tmp_path / "broken.json"
    broken.write_text('{"schema": "pixmetry/results/1", "estimates": 3}')
    scene = tmp_path / "scene.json"
    scene.write_text('{"schema": "pixmetry/scene/1"}')
    empty = tmp_path / "empty"
    empty.mkdir()
    limits = tmp_path / "limits.yaml"
    limits.write_text("schema: pixmetry/limits/1\nlimits: {K: {max: 1}}\n")
    pair = tmp_path / "pair.json"
    pair.write_text("[1,2]")
    for arguments, word in (
        ((good,), "one file cannot be compared"),
        ((good, tmp_path / "none.json"), "cannot be read"),
        ((good, empty), "without results.json"),
        ((good, old), "a data sheet and"),
        ((good, good, old), "several kinds"),
        ((good, broken), "damaged results"),
        ((good, scene), "no data sheet, assessment, calibration or series"),
        ((good, limits), "neither JSON nor XML"),
        ((good, pair), "a JSON list"),
        ((good, good, "--level", "95"), "level"),
        ((good, good, good, "--same-light"), "two files"),
        ((good, "--limits", limits), "lacks its unit"),
        ((good, "--limits", tmp_path / "none.yaml"), "cannot be read"),
        ((good, good, "--json", good / "out.json"), "the folder does not exist"),
        ((good, good, "--json", tmp_path), "is a folder"),
        ((good, good, "--json", limits), "no result of this kind"),
    ):
        result = run(*arguments)
        assert result.exit_code == 2, (arguments, result.output)
        (line,) = [line for line in result.output.splitlines() if line.startswith("error:")]
        assert word in line, line
        assert "Traceback" not in result.output and not isinstance(result.exception, KeyError)
