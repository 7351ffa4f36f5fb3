"""Correcting frames from Python: arrays in and out are what files give, and odd input is told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tifffile import imread

import pixmetry
from pixmetry.assess.correct import _bits_of, _response_of
from pixmetry.camera.camera import load_camera
from pixmetry.camera.overrides import with_source
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


def test_flat_frames_of_a_mosaic_tell_the_response_of_each_colour_by_itself() -> None:
    """Filters are no unevenness: what the flat field of a mosaic corrects leaves the colours apart, and evens the pixels of each."""
    row, col = np.indices((64, 64))
    colour = np.array([[0.4, 1.0], [1.0, 0.6]])[row % 2, col % 2]
    light = 1 - 0.2 * ((row - 31.5) ** 2 + (col - 31.5) ** 2) / 64**2
    uneven = 1 + 0.01 * ((7 * row * row + 13 * col * col + 5 * row * col) % 11 - 5.0)
    found = _response_of(2500 * colour * light * uneven, True)
    for i, j in np.ndindex(2, 2):
        part, aim = found[i::2, j::2], uneven[i::2, j::2]
        assert part.mean() == pytest.approx(1.0, abs=1e-6)
        assert np.corrcoef(part.ravel(), aim.ravel())[0, 1] > 0.99
    camera = replace(with_source(load_camera("imx264_like"), "sensor.bayer_mosaic"), frame_shape=(64, 64))
    black = float(np.median(pixmetry.correct(np.zeros((64, 64), np.uint16), camera).frames))
    flat, frame = (np.rint(level * colour * uneven - black).astype(np.uint16) for level in (2500, 1000))
    corrected = pixmetry.correct(frame, camera, flat=flat).frames[0]
    assert [corrected[i::2, j::2].mean() for i, j in np.ndindex(2, 2)] == pytest.approx([400, 1000, 1000, 600], rel=0.01)
    assert corrected[::2, ::2].std() < 0.2 * frame[::2, ::2].std()


def test_dark_and_flat_arrays_are_checked() -> None:
    camera = load_camera("ft_ccd_generic")
    shape = camera.output_shape
    frame, top = np.full(shape, 100, np.uint16), 2 ** _bits_of(camera) - 1
    hole = np.full(shape, 50.0)
    hole[3, 4] = np.nan
    clipped = np.full(shape, top // 2, np.uint16)
    clipped[: shape[0] // 4] = top
    for maps, words in (
        ({"dark": hole}, "cannot store"),
        ({"flat": np.full(shape, top + 1.0)}, "cannot store"),
        ({"flat": clipped}, "clipped"),
    ):
        with pytest.raises(InputError, match=words):
            pixmetry.correct(frame.astype(np.uint8 if top < 256 else np.uint16), camera, **maps)
    clipped[shape[0] // 400 :] = top // 2  # single hot pixels are no reason
    clipped[0, :5] = top
    pixmetry.correct(frame.astype(np.uint8 if top < 256 else np.uint16), camera, flat=clipped)
