"""What is wanted beside what is reached, how sources are measured, and the scale of a range of an entry on the object."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from pixmetry.budget.answer import Goal, how_to_measure
from pixmetry.budget.scenario import read_scenario
from pixmetry.budget.sweep import parse_sweep
from pixmetry.camera.catalogue import sources
from pixmetry.cli import main
from pixmetry.core.errors import InputError
from pixmetry.report.blocks import Block, block_diagram

SMALL = ("--set", "rows=200", "--set", "cols=240")


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["budget", "imx264_like", *SMALL, *map(str, arguments)])


@pytest.mark.parametrize(
    ("wanted", "verdict", "words"),
    [
        (0.06, "met", "no more than 0.05 mm"),
        (0.02, "met as far as known", "can raise it to 0.05 mm. Measure first: Hum."),
        (0.008, "not met as far as known", "What is known alone leaves 0.005 mm"),
        (0.004, "not met", "no less than 0.005 mm"),
    ],
)
def test_what_is_wanted_is_judged_over_the_interval(wanted: float, verdict: str, words: str) -> None:
    goal = Goal(wanted, reached=0.01, least=0.005, most=0.05, unit="mm", next_title="Hum")
    assert goal.verdict == verdict and words in goal.text


def test_a_goal_is_answered_in_its_unit(tmp_path: Path) -> None:
    data = tmp_path / "b.json"
    told = run("--set", "object.field_mm=100", "--set", "goal.u_mm=1", "--json", data, "--html", tmp_path / "b.html")
    assert told.exit_code == 0 and "1 mm in x and y is met" in told.output, told.output
    record = json.loads(data.read_text(encoding="utf-8"))
    assert record["goal"]["verdict"] == "met" and record["goal"]["reached"] == pytest.approx(max(record["answer"]["after_mm"]))
    assert "1 mm in x and y is met" in (tmp_path / "b.html").read_text(encoding="utf-8")
    told = run("--set", "goal.u_px=1e-6")
    assert "1e-06 px in x and y is not met" in told.output


def test_a_goal_on_the_object_needs_its_scale_and_one_unit() -> None:
    told = run("--set", "goal.u_mm=0.05")
    assert told.exit_code == 2 and "goal.u_mm" in told.output and len(told.output.strip().splitlines()) == 1
    with pytest.raises(InputError, match="u_px and u_mm say the same"):
        read_scenario({"goal": {"u_px": 0.1, "u_mm": 1.0}})


def test_every_source_says_how_it_is_measured() -> None:
    for source_id in sources():
        said = how_to_measure(source_id)
        assert said[0].isupper() or said.startswith("`"), source_id
        assert said.endswith(".") and not said.endswith(".."), source_id
    assert how_to_measure("no.source") == ""


def test_a_range_is_told_on_the_object_too_at_round_values() -> None:
    assert parse_sweep("state.grabber_on_min=5:240") == ("state.grabber_on_min", (5.0, 13.2, 34.6, 91.2, 240.0))
    told = run("--vary", "object.distance_mm=1000,2000", "--set", "object.f_mm=25")
    assert told.exit_code == 0 and "mm on the object" in told.output, told.output


def test_blocks_stand_in_one_row_or_two_and_are_told_in_words() -> None:
    for count in (1, 5, 9):
        drawn = block_diagram([Block(f"link {k}", 1 / count, ["1 mpx"]) for k in range(count)], "chain", "the total", "caption")
        assert drawn.alt.count("%") == count and drawn.svg.count("link") >= count
