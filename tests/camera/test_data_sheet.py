"""A camera of a data sheet: the numbers go where they belong, conversions agree with other ways to compute them, mistakes are told."""

from __future__ import annotations

import math
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from pixmetry.camera.camera import Camera, load_camera
from pixmetry.camera.data_sheet import (
    BLUR,
    blur_of_mtf,
    camera_of_data_sheet,
    diffraction_mtf,
    full_well_of_capacity,
    linearity_error,
)
from pixmetry.core.errors import ChainError, InputError
from pixmetry.scene.uniform import Uniform
from pixmetry.sources.optics.distortion import pull_of
from pixmetry.sources.optics.point_spread import PointSpread, transfer

LEAST = {"schema": "pixmetry/data_sheet/1", "rows": 24, "cols": 32, "pitch_um": 3.45, "bits": 12}
WHOLE = LEAST | {
    "saturation_capacity_e": 10_400,
    "read_noise_e": 2.3,
    "quantum_efficiency": 0.6,
    "prnu_rel": 0.005,
    "dsnu_e": 0.7,
    "dark_current_e_per_s": 3.0,
    "nonlinearity_rel": 0.002,
    "fill_factor": 0.81,
    "lens": {"f_mm": 25, "f_number": 4, "mtf": [[50, 0.6], [100, 0.3]], "distortion_rel": 0.0002},
}


def sheet(**changes: Any) -> Camera:
    return camera_of_data_sheet(LEAST | changes)


def whole(**changes: Any) -> Camera:
    return camera_of_data_sheet(WHOLE | changes)


# ---- what is stated and what is usual ----------------------------------------------------------------------------------------------


def test_four_lines_make_a_camera_of_usual_values() -> None:
    camera = sheet()
    assert camera.frame_shape == (24, 32) and camera.pitch_um == (3.45, 3.45)
    assert {e.known_from for e in camera.chain if type(e.params).model_fields} == {"typical"}
    for e in camera.chain:
        if e.source.id in ("sensor.prnu", "sensor.dsnu", "electronics.amplifier_noise", "sensor.full_well", "sensor.quantum_efficiency"):
            assert e.params == e.source.typical
    assert camera.estimates == {}
    assert camera.facts["lens"] == "none is stated: no point spread" and "optics.point_spread" not in camera
    frame = camera.expose(Uniform(2000.0)).data
    assert 0 < frame.mean() < 4095


def test_what_is_stated_goes_into_the_chain_in_the_order_of_the_light() -> None:
    camera = whole(u={"read_noise_e": 0.1})
    names = [e.name for e in camera.chain]
    order = ["optics.point_spread", "sensor.pixel_aperture", "sensor.prnu", "sensor.dark_current", "sensor.shot_noise", "sensor.full_well"]
    order += ["sensor.dsnu", "electronics.amplifier_noise", "electronics.gain", "electronics.nonlinearity", "grabber.adc"]
    assert [name for name in names if name in order] == order
    assert camera["sensor.quantum_efficiency"].params.quantum_efficiency == 0.6
    assert camera["sensor.prnu"].params.model_dump() == {"pixel_std_rel": 0.005, "row_std_rel": 0.0, "col_std_rel": 0.0}
    assert camera["sensor.dsnu"].params.pixel_std_e == 0.7
    assert camera["sensor.dark_current"].params.rate_e_per_s == 3.0
    assert camera["sensor.pixel_aperture"].params.width_x_px == pytest.approx(0.9)
    assert {e.name for e in camera.chain if e.known_from == "typical"} == {"grabber.adc"}
    noise = camera.estimates["electronics.amplifier_noise"]["white_e"]
    assert (noise.value, noise.u, noise.unit) == (2.3, 0.1, "e-")


def test_the_dark_current_holds_at_the_temperature_of_the_sheet() -> None:
    camera = sheet(dark_current_e_per_s=40.0, temperature_c=45.0)
    assert camera.temperature_c == 45.0 and camera["sensor.dark_current"].params.reference_temperature_c == 45.0


def test_rows_and_columns_of_a_pattern_are_taken_out_of_its_total() -> None:
    dsnu = sheet(dsnu_e=5.0, dsnu_row_e=3.0, u={"dsnu_e": 0.1}).chain
    element = next(e for e in dsnu if e.source.id == "sensor.dsnu")
    assert element.params.pixel_std_e == pytest.approx(4.0) and element.params.row_std_e == 3.0
    assert element.estimates["pixel_std_e"].u == pytest.approx(0.125)  # d pixel/d total = total/pixel


