"""Points in space: against intersections of noisy rays, and against whole networks that `pixmetry.calibrate` adjusts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from budget.cameras import element
from budget.measured_networks import Measured, calibration_shots, measuring_shots
from pixmetry.budget.calibration_noise import calibration_row
from pixmetry.budget.networks import Images, solve, stations, towards
from pixmetry.budget.object_space import point_of
from pixmetry.budget.scenario import read_scenario
from pixmetry.budget.setting import Setting
from pixmetry.budget.table import DESCRIBED, Parts, SourceRow, Table
from pixmetry.camera.camera import Camera
from pixmetry.locate.target_estimator import TargetEstimator

C_PX = 4000.0


def at_the_middle(u_px: tuple[float, float], rays: int, base_to_height: float, arrangement: str = "circle") -> np.ndarray:
    """Standard uncertainty of a point in the middle, cameras known, over the distance."""
    position = stations(rays, base_to_height, arrangement)
    images = Images(C_PX, (1000, 1000), 1.0, towards(position), position, np.zeros((1, 3)))
    return np.sqrt(np.diag(solve(images, u_px, posed=True).point_covariance[0]))


def scattered(u_px: tuple[float, float], rays: int, base_to_height: float, trials: int, rng: np.random.Generator) -> np.ndarray:
    """Covariance of points that pinhole cameras turned to the point see with noise; shape (3, 3)."""
    angles = np.pi * np.arange(rays) * (1 if rays == 2 else 2 / rays)
    cameras = []
    for a in angles:
        centre = np.array([np.cos(a), np.sin(a), 0.0]) * 0.5 * base_to_height - [0, 0, 1]
        forward = -centre / np.linalg.norm(centre)
        right = np.array([1.0, 0.0, 0.0]) - forward[0] * forward
        right /= np.linalg.norm(right)
        cameras.append((centre, np.stack([right, np.cross(forward, right), forward])))

    def seen(point: np.ndarray) -> np.ndarray:
        views = [rotation @ (point - centre) for centre, rotation in cameras]
        return np.array([[C_PX * v[0] / v[2], C_PX * v[1] / v[2]] for v in views])

    found = []
    for _ in range(trials):
        image = seen(np.zeros(3)) + rng.standard_normal((rays, 2)) * u_px
        found.append(least_squares(lambda p, image=image: ((seen(p) - image) / u_px).ravel(), np.zeros(3)).x)
    return np.cov(np.array(found).T)


@pytest.mark.parametrize(("u_px", "rays", "base_to_height"), [((0.1, 0.1), 2, 0.5), ((0.05, 0.2), 2, 1.0), ((0.1, 0.05), 5, 1.2)])
def test_it_is_the_scatter_of_intersections(u_px, rays: int, base_to_height: float, rng: np.random.Generator) -> None:
    """A standard deviation of 300 points is known to 4.1 %: 1e-6 in nine of them lies at 5.4 of these, 22 %."""
    seen = np.sqrt(np.diag(scattered(u_px, rays, base_to_height, 300, rng)))
    assert seen == pytest.approx(at_the_middle(u_px, rays, base_to_height), rel=0.22)


def test_depth_of_a_narrow_pair_is_the_textbook_s() -> None:
    """Normal case of stereo: u_Z = (Z/B) √2 u on the object."""
    assert at_the_middle((0.1, 0.1), 2, 0.02)[2] == pytest.approx(np.sqrt(2) * 0.1 / C_PX / 0.02, rel=1e-3)


def test_cameras_in_a_row_tell_less_depth_than_on_a_circle() -> None:
    """Σ x² of four places on a line over that of four on a circle about it: 20/9 to 4, in units of half the base."""
    row, circle = (at_the_middle((0.1, 0.1), 4, 0.05, how)[2] for how in ("row", "circle"))
    assert row / circle == pytest.approx(np.sqrt(4 / (20 / 9)), rel=0.01)


# ---- whole networks ----------------------------------------------------------------------------------------------------------------

SHAPE, PITCH = (600, 800), {"pitch_x_um": 5.0, "pitch_y_um": 5.0}
LENS = element("optics.distortion", k1_per_mm2=-1.5e-3, p1_per_mm=3e-5, **PITCH)
BOW = element("sensor.unflatness", bow_x_um=8.0, bow_y_um=4.0, chief_ray_deg=9.0, f_number=8.0, **PITCH)
CAMERA = Camera("test", SHAPE, (LENS, BOW), pitch_um=(5.0, 5.0), facts={"saturation_dn": 200.0, "bits": 8})


def rows_of(setting: Setting, noise_px: float) -> list[SourceRow]:
    """What the camera's maps leave, noise of an image point, and that of the calibration."""
    rows = Table(setting, TargetEstimator()).rows({"optics.distortion", "sensor.unflatness"})
    rows.append(SourceRow("noise", "noise", "", 0, 0, DESCRIBED, "T", Parts(), Parts(time_px=(noise_px, noise_px))))
    return [*rows, calibration_row(rows, setting)]


