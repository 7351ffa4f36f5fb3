"""Gain and noise behind filters: frames made by NumPy and SciPy, the filters by ``scipy.ndimage``; nothing of the package simulates here.

The chance that a sound estimator fails is 1e-6 a test (5 u of a normal distribution). The filters change the gain by 30 to 90 %, that is by
tens of u.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import ndimage

from pixmetry.camera.noise_covariance import (
    LAGS,
    NoiseCovariance,
    NoiseFilter,
    blur_kernel,
    charge_response,
    response_to_white,
    sampling_covariance,
)
from pixmetry.core.number import Estimates
from pixmetry.observe.noise_covariance import LagProducts, lag_products
from pixmetry.observe.noise_filter import before_correlation, find_noise_filter
from pixmetry.observe.observe import Group, observe

SHAPE, GAIN, NOISE_E, OFFSET, TOP = (120, 160), 0.5, 8.0, 60.0, 4095
Z = 5.0


def campaign(rng: np.random.Generator, filtered: Callable[[np.ndarray], np.ndarray], levels: int = 10, lines_e: float = 0.0):
    """Observations of a camera with white noise whose codes go through a filter of codes."""

    def frame(mean_e: float) -> np.ndarray:
        electrons = rng.poisson(mean_e, SHAPE) + rng.normal(0, NOISE_E, SHAPE) + rng.normal(0, lines_e, (SHAPE[0], 1))
        codes = np.clip(np.rint(OFFSET + GAIN * electrons), 0, TOP)
        return np.clip(np.rint(filtered(codes)), 0, TOP).astype(np.uint16)

    def groups():
        for k in range(1, levels + 1):
            exposure, light = 0.01 * k / levels, 6500.0 * k / levels
            yield Group("dark", "level", exposure, None, [frame(0.0) for _ in range(2)])
            yield Group("bright", "level", exposure, None, [frame(light) for _ in range(2)])

    return observe(groups(), 12)


def test_covariance_is_that_of_plain_sums(rng):
    """The kernel's products against slices, and the correction for the means: white noise has none at any lag."""
    first, second = (rng.integers(0, 4000, (41, 57)).astype(np.uint16) for _ in range(2))
    noise = ((second.astype(float) - first) / np.sqrt(2))[4:-4, 4:-4]  # without the margin of an eighth of the rows, even
    noise -= noise.mean(axis=1, keepdims=True)
    noise -= noise.mean(axis=0)
    sums, mean = lag_products(first, second)
    assert mean == pytest.approx(first[4:-4, 4:-4].mean())
    for j, i in ((0, 0), (0, 1), (2, -3), (4, 4)):
        for r in (0, 1):
            for c in (0, 1):
                at = [(y, x) for y in range(r, 33 - j, 2) for x in range(c, 49, 2) if 0 <= x + i < 49]
                expected = sum(noise[y, x] * noise[y + j, x + i] for y, x in at)
                assert sums[r, c, j, 4 + i] == pytest.approx(expected, rel=1e-4, abs=2.0)


def test_covariance_of_small_frames_has_no_bias(rng):
    """Of 400 pairs of 24 × 20 pixels: without the correction the variance is 9 % too small and the nearest lags are −4 to −5 %."""
    products = LagProducts()
    for k in range(400):
        first, second = (np.rint(rng.normal(2000, 20, (24, 20))).astype(np.uint16) for _ in range(2))
        products.add(k, *lag_products(first, second), first.shape)
    mean = products.covariance_dn2().mean(axis=(0, 1))
    u = 400 / np.sqrt(400 * 24 * 20)
    # the correction itself has noise: over 60 repetitions the values scatter by 1.7 u, not by √2 u and u
    assert mean[0, 4] == pytest.approx(400 + 1 / 12, abs=1.75 * Z * u)
    assert np.abs([mean[0, 5], mean[1, 4], mean[1, 5], mean[0, 6]]).max() < 1.75 * Z * u


def test_bartletts_formula_gives_the_scatter_of_lag_products(rng):
    """Scatter of the products of 600 filtered fields; a variance of 600 values is known to 6 %."""
    kernel = np.array([[0.05, 0.1, 0.05], [0.1, 0.4, 0.1], [0.05, 0.1, 0.05]])
    fields = ndimage.convolve(rng.normal(0, 1, (600, 40, 40)), kernel[None], mode="wrap")
    products = np.array([[np.mean(f * np.roll(f, (-j, -i), (0, 1))) for j, i in LAGS[:8]] for f in fields])
    full = np.array([np.mean(fields * np.roll(fields, (-j, -i), (1, 2))) for j, i in LAGS])
    predicted = sampling_covariance(full)[:8, :8] / 1600
    measured = np.cov(products.T)
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    assert np.abs((measured - predicted) / scale).max() < Z * np.sqrt(2 / 600) * 1.2


