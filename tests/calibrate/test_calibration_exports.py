"""Files for other programs: no file of one camera replaces that of another, and what has no meaning is said."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.exchange import model_of_colmap, read_opencv
from pixmetry.calibrate.files.exports import FORMATS, check_exports, write_exports
from pixmetry.calibrate.files.imports import read_cameras
from pixmetry.calibrate.job import _changed
from pixmetry.calibrate.project.schema import ProjectModel
from pixmetry.core.config import validate
from pixmetry.core.errors import InputError

MODEL = CameraModel.of(Sensor(640, 480), "object_to_image", c=800.0, k1=-0.1, name="left eye")


def test_each_camera_has_a_file_of_its_own(tmp_path: Path) -> None:
    other = replace(MODEL.with_values(c=900.0), name="right")
    write_exports([MODEL, other], {"opencv": tmp_path / "camera.yaml"})
    read = {path.name: read_opencv(path)["c"] for path in tmp_path.iterdir()}
    assert read == {"camera-left_eye.yaml": pytest.approx(800), "camera-right.yaml": pytest.approx(900)}


def test_names_that_would_be_one_file_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="two cameras"):
        write_exports([MODEL, replace(MODEL, name="left_eye")], {"opencv": tmp_path / "camera.yaml", "colmap": tmp_path / "cameras.txt"})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["camera.yaml", "camera.yml", "camera.xml", "camera.json", "cameras.txt"])
def test_only_earlier_exports_are_replaced(name: str, tmp_path: Path) -> None:
    """What OpenCV or COLMAP wrote themselves is somebody else's, and so is the other file of an export of two."""
    path, other = tmp_path / name, tmp_path / "other"
    opencv, colmap = (other.with_suffix(".xml"), path) if name.endswith(".txt") else (path, other)
    for c in (800.0, 900.0):
        write_exports([MODEL.with_values(c=c)], {"opencv": opencv, "colmap": colmap})
        assert read_opencv(opencv)["c"] == pytest.approx(c)
    raw = path.read_bytes()
    theirs = raw.replace(raw[raw.index(b"ritten") - 1 :].split(b"\n")[0], b"") if name.endswith(".txt") else _of_opencv(path)
    path.write_bytes(theirs)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    for attempt in (check_exports, lambda wanted, _: write_exports([MODEL], wanted)):
        with pytest.raises(InputError, match=f"{name}: file exists and is no result of this kind"):
            attempt({"opencv": opencv, "colmap": colmap}, tmp_path / "results")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def _of_opencv(path: Path) -> bytes:
    """The same camera as OpenCV itself writes it."""
    storage = cv2.FileStorage(path.suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("camera_matrix", np.diag([800.0, 800.0, 1.0]))
    return storage.releaseAndGetString().encode()


LENS = {"c": 700.0, "xp": 330.0, "yp": 236.0, "b1": 2e-3, "k1": -0.12, "k2": 0.03, "p1": 1e-3, "p2": -8e-4}
FILES = {"ros": "a.yaml", "kalibr": "b.yaml", "mrcal": "c.cameramodel", "metashape": "d.xml", "matlab": "e.m"}
FILES |= {"opencv": "f.yml", "colmap": "g.txt"}
FORMS = {
    "brown": (LENS, "perspective"),
    "rational": (LENS | {"k3": 0.01, "d1": 0.2, "d2": 0.05}, "perspective"),
    "fisheye": ({**LENS, "c": 300.0, "p1": 0.0, "p2": 0.0}, "equidistant"),
}
HOLD = {
    "brown": set(FILES),
    "rational": {"ros", "mrcal", "opencv", "colmap"},
    "fisheye": {"ros", "kalibr", "metashape", "opencv", "colmap"},
}


@pytest.mark.parametrize("form", FORMS)
def test_each_format_holds_what_it_can_and_gives_it_back(form: str, tmp_path: Path) -> None:
    """Files that can hold the lens are written and read back to rounding; the others are refused, and stop nothing."""
    lens, projection = FORMS[form]
    model = CameraModel.of(Sensor(640, 480), "object_to_image", name="eye", projection=projection, **lens)
    made = write_exports([model], {name: tmp_path / file for name, file in FILES.items()})
    written = {name for name, file in FILES.items() if (tmp_path / file).exists()}
    assert written == HOLD[form] and len(made.refused) == len(FILES) - len(written)
    assert len(made.sentences) == len(written) and all("nothing is lost" in sentence for sentence in made.sentences)
    assert all("px would be lost" in str(problem) or "no place" in str(problem) for _, problem in made.refused)
    for name in written - {"matlab", "colmap", "opencv"}:
        ((_, back),) = read_cameras(tmp_path / FILES[name]).items()
        assert (back.sensor, back.projection) == (model.sensor, model.projection)
        np.testing.assert_allclose(back.values, model.values, rtol=1e-12, atol=1e-15, err_msg=name)
    np.testing.assert_allclose(read_opencv(tmp_path / FILES["opencv"]).values, model.values, rtol=1e-12, atol=1e-15)
    colmap = model_of_colmap((tmp_path / FILES["colmap"]).read_text().splitlines()[-1])
    np.testing.assert_allclose(colmap.values, model.values, rtol=1e-12, atol=1e-15)
    assert colmap.projection == projection


def test_the_files_of_ros_are_read_by_opencv(tmp_path: Path) -> None:
    """cv2.FileStorage reads the same numbers from the file with OpenCV's head."""
    write_exports([MODEL], {"ros": tmp_path / "ros.yaml"})
    text = (tmp_path / "ros.yaml").read_text()
    storage = cv2.FileStorage("%YAML:1.0\n---\n" + text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    numbers = storage.getNode("camera_matrix").getNode("data")
    assert [numbers.at(k).real() for k in range(numbers.size())] == [800, 0, 319.5, 0, 800, 239.5, 0, 0, 1]
    assert storage.getNode("distortion_model").string() == "plumb_bob" and storage.getNode("image_width").real() == 640


def test_what_a_program_reads_is_where_it_looks(tmp_path: Path) -> None:
    """Published conventions: MATLAB counts pixels from 1, Metashape's cx counts from the middle and b1 is in pixels; mrcal is Python."""
    model = CameraModel.of(Sensor(640, 480), "object_to_image", name="eye", **LENS)
    write_exports([model], {name: tmp_path / file for name, file in FILES.items()})
    assert "[331.0 237.0], [480 640]" in (tmp_path / "e.m").read_text()
    metashape = (tmp_path / "d.xml").read_text()
    assert "<cx>10.5</cx>" in metashape and "<f>700.0</f>" in metashape
    assert float(metashape.partition("<b1>")[2].partition("<")[0]) == pytest.approx(1.4)
    mrcal = eval((tmp_path / "c.cameramodel").read_text())
    assert mrcal["lensmodel"] == "LENSMODEL_OPENCV5" and mrcal["intrinsics"][6:8] == [LENS["p2"], LENS["p1"]]


def test_long_files_of_cameras_are_read(tmp_path: Path) -> None:
    """mrcal stores the observations in the file of a camera; a calibration of pixmetry holds all of its covariances."""
    from pixmetry.core.door import MOST_SETTINGS_BYTES

    model = CameraModel.of(Sensor(640, 480), "object_to_image", name="eye", **LENS)
    write_exports([model], {"mrcal": tmp_path / "c.cameramodel"})
    head = (tmp_path / "c.cameramodel").read_text().rstrip().rstrip("},\n ")
    packed = base64.b85encode(bytes(range(256)) * (MOST_SETTINGS_BYTES // 256)).decode()
    (tmp_path / "long.cameramodel").write_text(f"{head}, 'optimization_inputs': b'{packed}'}}")
    (short,), (long,) = (read_cameras(tmp_path / f"{name}.cameramodel").values() for name in ("c", "long"))
    assert str(long) == str(short)
    (tmp_path / "long.cameramodel").write_text(f"{head}, 'other': {'[0],' * (MOST_SETTINGS_BYTES // 4)}}}")
    with pytest.raises(InputError, match="too long for a camera"):
        read_cameras(tmp_path / "long.cameramodel")
    (tmp_path / "calibration.json").write_text('{"schema": "' + "x" * MOST_SETTINGS_BYTES + '"}')
    assert read_cameras(tmp_path / "calibration.json") is None  # read as one of pixmetry's next


def test_the_chain_of_kalibr_says_how_the_cameras_stand(rng: np.random.Generator, tmp_path: Path) -> None:
    """T_cn_cnm1 takes a point of camera 0 to camera 1, in metres."""
    from calibrate.rigs import simulated_rig
    from pixmetry.calibrate.bundle.bundle import adjust
    from pixmetry.calibrate.checks.rig_check import rig_record
    from pixmetry.core.config import load_yaml

    sim = simulated_rig(rng, direction="object_to_image", instants=5)
    found = adjust(sim.network, sim.truth)
    write_exports([found.camera(0), found.camera(1)], {"kalibr": tmp_path / "chain.yaml"}, rig=rig_record(found))
    T = np.array(load_yaml(tmp_path / "chain.yaml")["cam1"]["T_cn_cnm1"])
    point = np.array([100.0, -50, 900])
    inside = [(point - found.state.position[k]) @ found.state.rotation[k].T / 1000 for k in (0, 1)]
    np.testing.assert_allclose((T @ [*inside[0], 1])[:3], inside[1], atol=1e-9)


def test_a_lens_without_inverse_in_a_corner_is_written_and_says_so(tmp_path: Path) -> None:
    """Strong barrel distortion folds the corners over: what has an inverse is compared, the sentence names the rest."""
    model = CameraModel.of(Sensor(640, 480), "object_to_image", c=300.0, k1=-0.22, k2=0.0, b2=1e-5, name="eye")
    u, _ = model.direction_of(np.array([0.0]), np.array([0.0]))
    assert np.isnan(u).all()
    made = write_exports([model], {"opencv": tmp_path / "f.yml", "ros": tmp_path / "a.yaml"}, may_lose_px=0.1)
    assert not made.refused and all("of the frame the calibrated lens has no inverse" in sentence for sentence in made.sentences)


def test_formats_and_endings_are_checked_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such format"):
        check_exports({"word": tmp_path / "a.doc"}, tmp_path / "r")
    for name in set(FORMATS) - {"colmap"}:
        with pytest.raises(InputError, match="ending|storage"):
            check_exports({name: tmp_path / "a.doc"}, tmp_path / "r")


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


def test_what_ros_loses_is_told(tmp_path: Path) -> None:
    """ROS has no thin prisms: they displace by up to some tenths of a pixel, and the sentence says so."""
    model = CameraModel.of(Sensor(1280, 960), "object_to_image", c=900, k1=-0.1, s1=3e-4, s3=-2e-4)
    made = write_exports([model], {"ros": tmp_path / "ros.yaml", "mrcal": tmp_path / "a.cameramodel"}, 1.0)
    lost = {sentence.partition(" for ")[2].partition(";")[0]: sentence for sentence in made.sentences}
    assert "nothing is lost" in lost["mrcal"] and "px are lost" in lost["ROS"] and not made.refused
    assert write_exports([model], {"ros": tmp_path / "ros.yaml"}).refused


@pytest.mark.parametrize("form", [name for name in FORMATS if name != "matlab"])
def test_the_sentence_states_the_loss_of_the_file(form: str, tmp_path: Path) -> None:
    """A denominator in the other direction, whose conversion has a term that the lens has not: within 15 %, as nodes differ."""
    model = CameraModel.of(Sensor(1280, 960, 5, 5), "image_to_object", c=4.5, k1=-0.01, d1=0.002, d2=1e-4)
    path = tmp_path / f"file{FORMATS[form].endings[0]}"
    (sentence,) = write_exports([model], {form: path}, 50.0).sentences
    told = float(sentence.partition("up to ")[2].partition(" px")[0])
    if form == "opencv":
        back = read_opencv(path)
    elif form == "colmap":
        back = model_of_colmap(path.read_text().splitlines()[-1])
    else:
        (back,) = read_cameras(path).values()
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(0, 1279, 65), np.linspace(0, 959, 65)))
    again = back.project(*model.direction_of(x, y))
    assert np.hypot(again[0] - x, again[1] - y).max() == pytest.approx(told, rel=0.15)


def test_a_narrow_fisheye_in_perspective_says_what_it_loses(tmp_path: Path) -> None:
    """MATLAB has no fisheye: the sentence is of the perspective that was written, as the refusal is."""
    model = CameraModel.of(Sensor(640, 480), "object_to_image", projection="orthographic", c=600)
    (refused,) = write_exports([model], {"matlab": tmp_path / "a.m"}).refused
    (sentence,) = write_exports([model], {"matlab": tmp_path / "a.m"}, 1.0).sentences
    assert "up to 0.19 px would be lost" in str(refused[1]) and "up to 0.19 px are lost" in sentence
