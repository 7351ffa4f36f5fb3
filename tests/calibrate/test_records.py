"""Records of a calibration: to JSON and back, in a notebook, and as data frames."""

from __future__ import annotations

import base64
import json
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calibrate.networks import simulate
from pixmetry.calibrate.bundle.solve import Options, calibrate_network
from pixmetry.calibrate.files.record import _record, _stored, calibration_json
from pixmetry.calibrate.records import (
    AxisComponent,
    CameraComponents,
    FieldTest,
    NetworkRecord,
    Pattern,
    Tests,
    read_record,
    record_of,
)
from pixmetry.core.errors import InputError
from pixmetry.files.strict_json import json_text, plain


@pytest.fixture(scope="module")
def calibration():
    simulated = simulate(np.random.default_rng(1), images=8, points=30)
    return calibrate_network(simulated.network, Options(), simulated.truth)


def test_records_come_back_as_they_were(calibration):
    """Whatever the tests hold: text, back, and text again; NaN is None on the way."""
    text = json_text(record_of(calibration.tests))
    back = read_record(Tests, json.loads(text))
    assert json_text(record_of(back)) == text
    assert back.network.sizes == calibration.tests.network.sizes and back.parameters == calibration.tests.parameters
    np.testing.assert_array_equal(back.projection["camera"].u_px, calibration.tests.projection["camera"].u_px)


def test_what_is_joined_stands_among_the_fields_of_its_owner():
    x, y = (AxisComponent(s, 0.1, 0.2, None, float("inf"), 1.0, 50.0, True) for s in (0.03, 0.04))
    record = record_of(CameraComponents(3, False, True, x, y))
    assert list(record)[:5] == ["iterations", "common", "by_axis", "sigma_x_px", "u_sigma_x_px"]
    assert (record["sigma_y_px"], record["factor_x"], record["estimated_y"]) == (0.04, 1.0, True)
    assert read_record(CameraComponents, json.loads(json_text(record))) == CameraComponents(3, False, True, x, y)


def test_parts_that_were_not_made_are_left_out_and_missing_ones_are_none():
    assert record_of(Tests()) == {} and not Tests().made
    assert record_of(FieldTest("fixed", None, "untested")) == {"verdict": "fixed", "text": "untested"}
    assert "period_px" not in record_of(Pattern("radius", "a", 0.1, None, 0.5))
    old = read_record(Tests, {"network": {"images": 3, "sigma0": None}, "patterns": [{"name": "radius", "p": 0.5}]})
    assert old.network.sizes.images == 3 and np.isnan(old.network.sigma0) and isinstance(old.network, NetworkRecord)
    assert old.patterns[0].p == 0.5 and old.patterns[0].by_image is None and old.known is None


def test_a_calibration_says_in_one_line_what_it_is(calibration):
    a = calibration.adjustment
    assert repr(calibration).startswith(f"<Calibration of camera: 8 images, {a.used.sum()} image points, sigma0 ")
    page = calibration._repr_html_()
    assert f"<td>c</td><td>{a.camera()['c']:.8g}</td>" in page and page.count("<tr>") == a.network.cameras[0].free.sum()


@pytest.mark.parametrize(("table", "rows"), [("parameters", 12), ("points", 30), ("poses", 8), ("residuals", None)])
def test_tables_become_data_frames(calibration, monkeypatch, table, rows):
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))  # which holds columns as pandas does
    frame = calibration.to_dataframe(table)
    count = len(calibration.adjustment.network) if rows is None else rows
    assert {len(values) for values in frame.values()} == {count}
    if table == "parameters":
        place = frame["parameter"].index("k1")
        names, covariance = calibration.adjustment.interior_covariance()
        assert frame["u"][place] == pytest.approx(np.sqrt(covariance[names.index("k1"), names.index("k1")]))
        assert frame["estimated"].count(True) == len(names)


def test_without_pandas_one_error_says_what_to_do(calibration, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="pandas is not installed"):
        calibration.to_dataframe()
    with pytest.raises(InputError, match="no such table"):
        calibration.columns("distances")