@pytest.mark.parametrize("pattern", ["RGGB", "GRBG", "GBRG", "BGGR"])
def test_a_colour_sensor_has_its_mosaic(pattern: str) -> None:
    frame = sheet(colour=pattern, prnu_rel=0.0, dsnu_e=0.0).expose(Uniform(20_000.0), quiet=True).data[0].astype(float)
    cells = {pattern[2 * r + c] + "12"[r]: frame[r::2, c::2].mean() for r in (0, 1) for c in (0, 1)}
    red, blue = (next(v for k, v in cells.items() if k[0] == colour) for colour in "RB")
    greens = [v for k, v in cells.items() if k[0] == "G"]
    assert blue < red < min(greens) and greens[0] == pytest.approx(greens[1], rel=0.01)


def test_shutters() -> None:
    assert sheet(shutter="rolling", line_time_us=12.5)["sensor.rolling_shutter"].params.row_time_s == pytest.approx(12.5e-6)
    assert sheet(shutter="rolling")["sensor.rolling_shutter"].known_from == "typical"
    fields = sheet(shutter="interlaced", interface="analogue", sensor="ccd", line_time_us=64.0)
    assert fields["sensor.interlace"].params.field_period_s == pytest.approx(12 * 64e-6)
    assert sheet().facts["shutter"] == "global" and "sensor.rolling_shutter" not in sheet()


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_the_full_well_fills_the_converter_and_black_is_not_clipped(bits: int) -> None:
    camera = whole(bits=bits, lens=None)
    black = camera["grabber.adc"].params.offset_dn
    top = camera["electronics.gain"].params.gain_dn_per_e * camera["sensor.full_well"].params.full_well_e + black
    assert top == pytest.approx(2**bits - 1)
    dark = camera.expose(Uniform(0.0), 20).data
    assert (dark == 0).mean() < 0.005  # EMVA 1288 R4.0 §6.5
    assert black < 0.02 * 2**bits


def test_a_stated_gain_stays() -> None:
    camera = sheet(gain_dn_per_e=0.2, full_well_e=30_000, black_level_dn=16.0, u={"gain_dn_per_e": 0.01})
    assert camera["electronics.gain"].params.gain_dn_per_e == 0.2 and camera.estimates["electronics.gain"].u[0] == 0.01
    assert camera["grabber.adc"].params.offset_dn == 16.0
    assert camera["electronics.nonlinearity"].params.reference_dn == 4095 - 16  # the converter is full first


@pytest.mark.parametrize(
    "changes",
    [
        {"rows": 1},
        {"rows": 4, "cols": 4096},
        {"rows": 1, "cols": 1},
        {"pitch_um": 0.7, "lens": {"f_number": 32}},
        {"pitch_um": 100.0, "lens": {"f_number": 0.95}},
        {"pitch_um": None, "pitch_x_um": 11.6, "pitch_y_um": 11.2, "lens": {"f_number": 8, "mtf": 0.2}},
        {"bits": 8, "sensor": "ccd", "interface": "analogue", "shutter": "interlaced"},
        {"bits": 16, "full_well_e": 100_000, "read_noise_e": 1.0},
        {"bits": 16, "read_noise_e": 0.0, "dsnu_e": 0.0, "prnu_rel": 0.0, "dark_current_e_per_s": 0.0, "nonlinearity_rel": 0.0},
        {"lens": {}},
        {"lens": {"f_mm": 8, "distortion_rel": -0.02}, "rows": 480, "cols": 640},
        {"temperature_c": 120.0},
        {"shutter": "rolling", "rows": 2},
    ],
)
def test_odd_but_lawful_sheets_expose(changes: dict[str, Any], tmp_path: Path) -> None:
    record = {name: value for name, value in (LEAST | changes).items() if value is not None}
    camera = camera_of_data_sheet(record)
    rows, cols = min(camera.frame_shape[0], 16), min(camera.frame_shape[1], 16)
    window = (0, 0, rows, cols)
    frame = camera.expose(Uniform(1000.0), window=window).data
    assert frame.shape == (1, rows, cols) and frame.max() > 0
    camera.save(tmp_path / "camera.yaml")
    again = load_camera(tmp_path / "camera.yaml")
    assert again.to_record() == camera.to_record() and again == camera


