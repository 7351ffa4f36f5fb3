"""The descent of Levenberg and Marquardt against SciPy, from afar, with held and bounded unknowns, and where there is no way down."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from core._decay_kernels import Decay, descend_decay
from pixmetry.core._least_squares_kernels import Rest

NONE = np.full(2, -np.inf)
BOTH = np.arange(2)
CLOSE = Rest(1e-16, 1e-16, 0.1, 0.0)


def _noisy(rng: np.random.Generator, a: float, b: float) -> Decay:
    t = np.linspace(0.0, 3.0, 60)
    return Decay(t, a * np.exp(-b * t) + rng.normal(0.0, 0.05, 60), 0.0)


def test_finds_what_scipy_finds_from_afar(rng: np.random.Generator) -> None:
    for start in ((2.0, 1.0), (0.3, 6.0), (20.0, 0.0)):
        decay, p = _noisy(rng, 3.0, 1.3), np.array(start)
        chi2, rests, _ = descend_decay(decay, p, NONE, BOTH, 60, CLOSE)
        best = least_squares(lambda q, d=decay: q[0] * np.exp(-q[1] * d.t) - d.value, (3.0, 1.3), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert rests
        np.testing.assert_allclose(p, best.x, rtol=1e-6)
        np.testing.assert_allclose(chi2, 2 * best.cost, rtol=1e-9)


def test_weights_that_follow_the_model_solve_their_own_equations(rng: np.random.Generator) -> None:
    """At rest Σ w(p) (d − µ) ∂µ/∂p is 0, with the weights at p; the matrix that is handed back is Σ w(p) (∂µ/∂p)²."""
    decay = _noisy(rng, 3.0, 0.5)._replace(noise=0.01)
    p = np.array([2.0, 1.0])
    _, rests, normal = descend_decay(decay, p, NONE, BOTH, 60, CLOSE)
    fall = np.exp(-p[1] * decay.t)
    force = (decay.value - p[0] * fall) / (0.01 * p[0] * fall)
    assert rests
    assert abs((force * fall).sum()) < 1e-5 * abs(force * fall).sum()
    assert abs((force * decay.t * fall).sum()) < 1e-5 * abs(force * decay.t * fall).sum()
    slopes = np.stack([fall, -p[0] * decay.t * fall])
    np.testing.assert_allclose(np.tril(normal), np.tril(slopes / (0.01 * p[0] * fall) @ slopes.T), rtol=1e-5)


def test_what_is_not_active_stays_and_what_is_least_is_held(rng: np.random.Generator) -> None:
    decay, p = _noisy(rng, 3.0, 1.3), np.array([2.0, 1.0])
    assert descend_decay(decay, p, NONE, np.array([0]), 60, CLOSE)[1]
    fall = np.exp(-decay.t)
    assert p[1] == 1.0
    np.testing.assert_allclose(p[0], (fall * decay.value).sum() / (fall**2).sum(), rtol=1e-9)
    p = np.array([2.0, 2.0])  # pressed to less than its least, as long as it is
    assert descend_decay(decay, p, np.array([-np.inf, 2.0]), BOTH, 60, CLOSE)[1]
    assert p[1] == 2.0
    fall = np.exp(-2.0 * decay.t)
    np.testing.assert_allclose(p[0], (fall * decay.value).sum() / (fall**2).sum(), rtol=1e-9)


def test_a_model_without_a_minimum_is_not_at_rest() -> None:
    decay = Decay(np.linspace(0.0, 3.0, 60), np.full(60, -1.0), 0.0)  # wants a height below 0, which is no model
    p = np.array([1.0, 1.0])
    assert not descend_decay(decay, p, NONE, BOTH, 60, CLOSE)[1]
    assert p[0] > 0.0
