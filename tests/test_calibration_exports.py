"""Files for other programs: no file of one camera replaces that of another, and what has no meaning is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pixmetry.calibrating import _changed
from pixmetry.calibration.exchange import read_opencv
from pixmetry.calibration.model import CameraModel, Sensor
from pixmetry.calibration_exports import write_exports
from pixmetry.calibration_project.schema import ProjectModel
from pixmetry.core.config import validate
from pixmetry.core.errors import InputError

MODEL = CameraModel.of(Sensor(640, 480), "object_to_image", c=800.0, k1=-0.1, name="left eye")


def test_each_camera_has_a_file_of_its_own(tmp_path: Path) -> None:
    other = replace(MODEL.with_values(c=900.0), name="right")
    write_exports([MODEL, other], tmp_path / "camera.yaml", None)
    read = {path.name: read_opencv(path)["c"] for path in tmp_path.iterdir()}
    assert read == {"camera-left_eye.yaml": pytest.approx(800), "camera-right.yaml": pytest.approx(900)}


def test_names_that_would_be_one_file_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="two cameras"):
        write_exports([MODEL, replace(MODEL, name="left_eye")], tmp_path / "camera.yaml", tmp_path / "cameras.txt")
    assert not list(tmp_path.iterdir())


def test_pictures_have_no_other_coordinates() -> None:
    project = {"schema": "pixmetry/calibration/1", "cameras": {}, "pictures": {"files": "*.png", "grid": "9x6", "pitch": 25}}
    with pytest.raises(InputError, match="image_coordinates have no meaning with pictures"):
        validate(ProjectModel, project | {"cameras": [{}], "image_coordinates": {"y": "up"}})


def test_none_holds_all() -> None:
    from numpy.random import default_rng

    from calibration.networks import simulate

    network = simulate(default_rng(1), images=4, points=10).network
    network = replace(network, cameras=tuple(m.with_values(c=20.0) for m in network.cameras))
    assert not _changed(network, "none", None).cameras[0].free.any()