def test_a_huge_format_is_built_and_exposed_in_a_window() -> None:
    camera = sheet(rows=50_000, cols=100_000)
    assert camera.expose(Uniform(1000.0), window=(49_990, 99_990, 10, 10)).data.shape == (1, 10, 10)


# ---- conversions -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("capacity", [500.0, 10_400.0, 300_000.0])
def test_of_the_pixels_at_the_capacity_two_in_a_thousand_are_full(capacity: float) -> None:
    """EMVA 1288 R4.0 §6.6; the electrons by Poisson's law and, for the pixels' sensitivities, the normal one."""
    full = full_well_of_capacity(capacity, 3.0)
    assert stats.poisson.sf(full, capacity) == pytest.approx(0.002, abs=6e-4 if capacity < 1000 else 3e-4)
    wider = full_well_of_capacity(capacity, 3.0, 0.02)
    assert stats.norm.sf(wider, capacity, math.sqrt(capacity + 9 + (0.02 * capacity) ** 2)) == pytest.approx(0.002)


def test_capacity_and_noise_of_a_sheet_that_has_only_ratios() -> None:
    """The definitions of EMVA 1288 R4.0 (eq. 26 to 28, 53, 55), the other way round."""
    camera = sheet(snr_max_db=40.3, dynamic_range_db=71.2, u={"snr_max_db": 0.1, "dynamic_range_db": 0.1})
    noise = camera["electronics.amplifier_noise"].params.white_e
    capacity = 10**4.03
    e_min = math.sqrt(noise**2 + (capacity / 4095) ** 2 / 12 + 0.25) + 0.5
    assert 20 * math.log10(capacity / e_min) == pytest.approx(71.2, abs=1e-6)
    assert camera["sensor.full_well"].params.full_well_e == pytest.approx(full_well_of_capacity(capacity, noise, 0.01))
    assert camera["electronics.amplifier_noise"].known_from == camera["sensor.full_well"].known_from == "sheet"
    higher = sheet(snr_max_db=40.4, dynamic_range_db=71.2)["electronics.amplifier_noise"].params.white_e - noise
    wider = sheet(snr_max_db=40.3, dynamic_range_db=71.3)["electronics.amplifier_noise"].params.white_e - noise
    assert camera.estimates["electronics.amplifier_noise"]["white_e"].u == pytest.approx(math.hypot(higher, wider), rel=0.05)


@pytest.mark.parametrize("error", [1e-4, 0.002, 0.01, 0.04])
def test_the_bend_has_the_linearity_error_of_the_sheet(error: float) -> None:
    """By an optimiser over the line's two parameters, in place of the normal equations."""
    from scipy.optimize import minimize

    bend = whole(nonlinearity_rel=error)["electronics.nonlinearity"].params.a1
    assert bend < 0
    x = np.linspace(0.05, 0.95, 400)
    y = x + bend * x**2
    line = minimize(lambda p: float((((p[0] + p[1] * x) - y) ** 2 / y**2).sum()), [0.0, 1.0], method="Nelder-Mead", tol=1e-14).x
    assert np.abs(y / (line[0] + line[1] * x) - 1).mean() == pytest.approx(error, rel=0.02)
    assert linearity_error(bend) == pytest.approx(error, rel=1e-6)


def test_diffraction_is_that_of_the_point_spread(rng: np.random.Generator) -> None:
    """The closed form against the autocorrelation of the pupil by which the camera spreads its light."""
    f_number, wavelength, pitch = rng.uniform(0.95, 32), rng.uniform(400, 1000), rng.uniform(1, 20)
    params = PointSpread(model="diffraction", f_number=f_number, wavelength_nm=wavelength, pitch_x_um=pitch, pitch_y_um=pitch)
    lp_per_mm = np.linspace(1, 1.2e6 / f_number / wavelength, 25)
    seen = transfer(params, lp_per_mm * pitch / 1000, np.zeros(25))
    assert np.allclose(diffraction_mtf(lp_per_mm, f_number, wavelength), seen.real, atol=1e-6)


