"""Lag that a light going off told is taken off the frames of a moving target: the whole way from the manifest's groups to a position."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

import pixmetry
from pixmetry import Frames, assess, campaign_of_arrays
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

SHAPE, EXPOSURE_S, LAG, STEP_PX = (96, 128), 0.002, 0.04, 3.0


def camera_with_everything() -> Camera:
    sources = {
        "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
        "sensor.prnu": {"pixel_std_rel": 0.005},
        "sensor.dsnu": {"pixel_std_e": 2.0},
        "sensor.dark_current": {"rate_e_per_s": 20.0},
        "sensor.shot_noise": {},
        "sensor.image_lag": {"lag_rel": LAG},
        "electronics.amplifier_noise": {"white_e": 8.0},
        "electronics.row_noise": {"row_e": 1.0},
        "electronics.gain": {"gain_dn_per_e": 0.2},
        "grabber.adc": {"bits": 12, "offset_dn": 100.0},
    }
    found = {name: get_source(name) for name in sources}
    return Camera("lagging", SHAPE, tuple(Element(s.id, s, s.parameters(**sources[s.id])) for s in in_order(found.values())))


def places_of(frames: np.ndarray) -> np.ndarray:
    """x of the target in each frame by the centre of gravity of a window that goes with it."""
    out = []
    for k, frame in enumerate(frames):
        first = 20 + int(STEP_PX * k)
        window = frame[38:58, first : first + 22].astype(float)
        window = window - np.median(window[[0, 1, -2, -1]])
        out.append(first + float((window.sum(axis=0) * np.arange(22)).sum() / window.sum()))
    return np.array(out)


def test_measured_lag_is_taken_off_and_the_positions_return(seed: int, tmp_path: Path):
    """A disc that moves 3 px a frame stays behind by 0.04 · 3 px; corrected, less than a fifth of that is left."""
    camera = camera_with_everything()

    def taken(scene: object, frames: int, number: int, exposure_s: float = EXPOSURE_S) -> np.ndarray:
        return camera.expose(scene, frames, seed=seed % 10**6 + number, exposure_s=exposure_s).data.astype(np.uint16)

    levels = [0.001 * k for k in range(1, 9)]
    groups = [Frames("dark", t, taken(Uniform(0.0), 2, 10 + k, t)) for k, t in enumerate(levels)]
    groups += [Frames("bright", t, taken(Uniform(1.5e6 * t), 3, 30 + k, t)[1:]) for k, t in enumerate(levels)]
    x = np.where(np.arange(20) < 4, SHAPE[1] / 2, 1e5)[:, None]
    lamp = Discs(x, np.full((20, 1), SHAPE[0] / 2), 400.0, peak_photons=9000.0, per_frame=True)
    groups.append(Frames("light_off", EXPOSURE_S, taken(lamp, 20, 60)))
    found = assess(campaign_of_arrays(groups, bits=12, name="lagging", sensor="cmos"), tmp_path / "result", trials=0)
    lag = found.estimates["sensor.image_lag"]["lag_rel"]
    assert abs(lag.value - LAG) < 7 * lag.u

    along = 30.3 + STEP_PX * np.arange(16)[:, None]
    target = Discs(along, np.full((16, 1), 48.2), diameter_px=7.0, blur_px=0.9, peak_photons=12_000.0, per_frame=True)
    frames = taken(target, 16, 90)
    clean = camera.switched(off=["sensor.image_lag"]).expose(target, 16, quiet=True, exposure_s=EXPOSURE_S).data
    corrected = pixmetry.correct(frames, tmp_path / "result", sequence=True)
    told = corrected.sources["sensor.image_lag"]
    assert "(1 of 16 frames)" in told and "corrected (15 of 16 frames)" in told
    before, after = (np.mean((places_of(stack) - places_of(clean))[1:]) for stack in (frames, corrected.frames))
    assert before == pytest.approx(-LAG * STEP_PX, rel=0.3)
    assert abs(after) < 0.2 * abs(before)

    alone = pixmetry.correct(frames[:2], tmp_path / "result")
    assert "needs the frame before" in alone.sources["sensor.image_lag"]
    (tmp_path / "frames").mkdir()
    for k, frame in enumerate(frames[:3]):
        tifffile.imwrite(tmp_path / "frames" / f"f{k}.tif", frame)
    pixmetry.correct(tmp_path / "frames", tmp_path / "result", tmp_path / "out", sequence=True)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "out" / "f2.tif"), corrected.frames[2])
