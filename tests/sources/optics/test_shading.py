"""Shading: the paraboloid in closed form, its round trip, its blind measurement and the shift of a Gaussian spot."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pixmetry.camera.observations import DefectList, Observations
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import MeasureError
from pixmetry.observe.spatial_fit import fit_spatial
from pixmetry.observe.stack import StackAccumulator
from pixmetry.sources.optics.shading import SOURCE, Shading
from source_signals import K_DN_PER_E, centroid, flat, signal, spot_probe, spots, stream

SHAPE = (41, 61)


def test_shape_of_the_light(rng: np.random.Generator):
    """Mean 1, gradient at the centre, loss from centre to corner, all read off a flat frame."""
    params = Shading(gradient_x_per_px=1e-3, gradient_y_per_px=-2e-3, corner_rel=0.3)
    light = SOURCE.forward(params, flat(1.0, SHAPE, kind=Kind.PHOTONS), stream(rng)).data[0].astype(float)
    assert light.mean() == pytest.approx(1, abs=1e-6)
    assert (light[20, 31] - light[20, 29]) / 2 == pytest.approx(1e-3, abs=1e-6)
    assert (light[21, 30] - light[19, 30]) / 2 == pytest.approx(-2e-3, abs=1e-6)
    corners = light[[0, 0, -1, -1], [0, -1, 0, -1]].mean()
    assert light[20, 30] - corners == pytest.approx(0.3, abs=1e-6)


def test_correction_undoes_it(rng: np.random.Generator):
    frame = signal(rng.uniform(100, 1000, (2, *SHAPE)), Kind.PHOTONS)
    shaded = SOURCE.forward(SOURCE.bound, frame, stream(rng))
    assert np.allclose(SOURCE.correct(SOURCE.bound, shaded, {}).data, frame.data, rtol=1e-5)


def test_light_never_falls_below_zero(rng: np.random.Generator):
    light = SOURCE.forward(Shading(gradient_x_per_px=0.1), flat(1.0, SHAPE, kind=Kind.PHOTONS), stream(rng))
    assert light.data.min() > 0


def seen(rng: np.random.Generator, light: np.ndarray, frames: int = 8) -> Observations:
    """Stacks of noisy frames under a light, its mean 1000 DN."""
    stacks = []
    for mean in (np.full(light.shape, 50.0), 50 + 1000 * light / light.mean()):
        accumulator = StackAccumulator(12)
        for _ in range(frames):
            accumulator.add(np.rint(mean + rng.normal(0, 3, light.shape)).astype(np.uint16))
        stacks.append(accumulator.result(0.01))
    nothing = np.zeros(0, dtype=int)
    none = DefectList(nothing, nothing, (), nothing.astype(float), nothing.astype(float), 0.0, light.shape)
    return Observations(spatial_fit=fit_spatial(*stacks, none))


def light_of(rng: np.random.Generator, params: Shading, shape: tuple[int, int]) -> np.ndarray:
    return SOURCE.forward(params, flat(1.0, shape, kind=Kind.PHOTONS), stream(rng)).data[0].astype(float)


@pytest.mark.parametrize("corner", [0.3, -0.2])
def test_all_parameters_are_measured_blind(corner, rng: np.random.Generator):
    """Stacks of shaded frames with noise: within 5.5 u (t law, 50 degrees of freedom, 1e-6); u is below a hundredth of the value."""
    params = Shading(gradient_x_per_px=1e-3, gradient_y_per_px=-6e-4, corner_rel=corner)
    got = SOURCE.measure(seen(rng, light_of(rng, params, (96, 128))))
    for name, value in params.model_dump().items():
        assert abs(got[name].value - value) < 5.5 * got[name].u, name
        assert got[name].u < 0.01 * abs(value), name
    assert SOURCE.make({e.name: e.value for e in got})


@pytest.mark.parametrize("corner", [0.3, 0.0])
def test_uncertainty_of_the_corner_is_calibrated(corner, rng: np.random.Generator):
    """200 small stacks: z is N(0, 1) by Kolmogorov–Smirnov, 1e-6; catches a bias of 0.4 u with power 0.9."""
    light = light_of(rng, Shading(gradient_x_per_px=1e-3, corner_rel=corner), (40, 30))
    found = [SOURCE.measure(seen(rng, light, frames=3))["corner_rel"] for _ in range(200)]
    z = np.array([(e.value - corner) / e.u for e in found])
    assert stats.kstest(z, "norm").pvalue > 1e-6
    low, high = stats.chi2.ppf([5e-7, 1 - 5e-7], z.size)
    assert low < (z**2).sum() < high


def test_measured_shading_moves_a_target_as_the_true_one_does(rng: np.random.Generator):
    """The budget's row: mean and spread over the frame within 3 % of those with true parameters, of which the corner is nearly all."""
    params = Shading(gradient_x_per_px=2e-5, corner_rel=0.3)
    got = SOURCE.measure(seen(rng, light_of(rng, params, (96, 128))))
    measured, true = (SOURCE.propagate(p, spot_probe(sigma=2.0)) for p in (Shading(**{e.name: e.value for e in got}), params))
    assert measured.total_px == pytest.approx(true.total_px, rel=0.03)


