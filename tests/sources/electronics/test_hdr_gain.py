"""Stitching of two gains and a knee: the jump, the bend, noise and steps above the switch only, and the inverse."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pixmetry.camera.signal import Kind
from pixmetry.sources.electronics.hdr_gain import SOURCE, HdrGain
from source_signals import Z, centroid, flat, signal, spot_probe, stream


def joined(rng: np.random.Generator, params: HdrGain, values) -> np.ndarray:
    return SOURCE.forward(params, signal(np.reshape(values, (1, 1, -1)), Kind.DN), stream(rng)).data[0, 0].astype(float)


def test_two_gains_jump_at_the_switch(rng: np.random.Generator):
    got = joined(rng, HdrGain(switch_dn=100.0, mismatch_rel=0.02, offset_dn=-0.5), [-3, 50, 100, 100.01, 1000])
    assert got == pytest.approx([-3, 50, 100, 1.02 * 100.01 - 0.5, 1019.5], rel=1e-6)


def test_knee_bends_without_a_jump(rng: np.random.Generator):
    got = joined(rng, HdrGain(mode="knee", switch_dn=100.0, mismatch_rel=-0.1), [50, 100, 100.01, 200])
    assert got == pytest.approx([50, 100, 100.009, 190], rel=1e-6)


def test_upper_part_comes_in_steps_and_with_noise(rng: np.random.Generator):
    """Noise of 8 DN then steps of 4: variance 64 + 16/12 above the switch, none below; 1e-6, catches 2 %."""
    params = HdrGain(switch_dn=100.0, upper_noise_dn=8.0, ratio=4)
    out = SOURCE.forward(params, flat(1000.0, (400, 500), kind=Kind.DN), stream(rng)).data.astype(float)
    assert np.array_equal(out % 4, np.zeros_like(out))
    assert abs(out.var() / (64 + 16 / 12) - 1) < Z * math.sqrt(2 / out.size)
    below = flat(99.5, (40, 50), kind=Kind.DN)
    assert np.array_equal(SOURCE.forward(params, below, stream(rng)).data, below.data)


def test_columns_differ_and_are_told(rng: np.random.Generator):
    params, one = HdrGain(switch_dn=10.0, column_std_rel=0.01), stream(rng)
    frames = flat(100.0, (5, 4000), n=2, kind=Kind.DN)
    out, told = SOURCE.forward(params, frames, one).data, SOURCE.truth(params, frames, one)["upper_slope_rel"]
    assert out == pytest.approx(np.broadcast_to(100 * told, out.shape), rel=1e-6)
    assert abs(told.std() / 0.01 - 1) < Z / math.sqrt(2 * 4000)


@pytest.mark.parametrize("mode", ["two gains", "knee"])
def test_inverse_brings_the_scale_back(mode, rng: np.random.Generator):
    params = HdrGain(mode=mode, switch_dn=100.0, mismatch_rel=0.03, offset_dn=1.0 if mode == "two gains" else 0.0)
    frames = signal(rng.uniform(0, 500, (2, 30, 40)), Kind.DN)
    back = SOURCE.correct(params, SOURCE.forward(params, frames, stream(rng)), {})
    assert np.abs(back.data - frames.data).max() < 1e-3


def test_shift_of_a_stretched_spot():
    """A spot whose top is 10 % too high: the shift of its centroid from the stretched image itself."""
    probe = spot_probe(sigma=0.6, n=32)
    got = SOURCE.propagate(HdrGain(switch_dn=75.0, mismatch_rel=0.1), probe)
    image = np.where(probe.signal_dn > 75, 1.1 * probe.signal_dn, probe.signal_dn)
    true = centroid(image)[0] - probe.x_hat_px
    assert got.u_x_px == pytest.approx(np.std(true), rel=0.1) and got.u_x_px > 0.002
    assert SOURCE.propagate(HdrGain(switch_dn=200.0, mismatch_rel=0.1), probe).u_x_px == 0