def test_blur_and_diffraction_together_have_the_mtf_of_the_sheet() -> None:
    """By the transfer functions with which the two elements of the chain spread the light."""
    camera = whole(lens={"f_number": 5.6, "mtf": [[60, 0.45]]}, wavelength_nm=600)
    blur, spread = camera[BLUR].params, camera["optics.point_spread"].params
    nu = 60 * 3.45 / 1000
    together = float(transfer(spread, np.array([nu]), np.zeros(1)).real[0]) * math.exp(-2 * (math.pi * blur.sigma_px * nu) ** 2)
    assert together == pytest.approx(0.45, abs=1e-6)


def test_the_best_blur_of_several_points_is_that_of_least_squares(rng: np.random.Generator) -> None:
    from scipy.optimize import curve_fit

    frequency = np.array([20.0, 40.0, 80.0, 120.0])
    sigma_mm, u = 1.5e-3, 1e-4
    mtf = diffraction_mtf(frequency, 2.8, 550) * np.exp(-2 * (np.pi * sigma_mm * frequency) ** 2) + rng.normal(0, u, 4)
    found, u_found = blur_of_mtf(tuple(zip(frequency, mtf, strict=True)), u, 2.8, 550)

    def model(nu: np.ndarray, s: float) -> np.ndarray:
        return diffraction_mtf(nu, 2.8, 550) * np.exp(-2 * (np.pi * s * nu) ** 2)

    best, covariance = curve_fit(model, frequency, mtf, [1e-3], sigma=np.full(4, u), absolute_sigma=True)
    assert found == pytest.approx(1000 * best[0], rel=1e-4) and u_found == pytest.approx(1000 * math.sqrt(covariance[0, 0]), rel=1e-2)
    assert abs(found - 1.5) < stats.norm.isf(5e-7) * u_found  # false failures 1e-6


def test_one_mtf_is_that_at_the_pixels_nyquist_frequency() -> None:
    assert whole(lens={"f_number": 4, "mtf": 0.3})[BLUR].params == whole(lens={"f_number": 4, "mtf": [[500 / 3.45, 0.3]]})[BLUR].params


def test_a_diffraction_limited_lens_has_no_other_blur_and_an_unknown_one_the_usual() -> None:
    limited = whole(lens={"f_number": 8, "mtf": "diffraction-limited"})
    assert BLUR not in limited and limited["optics.point_spread"].params.f_number == 8
    usual = whole(lens={"f_number": 8})
    assert usual[BLUR].known_from == "typical" and usual[BLUR].params.sigma_px == 0.6


def test_the_distortion_is_that_at_the_corner_of_the_frame() -> None:
    camera = sheet(rows=481, cols=641, lens={"distortion_rel": 0.02})
    x, y = pull_of(camera["optics.distortion"].params, camera.frame_shape)(np.array([640.5]), np.array([480.5]))
    radius = math.hypot(x[0] - 320, y[0] - 240)
    assert math.hypot(320.5, 240.5) / radius - 1 == pytest.approx(0.02, rel=1e-9)


