"""Results that version 0.1 wrote open in this one, with the values that they hold; a schema of another number is refused."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

from pixmetry import compare, compare_budgets
from pixmetry.assess.judge.subjects import load_subject
from pixmetry.camera.camera import load_camera
from pixmetry.core.errors import InputError

STORED = Path(__file__).parent / "stored_0_1.zip"


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stored")
    with zipfile.ZipFile(STORED) as archive:
        archive.extractall(folder)
    return folder


def values_in(path: Path) -> set[float]:
    """Every ``value`` in a record, read without pixmetry."""
    found: set[float] = set()

    def walk(node: object) -> None:
        if isinstance(node, dict):
            if isinstance(node.get("value"), int | float):
                found.add(float(node["value"]))
            for child in node.values():
                walk(child)
        elif isinstance(node, list):
            for child in node:
                walk(child)

    walk(json.loads(path.read_text(encoding="utf-8")))
    return found


@pytest.mark.parametrize(
    ("name", "kind"), [("assessed/results.json", "assessment"), ("sheet.json", "data sheet"), ("series/series.json", "series")]
)
def test_results_open_with_their_values(stored: Path, name: str, kind: str) -> None:
    subject = load_subject(stored / name)
    assert subject.kind == kind and len(subject.values) > 5
    known = values_in(stored / name)
    read = {v.value for (_, key), v in subject.values.items() if v.value == v.value and not key.startswith("budget.")}
    assert len(read & known) > 0.8 * len(read)
    assert compare(stored / name, stored / name).same


def test_both_forms_of_a_data_sheet_say_the_same(stored: Path) -> None:
    assert compare(stored / "sheet.json", stored / "sheet.xml").same


def test_the_camera_of_an_assessment_makes_frames(stored: Path) -> None:
    camera = load_camera(stored / "assessed" / "camera.yaml")
    assert camera.name and len(camera.active) > 3


def test_a_budget_is_compared(stored: Path) -> None:
    found = compare_budgets([stored / "budget.json", stored / "budget.json"])
    assert found.best.camera == "imx264_like" and found.ranks[1].ratio == pytest.approx(1.0)


def test_a_schema_of_a_later_number_is_refused(stored: Path, tmp_path: Path) -> None:
    record = json.loads((stored / "series" / "series.json").read_text())
    record.pop("checksums", None)
    record["schema"] = "pixmetry/series/2"
    (tmp_path / "series.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match="no data sheet, assessment, calibration or series"):
        load_subject(tmp_path / "series.json")
