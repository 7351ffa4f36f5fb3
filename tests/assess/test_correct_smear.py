"""Smear that bright spots told is taken off frames of other scenes: the whole way from the manifest's groups to a position."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import pixmetry
from pixmetry import Frames, assess, campaign_of_arrays
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

SHAPE, EXPOSURE_S, SMEAR_S = (160, 140), 0.002, 2e-4
X_PX, Y_PX = 70.3, 40.4


def camera_with_everything() -> Camera:
    """A frame transfer camera that is flushed before each exposure."""
    sources = {
        "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
        "sensor.prnu": {"pixel_std_rel": 0.005},
        "sensor.dsnu": {"pixel_std_e": 2.0},
        "sensor.dark_current": {"rate_e_per_s": 20.0},
        "sensor.smear": {"transfer_s": SMEAR_S, "rows": "passed", "store": "below"},
        "sensor.shot_noise": {},
        "sensor.charge_transfer": {"parallel_cti": 1e-5, "serial_cti": 1e-5},
        "electronics.amplifier_noise": {"white_e": 8.0},
        "electronics.row_noise": {"row_e": 1.0},
        "electronics.gain": {"gain_dn_per_e": 0.2},
        "grabber.adc": {"bits": 12, "offset_dn": 100.0},
    }
    found = {name: get_source(name) for name in sources}
    return Camera("smearing", SHAPE, tuple(Element(s.id, s, s.parameters(**sources[s.id])) for s in in_order(found.values())))


def place_of(frame: np.ndarray) -> float:
    """x of the target by its centre of gravity in a window, above the level left and right of it."""
    window = frame[32:50, 61:80].astype(float)
    window = window - np.median(window[:, [0, 1, 2, -3, -2, -1]])
    return 61 + float((window.sum(axis=0) * np.arange(window.shape[1])).sum() / window.sum())


def test_measured_smear_is_taken_off_and_the_position_returns(seed: int, tmp_path: Path):
    """A bright disc below the target smears one side of it: 20 frames, before 0.1 px and more away, after within a fifth of that."""
    camera = camera_with_everything()

    def taken(scene: object, frames: int, exposure_s: float, number: int) -> np.ndarray:
        return camera.expose(scene, frames, seed=seed % 10**6 + number, exposure_s=exposure_s).data.astype(np.uint16)

    levels = [0.001 * k for k in range(1, 9)]
    groups = [Frames("dark", t, taken(Uniform(0.0), 2, t, 10 + k)) for k, t in enumerate(levels)]
    groups += [Frames("bright", t, taken(Uniform(1.5e6 * t), 2, t, 30 + k)) for k, t in enumerate(levels)]
    for k, t in enumerate((0.0005, 0.001, 0.002)):
        spots = Discs([40.2, 100.6], [80.3, 84.1], diameter_px=9.0, blur_px=1.2, peak_photons=6e6 * t)
        groups.append(Frames("spots", t, taken(spots, 6, t, 50 + k)))
    found = assess(campaign_of_arrays(groups, bits=12, name="smearing", sensor="ccd"), tmp_path / "result", trials=0)
    smear = found.estimates["sensor.smear"]["transfer_s"]
    assert abs(smear.value - SMEAR_S) < 7 * smear.u

    peaks = np.array([4000.0, 14000.0])
    scene = Discs([X_PX, 79.0], [Y_PX, 110.0], diameter_px=8.0, blur_px=1.0, peak_photons=peaks)
    frames = taken(scene, 20, EXPOSURE_S, 90)
    corrected = pixmetry.correct(frames, tmp_path / "result", settings={"exposure_s": EXPOSURE_S})
    assert corrected.sources["sensor.smear"].startswith("corrected")
    clean = camera.switched(off=["sensor.smear"]).expose(scene, 1, quiet=True, exposure_s=EXPOSURE_S).data[0]
    true_px = place_of(clean)
    before, after = (np.mean([place_of(f) for f in stack]) - true_px for stack in (frames, corrected.frames))
    assert abs(before) > 0.1
    assert abs(after) < 0.2 * abs(before)
