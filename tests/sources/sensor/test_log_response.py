"""Logarithmic response: millivolts a decade, the knee, the spread of the pixels and its truth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pixmetry.camera.signal import Kind
from pixmetry.sources.sensor.log_response import SOURCE, LogResponse
from source_signals import Z, flat, signal, stream


def answer(rng: np.random.Generator, params: LogResponse, electrons, **kw) -> np.ndarray:
    out = SOURCE.forward(params, signal(np.reshape(electrons, (1, 1, -1)), **kw), stream(rng))
    assert out.kind is Kind.DN
    return out.data[0, 0].astype(float)


@pytest.mark.parametrize(("temperature_c", "factor", "mv"), [(26.85, 1.0, 59.53), (26.85, 1.3, 77.4), (-73.15, 1.0, 39.68)])
def test_millivolts_a_decade(temperature_c, factor, mv, rng: np.random.Generator):
    """kT/q ln 10 is 59.5 mV at 300 K: far above the foot every decade of light adds as much."""
    y = answer(rng, LogResponse(gain_dn_per_v=1000.0, slope_factor=factor, foot_e=1.0), [1e4, 1e5, 1e6], temperature_c=temperature_c)
    assert np.diff(y) == pytest.approx([mv, mv], rel=1e-3)


def test_foot_and_knee(rng: np.random.Generator):
    """At x = c the logarithm has risen by ln 2; with a knee the response is straight up to it and has no step in value or slope."""
    b = 1000 * 8.617333e-5 * 293.15
    assert answer(rng, LogResponse(foot_e=500.0, offset_dn=20.0), [0, 500, -30]) == pytest.approx([20, 20 + b * math.log(2), 20], rel=1e-6)
    x = np.array([0, 1000, 2000, 2999, 3000, 3001, 1e5])
    y = answer(rng, LogResponse(mode="lin-log", foot_e=1000.0, knee_e=3000.0), x)
    assert y[1:5] == pytest.approx(b * x[1:5] / 1000, rel=1e-6)
    assert y[5] - y[4] == pytest.approx(y[4] - y[3], rel=5e-2)
    assert y[6] == pytest.approx(b * (3 + math.log(98)), rel=1e-6)


def test_a_percent_of_a_decade_in_the_offset_is_2_3_percent_of_light(rng: np.random.Generator):
    """Inverted with the mean response, the spread of a by 1 % of a decade scatters ln x by 0.01 ln 10, at 1e-6; catches 2 % of it."""
    decade = 1000 * 8.617333e-5 * 293.15 * math.log(10)
    params = LogResponse(foot_e=1.0, offset_std_dn=0.01 * decade)
    y = SOURCE.forward(params, flat(1e5, (400, 400)), stream(rng)).data.astype(float)
    log_light = y / decade * math.log(10)
    assert abs(log_light.std() / (0.01 * math.log(10)) - 1) < Z / math.sqrt(2 * y.size) + 1e-3
    assert math.expm1(0.03 * math.log(10)) == pytest.approx(0.07, abs=0.002)


def test_told_pixels_invert_the_response(rng: np.random.Generator):
    params, one = LogResponse(foot_e=200.0, offset_std_dn=3.0, slope_std_rel=0.02, foot_std_rel=0.1), stream(rng)
    electrons = rng.uniform(100, 50_000, (3, 20, 30)).astype(np.float32)
    frames = signal(electrons)
    out = SOURCE.forward(params, frames, one).data.astype(float)
    told = SOURCE.truth(params, frames, one)
    assert told["c_e"] * np.expm1((out - told["a_dn"]) / told["b_dn"]) == pytest.approx(electrons, rel=2e-4)
    assert told["a_dn"].std() > 1 and told["b_dn"].std() > 0.1 and told["c_e"].std() > 5


def test_its_own_noise_is_alike_at_all_levels_and_new_in_every_frame(rng: np.random.Generator):
    """160 000 numbers each know the standard deviation to 0.18 %; a factor of 1.01 would be seen."""
    params = LogResponse(foot_e=200.0, noise_dn=0.3)
    for level in (0.0, 1e5):
        y = SOURCE.forward(params, flat(level, (400, 400), n=2), stream(rng)).data.astype(float)
        assert y[0].std() == pytest.approx(0.3, rel=Z / math.sqrt(2 * 160_000))
        assert abs(np.corrcoef(y[0].ravel(), y[1].ravel())[0, 1]) < Z / 400
