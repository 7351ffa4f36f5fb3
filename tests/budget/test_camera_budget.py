"""The budget of a camera in a scenario: every row, in every preset; what calibrations, states and several descriptions make of it."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

import pixmetry
from pixmetry.budget.answer import answer_of, rms
from pixmetry.budget.camera_budget import CameraBudget
from pixmetry.budget.cameras import camera_of
from pixmetry.budget.motion import lag_contribution
from pixmetry.budget.page import page_of
from pixmetry.budget.scenario import Scenario, read_scenario
from pixmetry.budget.setting import Setting
from pixmetry.budget.table import ABSENT, AT_BOUND, COUNTED, ELSEWHERE, MEASURED, SHEET, TYPICAL, SourceRow, Table
from pixmetry.camera.camera import Camera, Element, load_camera
from pixmetry.camera.catalogue import get_source, sources
from pixmetry.core.errors import InputError, ParameterError
from pixmetry.core.number import Estimates
from pixmetry.locate.centroids.fixed import FixedCentroid
from pixmetry.locate.target_estimator import TargetEstimator
from pixmetry.report.html import html_of

PRESETS = ("imx264_like", "pulnix_tm6cn_epix_512", "ft_ccd_generic", "cmos_log_fuga15")
SHAPE = (240, 320)  # of the presets here, but for those with a grabber of their own size


@cache
def camera(name: str) -> Camera:
    found = load_camera(name)
    return found if "epix" in name else replace(found, frame_shape=SHAPE)


@cache
def budget_of(name: str) -> CameraBudget:
    return pixmetry.budget(camera(name), {"motion": {"speed_px_per_s": 20.0}, "light": {"source": "laser"}})


@pytest.mark.parametrize("name", PRESETS)
def test_every_source_has_a_row_that_says_what_it_does_or_why_not(name: str) -> None:
    found = budget_of(name)
    assert {r.source_id for r in found.rows} == {*sources(), "calibration"}
    for row in found.rows:
        assert row.status in (*COUNTED, AT_BOUND, ABSENT, ELSEWHERE)
        assert row.before is not None and row.after is not None and row.how or row.reason, row.name
        for parts in (row.before, row.after, row.largest):
            if parts is not None:
                assert np.isfinite([*parts.constant_px, *parts.smooth_px, *parts.place_px, *parts.time_px]).all(), row.name
        if row.gum_class not in ("D", "O") and row.name != "calibration":
            assert row.after_px <= row.before_px * (1 + 1e-9) + 1e-6, row.name
        assert row.largest_px >= row.after_px, row.name
        assert 0 <= row.share <= 1 and 0 <= row.own_stars <= 5
    assert sum(r.share for r in found.rows) == pytest.approx(1.0)


@pytest.mark.parametrize("name", PRESETS)
def test_the_interval_holds_the_answer_and_things_to_do_lower_it(name: str) -> None:
    found = budget_of(name)
    one = found.one
    for least, after, most in zip(one.least_px, one.after_px, one.most_px, strict=True):
        assert 0 < least <= after <= most * (1 + 1e-9)
    assert rms(one.after_px) <= rms(one.before_px)
    for steps, now in ((found.to_measure, one.most_rms_px), (found.to_change, one.after_rms_px)):
        assert all(s.now_px == pytest.approx(now) and s.then_px < s.now_px for s in steps)
        assert [s.then_px for s in steps] == sorted(s.then_px for s in steps)
    averaged = answer_of(found.rows, frames=16, targets=4)
    assert rms(averaged.after_px) < rms(one.after_px)


@pytest.mark.parametrize("name", PRESETS)
def test_the_record_is_json_and_the_table_a_data_frame(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = budget_of(name)
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))  # which holds columns as pandas does
    record = json.loads(json.dumps(found.to_record(), allow_nan=False))
    assert record["schema"] == "pixmetry/camera_budget/1" and len(record["rows"]) == len(sources()) + 1
    assert found.to_dataframe()["title"] == [r.title for r in found.rows]
    assert found.camera in repr(found) and "<table>" in found._repr_html_()


def left_px(cam: Camera, source_id: str, scenario: dict[str, object]) -> float:
    """What one source leaves after the calibration; the others are not computed."""
    table = Table(Setting(cam, read_scenario(scenario)), TargetEstimator())
    return next(r.after_px for r in table.rows([source_id]))


def test_a_cold_grabber_is_off_and_a_warm_one_is_not() -> None:
    """With everything else as it is: a scale that is off by 0.71 % e^(−t/820 s) of 149 + x pixels."""
    cam, name = camera("pulnix_tm6cn_epix_512"), "grabber.clock_warm_up"
    x = np.linspace(0, 720, 2000)  # what the 512 samples still show
    expected = np.sqrt(0.5 * np.mean(((149 + x) * 0.0071) ** 2))
    assert left_px(cam, name, {"state": {"grabber_on_min": 0.0}}) == pytest.approx(expected, rel=0.02)
    assert left_px(cam, name, {"state": {"grabber_on_min": 120.0}}) < 1e-3
    assert left_px(cam, name, {"state": {"grabber_on_min": 0.0}, "calibration": {"every_image": True}}) < 0.01


def test_what_is_calibrated_decides_what_is_left() -> None:
    models = ("none", "principal_point_and_scale", "lens")
    found = [rms(pixmetry.budget(camera("imx264_like"), {"calibration": {"model": m}}).one.after_px) for m in models]
    assert found[0] > found[1] > found[2]


@pytest.mark.parametrize(
    ("source_id", "scenario"),
    [
        ("sensor.trigger_jitter", {"motion": {"speed_px_per_s": 500.0}}),
        ("scene.speckle", {"light": {"source": "laser", "wavelength_nm": 650.0, "f_number": 8.0}}),
        ("storage.jpeg", {"storage": {"format": "jpeg", "quality": 50}}),
        ("scene.view_point", {"target": {"surface": "glossy"}}),
    ],
)
def test_motion_light_and_storage_bring_their_sources_in(source_id: str, scenario: dict[str, object]) -> None:
    usual = left_px(camera("imx264_like"), source_id, {"target": {"surface": "retro"}})
    assert left_px(camera("imx264_like"), source_id, scenario) > 3 * usual


def test_a_cold_camera_that_only_has_the_usual_drifts_is_off() -> None:
    """Mount and temperature of a camera whose description holds neither: as old as the scenario says, calibrated when warm."""
    drift = [left_px(camera("imx264_like"), "sensor.mount_drift", {"state": {"camera_on_min": m}}) for m in (0.0, 10.0, 120.0)]
    heat = [left_px(camera("imx264_like"), "sensor.thermal_expansion", {"state": {"camera_on_min": m}}) for m in (0.0, 10.0, 120.0)]
    for values in (drift, heat):
        assert values[0] > values[1] > 10 * values[2]


def test_a_light_that_the_scenario_tells_has_no_other_bound() -> None:
    told = {"target": {"gradient_rel_per_px": 0.1}}
    row = next(r for r in Table(Setting(camera("imx264_like"), read_scenario(told)), TargetEstimator()).rows(["scene.view_point"]))
    assert row.largest is None and row.after_px > 0.1


def test_jitter_averages_over_frames_and_latency_does_not() -> None:
    scenario = read_scenario({"motion": {"speed_px_per_s": 1000.0}})
    row = next(r for r in Table(Setting(camera("imx264_like"), scenario), TargetEstimator()).rows(["sensor.trigger_jitter"]))
    one, many = (answer_of([row], frames=n).after_px[0] for n in (1, 100))
    assert row.after.time_px[0] == pytest.approx(1000 * 10e-6, rel=0.2)
    assert many < one and many == pytest.approx(1000 * 50e-6, rel=0.01)


def test_a_lag_pulls_a_slow_target_back_and_leaves_a_fast_one() -> None:
    """Slow: v T q/(1 − q) of the share q = 0.1, for the centroid. Fast: the ghosts lie outside of the window."""
    cam, source = camera("imx264_like"), get_source("sensor.image_lag")
    lagging = Element(source.id, source, source.make({"lag_rel": 0.1}))

    def shift(speed: float) -> float:
        setting = Setting(cam, read_scenario({"motion": {"speed_px_per_s": speed, "frame_period_s": 0.01}}))
        return lag_contribution(lagging, setting, FixedCentroid(window=25)).bias_x_px

    assert shift(20.0) == pytest.approx(-20 * 0.01 * 0.1 / 0.9, rel=0.02)
    assert abs(shift(1e5)) < 1e-3


def test_a_source_that_is_switched_off_is_not_in_the_camera() -> None:
    source = get_source("sensor.tilt")
    off = Element(source.id, source, source.typical, on=False)
    cam = replace(camera("imx264_like"), chain=(off, *camera("imx264_like").chain))
    row = next(r for r in Table(Setting(cam, Scenario()), TargetEstimator()).rows(["sensor.tilt"]))
    assert row.status == ABSENT and "switched off" in row.reason


def test_a_typical_element_of_the_chain_has_the_same_bound_as_one_beyond_it() -> None:
    source, scenario = get_source("sensor.tilt"), read_scenario({"calibration": {"model": "none"}})
    beyond = next(r for r in Table(Setting(camera("imx264_like"), scenario), TargetEstimator()).rows(["sensor.tilt"]))
    element = Element(source.id, source, Table(Setting(camera("imx264_like"), scenario), TargetEstimator())._own(source, source.typical))
    cam = replace(camera("imx264_like"), chain=(replace(element, known_from="typical"), *camera("imx264_like").chain))
    inside = next(r for r in Table(Setting(cam, scenario), TargetEstimator()).rows(["sensor.tilt"]))
    assert inside.before_px == pytest.approx(beyond.before_px) and inside.largest_px == pytest.approx(beyond.largest_px)
    assert inside.largest_px > 2 * inside.before_px


def test_a_camera_joined_with_itself_is_itself() -> None:
    sheet_camera = load_camera("imx250")
    joined, compared = camera_of([sheet_camera, sheet_camera])
    assert [(e.name, e.params) for e in joined.chain] == [(e.name, e.params) for e in sheet_camera.chain]
    assert all(d.agree for d in compared)


def test_the_aperture_of_the_scenario_is_that_of_the_lens_in_the_chain() -> None:
    source = get_source("optics.point_spread")
    lens = Element("lens", source, source.make({"model": "diffraction", "f_number": 4.0}), known_from="sheet")
    cam = replace(camera("imx264_like"), chain=(lens, *camera("imx264_like").chain))
    stopped_down = Setting(cam, read_scenario({"light": {"f_number": 16.0}})).camera["lens"]
    assert stopped_down.params.f_number == 16.0 and stopped_down.known_from == "sheet"
    assert Setting(cam, Scenario()).camera["lens"].params.f_number == 4.0


def test_the_chief_ray_follows_the_lens() -> None:
    near, far = (left_px(camera("imx264_like"), "sensor.unflatness", {"object": {"f_mm": f}}) for f in (4.0, 50.0))
    assert near > 5 * far


def measured(value: float, u: float) -> Camera:
    """The camera with a PRNU that was measured."""
    found = camera("imx264_like").with_parameters("sensor.prnu", pixel_std_rel=value, row_std_rel=0.0, col_std_rel=0.0)
    estimates = Estimates.from_rows([("pixel_std_rel", value, u, 100.0, "1")], method="a test")
    chain = tuple(replace(e, known_from="measured", estimates=estimates) if e.source.id == "sensor.prnu" else e for e in found.chain)
    return replace(found, name="measured", chain=chain)


def sheet(value: float) -> Camera:
    found = camera("imx264_like").with_parameters("sensor.prnu", pixel_std_rel=value, row_std_rel=0.0, col_std_rel=0.0)
    return replace(found, chain=tuple(replace(e, known_from="sheet") if e.source.id == "sensor.prnu" else e for e in found.chain))


def test_what_was_measured_goes_before_the_sheet_and_is_compared_with_it() -> None:
    joined, compared = camera_of([sheet(0.005), measured(0.01, 0.0002)])
    assert joined["sensor.prnu"].params.pixel_std_rel == 0.01 and joined["sensor.prnu"].known_from == "measured"
    of_prnu = [d for d in compared if d.parameter == "pixel_std_rel"]
    assert len(of_prnu) == 1 and not of_prnu[0].agree
    assert all(d.agree for d in camera_of([sheet(0.0101), measured(0.01, 0.0002)])[1])
    row, alone = (next(r for r in Table(Setting(c, Scenario()), TargetEstimator()).rows(["sensor.prnu"])) for c in (joined, sheet(0.005)))
    assert row.status == MEASURED and row.largest_px == pytest.approx(1.04 * row.after_px, rel=0.01)  # two standard uncertainties
    assert row.u_of_total_px == pytest.approx(0.02 * row.before_px, rel=0.01)  # 2 % of the value
    assert alone.status == SHEET and row.before_px == pytest.approx(2 * alone.before_px, rel=0.01)


def test_descriptions_of_different_sensors_are_refused() -> None:
    with pytest.raises(InputError, match="different sensors"):
        camera_of([camera("imx264_like"), camera("pulnix_tm6cn_epix_512")])


def test_a_measured_source_leaves_the_interval_and_the_list_of_what_to_measure() -> None:
    found = pixmetry.budget(measured(0.01, 0.0002))
    assert "sensor.prnu" not in [n.source_id for n in found.to_measure]
    assert all(next(r for r in found.rows if r.name == n.name).status in (TYPICAL, AT_BOUND) for n in found.to_measure)


def test_lengths_on_the_object_follow_the_scale() -> None:
    near, far = (pixmetry.budget(camera("imx264_like"), {"object": {"distance_mm": d, "f_mm": 25.0}}) for d in (1025.0, 2025.0))
    assert near.setting.px_per_mm == pytest.approx(25 / 1000 / 3.45e-3)
    assert near.mm(near.one.after_px)[0] == pytest.approx(near.one.after_px[0] * 1000 / 25 * 3.45e-3)
    ratio = far.point.u_mm[2] / near.point.u_mm[2] / (rms(far.answer.after_px) / rms(near.answer.after_px))
    assert ratio == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"target": {"diameter_mm": 5.0}}, "scale of the image"),
        ({"motion": {"speed_mm_per_s": 5.0}}, "scale of the image"),
        ({"target": {"diameter_mm": 5.0, "diameter_px": 7.0}}, "say the same"),
        ({"object": {"distance_mm": 10.0, "f_mm": 25.0}, "target": {"diameter_mm": 1.0}}, "nearer than the focal length"),
        ({"calibration": {"model": "magic"}}, "principal_point_and_scale"),
        ({"target": {"diameter_px": 150.0}}, "too large"),
        ({"object": {"field_mm": 100.0, "distance_mm": 2000.0, "f_mm": 25.0}}, "two of them give the third"),
        ({"storage": {"format": "tape"}}, "not stored on tape"),
        ({"speed": 3}, "speed"),
    ],
)
def test_a_scenario_that_cannot_be_used_is_refused_in_words(given: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        pixmetry.budget(camera("imx264_like"), given)


def test_a_scenario_file_and_its_defaults(tmp_path) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text("schema: pixmetry/scenario/1\nmotion: {speed_px_per_s: 50}\n", encoding="utf-8")
    found = read_scenario(path)
    assert found.told["motion.speed_px_per_s"] == (50.0, True) and found.told["count.rays"] == (2, False)
    assert read_scenario(None) == Scenario()
    path.write_text("schema: pixmetry/scenario/1\nmotion: {speed: 50}\n", encoding="utf-8")
    with pytest.raises(InputError, match="line 2"):
        read_scenario(path)


def test_what_is_measured_as_nothing_may_be_there_within_its_uncertainty() -> None:
    """Scales of x and y that differ by 0 ± u stretch a frame of 320 columns by u · 320/√12 px (rms); the upper end holds twice that."""
    u = 1e-3
    estimates = Estimates.from_rows([("b1", 0.0, u, 100.0, "1")])
    affinity = Element(
        "affinity", get_source("sensor.affinity"), get_source("sensor.affinity").make({}), known_from="measured", estimates=estimates
    )
    cam = camera("imx264_like")
    setting = Setting(replace(cam, chain=(affinity, *cam.chain)), Scenario.model_validate({"calibration": {"model": "none"}}))
    (row,) = Table(setting, TargetEstimator()).rows(["sensor.affinity"])
    stretched = u * SHAPE[1] / np.sqrt(12)
    assert row.status == MEASURED and row.after_px == 0
    assert row.u_of_total_px == pytest.approx(stretched / np.sqrt(2), rel=0.01)  # rms over x and y
    assert row.largest is not None and row.largest.smooth_px == pytest.approx((2 * stretched, 0.0), rel=0.01)


@pytest.mark.parametrize(
    ("source_id", "name", "value", "u", "scenario"),
    [
        ("optics.distortion", "k1_per_mm2", 1e-4, 1e-5, {}),
        ("sensor.trigger_jitter", "jitter_s", 1e-6, 2e-7, {"motion": {"speed_px_per_s": 2000.0}}),
        ("sensor.pixel_aperture", "width_x_px", 0.7, 0.1, {}),
    ],
)
def test_the_uncertainty_of_a_measured_value_without_a_closed_form_is_in_the_interval(
    source_id: str, name: str, value: float, u: float, scenario: dict[str, object]
) -> None:
    """It is the root mean square of the changes of the row if the value is larger and smaller by u."""

    def row_of(at: float, u: float = 0.0) -> SourceRow:
        source = get_source(source_id)
        estimates = Estimates.from_rows([(name, at, u, 100.0, source.units[name])])
        params = source.make({**source.typical.model_dump(), name: at})
        cam = camera("imx264_like")
        chain = tuple(e for e in cam.chain if e.source.id != source_id)
        setting = Setting(replace(cam, chain=chain), Scenario.model_validate(scenario))
        return Table(setting, TargetEstimator()).row(
            Element(source_id, source, params, known_from="measured", estimates=estimates), in_camera=False
        )

    row, low, high = row_of(value, u), row_of(value - u), row_of(value + u)
    change = rms((high.before_px - row.before_px, low.before_px - row.before_px))
    assert change > 0 and row.u_of_total_px == pytest.approx(change, rel=1e-6)
    assert row.largest_px > row.after_px


@pytest.mark.parametrize(("side", "pitch_um"), [((10652, 14204), 3.76), ((200, 300), 3.76), ((1, 2048), 14.0), ((6000, 8000), 0.8)])
def test_usual_lenses_and_sensors_grow_with_the_format(side: tuple[int, int], pitch_um: float) -> None:
    """A lens has as many percent of distortion in the corner of any format, here at most 0.8 %."""
    cam = replace(camera("imx264_like"), frame_shape=side, pitch_um=(pitch_um, pitch_um))
    setting = Setting(cam, Scenario.model_validate({"calibration": {"model": "none"}}))
    (row,) = Table(setting, TargetEstimator()).rows(["optics.distortion"])
    corner_px = 0.5 * np.hypot(*side)
    assert row.reason == "" and 0.2 * 0.008 * corner_px < row.before_px < 0.008 * corner_px


def test_what_cannot_be_computed_is_left_out_and_said() -> None:
    """A source whose model does not hold for this camera loses its own row only; record and page say that the answer lacks it."""
    prnu, whole = get_source("sensor.prnu"), pixmetry.budget(camera("imx264_like"))

    def refuse(*given: object) -> None:
        raise ParameterError("the model does not hold here")

    broken = replace(prnu, propagate=refuse)
    cam = camera("imx264_like")
    chain = tuple(replace(e, source=broken) if e.source.id == prnu.id else e for e in cam.chain)
    found = pixmetry.budget(replace(cam, chain=chain))
    (name,) = found.to_record()["left_out"]
    assert [r.source_id for r in found.left_out] == [prnu.id] and name == found.left_out[0].name
    assert "does not hold here" in html_of(page_of(found)) and whole.left_out == ()
    assert 0 < found.one.after_px[0] < whole.one.after_px[0]


def test_a_source_that_stands_twice_in_a_chain_has_its_names_in_the_table() -> None:
    """The lens of a data sheet has two spreads: diffraction, and what else blurs."""
    camera = load_camera("imx264_like")
    source = get_source("optics.point_spread")
    two = (Element(name, source, source.make({"sigma_px": 0.4})) for name in (source.id, "lens blur"))
    twice = replace(camera, chain=(*two, *camera.chain))
    rows = Table(Setting(twice, read_scenario({})), TargetEstimator()).rows({"optics.point_spread"})
    assert {r.title for r in rows} == {"Point spread of the lens", "Point spread of the lens (lens blur)"}
