"""Files for other programs: no file of one camera replaces that of another, and what has no meaning is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.exchange import read_opencv
from pixmetry.calibrate.files.write import check_exports, write_exports
from pixmetry.calibrate.job import _changed
from pixmetry.calibrate.project.schema import ProjectModel
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


@pytest.mark.parametrize("name", ["camera.yaml", "camera.yml", "camera.xml", "camera.json", "cameras.txt"])
def test_only_earlier_exports_are_replaced(name: str, tmp_path: Path) -> None:
    """What OpenCV or COLMAP wrote themselves is somebody else's, and so is the other file of an export of two."""
    path, other = tmp_path / name, tmp_path / "other"
    opencv, colmap = (other.with_suffix(".xml"), path) if name.endswith(".txt") else (path, other)
    for c in (800.0, 900.0):
        write_exports([MODEL.with_values(c=c)], opencv, colmap)
        assert read_opencv(opencv)["c"] == pytest.approx(c)
    raw = path.read_bytes()
    theirs = raw.replace(raw[raw.index(b"ritten") - 1 :].split(b"\n")[0], b"") if name.endswith(".txt") else _of_opencv(path)
    path.write_bytes(theirs)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    for attempt in (check_exports, lambda o, c, _: write_exports([MODEL], o, c)):
        with pytest.raises(InputError, match=f"{name}: file exists and is no result of this kind"):
            attempt(opencv, colmap, tmp_path / "results")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def _of_opencv(path: Path) -> bytes:
    """The same camera as OpenCV itself writes it."""
    storage = cv2.FileStorage(path.suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("camera_matrix", np.diag([800.0, 800.0, 1.0]))
    return storage.releaseAndGetString().encode()


def test_pictures_have_no_other_coordinates() -> None:
    project = {"schema": "pixmetry/calibration/1", "cameras": {}, "pictures": {"files": "*.png", "grid": "9x6", "pitch": 25}}
    with pytest.raises(InputError, match="image_coordinates have no meaning with pictures"):
        validate(ProjectModel, project | {"cameras": [{}], "image_coordinates": {"y": "up"}})


def test_none_holds_all() -> None:
    from numpy.random import default_rng

    from calibrate.networks import simulate

    network = simulate(default_rng(1), images=4, points=10).network
    network = replace(network, cameras=tuple(m.with_values(c=20.0) for m in network.cameras))
    assert not _changed(network, "none", None).cameras[0].free.any()
