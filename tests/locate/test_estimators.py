"""Estimators against plain NumPy, finite differences, closed forms and a numerical integral of the S-curve."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import erf

from pixmetry.core.errors import InputError
from pixmetry.locate.centroids.fixed import LAWS, FixedCentroid
from pixmetry.locate.detect.targets import Positions
from pixmetry.locate.estimator import Method, Settings
from pixmetry.locate.estimators import estimators, methods
from pixmetry.locate.noise import NoiseModel
from pixmetry.locate.target_estimator import TargetEstimator, parse_estimator

SIDE = 24
AXIS = np.arange(SIDE, dtype=float)


def estimator(name: str, **kw) -> FixedCentroid:
    if name.endswith("threshold"):
        kw = {"threshold_dn": 20.0} | kw
    return FixedCentroid(name, background_dn=10.0, **kw)


def spot(x: float, y: float, width: float = 1.8, peak: float = 150.0, background: float = 10.0) -> np.ndarray:
    """A Gaussian spot sampled at the centres of the pixels."""
    return background + peak * np.exp(-((AXIS - x) ** 2 + (AXIS[:, None] - y) ** 2) / (2 * width**2))


def by_hand(window: np.ndarray, name: str, half: int = 6, threshold: float = 20.0, background: float = 10.0) -> tuple[float, float]:
    """The definition, pixel by pixel."""
    total = sx = sy = 0.0
    for r in range(12 - half, 13 + half):
        for c in range(12 - half, 13 + half):
            i = window[r, c] - background
            f = {"centroid": i, "squared_centroid": i * i, "soft_threshold": max(i - threshold, 0)}.get(name, i if i > threshold else 0)
            total, sx, sy = total + f, sx + f * c, sy + f * r
    return sx / total, sy / total


@pytest.mark.parametrize("name", LAWS)
def test_locate_is_the_definition(name: str, rng: np.random.Generator) -> None:
    windows = np.stack([spot(*(12 + rng.uniform(-0.5, 0.5, 2))) + rng.normal(0, 1, (SIDE, SIDE)) for _ in range(5)])
    x, y = estimator(name).locate(windows)
    for k in range(5):
        assert (x[k], y[k]) == pytest.approx(by_hand(windows[k], name), abs=1e-12)
    single = estimator(name).locate(windows.astype(np.float32))
    assert np.allclose(single, (x, y), atol=1e-5)


@pytest.mark.parametrize("name", LAWS)
def test_gradient_equals_finite_differences(name: str) -> None:
    """Central differences in every pixel of one window; no pixel lies so near the threshold that the step crosses it."""
    law = estimator(name)
    window = spot(12.23, 11.64)[None]
    assert np.abs(window - 30.0).min() > 1e-3
    gx, gy = law.gradient(window)
    step = 1e-4
    moved = np.repeat(window, 2 * SIDE * SIDE, axis=0)
    for k in range(SIDE * SIDE):
        moved[2 * k, k // SIDE, k % SIDE] += step
        moved[2 * k + 1, k // SIDE, k % SIDE] -= step
    for got, at in ((gx, law.locate(moved)[0]), (gy, law.locate(moved)[1])):
        numeric = ((at[0::2] - at[1::2]) / (2 * step)).reshape(SIDE, SIDE)
        assert np.abs(numeric - got[0]).max() < 1e-6 * np.abs(numeric).max()


def test_a_symmetric_spot_at_a_symmetric_place_is_found_exactly() -> None:
    for name in LAWS:
        x, y = estimator(name).locate(spot(12.0, 12.0)[None])
        assert (x[0], y[0]) == pytest.approx((12.0, 12.0), abs=1e-12)


def test_no_light_above_the_threshold_gives_nan() -> None:
    dark = np.full((2, SIDE, SIDE), 10.0)
    dark[1] = spot(12, 12)
    x, y = estimator("soft_threshold").locate(dark)
    assert np.isnan([x[0], y[0]]).all() and np.isfinite([x[1], y[1]]).all()
    gx, _ = estimator("soft_threshold").gradient(dark)
    assert np.isnan(gx[0, 12, 12]) and np.isfinite(gx[1]).all()


def test_s_curve_of_a_soft_threshold_equals_the_poisson_sum() -> None:
    """Error of the centroid of a line profile sampled at the integers, against Poisson's sums with integrals done numerically.

    e(c) = −2 Σ S_k sin(2πkc) / (∫h + 2 Σ C_k cos(2πkc)), S_k = ∫ x h sin(2πkx) dx, C_k = ∫ h cos(2πkx) dx. Here h is a Gaussian of standard
    deviation 0.8 under a soft threshold at 0.3 of its height, as a product with a constant along y.
    """
    width, peak, threshold = 0.8, 150.0, 45.0
    edge = width * math.sqrt(2 * math.log(peak / threshold))

    def h(x: float) -> float:
        return peak * math.exp(-(x**2) / (2 * width**2)) - threshold

    area = 2 * quad(h, 0, edge)[0]
    phases = np.linspace(-0.45, 0.45, 13)
    top, bottom = np.zeros(13), np.full(13, area)
    for k in range(1, 80):
        top -= 4 * quad(lambda x: x * h(x), 0, edge, weight="sin", wvar=2 * math.pi * k)[0] * np.sin(2 * math.pi * k * phases)
        bottom += 4 * quad(h, 0, edge, weight="cos", wvar=2 * math.pi * k)[0] * np.cos(2 * math.pi * k * phases)
    series = top / bottom
    windows = np.stack([np.repeat((peak * np.exp(-((AXIS - 12 - c) ** 2) / (2 * width**2)))[None], SIDE, axis=0) for c in phases])
    x, _ = FixedCentroid("soft_threshold", threshold_dn=threshold).locate(windows)
    assert np.abs(series).max() > 0.05
    assert np.allclose(x - 12 - phases, series, atol=2e-3)  # the kinks at ± edge leave 1/k² beyond the last term


def test_noise_of_each_estimator_is_what_the_gradient_predicts(rng: np.random.Generator) -> None:
    """20 000 windows of plain NumPy noise. False alarm 1e-6 in each of 8 comparisons (z = 4.9 of √(1/2n)); 4 % errors are seen."""
    n, sigma = 20_000, 0.5
    # the profile is flat away from the threshold, so that no noise carries a pixel over it and first order holds
    flat = np.where(np.hypot(AXIS - 12, AXIS[:, None] - 12) < 3.6, 150.0, 0.0) + 10.0
    windows = flat + rng.normal(0, sigma, (n, SIDE, SIDE))
    for name in LAWS:
        law = estimator(name)
        found = law.locate(windows)
        for got, gradient in zip(found, law.gradient(flat[None]), strict=True):
            predicted = sigma * np.sqrt((gradient**2).sum())
            second_order = 0.005
            if name == "squared_centroid":  # the squared noise of the dark pixels adds 2σ⁴ in each
                dark = (np.hypot(AXIS - 12, AXIS[:, None] - 12) >= 3.6) & (np.abs(AXIS - 12) <= 6) & (np.abs(AXIS[:, None] - 12) <= 6)
                moment = ((AXIS - 12) ** 2 * dark).sum() * 2 * sigma**4
                predicted = math.hypot(predicted, math.sqrt(moment) / ((flat - 10) ** 2).sum())
            assert abs(got.std() / predicted - 1) < 4.9 / math.sqrt(2 * n) + second_order


def test_gaussian_noise_of_a_centroid_has_the_closed_form() -> None:
    """u = σ √(Σx²)/S: over a square of w pixels, Σx² = w²(w² − 1)/12."""
    window = spot(12, 12)[None]
    law = FixedCentroid("centroid", window=13, background_dn=10.0)
    gx, _ = law.gradient(window)
    total = 150 * 2 * math.pi * 1.8**2 * erf(6.5 / 1.8 / math.sqrt(2)) ** 2
    assert np.sqrt((gx**2).sum()) == pytest.approx(math.sqrt(169 * 168 / 12) / total, rel=2e-3)


def test_parse_estimator() -> None:
    got = parse_estimator("fixed_soft_threshold:sigma=4,window=11")
    assert (got.name, got.sigma, got.window, got.threshold_dn) == ("fixed_soft_threshold", 4.0, 11, None)
    assert got.resolved(5.0, 0.5).threshold_dn == 2.0 and got.resolved(5.0, 0.5).background_dn == 5.0
    assert parse_estimator("fixed_hard_threshold:threshold=12").threshold_dn == 12.0
    assert parse_estimator("fixed_soft_threshold") == FixedCentroid()
    assert parse_estimator("fixed_centroid:window=9").window == 9


def test_a_name_of_locate_means_what_locate_runs() -> None:
    """One name, one algorithm: what has a fixed square of pixels is called so, and its settings are refused under the other name."""
    for name in estimators("disc"):
        assert parse_estimator(name) == TargetEstimator(name)
    with pytest.raises(InputError, match="fixed_soft_threshold:window=11"):
        parse_estimator("soft_threshold:window=11")
    with pytest.raises(InputError, match="no such"):
        parse_estimator("fixed_template")


REFUSED = ["median", "fixed_centroid:sigma=3", "fixed_centroid:size=3", "fixed_soft_threshold:window=12", "template:window=15"]
REFUSED += [f"fixed_soft_threshold:{s}" for s in ("window=9.5", "sigma", "sigma=x", "sigma=-1", "sigma=nan", "window=9,window=11")]


@pytest.mark.parametrize("text", REFUSED)
def test_parse_estimator_refuses(text: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_estimator(text)
    assert refused.value.allowed or refused.value.remedy


def test_a_window_that_does_not_fit_and_a_threshold_that_is_not_known_are_refused() -> None:
    with pytest.raises(InputError, match="fit"):
        estimator("centroid").locate(np.zeros((1, 12, 24)))
    with pytest.raises(InputError, match="noise"):
        FixedCentroid().locate(np.zeros((1, 24, 24)))


def _stating(s_curve_px: float | None, var_px2: float) -> Method:
    """A method that puts every target at 0, with this covariance and this error over the phase."""
    more = {} if s_curve_px is None else {"s_curve_px": np.array([s_curve_px, np.nan])}
    var, none = np.array([var_px2, np.nan]), np.zeros(2)
    return Method("mine", "", lambda *_: Positions(none, none, var, none, var, none.astype(np.uint32), more), lambda *_: 2.0)


@pytest.mark.parametrize(("s_curve_px", "var_px2", "what"), [(None, 1e-4, "without the sub-pixel phase"), (0.02, 1e-4, "less than those")])
def test_a_covariance_without_the_phase_is_refused(s_curve_px: float | None, var_px2: float, what: str) -> None:
    with pytest.raises(InputError, match=what):
        _stating(s_curve_px, var_px2).positions(np.zeros((9, 9), np.uint8), None, NoiseModel(1.0), Settings())


def test_a_covariance_with_the_phase_or_of_a_method_that_does_not_see_it_passes() -> None:
    method = _stating(0.02, 4e-4)
    assert method.positions(np.zeros((9, 9), np.uint8), None, NoiseModel(1.0), Settings()).var_x_px2[0] == 4e-4
    method = replace(_stating(None, 1e-4), sees_phase=False)
    assert method.positions(np.zeros((9, 9), np.uint8), None, NoiseModel(1.0), Settings()).var_x_px2[0] == 1e-4
    assert {name for name, one in methods().items() if not one.sees_phase} == {"template", "poisson_gaussian"}
