"""The cameras that come with the package: every source on, the same bits whatever the threads, tiles, windows, batches and slices."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from importlib.resources import files

import numpy as np
import pytest

from catalogue.support import Texture
from pixmetry.camera import bands
from pixmetry.camera.camera import Camera, load_camera
from pixmetry.core.random import Grid
from pixmetry.scene.uniform import Uniform

PRESETS = sorted(p.name.removesuffix(".yaml") for p in (files("pixmetry.camera") / "presets").iterdir() if p.name.endswith(".yaml"))
SCENE = Texture(mean_dn=200.0)
SMALL = (96, 128)
LAYOUT = {"grabber.sampling_clock": {"samples": 84}, "grabber.window_offset": {"row_offset": 8, "rows": 64}}


@cache
def small(name: str) -> Camera:
    """The preset with fewer pixels."""
    camera = replace(load_camera(name), frame_shape=SMALL)
    for source, values in LAYOUT.items():
        if source in camera:
            camera = camera.with_parameters(source, **values)
    return camera


@cache
def frames(name: str) -> np.ndarray:
    return small(name).expose(SCENE, 4, seed=5).data


def test_all_presets_of_the_handbooks_cameras_are_there() -> None:
    needed = {"pulnix_tm6cn", "pulnix_tm6cn_epix_512", "pulnix_tm6cn_epix_pixelclock", "imx264_like", "cid_generic", "cmos_log_fuga15"}
    needed |= {"ft_ccd_generic", "dcs420_like", "sony_xc8500_interlaced", "sony_xc8500_field", "sony_xc8500_progressive"}
    assert needed <= set(PRESETS)


@pytest.mark.parametrize("name", ["pulnix_tm6cn", "pulnix_tm6cn_epix_512", "pulnix_tm6cn_epix_pixelclock"])
def test_published_noise_of_single_frames(name: str) -> None:
    """The handbook's figure 3.20: 0.9 grey values in the dark, 1.8 at 250, in 50 × 50 pixels of a frame; about 13 from end to end at 230.

    Whole camera, warm, every source on; the variance between grows as that of shot noise, read to a tenth of a grey value. The range of
    2500 normal numbers of that deviation is 12.1 ± 0.9, and 36 of them are averaged.
    """
    camera = load_camera(name)
    for photons, level in ((0, 0), (60_000, 125), (111_000, 230)):
        frame = camera.expose(Uniform(photons), [6000], seed=3, window=(150, 100, 300, 300)).data[0].astype(float)
        patches = frame.reshape(6, 50, 6, 50).transpose(0, 2, 1, 3).reshape(36, 2500)
        assert frame.mean() == pytest.approx(level, abs=6)
        assert patches.std(axis=1).mean() == pytest.approx(np.sqrt(0.81 + 0.0097 * level), abs=0.11)
    assert 11.0 < np.ptp(patches, axis=1).mean() < 13.5


@pytest.mark.parametrize("name", PRESETS)
def test_numbers_say_where_they_come_from(name: str) -> None:
    text = (files("pixmetry.camera") / "presets" / f"{name}.yaml").read_text(encoding="utf-8")
    assert text.startswith("#") and re.search(r"\[assumed\]|typical of the class|none is of one data sheet", text)
    assert load_camera(name).name == name


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_makes_the_same_bits_however_it_is_cut(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    camera, whole = small(name), frames(name)
    assert whole.dtype == np.uint16 and whole.shape[1:] == camera.output_shape
    assert np.ptp(whole) > 5
    rows, cols = camera.output_shape
    for window in ((0, 0, 7, 9), (rows - 5, cols - 11, 5, 11), (rows // 3, cols // 2, 13, 6)):
        r, c, h, w = window
        assert np.array_equal(camera.expose(SCENE, 4, seed=5, window=window).data, whole[:, r : r + h, c : c + w])
    assert np.array_equal(camera.expose(SCENE, [2, 3], seed=5).data, whole[2:])
    monkeypatch.setattr(bands, "TILE_PIXELS", 16 * SMALL[1])
    for threads in (1, 2):
        assert np.array_equal(camera.expose(SCENE, 4, seed=5, threads=threads).data, whole)
    if not any(link.remembers for link in camera.links):
        grid = Grid(np.array([3, 0, 1]), np.array([0, rows - 8, 11]), np.array([2, cols - 8, 17]), (8, 8))
        batch = camera.expose_windows(SCENE, grid, seed=5)
        for data, f, r, c in zip(batch, grid.frame, grid.row0, grid.col0, strict=True):
            assert np.array_equal(data, whole[f, r : r + 8, c : c + 8])


@pytest.mark.parametrize("name", PRESETS)
def test_switching_one_source_off_changes_no_others_draws(name: str) -> None:
    """What the other sources tell of themselves, and the noise of a frame without the source that was switched, stay the same."""
    camera = small(name)
    told = camera.truth(frame=1, seed=5)
    for element in camera.chain:
        if element.source.essential or element.source.produces is not None or element.source.reshape is not None:
            continue
        without = camera.switched(off=[element.name])
        if without.output_shape != camera.output_shape:
            continue
        for other, arrays in without.truth(frame=1, seed=5).items():
            assert all(np.array_equal(v, told[other][key]) for key, v in arrays.items()), (element.name, other)


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_survives_its_file(name: str, tmp_path: object) -> None:
    camera = small(name)
    camera.save(tmp_path / "camera.yaml")
    again = load_camera(tmp_path / "camera.yaml")
    assert again.to_record() == camera.to_record()
    assert np.array_equal(again.expose(SCENE, 1, seed=5).data, frames(name)[:1])