@pytest.mark.parametrize(("along_x", "along_y"), [(0.3, 0.0), (0.1, 0.3), (0.2, -0.2)])
def test_light_that_is_not_round_gets_the_nearest_paraboloid_and_a_wider_u(along_x, along_y, rng: np.random.Generator):
    """Against a least-squares fit to the light without noise; u covers the curvatures of both axes within two of it."""
    shape = (96, 128)
    y, x = np.mgrid[: shape[0], : shape[1]] - np.array([47.5, 63.5])[:, None, None]
    corner2 = 47.5**2 + 63.5**2
    light = 1 - (along_x * x**2 + along_y * y**2) / corner2
    light /= light.mean()
    columns = np.stack([np.ones(light.size), x.ravel(), y.ravel(), -(x**2 + y**2).ravel() / corner2], axis=1)
    nearest = np.linalg.lstsq(columns, light.ravel(), rcond=None)[0][3]
    got = SOURCE.measure(seen(rng, light))["corner_rel"]
    assert got.value == pytest.approx(nearest, abs=0.01)
    assert "differently along x and y" in got.reason
    for axis in (along_x, along_y):
        assert abs(got.value - axis) < 2 * got.u + 0.05


def test_without_a_stack_it_says_what_to_take():
    with pytest.raises(MeasureError, match="at least 16"):
        SOURCE.measure(Observations())


def test_spot_at_the_centre_moves_by_gradient_times_variance(rng: np.random.Generator):
    """P3: a Gaussian spot of variance σ² under a relative ramp g moves by exactly gσ²."""
    params = Shading(gradient_x_per_px=2e-3, gradient_y_per_px=-1e-3)
    x, y = np.array([12.0]), np.array([12.0])
    frame = signal(spots(x, y) / K_DN_PER_E, Kind.PHOTONS, row0=228, col0=308, frame_shape=(481, 641))
    after = centroid(SOURCE.forward(params, frame, stream(rng)).data.astype(float))
    assert after[0][0] - 12 == pytest.approx(2e-3 * 4, rel=1e-3)
    assert after[1][0] - 12 == pytest.approx(-1e-3 * 4, rel=1e-3)


def test_mean_shift_over_the_frame_in_closed_form():
    """The mean of g/(1 + g x) over a frame of n pixels is ln((1 + a)/(1 − a))/n with a = g n/2."""
    g, n = 1e-3, 640
    got = SOURCE.propagate(Shading(gradient_x_per_px=g), spot_probe(sigma=2.0))
    a = g * n / 2
    assert got.bias_x_px == pytest.approx(4 * np.log((1 + a) / (1 - a)) / n, rel=2e-3)
    assert got.bias_y_px == pytest.approx(0, abs=1e-9)


def test_spread_over_the_frame_is_that_of_random_places(rng: np.random.Generator):
    """The quadratic part alone: standard deviation of the true shift over 2000 places.

    A uniform slope has a kurtosis of 1.8, so the standard deviation found scatters by √(0.2/2000) = 1 %: 5 % at 1e-6. The window keeps
    the targets 12 px from the edge, which takes 25 px off the range.
    """
    params, shape = Shading(corner_rel=0.1), (480, 640)
    got = SOURCE.propagate(params, spot_probe(sigma=2.0))
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
