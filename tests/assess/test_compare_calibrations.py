"""Calibrations compared: what changed of a camera between two, and its limits."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from pixmetry.assess.judge.compare import check_limits, compare
from pixmetry.assess.judge.subjects import load_subject
from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.files.record import calibration_json
from pixmetry.calibrate.records import Calibration
from pixmetry.cli import main
from pixmetry.core.errors import InputError
from report.calibrations import full

LIMITS = "schema: pixmetry/limits/1\nlimits:\n  sigma0: {max: 100, unit: '1'}\n  k1: {min: 1, unit: mm^-2}\n"


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return full(np.random.default_rng(3))


def written(folder: Path, calibration: Calibration, **steps_in_u: float) -> Path:
    """The folder of a calibration whose parameters are so many of their u larger."""
    a = calibration.adjustment
    names, covariance = a.interior_covariance(0)
    interior = a.state.interior.copy()
    for name, step in steps_in_u.items():
        u = math.sqrt(covariance[names.index(name), names.index(name)]) if name in names else 1.0
        interior[0, NAMES.index(name)] += step * u
    folder.mkdir()
    moved = replace(calibration, adjustment=replace(a, state=replace(a.state, interior=interior)))
    (folder / "calibration.json").write_text(calibration_json(moved), encoding="utf-8")
    return folder


def test_says_what_changed_and_by_how_much(calibration: Calibration, tmp_path: Path) -> None:
    """3 u of one side are 2.1 u of the difference, which chance brings about; 12 u are 8.5, which it does not."""
    one, two = written(tmp_path / "a", calibration), written(tmp_path / "b", calibration, c=12.0, xp=-3.0)
    result = compare(one, two)
    rows = {row.key: row for row in result.rows}
    assert rows["c"].verdict == "changed" and rows["xp"].verdict == "same" and result.kind == "calibration"
    assert rows["c"].in_u == pytest.approx(12 / math.sqrt(2), rel=1e-6) and rows["xp"].in_u == pytest.approx(-3 / math.sqrt(2), rel=1e-6)
    assert rows["c"].dof == pytest.approx(2 * calibration.adjustment.dof)  # two u alike, each with as many
    assert {row.key for row in result.of("changed")} == {"c"} and set(rows) == {"sigma0", *NAMES[:12]}
    assert compare(one, one / "calibration.json").same


def test_what_was_held_fast_is_compared_as_a_number(calibration: Calibration, tmp_path: Path) -> None:
    free = calibration.adjustment.interior_covariance(0)[0]
    fixed = next(name for name in NAMES if name not in free)
    result = compare(written(tmp_path / "a", calibration), written(tmp_path / "b", calibration, **{fixed: 1e-3}))
    assert {row.key for row in result.of("differs")} == {fixed} and not result.of("changed")


def test_the_command_takes_folders_and_limits(calibration: Calibration, tmp_path: Path) -> None:
    one, two = written(tmp_path / "a", calibration), written(tmp_path / "b", calibration, c=12.0)
    done = CliRunner().invoke(main, ["compare", str(one), str(two), "--json", str(tmp_path / "out.json")])
    assert done.exit_code == 1 and "1 changed" in done.output, done.output
    record = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))["comparison"]
    assert [row["key"] for row in record["rows"] if row["verdict"] == "changed"] == ["c"]
    (tmp_path / "limits.yaml").write_text(LIMITS.replace("mm^-2", load_subject(one).values["mono", "k1"].unit))
    checked = {row.key: row.judgement.verdict for row in check_limits(one, tmp_path / "limits.yaml")}
    assert checked == {"sigma0": "pass", "k1": "fail"}


def test_kinds_do_not_mix_and_damage_is_told(calibration: Calibration, tmp_path: Path) -> None:
    one = written(tmp_path / "a", calibration)
    path = one / "calibration.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    del record["checksums"], record["cameras"][0]["parameters"][0]["unit"]
    path.write_text(json.dumps(record), encoding="utf-8")
    with pytest.raises(InputError, match="damaged calibration"):
        load_subject(one)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"folder without results\.json or calibration\.json"):
        load_subject(tmp_path / "empty")
