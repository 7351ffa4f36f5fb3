"""Vignetting: cos⁴, the common area of two circles by counting, and the pull on a target."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.signal import Kind
from pixmetry.sources.optics.vignetting import SOURCE, Vignetting, factor, overlap
from source_signals import centroid, centroid_probe, flat, signal, spots, stream

SHAPE = (101, 201)


def test_natural_vignetting_is_the_fourth_power_of_the_cosine(rng: np.random.Generator):
    params = Vignetting(cos_power=4, principal_distance_mm=1.0, pitch_x_um=10, pitch_y_um=5)
    light = SOURCE.forward(params, flat(1.0, SHAPE, kind=Kind.PHOTONS), stream(rng)).data[0]
    assert light[50, 100] == 1
    assert light[50, 200] == pytest.approx(np.cos(np.pi / 4) ** 4)
    assert light[100, 100] == pytest.approx(np.cos(np.arctan(0.25)) ** 4)


def test_mechanical_vignetting_is_what_two_openings_have_in_common():
    """Counted on a raster of 2000 × 2000 points."""
    x, y = np.meshgrid(np.linspace(-1, 1, 2000), np.linspace(-1, 1, 2000))
    for shift in (0.0, 0.2, 0.5, 0.9, 1.0):
        common = ((x - shift) ** 2 + y**2 < 1) & ((x + shift) ** 2 + y**2 < 1)
        assert overlap(np.array(shift)) == pytest.approx(common.sum() / (x**2 + y**2 < 1).sum(), abs=2e-3)


def test_the_shift_in_the_corner_is_the_parameter(rng: np.random.Generator):
    params = Vignetting(pupil_shift_rel=0.3, pitch_x_um=8.6, pitch_y_um=8.3)
    light = SOURCE.forward(params, flat(1.0, SHAPE, kind=Kind.PHOTONS), stream(rng)).data[0]
    assert light[0, 0] == pytest.approx(float(overlap(np.array(0.3))), rel=1e-6)


def test_correction_undoes_it(rng: np.random.Generator):
    frame = signal(rng.uniform(100, 1000, (2, *SHAPE)), Kind.PHOTONS)
    back = SOURCE.correct(SOURCE.bound, SOURCE.forward(SOURCE.bound, frame, stream(rng)), {})
    assert np.allclose(back.data, frame.data, rtol=1e-5)


def test_propagation_is_what_a_gaussian_spot_feels():
    """A ramp g moves a Gaussian spot by g σ²; over the frame here by placing spots."""
    params = Vignetting(cos_power=4, principal_distance_mm=2.0, pupil_shift_rel=0.4)
    shape, sigma = (300, 400), 2.0
    rng = np.random.default_rng(5)
    x0, y0 = rng.integers(12, 400 - 13, 400), rng.integers(12, 300 - 13, 400)
    tiles = spots(np.full(400, 12.0), np.full(400, 12.0), sigma=sigma)
    cols, rows = x0[:, None, None] + np.arange(-12, 13), y0[:, None, None] + np.arange(-12, 13)[:, None]
    dx, dy = (c - 12 for c in centroid(tiles * factor(params, cols, rows, shape)))
    probe = centroid_probe(tiles[:1], np.array([12.0]), np.array([12.0]), shape)
    predicted = SOURCE.propagate(params, probe)
    assert predicted.u_x_px == pytest.approx(dx.std(), rel=0.2)
    assert predicted.u_y_px == pytest.approx(dy.std(), rel=0.2)
