"""Quantum efficiency: a factor and a change of kind, and its reading from the photon transfer."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.observations import Observations
from pixmetry.core.signal import Kind
from pixmetry.sensor.quantum_efficiency import SOURCE
from source_signals import fitted, signal, stream


def test_photons_become_electrons():
    photons = np.random.default_rng().uniform(0, 1e5, (2, 5, 7)).astype(np.float32)
    out = SOURCE.forward(SOURCE.make({"quantum_efficiency": 0.25}), signal(photons, Kind.PHOTONS), stream())
    assert out.kind is Kind.ELECTRONS
    assert np.array_equal(out.data, photons / 4)


@pytest.mark.parametrize("value", [0.0, -0.1, 1.01])
def test_impossible_values_are_refused(value):
    with pytest.raises(InputError):
        SOURCE.make({"quantum_efficiency": value})


def test_measured_value_comes_with_its_uncertainty():
    got = SOURCE.measure(
        Observations(photon_transfer_fit=fitted(quantum_efficiency=(0.45, 0.01, "1"), gain_dn_per_e=(0.28, 0.001, "DN/e-")))
    )
    assert (got.names, got["quantum_efficiency"].value, got["quantum_efficiency"].u) == (("quantum_efficiency",), 0.45, pytest.approx(0.01))


def test_without_photon_counts_it_says_what_is_missing():
    with pytest.raises(MeasureError, match="photons per pixel"):
        SOURCE.measure(Observations(photon_transfer_fit=fitted(gain_dn_per_e=(0.28, 0.001, "DN/e-"))))
