"""Cameras of data sheets, tested by EMVA 1288: the test gives the sheet back; and the result of a test is a camera again."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from data_sheets import measured, sheet, value
from pixmetry.assess.self_test import Exposure, expose
from pixmetry.camera.camera import Camera
from pixmetry.camera.data_sheet import camera_of_data_sheet
from pixmetry.core.errors import InputError
from pixmetry.core.number import Number
from pixmetry.emva.evaluate import evaluate
from pixmetry.emva.files.sheet_camera import camera_of_sheet
from pixmetry.emva.files.sheets import read_sheet, write_files
from pixmetry.emva.records import DataSheet, Results
from pixmetry.emva.reduction import measure_frames
from pixmetry.scene.uniform import Uniform

ROWS, COLS, LEVELS, STACK, LONGEST_S = 96, 128, 40, 32, 0.02
ALPHA = 1e-6  # rate at which a test fails although nothing is wrong, whatever the seed
SHEETS: dict[str, dict[str, Any]] = {
    "cmos of 12 bits": {
        "bits": 12,
        "saturation_capacity_e": 10_400,
        "read_noise_e": 2.5,
        "quantum_efficiency": 0.64,
        "prnu_rel": 0.006,
        "dsnu_e": 1.2,
        "dark_current_e_per_s": 3.0,
        "nonlinearity_rel": 0.003,
    },
    "ccd of 14 bits": {
        "bits": 14,
        "saturation_capacity_e": 18_000,
        "read_noise_e": 7.0,
        "quantum_efficiency": 0.55,
        "prnu_rel": 0.01,
        "dsnu_e": 4.0,
        "dark_current_e_per_s": 20.0,
        "nonlinearity_rel": 0.001,
    },
    "10 bits with ratios and a gain": {
        "bits": 10,
        "snr_max_db": 39.0,
        "dynamic_range_db": 58.0,
        "gain_dn_per_e": 0.12,
        "quantum_efficiency": 0.4,
        "prnu_rel": 0.008,
        "dsnu_e": 9.0,
        "dark_current_e_per_s": 5.0,
        "nonlinearity_rel": 0.0,
    },
}


def camera_of(name: str, seed: int) -> Camera:
    """The camera of a sheet, another unit for every seed; the converter's steps are not stated and are equal here."""
    camera = camera_of_data_sheet({"schema": "pixmetry/data_sheet/1", "rows": ROWS, "cols": COLS, "pitch_um": 4.0} | SHEETS[name])
    equal = {"inl_amplitude_lsb": 0.0, "dnl_std_lsb": 0.0}
    return replace(camera.with_parameters("grabber.adc", **equal), unit_seed=seed + 1)


def results_of(camera: Camera, seed: int) -> Results:
    """The test of a camera, with light a little beyond saturation."""
    gain = camera["electronics.gain"].params.gain_dn_per_e
    adc = camera["grabber.adc"].params
    full = min(camera["sensor.full_well"].params.full_well_e, (adc.top - adc.offset_dn) / gain)
    brightest = 1.08 * full / camera["sensor.quantum_efficiency"].params.quantum_efficiency
    exposures, light = [], []
    for k in range(1, LEVELS + 1):
        for kind in ("dark", "bright"):
            share = k / LEVELS
            exposures.append(Exposure(kind, "level", share * LONGEST_S, share * brightest if kind == "bright" else 0.0, 2))
            light.append(exposures[-1].photons)
    for kind in ("dark", "bright"):
        exposures.append(Exposure(kind, "stack", 0.5 * LONGEST_S, 0.5 * brightest if kind == "bright" else 0.0, STACK))
        light.append(exposures[-1].photons)
    (measured,) = measure_frames(expose(camera, exposures, light, seed), adc.bits)
    return evaluate(measured, "4.0", draws=1000)


def assert_is(found: Number, stated: float, model: float = 0.0, of: int = 6) -> None:
    """Within Student's t of its u, at ALPHA over the values of a test, and beside it a relative error of the definition."""
    t = stats.t.isf(ALPHA / of / 2, min(found.dof, 1e9))
    assert abs(found.value - stated) < t * found.u + model * stated, (found.value, found.u, stated)


