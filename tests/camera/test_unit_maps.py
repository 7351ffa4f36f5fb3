"""A camera with maps of one measured unit: they replace what is drawn, for that unit alone, and travel with its file."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from pixmetry.camera.camera import Camera, Element, build_camera, load_camera
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.overrides import changed_camera
from pixmetry.camera.unit_maps import MeasuredUnit
from pixmetry.core.errors import InputError
from pixmetry.scene.uniform import Uniform
from pixmetry.simulate.job import simulate

SHAPE = (48, 64)
PHOTONS = 4000.0


def measured(rng: np.random.Generator) -> Camera:
    """A camera without temporal noise, so that its frames are what its maps say."""
    chain = {
        "optics.shading": ({"gradient_x_per_px": 1e-3}, {"light_rel": rng.uniform(0.9, 1.1, SHAPE).astype(np.float32)}),
        "sensor.prnu": ({"pixel_std_rel": 0.01}, {"response_dev_rel": rng.normal(0, 0.01, SHAPE).astype(np.float16)}),
        "sensor.quantum_efficiency": ({"quantum_efficiency": 1.0}, {}),
        "sensor.defects": ({"hot_fraction": 0.01}, {"pixels": np.array([[5, 7, 1.0, 900.0, 0.0], [30, 2, 0.5, 0.0, 0.0]])}),
        "sensor.dsnu": ({"pixel_std_e": 20.0}, {"offset_e": rng.normal(0, 20, SHAPE).astype(np.float16)}),
        "electronics.gain": ({"gain_dn_per_e": 0.5}, {}),
        "grabber.phase_pattern": ({"amplitude_dn": 3.0, "moving": False}, {"phase_turns": np.array([0.3])}),
        "grabber.adc": ({"bits": 12, "dnl_std_lsb": 0.1}, {"threshold_lsb": rng.uniform(-0.3, 0.3, 4095)}),
    }
    elements = tuple(Element(name, get_source(name), get_source(name).make(v), maps=m) for name, (v, m) in chain.items())
    return Camera("twin", SHAPE, elements, measured=MeasuredUnit(0, SHAPE))


def expected(camera: Camera) -> np.ndarray:
    """The same in plain NumPy."""
    maps = {e.name: e.maps for e in camera.chain}
    light = maps["optics.shading"]["light_rel"].astype(float) * PHOTONS * (1 + maps["sensor.prnu"]["response_dev_rel"].astype(float))
    for row, col, response, excess, _ in maps["sensor.defects"]["pixels"]:
        light[int(row), int(col)] = light[int(row), int(col)] * response + excess
    dn = 0.5 * (light + maps["sensor.dsnu"]["offset_e"].astype(float))
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]]
    dn += 3 * np.sin(2 * np.pi * (0.11 * col + 0.07 * row + 0.3))
    return np.searchsorted(np.arange(1, 4096) - 0.5 + maps["grabber.adc"]["threshold_lsb"], dn, side="right")


def frame(camera: Camera, **kw) -> np.ndarray:
    return camera.expose(Uniform(PHOTONS), **kw).data


def test_the_measured_unit_makes_what_its_maps_say(rng: np.random.Generator):
    camera = measured(rng)
    shown = frame(camera)[0].astype(int)
    off = shown - expected(camera)
    assert np.abs(off).max() <= 1 and np.mean(off != 0) < 5e-3  # float32 on the edge between two codes


def test_a_window_equals_the_crop_bit_for_bit(rng: np.random.Generator):
    camera = measured(rng)
    whole = frame(camera, frames=3)
    assert np.array_equal(frame(camera, frames=3, window=(3, 5, 20, 40)), whole[:, 3:23, 5:45])


def test_another_unit_is_another_camera_of_the_type_and_may_have_another_size(rng: np.random.Generator):
    camera = measured(rng)
    one, two = (frame(changed_camera(camera, {"unit_seed": k})) for k in (1, 2))
    assert not np.array_equal(one, two) and not np.array_equal(one, frame(camera))
    drawn = Camera("drawn", SHAPE, tuple(Element(e.name, e.source, e.params) for e in camera.chain), unit_seed=1)
    assert np.array_equal(one, frame(drawn))
    assert frame(changed_camera(camera, {"unit_seed": 1, "rows": 60})).shape == (1, 60, 64)


def test_the_measured_unit_has_the_size_of_its_maps(rng: np.random.Generator):
    with pytest.raises(InputError, match="48 × 64.*unit_seed"):
        frame(changed_camera(measured(rng), {"rows": 60}))


def test_a_map_goes_with_the_parameters_that_it_stands_for(rng: np.random.Generator):
    camera = measured(rng)
    other = changed_camera(camera, {"sensor.prnu.pixel_std_rel": 0.0, "grabber.adc.offset_dn": 10.0})
    assert not other["sensor.prnu"].maps and other["grabber.adc"].maps and other["sensor.dsnu"].maps


def test_the_folder_may_be_moved_and_each_file_is_checked(tmp_path, rng: np.random.Generator):
    camera = measured(rng)
    (tmp_path / "made").mkdir()
    camera.save(tmp_path / "made" / "camera.yaml")
    shutil.move(tmp_path / "made", tmp_path / "moved")
    file = tmp_path / "moved" / "camera.yaml"
    again = load_camera(file)
    assert np.array_equal(frame(again), frame(camera))
    assert again.to_record() == camera.to_record()
    renamed = file.with_name("mine.yaml")
    shutil.copy(file, renamed)
    assert np.array_equal(frame(load_camera(renamed)), frame(camera))
    text = file.read_text()
    assert "file: camera.maps.npz" in text
    renamed.write_text(text.replace("file: camera.maps.npz", "file: ../camera.maps.npz"))
    with pytest.raises(InputError, match="measured.file"):
        load_camera(renamed)
    file.write_text(text.replace("phase_turns: sha256:", "phase_turns: sha256:0"))
    with pytest.raises(InputError, match="phase_turns"):
        load_camera(file)
    file.write_text(text)
    archive = file.with_name("camera.maps.npz")
    whole = archive.read_bytes()
    archive.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cannot be read"):
        load_camera(file)
    archive.unlink()
    with pytest.raises(InputError, match=r"camera\.maps\.npz.*missing"):
        load_camera(file)


def test_a_map_that_a_source_does_not_know_is_refused(rng: np.random.Generator):
    record = measured(rng).to_record()
    record["chain"][1]["maps"] |= {"nonsense": "sha256:0"}
    with pytest.raises(InputError, match="maps of this camera"):
        build_camera(record)
    element = measured(rng)["sensor.prnu"]
    with pytest.raises(InputError, match="nonsense.*response_dev_rel"):
        Camera("c", SHAPE, (Element("sensor.prnu", element.source, element.params, maps={"nonsense": np.zeros(SHAPE)}),))


def test_a_simulation_writes_the_maps_and_its_camera_makes_the_same_frames(tmp_path, rng: np.random.Generator):
    measured(rng).save(tmp_path / "camera.yaml")
    scene = {"schema": "pixmetry/scene/1", "uniform": {"level_photons": PHOTONS}}
    first = simulate(tmp_path / "camera.yaml", scene, tmp_path / "one", window=(4, 4, 30, 30), truth=True)
    second = simulate(first / "camera.yaml", scene, tmp_path / "two")
    import tifffile

    one, two = (tifffile.imread(next(folder.glob("*.tif"))) for folder in (first, second))
    assert np.array_equal(one, two[4:34, 4:34])
    with pytest.raises(InputError, match="another frame size"):
        simulate(tmp_path / "camera.yaml", scene, tmp_path / "three", overrides={"cols": 32})
    assert not (tmp_path / "three").exists()
