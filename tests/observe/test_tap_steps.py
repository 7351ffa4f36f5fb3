"""Taps beside the light and the columns' own pattern, against columns drawn here; each test fails by chance once in a million runs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pixmetry.camera.observations import StackMoments, TapSteps
from pixmetry.core.number import Estimates
from pixmetry.observe.spatial_fit import fit_spatial
from pixmetry.observe.stack import StackAccumulator
from pixmetry.observe.tap_steps import evened, find_taps, with_steps_in_slope

ALPHA = 1e-6
SHAPE = (40, 200)
COL_REL, SLOPE = 0.001, 2e-4


def stacks(rng: np.random.Generator, step: float, odd_even: float, taps: int = 2) -> tuple[StackMoments, StackMoments]:
    """Dark and bright frames behind taps; light that slopes along x and falls to the sides."""
    cols = np.arange(SHAPE[1])
    x = cols - 99.5
    gain = 1 + step * ((cols * taps // SHAPE[1]) % 2 - 0.5) + odd_even * (cols % 2 - 0.5)
    light = 2000 * (1 + SLOPE * x - 3e-6 * x**2) * gain * (1 + COL_REL * rng.standard_normal(SHAPE[1]))
    mean = light * (1 + 0.005 * rng.standard_normal(SHAPE))
    made = []
    for level, noise in ((np.zeros(SHAPE), 2.0), (mean, 10.0)):
        sums = StackAccumulator(12)
        for _ in range(8):
            sums.add(np.rint(100 + level + noise * rng.standard_normal(SHAPE)).astype(np.uint16))
        made.append(sums.result(0.01))
    return made[0], made[1]


def test_taps_columns_and_slope_are_told_from_each_other(rng: np.random.Generator):
    """χ² of the z of 40 sensors. The step would make the slope wrong by half, the stripes the columns' PRNU twice as large."""
    z = []
    for _ in range(40):
        step, odd_even = 0.01 * rng.choice([-1, 1]), 0.003 * rng.choice([-1, 1])
        dark, bright = stacks(rng, step, odd_even)
        taps = find_taps(dark, bright, mosaic=False)
        assert taps.fit["taps"].value == 2 and not taps.fit.limits
        found = with_steps_in_slope(fit_spatial(dark, evened(dark, bright, taps)), taps)
        mean = 1 - 3e-6 * (SHAPE[1] ** 2 - 1) / 12
        truth = {"step_rel": step, "odd_even_rel": odd_even, "prnu_col_rel": COL_REL, "shading_x_per_px": SLOPE / mean}
        told = {n: (taps.fit if n in taps.fit else found)[n] for n in truth}
        z.append([(e.value - truth[n]) / e.u for n, e in told.items()])
    each = np.array(z)
    low, high = stats.chi2.ppf([ALPHA / 8, 1 - ALPHA / 8], len(each))
    squares = (each**2).sum(axis=0)
    assert (0.8 * low < squares).all() and (squares < 1.25 * high).all(), squares


@pytest.mark.parametrize("taps", [2, 4])
def test_the_number_of_taps(taps: int, rng: np.random.Generator):
    assert find_taps(*stacks(rng, 0.03, 0.0, taps), mosaic=False).fit["taps"].value == taps


def test_a_sensor_without_taps_is_left_as_it_is(rng: np.random.Generator):
    dark, bright = stacks(rng, 0.0, 0.0)
    found = find_taps(dark, bright, mosaic=False)
    if found.fit.limits == {"step_rel", "odd_even_rel"}:
        assert evened(dark, bright, found) is bright
    assert np.abs(found.gain - 1).max() < 0.003


def test_a_step_that_was_not_found_is_in_u_of_the_slope_and_of_the_columns():
    """Of a step that a polynomial of fourth order is fitted to, the slope in the middle is in the light's, the rest in the columns'."""
    step, columns, cols = 5e-4, 1e-3, SHAPE[1]
    x = (np.arange(cols) - 99.5) / 99.5
    side = np.where(x < 0, -0.5, 0.5)
    fitted = np.polynomial.Polynomial.fit(x, side, 4, domain=(-1, 1))
    rows = [("shading_x_per_px", SLOPE, 3e-7, np.inf, "1/px"), ("prnu_col_rel", columns, 2e-5, np.inf, "1")]
    found = with_steps_in_slope(Estimates.from_rows(rows, method="as drawn"), TapSteps(Estimates.empty(), np.ones(cols), step))
    assert found["shading_x_per_px"].u == pytest.approx(np.hypot(3e-7, step * fitted.deriv()(0.0) / 99.5))
    assert found["shading_x_per_px"].u > 4e-6
    raised = step**2 * np.mean((side - fitted(x)) ** 2) / (2 * columns)
    assert found["prnu_col_rel"].u == pytest.approx(np.hypot(2e-5, raised), rel=1e-9)
