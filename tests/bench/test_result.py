"""What `pixmetry view` shows of a result is what its files hold."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pixmetry.bench.result import MOST_SIDE, read_result
from pixmetry.core.errors import InputError
from pixmetry.files.images import write_frame
from pixmetry.files.results import write_json, write_maps

RECORD = {
    "schema": "pixmetry/results/1",
    "camera": {"name": "seven", "bits": 12},
    "estimates": {"sensor.prnu": [{"name": "pixel_std_rel", "value": 0.01, "u": 0.001}]},
    "budget": {"rows": [{"name": "sensor.prnu", "source_id": "sensor.prnu", "total_px": 0.002, "parts": {"time_px": [0.001, 0.002]}}]},
    "points": {"name": ["a", "b"], "x": [1.0, 2.0]},
}
POSITIONS = "# a comment\nimage,x_px,y_px,residual_x_px,residual_y_px\nfirst,10.5,20.25,0.01,-0.02\nsecond,30,,0.5,\n"


def folder(path: Path) -> Path:
    write_json(path / "results.json", RECORD)
    write_maps(path / "maps.zarr.zip", {"prnu_map_percent": np.arange(12.0).reshape(3, 4), "line": np.arange(5.0)}, {})
    (path / "residuals.csv").write_text(POSITIONS)
    return path


def test_tables_maps_and_positions_of_a_folder(tmp_path: Path) -> None:
    found = read_result(folder(tmp_path))
    tables = {t.name: t for t in found.tables}
    assert found.kind == "pixmetry/results/1"
    assert tables["camera"].rows == (("name", "seven"), ("bits", 12))
    assert tables["estimates.sensor.prnu"].rows == (("pixel_std_rel", 0.01, 0.001),) and found.tables[0].name == "budget.rows"
    assert tables["budget.rows"].columns == ("name", "source_id", "total_px", "parts.time_px")
    assert tables["points"].rows == (("a", 1.0), ("b", 2.0))
    assert tables["residuals.csv"].rows == (("first", 10.5, 20.25, 0.01, -0.02), ("second", 30.0, None, 0.5, None))
    (shown,) = found.maps
    record = shown.to_record()
    values = np.frombuffer(base64.b64decode(record["data"]), "<f4").reshape(record["rows"], record["cols"])
    assert shown.name == "prnu_map_percent" and np.array_equal(values, np.arange(12.0).reshape(3, 4))


def test_a_picture_is_the_first_map_and_a_large_one_is_thinned(tmp_path: Path) -> None:
    (tmp_path / "found.csv").write_text(POSITIONS)
    write_frame(tmp_path / "a.png", np.full((40, 2 * MOST_SIDE), 7, np.uint8), 8)
    found = read_result(tmp_path / "found.csv", [tmp_path / "a.png"])
    record = found.maps[0].to_record()
    assert found.maps[0].name == "a.png" and record["step"] == 2 and (record["rows"], record["cols"]) == (20, MOST_SIDE)
    json.dumps(found.to_record(), allow_nan=False)


def test_pictures_are_found_beside_the_result_and_in_a_folder(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    (tmp_path / "found.csv").write_text(POSITIONS.replace("first", "a.png").replace("second", "b.png"))
    write_frame(tmp_path / "a.png", np.zeros((4, 5), np.uint8), 8)
    write_frame(tmp_path / "pictures" / "b.png", np.zeros((4, 5), np.uint8), 8)
    write_frame(tmp_path / "pictures" / "other.png", np.zeros((4, 5), np.uint8), 8)
    assert [m.name for m in read_result(tmp_path / "found.csv").maps] == ["a.png"]
    assert [m.name for m in read_result(tmp_path / "found.csv", [tmp_path / "pictures"]).maps] == ["a.png", "b.png"]
    with pytest.raises(InputError, match="no such picture"):
        read_result(tmp_path / "found.csv", [tmp_path / "none.png"])


def test_records_by_name_are_one_table_and_matrices_are_maps(tmp_path: Path) -> None:
    values = {name: {"value": k, "u": 0.1, "unit": "DN"} for k, name in enumerate(("K", "QE", "DR"))}
    estimates = {f"sensor.{s}": [{"name": n, "value": 1.0, "u": 0.1} for n in "ab"] for s in ("prnu", "dsnu")}
    matrix = [[float(r * c) for c in range(9)] for r in range(8)]
    write_json(tmp_path / "a.json", {"schema": "x", "results": values, "estimates": estimates, "part": {"matrix": matrix}})
    found = read_result(tmp_path / "a.json")
    tables = {t.name: t for t in found.tables}
    assert tables["results"].columns == ("of", "value", "u", "unit") and tables["results"].rows[1] == ("QE", 1, 0.1, "DN")
    assert [row[:2] for row in tables["estimates"].rows] == [(f"sensor.{s}", n) for s in ("prnu", "dsnu") for n in "ab"]
    assert [(m.name, m.to_record()["rows"], m.to_record()["cols"]) for m in found.maps] == [("part.matrix", 8, 9)]


def test_what_is_damaged_or_no_result_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.json").write_text("{")
    (tmp_path / "bad.csv").write_text("a,a\n1,2\n")
    (tmp_path / "sealed.json").write_text(json.dumps({"schema": "x", "a": 1, "checksums": {"files": {}, "record": "0"}}))
    for name in ("empty", "bad.json", "bad.csv", "sealed.json", "no-such"):
        with pytest.raises(InputError):
            read_result(tmp_path / name)


def test_the_server_gives_the_result_to_who_has_the_link(tmp_path: Path) -> None:
    pytest.importorskip("starlette")
    pytest.importorskip("httpx2")
    from starlette.testclient import TestClient

    from pixmetry.bench.server import app_of_result

    with TestClient(app_of_result(read_result(folder(tmp_path)), "token", 8352), base_url="http://127.0.0.1:8352") as client:
        told: Any = client.get("/token/result").json()
        assert told["maps"] == ["prnu_map_percent"] and len(told["tables"]) == 5
        assert client.get("/token/map/0").json()["rows"] == 3
        assert client.get("/token/map/1").status_code == 404
        assert b"view.js" in client.get("/token/").content
        assert client.get("/other/result").status_code == 403
        assert client.get("/token/result", headers={"Origin": "http://evil.example"}).status_code == 403
