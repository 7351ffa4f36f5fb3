"""The law of dark current and temperature against simulation. Statistical tests fail by chance once in a million runs, for any seed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, stats

from pixmetry.core.errors import InputError, MeasureError
from pixmetry.observe.dark_temperature import fit_dark_temperature, law_at

ALPHA = 1e-6
T = np.array([-5.0, 5.0, 15.0, 25.0, 35.0, 45.0])
REFERENCE, CURRENT, STEP = 25.0, 30.0, 7.5


def law(t):
    return CURRENT * np.exp(np.log(2) * (t - REFERENCE) / STEP)


def draw(rng: np.random.Generator, scatter: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Currents with 2 % and 2 e⁻/s: the coldest ones are lost in it and often negative."""
    u = np.hypot(2.0, 0.02 * law(T))
    return law(T) + scatter * u * rng.standard_normal(T.size), u


def test_recovers_the_law_within_its_u(rng: np.random.Generator):
    """z by Kolmogorov–Smirnov and χ² of both values together, ALPHA each: 500 draws catch a bias of 0.25 u and an u that is 17 % off."""
    z, d2 = [], []
    want = np.array([CURRENT, STEP])
    for _ in range(500):
        y, u = draw(rng)
        got = fit_dark_temperature(T, y, u, reference_c=REFERENCE)
        z.append((got.values - want) / got.u)
        d2.append((got.values - want) @ np.linalg.solve(got.covariance, got.values - want))
    for column in np.array(z).T:
        assert stats.kstest(column, "norm").pvalue > ALPHA
        low, high = stats.chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], 500)
        assert low < (column**2).sum() < high
    low, high = stats.chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], 1000)
    assert low < np.sum(d2) < high


def test_is_the_weighted_least_squares_fit(rng: np.random.Generator):
    """SciPy's curve_fit on the law as it is written, with its covariance."""
    y, u = draw(rng)
    got = fit_dark_temperature(T, y, u, reference_c=10.0)
    p, covariance = optimize.curve_fit(
        lambda t, a, d: a * 2 ** ((t - 10.0) / d), T, y, p0=(law(10.0), STEP), sigma=u, absolute_sigma=True, xtol=1e-13, gtol=1e-13
    )
    np.testing.assert_allclose(got.values, p, rtol=1e-5)
    if not got.reasons:
        np.testing.assert_allclose(got.covariance, covariance, rtol=1e-3)
    other = fit_dark_temperature(T, y, u, reference_c=40.0)["dark_current_ref"]
    np.testing.assert_allclose(law_at(got, np.array([10.0, 40.0]), reference_c=10.0), [got.values[0], other.value], rtol=1e-9)


def test_scatter_beyond_the_stated_u_widens_it(rng: np.random.Generator):
    """Currents that scatter 2000 times as much: t of n − 2 with the widened u; Kolmogorov–Smirnov, ALPHA."""
    t = []
    for _ in range(300):
        y, u = law(T) * (1 + 0.02 * rng.standard_normal(T.size)), 1e-5 * law(T)
        got = fit_dark_temperature(T, y, u, reference_c=REFERENCE)["doubling_temperature_k"]
        assert got.dof == 4 and "scatter" in got.reason
        t.append((got.value - STEP) / got.u)
    assert stats.kstest(t, stats.t(4).cdf).pvalue > ALPHA


def test_refusals():
    y, u = law(T), 0.02 * law(T)
    with pytest.raises(MeasureError, match="too few temperatures.*found 2"):
        fit_dark_temperature(T[[0, 0, 3]] + [0, 0.1, 0], y[[0, 0, 3]], u[[0, 0, 3]], reference_c=25)
    with pytest.raises(MeasureError, match="10 K"):
        fit_dark_temperature(np.array([20.0, 24.0, 28.0]), y[:3], u[:3], reference_c=25)
    with pytest.raises(MeasureError, match="does not grow"):
        fit_dark_temperature(T, np.full(6, 10.0), np.full(6, 1.0), reference_c=25)
    with pytest.raises(MeasureError, match="does not grow"):
        fit_dark_temperature(T, y[::-1], u, reference_c=25)
    with pytest.raises(MeasureError, match="above zero"):
        fit_dark_temperature(T, -y, u, reference_c=25)
    with pytest.raises(InputError):
        fit_dark_temperature(T, y, 0 * u, reference_c=25)
    with pytest.raises(InputError):
        fit_dark_temperature(T, y[:3], u, reference_c=25)


@pytest.mark.parametrize("currents", [(-1.0, -1.0, 1e4), (0.0, 0.0, 100.0), (1.0, -3.0, -3.0)])
def test_a_current_at_one_temperature_tells_no_law(currents: tuple[float, ...]):
    with pytest.raises(MeasureError, match="one temperature only"):
        fit_dark_temperature(np.array([20.0, 40.0, 55.0]), np.array(currents), np.ones(3), reference_c=20.0)
