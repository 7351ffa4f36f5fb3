"""Correcting frames from Python: arrays in and out are what files give, and odd input is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tifffile import imread

import pixmetry
from pixmetry.core.errors import InputError


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("correct") / "result"
    pixmetry.assess(output=folder, trials=0)
    return folder


@pytest.fixture(scope="module")
def files() -> list[Path]:
    return [path for path in pixmetry.load_campaign().files if path.suffix == ".png"][:3]


def test_arrays_give_what_files_give(result: Path, files: list[Path], tmp_path: Path) -> None:
    frames = np.stack([pixmetry.read_frame(path) for path in files])
    of_arrays = pixmetry.correct(frames, result)
    of_files = pixmetry.correct(files, result, tmp_path / "out")
    assert of_arrays.frames.shape == frames.shape and of_arrays.frames.dtype == np.float32
    for path, corrected in zip(files, of_arrays.frames, strict=True):
        assert np.array_equal(imread(of_files.output / f"{path.stem}.tif"), corrected)
    assert of_arrays.sources == of_files.sources and of_files.frames is None
    assert "corrected" in of_arrays.sources.values() and "Correction of" in repr(of_arrays)
    one = pixmetry.correct(frames[1].astype(np.int64), result)
    assert np.array_equal(one.frames[0], of_arrays.frames[1])


def test_what_is_no_frame_is_told(result: Path, files: list[Path], tmp_path: Path) -> None:
    frame = pixmetry.read_frame(files[0])
    for bad, words in (
        (frame.astype(float), "no frames of stored codes"),
        (frame[0], "no frames of stored codes"),
        (frame[:-1], "pixels"),
        (np.full(frame.shape, 70000), "cannot store"),
    ):
        with pytest.raises(InputError, match=words):
            pixmetry.correct(bad, result)
    with pytest.raises(InputError, match="goes with files"):
        pixmetry.correct(frame, result, tmp_path / "out")
    with pytest.raises(InputError, match="folder for the corrected frames is missing"):
        pixmetry.correct(files, result)


def test_the_camera_file_of_a_unit_brings_its_maps(result: Path) -> None:
    """The maps of the digital twin are those of the results, with the spread that noise adds to these taken out."""
    paths = [path for path in pixmetry.load_campaign().files if path.suffix == ".png"]
    frame = max((pixmetry.read_frame(path)[None] for path in paths), key=lambda data: data.mean() * (data.max() < 250))
    measured, described = pixmetry.correct(frame, result), pixmetry.correct(frame, result / "camera.yaml")
    for name in ("sensor.dsnu", "sensor.prnu"):
        assert measured.sources[name] == described.sources[name] == "corrected"
    taken = [(c.frames - frame).ravel() for c in (measured, described)]
    assert np.corrcoef(*taken)[0, 1] > 0.3  # of 3600 pixels: 0.017 by chance
    assert np.std(taken[1]) < np.std(taken[0])
