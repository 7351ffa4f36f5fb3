"""`pixmetry budget`: what it prints and writes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from pixmetry.budget.answer import Answer
from pixmetry.budget.sweep import Step, Sweep
from pixmetry.cli import main

SMALL = ("--set", "rows=200", "--set", "cols=240")
SHEET = """schema: pixmetry/data_sheet/1
name: a sheet
rows: 200
cols: 240
pitch_um: 3.45
bits: 12
sensor: cmos
saturation_capacity_e: 10400
read_noise_e: 2.3
lens: {f_mm: 25, f_number: 4}
"""


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["budget", *map(str, arguments)])


def test_a_data_sheet_and_a_distance_give_millimetres(tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.yaml"
    sheet.write_text(SHEET, encoding="utf-8")
    files = {"--html": tmp_path / "b.html", "--json": tmp_path / "b.json"}
    told = run(sheet, "--set", "object.distance_mm=2000", *(a for pair in files.items() for a in pair))
    assert told.exit_code == 0, told.output
    assert "on the object" in told.output and "Z " in told.output and "from the sheet" in told.output
    record = json.loads(files["--json"].read_text(encoding="utf-8"))
    assert record["px_per_mm"] == pytest.approx(25 / 1975 / 3.45e-3)
    assert record["answer"]["after_mm"][0] == pytest.approx(record["answer"]["after_px"][0] / record["px_per_mm"])
    page = files["--html"].read_text(encoding="utf-8")
    for words in ("Uncertainty of a position", "What to measure next", "The handbook&#x27;s error table", "<svg"):
        assert words in page or words.replace("&#x27;", "'") in page or words.replace("&#x27;", "’") in page, words


def test_next_tells_only_what_to_do() -> None:
    told = run("imx264_like", *SMALL, "--next")
    assert told.exit_code == 0, told.output
    assert "To measure next" in told.output and "To change next" in told.output and "known" not in told.output.splitlines()[0]


def test_all_shows_every_row_and_the_defaults() -> None:
    told = run("imx264_like", *SMALL, "--all")
    assert "not in this camera" in told.output and "count.rays: 2 (default)" in told.output


def test_a_range_of_an_entry_is_a_table_and_a_figure(tmp_path: Path) -> None:
    page, data = tmp_path / "b.html", tmp_path / "b.json"
    told = run("imx264_like", *SMALL, "--vary", "target.diameter_px=5,10", "--html", page, "--json", data)
    assert told.exit_code == 0, told.output
    steps = json.loads(data.read_text(encoding="utf-8"))["sweep"]["steps"]
    assert [s["value"] for s in steps] == [5.0, 10.0]
    assert steps[1]["answer"]["least_px"][0] < steps[0]["answer"]["least_px"][0]  # a larger target is better known
    assert "target.diameter_px" in told.output and "Over target.diameter_px" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("no_such_camera",), "no such camera"),
        (("imx264_like", "--scenario", "nowhere.yaml"), "no such scenario"),
        (("imx264_like", "--set", "motion.sped=3"), "sped"),
        (("imx264_like", "--set", "target.diameter_px=600"), "diameter_px"),
        (("imx264_like", "--estimator", "magic"), "estimator"),
        (("imx264_like", "--vary", "target.diameter_px=3"), "FROM:TO"),
        (("imx264_like", "--vary", "target.diameter=3:4"), "diameter_px"),
    ],
)
def test_what_cannot_be_used_is_told_in_one_line(arguments: tuple[str, ...], words: str) -> None:
    told = run(*arguments)
    assert told.exit_code == 2
    lines = [line for line in told.output.splitlines() if line.startswith("error:")]
    assert len(lines) == 1 and words in lines[0], told.output


@pytest.mark.parametrize(
    ("totals", "steady"),
    [((1.9, 1.0, 0.2, 0.083, 0.082), 4.0), ((1.0, 1.01, 1.02), None), ((3.0, 2.0, 1.0), None), ((2.0, 1.0, 1.05), 2.0)],
)
def test_a_sweep_tells_from_where_on_the_total_hardly_changes(totals: tuple[float, ...], steady: float | None) -> None:
    """As a grabber that warms up: the first value after which nothing changes; none where that is the first or the last."""
    answers = [Answer(*[(total, total)] * 4) for total in totals]
    sweep = Sweep("state.grabber_on_min", tuple(Step(k + 1.0, answer, "") for k, answer in enumerate(answers)))
    assert sweep.steady_from == steady
    assert sweep.sentence == ("" if steady is None else f"From state.grabber_on_min {steady:g} on, the total changes by less than 10 %.")
