"""A sheet's budget and that of an assessed camera of its type agree within their intervals; what a sheet does not state widens them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from budget.sheet_twins import SHAPE, ends_px, twin_of
from pixmetry.budget.parameters import UNSTATED, UNSTATED_U_REL, assumed_estimates, told_values
from pixmetry.budget.scenario import Scenario
from pixmetry.budget.setting import Setting
from pixmetry.budget.table import SHEET, TYPICAL, SourceRow, Table
from pixmetry.camera.camera import Camera, load_camera
from pixmetry.camera.data_sheet import camera_of_data_sheet
from pixmetry.locate.target_estimator import TargetEstimator

RECORD = {"schema": "pixmetry/data_sheet/1", "rows": 96, "cols": 128, "pitch_um": 5.0, "bits": 12, "read_noise_e": 9.0}
NOISE, SHOT = "electronics.amplifier_noise", "sensor.shot_noise"


def rows_of(camera: Camera) -> dict[str, SourceRow]:
    found = Table(Setting(camera, Scenario()), TargetEstimator()).rows(only=[NOISE, SHOT])
    return {r.source_id: r for r in found}


def test_a_sheet_and_an_assessed_camera_of_its_type_agree(rng: np.random.Generator, tmp_path: Path) -> None:
    """Numbers up to 10 % off the sheet's: its intervals reach 20 %, and the assessment knows these numbers to better than 2 %."""
    twin = twin_of("cmv4000", tmp_path, rng, reach=1.0)
    assert twin.totals_overlap() and twin.ratio() == pytest.approx(1, abs=0.1)
    rows = twin.rows((SHOT, NOISE, "sensor.prnu", "sensor.dsnu", "grabber.adc"))
    assert len(rows) == 5
    for sheet, assessed in rows:
        assert assessed.status == "measured" or assessed.source_id == SHOT
        (low, high), (least, most) = ends_px(sheet), ends_px(assessed)
        assert max(low, least) <= min(high, most), sheet.title
        assert most - least < high - low, sheet.title  # a measurement narrows it


def test_a_number_without_uncertainty_gets_that_of_its_type_and_says_so() -> None:
    without = rows_of(camera_of_data_sheet(RECORD))[NOISE]
    assert without.status == SHEET and without.reason == UNSTATED
    assert without.largest_px == pytest.approx((1 + 2 * UNSTATED_U_REL) * without.after_px, rel=0.02)  # noise is in proportion
    stated = rows_of(camera_of_data_sheet(RECORD | {"u": {"read_noise_e": 0.09}}))[NOISE]
    assert stated.largest_px == pytest.approx(1.02 * stated.after_px, rel=0.005) and stated.reason != UNSTATED


def test_only_what_a_sheet_tells_is_assumed_uncertain() -> None:
    element = camera_of_data_sheet(RECORD)[NOISE]
    assert told_values(element) == {"white_e": 9.0}
    (number,) = assumed_estimates(element)
    assert (number.name, number.value, number.u) == ("white_e", 9.0, pytest.approx(0.9))


def test_shot_noise_is_as_well_known_as_the_saturation_capacity() -> None:
    """Its row goes with the inverse root of the capacity: unknown, told without u, told with u, measured or described."""
    unknown = rows_of(camera_of_data_sheet(RECORD))[SHOT]
    assert unknown.status == TYPICAL and unknown.largest_px == pytest.approx(2**0.5 * unknown.after_px)
    told = rows_of(camera_of_data_sheet(RECORD | {"full_well_e": 12000.0}))[SHOT]
    assert told.status != TYPICAL and told.largest_px == pytest.approx(1.1 * told.after_px)
    stated = rows_of(camera_of_data_sheet(RECORD | {"full_well_e": 12000.0, "u": {"full_well_e": 120.0}}))[SHOT]
    assert stated.largest_px == pytest.approx(1.01 * stated.after_px)
    described = rows_of(replace(load_camera("imx264_like"), frame_shape=SHAPE))[SHOT]
    assert described.largest is None