def test_covariances_of_points_are_stored_as_lower_triangles_and_those_of_older_files_stay_right(rng):
    """As the joint covariance is; a file without the name of the form has upper ones: XX, XY, XZ, YY, YZ, ZZ."""
    simulated = simulate(rng, images=6, points=20)
    made = calibrate_network(simulated.network, Options(folds=0), simulated.truth)
    record = json.loads(json_text(plain(_record(made))))
    expected = made.adjustment.point_covariance
    np.testing.assert_allclose(_stored(record).point_covariance, expected, rtol=1e-9)
    np.testing.assert_array_equal(np.array(record["points"]["covariance"], float), expected[:, [0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2]])
    del record["points"]["covariance_form"]
    record["points"]["covariance"] = expected[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].tolist()
    np.testing.assert_allclose(_stored(record).point_covariance, expected, rtol=1e-9)


SCHEMA = json.loads((Path(__file__).parents[2] / "docs" / "calibration-result.schema.json").read_text(encoding="utf-8"))
KEYWORDS = {"$schema", "$id", "$defs", "$ref", "title", "description", "type", "const", "enum", "properties", "required",
            "additionalProperties", "items", "minItems", "maxItems", "minimum"}  # fmt: skip
TYPES = {"object": dict, "array": list, "string": str, "number": (int, float), "integer": int, "boolean": bool, "null": type(None)}


def faults_of(value: object, schema: dict, at: str = "") -> list[str]:
    """Where a value breaks a JSON schema of the keywords above (draft 2020-12), written from its specification."""
    assert set(schema) <= KEYWORDS, set(schema) - KEYWORDS
    if "$ref" in schema:
        return faults_of(value, SCHEMA["$defs"][schema["$ref"].rpartition("/")[2]], at)
    kinds = schema.get("type", list(TYPES))
    kinds = [kinds] if isinstance(kinds, str) else kinds
    if not any(isinstance(value, TYPES[k]) and (k == "boolean" or not isinstance(value, bool)) for k in kinds):
        return [f"{at}: {type(value).__name__} for {kinds}"]
    out = [f"{at}: {value!r}"] if value != schema.get("const", value) or value not in schema.get("enum", [value]) else []
    if isinstance(value, dict):
        own = schema.get("properties", {})
        out += [f"{at}/{name} is missing" for name in schema.get("required", []) if name not in value]
        out += [f"{at}/{name} is not known" for name in value if name not in own and not schema.get("additionalProperties", True)]
        out += [fault for name in own if name in value for fault in faults_of(value[name], own[name], f"{at}/{name}")]
    if isinstance(value, list):
        ok = schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value))
        out += [] if ok else [f"{at}: {len(value)} items"]
        out += [fault for k, item in enumerate(value) for fault in faults_of(item, schema.get("items", {}), f"{at}/{k}")]
    if isinstance(value, int | float) and "minimum" in schema and value < schema["minimum"]:
        out.append(f"{at}: {value} is too small")
    return out


def test_the_documented_schema_holds(calibration):
    """Of a camera in mm and of a rig; and what is broken in a record is found by it."""
    from calibrate.rigs import simulated_rig

    record = json.loads(calibration_json(calibration))
    assert faults_of(record, SCHEMA) == []
    rig = simulated_rig(np.random.default_rng(2), instants=5)
    assert faults_of(json.loads(calibration_json(calibrate_network(rig.network, Options(folds=0, snoop=False), rig.truth))), SCHEMA) == []
    for path, wrong in (
        (("sigma0",), "1"), (("cameras", 0, "direction"), "inwards"), (("cameras", 0, "parameters", 0, "free"), 1),
        (("images", "rotation", 0), [1.0] * 8), (("points", "xyz", 0, 2), "z"), (("dof",), -1), (("new",), 0), (("cameras",), []),
    ):  # fmt: skip
        broken = json.loads(calibration_json(calibration))
        place = broken
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = wrong
        assert len(faults_of(broken, SCHEMA)) == 1, path
    del record["unit"]
    assert faults_of(record, SCHEMA) == ["/unit is missing"]


def test_the_covariance_is_read_as_the_documentation_says(calibration):
    """In four lines, without pixmetry."""
    told = json.loads(calibration_json(calibration))["covariance"]
    lower = np.frombuffer(zlib.decompress(base64.b64decode(told["data"])), "<f8")
    matrix = np.zeros((told["size"], told["size"]))
    matrix[np.tril_indices(told["size"])] = lower
    np.testing.assert_allclose(matrix + np.tril(matrix, -1).T, calibration.adjustment.covariance, rtol=1e-9, atol=1e-25)
    assert len(told["columns"]) == told["size"]
