"""Results of a test by EMVA 1288 as the camera of a budget, alone and beside a data sheet; and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from data_sheets import measured, written
from pixmetry.budget.cameras import camera_of
from pixmetry.camera.camera import load_camera
from pixmetry.cli import main
from pixmetry.core.errors import InputError
from pixmetry.emva.files.sheet_camera import camera_of_sheet
from pixmetry.emva.records import DataSheet

VALUES = {"QE": (62.0, 2.0), "K": (0.10, 0.002), "sigma_d": (2.3, 0.05), "u_e_sat": (9_100.0, 60.0), "DSNU1288": (1.0, 0.02)}
FACTS = {"name": "tested", "bits": 10, "rows": 120, "cols": 160, "pitch_x_um": 5.5, "pitch_y_um": 5.5}
SHEET = """schema: pixmetry/data_sheet/1
name: a sheet
rows: 240
cols: 320
pitch_um: 5.5
bits: 12
sensor: cmos
saturation_capacity_e: 10400
read_noise_e: 2.9
prnu_rel: 0.004
lens: {f_mm: 25, f_number: 4}
u: {read_noise_e: 0.1}
"""
FOREIGN = """<?xml version="1.0" encoding="UTF-8"?>
<results>
  <sensitivity>
    <QE><symbol>eta</symbol><unit>%</unit><value>62,1</value></QE>
    <K><unit>DN/e-</unit><value>0.38</value></K>
    <sigma_d><value>2.4</value></sigma_d>
  </sensitivity>
  <spatial><DSNU1288><value>1.2</value></DSNU1288><PRNU1288><value>None</value></PRNU1288></spatial>
