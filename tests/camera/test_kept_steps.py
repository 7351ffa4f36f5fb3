"""What is kept between exposures never shows: every picture is that of the camera alone, bit for bit."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from pixmetry.camera.camera import Camera, load_camera
from pixmetry.camera.kept_steps import KeptSteps
from pixmetry.camera.unit_maps import MeasuredUnit
from pixmetry.scene.files import build_scene, read_scene
from pixmetry.scene.uniform import Uniform

SCENE = {
    "schema": "pixmetry/scene/1",
    "uniform": {"level_photons": 300},
    "discs": {"x_px": [150.3], "y_px": [140.6], "diameter_px": 9, "peak_photons": 9000},
}
CHANGES = {
    "pulnix_tm6cn_epix_512": (
        ("sensor.prnu", "pixel_std_rel", 0.02),
        ("grabber.clamp", "offset_dn", 3.0),
        ("optics.point_spread", "sigma_px", 0.6),
        ("cable.termination", "far_rel", 0.1),
    ),
    "imx264_like": (("electronics.amplifier_noise", "white_e", 9.0), ("sensor.prnu", "pixel_std_rel", 0.02)),
    "sony_xc8500_field": (("sensor.prnu", "pixel_std_rel", 0.02), ("electronics.gain", "gain_dn_per_e", 0.01)),
}


def changed(camera: Camera) -> list[Camera]:
    found = [camera]
    for name, parameter, value in CHANGES[camera.name]:
        if name in camera and parameter in type(camera[name].params).model_fields:
            found.append(found[-1].with_parameters(name, **{parameter: value}))
    return [*found, found[-1].switched(off=["sensor.prnu"]), camera]


@pytest.mark.parametrize("name", CHANGES)
def test_each_picture_is_that_of_the_camera_alone(name: str) -> None:
    kept, camera = KeptSteps(), load_camera(name)
    scene = build_scene(read_scene(SCENE), camera.frame_shape, "scene")
    window = (90, 100, 48, 40)
    for seed in (0, 3):
        for one in changed(camera):
            seen = kept.window(one, scene, "one", window, seed)
            alone = one.expose(scene, seed=seed, window=window)
            assert np.array_equal(seen.data, alone.data) and seen.kind is alone.kind
    other = build_scene(read_scene(SCENE | {"uniform": {"level_photons": 900}}), camera.frame_shape, "scene")
    assert np.array_equal(kept.window(camera, other, "two", window).data, camera.expose(other, window=window).data)
    moved = (60, 70, 64, 64)
    assert np.array_equal(kept.window(camera, other, "two", moved).data, camera.expose(other, window=moved).data)


def test_what_is_kept_is_bounded_and_cannot_be_changed() -> None:
    kept, camera = KeptSteps(most_bytes=1 << 20), load_camera("imx264_like")
    scene = build_scene(read_scene(SCENE), camera.frame_shape, "scene")
    for seed in range(6):
        kept.window(camera, scene, "one", (0, 0, 200, 200), seed)
        assert kept.held_bytes <= 1 << 20
    with pytest.raises(ValueError, match="read-only"):
        next(iter(kept._signals.values())).signal.data[0, 0, 0] = 1


def test_a_measured_map_lives_as_long_as_what_it_made_is_kept() -> None:
    """Maps are told apart by their address, which Python gives to the next array once a map is gone."""
    plain, window = load_camera("imx264_like"), (0, 0, 32, 32)
    unit = MeasuredUnit(plain.unit_seed, plain.frame_shape)

    def twin(deviation: float) -> tuple[Camera, weakref.ref[np.ndarray]]:
        response = np.full(plain.frame_shape, deviation, np.float16)
        maps = {"response_dev_rel": response}
        chain = tuple(replace(e, maps=maps) if e.name == "sensor.prnu" else e for e in plain.chain)
        return replace(plain, chain=chain, measured=unit), weakref.ref(response)

    kept = KeptSteps()
    camera, seen = twin(0.1)
    first = kept.window(camera, Uniform(2000.0), "even", window).data.mean()
    del camera
    gc.collect()
    assert seen() is not None
    second = kept.window(twin(0.2)[0], Uniform(2000.0), "even", window).data.mean()
    assert second > 1.05 * first
    none = KeptSteps(most_bytes=0)
    camera, seen = twin(0.1)
    none.window(camera, Uniform(2000.0), "even", window)
    del camera
    gc.collect()
    assert seen() is None
