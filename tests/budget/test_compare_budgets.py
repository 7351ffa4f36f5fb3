"""Budgets side by side: which is the best, how sure that is, what makes the difference, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

import pixmetry
from pixmetry.budget.camera_budget import CameraBudget
from pixmetry.budget.compare import LIKELY, OPEN, SAME, SURE, compare_budgets
from pixmetry.budget.compare_page import page_of, sentences
from pixmetry.budget.scenario import Scenario
from pixmetry.budget.table import AT_BOUND, MEASURED, TYPICAL, Parts, SourceRow
from pixmetry.budget.table import SHEET as FROM_SHEET
from pixmetry.camera.camera import load_camera
from pixmetry.cli import main
from pixmetry.core.errors import InputError
from pixmetry.files.results import write_json
from pixmetry.report import html_of

CAMERA = replace(load_camera("imx264_like"), frame_shape=(120, 160))
SHEET = """schema: pixmetry/data_sheet/1
name: a sheet
rows: 120
cols: 160
pitch_um: 3.45
bits: 12
sensor: cmos
saturation_capacity_e: 10400
read_noise_e: 2.3
"""


@pytest.fixture(scope="module")
def budget() -> CameraBudget:
    return pixmetry.budget(CAMERA)


def row(name: str, status: str, after: float, largest: float | None = None) -> SourceRow:
    parts = [None if v is None else Parts(place_px=(v, v)) for v in (2 * after, after, largest)]
    return SourceRow(name, name, name.title(), 0, 0, status, "F", *parts)


def given(budget: CameraBudget, rows: Sequence[SourceRow], camera: str = "one") -> CameraBudget:
    return replace(budget, rows=tuple(rows), setting=replace(budget.setting, described=replace(CAMERA, name=camera)))


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


def test_exposure_times_that_differ_are_told_and_can_be_made_equal(tmp_path: Path) -> None:
    """A sheet exposes for 10 ms, an assessed camera as its campaign did: dark current, among others, grows with that."""
    short, long = (tmp_path / name for name in ("short.yaml", "long.yaml"))
    short.write_text(SHEET + "exposure_s: 0.001\n", encoding="utf-8")
    long.write_text(SHEET + "exposure_s: 0.02\n", encoding="utf-8")
    result = run("budget", short, long, "--compare")
    assert result.exit_code == 0 and "do not expose equally long" in result.output and "20.0 ms" in result.output
    equal = run("budget", short, long, "--compare", "--set", "exposure_s=0.005")
    assert "expose equally" not in equal.output and "the same within 1 %" in equal.output


def test_identity_of_one_budget_twice(budget: CameraBudget) -> None:
    found = compare_budgets([budget, budget])
    assert found.ranks[1].verdict == SAME and found.ranks[1].ratio == 1 and not found.settings
    assert "the same within 1 %" in sentences(found)[0]


def test_intervals_that_do_not_overlap_are_sure(budget: CameraBudget) -> None:
    good = given(budget, [row("noise", MEASURED, 0.003), row("bend", TYPICAL, 0.001, 0.004)])
    bad = given(budget, [row("noise", MEASURED, 0.006), row("bend", TYPICAL, 0.001, 0.004)], camera="two")
    found = compare_budgets([bad, good], names=["bad", "good"])
    assert found.best.name == "good" and found.ranks[1].verdict == SURE and not found.ranks[1].overlaps
    assert found.ranks[1].ratio == pytest.approx((37 / 10) ** 0.5)
    (noise,) = (r for r in found.rows if r.source_id == "noise")
    assert noise.shares[0] == pytest.approx(1.0) and found.rows[0] is noise


def test_what_is_not_known_of_one_camera_is_the_same_in_both_its_budgets(budget: CameraBudget) -> None:
    """The same bend of one sensor cannot turn the order, that of another sensor can."""
    good, bad = ([row("noise", MEASURED, u), row("bend", TYPICAL, 0.001, 0.05)] for u in (0.003, 0.006))
    same = compare_budgets([given(budget, good), given(budget, bad)])
    assert same.ranks[1].verdict == SURE and same.ranks[1].overlaps
    other = compare_budgets([given(budget, good), given(budget, bad, camera="two")])
    assert other.ranks[1].verdict == LIKELY and other.ranks[1].open_sources == ("Bend",)
    assert "likely, not sure" in sentences(other)[0]


def test_a_common_source_that_helps_the_worse_one_leaves_it_open(budget: CameraBudget) -> None:
    """Of one camera too: where the better one suffers more from what is not known, the order may turn."""
    good = given(budget, [row("noise", MEASURED, 0.003), row("bend", TYPICAL, 0.002, 0.02)])
    bad = given(budget, [row("noise", MEASURED, 0.006), row("bend", TYPICAL, 0.001, 0.01)])
    assert compare_budgets([good, bad]).ranks[1].verdict == OPEN


def test_sources_at_their_bound_widen_and_do_not_count(budget: CameraBudget) -> None:
    good = given(budget, [row("noise", MEASURED, 0.003), row("hum", AT_BOUND, 0.01, 0.01)])
    bad = given(budget, [row("noise", MEASURED, 0.006)], camera="two")
    found = compare_budgets([good, bad])
    assert found.ranks[0].side == 0 and found.ranks[1].verdict == OPEN and found.ranks[1].open_sources == ("Hum",)
    assert {r.source_id for r in found.rows} == {"noise"}


def test_lenses_are_compared_on_the_object_and_scenarios_that_differ_are_told(tmp_path: Path) -> None:
    lenses = [pixmetry.budget(CAMERA, {"object": {"distance_mm": 2000, "f_mm": f}}) for f in (16, 50)]
    found = compare_budgets(lenses, names=["16 mm", "50 mm"])
    assert found.unit == "mm" and found.best.name == "50 mm" and found.settings == {"object.f_mm": (16.0, 50.0)}
    told = found.best.size(found.best.answer.after_px, "mm")
    x, y = lenses[1].mm(lenses[1].one.after_px)
    assert told == pytest.approx((0.5 * (x**2 + y**2)) ** 0.5)
    assert found.best.depth_mm == pytest.approx(lenses[1].point.u_mm[2])
    for r in found.rows:
        assert len(r.sizes) == len(r.shares) == 2
    assert sum(r.shares[0] for r in found.rows) == pytest.approx(1.0)
    page = html_of(page_of(found))
    for words in ("Which is the best", "Where the difference comes from", "Field of view", "object.f_mm"):
        assert words in page
    path = [tmp_path / f"{n}.json" for n in ("a", "b")]
    for file, one in zip(path, lenses, strict=True):
        write_json(file, one.to_record())
    assert compare_budgets(path).to_record()["rows"] == found.to_record()["rows"]  # files say what the budgets say


def test_pixels_of_two_sizes_are_told(budget: CameraBudget) -> None:
    other = replace(budget, setting=replace(budget.setting, described=replace(CAMERA, pitch_um=(7.0, 7.0))))
    assert any("not of the same size" in words for words in sentences(compare_budgets([budget, other])))


def test_command_with_files_and_with_cameras(tmp_path: Path, budget: CameraBudget) -> None:
    files = [tmp_path / "before.json", tmp_path / "after.json"]
    write_json(files[0], budget.to_record())
    quiet = [replace(r, after=Parts.of([0.5 * v for v in r.after.values_px])) if r.after else r for r in budget.rows]
    write_json(files[1], replace(budget, rows=tuple(quiet)).to_record())
    page, data = tmp_path / "c.html", tmp_path / "c.json"
    told = run("compare", *files, "--html", page, "--json", data, "--pdf", tmp_path / "c.pdf")
    assert told.exit_code == 0, told.output
    assert "after is better than before, 2.00 times" in told.output and (tmp_path / "c.pdf").read_bytes().startswith(b"%PDF")
    record = json.loads(data.read_text(encoding="utf-8"))["comparison"]
    assert record["best"] == "after" and record["ranks"][1]["ratio"] == pytest.approx(2.0) and "<svg" in page.read_text(encoding="utf-8")
    sheets = [tmp_path / "16.yaml", tmp_path / "25.yaml"]
    for sheet in sheets:
        sheet.write_text(SHEET + f"lens: {{f_mm: {sheet.stem}, f_number: 4}}\n", encoding="utf-8")
    told = run("budget", *sheets, "--compare", "--set", "object.distance_mm=2000")
    assert told.exit_code == 0, told.output
    assert "25 is better than 16" in told.output and "do not see the same field" in told.output


def test_what_cannot_be_compared_is_told_in_one_line(tmp_path: Path, budget: CameraBudget) -> None:
    good, bad, other = (tmp_path / f"{n}.json" for n in ("good", "bad", "other"))
    record = json.loads(json.dumps(budget.to_record(), default=str))
    write_json(good, budget.to_record())
    record["rows"][0]["after"]["place_px"] = [1.0, 1.0]
    write_json(bad, record)
    write_json(other, {"schema": "pixmetry/results/9"})
    sheet = tmp_path / "s.yaml"
    sheet.write_text(SHEET, encoding="utf-8")
    cases = [
        (("compare", good, bad), "damaged budget"),
        (("compare", good, other), "not an error budget"),
        (("compare", good, tmp_path / "none.json"), "cannot be read"),
        (("compare", good, good, "--limits", other), "--limits"),
        (("compare", other, other, "--html", tmp_path / "x.html"), "--html"),
        (("budget", sheet, "--compare"), "two cameras"),
        (("budget", sheet, sheet, "--compare", "--next"), "--next"),
    ]
    for arguments, words in cases:
        told = run(*arguments)
        assert told.exit_code == 2 and words in told.output and len(told.output.strip().splitlines()) == 1, (arguments, told.output)
    with pytest.raises(InputError, match="one budget"):
        compare_budgets([budget])


def test_lenses_on_one_camera_do_not_share_what_is_not_known_of_the_lens(budget: CameraBudget) -> None:
    """Two budgets of one camera: an unmeasured distortion is the same in both with one lens, and another with another lens."""
    lens = row("optics.distortion", TYPICAL, 0.001, 0.05)
    better, worse = (given(budget, [row("noise", MEASURED, size), lens]) for size in (0.003, 0.006))
    assert compare_budgets([better, worse]).ranks[1].verdict == SURE
    other = replace(worse, setting=replace(worse.setting, scenario=Scenario.model_validate({"object": {"f_mm": 33.0}})))
    found = compare_budgets([better, other]).ranks[1]
    assert found.verdict == LIKELY and found.open_sources == (lens.title,)


@pytest.mark.parametrize("status", [MEASURED, FROM_SHEET])
def test_a_number_with_an_uncertainty_may_be_smaller_as_well_as_larger(budget: CameraBudget, status: str) -> None:
    """.0030 up to .0036 beside .0037 up to .0080 overlap, for the second may be as small as 0; up to .0038 it may not."""
    better = given(budget, [row("noise", status, 0.0030, 0.0036)])
    verdicts = [
        compare_budgets([better, given(budget, [row("noise", status, 0.0037, most)], "two")]).ranks[1] for most in (0.0080, 0.0037001)
    ]
    assert [r.verdict for r in verdicts] == [LIKELY, SURE]
    assert verdicts[0].open_sources == ("Noise",)
