"""Amplifier noise: its law, its independence from frame to frame, and the shift of a centroid in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from pixmetry.camera.observations import Observations
from pixmetry.core.errors import MeasureError
from pixmetry.sources.electronics.amplifier_noise import SOURCE, AmplifierNoise
from source_signals import ALPHA, K_DN_PER_E, Z, fitted, flat, spot_probe, stream


def test_normal_with_the_given_standard_deviation(rng: np.random.Generator):
    """Kolmogorov–Smirnov at 1e-6 over 200 000 pixels; an error of 2 % of σ, or a mean of 0.01 σ, would be caught."""
    out = SOURCE.forward(AmplifierNoise(white_e=12.0), flat(100.0, (400, 500)), stream(rng)).data.astype(float)
    assert stats.kstest((out.ravel() - 100) / 12, "norm").pvalue > ALPHA


def test_frames_are_independent(rng: np.random.Generator):
    """Correlation of two frames is 0 ± 1/√n, at 1e-6; 0.011 would be caught."""
    out = SOURCE.forward(AmplifierNoise(white_e=12.0), flat(0.0, (400, 500), n=2), stream(rng)).data.astype(float)
    assert abs(np.corrcoef(out[0].ravel(), out[1].ravel())[0, 1]) < Z / math.sqrt(out[0].size)


def test_shift_of_a_centroid():
    """u = σ √Σ(x − x̂)²/S: over a window of n × n pixels Σ(x − x̂)² = n²(n² − 1)/12 + n² (x̂ − x_c)²."""
    probe, n = spot_probe(n=1), 25
    got = SOURCE.propagate(AmplifierNoise(white_e=50.0), probe)
    squares = n**2 * (n**2 - 1) / 12 + n**2 * (probe.x_hat_px[0] - 12) ** 2
    assert got.u_x_px == pytest.approx(50 * K_DN_PER_E * math.sqrt(squares) / probe.signal_dn.sum(), rel=1e-9)


def test_measured_from_dark_frames():
    got = SOURCE.measure(Observations(photon_transfer_fit=fitted(dark_noise_e=(10.9, 0.1, "e-"))))["white_e"]
    assert (got.value, got.u) == (10.9, pytest.approx(0.1))
    with pytest.raises(MeasureError, match="dark"):
        SOURCE.measure(Observations())
