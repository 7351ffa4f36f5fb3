"""Quantum efficiency: a factor and a change of kind, and its reading from the photon transfer."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind
from pixmetry.camera.silicon import absorption_per_cm
from pixmetry.core.errors import InputError, MeasureError, ParameterError
from pixmetry.sources.sensor.quantum_efficiency import SOURCE, QuantumEfficiency, efficiency, spectral_efficiency
from source_signals import fitted, signal, stream


def test_photons_become_electrons(rng: np.random.Generator):
    photons = rng.uniform(0, 1e5, (2, 5, 7)).astype(np.float32)
    out = SOURCE.forward(SOURCE.make({"quantum_efficiency": 0.25}), signal(photons, Kind.PHOTONS), stream(rng))
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


@pytest.mark.parametrize(("wavelength_nm", "per_cm"), [(400, 9.30e4), (550, 6.39e3), (600, 4.17e3), (800, 850), (1000, 64), (1100, 3.5)])
def test_absorption_of_silicon(wavelength_nm, per_cm):
    """Published coefficients at 300 K (Green 2008), 550 nm between the rows of the table."""
    assert absorption_per_cm(wavelength_nm) == pytest.approx(per_cm, rel=0.01)


def test_no_absorption_is_made_up_beyond_the_table():
    with pytest.raises(ParameterError, match="1200"):
        absorption_per_cm(np.array([500.0, 1300.0]))


def test_light_absorbed_layer_by_layer(rng: np.random.Generator):
    """Against photons walked down through thin layers of silicon."""
    params = QuantumEfficiency(model="silicon", wavelength_nm=700, depth_um=8.0, dead_layer_um=0.5, reflectance=0.1, collected=0.9)
    alive, caught, step = 0.9, 0.0, 1e-3
    for k in range(8500):
        stopped = alive * 1.89e3 * 1e-4 * step
        alive -= stopped
        caught += 0.9 * stopped * (k >= 500)
    assert efficiency(params) == pytest.approx(caught, rel=1e-3)
    out = SOURCE.forward(params, signal(np.full((1, 2, 2), 1000.0), Kind.PHOTONS), stream(rng))
    assert out.data == pytest.approx(1000 * efficiency(params)) and out.kind is Kind.ELECTRONS


def test_band_is_the_mean_over_its_wavelengths():
    params = QuantumEfficiency(model="silicon", wavelength_nm=600, bandwidth_nm=400)
    fine = np.arange(400.5, 800, 1.0)
    assert efficiency(params) == pytest.approx(spectral_efficiency(params, fine).mean(), rel=2e-4)


def test_blue_is_lost_in_the_dead_layer_and_infrared_goes_through():
    """Amperes per watt, η λ, peak in the red to near infrared, blue is weaker than red, nothing is left at 1100 nm."""
    params = QuantumEfficiency(model="silicon", depth_um=10.0, dead_layer_um=0.2)
    wavelength = np.arange(400.0, 1101, 5)
    watt = spectral_efficiency(params, wavelength) * wavelength
    assert 650 < wavelength[watt.argmax()] < 800
    eta = dict(zip(wavelength, spectral_efficiency(params, wavelength), strict=True))
    assert eta[450.0] < eta[600.0] and eta[1100.0] < 0.01 * eta[600.0]
