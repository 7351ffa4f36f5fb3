"""A calibration enters an assessment: the digital twin gets the lens, the budget what the calibration leaves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from calibrate.networks import simulate
from pixmetry import assess, load_camera
from pixmetry.assess.page.page import page_of
from pixmetry.calibrate.bundle.model import NAMES, CameraModel, Sensor
from pixmetry.calibrate.bundle.solve import Options, calibrate_network
from pixmetry.calibrate.calibrated_camera import calibrated_geometry, geometry_of, with_pitch
from pixmetry.calibrate.files.write import write_results
from pixmetry.camera.observations import LENS
from pixmetry.cli import main
from pixmetry.core.errors import InputError
from pixmetry.emva.job import emva1288
from pixmetry.files import load_campaign
from pixmetry.report import html_of

PITCH = (8.3, 8.3)


def test_a_file_of_a_calibration_enters_twin_report_and_budget(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)  # what is tested does not depend on the draw
    sensor = Sensor(780, 582, *PITCH)
    simulated = simulate(rng, images=12, points=60, sensor=sensor, interior={"k1": -2e-3})
    calibration = calibrate_network(simulated.network, Options(folds=0))
    write_results(calibration, tmp_path / "calibration")
    file = tmp_path / "calibration" / "calibration.json"
    ran = CliRunner().invoke(main, ["assess", "-o", str(tmp_path / "out"), "--trials", "200", "--calibration", str(file.parent)])
    assert ran.exit_code == 0, ran.output
    assert "calibrated" in ran.output and "Lens distortion" in ran.output
    assert "780 × 582 pixels, the frames have 60 × 60" in " ".join(ran.output.split())
    twin = load_camera(tmp_path / "out" / "camera.yaml")
    assert twin[LENS].params.k1_per_mm2 == pytest.approx(-2e-3, rel=0.1)
    assert "calibration.json" in (tmp_path / "out" / "results.json").read_text()
    geometry, again = calibrated_geometry(file), calibrated_geometry(calibration)
    np.testing.assert_allclose(geometry.lens.values, again.lens.values, rtol=1e-9, atol=1e-12)
    assert 0.002 < geometry.u_x_px < 0.3  # twelve images of .04 px: well in the middle, badly in the corners
    report = (tmp_path / "out" / "report.html").read_text()
    assert 'class="status calibrated"' in report


def test_what_is_left_over_counts_in_the_verdict() -> None:
    model = CameraModel.of(Sensor(780, 582, *PITCH), c=12.0, k1=-1e-3)
    fine, poor = (geometry_of(model, (), np.zeros((0, 0)), left_px=(left, left)) for left in (0.0, 0.05))
    totals = [assess(calibration=g, trials=200).budget.verdict.total_px for g in (fine, poor)]
    assert totals[1] == pytest.approx(np.hypot(totals[0], 0.05), rel=0.02)


def test_the_calibration_of_another_camera_is_refused(tmp_path: Path) -> None:
    geometry = geometry_of(CameraModel.of(Sensor(780, 582, 2.2, 2.2), c=12.0), (), np.zeros((0, 0)))
    campaign = load_campaign(None)
    campaign = replace(campaign, camera=replace(campaign.camera, pitch_x_um=8.3, pitch_y_um=8.3))
    with pytest.raises(InputError, match="another pixel pitch"):
        assess(campaign, calibration=geometry, trials=200)
    (tmp_path / "calibration.json").write_text("{}")
    ran = CliRunner().invoke(main, ["assess", "--calibration", str(tmp_path / "calibration.json"), "-o", str(tmp_path / "out")])
    assert ran.exit_code == 2 and ran.output.count("\n") == 1 and not (tmp_path / "out").exists()


def test_another_folder_is_no_calibration(tmp_path: Path) -> None:
    ran = CliRunner().invoke(main, ["assess", "--calibration", str(tmp_path), "-o", str(tmp_path / "out")])
    assert ran.exit_code == 2 and ran.output.count("\n") == 1 and "calibration.json" in ran.output and not (tmp_path / "out").exists()


@pytest.mark.parametrize("direction", ["image_to_object", "object_to_image"])
def test_a_calibration_in_pixels_takes_a_pitch_and_sees_the_same(direction: str, rng: np.random.Generator) -> None:
    lens = {"p1": 1e-6, "p2": -2e-6, "k1": -1e-8, "k2": 2e-14, "k3": 1e-20, "k4": 1e-26, "k5": -1e-32}
    if direction == "object_to_image":
        lens = {name: value * 800.0 ** (1 if name[0] == "p" else 2 * int(name[1])) for name, value in lens.items()}
    names = ("c", "xp", "yp", "b1", "b2", *lens)
    model = CameraModel.of(Sensor(780, 582), direction, names, c=800.0, xp=380.0, yp=300.0, b1=1e-3, b2=-2e-3, **lens)
    root = rng.normal(0, 1, (len(names), len(names))) * 1e-3 * np.abs([model[name] for name in names])[:, None]
    covariance = root @ root.T
    changed, scaled = with_pitch(model, names, covariance, PITCH)
    assert changed.sensor.pitch_x_um == PITCH[0] and changed["c"] == pytest.approx(800 * 0.0083)
    u, v = rng.uniform(-0.4, 0.4, 20), rng.uniform(-0.3, 0.3, 20)
    (x, y, _, before), (x_mm, y_mm, _, after) = model.projected(u, v), changed.projected(u, v)
    np.testing.assert_allclose((x_mm, y_mm), (x, y), atol=1e-8)
    own = [NAMES.index(name) for name in names]
    spread, same = (np.einsum("nij,jk,nik->ni", j[..., own], c, j[..., own]) for j, c in ((before, covariance), (after, scaled)))
    np.testing.assert_allclose(same, spread, rtol=1e-7)


def test_a_pitch_of_the_campaign_stands_in_where_the_calibration_has_none() -> None:
    simulated = simulate(np.random.default_rng(6), images=12, points=60, sensor=Sensor(780, 582, *PITCH))
    net = simulated.network
    (camera,) = net.cameras
    in_px = replace(net, cameras=(CameraModel.of(Sensor(780, 582), camera.direction, c=camera["c"] / 0.0083),))
    calibration = calibrate_network(in_px, Options(folds=0))
    found = calibrated_geometry(calibration, pitch_um=PITCH)
    expected = calibrated_geometry(calibrate_network(net, Options(folds=0)))
    np.testing.assert_allclose(found.lens.values, expected.lens.values, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(found.u_x_px, expected.u_x_px, rtol=1e-2)
    with pytest.raises(InputError, match="pixel pitch is not known.*campaign"):
        calibrated_geometry(calibration)
    with pytest.raises(InputError, match="not square"):
        calibrated_geometry(calibration, pitch_um=(8.6, 8.3))


def test_frames_of_a_window_see_the_lens_of_the_whole_sensor(tmp_path: Path) -> None:
    """The principal point, in pixels of the sensor, is where the calibration has it, whatever part of the sensor the frames show."""
    sensor = Sensor(780, 582, *PITCH)
    simulated = simulate(np.random.default_rng(5), images=12, points=60, sensor=sensor, interior={"k1": -2e-3})
    write_results(calibrate_network(simulated.network, Options(folds=0)), tmp_path / "calibration")
    campaign = load_campaign(None)
    facts = {"pitch_x_um": 8.3, "pitch_y_um": 8.3, "sensor_cols": 780, "sensor_rows": 582, "first_col": 500, "first_row": 10}
    campaign = replace(campaign, camera=replace(campaign.camera, **facts))
    assessment = assess(campaign, calibration=tmp_path / "calibration", trials=0)
    lens, whole = assessment.camera[LENS].params, calibrated_geometry(tmp_path / "calibration").lens
    assert lens.centre_x_px + 59 / 2 + 500 == pytest.approx(whole["centre_x_px"].value + 779 / 2)
    assert lens.centre_y_px + 59 / 2 + 10 == pytest.approx(whole["centre_y_px"].value + 581 / 2)
    notes = " ".join(assessment.observations.notes)
    assert "60 × 60 pixels from column 500, row 10 of a sensor of 780 × 582" in notes
    assert "not for another camera" not in notes


def test_what_is_accepted_is_taken_for_the_whole_sensor_and_what_is_measured_for_the_window() -> None:
    campaign = load_campaign(None)
    window = assess(campaign, trials=0)
    facts = {"sensor_cols": 1600, "sensor_rows": 1600, "vendor": "Maker", "serial_number": "7"}
    whole = assess(replace(campaign, camera=replace(campaign.camera, **facts), operator="A. Tester"), trials=0)
    was = {row.name: row for row in window.budget.rows}
    changed = {row.name for row in whole.budget.rows if row.total_px != was[row.name].total_px}
    assert changed and all(was[name].status == "accepted" for name in changed)
    record = whole.to_record()
    assert record["camera"]["sensor_cols"] == 1600 and record["camera"]["vendor"] == "Maker"
    assert record["conditions"]["operator"] == "A. Tester"
    assert record["conditions"]["lossless"] is True and record["conditions"]["lossless_known"] == "proven"
    assert "Serial number" in html_of(page_of(whole)) and "1600 × 1600" in html_of(page_of(whole))
    camera = emva1288(replace(campaign, camera=replace(campaign.camera, **facts), operator="A. Tester"))
    assert camera.camera["serial_number"] == "7" and camera.conditions["operator"] == "A. Tester"
