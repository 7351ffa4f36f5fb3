"""The threshold's S-curve against the Fourier series of a hard-thresholded Gaussian."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.contribution import Probe
from pixmetry.sources.processing.threshold import SOURCE
from source_signals import centroid_probe, spots


def hard_threshold_probe(sigma: float, threshold: float, n: int) -> Probe:
    """A column of light whose centroid keeps the grey values above the threshold, at n phases along x."""
    x = 12 + np.arange(n) / n - 0.5
    image = spots(x, np.full(n, 12.0), sigma=sigma)[:, 12:13, :]
    kept = np.where(image > threshold, image, 0.0)
    probe = centroid_probe(kept, x, np.zeros(n))
    return type(probe)(**{**probe.__dict__, "signal_dn": image})


def test_s_curve_is_its_fourier_series():
    """e(c) = −2 Σ S_k sin(2πkc)/∫h with S_k = ∫ x h(x) sin(2πkx) dx, integrated here on a fine raster, to k = 300."""
    sigma, threshold, n = 0.9, 30.0, 40
    got = SOURCE.propagate(SOURCE.typical, hard_threshold_probe(sigma, threshold, n))
    edge = sigma * np.sqrt(2 * np.log(150 / threshold))
    fine = np.linspace(-edge, edge, 20_001)
    h = 150 * np.exp(-0.5 * (fine / sigma) ** 2)
    # the centroid is a ratio of two sums over pixels, each with its own Poisson series in the phase c
    phases = np.arange(n) / n - 0.5
    top, bottom = np.zeros(n), np.full(n, np.trapezoid(h, fine))
    for k in range(1, 301):
        c, s = np.cos(2 * np.pi * k * fine), np.sin(2 * np.pi * k * fine)
        top -= 2 * np.trapezoid(fine * h * s, fine) * np.sin(2 * np.pi * k * phases)
        bottom += 2 * np.trapezoid(h * c, fine) * np.cos(2 * np.pi * k * phases)
    series = top / bottom
    assert got.u_x_px == pytest.approx(np.std(series), rel=0.03)
    assert got.u_x_px > 0.01


def test_smooth_targets_have_none():
    """A Gaussian of 1 px without a threshold: its spectrum at one cycle per pixel is e^(−2π²) of its mean."""
    got = SOURCE.propagate(SOURCE.typical, hard_threshold_probe(1.0, 0.0, 16))
    assert got.u_x_px < 1e-6 and abs(got.bias_x_px) < 1e-6


def test_it_has_no_place_on_the_frame():
    assert SOURCE.verbs == {"forward": False, "measure": False, "correct": False, "propagate": True}
    assert "estimator" in SOURCE.reasons["forward"]
