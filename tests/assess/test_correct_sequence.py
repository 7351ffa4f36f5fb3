"""Sequences through a whole camera: what moves the level of frames, or mixes them, is taken off, and the positions come back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

import pixmetry
from pixmetry.assess.correct import Correction
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

SHAPE, FRAMES, BLACK_DN = (96, 128), 20, 100.0
X_PX = 30.3 + 3.0 * np.arange(FRAMES)  # of a target that moves 3 px a frame
Y_PX = np.full(FRAMES, 48.2)
OTHERS: dict[str, dict[str, object]] = {
    "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
    "sensor.prnu": {"pixel_std_rel": 0.005},
    "sensor.dsnu": {"pixel_std_e": 2.0},
    "sensor.shot_noise": {},
    "electronics.amplifier_noise": {"white_e": 8.0},
    "electronics.row_noise": {"row_e": 1.0},
    "electronics.gain": {"gain_dn_per_e": 0.2},
    "grabber.adc": {"bits": 12, "offset_dn": BLACK_DN},
}


PATCH = [v.ravel() for v in np.meshgrid(np.arange(8.0, 120, 6), np.arange(72.0, 92, 6))]  # of discs that overlap
SCENE = Discs(  # a target of two discs that overlap, and a patch that comes and goes
    np.column_stack([X_PX, X_PX + 5.0, np.where((np.arange(FRAMES) % 10 < 5)[:, None], PATCH[0], 1e5)]),
    np.column_stack([Y_PX, Y_PX, np.broadcast_to(PATCH[1], (FRAMES, len(PATCH[1])))]),
    7.0,
    blur_px=0.9,
    peak_photons=np.array([8000.0, 4000.0, *np.full(len(PATCH[0]), 9000.0)]),
    per_frame=True,
    background=Uniform(4000.0),
)


def camera_with(**changed: dict[str, object]) -> Camera:
    chosen = OTHERS | {name.replace("__", "."): values for name, values in changed.items()}
    chain = tuple(Element(s.id, s, s.make(chosen[s.id])) for s in in_order(get_source(name) for name in chosen))
    return Camera("moving", SHAPE, chain, facts={"frame_period_s": 0.0231}, exposure_s=0.002)


def places_of(frames_dn: np.ndarray, threshold_dn: float) -> np.ndarray:
    """Centroids above a threshold in DN, shape (frames, 2), in windows that go with the target."""
    out = []
    for frame, x in zip(frames_dn.astype(float), X_PX, strict=True):
        rows, cols = np.arange(38, 60), np.arange(round(x) - 10, round(x) + 14)
        weight = np.maximum(frame[38:60, cols[0] : cols[-1] + 1] - threshold_dn, 0)
        out.append([(weight.sum(axis=0) * cols).sum(), (weight.sum(axis=1) * rows).sum()] / weight.sum())
    return np.array(out)


def errors_of(found: Correction, clean_dn: np.ndarray, threshold_dn: float) -> np.ndarray:
    """Errors of the positions of all frames but the first, against noise-free frames of the camera without the source, px."""
    assert found.frames is not None
    return (places_of(found.frames, threshold_dn) - places_of(clean_dn, threshold_dn))[1:]


def scatter(errors_px: np.ndarray) -> float:
    return float(errors_px[:, 0].std())


def rms(errors_px: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors_px[:, 0] ** 2)))


AGC = {"electronics__agc": {"kappa": 0.3, "target_dn": 1200.0, "highest_db": 20.0, "lowest_db": -20.0}}
LAMP = {"optics__flicker": {"depth_rel": 0.3, "frequency_hz": 111.0}}
MIXED = {"processing__temporal_noise_reduction": {"alpha": 0.4, "bits": 12}}
LAG = {"sensor__image_lag": {"lag_rel": 0.1}}
BANDS = {"optics__flicker": {"depth_rel": 0.3, "frequency_hz": 111.0}, "sensor__rolling_shutter": {"row_time_s": 1e-4}}


@pytest.mark.parametrize(
    ("changed", "size"),
    [(AGC, scatter), (LAMP, scatter), (AGC | LAMP, scatter), (MIXED, rms), (LAG, rms), (MIXED | LAG, rms), (MIXED | AGC, scatter)],
    ids=["agc", "lamp", "agc and lamp", "mixed", "lag", "mixed and lag", "mixed and agc"],
)
def test_positions_come_back(changed: dict[str, dict[str, object]], size: Callable[[np.ndarray], float], seed: int) -> None:
    """Over a fixed threshold a target that is not round goes with the gain of its frame; one in a mixed frame trails.

    What is left is noise: three times that of the camera without these sources at most, and a quarter of the error. A gain or a lamp is
    known against the mean of all frames, so the scatter of the errors counts there.
    """
    camera, names = camera_with(**changed), [name.replace("__", ".") for name in changed]
    without = camera.switched(off=names)
    clean = without.expose(SCENE, FRAMES, quiet=True).data - BLACK_DN
    frames, plain = (c.expose(SCENE, FRAMES, seed=seed % 10**6).data for c in (camera, without))
    before, after = (pixmetry.correct(frames, camera, sequence=True, skip=skip) for skip in (names, []))
    noise = scatter(errors_of(pixmetry.correct(plain, without), clean, 1500.0))
    left, had = (size(errors_of(found, clean, 1500.0)) for found in (after, before))
    assert had > 0.08
    assert left < 0.25 * had and left < 3 * noise


def test_bands_are_taken_off(seed: int) -> None:
    """Of a lamp whose phase turns by 1.07 cycles over the rows of a frame: its slope moves targets along y, by what is left of them."""
    target = Discs(X_PX[:, None], Y_PX[:, None], 7.0, blur_px=0.9, peak_photons=8000.0, per_frame=True, background=Uniform(4000.0))
    camera = camera_with(**BANDS)
    without = camera.switched(off=["optics.flicker"])
    clean = without.expose(target, FRAMES, quiet=True).data - BLACK_DN
    frames, plain = (c.expose(target, FRAMES, seed=seed % 10**6).data for c in (camera, without))
    before, after = (pixmetry.correct(frames, camera, sequence=True, skip=skip) for skip in (["optics.flicker"], []))
    noise, had, left = (float(errors_of(c, clean, 900.0)[:, 1].std()) for c in (pixmetry.correct(plain, without), before, after))
    assert had > 0.05 and left < 0.25 * had and left < 3 * noise
    assert after.sources["optics.flicker"].startswith("corrected by what stays")


def test_files_are_corrected_as_arrays_are(tmp_path: Path) -> None:
    camera = camera_with(**AGC, **LAG)
    frames = camera.expose(SCENE, FRAMES, seed=5).data
    camera.save(tmp_path / "camera.yaml")
    (tmp_path / "frames").mkdir()
    for k, frame in enumerate(frames):
        tifffile.imwrite(tmp_path / "frames" / f"f{k:02d}.tif", frame)
    found = pixmetry.correct(frames, camera, sequence=True)
    written = pixmetry.correct(tmp_path / "frames", tmp_path / "camera.yaml", tmp_path / "out", sequence=True)
    assert found.frames is not None and "factors from" in written.sources["electronics.agc"]
    for k in (0, 1, FRAMES - 1):
        np.testing.assert_array_equal(tifffile.imread(tmp_path / "out" / f"f{k:02d}.tif"), found.frames[k])


def test_the_reason_says_what_is_missing(rng: np.random.Generator) -> None:
    camera = camera_with(**AGC)
    frames = camera.expose(SCENE, FRAMES, seed=1).data
    assert "--sequence" in pixmetry.correct(frames, camera).sources["electronics.agc"]
    assert "give 7 frames more" in pixmetry.correct(frames[:5], camera, sequence=True).sources["electronics.agc"]
    moving = np.array([np.kron(rng.integers(200, 3000, (6, 8)), np.ones((16, 16))) for _ in frames]).astype(np.uint16)
    assert "keep camera and scene at rest" in pixmetry.correct(moving, camera, sequence=True).sources["electronics.agc"]
    locked = camera.with_parameters("electronics.agc", kappa=0.0)
    assert pixmetry.correct(frames, locked, sequence=True).sources["electronics.agc"] == "nothing to correct"


def test_frames_without_light_stay_as_they_are() -> None:
    camera = camera_with(**LAMP)
    frames = camera.expose(SCENE, FRAMES, seed=1).data
    frames[7] = 100
    found = pixmetry.correct(frames, camera, sequence=True)
    assert found.frames is not None and np.abs(found.frames[7]).max() < 50
    assert found.frames[6, :30].mean() == pytest.approx(found.frames[12, :30].mean(), rel=0.01)


@pytest.mark.parametrize("changed", [AGC, MIXED, AGC | MIXED], ids=["agc", "mixed", "agc and mixed"])
def test_rows_keep_no_offset_that_a_gain_or_a_mixture_has_changed(changed: dict[str, dict[str, object]], rng: np.random.Generator) -> None:
    """Covered columns tell the offsets of rows as they are stored, behind gain and mixture; frames made without the package.

    Of 20 DN (evenly spread, so that no covered pixel is below code 0: 1.4 times −34.6 DN, and noise) the noise of 24 covered columns leaves
    4/√24 DN, times √(1 + 0.4²)/0.6 where frames are mixed.
    """
    gain = 1 + 0.4 * np.cos(1.1 * np.arange(FRAMES)) if "electronics__agc" in changed else np.ones(FRAMES)
    light = np.pad(rng.uniform(600, 900, SHAPE), ((0, 0), (0, 24)))
    offset = 20.0 * rng.uniform(-np.sqrt(3), np.sqrt(3), (FRAMES, SHAPE[0], 1))
    seen = gain[:, None, None] * (light + offset + 4.0 * rng.standard_normal((FRAMES, *light.shape)))
    for k in range(1, FRAMES if "processing__temporal_noise_reduction" in changed else 0):
        seen[k] = 0.4 * seen[k - 1] + 0.6 * seen[k]
    camera = replace(camera_with(**changed), facts={"frame_period_s": 0.0231, "covered": {"right": 24}})
    found = pixmetry.correct(np.rint(BLACK_DN + seen).astype(np.uint16), camera, sequence=True)
    assert found.frames is not None
    rows = (found.frames - light[:, : SHAPE[1]]).mean(axis=2)[1:]
    left = (rows - rows.mean(axis=1, keepdims=True) - rows.mean(axis=0)).std()
    assert left < 2.5


def test_offsets_of_rows_are_those_in_front_of_a_gamma(rng: np.random.Generator) -> None:
    """Covered columns at 60 DN, where the curve is ten times as steep as at 700; frames made without the package. Subtracted as codes the
    offsets of 8 DN would leave 29 DN, the noise of 24 covered columns leaves 4/√24 DN."""
    light = np.pad(rng.uniform(600, 900, SHAPE), ((0, 0), (0, 24)), constant_values=60.0)
    offset = 8.0 * rng.uniform(-np.sqrt(3), np.sqrt(3), (4, SHAPE[0], 1))
    straight = light + offset + 4.0 * rng.standard_normal((4, *light.shape))
    frames = np.rint(BLACK_DN + 4095 * (straight / 4095) ** 0.45).astype(np.uint16)
    camera = replace(camera_with(electronics__gamma={"gamma": 0.45}), facts={"covered": {"right": 24}})
    found = pixmetry.correct(frames, camera)
    assert found.frames is not None
    rows = (found.frames - light[:, : SHAPE[1]]).mean(axis=2)
    assert (rows - rows.mean(axis=1, keepdims=True)).std() < 1.5


def test_mixed_frames_are_those_of_the_camera_that_does_not_mix(seed: int) -> None:
    """With the same draws. Their rounding to whole DN is left, 1/√12 √(1 + 0.4²)/0.6 and that of the others: 0.6 DN of steps of 800 DN."""
    camera = camera_with(**MIXED)
    without = camera.switched(off=["processing.temporal_noise_reduction"])
    frames, plain = (c.expose(SCENE, FRAMES, seed=seed % 10**6).data for c in (camera, without))
    found = pixmetry.correct(frames, camera, sequence=True)
    assert found.frames is not None
    assert float((found.frames[1:] - (plain[1:] - BLACK_DN)).std()) < 0.7
    assert float((found.frames[1:] - (plain[1:] - BLACK_DN)).mean()) == pytest.approx(0.0, abs=0.05)
