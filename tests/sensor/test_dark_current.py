"""Dark current: exposure time and temperature, its shot noise, and what it does to a centroid."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pixmetry.core.errors import MeasureError
from pixmetry.core.observations import Observations
from pixmetry.core.signal import Kind
from pixmetry.sensor.dark_current import SOURCE, DarkCurrent, mean_e
from pixmetry.sensor.shot_noise import SOURCE as SHOT
from source_signals import K_DN_PER_E, Z, fitted, flat, spot_probe, stream


def test_doubles_every_eight_kelvin_and_grows_with_time():
    params = DarkCurrent(rate_e_per_s=100.0)
    frames = flat(10.0, (2, 3), n=4, exposure_s=[1.0, 2.0, 1.0, 1.0], temperature_c=[20.0, 20.0, 28.0, 12.0])
    out = SOURCE.forward(params, frames, stream()).data
    assert out[:, 0, 0] == pytest.approx([110, 210, 210, 60])
    assert (out == out[:, :1, :1]).all()


def test_doubling_is_an_activation_energy():
    """Against exp(−E/kT) with E = k T (T + 8 K) ln 2 / 8 K at 20 °C: the same over the first step of 8 K."""
    k, t = 8.617333e-5, 293.15
    energy = k * t * (t + 8) * math.log(2) / 8
    assert energy == pytest.approx(0.66, abs=0.005)
    assert mean_e(DarkCurrent(rate_e_per_s=1.0), 1.0, 28.0) == pytest.approx(math.exp(-energy / k * (1 / (t + 8) - 1 / t)), rel=1e-9)


def test_its_noise_is_poisson():
    """Mean and variance after the shot noise both equal the dark electrons, at 1e-6; an error of 1 % of the mean would be caught."""
    params, shape = DarkCurrent(rate_e_per_s=40.0), (500, 500)
    dark = SHOT.forward(SHOT.typical, SOURCE.forward(params, flat(0.0, shape, exposure_s=1.0), stream()), stream()).data.astype(float)
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


def test_electrons_stay_electrons():
    assert SOURCE.forward(SOURCE.typical, flat(1.0, (2, 2)), stream()).kind is Kind.ELECTRONS
    assert np.array_equal(SOURCE.forward(SOURCE.neutral, flat(7.0, (2, 2)), stream()).data, np.full((1, 2, 2), 7, np.float32))
