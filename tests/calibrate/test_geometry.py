"""A calibrated camera in the parameters of the error sources: they draw the image as the calibration sees it, and are as uncertain."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pixmetry.budget.job import compute_budget
from pixmetry.calibrate import calibrated_camera as geometry_module
from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.calibrated_camera import calibrated_camera, geometry_of
from pixmetry.calibrate.checks.residual_grid import systematic_rest
from pixmetry.camera.camera import load_camera
from pixmetry.camera.observations import AFFINITY, LENS, TAKEN_UP, Observations
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.locate.centroids.fixed import FixedCentroid
from pixmetry.sources.optics import distortion
from pixmetry.sources.sensor import affinity

SENSOR = Sensor(752, 582, 8.6, 8.3)
SHAPE = (582, 752)
NAMES = ("c", "xp", "yp", "b1", "b2", "p1", "p2", "k1", "k2", "k3")
PHOTOGRAMMETRIC = CameraModel.of(
    SENSOR, c=8.0, xp=371.2, yp=297.5, b1=2e-3, b2=-1e-3, p1=3e-5, p2=-4e-5, k1=1e-3, k2=-2e-5, k3=1e-7
)  # 4 % of distortion in the corners
VISION = CameraModel.of(SENSOR, "object_to_image", c=8.0, xp=371.2, yp=297.5, b1=2e-3, b2=-1e-3, p1=2e-4, p2=-3e-4, k1=-0.05, k2=0.03)
FIVE_TERMS = PHOTOGRAMMETRIC.with_values(k4=3e-9, k5=-1e-10)
MODELS = pytest.mark.parametrize("model", [PHOTOGRAMMETRIC, VISION, FIVE_TERMS], ids=["photogrammetric", "vision", "five terms"])


def through_the_sources(seen: Observations, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ideal places as the two sources' own maps have them: first the sheared image, then the lens."""
    sheared = affinity.SOURCE.make({e.name: e.value for e in affinity.measure(seen)})
    lens = distortion.SOURCE.make({e.name: e.value for e in distortion.measure(seen)})
    return distortion.pull_of(lens, SHAPE)(*affinity.pull_of(sheared, SHAPE)(x, y))


@MODELS
def test_the_sources_look_where_the_calibrated_camera_looks(model: CameraModel) -> None:
    geometry = geometry_of(model, NAMES, np.zeros((10, 10)))
    seen = Observations(geometry=geometry)
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(0, 751, 12), np.linspace(0, 581, 12)))
    ideal_x, ideal_y = through_the_sources(seen, x, y)
    c, cx, cy = (geometry.lens[n].value for n in ("principal_distance_mm", "centre_x_px", "centre_y_px"))
    u, v = model.direction_of(x, y)
    np.testing.assert_allclose(ideal_x, 375.5 + cx + c / 8.6e-3 * u, atol=0.02)
    np.testing.assert_allclose(ideal_y, 290.5 + cy + c / 8.3e-3 * v, atol=0.02)


