"""Displacements over the frame against closed forms and against located discs; what calibrations leave of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pixmetry.budget.fields import Calibration, Places, field_of, spread_of
from pixmetry.camera.camera import Camera, Element, load_camera
from pixmetry.camera.catalogue import get_source
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

SHAPE = (400, 500)


def camera_with(source_id: str, **params: object) -> Camera:
    source = get_source(source_id)
    return Camera("test", SHAPE, (Element(source_id, source, source.make(params)),), pitch_um=(5.0, 5.0))


DISTORTED = camera_with("optics.distortion", k1_per_mm2=-2e-2, p1_per_mm=1e-3, pitch_x_um=5.0, pitch_y_um=5.0)


def left(camera: Camera, model: str, then: Camera | None = None, **kw: object) -> np.ndarray:
    places = Places.over(SHAPE, kw.pop("grid_px", 60.0))
    fields = field_of(camera, places), field_of(then or camera, places)
    return Calibration(model, bool(kw.get("every_image")), places).left(*fields)


def test_a_field_is_where_discs_are_found() -> None:
    """Discs through the camera's chain, by their centre of gravity; within 0.006 px: the light of a disc is stretched, too."""
    places = Places.over(SHAPE, 100.0)
    field = field_of(DISTORTED, places)[:, 0]
    inside = np.flatnonzero((np.abs(places.x_px[0] - 250) < 200) & (np.abs(places.y_px[0] - 200) < 150))[:40]
    for i in inside:
        x, y = places.x_px[0, i], places.y_px[0, i]
        at = np.rint([x + field[0, i], y + field[1, i]]).astype(int)
        scene = Discs([x], [y], diameter_px=5.0, blur_px=0.8, peak_photons=1e4, background=Uniform(0.0))
        frame = DISTORTED.expose(scene, window=(int(at[1]) - 10, int(at[0]) - 10, 21, 21)).data[0].astype(float)
        rows, cols = np.mgrid[-10:11, -10:11]
        found = np.array([(cols * frame).sum(), (rows * frame).sum()]) / frame.sum() + at
        assert found - (x, y) == pytest.approx(field[:, i], abs=0.006)


@pytest.mark.parametrize(
    "camera",
    [
        DISTORTED,
        camera_with("sensor.affinity", b1=1e-3, b2=5e-4),
        camera_with("optics.distortion", k1_per_mm2=1e-2, k2_per_mm4=1e-3, pitch_x_um=5.0, pitch_y_um=5.0),
    ],
    ids=["radial and tangential", "affine", "two radial terms"],
)
def test_a_lens_calibration_takes_up_what_it_models(camera: Camera) -> None:
    before, after = spread_of(left(camera, "none"))[1], spread_of(left(camera, "lens"))[1]
    assert before.max() > 0.05
    assert after.max() < 1e-6 * before.max()


def test_a_tilt_of_the_sensor_is_a_rotation_of_the_camera_but_for_third_order() -> None:
    camera = camera_with("sensor.tilt", tilt_x_deg=0.5, principal_distance_mm=8.0, pitch_x_um=5.0, pitch_y_um=5.0)
    assert spread_of(left(camera, "none"))[1].max() > 0.05
    assert spread_of(left(camera, "lens"))[1].max() < 1e-3


def test_shift_and_scales_leave_the_curved_part() -> None:
    """Of δ = k x³ over an even spread of x in ±1, a line leaves k √(4/175): its projection on P₃."""
    places = Places.over(SHAPE, 100.0)
    unit = (places.x_px - 249.5) / 249.5
    field = np.stack([0.3 * unit**3, np.zeros_like(unit)])
    found = Calibration("principal_point_and_scale", False, places).left(field, field)
    assert spread_of(found)[1][0] == pytest.approx(0.3 * np.sqrt(4 / 175), rel=0.03)


def test_a_grid_leaves_the_curvature_within_its_cells() -> None:
    """Of sin(2πx/P) with cells of d, bilinear interpolation leaves (2πd/P)²/8 at most; what lies between is left to no polynomial."""
    places = Places.over(SHAPE, 25.0)
    wave = 0.1 * np.sin(2 * np.pi * places.x_px / 125.0)
    field = np.stack([wave, np.zeros_like(wave)])
    left_px = np.abs(Calibration("residual_grid", False, places).left(field, field)[0])
    bound = 0.1 * (2 * np.pi * 25 / 125) ** 2 / 8
    assert 0.5 * bound < left_px.max() < 1.1 * bound
    assert spread_of(Calibration("lens", False, places).left(field, field))[1][0] > 0.05


def test_a_drift_since_the_calibration_stays_and_a_fit_in_every_image_takes_it_up() -> None:
    """A mount of 23e-6/K that is 10 K warmer than when it was calibrated: the scale is off by 2.3e-4 at every place."""
    warm = camera_with("sensor.thermal_expansion", reference_c=20.0, mount_per_k=23e-6)
    then, now = replace(warm, temperature_c=30.0), replace(warm, temperature_c=40.0)
    places = Places.over(SHAPE, 100.0)
    found = left(now, "lens", then)
    assert found[0] == pytest.approx(2.3e-4 * (places.x_px[0] - 249.5), rel=2e-3, abs=1e-5)
    assert np.abs(left(now, "lens", then, every_image=True)).max() < 1e-6


def test_a_layout_that_is_not_known_is_an_error_of_its_own() -> None:
    """512 samples at 10 MHz show 726.4 of 752 pixels: taken for the whole row, they are off by the missing 3.4 % of the scale."""
    camera = load_camera("pulnix_tm6cn_epix_512").switched(on=["grabber.sampling_clock"])
    places = Places.over(camera.frame_shape, 100.0)
    field = field_of(camera, places, known_layout=False)[0, 0]
    scale = np.polyfit(places.x_px[0][np.isfinite(field)], field[np.isfinite(field)], 1)[0]
    assert scale == pytest.approx(752 / 512 / 1.41875 - 1, rel=1e-3)
    assert np.nanmax(np.abs(field_of(camera, places)[0, 0])) < 1e-9