@pytest.mark.parametrize(
    ("model", "rays", "base", "arrangement", "noise_px"),
    [("lens", 2, 0.5, "circle", 0.05), ("lens", 5, 0.8, "row", 0.02), ("none", 4, 0.8, "circle", 0.02)],
)
def test_it_is_what_a_bundle_adjustment_finds(
    model: str, rays: int, base: float, arrangement: str, noise_px: float, rng: np.random.Generator
) -> None:
    """Networks through the camera's maps, adjusted with the interior parameters held: within 35 % of the scatter, axis by axis.

    Four networks of 30 points: a standard deviation is known to 6.5 %, 5.4 of these are 1e-6 in nine; what is the same in all images, a
    third of the variance, is nearly the same field in all of them.
    """
    scenario = {
        "object": {"distance_mm": 1000.0, "f_mm": 12.0},
        "count": {"rays": rays, "base_to_height": base, "arrangement": arrangement, "points": 30},
        "calibration": {"model": model, "images": 12, "targets": 50, "field": "deep"},
    }
    setting = Setting(CAMERA, read_scenario(scenario))
    rows = rows_of(setting, noise_px)
    measured, half = Measured(setting, (noise_px, noise_px)), 500 * np.array([800, 600]) / setting.c_px
    errors = []
    calibration = None if model == "none" else measured.calibrated(model, calibration_shots(rng, 12, 50, 1000.0, half, False), rng)
    for _ in range(4):
        shots = measuring_shots(rng, rays, base, arrangement, 30, 1000.0, 0.8 * half)
        errors.append(measured.points(shots, calibration, rng.standard_normal((2, rays, 30))))
    found = np.sqrt(np.nanmean(np.square(errors), axis=(0, 1)))
    assert point_of(rows, setting).u_mm == pytest.approx(found, rel=0.35)


def test_a_shift_of_all_targets_in_all_images_is_not_averaged_by_rays() -> None:
    """Latency of the trigger shifts a moving point as far in ten images as in two."""
    moving = {"motion": {"speed_px_per_s": 1e5}, "object": {"distance_mm": 1000.0, "f_mm": 12.0}}
    setting = Setting(CAMERA, read_scenario(moving))
    row = SourceRow("lag", "sensor.trigger_jitter", "", 0, 0, DESCRIBED, "O", Parts(), Parts(constant_px=(0.5, 0.0)))
    for rays in (2, 10):
        s = replace(setting, scenario=read_scenario({**moving, "count": {"rays": rays}}))
        assert point_of([row], s).u_mm[0] == pytest.approx(0.5 / setting.px_per_mm, rel=1e-3)


def test_a_shift_of_the_principal_point_is_taken_up_by_the_orientation() -> None:
    setting = Setting(CAMERA, read_scenario({"object": {"distance_mm": 1000.0, "f_mm": 12.0}}))
    row = SourceRow("shift", "grabber.window_offset", "", 0, 0, DESCRIBED, "G", Parts(), Parts(constant_px=(0.5, 0.0)))
    assert point_of([row], setting).u_mm[0] < 0.05 * 0.5 / setting.px_per_mm
    known = replace(setting, scenario=read_scenario({"object": {"distance_mm": 1000.0, "f_mm": 12.0}, "count": {"points": 0}}))
    assert point_of([row], known).u_mm[0] == pytest.approx(0.5 / setting.px_per_mm, rel=0.1)


def test_one_ray_tells_no_depth() -> None:
    setting = Setting(CAMERA, read_scenario({"object": {"distance_mm": 1000.0, "f_mm": 12.0}, "count": {"rays": 1}}))
    row = SourceRow("noise", "noise", "", 0, 0, DESCRIBED, "T", Parts(), Parts(time_px=(0.1, 0.1)))
    assert point_of([row], setting) is None
