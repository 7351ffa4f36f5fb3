"""Charge injection: the size of reset noise, what double sampling leaves of it, and the clock's pattern."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pixmetry.sources.sensor.charge_injection import SOURCE, ChargeInjection, feed_through_e, noise_e
from source_signals import Z, centroid_probe, flat, spots, stream


def test_forty_electrons_on_ten_femtofarad_at_300_kelvin():
    assert noise_e(ChargeInjection(node_ff=10.0), 26.85) == pytest.approx(40.2, abs=0.05)
    assert noise_e(ChargeInjection(node_ff=40.0), 26.85) == pytest.approx(2 * noise_e(ChargeInjection(node_ff=10.0), 26.85))
    assert noise_e(ChargeInjection(node_ff=10.0), -198.15) == pytest.approx(noise_e(ChargeInjection(node_ff=10.0), 26.85) / 2)


@pytest.mark.parametrize(("cds", "sigma"), [(False, math.hypot(40.165, 30)), (True, 30 * math.sqrt(2))])
def test_double_sampling_takes_the_reset_off_and_doubles_the_rest(cds, sigma, rng: np.random.Generator):
    """Variance at 1e-6 over 500 000 pixels; catches 1 % of it (kTC at 26.46 °C: 40.165 e-)."""
    params = ChargeInjection(node_ff=10.0, injection_std_e=30.0, cds=cds)
    out = SOURCE.forward(params, flat(1000.0, (500, 500), n=2, temperature_c=26.46), stream(rng)).data.astype(float) - 1000
    assert abs(out.var() / sigma**2 - 1) < Z * math.sqrt(2 / out.size) + 2e-4
    assert abs(out.mean()) < Z * sigma / math.sqrt(out.size)
    a, b = out
    assert abs((a * b).mean()) < Z * sigma**2 / math.sqrt(a.size)  # new in every frame


def test_pattern_is_that_of_a_settling_edge_sampled_once_a_column(rng: np.random.Generator):
    """Against the transient itself on a fine time axis: the sample at the end of each column minus, with CDS, half a column before."""
    for cds in (False, True):
        params = ChargeInjection(spike_e=100.0, spike_period_px=4, settling_px=1.5, cds=cds)
        time = np.arange(0, 40, 0.25)
        transient = -100 * np.exp(-(time % 4) / 1.5)
        at = np.arange(4, 36)
        later = transient[np.searchsorted(time, at + (0.5 if cds else 0.0))]
        expected = later - (transient[np.searchsorted(time, at)] if cds else 0)
        assert feed_through_e(params, at) == pytest.approx(expected, rel=1e-12)
        out = SOURCE.forward(params, flat(0.0, (3, 36), n=2), stream(rng)).data
        assert out[:, :, 4:] == pytest.approx(np.broadcast_to(feed_through_e(params, at), (2, 3, 32)), rel=1e-6)


def test_pattern_is_told(rng: np.random.Generator):
    params = ChargeInjection(spike_e=50.0)
    told = SOURCE.truth(params, flat(0.0, (4, 8)), stream(rng))
    assert told["feed_through_e"] == pytest.approx(SOURCE.forward(params, flat(0.0, (4, 8)), stream(rng)).data[0, 0])


def test_shift_is_that_of_white_noise():
    """u = σ √Σ(x − x̂)² / S in closed form: Σx² over a window of n × n pixels about its centre is n²(n² − 1)/12."""
    middle, total, n = np.array([12.0]), 150 * 2 * math.pi * 4, 25
    got = SOURCE.propagate(ChargeInjection(node_ff=10.0), centroid_probe(spots(middle, middle), middle, middle))
    sigma = 0.01 * 40.165 * math.sqrt(293.15 / 299.61)  # in DN at 20 °C
    assert got.u_x_px == pytest.approx(sigma * math.sqrt(n**2 * (n**2 - 1) / 12) / total, rel=1e-3)
    assert got.gum_class == "T"
