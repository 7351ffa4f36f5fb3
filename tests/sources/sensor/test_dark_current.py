"""Dark current: exposure time and temperature, its shot noise, and what it does to a centroid."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import MeasureError
from pixmetry.sources.sensor.dark_current import SOURCE, DarkCurrent, mean_e, warming
from pixmetry.sources.sensor.shot_noise import SOURCE as SHOT
from source_signals import K_DN_PER_E, Z, fitted, flat, spot_probe, stream


def test_doubles_every_eight_kelvin_and_grows_with_time(rng: np.random.Generator):
    params = DarkCurrent(rate_e_per_s=100.0)
    frames = flat(10.0, (2, 3), n=4, exposure_s=[1.0, 2.0, 1.0, 1.0], temperature_c=[20.0, 20.0, 28.0, 12.0])
    out = SOURCE.forward(params, frames, stream(rng)).data
    assert out[:, 0, 0] == pytest.approx([110, 210, 210, 60])
    assert (out == out[:, :1, :1]).all()


def test_doubling_is_an_activation_energy():
    """Against exp(−E/kT) with E = k T (T + 8 K) ln 2 / 8 K at 20 °C: the same over the first step of 8 K."""
    k, t = 8.617333e-5, 293.15
    energy = k * t * (t + 8) * math.log(2) / 8
    assert energy == pytest.approx(0.66, abs=0.005)
    assert mean_e(DarkCurrent(rate_e_per_s=1.0), 1.0, 28.0) == pytest.approx(math.exp(-energy / k * (1 / (t + 8) - 1 / t)), rel=1e-9)


def test_its_noise_is_poisson(rng: np.random.Generator):
    """Mean and variance after the shot noise both equal the dark electrons, at 1e-6; an error of 1 % of the mean would be caught."""
    params, shape = DarkCurrent(rate_e_per_s=40.0), (500, 500)
    dark = SHOT.forward(SHOT.typical, SOURCE.forward(params, flat(0.0, shape, exposure_s=1.0), stream(rng)), stream(rng)).data.astype(float)
    n = dark.size
    assert abs(dark.mean() - 40) < Z * math.sqrt(40 / n)
    assert abs(dark.var() - 40) < Z * math.sqrt((2 * 40**2 + 40) / n)  # fourth central moment of Poisson: 3µ² + µ


def test_measured_rate_states_its_temperature():
    transfer = fitted(dark_current_e_per_s=(12.0, 0.5, "e-/s"))
    got = SOURCE.measure(Observations(photon_transfer_fit=transfer, temperature_c=31.0))["rate_e_per_s"]
    assert (got.value, got.u) == (12.0, pytest.approx(0.5))
    assert "31 °C" in got.reason
    with pytest.raises(MeasureError, match="several exposure times"):
        SOURCE.measure(Observations(photon_transfer_fit=fitted(gain_dn_per_e=(0.1, 0.01, "DN/e-"))))


def test_shift_is_that_of_white_noise():
    """u = σ √Σ(x − x̂)² / S in closed form: Σx² over a window of n × n pixels about its centre is n²(n² − 1)/12."""
    probe = spot_probe(n=1)
    x0 = probe.x_hat_px[0]
    got = SOURCE.propagate(DarkCurrent(rate_e_per_s=400.0), probe)
    sigma, total, n = K_DN_PER_E * math.sqrt(400 * 0.01), 150 * 2 * math.pi * 4, 25
    assert got.u_x_px == pytest.approx(sigma * math.sqrt(n**2 * (n**2 - 1) / 12 + n**2 * (x0 - 12) ** 2) / total, rel=1e-3)
    assert got.bias_x_px == 0.0  # the pedestal comes off with the background


def test_electrons_stay_electrons(rng: np.random.Generator):
    assert SOURCE.forward(SOURCE.typical, flat(1.0, (2, 2)), stream(rng)).kind is Kind.ELECTRONS
    assert np.array_equal(SOURCE.forward(SOURCE.neutral, flat(7.0, (2, 2)), stream(rng)).data, np.full((1, 2, 2), 7, np.float32))


def test_half_the_gap_doubles_in_nine_and_a_half_kelvin():
    """Rise of temperature that doubles it at 20 °C: 9.46 K by E_g/2 alone, 8.84 K with T^1.5, by bisection of the formula itself."""
    k, t = 8.617333e-5, 293.15
    for power, expected in ((0.0, 9.46), (1.5, 8.84)):
        low, high = 1.0, 30.0
        for _ in range(60):
            rise = (low + high) / 2
            grown = ((t + rise) / t) ** power * math.exp(1.12 / (2 * k) * (1 / t - 1 / (t + rise)))
            low, high = (rise, high) if grown < 2 else (low, rise)
        assert rise == pytest.approx(expected, abs=0.03)
    assert warming(DarkCurrent(law="gap"), 20.0 + rise) == pytest.approx(2, rel=1e-4)
    assert warming(DarkCurrent(law="gap", gap_ev=1.2), 20.0 + rise) > 2.08


def test_spread_of_the_rates_is_log_normal_about_the_same_mean(rng: np.random.Generator):
    """Kolmogorov–Smirnov of the logarithm and the mean rate, 1e-6 each; catches 2 % of the mean. The Poisson draw comes after it."""
    from scipy import stats

    params, one = DarkCurrent(rate_e_per_s=50.0, spread_log=0.6), stream(rng)
    frames = flat(0.0, (500, 500), n=2, exposure_s=2.0)
    out = SOURCE.forward(params, frames, one).data.astype(float)
    assert np.array_equal(out[0], out[1])
    assert abs(out[0].mean() / 100 - 1) < Z * math.sqrt(math.expm1(0.36) / out[0].size) + 1e-6
    assert stats.kstest((np.log(out[0].ravel() / 100) + 0.18) / 0.6, "norm").pvalue > 1e-6
    drawn = SHOT.forward(SHOT.typical, SOURCE.forward(params, frames, one), stream(rng)).data.astype(float)
    pair = ((drawn[1] - drawn[0]) ** 2).mean() / 2  # temporal variance is the mean, fixed pattern is not in it
    assert abs(pair / out[0].mean() - 1) < Z * math.sqrt((2 + 3 * math.exp(0.36)) / out[0].size)
    assert SOURCE.truth(params, frames, one)["dark_current_e_per_s"] == pytest.approx(out[0] / 2, rel=1e-5)


def test_glow_falls_off_from_its_corner_and_grows_with_time_alone(rng: np.random.Generator):
    params = DarkCurrent(glow_e_per_s=100.0, glow_reach_px=10.0, glow_corner="bottom right")
    out = SOURCE.forward(params, flat(0.0, (30, 40), n=2, exposure_s=[1.0, 3.0], temperature_c=[20.0, 60.0]), stream(rng)).data
    assert out[0, 29, 39] == pytest.approx(100) and out[0, 26, 35] == pytest.approx(100 * math.exp(-0.5))
    assert out[1] == pytest.approx(3 * out[0])
