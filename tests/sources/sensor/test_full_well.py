"""Full well: hard and soft tops in closed form, and the S-curve of a clipped spot."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.observations import Observations
from pixmetry.core.errors import MeasureError
from pixmetry.sources.sensor.full_well import SOURCE, FullWell, response_e
from source_signals import K_DN_PER_E, centroid, fitted, signal, spot_probe, stream


def test_hard_top_is_a_minimum(rng: np.random.Generator):
    data = rng.uniform(0, 40_000, (2, 30, 40)).astype(np.float32)
    out = SOURCE.forward(FullWell(full_well_e=15_000), signal(data), stream(rng)).data
    assert np.array_equal(out, np.where(data > 15_000, np.float32(15_000), data))
    assert out.dtype == np.float32


def test_soft_top_joins_smoothly_and_reaches_the_capacity():
    params = FullWell(full_well_e=10_000, knee_rel=0.2)
    x = np.linspace(0, 40_000, 40_001)
    y = response_e(params, x)
    below = x <= 8000
    assert np.array_equal(y[below], x[below])
    slope = np.diff(y)
    assert (slope >= 0).all() and slope[8000] == pytest.approx(1, abs=1e-3)
    assert y[10_000] == pytest.approx(8000 + 2000 * (1 - np.exp(-1)))
    assert y[-1] == pytest.approx(10_000, abs=0.01) and y.max() <= 10_000


def test_below_the_full_well_nothing_moves():
    got = SOURCE.propagate(FullWell(full_well_e=15_001), spot_probe())
    assert (got.u_x_px, got.bias_x_px, got.u_y_px, got.bias_y_px) == (0, 0, 0, 0)


def test_shift_of_a_clipped_spot():
    """The true shift of a centroid is that of the lost charge over what is left: first order times S/S′, from the clipped image."""
    probe = spot_probe(sigma=0.6, n=32)
    params = FullWell(full_well_e=9000)
    got = SOURCE.propagate(params, probe)
    clipped = np.minimum(probe.signal_dn, 9000 * K_DN_PER_E)
    lost = (probe.signal_dn.sum(axis=(1, 2))) / clipped.sum(axis=(1, 2))
    true = centroid(clipped)[0] - probe.x_hat_px
    assert got.u_x_px == pytest.approx(np.std(true / lost), rel=1e-6)
    assert got.u_x_px > 0.01
    assert abs(got.u_x_px - np.std(true)) < got.model_error * np.std(true)


def test_measured_from_saturation():
    got = SOURCE.measure(Observations(photon_transfer_fit=fitted(full_well_e=(14_000.0, 20.0, "e-"))))
    assert got["full_well_e"].value == 14_000
    with pytest.raises(MeasureError, match="saturation"):
        SOURCE.measure(Observations(photon_transfer_fit=fitted(gain_dn_per_e=(0.28, 0.001, "DN/e-"))))


def test_capacities_differ_by_pixel_and_are_told(rng: np.random.Generator):
    """Spread of the capacities at 1e-6 over 250 000 pixels; catches 1 %."""
    params, one = FullWell(full_well_e=10_000, spread_rel=0.03), stream(rng)
    frames = signal(np.full((2, 500, 500), 1e6))
    out, told = SOURCE.forward(params, frames, one).data, SOURCE.truth(params, frames, one)["full_well_e"]
    assert np.array_equal(out[0], told) and np.array_equal(out[1], told)
    assert abs(told.astype(float).std() / 300 - 1) < 4.8917 / np.sqrt(2 * told.size)
