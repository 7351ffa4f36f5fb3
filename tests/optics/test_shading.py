"""Shading: the paraboloid in closed form, its round trip, its blind measurement and the shift of a Gaussian spot."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.core.errors import MeasureError
from pixmetry.core.observations import Observations
from pixmetry.core.signal import Kind
from pixmetry.experiment.spatial_fit import fit_spatial
from pixmetry.experiment.stack import StackAccumulator
from pixmetry.optics.shading import SOURCE, Shading
from source_signals import K_DN_PER_E, centroid, flat, signal, spot_probe, spots, stream

SHAPE = (41, 61)


def test_shape_of_the_light():
    """Mean 1, gradient at the centre, loss from centre to corner, all read off a flat frame."""
    params = Shading(gradient_x_per_px=1e-3, gradient_y_per_px=-2e-3, corner_rel=0.3)
    light = SOURCE.forward(params, flat(1.0, SHAPE, kind=Kind.PHOTONS), stream()).data[0].astype(float)
    assert light.mean() == pytest.approx(1, abs=1e-6)
    assert (light[20, 31] - light[20, 29]) / 2 == pytest.approx(1e-3, abs=1e-6)
    assert (light[21, 30] - light[19, 30]) / 2 == pytest.approx(-2e-3, abs=1e-6)
    corners = light[[0, 0, -1, -1], [0, -1, 0, -1]].mean()
    assert light[20, 30] - corners == pytest.approx(0.3, abs=1e-6)


def test_correction_undoes_it():
    rng = np.random.default_rng()
    frame = signal(rng.uniform(100, 1000, (2, *SHAPE)), Kind.PHOTONS)
    shaded = SOURCE.forward(SOURCE.bound, frame, stream())
    assert np.allclose(SOURCE.correct(SOURCE.bound, shaded, {}).data, frame.data, rtol=1e-5)


def test_light_never_falls_below_zero():
    light = SOURCE.forward(Shading(gradient_x_per_px=0.1), flat(1.0, SHAPE, kind=Kind.PHOTONS), stream())
    assert light.data.min() > 0


def test_gradient_is_measured_blind():
    """Stacks of shaded frames with noise: within 5.5 u (t law, 50 degrees of freedom, 1e-6); u is below a hundredth of the gradient."""
    rng = np.random.default_rng()
    params = Shading(gradient_x_per_px=1e-3, gradient_y_per_px=-6e-4, corner_rel=0.3)
    shape = (96, 128)
    light = SOURCE.forward(params, flat(1000.0, shape, kind=Kind.PHOTONS), stream()).data[0]
    stacks = []
    for mean in (np.full(shape, 50.0), 50 + light):
        accumulator = StackAccumulator(12)
        for _ in range(8):
            accumulator.add(np.rint(mean + rng.normal(0, 3, shape)).astype(np.uint16))
        stacks.append(accumulator.result(0.01))
    got = SOURCE.measure(Observations(spatial_fit=fit_spatial(*stacks)))
    for name, value in (("gradient_x_per_px", 1e-3), ("gradient_y_per_px", -6e-4)):
        assert abs(got[name].value - value) < 5.5 * got[name].u
        assert got[name].u < 0.01 * abs(value)


def test_without_a_stack_it_says_what_to_take():
    with pytest.raises(MeasureError, match="at least 16"):
        SOURCE.measure(Observations())


def test_spot_at_the_centre_moves_by_gradient_times_variance():
    """P3: a Gaussian spot of variance σ² under a relative ramp g moves by exactly gσ²."""
    params = Shading(gradient_x_per_px=2e-3, gradient_y_per_px=-1e-3)
    x, y = np.array([12.0]), np.array([12.0])
    frame = signal(spots(x, y) / K_DN_PER_E, Kind.PHOTONS, row0=228, col0=308, frame_shape=(481, 641))
    after = centroid(SOURCE.forward(params, frame, stream()).data.astype(float))
    assert after[0][0] - 12 == pytest.approx(2e-3 * 4, rel=1e-3)
    assert after[1][0] - 12 == pytest.approx(-1e-3 * 4, rel=1e-3)


def test_mean_shift_over_the_frame_in_closed_form():
    """The mean of g/(1 + g x) over a frame of n pixels is ln((1 + a)/(1 − a))/n with a = g n/2."""
    g, n = 1e-3, 640
    got = SOURCE.propagate(Shading(gradient_x_per_px=g), spot_probe(sigma=2.0))
    a = g * n / 2
    assert got.bias_x_px == pytest.approx(4 * np.log((1 + a) / (1 - a)) / n, rel=2e-3)
    assert got.bias_y_px == pytest.approx(0, abs=1e-9)


def test_spread_over_the_frame_is_that_of_random_places():
    """The quadratic part alone: standard deviation of the true shift over 2000 places.

    A uniform slope has a kurtosis of 1.8, so the standard deviation found scatters by √(0.2/2000) = 1 %: 5 % at 1e-6. The window keeps
    the targets 12 px from the edge, which takes 25 px off the range.
    """
    params, shape = Shading(corner_rel=0.1), (480, 640)
    got = SOURCE.propagate(params, spot_probe(sigma=2.0))
    rng = np.random.default_rng()
    shifts = []
    for _ in range(2000):
        row0, col0 = rng.integers(0, shape[0] - 25), rng.integers(0, shape[1] - 25)
        x, y = np.array([12.0]), np.array([12.0])
        frame = signal(spots(x, y), Kind.PHOTONS, row0=row0, col0=col0, frame_shape=shape)
        after = centroid(SOURCE.forward(params, frame, stream(1)).data.astype(float))
        shifts.append([after[0][0] - 12, after[1][0] - 12])
    found = np.std(shifts, axis=0)
    assert got.u_x_px * (640 - 25) / 640 == pytest.approx(found[0], rel=0.06)
    assert got.u_y_px * (480 - 25) / 480 == pytest.approx(found[1], rel=0.06)
