"""Interlacing, rolling shutter, light pulses and trigger: when each row looks, seen on a target that moves."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from pixmetry.sources.sensor import exposure, interlace, light_pulses, rolling_shutter, trigger_jitter
from pixmetry.sources.sensor.exposure import Exposure
from pixmetry.sources.sensor.interlace import Interlace
from pixmetry.sources.sensor.light_pulses import LightPulses
from pixmetry.sources.sensor.rolling_shutter import RollingShutter
from pixmetry.sources.sensor.trigger_jitter import TriggerJitter
from source_signals import ALPHA, flat, stream
from sources.sensor.moving_scenes import STEADY, Spot, Steady, chain, moments, row_centres


def field_centres(image: np.ndarray) -> tuple[float, float]:
    """Centre along x in the even and in the odd field, each by itself."""
    return moments(image[0::2])[0], moments(image[1::2])[0]


# ---- interlace -------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("first", ["even", "odd"])
def test_the_fields_lie_apart_by_the_speed_times_the_field_period(first: str) -> None:
    """50 px/s: 1 px; the speed follows from the second field minus the first, whichever rows it has."""
    camera = chain((interlace.SOURCE, Interlace(first_field=first)), exposure_s=0.01)
    even, odd = field_centres(camera.expose(Spot(20.0, 15.0, 50.0)).data[0])
    second, earlier = (odd, even) if first == "even" else (even, odd)
    assert (second - earlier) / 0.02 == pytest.approx(50.0, abs=0.01)
    assert 0.5 * (even + odd) == pytest.approx(20.0 + 50.0 * (0.005 + 0.010), abs=1e-3)  # t0 + t_exp/2 + half a field period


def test_the_centre_of_the_frame_is_the_mean_of_the_fields_within_3_millipixels() -> None:
    camera = chain((interlace.SOURCE, Interlace()), exposure_s=0.01)
    for y in np.linspace(14.0, 16.0, 7):
        x = moments(camera.expose(Spot(20.0, float(y), 50.0, smooth_px=1.2)).data[0])[0]
        assert x == pytest.approx(20.0 + 50.0 * 0.015, abs=3e-3)


def test_frame_integration_blurs_both_fields_over_40_ms_and_they_overlap_by_half() -> None:
    camera = chain((exposure.SOURCE, Exposure(nodes=6)), (interlace.SOURCE, Interlace()), exposure_s=0.04)
    image = camera.expose(Spot(20.0, 15.0, 50.0)).data[0].astype(float)
    still = camera.expose(Spot(20.0, 15.0)).data[0].astype(float)
    even, odd = image[0::2], image[1::2]
    for field, reference in ((even, still[0::2]), (odd, still[1::2])):
        assert moments(field)[2] - moments(reference)[2] == pytest.approx(2.0**2 / 12, abs=1e-4)
    assert field_centres(image)[1] - field_centres(image)[0] == pytest.approx(1.0, abs=1e-4)


def test_field_integration_sums_each_row_and_the_next() -> None:
    """The oracle takes the same scene in frame integration and adds its rows."""
    spot = Spot(20.3, 15.2, 0.0, smooth_px=0.9)
    single = chain((interlace.SOURCE, Interlace()), shape=(33, 40)).expose(spot).data[0].astype(float)
    summed = chain((interlace.SOURCE, Interlace(integration="field")), shape=(33, 40)).expose(spot).data[0].astype(float)
    assert summed[:-1] == pytest.approx(single[:-1] + single[1:], rel=2e-4, abs=1e-3)
    x, y = chain((interlace.SOURCE, Interlace(integration="field")), shape=(33, 40)).true_positions([20.3], [15.2])
    assert moments(summed)[:2] == pytest.approx((float(x[0]), float(y[0])), abs=1e-3)
    moved = chain((interlace.SOURCE, Interlace(integration="field")), exposure_s=0.01).expose(Spot(20.0, 15.0, 50.0)).data[0]
    even, odd = field_centres(moved)
    assert odd - even == pytest.approx(1.0, abs=1e-3)


def test_truth_of_the_fields(rng: np.random.Generator) -> None:
    told = interlace.truth(Interlace(first_field="odd"), flat(0, (5, 4), 2), stream(rng))
    assert np.array_equal(told["field"], [[1, 0, 1, 0, 1]] * 2)
    assert np.allclose(told["delay_s"], [[0.02, 0, 0.02, 0, 0.02]] * 2)


# ---- rolling shutter -------------------------------------------------------------------------------------------------------------------


def test_2048_rows_of_10_us_shear_a_line_by_1_02_px_at_50_px_per_s() -> None:
    camera = chain((rolling_shutter.SOURCE, RollingShutter(row_time_s=10e-6)), shape=(2048, 20), exposure_s=1e-3)
    centres = row_centres(camera.expose(Spot(9.0, None, 50.0)).data[0])
    assert centres[-1] - centres[0] == pytest.approx(50.0 * 10e-6 * 2047, abs=1e-4)
    assert centres[-1] - centres[0] == pytest.approx(1.02, abs=0.005)
    assert np.diff(centres) == pytest.approx(50.0 * 10e-6, abs=2e-5)


def test_the_bottom_row_first_shears_the_other_way() -> None:
    def slope(first: str) -> float:
        camera = chain((rolling_shutter.SOURCE, RollingShutter(row_time_s=1e-4, first_row=first)))
        return float(np.polyfit(np.arange(32), row_centres(camera.expose(Spot(20.0, None, 100.0)).data[0]), 1)[0])

    assert slope("top") == pytest.approx(0.01, rel=1e-3)
    assert slope("bottom") == pytest.approx(-0.01, rel=1e-3)


def test_a_global_reset_gathers_longer_from_row_to_row_about_a_later_middle() -> None:
    params = RollingShutter(row_time_s=1e-4, reset="global")
    pairs = (exposure.SOURCE, Exposure(nodes=5)), (rolling_shutter.SOURCE, params)
    rows = np.arange(32)
    even = chain(*pairs, exposure_s=1e-3).expose(Steady()).data[0]
    assert even == pytest.approx(np.broadcast_to(STEADY * (1 + 0.1 * rows)[:, None], (32, 48)), rel=1e-6)
    centres = row_centres(chain(*pairs, exposure_s=1e-3).expose(Spot(20.0, None, 400.0)).data[0])
    assert centres == pytest.approx(20.0 + 400.0 * 0.5 * (1e-3 + rows * 1e-4), abs=1e-4)


def test_truth_of_the_rows_is_where_a_target_is_seen(rng: np.random.Generator) -> None:
    """The delay of the middle of each row's exposure, times the speed, is how far the target has moved in that row."""
    for reset in ("rolling", "global"):
        params = RollingShutter(row_time_s=1e-4, reset=reset)
        pairs = (exposure.SOURCE, Exposure(nodes=5)), (rolling_shutter.SOURCE, params)
        seen = row_centres(chain(*pairs, exposure_s=1e-3).expose(Spot(20.0, None, 400.0)).data[0])
        told = rolling_shutter.truth(params, flat(0, (32, 48)), stream(rng))
        assert seen - seen[0] == pytest.approx(400.0 * told["delay_s"][0], abs=2e-4), reset