</results>
"""


@pytest.fixture
def sheet(tmp_path: Path) -> Path:
    path = tmp_path / "sheet.yaml"
    path.write_text(SHEET, encoding="utf-8")
    return path


def of_a_test(facts: dict[str, object]) -> DataSheet:
    return measured(VALUES, dof=40.0, camera=facts)


@pytest.mark.parametrize("ending", ["json", "xml"])
def test_our_results_are_cameras(ending: str, tmp_path: Path) -> None:
    path = written(of_a_test(FACTS), tmp_path / f"result.{ending}")
    found, compared = camera_of(path)
    assert found == camera_of_sheet(of_a_test(FACTS)) and not compared
    assert found["electronics.amplifier_noise"].known_from == "measured"
    assert found.estimates["electronics.amplifier_noise"]["white_e"].u == 0.05


def test_the_values_of_another_program_replace_those_of_the_sheet(sheet: Path, tmp_path: Path) -> None:
    """It says neither format nor u; the sheet says the format."""
    path = tmp_path / "foreign.xml"
    path.write_text(FOREIGN, encoding="utf-8")
    for given in ([sheet, path], [path, sheet]):
        found, compared = camera_of(given)
        assert found.frame_shape == (240, 320) and found.pitch_um == (5.5, 5.5) and found.facts["bits"] == 12
        assert found["sensor.quantum_efficiency"].params.quantum_efficiency == pytest.approx(0.621)
        assert found["electronics.amplifier_noise"].params.white_e == 2.4 and found["electronics.gain"].params.gain_dn_per_e == 0.38
        assert found["sensor.prnu"].known_from == "sheet" and found["sensor.prnu"].params.pixel_std_rel == 0.004  # the test has none
        assert {d.name for d in compared} >= {"electronics.amplifier_noise"}
    assert camera_of([sheet, path])[0].name == "a sheet" and camera_of([path, sheet])[0].name == "foreign"


def test_a_window_of_the_sensor_is_enough_for_a_test(sheet: Path, tmp_path: Path) -> None:
    """And with the measured gain goes the converter whose steps it counts."""
    path = written(of_a_test(FACTS), tmp_path / "result.json")
    found, _ = camera_of([sheet, path])
    assert found.frame_shape == (240, 320)
    assert found["electronics.gain"].params.gain_dn_per_e == 0.10
    assert found["grabber.adc"].params.bits == found.facts["bits"] == 10
    whole = written(of_a_test(FACTS | {"sensor_rows": 240, "sensor_cols": 320}), tmp_path / "whole.json")
    assert camera_of(whole)[0].frame_shape == (240, 320)


def test_a_budget_of_a_sheet_and_a_result_of_another_program(sheet: Path, tmp_path: Path) -> None:
    path = tmp_path / "foreign.xml"
    path.write_text(FOREIGN, encoding="utf-8")
    told = CliRunner().invoke(main, ["budget", str(sheet), str(path), "--set", "object.distance_mm=2000", "--all"])
    assert told.exit_code == 0, told.output
    (noise,) = (line for line in told.output.splitlines() if "Amplifier noise" in line)
    assert " measured " in noise and "on the object" in told.output


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.xml", FOREIGN, "does not say bits and rows and cols"),
        ("a.xml", "<a/>", "not a result of EMVA 1288"),
        ("a.xml", "<results/>", "holds no value"),
        ("a.xml", FOREIGN.replace("0.38", "zero"), "is not a number"),
        ("a.xml", FOREIGN[:200], "not valid XML"),
        ("a.html", "<!DOCTYPE html>\n<html><head><title>x: EMVA 1288 data sheet</title></head></html>", "a page for reading"),
        ("a.json", '{"schema": "pixmetry/emva1288/1"}', "release"),
        ("a.json", '{"schema": "pixmetry/emva1288/1", ', "JSON"),
        ("a.json", '{"schema": "pixmetry/results/1"}', "another kind"),
    ],
)
def test_odd_files_are_refused_in_words(name: str, text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=words):
        camera_of(path)


def test_results_of_another_sensor_are_refused(sheet: Path, tmp_path: Path) -> None:
    for name, facts in (("large", {"rows": 480, "cols": 640}), ("told", {"sensor_rows": 200, "sensor_cols": 300})):
        path = written(of_a_test(FACTS | facts), tmp_path / f"{name}.json")
        with pytest.raises(InputError, match="different sensors"):
            camera_of([sheet, path])


@pytest.mark.parametrize(("old", "new", "words"), [("62,1", "162", "quantum_efficiency"), ("0.38", "0", "gain"), ("2.4", "-2.4", "")])
def test_values_that_no_camera_has_are_refused_and_small_negative_ones_are_limits(
    old: str, new: str, words: str, sheet: Path, tmp_path: Path
) -> None:
    path = tmp_path / "odd.xml"
    path.write_text(FOREIGN.replace(old, new), encoding="utf-8")
    if words:
        with pytest.raises(InputError, match=words):
            camera_of([sheet, path])
    else:
        found, _ = camera_of([sheet, path])
        assert found["electronics.amplifier_noise"].params.white_e == 0.0


def test_a_preset_is_compared_with_the_measurement(tmp_path: Path) -> None:
    """Its gain is described, the test measured 0.10 DN/e⁻ to 2 %: within 10 % of the description they agree, beyond they differ."""
    facts = {"name": "tested", "bits": 12, "rows": 2048, "cols": 2448, "pitch_x_um": 3.45, "pitch_y_um": 3.45}
    path = written(of_a_test(facts), tmp_path / "result.json")
    preset = load_camera("imx264_like")
    gain = preset["electronics.gain"].params.gain_dn_per_e
    joined, compared = camera_of([preset, path])
    (found,) = (d for d in compared if (d.name, d.parameter) == ("electronics.gain", "gain_dn_per_e"))
    assert (found.first, found.first_from, found.second_from) == (gain, "described", "measured") and not found.agree
    assert joined["electronics.gain"].params.gain_dn_per_e == pytest.approx(0.10)
    like = preset.with_parameters("electronics.gain", gain_dn_per_e=0.105)
    (close,) = (d for d in camera_of([like, path])[1] if d.parameter == "gain_dn_per_e")
    assert close.agree
    assert not camera_of([preset, preset])[1]  # two descriptions that measured nothing
