"""Light that flickers: the mean of the lamp over the exposure of each row, against numerical integration."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from catalogue.support import Flat
from pixmetry.camera.camera import Camera, Element
from pixmetry.core.random import Grid
from pixmetry.sources.optics.flicker import SOURCE, Flicker, mean_light, shares
from pixmetry.sources.sensor import exposure, light_pulses, parasitic_light, rolling_shutter
from pixmetry.sources.sensor.exposure import Exposure
from pixmetry.sources.sensor.light_pulses import LightPulses
from pixmetry.sources.sensor.parasitic_light import ParasiticLight
from pixmetry.sources.sensor.rolling_shutter import RollingShutter
from sources.sensor.moving_scenes import STEADY, Spot, Steady, chain, moments

LAMPS = {
    "sine": Flicker(depth_rel=0.4, frequency_hz=100.0, phase_rad=0.7),
    "switched": Flicker(depth_rel=0.9, frequency_hz=130.0, phase_rad=-2.0, waveform="switched", duty=0.3),
}


def lamp_at(t: np.ndarray, lamp: Flicker) -> np.ndarray:
    """The lamp at an instant, written apart from the source."""
    if lamp.waveform == "sine":
        return 1 + lamp.depth_rel * np.cos(2 * np.pi * lamp.frequency_hz * t + lamp.phase_rad)
    cycle = (lamp.frequency_hz * t + lamp.phase_rad / (2 * np.pi)) % 1.0
    return 1 - lamp.depth_rel + lamp.depth_rel / lamp.duty * (cycle < lamp.duty)


def integrated(lamp: Flicker, begin: float, length: float) -> float:
    t = begin + (np.arange(200_000) + 0.5) / 200_000 * length
    return float(lamp_at(t, lamp).mean())


@pytest.mark.parametrize("lamp", LAMPS.values(), ids=LAMPS.keys())
def test_the_mean_over_any_time_and_at_an_instant(lamp: Flicker, rng: np.random.Generator) -> None:
    begin, length = rng.uniform(-0.05, 0.05, 8), rng.uniform(1e-4, 0.03, 8)
    expected = [integrated(lamp, b, d) for b, d in zip(begin, length, strict=True)]
    assert mean_light(lamp, begin, begin + length) == pytest.approx(expected, abs=1e-4)
    assert mean_light(lamp, begin, begin) == pytest.approx(lamp_at(begin, lamp), abs=1e-9)
    assert mean_light(lamp, np.zeros(1), np.full(1, 10 / lamp.frequency_hz)) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("lamp", LAMPS.values(), ids=LAMPS.keys())
@pytest.mark.parametrize("nodes", [1, 4])
@pytest.mark.parametrize("scene", [Flat(50.0), Steady()], ids=["still", "moving"])
def test_a_rolling_shutter_shows_bands_that_are_the_mean_over_each_rows_exposure(lamp: Flicker, nodes: int, scene: object) -> None:
    """Whether the scene moves or not, and however many looks stand for the exposure: the total is exact."""
    length, row_time = 3e-3, 2e-4
    pairs = (SOURCE, lamp), (exposure.SOURCE, Exposure(nodes=nodes)), (rolling_shutter.SOURCE, RollingShutter(row_time_s=row_time))
    image = chain(*pairs, shape=(60, 4), exposure_s=length).expose(scene, [1]).data[0]
    expected = [STEADY * integrated(lamp, 0.04 + r * row_time, length) for r in range(60)]
    assert image == pytest.approx(np.repeat(np.array(expected)[:, None], 4, axis=1), rel=2e-4)
    assert np.ptp(image) > 0.2 * STEADY


def test_an_exposure_of_a_whole_period_sees_no_flicker_and_a_short_one_all_of_it() -> None:
    lamp = Flicker(depth_rel=0.5)
    for length, expected in (
        (0.01, 1.0),
        (0.02, 1.0),
        (1e-5, 1.5),
        (0.005, 1 + 0.5 * quad(lambda t: np.cos(200 * np.pi * t), 0, 0.005)[0] / 0.005),
    ):
        image = chain((SOURCE, lamp), exposure_s=length).expose(Flat(50.0)).data[0]
        assert image == pytest.approx(np.full(image.shape, STEADY * expected), rel=1e-5)


def test_frames_of_a_still_scene_differ_in_brightness_as_the_lamp_beats_with_them() -> None:
    lamp, length = Flicker(depth_rel=0.5, frequency_hz=103.0, phase_rad=0.2), 2e-3
    frames = chain((SOURCE, lamp), exposure_s=length).expose(Flat(50.0), 4).data
    expected = [STEADY * integrated(lamp, 0.04 * k, length) for k in range(4)]
    assert frames.mean(axis=(1, 2)) == pytest.approx(expected, rel=1e-5)
    assert np.ptp(frames) > 0.2 * STEADY


def test_flicker_weights_the_path_of_a_moving_target() -> None:
    """The centre is ∫ v t E(t) dt / ∫ E(t) dt."""
    lamp, v, length = Flicker(depth_rel=0.8, frequency_hz=25.0, phase_rad=0.4), 100.0, 0.02
    pairs = (SOURCE, lamp), (exposure.SOURCE, Exposure(nodes=12))
    x = moments(chain(*pairs, exposure_s=length).expose(Spot(20.0, 15.0, v)).data[0])[0]
    flux, path = (quad(lambda t, k=k: lamp_at(t, lamp) * t**k, 0, length)[0] for k in (0, 1))
    assert x == pytest.approx(20.0 + v * path / flux, abs=2e-3)


def test_two_lamps_multiply_in_short_looks() -> None:
    one, two = Flicker(depth_rel=0.3, phase_rad=1.0), Flicker(depth_rel=0.5, frequency_hz=77.0, phase_rad=-0.5)
    camera = Camera("test", (4, 4), (Element("a", SOURCE, one), Element("b", SOURCE, two)), exposure_s=1e-6)
    image = camera.expose(Flat(50.0), [3]).data[0]
    assert image == pytest.approx(np.full((4, 4), STEADY * lamp_at(0.12, one) * lamp_at(0.12, two)), rel=1e-3)


def test_pulses_are_instants_and_a_waiting_store_adds_its_own_looks() -> None:
    lamp = LAMPS["sine"]
    pulsed = chain((SOURCE, lamp), (light_pulses.SOURCE, LightPulses(pulse_s=0.0)), shape=(2, 3), exposure_s=0.02).expose(Steady()).data[0]
    expected = np.array([lamp_at(0.0195, lamp), lamp_at(0.0205, lamp)])
    assert pulsed == pytest.approx(np.repeat(STEADY * expected[:, None], 3, axis=1), rel=1e-6)
    params = ParasiticLight(sensitivity_rel=0.01, wait_s=1e-5, row_time_s=0.0)
    stored = chain((SOURCE, lamp), (parasitic_light.SOURCE, params), shape=(2, 3), exposure_s=3e-3).expose(Steady()).data[0]
    total = integrated(lamp, 0.0, 3e-3) + 0.01 * 1e-5 / 3e-3 * lamp_at(3.005e-3, lamp)
    assert stored == pytest.approx(np.full((2, 3), STEADY * total), rel=1e-5)


def test_looks_of_a_shutter_share_its_time_without_gaps() -> None:
    camera = chain((exposure.SOURCE, Exposure(nodes=7)))
    signal = camera.signal(Steady(), Grid.whole([2], (3, 3)), exposure_s=0.01)
    light = exposure.forward(Exposure(nodes=7), signal, None).light
    begin, end = shares(light)
    assert begin[0, 0, 0] == pytest.approx(0.08) and end[0, 0, -1] == pytest.approx(0.09)
    assert begin[0, 0, 1:] == pytest.approx(end[0, 0, :-1])