# ---- what is refused ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bits": None}, "'bits' is missing.*add `bits"),
        ({"pitch_um": None}, "'pitch_um' is missing.*pitch_x_um"),
        ({"pitch_x_um": 3.0}, "given twice"),
        ({"bits": 24}, "'bits'.*less than or equal to 16"),
        ({"read_noise": 3.0}, "'read_noise' lacks its unit.*read_noise_e"),
        ({"prnu_percent": 1}, "unknown key 'prnu_percent'"),
        ({"quantum_efficiency": 62}, "'quantum_efficiency'.*less than or equal to 1"),
        ({"read_noise_e": "2,3"}, "2.3"),
        ({"colour": "RGB"}, "colour"),
        ({"schema": "pixmetry/data_sheet/2"}, "another kind.*pixmetry/data_sheet/1"),
        ({"u": {"read_noise_e": 0.1}}, "uncertainty of 'read_noise_e', which the sheet does not state"),
        ({"read_noise_e": 3.0, "u": {"read_noise_e": -0.1}}, "uncertainty of read_noise_e.*0 or more"),
        ({"full_well_e": 9000, "saturation_capacity_e": 10_000}, "full well below the saturation capacity.*give one"),
        ({"gain_dn_per_e": 2.6, "saturation_capacity_e": 10_400}, "full before the saturation capacity.*up to 4095.*1/K"),
        ({"dynamic_range_db": 70}, "a dynamic range without what it is a range of.*snr_max_db"),
        ({"dynamic_range_db": 100, "snr_max_db": 40}, "a dynamic range that rounding does not leave"),
        ({"saturation_capacity_e": 10_000, "snr_max_db": 45}, "not the root.*40.0 dB"),
        ({"dsnu_row_e": 1.0}, "without dsnu_e"),
        ({"prnu_rel": 0.001, "prnu_row_rel": 0.01}, "larger than it"),
        ({"bits": 8, "full_well_e": 20, "read_noise_e": 90.0}, "black and its noise fill the range"),
        ({"lens": {"mtf": "diffraction-limited"}}, "'lens.f_number' is missing"),
        ({"lens": {"f_number": 16, "mtf": [[100, 0.9]]}}, "better than diffraction at f/16.*up to 0.0"),
        ({"lens": {"mtf": [[100, 1.2]]}}, "an MTF that cannot be"),
        ({"lens": {"mtf": []}}, "an MTF that cannot be"),
        ({"lens": {"mtf": "good"}}, "lens.mtf: an MTF of no known form.*diffraction-limited.*pairs.*Nyquist"),
        ({"lens": {"mtf": [50, 0.6]}}, "an MTF of no known form"),
        ({"lens": {"mtf": {50: 0.6}}}, "an MTF of no known form"),
        ({"lens": {"f_number": 0.2}}, "f_number.*greater than or equal to 0.7"),
        ({"lens": {"distortion_rel": 0.9}}, "lens.distortion_rel.*too strong.*corner"),
    ],
)
def test_a_mistake_is_told_with_what_is_allowed(changes: dict[str, Any], message: str) -> None:
    record = {name: value for name, value in (LEAST | changes).items() if value is not None}
    with pytest.raises((InputError, ChainError), match=rf"(?s){message}"):
        camera_of_data_sheet(record, "sheet.yaml")


def test_the_line_of_the_mistake_is_named(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("schema: pixmetry/data_sheet/1\nrows: 4\ncols: 4\npitch_um: 3\nbits: 12\nread_noise_e: two\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"mine.yaml, line 6: 'read_noise_e' is not a number"):
        load_camera(path)
    path.write_text(path.read_text().replace("two", "2.0"), encoding="utf-8")
    assert load_camera(path).name == "mine"
    path.write_text(path.read_text().replace("data_sheet/1", "emva1288/1"), encoding="utf-8")
    with pytest.raises(InputError, match=r"mine.yaml, line 1: a file of another kind.*pixmetry/camera/1, pixmetry/data_sheet/1"):
        load_camera(path)


# ---- the sheets that come along ----------------------------------------------------------------------------------------------------

SHEETS = sorted(p for p in (files("pixmetry.camera") / "sheets").iterdir() if p.name.endswith(".yaml"))
PAGE = (Path(__file__).resolve().parents[2] / "docs" / "data-sheets.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", SHEETS, ids=lambda p: p.name)
def test_a_sheet_that_comes_along_is_a_camera_under_its_name(path: Any) -> None:
    name = path.name.removesuffix(".yaml")
    camera = load_camera(name)
    assert camera.name == name and camera.expose(Uniform(500.0), window=(0, 0, 8, 8)).data.shape == (1, 8, 8)
    assert f"| `{name}` |" in PAGE
    stated = {e.name for e in camera.chain if e.known_from == "sheet"}
    text = path.read_text(encoding="utf-8")
    noise, well = "electronics.amplifier_noise", "sensor.full_well"
    for key, element in (("full_well_e", well), ("snr_max_db", well), ("read_noise_e", noise), ("dynamic_range_db", noise)):
        assert f"\n{key}:" not in text or element in stated


@pytest.mark.parametrize("path", SHEETS, ids=lambda p: p.name)
def test_the_source_of_every_number_stands_beside_it(path: Any) -> None:
    """Rows and columns of one quotation share it."""
    lines = path.read_text(encoding="utf-8").splitlines()
    bare = [line for line in lines if re.match(r"\w+: [\d.]+\s*$", line)]
    assert [line.split(":")[0] for line in bare] in ([], ["cols"])
    assert lines[0].startswith("# ") and any(line.startswith("source:") for line in lines)


def test_five_sensors_come_along_and_no_name_is_that_of_a_preset() -> None:
    names = {p.name for p in SHEETS}
    assert {f"{name}.yaml" for name in ("imx264", "imx250", "imx183", "cmv4000", "icx285")} <= names
    assert not names & {p.name for p in (files("pixmetry.camera") / "presets").iterdir()}
