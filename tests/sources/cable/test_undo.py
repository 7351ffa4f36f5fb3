"""Taking the cable out: frames with it, corrected, are the frames that the same camera makes without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from catalogue.support import Targets, camera_with
from pixmetry.assess.correct import correct_signal
from pixmetry.camera.camera import Camera, Element, load_camera
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import ParameterError
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform
from pixmetry.sources.cable.t_piece import TPiece
from pixmetry.sources.cable.termination import Termination
from source_signals import signal

CABLES = {
    "2 m of 50 ohm": ("cable.termination", Termination(length_m=2.0, line_ohm=50.0)),
    "20 m, not terminated, lossy": ("cable.termination", Termination(length_m=20.0, line_ohm=50.0, load_ohm=1000.0, skin_db=0.5)),
    "open branch": ("cable.t_piece", TPiece(branch="open", length_m=5.0)),
    "terminated branch": ("cable.t_piece", TPiece(branch="terminated", length_m=4.0, end_ohm=50.0)),
}
FILTERS = [("electronics.video_amplifier", {"natural_mhz": 8.0, "damping": 0.7}), ("grabber.low_pass", {"kind": "butterworth"})]


def element(id: str, params: object) -> Element:
    source = get_source(id)
    return Element(id, source, source.make(params) if isinstance(params, dict) else params)


def chain(cable: str, *behind: Element, filters: bool = True) -> Camera:
    id, params = CABLES[cable]
    amplifier, low_pass = ([element(*f)] if filters else [] for f in FILTERS)
    first, *rest = [*amplifier, element(id, params), *low_pass, *behind]
    return camera_with(first.source, first.params, shape=(24, 320), after=rest)


def corrected(camera: Camera, data: np.ndarray) -> np.ndarray:
    frames = signal(data, Kind.DN, frame_shape=camera.output_shape)
    return correct_signal(camera, frames, {})[0].data.astype(float)


def centres(frames: np.ndarray, threshold: float) -> np.ndarray:
    light = np.maximum(frames - threshold, 0.0)
    return (light * np.arange(frames.shape[2])).sum(axis=(1, 2)) / light.sum(axis=(1, 2))


SCENE = Targets(np.linspace(40.2, 280.7, 12), np.full(12, 11.6))


@pytest.mark.parametrize("filters", [True, False], ids=["behind filters", "bare line"])
@pytest.mark.parametrize("cable", CABLES)
def test_the_cable_is_taken_out_of_the_pixels(cable: str, filters: bool, rng: np.random.Generator) -> None:
    """Of 12 discs; less than 1 % of the shift is left, and noise of the samples is not raised by more than 80 %."""
    camera = chain(cable, filters=filters)
    without = camera.switched(off=[CABLES[cable][0]] if filters else ["source under test"])
    there, gone = (c.expose(SCENE, 12, quiet=True).data.astype(float) for c in (camera, without))
    back = corrected(camera, there)
    shift, left = (centres(f, 20.0) - centres(gone, 20.0) for f in (there, back))
    assert np.abs(shift).min() > 0.01
    assert np.abs(left).max() < 0.01 * np.abs(shift).max()
    assert np.abs(back - gone).max() < 0.02 * np.abs(there - gone).max() + 0.2
    noise = rng.normal(0, 1, there.shape)
    assert (corrected(camera, there + noise) - back).std() < 1.8


@pytest.mark.parametrize("cable", CABLES)
def test_with_a_slow_clock_the_larger_part_goes(cable: str) -> None:
    """10 MHz for 14.2 MHz of pixels: fewer samples than pixels; less than 4 % of the shift is left."""
    camera = chain(cable, element("grabber.sampling_clock", {"clock_mhz": 10.0, "samples": 225, "start_ns": 40.0}))
    there, gone = (c.expose(SCENE, 12, quiet=True).data.astype(float) for c in (camera, camera.switched(off=[CABLES[cable][0]])))
    shift, left = (centres(f, 20.0) - centres(gone, 20.0) for f in (there, corrected(camera, there)))
    assert np.sqrt((left**2).mean()) < 0.04 * np.sqrt((shift**2).mean())


@pytest.mark.parametrize("name", ["pulnix_tm6cn_epix_512", "pulnix_tm6cn_epix_pixelclock"])
@pytest.mark.parametrize("branch", ["open", "none"])
def test_presets_give_targets_back_without_their_cable(name: str, branch: str) -> None:
    """Codes of the whole camera, all sources on but noise; with a cable of 50 Ω, and a T-piece behind it."""
    camera = load_camera(name).with_parameters("cable.termination", length_m=2.0 if branch == "open" else 5.0, line_ohm=50.0)
    at = next(i for i, e in enumerate(camera.chain) if e.name == "cable.termination")
    t_piece = element("cable.t_piece", TPiece(branch=branch, length_m=5.0))
    camera = replace(camera, chain=(*camera.chain[: at + 1], t_piece, *camera.chain[at + 1 :]))
    scene = Discs([200.2, 333.9, 501.4, 620.6], [300.0, 300.4, 299.8, 300.1], diameter_px=8.0, peak_photons=1.0e5, background=Uniform(9e3))
    row = 250 if camera.output_shape[0] == 512 else 282
    ratio = camera.output_shape[1] / (726.4 if camera.output_shape[1] == 512 else 752)
    found = []
    for one in (camera, camera.switched(off=["cable.termination", "cable.t_piece"])):
        frames = one.expose(scene, 1, quiet=True, window=(row, 0, 36, one.output_shape[1]))
        found.append((frames.data.astype(float), correct_signal(one, frames, {})[0].data.astype(float)))
    shifts = []
    for kind in (0, 1):
        there, gone = (f[kind] for f in found)
        level = np.median(gone) + 20.0
        parts = [slice(int(x * ratio) - 14, int(x * ratio) + 14) for x in scene.x_px]
        shifts.append(np.array([(centres(there[:, :, p], level) - centres(gone[:, :, p], level))[0] for p in parts]))
    before, after = (np.sqrt((s**2).mean()) for s in shifts)
    assert before > 0.015
    assert after < (0.06 if "512" in name else 0.03) * before + 0.0005  # what rounding to whole numbers moves


def test_a_row_that_is_too_long_is_refused() -> None:
    with pytest.raises(ParameterError, match="4096"):
        id, params = CABLES["open branch"]
        get_source(id).correct(params, signal(np.zeros((1, 1, 5000)), Kind.DN), {})
