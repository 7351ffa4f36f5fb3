"""Arguments of a wrong type, shape or value: each is refused by the package's own error, which names the argument."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pixmetry import calibrate, read_calibration
from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.certificate import compare_readings, models_of_certificate
from pixmetry.calibrate.job import solve_again
from pixmetry.calibrate.projection import CalibratedCamera, calibrated_cameras, difference
from pixmetry.calibrate.rig_pair import CameraPair, camera_pair
from pixmetry.core.arrays import given_array, given_count
from pixmetry.core.errors import InputError, PixmetryError

CAMERA = CalibratedCamera(CameraModel.of(Sensor(640, 480), c=800.0), ("c",), np.array([[4.0]]))
PAIR = CameraPair(CAMERA.model, CAMERA.model, np.eye(3), np.array([-1.0, 0.0, 0.0]))
SENSOR = Sensor(4288, 2848, 8.45, 8.45)
NOTHING: list[Any] = [
    None,
    "abc",
    5,
    [],
    [[1, 2], [3]],
    object(),
    np.ones((2, 7)),
    [["a", "b", "c"]],
    np.ones((2, 3)) * 1j,
    np.zeros((0, 4)),
]
TAKING: dict[str, Callable[[Any], object]] = {
    "points": CAMERA.project,
    "px": CAMERA.unproject,
    "first_px": lambda value: PAIR.epipolar_distances(value, value),
    "second_px": lambda value: PAIR.epipolar_distances(np.ones((4, 2)), value),
    "values": CAMERA.unpack,
    "first": lambda value: difference(value, CAMERA),
    "second": lambda value: difference(CAMERA, value),
    "numbers": lambda value: models_of_certificate(value, SENSOR),
    "sensor": lambda value: models_of_certificate({"c": 28.0}, value),
    "network": lambda value: compare_readings(value, {"c": 28.0}),
    "calibration": calibrated_cameras,
    "calibration ": camera_pair,
    "the calibration does not hold": solve_again,
}


@pytest.mark.parametrize("name", TAKING)
def test_what_cannot_be_used_is_refused_by_its_name(name: str) -> None:
    for value in NOTHING:
        with pytest.raises(InputError) as caught:
            TAKING[name](value)
        assert str(caught.value).startswith(name.strip())


def test_covariances_of_another_shape_are_refused() -> None:
    for value in [*NOTHING[1:], np.ones((2, 2)), np.ones((3, 3, 3)), np.ones((3, 2, 2))]:
        with pytest.raises(InputError, match="^covariance: "):
            CAMERA.project(np.ones((2, 3)), value)
        with pytest.raises(InputError, match="^covariance_px2: "):
            CAMERA.unproject(np.ones((2, 2)), value)


def test_points_that_hold_nan_have_no_pixel_and_none_are_none() -> None:
    assert np.isnan(CAMERA.project([[np.nan, 0, 1]]).px).all() and np.isnan(CAMERA.unproject([[np.nan, 0]]).direction).any()
    assert CAMERA.project(np.zeros((0, 3))).px.shape == (0, 2) and CAMERA.unproject(np.zeros((0, 2))).direction.shape == (0, 3)
    assert CAMERA.project([[0, 0, 1]]).px.tolist() == CAMERA.project(np.array([[0.0, 0.0, 1.0]])).px.tolist()
    with pytest.raises(InputError, match="values: holds values that are not finite"):
        CAMERA.unpack([np.nan])


@pytest.mark.parametrize("places", [0, 1, -3, 2.5, "a", None, True, 10**6, float("nan")])
def test_number_of_places_of_a_difference(places: Any) -> None:
    with pytest.raises(InputError, match="^cols: not a whole number within its limits.*2 … 1000"):
        difference(CAMERA, CAMERA, cols=places)


@pytest.mark.parametrize(
    ("numbers", "where"),
    [({"c": np.nan}, "c"), ({"c": 28.0, "A1": "x"}, "A1"), ({"c": 28.0, "R0": 1e300}, "R0"), ({"c": 28.0, "B1": None}, "B1")],
)
def test_numbers_of_a_certificate(numbers: dict[str, Any], where: str) -> None:
    with pytest.raises(InputError, match=f"^certificate, {where}: not a finite number"):
        models_of_certificate(numbers, SENSOR)


@pytest.mark.parametrize("path", [None, 5, [], np.ones(3), object(), ["a"]])
def test_a_calibration_is_read_from_a_path(path: Any) -> None:
    with pytest.raises(InputError, match="^path: not the name of a folder or file"):
        read_calibration(path)


@pytest.mark.parametrize("source", [None, 5, object(), np.ones((3, 3)), [[1, 2]], [5], b"a.yaml"])
def test_sources_of_a_calibration(source: Any) -> None:
    with pytest.raises(InputError, match="^source: cannot be used"):
        calibrate(source)


@pytest.mark.parametrize(
    ("given", "where"),
    [
        ({"output": 5}, "output"), ({"options": 5}, "options"), ({"options": [("folds", 1)]}, "options"),
        ({"check_points": 3}, "check_points"),
        ({"progress": 5}, "progress"), ({"free": 5}, "free"), ({"free": [1, 2]}, "free"), ({"free": "c, q"}, "free"),
        ({"per_image": 3}, "per_image"),
        ({"options": {"folds": "a"}}, "folds"), ({"options": {"folds": np.nan}}, "folds"), ({"options": {"loss": 3}}, "loss"),
        ({"options": {"false_alarms": "x"}}, "false_alarms"), ({"options": {"loss_scale": np.nan}}, "loss_scale"),
        ({"options": {"max_iterations": 0}}, "max_iterations"), ({"options": {"snoop": "no"}}, "snoop"),
        ({"options": {"per_image": "x_scale"}}, "per_image"),
    ],
)  # fmt: skip
def test_arguments_of_a_calibration_are_checked_before_its_files_are_read(given: dict[str, Any], where: str) -> None:
    with pytest.raises(PixmetryError) as caught:
        calibrate("there-is-no-such-file.yaml", **given)
    assert caught.value.where == where


def test_limits_of_given_numbers() -> None:
    assert given_count(np.int64(3), "n", 2, 3) == 3 and given_array([True, False], "a", ("n",)).tolist() == [1.0, 0.0]
    with pytest.raises(InputError, match=r"^a: an array of another shape; found \(2,\); allowed: shape \(n, 2, 2\)"):
        given_array([1, 2], "a", ("n", 2, 2))
