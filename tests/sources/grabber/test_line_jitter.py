"""Delays of the rows: moments and autocorrelation of the truth, and that images do what it tells."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.core.random import Grid
from pixmetry.sources.grabber.line_jitter import SOURCE, LineJitter, delay_s, propagate, truth
from source_signals import Z, stream
from video_signals import PIXEL_HZ, bump, centre, sampled, standard_probe, video

N, ROWS = 400, 60


def delays_ns(rng: np.random.Generator, params: LineJitter, n: int = N, rows: int = ROWS, row0: int = 0) -> np.ndarray:
    grid = Grid(np.arange(n), np.full(n, row0), np.zeros(n), (rows, 8))
    return 1e9 * delay_s(params, grid, ROWS, stream(rng))


def test_moments_of_the_two_kinds(rng: np.random.Generator) -> None:
    """Variance of N numbers: relative standard error √(2/N_eff), the carried-on ones with N_eff = N tanh-like (1 − ρ²)/(1 + ρ²)."""
    rho2 = np.exp(-2 / 5)
    for params, independent in ((LineJitter(white_ns=20.0), 1.0), (LineJitter(loop_ns=20.0, loop_rows=5.0), (1 - rho2) / (1 + rho2))):
        found = delays_ns(rng, params)
        assert found.var() == pytest.approx(400.0, rel=Z * np.sqrt(2 / (found.size * independent)) * 1.1)


@pytest.mark.parametrize("interlaced", [True, False])
def test_the_loop_carries_on_within_a_field(interlaced: bool, rng: np.random.Generator) -> None:
    """Correlation e^(−k/L) at k lines of the field, and none between fields.

    Products of unit variance numbers, alike over (1 + ρ²)/(1 − ρ²) = 5.1 rows; L off by a fifth would change the one at 4 lines by 0.07.
    """
    found = delays_ns(rng, LineJitter(loop_ns=1.0, loop_rows=5.0, interlaced=interlaced), n=4000)
    u = Z * np.sqrt(2 * 5.1 / (4000 * (ROWS - 8)))
    for lag in (1, 2, 3, 8):
        got = (found[:, lag:] * found[:, :-lag]).mean()
        expected = (np.exp(-lag / 2 / 5) if lag % 2 == 0 else 0.0) if interlaced else np.exp(-lag / 5)
        assert got == pytest.approx(expected, abs=u), lag


def test_any_rows_have_the_delays_of_the_whole(rng: np.random.Generator) -> None:
    params, draws = LineJitter(white_ns=3.0, loop_ns=20.0, loop_rows=30.0, settling_ns=50.0, shear_ns=20.0), stream(rng)
    grids = [Grid(np.arange(3), np.full(3, r), np.zeros(3), (h, 4)) for r, h in ((0, 200), (77, 40), (199, 1))]
    whole, some, one = (delay_s(params, g, 200, draws) for g in grids)
    assert np.array_equal(whole[:, 77:117], some) and np.array_equal(whole[:, 199:], one)


def test_the_steady_part_settles_after_the_vertical_interval_and_shears(rng: np.random.Generator) -> None:
    found = delays_ns(rng, LineJitter(settling_ns=100.0, settling_rows=10.0, shear_ns=30.0), n=1)[0]
    line = np.arange(ROWS) // 2
    np.testing.assert_allclose(found, 100 * np.exp(-line / 10) + 30 * (np.arange(ROWS) / (ROWS - 1) - 0.5), atol=1e-9)


def test_rows_move_by_the_truth(rng: np.random.Generator) -> None:
    params, draws = LineJitter(white_ns=20.0, loop_ns=10.0), stream(rng)
    before = video(np.broadcast_to(bump(60.0, 120, 3.0), (2, 40, 120)), smooth=True)
    told = truth(params, before, draws)["row_shift_px"]
    moved = (centre(sampled(SOURCE.forward(params, before, draws), 8)) - centre(sampled(before, 8))) / 8
    np.testing.assert_allclose(moved, told, atol=1e-3)


def test_published_size_of_20_ns() -> None:
    """20 ns are 0.284 px at 14.1875 MHz; T7, plain centroid, window radius 6, background 0: n_eff = 7.07, u = 0.376 σ."""
    assert pytest.approx(0.284, abs=5e-4) == 20e-9 * PIXEL_HZ
    probe = standard_probe()
    weight = probe.signal_dn.sum(axis=2)
    n_eff = weight.sum(axis=1) ** 2 / (weight**2).sum(axis=1)
    np.testing.assert_allclose(n_eff, 7.07, atol=0.03)
    assert propagate(LineJitter(white_ns=20.0), probe).u_x_px == pytest.approx(0.376 * 0.284, rel=0.02)
    assert propagate(LineJitter(white_ns=20.0), probe).u_y_px < 2e-5  # light that leaves the window to the side


def test_carried_on_delays_do_not_average_over_the_rows() -> None:
    """Fully alike within both fields, independent between them: 1/√2 of the delay."""
    probe = standard_probe()
    u = propagate(LineJitter(loop_ns=20.0, loop_rows=60.0), probe).u_x_px
    assert u == pytest.approx(0.284 / np.sqrt(2), rel=0.06)
    assert propagate(LineJitter(loop_ns=20.0, loop_rows=60.0, interlaced=False), probe).u_x_px == pytest.approx(0.284, rel=0.04)
