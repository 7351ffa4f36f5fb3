"""Automatic gain control: the loop in closed form, its limits, its memory, and what it does to a position."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.signal import Kind
from pixmetry.core.errors import InputError
from pixmetry.sources.electronics.agc import SOURCE, Agc, start
from source_signals import flat, signal, spot_probe, stream

SHAPE = (20, 30)


def gains(rng: np.random.Generator, params: Agc, level: float, n: int) -> np.ndarray:
    out, _ = SOURCE.forward(params, flat(level, SHAPE, n=n, kind=Kind.DN), stream(rng), start(params))
    return out.data[:, 0, 0].astype(float) / level


def test_deviation_in_decibels_decays_geometrically(rng: np.random.Generator):
    """g_t = (target/level)^(1 − (1 − κ)^t)."""
    params = Agc(target_dn=100.0, kappa=0.3)
    expected = (100 / 20) ** (1 - 0.7 ** np.arange(30))
    assert gains(rng, params, 20.0, 30) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("level", "limit_db"), [(1e-3, 32.0), (1e5, -6.0)])
def test_stays_within_its_limits(level, limit_db, rng: np.random.Generator):
    params = Agc(target_dn=100.0, kappa=0.5, lowest_db=-6.0, highest_db=32.0)
    assert gains(rng, params, level, 40)[-1] == pytest.approx(10 ** (limit_db / 20), rel=1e-5)


def test_a_frame_without_light_asks_for_all_the_gain(rng: np.random.Generator):
    _, state = SOURCE.forward(Agc(kappa=1.0), flat(0.0, SHAPE, kind=Kind.DN), stream(rng), 1.0)
    assert state == pytest.approx(10 ** (32 / 20))


def test_memory_goes_on_where_it_stopped(rng: np.random.Generator):
    params = Agc(target_dn=80.0, kappa=0.2)
    frames = rng.uniform(0, 100, (12, *SHAPE)) * np.linspace(0.2, 2, 12)[:, None, None]
    whole, last = SOURCE.forward(params, signal(frames, Kind.DN), stream(rng), start(params))
    first, state = SOURCE.forward(params, signal(frames[:5], Kind.DN), stream(rng), start(params))
    second, end = SOURCE.forward(params, signal(frames[5:], Kind.DN), stream(rng), state)
    assert np.array_equal(whole.data, np.concatenate([first.data, second.data]))
    assert end == last


def test_windows_hold_the_gain_and_the_context_is_the_frame(rng: np.random.Generator):
    params = Agc(target_dn=80.0, kappa=0.2)
    window = flat(10.0, (4, 5), n=3, kind=Kind.DN, frame_shape=SHAPE)
    out, state = SOURCE.forward(params, window, stream(rng), 2.5)
    assert state == 2.5 and np.array_equal(out.data, np.full((3, 4, 5), 25, np.float32))
    assert SOURCE.window_needed(params, window.windows, SHAPE).equals(window.windows.full_frame(SHAPE))


def test_a_loop_that_never_settles_is_refused():
    with pytest.raises(InputError, match="settle"):
        SOURCE.make({"kappa": 0.001})


def test_a_common_factor_does_not_move_a_centroid_whose_threshold_follows_it():
    assert SOURCE.propagate(SOURCE.bound, spot_probe()).total_px == 0.0
    image, threshold = spot_probe(sigma=0.6).signal_dn, 40.0
    for gain in (0.5, 7.0):
        weight, plain = np.maximum(gain * image - gain * threshold, 0), np.maximum(image - threshold, 0)
        found, before = (((w.sum(axis=1) * np.arange(25)).sum(axis=1) / w.sum(axis=(1, 2))) for w in (weight, plain))
        np.testing.assert_allclose(found, before, atol=1e-12)