@MODELS
def test_the_covariance_goes_along(model: CameraModel, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """The spread of a thousand cameras, each turned into sources apart, against the propagated covariance: 20 % at 6 standard errors."""
    monkeypatch.setattr(geometry_module, "GRID", 9)  # places where both look: 81, in place of 625
    scale = 1e-3 * np.array([1, 100, 100, 0.1, 0.1, 0.1, 0.1, 0.1, 0.01, 0.001])
    scale[5:] *= 1 if model is VISION else 0.01
    mixing = np.eye(10) + 0.3 * rng.normal(size=(10, 10))
    covariance = scale[:, None] * (mixing @ mixing.T) * scale
    lens = geometry_of(model, NAMES, covariance).lens
    draws = rng.multivariate_normal([model[n] for n in NAMES], covariance, size=1000, method="cholesky")
    few = [geometry_of(model.with_values(**dict(zip(NAMES, row, strict=True))), (), np.zeros((0, 0))).lens.values for row in draws]
    ratio = np.std(few, axis=0, ddof=1)[:10] / lens.u[:10]
    assert np.abs(ratio - 1).max() < 6 / np.sqrt(2 * 999) + 0.05, dict(zip(lens.names, ratio, strict=False))


@pytest.mark.parametrize("preset", ["pulnix_tm6cn", "pulnix_tm6cn_epix_512", "imx264_like", "sony_xc8500_progressive"])
def test_a_preset_takes_the_calibration_over(preset: str, tmp_path: Path) -> None:
    """What it had of lens, affinity and what a calibration takes up with them is replaced; the file keeps all of it."""
    camera = load_camera(preset)
    rows, cols = camera.frame_shape
    sensor = Sensor(cols, rows, *camera.pitch_um)
    geometry = geometry_of(CameraModel.of(sensor, c=12.0, b1=1e-4, k1=-3e-4, p1=1e-5), (), np.zeros((0, 0)), origin="calibration of today")
    calibrated_camera(camera, geometry).save(tmp_path / "camera.yaml")
    again = load_camera(tmp_path / "camera.yaml")
    assert again[LENS].params.k1_per_mm2 == pytest.approx(-3e-4, rel=1e-3)
    assert again[AFFINITY].params.b1 == pytest.approx(-1e-4, rel=0.02)  # to first order
    assert not {e.source.id for e in again.active} & set(TAKEN_UP[2:])
    assert "calibration of today" in again.facts["calibration"] and again.facts["principal_distance_mm"] == pytest.approx(12, rel=1e-3)
    others = [e.name for e in camera.chain if e.source.id not in TAKEN_UP]
    assert [e.name for e in again.chain if e.source.id not in TAKEN_UP] == others
    assert calibrated_camera(again, geometry).to_record() == again.to_record()  # once more changes nothing
    corner = again.true_positions([5.0], [5.0])
    assert np.abs(np.subtract(corner, camera.true_positions([5.0], [5.0]))).max() > 0.5


def test_a_calibration_of_another_sensor_is_refused() -> None:
    model = CameraModel.of(Sensor(640, 480, 3.45, 3.45), c=12.0)
    with pytest.raises(InputError, match="another pixel pitch"):
        calibrated_camera(load_camera("pulnix_tm6cn"), geometry_of(model, (), np.zeros((0, 0))))


def test_a_strong_lens_of_a_vision_program_needs_five_terms() -> None:
    """The inverse of its polynomial is none; three terms follow it to a pixel or worse, five to 0.05 px."""
    geometry = geometry_of(CameraModel.of(SENSOR, "object_to_image", c=7.0, k1=-0.3), (), np.zeros((0, 0)))
    assert geometry.lens["k5_per_mm10"].value != 0
    assert geometry_of(VISION, (), np.zeros((0, 0))).lens["k5_per_mm10"].value == 0


def test_what_the_sources_cannot_hold_is_refused() -> None:
    with pytest.raises(InputError, match="pitch"):
        geometry_of(CameraModel.of(Sensor(752, 582), c=930.0), (), np.zeros((0, 0)))
    with pytest.raises(InputError, match="cannot represent"):
        geometry_of(CameraModel.of(SENSOR, "object_to_image", c=3.2, k1=-0.35, k2=0.12), (), np.zeros((0, 0)))
    with pytest.raises(MeasureError, match="calibrated geometry"):
        distortion.measure(Observations())


def test_a_budget_counts_what_the_calibration_leaves() -> None:
    """In place of tens of pixels of distortion; the sources that it takes up count once."""
    camera = load_camera("pulnix_tm6cn")
    quick = FixedCentroid()  # any estimator does
    bare = compute_budget(camera, estimator=quick, trials=0)
    geometry = geometry_of(
        PHOTOGRAMMETRIC, NAMES, np.zeros((10, 10)), dof=500, u_px=(0.003, 0.004), left_px=(0.02, 0.0), origin="calibration of today"
    )
    seen = Observations(geometry=geometry)
    estimates = {LENS: distortion.measure(seen), AFFINITY: affinity.measure(seen)}
    budget = compute_budget(camera, estimates, estimator=quick, geometry=geometry, trials=0)
    rows = {r.source_id: r for r in budget.rows}
    assert {rows[i].status for i in TAKEN_UP} == {"calibrated"}
    assert [rows[i].contribution is None for i in TAKEN_UP] == [False, True, True, True, True]
    left = rows[LENS].contribution
    assert left.u_x_px == pytest.approx(np.hypot(0.003, 0.02)) and left.u_y_px == 0.004 and left.gum_class == "G"
    alone = {r.source_id: r.total_px for r in bare.rows if r.status in ("measured", "modelled")}
    gone = sum(alone.get(i, 0.0) ** 2 for i in TAKEN_UP)
    assert budget.verdict.total_px**2 == pytest.approx(bare.verdict.total_px**2 - gone + left.total_px**2, rel=0.2)
    assert rows[LENS].share > 0.1


def test_the_systematic_rest_is_found_beside_noise(rng: np.random.Generator) -> None:
    """A pattern of .02 px in x under noise of .05 px; y has noise only. 20 000 residuals in 80 cells: found to 5.5 se of 1.8 %."""
    n, sensor = 20_000, Sensor(800, 640)
    x, y = rng.uniform(0, 799, n), rng.uniform(0, 639, n)
    pattern = 0.02 * np.sqrt(2) * np.sign(np.sin(2 * np.pi * x / 160)) * (x < 400)  # half of the frame, ± by cells of 80 px
    network = SimpleNamespace(cameras=(CameraModel.of(sensor),), camera_of=np.zeros(1, int), image=np.zeros(n, int), x_px=x, y_px=y)
    residual = rng.normal(0, 0.05, (n, 2))
    residual[:, 0] += pattern
    rest = systematic_rest(SimpleNamespace(network=network, used=np.ones(n, bool), residual_px=residual))
    assert rest[0] == pytest.approx(0.02, rel=0.1) and rest[1] < 0.004  # noise alone: (between − within)/250 is below 4e-6 at 6 se
