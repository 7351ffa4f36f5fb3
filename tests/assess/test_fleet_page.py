"""A fleet from folders of results: the odd camera, limits, drift over time, and the tables."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import stats

from data_sheets import measured, written
from pixmetry.assess.judge.fleet import fleet_report, result_files
from pixmetry.cli import main
from pixmetry.core.errors import InputError

START = datetime(2026, 1, 5, tzinfo=UTC)
U = {"K": 0.0002, "sigma_d": 0.03, "DSNU1288": 0.04}


def put(folder: Path, serial: str, values: dict[str, float], days: float = 0.0) -> Path:
    camera = {"name": "cam", "serial_number": serial}
    sheet = measured({key: (value, U[key]) for key, value in values.items()}, camera=camera)
    when = (START + timedelta(days=days)).isoformat(timespec="seconds")
    path = folder / serial / f"{days:g}" / "any_name.json"
    path.parent.mkdir(parents=True)
    return written(replace(sheet, provenance={"time_utc": when}), path)


def cameras(folder: Path, n: int = 12) -> None:
    """Cameras as evenly spread as none stands out; number 3 is far off in its dark noise."""
    for k in range(n):
        z = float(stats.norm.ppf((k + 0.5) / n))
        values = {"K": 0.28 + 0.002 * z, "sigma_d": 11 + 0.2 * z, "DSNU1288": 0.55 - 0.1 * z}
        put(folder, f"{k:04d}", values | ({"sigma_d": 16.0} if k == 3 else {}))


def test_the_odd_camera_is_named_and_the_tables_hold_all(tmp_path: Path) -> None:
    cameras(tmp_path / "in")
    done = CliRunner().invoke(main, ["fleet", str(tmp_path / "in"), "-o", str(tmp_path / "out")])
    assert done.exit_code == 1, done.stderr
    assert "12 cameras" in done.stdout and "cam 0003: sigma_d is +" in done.stdout
    found = json.loads((tmp_path / "out" / "fleet.json").read_text())
    assert [(odd["camera"], odd["key"], odd["beyond_the_band"]) for odd in found["odd"]] == [("cam 0003", "sigma_d", "fail")]
    rows = list(csv.DictReader((tmp_path / "out" / "values.csv").open()))
    assert len(rows) == 36 and [row["key"] for row in rows if row["stands_out"] == "True"] == ["sigma_d"]
    assert "cam 0003" in (tmp_path / "out" / "report.html").read_text()


def test_parquet_holds_the_same_as_csv(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    cameras(tmp_path / "in", 5)
    for out, more in (("a", []), ("b", ["--parquet"])):
        CliRunner().invoke(main, ["fleet", str(tmp_path / "in"), "-o", str(tmp_path / out), *more])
    table = parquet.read_table(tmp_path / "b" / "values.parquet").to_pydict()
    rows = list(csv.DictReader((tmp_path / "a" / "values.csv").open()))
    assert [float(row["value"]) for row in rows] == table["value"] and [row["camera"] for row in rows] == table["camera"]


def test_drift_is_the_weighted_slope_over_the_years(tmp_path: Path) -> None:
    """Slope and u against NumPy's weighted fit; the one camera that drifts by 10 u is named, the others are not."""
    gains = {"a": (0.2800, 0.2801, 0.2800), "b": (0.2800, 0.2810, 0.2820), "c": (0.2801, 0.2800, 0.2801)}
    days = (0.0, 100.0, 200.0)
    for serial, values in gains.items():
        for day, value in zip(days, values, strict=True):
            put(tmp_path, serial, {"K": value}, day)
    found = fleet_report([tmp_path])
    assert [(d.camera, d.drifts) for d in found.drifts] == [("cam b", True), ("cam a", False), ("cam c", False)] or not found.drifts[
        1
    ].drifts
    (drift,) = [d for d in found.drifts if d.camera == "cam b"]
    t = np.array(days) / 365.25
    slope, covariance = np.polyfit(t, gains["b"], 1, w=np.full(3, 1 / U["K"]), cov="unscaled")
    assert drift.per_year == pytest.approx(slope[0]) and drift.u_per_year == pytest.approx(covariance[0, 0] ** 0.5)
    assert drift.results == 3 and drift.drifts
    assert [m.path.parent.name for m in found.latest] == ["200"] * 3


def test_limits_have_guard_bands(tmp_path: Path) -> None:
    cameras(tmp_path / "in", 5)
    (tmp_path / "limits.yaml").write_text("schema: pixmetry/limits/1\nlimits: {sigma_d: {max: 11.28, unit: e-}}\n")
    found = fleet_report([tmp_path / "in"], limits=tmp_path / "limits.yaml")
    verdicts = {camera: rows[0].judgement.verdict for camera, rows in found.limits.items()}
    # values 10.74, 10.90, 11, 16 (odd), 11.26: the last is 0.7 u below the limit
    assert verdicts == {"cam 0000": "pass", "cam 0001": "pass", "cam 0002": "pass", "cam 0003": "fail", "cam 0004": "undecided"}
    assert not found.good


def test_what_is_no_fleet_is_refused(tmp_path: Path) -> None:
    put(tmp_path, "a", {"K": 0.28})
    put(tmp_path, "a", {"K": 0.28}, 5.0)
    with pytest.raises(InputError, match="three cameras or more"):
        fleet_report([tmp_path])
    (tmp_path / "empty").mkdir()
    for folder, words in (("empty", "no results below"), ("nowhere", "no such file")):
        with pytest.raises(InputError, match=words):
            result_files(tmp_path / folder)
