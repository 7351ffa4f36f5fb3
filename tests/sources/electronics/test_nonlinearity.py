"""Non-linearity: the polynomial, refusal of one that falls, its exact inverse, and the S-curve that it makes."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.sources.electronics.nonlinearity import SOURCE, Nonlinearity
from source_signals import centroid, centroid_probe, fitted, signal, spot_probe, spots, stream

BENT = Nonlinearity(a1=-0.05, a2=0.08, a3=-0.1, reference_dn=1000.0)


def test_is_the_polynomial_of_the_joint_fit(rng: np.random.Generator):
    x = rng.uniform(-100, 1200, (1, 30, 40)).astype(np.float32)
    out = SOURCE.forward(BENT, signal(x, Kind.DN), stream(rng)).data
    w = x.astype(float) / 1000
    assert np.allclose(out, x * (1 - 0.05 * w + 0.08 * w**2 - 0.1 * w**3), rtol=2e-6, atol=1e-4)


def test_rises_far_beyond_its_range(rng: np.random.Generator):
    x = np.linspace(-2000, 5000, 70_001, dtype=np.float64)[None, None]
    out = SOURCE.forward(BENT, signal(x, Kind.DN), stream(rng)).data[0, 0].astype(float)
    assert (np.diff(out) > 0).all()


@pytest.mark.parametrize("values", [{"a1": -0.6}, {"a2": -0.22}, {"a3": -0.13}, {"a1": 0.9, "a2": -0.9}, {"reference_dn": -1}])
def test_a_response_that_falls_is_refused(values):
    with pytest.raises(InputError):
        SOURCE.make(values)


@pytest.mark.parametrize("values", [{"a1": -0.39}, {"a2": -0.21}, {"a3": -0.127}])
def test_one_that_still_rises_up_to_its_end_is_taken(values):
    """The slope 1 + 2a₁w, 1 + 3a₂w², 1 + 4a₃w³ reaches zero at w = 1.25 for a = −0.4, −0.2133, −0.128."""
    assert SOURCE.make(values)


def test_inverse_is_exact(rng: np.random.Generator):
    x = rng.uniform(-500, 2500, (2, 50, 60))
    frame = signal(x, Kind.DN)
    back = SOURCE.correct(BENT, SOURCE.forward(BENT, frame, stream(rng)), {})
    assert np.abs(back.data - frame.data).max() < 2e-3  # a few steps of float32 at 2500 DN
    assert back.data.dtype == np.float32


def test_symmetric_targets_have_an_s_curve_and_no_bias(rng: np.random.Generator):
    """Against the centroid of bent spots at 16 phases: the first order differs by the factor S/S′, and its mean over the phases is 0."""
    params = Nonlinearity(a1=-0.1, a3=-0.06, reference_dn=200.0)
    x = 12 + np.linspace(-0.5, 0.5, 16, endpoint=False)
    y = np.full(16, 12.0)
    image = spots(x, y, sigma=0.45)
    probe = centroid_probe(image, x, y)
    got = SOURCE.propagate(params, probe)
    bent = SOURCE.forward(params, signal(image, Kind.DN), stream(rng)).data.astype(float)
    true = centroid(bent)[0] - centroid(image)[0]
    weight = bent.sum(axis=(1, 2)) / image.sum(axis=(1, 2))
    assert got.u_x_px == pytest.approx(np.std(true * weight), rel=1e-3)
    assert got.u_x_px > 5e-4
    assert abs(got.bias_x_px) < 1e-6
    assert got.u_y_px < 1e-6


def test_wide_targets_do_not_move():
    assert SOURCE.propagate(SOURCE.bound, spot_probe(sigma=2.0)).total_px < 1e-5


def test_measured_from_the_joint_fit():
    fit = fitted(nonlinearity_a1=(0.01, 0.001, "1"), nonlinearity_a2=(0.02, 0.002, "1"), nonlinearity_a3=(-0.03, 0.003, "1"))
    got = SOURCE.measure(Observations(photon_transfer_fit=fit))
    assert (got.names, list(got.values)) == (("a1", "a2", "a3"), [0.01, 0.02, -0.03])
    with pytest.raises(MeasureError, match="light levels"):
        SOURCE.measure(Observations())