@pytest.mark.parametrize("name", SHEETS)
def test_the_camera_of_a_sheet_has_the_values_of_the_sheet(name: str, seed: int) -> None:
    camera, stated = camera_of(name, seed), SHEETS[name]
    results = results_of(camera, seed)
    values = results.values
    capacity = stated.get("saturation_capacity_e") or 10 ** (stated["snr_max_db"] / 10)
    gain, read = camera["electronics.gain"].params.gain_dn_per_e, camera["electronics.amplifier_noise"].params.white_e
    dark_shot2 = stated["dark_current_e_per_s"] * LONGEST_S  # largest share of dark current in the dark noise
    e_min = math.sqrt(read**2 + 1 / (12 * gain**2) + 0.25) + 0.5
    bend = 8 * stated["nonlinearity_rel"]  # of gain and responsivity, which are slopes at 0 to 70 % of a response that bends
    assert_is(values["K"], gain, bend)
    assert_is(values["QE"], 100 * stated["quantum_efficiency"], bend)
    assert_is(values["sigma_d"], read, bend + dark_shot2 / (2 * read**2))
    # the capacity is that of a level: the next darker one lies 1.08/LEVELS of the full well below it
    one_level = 1.08 / LEVELS * camera["sensor.full_well"].params.full_well_e / capacity
    saturation = values["u_e_sat"].value
    assert capacity * (1 - one_level - bend) - 6 * values["u_e_sat"].u < saturation < capacity * (1.005 + bend) + 6 * values["u_e_sat"].u
    assert values["SNR_max"].value == pytest.approx(math.sqrt(capacity), rel=one_level / 2 + 0.005 + bend)
    assert values["DR"].value == pytest.approx(capacity / e_min, rel=one_level + 0.05)
    assert values["u_p_min"].value == pytest.approx(e_min / stated["quantum_efficiency"], rel=0.05)
    patterns = stats.chi2(ROWS * COLS - 1).isf(ALPHA) ** 0.5 / (ROWS * COLS) ** 0.5 - 1  # scatter of a pattern that is drawn
    assert_is(values["DSNU1288"], stated["dsnu_e"], patterns + bend + 0.02)
    assert_is(values["PRNU1288"], 100 * stated["prnu_rel"], patterns + bend + 0.02)


def test_the_linearity_error_of_a_sheet_comes_back(seed: int) -> None:
    """Through the camera and the standard's own line: 1 % within a tenth, where noise and light add little."""
    camera = camera_of_data_sheet(
        {"schema": "pixmetry/data_sheet/1", "rows": ROWS, "cols": COLS, "pitch_um": 4.0}
        | SHEETS["ccd of 14 bits"]
        | {"nonlinearity_rel": 0.01, "prnu_rel": 0.0, "dsnu_e": 0.0}
    )
    values = results_of(replace(camera, unit_seed=seed), seed).values
    assert values["LE"].value == pytest.approx(1.0, rel=0.1)
    assert np.isfinite(values["LE"].u)


# ---- from the result of a test to a camera -----------------------------------------------------------------------------------------

FACTS = {"name": "K", "bits": 12, "rows": 24, "cols": 32, "pitch_x_um": 5.5, "sensor": "cmos", "temperature_c": 31.0}
VALUES = {
    "K": (0.38, 0.002),
    "QE": (62.0, 0.3),
    "sigma_d": (2.3, 0.02),
    "u_e_sat": (10_100.0, 60.0),
    "DSNU1288": (1.0, 0.02),
    "PRNU1288": (0.5, 0.01),
    "u_I_mean": (4.0, 0.5),
    "LE": (0.4, 0.05),
}


@pytest.mark.parametrize("ending", ["json", "xml"])
def test_the_file_of_a_test_is_a_camera(ending: str, tmp_path: Path) -> None:
    written = measured(VALUES, dof=40.0, camera=FACTS, conditions={"stack_exposure_s": 0.004})
    write_files(written, {ending: tmp_path / f"sheet.{ending}"})
    camera = camera_of_sheet(read_sheet(tmp_path / f"sheet.{ending}"))
    assert camera.name == "K" and camera.frame_shape == (24, 32) and camera.pitch_um == (5.5, 5.5)
    assert (camera.exposure_s, camera.temperature_c, camera.facts["bits"]) == (0.004, 31.0, 12)
    params = {e.name: e.params for e in camera.chain}
    assert params["sensor.quantum_efficiency"].quantum_efficiency == pytest.approx(0.62)
    assert params["electronics.gain"].gain_dn_per_e == 0.38 and params["electronics.amplifier_noise"].white_e == 2.3
    assert params["sensor.prnu"].pixel_std_rel == pytest.approx(0.005) and params["sensor.dsnu"].pixel_std_e == 1.0
    assert params["sensor.dark_current"].rate_e_per_s == 4.0 and params["sensor.dark_current"].reference_temperature_c == 31.0
    assert params["sensor.full_well"].full_well_e > 10_100
    known = {e.name: e.known_from for e in camera.chain}
    assert known["sensor.prnu"] == known["electronics.gain"] == known["electronics.nonlinearity"] == "measured"
    assert known["sensor.pixel_aperture"] == known["grabber.adc"] == "typical"
    prnu = camera.estimates["sensor.prnu"]["pixel_std_rel"]
    assert prnu.u == pytest.approx(1e-4) and prnu.dof == 40.0
    assert camera.expose(Uniform(2000.0)).data.mean() > 100


