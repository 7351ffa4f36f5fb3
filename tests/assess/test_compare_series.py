"""Series of a camera that warms up, compared over months, and held against limits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from click.testing import CliRunner
from tests.series.fixed_field import CENTRE, SHAPE, TIME_S, Warming

from pixmetry.assess.judge.compare import check_limits, compare, compare_fleet
from pixmetry.cli import main
from pixmetry.files.results import write_record
from pixmetry.series.modes import field_motion
from pixmetry.series.records import Series
from pixmetry.series.warm_up import drift_of

LIMITS = "schema: pixmetry/limits/1\nlimits:\n  shift_x_px: {max: 0.25, unit: px}\n  stable_s: {max: 36000, unit: s}\n"


def written(folder: Path, camera: Warming, rng: np.random.Generator, time_s: np.ndarray = TIME_S) -> Path:
    """The folder of results of a series of that camera."""
    motion = field_motion(*camera.positions(rng, 0.01, time_s), tuple(CENTRE))
    folder.mkdir()
    found = Series(drift_of(motion, time_s, SHAPE), tuple(map(str, time_s)), SHAPE)
    write_record(folder / "series.json", found.to_record())
    return folder


def test_a_camera_that_moves_farther_is_found(tmp_path: Path, rng: np.random.Generator) -> None:
    before = written(tmp_path / "march", Warming(0.15, 0.1, slow_s=1500.0), rng)
    after = written(tmp_path / "june", Warming(0.35, 0.1, slow_s=1500.0), rng)
    rows = {row.key: row for row in compare(before, after).rows}
    assert rows["shift_x_px"].verdict == "changed" and abs(rows["shift_x_px"].difference - 0.2) < 6 * rows["shift_x_px"].u
    assert {"shift_y_px", "scale_rel", "slow_s", "stable_s"} <= set(rows)
    (tmp_path / "limits.yaml").write_text(LIMITS)
    verdicts = {row.key: row.judgement.verdict for row in check_limits(after, tmp_path / "limits.yaml")}
    assert verdicts == {"shift_x_px": "fail", "stable_s": "pass"}


def test_what_a_short_series_does_not_tell_has_its_reason(tmp_path: Path, rng: np.random.Generator) -> None:
    whole = written(tmp_path / "a", Warming(0.15, 0.1), rng)
    short = written(tmp_path / "b", Warming(0.15, 0.1), rng, np.arange(12) * 10.0)
    rows = {row.key: row for row in compare(whole, short).rows}
    assert rows["slow_s"].verdict == "only A" and "series" in rows["slow_s"].reason


def test_months_of_a_camera_are_a_fleet(tmp_path: Path, rng: np.random.Generator) -> None:
    months = [written(tmp_path / str(k), Warming(1.5 if k == 3 else 0.15, 0.1), rng) for k in range(6)]
    out = {
        name
        for row in compare_fleet(months).rows
        if row.key == "shift_x_px"
        for name, far in zip(map(str, months), row.stands_out, strict=True)
        if far
    }
    assert str(months[3]) in out and len(out) < len(months)
    result = CliRunner().invoke(main, ["compare", *map(str, months[:2]), "--all"])
    assert result.exit_code in (0, 1) and "shift_x_px" in result.output
