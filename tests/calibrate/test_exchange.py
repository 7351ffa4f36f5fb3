"""Models of OpenCV and COLMAP: the same pixels as these programs see, and a clear refusal where something would be lost."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.exchange import (
    COLMAP,
    colmap_line,
    converted,
    model_of_colmap,
    model_of_opencv,
    opencv_form,
    read_opencv,
    write_opencv,
)
from pixmetry.core.errors import InputError

SENSOR = Sensor(752, 582, 8.6, 8.3)
LENS = dict(k1=-0.2, k2=0.15, k3=-0.03, p1=1e-3, p2=-5e-4)


def vision(**more: float) -> CameraModel:
    return CameraModel.of(SENSOR, "object_to_image", **(dict(c=8.0, xp=370.2, yp=285.7, b1=1e-3) | LENS | more))


def photogrammetric(**more: float) -> CameraModel:
    values = dict(c=8.0, xp=370.2, yp=285.7, b1=1e-3, b2=0.0, k1=3e-3, k2=-4e-5, p1=2e-5, p2=-3e-5) | more
    return CameraModel.of(SENSOR, "image_to_object", **values)


def looks(rng: np.random.Generator) -> np.ndarray:
    return np.column_stack([rng.uniform(-0.38, 0.38, 200), rng.uniform(-0.29, 0.29, 200), np.ones(200)])


def opencv_pixels(form: dict, points: np.ndarray) -> np.ndarray:
    zero = np.zeros(3)
    return cv2.projectPoints(points, zero, zero, form["camera_matrix"], form["distortion_coefficients"])[0][:, 0]


def test_opencv_sees_the_same_pixels(rng: np.random.Generator, tmp_path: Path) -> None:
    points = looks(rng)
    for model in (vision(), vision(k3=0.0, p1=0.0, b1=-0.03)):
        ours = np.column_stack(model.project(points[:, 0], points[:, 1]))
        np.testing.assert_allclose(ours, opencv_pixels(opencv_form(model), points), atol=1e-9)
        back = read_opencv(write_opencv(model, tmp_path / "camera.yaml"), (8.6, 8.3))
        np.testing.assert_allclose(back.values, model.values, rtol=1e-12, atol=1e-15)
        assert back.sensor == SENSOR and back.direction == "object_to_image"


def test_a_loss_is_refused_with_its_size_and_allowed_on_request(rng: np.random.Generator) -> None:
    with pytest.raises(InputError, match=r"no place for b2: up to 0\.\d+ px"):
        opencv_form(vision(b2=1e-3))
    with pytest.raises(InputError, match="no place for k4"):
        opencv_form(vision(k4=0.05))
    model = photogrammetric()
    with pytest.raises(InputError, match="corrects from image to object"):
        opencv_form(model)
    points = looks(rng)
    form = opencv_form(model, tolerance_px=0.05)
    apart = np.column_stack(model.project(points[:, 0], points[:, 1])) - opencv_pixels(form, points)
    assert 1e-6 < np.abs(apart).max() < 0.05


def test_the_directions_convert_into_each_other() -> None:
    model = photogrammetric(b2=1e-3)
    there = converted(model, "object_to_image")
    again = converted(there.model, "image_to_object")
    assert 0 < there.largest_px < 0.03 and again.largest_px < 0.03  # 5 % of distortion in the corners
    x, y = np.meshgrid(np.linspace(0, 751, 9), np.linspace(0, 581, 9))
    for other in (there.model, again.model):
        apart = np.hypot(*np.subtract(other.project(*model.direction_of(x, y)), (x.ravel(), y.ravel())))
        assert apart.max() < 0.06
    assert converted(model, "image_to_object").largest_px == 0


@pytest.mark.parametrize("kind", sorted(set(COLMAP) - {"OPENCV_FISHEYE"}))
def test_colmap_sees_the_same_pixels_half_a_pixel_further(kind: str, rng: np.random.Generator) -> None:
    points = looks(rng)
    kept = {n: v for n, v in (LENS | {"b1": 2e-3}).items() if n in COLMAP[kind]}
    sensor = SENSOR if "b1" in COLMAP[kind] else Sensor(752, 582)
    model = CameraModel.of(sensor, "object_to_image", **({"c": 8.0 if sensor is SENSOR else 950.0, "xp": 370.2, "yp": 285.7} | kept))
    line = colmap_line(model, 3, kind)
    back = model_of_colmap(line, (8.6, 8.3) if sensor is SENSOR else None)
    np.testing.assert_allclose(back.values, model.values, rtol=1e-12, atol=1e-14)
    _, name, cols, rows, *numbers = line.split()
    assert (int(cols), int(rows)) == (752, 582)
    ours = np.column_stack(model.project(points[:, 0], points[:, 1]))
    if kind.endswith("OPENCV"):  # OpenCV's projection with COLMAP's numbers, half a pixel further
        fx, fy, cx, cy, *lens = (float(v) for v in numbers)
        form = {"camera_matrix": np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), "distortion_coefficients": np.array(lens)}
        np.testing.assert_allclose(ours + 0.5, opencv_pixels(form, points), atol=1e-9)
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera(model=name, width=int(cols), height=int(rows), params=[float(v) for v in numbers])
    np.testing.assert_allclose(ours + 0.5, theirs.img_from_cam(points), atol=1e-9)


def test_what_cannot_be_read_is_refused(tmp_path: Path) -> None:
    refusals = {
        "1 FOV 752 582 900 900 376 291 0.5": "cannot represent",
        "1 THIN_PRISM_FISHEYE 752 582 900 900 376 291 0 0 0 0 0 0 0 0": "cannot represent",
        "1 RADIAL 752 582 900 376 291 0": "5 parameters",
        "1 RADIAL": "not a line",
    }
    for line, match in refusals.items():
        with pytest.raises(InputError, match=match):
            model_of_colmap(line)
    with pytest.raises(InputError, match="has one focal length"):
        colmap_line(vision(k1=0, k2=0, k3=0, p1=0, p2=0, b1=0), kind="SIMPLE_PINHOLE")
    with pytest.raises(InputError, match="not a camera matrix"):
        model_of_opencv(np.zeros((3, 3)), np.zeros(5), (752, 582))
    (tmp_path / "a.yaml").write_text("no: storage\n")
    with pytest.raises(InputError):
        read_opencv(tmp_path / "a.yaml")
    with pytest.raises(InputError, match="OpenCV's storage"):
        write_opencv(vision(), tmp_path / "camera.txt")