def gaussian(sigma: float, reach: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda x: ndimage.gaussian_filter(x, sigma, radius=reach, mode="nearest")


def unsharp(amount: float, sigma: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda x: (1 + amount) * x - amount * ndimage.gaussian_filter(x, sigma, radius=int(np.ceil(3 * sigma)), mode="nearest")


LINEAR_FILTERS = {
    "none": lambda x: x,
    "sharpened": unsharp(0.5, 1.0),
    "strongly sharpened": unsharp(1.5, 0.8),
    "blurred": gaussian(0.6, 1),
    "kernel": lambda x: ndimage.convolve(x, np.array([[1, 2, 1], [2, 8, 2], [1, 2, 1]]) / 20.0, mode="nearest"),
    "line": lambda x: ndimage.convolve1d(x, [0.15, 0.7, 0.15], axis=1, mode="nearest"),
}


@pytest.mark.parametrize("name", LINEAR_FILTERS)
def test_gain_and_dark_noise_behind_a_linear_filter(rng, name):
    fit = campaign(rng, LINEAR_FILTERS[name]).photon_transfer_fit
    gain, noise = fit["gain_dn_per_e"], fit["dark_noise_e"]
    assert abs(gain.value - GAIN) < Z * gain.u
    assert gain.u < 0.04 * GAIN
    assert abs(noise.value - NOISE_E) < Z * noise.u
    assert ("corrected" in gain.reason) == (name != "none")


def test_row_noise_behind_a_filter(rng):
    """A mask across the rows enlarges what a row has in common; the white noise that it enlarges too is not taken for it."""
    fit = campaign(rng, unsharp(0.6, 1.0), lines_e=3.0).photon_transfer_fit
    assert abs(fit["row_noise_e"].value - 3.0) < Z * fit["row_noise_e"].u
    assert campaign(rng, unsharp(0.6, 1.0)).photon_transfer_fit["row_noise_e"].value < 0.5


@pytest.mark.parametrize("name", ["median", "largest", "blocks"])
def test_gain_behind_other_filters_is_refused(rng, name):
    """A median, a rank filter, and means of blocks of two by two put in place of their pixels."""
    filters = {
        "median": lambda x: ndimage.median_filter(x, 3),
        "largest": lambda x: ndimage.percentile_filter(x, 70, 3),
        "blocks": lambda x: np.kron(x.reshape(60, 2, 80, 2).mean(axis=(1, 3)), np.ones((2, 2))),
    }
    seen = campaign(rng, filters[name])
    assert "gain_dn_per_e" not in seen.photon_transfer_fit
    assert any("neighbouring pixels is correlated" in note for note in seen.notes)


def test_sum_over_all_lags_is_the_variance_before_charge_was_repelled():
    """Charge is kept: with the exact response the sum over all lags is T, whatever loss and reach (both far above any sensor's)."""
    shot = np.array([100.0, 2000.0])
    for reach in (0.0, 0.5):
        before, behind = charge_response(2e-5, reach, shot)
        assert shot + 2 * behind.sum(axis=1) == pytest.approx(before, rel=1e-6)
        assert (before / shot - 1) / (2e-5 * shot) == pytest.approx(1, abs=0.1)  # to first order


def test_pixels_that_are_full_below_the_last_code_tell_no_filter(rng):
    """Two of twelve levels are at the full well, where charge that spills into a neighbour correlates them; the others are white."""

    def frame(mean_e: float) -> np.ndarray:
        electrons = rng.poisson(mean_e, SHAPE).astype(float)
        over = np.maximum(electrons - 6000.0, 0.0)
        electrons = np.minimum(electrons - over + 0.5 * np.roll(over, 1, axis=1), 6000.0 + 0.3 * np.roll(over, 1, axis=1))
        return np.rint(OFFSET + GAIN * (electrons + rng.normal(0, NOISE_E, SHAPE))).astype(np.uint16)

    def groups():
        for k in range(1, 13):
            for kind, light in (("dark", 0.0), ("bright", 570.0 * k)):
                yield Group(kind, "level", 0.01 * k, None, [frame(light) for _ in range(2)])

    seen = observe(groups(), 12)
    gain = seen.photon_transfer_fit["gain_dn_per_e"]
    assert seen.noise_filter.kind == "white" and abs(gain.value - GAIN) < Z * gain.u
    assert gain.u < 0.02 * GAIN
    assert seen.series.bright.mean_dn[-3] < seen.series.full_dn <= seen.series.bright.mean_dn[-1]


def exact(law: Callable[[np.ndarray], np.ndarray]) -> NoiseCovariance:
    """Covariances without any scatter: 20 black levels, and 10 of light whose shot noise, up to 2000 DN², is correlated by a law."""
    shot = np.concatenate([np.zeros(20), np.linspace(200.0, 2000.0, 10)])
    products = np.zeros((30, 2, 2, 5, 9))
    products[..., 0, 4] = (50.0 + shot)[:, None, None]
    for k, values in enumerate(law(shot[20:]).T):
        j, i = LAGS[1:][k]
        products[20:, :, :, j, 4 + i] = values[:, None, None]
    bright, none, mean = shot > 0, np.full((30, 2), np.nan), 100 + 2 * shot
    return NoiseCovariance(
        bright, ~bright, np.ones(30), mean, mean, np.zeros(30), np.ones(30, int), products, 50.0 + shot, none, np.zeros(30), (500, 500), 4
    )


def test_a_correlation_of_a_thousandth_is_charge_and_no_filter_where_both_fit():
    """A blur that changes the variance by 1 % stands back; one by 39 %, which repelled charge does not fit, does not."""
    for sigma, kind in ((0.27, "charge"), (0.4, "linear")):
        correlation, _ = response_to_white(blur_kernel(sigma, 1))
        found = find_noise_filter(exact(lambda shot, c=correlation: np.outer(shot, c[1:])))
        assert found is not None and found.kind == kind
    assert found.rival is None


def test_jitter_at_the_left_border_is_no_noise_of_the_light(rng):
    """Behind a filter along the row, rows that move by 0.2 px are noisy where the line rises from black: by the square of the light."""

    def frame(mean_e: float) -> np.ndarray:
        electrons = rng.poisson(mean_e, SHAPE) + rng.normal(0, NOISE_E, SHAPE)
        smooth = ndimage.convolve1d(electrons, [0.25, 0.5, 0.25], axis=1, mode="nearest")
        smooth[:, 0] += 0.2 * mean_e * rng.standard_normal(SHAPE[0])
        return np.rint(np.clip(400 + GAIN * smooth, 0, TOP)).astype(np.uint16)

    def groups():
        for k in range(1, 11):
            for kind, light in (("dark", 0.0), ("bright", 500.0 * k)):
                yield Group(kind, "level", 0.001 * k, None, [frame(light) for _ in range(2)])

    seen = observe(groups(), 12)
    gain = seen.photon_transfer_fit["gain_dn_per_e"]
    assert seen.noise_filter.kind == "linear" and seen.noise_filter.name == "filter along the row"
    assert abs(gain.value - GAIN) < Z * gain.u and gain.u < 0.1 * GAIN


def test_u_of_a_contrast_grows_with_it_when_a_filter_is_undone():
    """A filter that leaves a quarter of the variance: the contrast before is twice as large, with half of the relative u of the factor."""
    spatial = Estimates.from_rows([("prnu_pixel_rel", 0.01, 0.0, np.inf, "1")])
    before = before_correlation(spatial, NoiseFilter(kind="linear", factor=4.0, u_factor=0.4), 100.0)["prnu_pixel_rel"]
    assert before.value == pytest.approx(0.02) and before.u == pytest.approx(0.02 * 0.05)


def test_the_pattern_behind_an_unknown_filter_is_not_told():
    """That of a demosaicking is: its original pixels are as the converter gave them. Along the rows alone, rows keep theirs."""
    names = ("prnu_pixel_rel", "prnu_col_rel", "prnu_row_rel", "dsnu_pixel_dn", "dsnu_row_dn")
    spatial = Estimates.from_rows([(name, 0.01, 1e-4, np.inf, "1") for name in names], method="as drawn")
    along = np.array([1.0 if j == i == 0 else 0.2 if j == 0 and abs(i) == 1 else 0.0 for j, i in LAGS])
    both = np.array([1.0 if j == i == 0 else 0.2 if abs(j) + abs(i) == 1 else 0.0 for j, i in LAGS])
    for correlation, kept in ((along, ("prnu_row_rel", "dsnu_row_dn")), (both, ())):
        covariance = 1e-6 * np.eye(len(LAGS) - 1)
        unknown = NoiseFilter("unknown", "no linear filter fits", factor=1.3, u_factor=0.3, correlation=correlation, covariance=covariance)
        found = before_correlation(spatial, unknown, 100.0)
        assert found.names == kept
        assert all("no linear filter fits" in found.reasons[name] for name in set(names) - set(kept))
    kept = before_correlation(spatial, NoiseFilter(kind="unknown", name="demosaicking, bilinear, stored colour green"), 100.0)
    assert kept.names == spatial.names