# ---- light pulses ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("speed", "apart"), [(50.0, 0.05), (350.0, 0.35)])
def test_pulses_a_millisecond_apart(speed: float, apart: float) -> None:
    camera = chain((interlace.SOURCE, Interlace()), (light_pulses.SOURCE, LightPulses()), exposure_s=0.02)
    even, odd = field_centres(camera.expose(Spot(15.0, 15.0, speed)).data[0])
    assert odd - even == pytest.approx(apart, abs=1e-4)
    assert 0.5 * (odd + even) == pytest.approx(15.0 + speed * 0.02, abs=1e-3)  # astride the end of the first field


def test_steady_light_pulls_each_field_towards_its_own_middle() -> None:
    """Light of share a from the field's whole exposure: the centre is the weighted mean."""
    a, v = 0.2, 50.0
    pairs = (interlace.SOURCE, Interlace()), (light_pulses.SOURCE, LightPulses(ambient_share=a))
    image = chain((exposure.SOURCE, Exposure(nodes=5)), *pairs, exposure_s=0.02).expose(Spot(15.0, 15.0, v)).data[0]
    even, odd = field_centres(image)
    assert even == pytest.approx(15.0 + v * ((1 - a) * 0.0195 + a * 0.01), abs=1e-4)
    assert odd == pytest.approx(15.0 + v * ((1 - a) * 0.0205 + a * 0.03), abs=1e-4)


# ---- trigger ---------------------------------------------------------------------------------------------------------------------------


def test_latency_and_a_slow_clock_move_the_target_by_speed_times_delay() -> None:
    params = TriggerJitter(latency_s=2e-3, clock_error_rel=1e-3)
    camera = chain((trigger_jitter.SOURCE, params), exposure_s=0.01)
    still, later = (moments(image)[0] for image in camera.expose(Spot(15.0, 15.0, 50.0), 6).data[[0, 5]])
    assert still == pytest.approx(15.0 + 50.0 * (0.005 + 2e-3), abs=1e-4)
    assert later == pytest.approx(15.0 + 50.0 * (0.205 + 2e-3 + 0.2e-3), abs=1e-4)


def test_stat_the_delay_scatters_as_stated_and_moves_the_image_by_it(rng: np.random.Generator) -> None:
    """False-failure rate 1e-6; with 2000 frames a standard deviation that is off by 1.16 is seen."""
    params, n = TriggerJitter(jitter_s=1e-3), 2000
    told = trigger_jitter.truth(params, flat(0, (2, 2), n), stream(rng))["delay_s"]
    assert np.array_equal(told[:, 0], told[:, 1])
    low, high = chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], n - 1) / (n - 1)
    assert low < told[:, 0].var(ddof=1) / 1e-6 < high
    camera = chain((trigger_jitter.SOURCE, params), exposure_s=0.01)
    for frame in range(3):
        delay = camera.truth(frame=frame, seed=7)[trigger_jitter.SOURCE.id]["delay_s"].ravel()[0]
        x = moments(camera.expose(Spot(15.0, 15.0, 50.0), [frame], seed=7).data[0])[0]
        assert x == pytest.approx(15.0 + 50.0 * (0.005 + 0.04 * frame + delay), abs=1e-4)
