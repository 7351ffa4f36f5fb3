"""The correction grid: read as bilinear, given only where it helps, true within its uncertainty (failing once in a million runs)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import interpolate, stats

from calibrate.adjusted import NOISE_PX, adjusted, measured_again, shifted
from calibrate.networks import SENSOR, Simulated, predicted, simulate
from pixmetry.calibrate.checks import residual_grid
from pixmetry.calibrate.records import ResidualGrid, read_record

RATE = 1e-6


@pytest.fixture
def network(rng) -> tuple[Simulated, np.ndarray]:
    simulated = simulate(rng, images=30, points=100, known="fixed")
    return simulated, predicted(simulated.network, simulated.truth)


def wave(x, y):
    """An unflat sensor as no polynomial of a lens has it, px."""
    return 0.15 * np.sin(2 * np.pi * x / 1300) * np.cos(2 * np.pi * y / 1500), 0.1 * np.cos(2 * np.pi * x / 1000)


def test_grid_is_read_as_scipy_reads_it(rng):
    x_px, y_px = np.linspace(0, 2047, 9), np.linspace(0, 1535, 7)
    by_name = {"x_px": x_px, "y_px": y_px, "dx_px": rng.standard_normal((7, 9)), "dy_px": rng.standard_normal((7, 9))}
    grid = read_record(ResidualGrid, by_name)
    x, y = rng.uniform(0, 2047, (20, 3)), rng.uniform(0, 1535, (20, 3))
    for name, found in zip(("dx_px", "dy_px"), residual_grid.at(grid, x, y), strict=True):
        read = interpolate.RegularGridInterpolator((y_px, x_px), by_name[name])
        np.testing.assert_allclose(found, read(np.stack([y, x], axis=-1)), atol=1e-12)
    beyond, _ = residual_grid.at(grid, np.array([-50.0, 9999.0]), np.array([0.0, 1535.0]))
    np.testing.assert_allclose(beyond, [grid.dx_px[0, 0], grid.dx_px[-1, -1]])


def test_stat_values_are_true_within_their_uncertainty(rng, network):
    """Residuals that are the field and noise: squared errors at nodes among the points average to about u².

    The mean over some 110 nodes (about 0.6) is held between 0.2 and 2.5: no χ² test, as smoothing makes neighbours alike. Uncertainties
    wrong by a factor of 2.1 would be caught.
    """
    simulated, exact = network
    found = adjusted(simulated.network, simulated)
    field = np.stack(wave(*exact.T), axis=1)
    made = replace(found, residual_px=field + NOISE_PX * rng.standard_normal(field.shape))
    made = replace(made, network=replace(found.network, x_px=exact[:, 0], y_px=exact[:, 1]))
    grid = residual_grid.residual_grids(made)["camera"]
    x, y = np.meshgrid(grid.x_px, grid.y_px)
    among = grid.n > 5
    for name, truth in zip(("dx_px", "dy_px"), wave(x, y), strict=True):
        z2 = ((getattr(grid, name) - truth) / grid.u_px)[among] ** 2
        assert 0.2 < z2.mean() < 2.5, name
    assert abs(grid.n.sum() - len(exact)) < grid.n.size and grid.p < 1e-6
    assert grid.dx_px.shape == grid.u_px.shape == grid.n.shape == (len(grid.y_px), len(grid.x_px))


def test_stat_uncertainty_is_that_of_the_noise(rng, network):
    """A plane fits without a rest: u is the noise that was put in, through the penalised fit by dense matrices with one of the penalties.

    The noise is found from some 2800 places in x and y, to 0.95 %: an u 10 % off would be caught.
    """
    simulated, exact = network
    found = adjusted(simulated.network, simulated)
    x, y = exact.T
    plane = np.stack([0.2 + 1e-4 * x, -2e-4 * y], axis=1)
    made = replace(found, residual_px=plane + NOISE_PX * rng.standard_normal(plane.shape), network=replace(found.network, x_px=x, y_px=y))
    grid = residual_grid.residual_grids(made)["camera"]

    def hats(values, nodes):
        return np.maximum(0, 1 - np.abs(np.clip(values, nodes[0], nodes[-1])[:, None] - nodes) / (nodes[1] - nodes[0]))

    def squared(nodes, order):
        differences = np.diff(np.eye(len(nodes)), order, axis=0)
        return differences.T @ differences

    down, across = hats(y[made.used], grid.y_px), hats(x[made.used], grid.x_px)
    design = (down[:, :, None] * across[:, None, :]).reshape(len(down), -1)
    orders = ((0, 2), (2, 0), (1, 1), (1, 1))
    rough = sum(np.kron(squared(grid.y_px, i), squared(grid.x_px, j)) for i, j in orders)
    inverse = [np.linalg.inv(design.T @ design + penalty * rough + 1e-6 * np.eye(len(rough))) for penalty in residual_grid.PENALTIES]
    off = [np.abs(grid.u_px.ravel() / (NOISE_PX * np.sqrt(np.diag(one))) - 1).max() for one in inverse]
    assert min(off) < stats.norm.isf(RATE / 2) / np.sqrt(2 * 2 * (len(design) - len(rough)))


def test_planted_field_is_corrected(rng, network):
    """Left-out residuals fall, and so does sigma0 of the corrected network."""
    simulated, exact = network
    measured = shifted(measured_again(rng, simulated, exact), *wave(*exact.T))
    found = adjusted(measured, simulated)
    grid = residual_grid.residual_grids(found)["camera"]
    assert grid.p < 0.01 and grid.rms_with_px < 0.8 * grid.rms_without_px
    x, y = residual_grid.corrected(grid, measured.x_px, measured.y_px)
    better = adjusted(replace(measured, x_px=x, y_px=y), simulated)
    assert better.sigma0 < 0.8 * found.sigma0


def test_stat_noise_alone_gives_no_grid(rng, network):
    """Each of 10 measurements may give one with a rate of 1 % at most."""
    simulated, exact = network
    given = sum(bool(residual_grid.residual_grids(adjusted(measured_again(rng, simulated, exact), simulated), seed=i)) for i in range(10))
    assert given <= stats.binom.isf(RATE, 10, 0.01)


def test_few_points_or_images_give_no_grid(rng):
    few = simulate(rng, images=4, points=50, known="fixed")
    assert residual_grid.residual_grids(adjusted(few.network, few)) == {}


def test_a_grid_is_subtracted_as_it_is_stored(rng):
    """Bilinear in between, held beyond the edge; lists, as a file has them."""
    stored = {"x_px": [0.0, 2047.0], "y_px": [0.0, 1535.0], "dx_px": [[0.5, 1.5], [0.5, 1.5]], "dy_px": [[-0.25, -0.25], [0.75, 0.75]]}
    grid = read_record(ResidualGrid, stored)
    x, y = rng.uniform(0, SENSOR.cols - 1, (4, 5)), rng.uniform(0, SENSOR.rows - 1, (4, 5))
    found = residual_grid.corrected(grid, x, y)
    np.testing.assert_allclose(found, (x - 0.5 - x / 2047, y + 0.25 - y / 1535))
    np.testing.assert_allclose(residual_grid.corrected(grid, np.array([-9.0, 3000.0]), np.zeros(2))[0], [-9.5, 2998.5])
