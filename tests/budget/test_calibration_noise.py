"""Noise of a calibration in a budget: against calibrations by `pixmetry.calibrate`, and taken from one that was made."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import pixmetry
from budget.measured_networks import Measured, calibration_shots
from pixmetry.budget.calibration_noise import calibration_row
from pixmetry.budget.fields import Calibration, Places, field_of
from pixmetry.budget.measured_calibration import as_calibrated, measured_calibration
from pixmetry.budget.scenario import read_scenario
from pixmetry.budget.setting import Setting
from pixmetry.budget.table import ABSENT, DESCRIBED, MEASURED, TYPICAL, Parts, SourceRow
from pixmetry.calibrate.files.record import calibration_json
from pixmetry.camera.camera import Camera, Element, load_camera
from pixmetry.camera.catalogue import get_source
from pixmetry.cli import main
from pixmetry.core.errors import InputError

CAMERA = Camera("test", (600, 800), (), pitch_um=(5.0, 5.0), facts={"saturation_dn": 200.0, "bits": 8})
OBJECT = {"object": {"distance_mm": 1000.0, "f_mm": 12.0}}
PRESET = replace(load_camera("imx264_like"), frame_shape=(600, 800), pitch_um=(5.0, 5.0))


def row_of(measured_px: float = 0.02, camera: Camera = CAMERA, **told: object) -> SourceRow:
    scenario = read_scenario({**OBJECT, "calibration": told})
    noise = SourceRow("noise", "noise", "", 0, 0, DESCRIBED, "T", Parts(), Parts(time_px=(measured_px, measured_px)))
    return calibration_row([noise], Setting(camera, scenario))


@cache
def made(field: str = "flat", noise_px: float = 0.02) -> pixmetry.calibrate.Calibration:
    setting = Setting(CAMERA, read_scenario(OBJECT))
    half = 500 * np.array([800, 600]) / setting.c_px
    rng = np.random.default_rng(5)
    return Measured(setting, (noise_px, noise_px)).calibrated("lens", calibration_shots(rng, 15, 80, 1000.0, half, field == "flat"), rng)


@pytest.mark.parametrize("field", ["flat", "deep"])
def test_it_is_what_a_calibration_states_of_itself(field: str) -> None:
    """A field drawn at random, of which the images see some 70 %, against one laid out evenly: within 30 %."""
    found = made(field)
    said = np.sqrt(np.nanmean(np.square(found.tests.projection["camera"].u_px)))
    seen = len(found.adjustment.network) / 15
    row = row_of(images=15, targets=round(seen), field=field)
    assert np.sqrt(np.mean(np.square(row.after.smooth_px))) == pytest.approx(said, rel=0.3)


def test_it_falls_with_the_root_of_the_image_points_and_grows_with_their_noise() -> None:
    few, many = (row_of(images=n, targets=60).after_px for n in (16, 64))
    assert few / many == pytest.approx(2.0, rel=1e-6)
    assert row_of(0.04, images=16, targets=60).after_px == pytest.approx(2 * few, rel=1e-6)
    assert row_of(0.04, images=16, targets=60, noise_px=0.02).after_px == pytest.approx(few, rel=1e-6)


def test_fewer_parameters_carry_less_noise_and_a_grid_more() -> None:
    none, four, ten, grid = (row_of(model=m, images=16) for m in ("none", "principal_point_and_scale", "lens", "residual_grid"))
    assert none.status == ABSENT and none.after_px == 0
    assert 0 < four.after_px < ten.after_px < grid.after_px


def test_what_the_scenario_does_not_tell_is_typical_and_may_be_larger() -> None:
    usual = row_of()
    assert usual.status == TYPICAL and usual.largest_px > 2 * usual.after_px
    assert row_of(images=20).status == DESCRIBED


def test_a_calibration_that_was_made_brings_lens_noise_and_state(tmp_path: Path) -> None:
    calibration = made()
    (tmp_path / "c").mkdir()
    file = tmp_path / "c" / "calibration.json"
    file.write_text(calibration_json(calibration), encoding="utf-8")
    found = pixmetry.budget(PRESET, OBJECT, calibration=file)
    rows = {r.name: r for r in found.rows}
    row = rows["calibration"]
    said = np.sqrt(np.nanmean(np.square(calibration.tests.projection["camera"].u_px)))
    assert row.status == MEASURED and np.sqrt(np.mean(np.square(row.after.smooth_px))) == pytest.approx(said, rel=0.25)
    assert rows["optics.distortion"].status == MEASURED and "part of the lens" in rows["sensor.tilt"].reason
    assert found.scenario.calibration.model == "lens" and found.point is not None
    told = as_calibrated(read_scenario({"calibration": {"model": "none"}}), measured_calibration(calibration, PRESET))
    assert told.calibration.model == "none"  # what the scenario says goes first


def test_a_lens_of_five_radial_terms_is_that_of_the_budget(tmp_path: Path) -> None:
    """K4 and K5 of a strong lens, from the file of its calibration: the budget's lens is the true one to a few of its u, and is taken up.

    As a lens of three terms it would not be: these leave ten times as much of it, or more.
    """
    told = {"k1_per_mm2": -4e-3, "k4_per_mm8": 8e-7, "k5_per_mm10": -4e-8, "pitch_x_um": 5.0, "pitch_y_um": 5.0}
    lens = get_source("optics.distortion")
    camera = replace(CAMERA, chain=(Element(lens.id, lens, lens.make(told)),))
    setting, rng = Setting(camera, read_scenario(OBJECT)), np.random.default_rng(5)
    shots = calibration_shots(rng, 15, 80, 1000.0, 500 * np.array([800, 600]) / setting.c_px, False)
    found = {model: Measured(setting, (0.01, 0.01)).calibrated(model, shots, rng) for model in ("lens", "five_terms")}
    file = tmp_path / "calibration.json"
    file.write_text(calibration_json(found["five_terms"]), encoding="utf-8")
    budget = pixmetry.budget(replace(PRESET, chain=(*camera.chain, *PRESET.chain)), OBJECT, calibration=file)
    rows = {r.name: r for r in budget.rows}
    assert rows["calibration"].status == rows["optics.distortion"].status == MEASURED
    measured = budget.setting.described["optics.distortion"].params
    x, y = np.meshgrid(np.linspace(40, 759, 9), np.linspace(30, 569, 9))
    seen, true = (np.array(replace(camera, chain=(replace(camera.chain[0], params=p),)).true_positions(x.ravel(), y.ravel()))
                  for p in (measured, camera.chain[0].params))  # fmt: skip
    u = np.hypot(*rows["calibration"].after.smooth_px)
    left = seen - true - (seen - true).mean(axis=1)[:, None]
    assert rows["optics.distortion"].before_px > 2 and np.sqrt(np.mean(left**2)) < 3 * u < 0.1
    five = measured_calibration(file, PRESET)
    assert five.radial == 5 and measured_calibration(found["lens"], PRESET).radial == 3
    assert rows["optics.distortion"].after_px < 0.002
    places = Places.over(PRESET.frame_shape, 100.0)
    field = field_of(camera, places)
    few, many = (np.nanstd(Calibration("lens", False, places, radial=n).left(field, field)) for n in (3, 5))
    assert few > 10 * many


def test_a_calibration_of_another_sensor_is_refused() -> None:
    calibration = made()
    with pytest.raises(InputError, match="another size"):
        measured_calibration(calibration, replace(CAMERA, frame_shape=(480, 640)))
    with pytest.raises(InputError, match="another pixel pitch"):
        measured_calibration(calibration, replace(CAMERA, pitch_um=(3.45, 3.45)))
    assert measured_calibration(calibration, replace(CAMERA, pitch_um=None)).model == "lens"


def test_the_command_refuses_what_is_no_calibration(tmp_path: Path) -> None:
    wrong = tmp_path / "calibration.json"
    wrong.write_text(json.dumps({"schema": "something/1"}), encoding="utf-8")
    told = CliRunner().invoke(main, ["budget", "imx264_like", "--calibration", str(wrong)])
    assert told.exit_code == 2 and "not a calibration" in told.output
    both = CliRunner().invoke(main, ["budget", "imx264_like", "imx264_like", "--compare", "--calibration", str(wrong)])
    assert both.exit_code == 2 and "belongs to one camera" in both.output
