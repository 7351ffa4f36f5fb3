"""Conversion gain: a factor and a change of kind; blind recovery from variance against mean."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.sources.electronics.gain import SOURCE
from pixmetry.sources.sensor.shot_noise import SOURCE as SHOT
from source_signals import Z, fitted, flat, signal, stream


def test_electrons_become_dn(rng: np.random.Generator):
    electrons = rng.uniform(-50, 1e5, (2, 5, 7)).astype(np.float32)
    out = SOURCE.forward(SOURCE.make({"gain_dn_per_e": 0.125}), signal(electrons), stream(rng))
    assert out.kind is Kind.DN
    assert np.array_equal(out.data, electrons / 8)


def test_variance_over_mean_is_the_gain(rng: np.random.Generator):
    """The photon-transfer law σ² = K µ at 1e-6; an error of 1.5 % of the gain would be caught."""
    electrons = SHOT.forward(SHOT.typical, flat(1000.0, (500, 500)), stream(rng))
    dn = SOURCE.forward(SOURCE.make({"gain_dn_per_e": 0.03}), electrons, stream(rng)).data.astype(float)
    assert abs(dn.var() / dn.mean() / 0.03 - 1) < Z * np.sqrt(2 / dn.size)


def test_measured_from_the_photon_transfer():
    got = SOURCE.measure(Observations(photon_transfer_fit=fitted(gain_dn_per_e=(0.28, 0.002, "DN/e-"))))["gain_dn_per_e"]
    assert (got.value, got.u, got.unit) == (0.28, pytest.approx(0.002), "DN/e-")
    with pytest.raises(MeasureError, match="photon-transfer"):
        SOURCE.measure(Observations())


def test_no_gain_is_refused():
    with pytest.raises(InputError):
        SOURCE.make({"gain_dn_per_e": 0.0})