def test_pixels_rows_and_columns_are_those_of_the_test_and_limits_stay() -> None:
    parts = {"DSNU1288": value(2.0, 0.1, unit="e⁻"), "DSNU1288_pixel": value(1.5, 0.05, 90.0, unit="e⁻")}
    parts |= {"DSNU1288_row": value(0.4, 0.1, unit="e⁻", kind="upper_limit", reason="not significant")}
    camera = camera_of_sheet(sheet(parts | {"u_I_mean": value(-0.5, 1.0, unit="e⁻/s"), "LE": value(math.nan)}, camera=FACTS))
    dsnu = camera["sensor.dsnu"]
    assert dsnu.params.model_dump() == {"pixel_std_e": 1.5, "row_std_e": 0.0, "col_std_e": 0.0}
    assert dsnu.estimates["row_std_e"].is_upper_limit and dsnu.estimates["row_std_e"].value == 0.4
    assert dsnu.estimates["pixel_std_e"].dof == 90.0
    dark = camera["sensor.dark_current"]  # a rate below 0 is an upper limit
    assert dark.params.rate_e_per_s == 0.0 and dark.estimates["rate_e_per_s"].value == pytest.approx(1.645, abs=1e-3)
    assert dark.known_from == "measured" and camera["electronics.nonlinearity"].known_from == "typical"


def test_the_green_channel_of_a_colour_camera_is_taken_or_the_one_that_is_named() -> None:
    results = tuple(Results("4.0", {"QE": value(qe, 1.0, unit="%")}, channel=c) for c, qe in (("R", 40), ("Gr", 60), ("Gb", 59), ("B", 50)))
    colour = DataSheet(results, FACTS | {"cfa": "RGGB"}, {}, {})
    assert camera_of_sheet(colour)["sensor.quantum_efficiency"].params.quantum_efficiency == pytest.approx(0.6)
    assert camera_of_sheet(colour, "B")["sensor.quantum_efficiency"].params.quantum_efficiency == pytest.approx(0.5)
    assert camera_of_sheet(colour)["sensor.bayer_mosaic"].params.pattern == "RGGB"
    with pytest.raises(InputError, match="no such channel.*R, Gr, Gb, B"):
        camera_of_sheet(colour, "G")


def test_the_sheet_of_another_program_that_does_not_say_of_what_is_refused() -> None:
    with pytest.raises(InputError, match="does not say bits and rows and cols.*emva1288"):
        camera_of_sheet(measured(VALUES, camera={}))


def test_the_tested_camera_and_the_camera_of_its_test_are_alike(seed: int) -> None:
    """A sheet's camera, its test, the test's camera: the values agree within their u."""
    camera = camera_of("cmos of 12 bits", seed)
    about = {"name": "c", "bits": 12, "rows": ROWS, "cols": COLS}
    again = camera_of_sheet(DataSheet((results_of(camera, seed),), about, {}, {}))
    for source, name, model in (
        ("electronics.amplifier_noise", "white_e", 0.04),
        ("sensor.dsnu", "pixel_std_e", 0.08),
        ("sensor.prnu", "pixel_std_rel", 0.08),
        ("electronics.gain", "gain_dn_per_e", 0.03),
    ):
        found, true = again.estimates[source][name], getattr(camera[source].params, name)
        assert_is(found, true, model)
    assert again["sensor.full_well"].params.full_well_e == pytest.approx(camera["sensor.full_well"].params.full_well_e, rel=0.06)
