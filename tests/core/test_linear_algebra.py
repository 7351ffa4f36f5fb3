"""Small positive definite systems against NumPy, and what is none."""

from __future__ import annotations

import numpy as np

from pixmetry.core._linear_algebra_kernels import factor_for, factorise, invert, invert_root, solve


def _system(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """A matrix whose unknowns have scales from 1e-6 to 1e6, and a right side."""
    root = rng.normal(size=(n, 3 * n))
    scale = 10.0 ** rng.uniform(-6, 6, n)
    return root @ root.T * np.outer(scale, scale), rng.normal(size=n) * scale


def test_solves_and_inverts_as_numpy_does(rng: np.random.Generator) -> None:
    for n in (1, 2, 5, 10):
        matrix, right = _system(rng, n)
        scale = np.sqrt(np.diag(matrix))
        out, inverse = np.empty(n), np.empty((n, n))
        assert solve(matrix, n, right, 0.0, factor_for(n), out)
        np.testing.assert_allclose(out * scale, np.linalg.solve(matrix / np.outer(scale, scale), right / scale), rtol=1e-9)
        assert invert(matrix, n, inverse)
        np.testing.assert_allclose(inverse * np.outer(scale, scale), np.linalg.inv(matrix / np.outer(scale, scale)), rtol=1e-8, atol=1e-10)


def test_damping_adds_its_share_of_the_diagonal(rng: np.random.Generator) -> None:
    matrix, right = _system(rng, 4)
    out, scale = np.empty(4), np.sqrt(np.diag(matrix))
    assert solve(matrix, 4, right, 0.3, factor_for(4), out)
    unit = matrix / np.outer(scale, scale) + 0.3 * np.eye(4)
    np.testing.assert_allclose(out * scale, np.linalg.solve(unit, right / scale), rtol=1e-9)


def test_root_of_the_inverse(rng: np.random.Generator) -> None:
    matrix, _ = _system(rng, 5)
    factor, root = factor_for(5), np.zeros((5, 5))
    assert factorise(matrix, 5, 0.0, factor)
    invert_root(factor, 5, root)
    np.testing.assert_allclose(root @ matrix @ root.T, np.eye(5), atol=1e-9)


def test_only_the_leading_part_and_the_lower_triangle_are_read(rng: np.random.Generator) -> None:
    matrix, right = _system(rng, 3)
    wide = np.full((6, 6), np.nan)
    wide[:3, :3] = np.tril(matrix)
    out, plain = np.empty(3), np.empty(3)
    assert solve(wide, 3, right, 0.0, factor_for(6), out)
    assert solve(matrix, 3, right, 0.0, factor_for(3), plain)
    assert (out == plain).all()


def test_what_is_not_positive_definite_is_told() -> None:
    out, inverse = np.empty(2), np.empty((2, 2))
    for bad in ([[1.0, 1.0], [1.0, 1.0]], [[1.0, 2.0], [2.0, 1.0]], [[0.0, 0.0], [0.0, 1.0]], [[np.nan, 0.0], [0.0, 1.0]]):
        assert not solve(np.array(bad), 2, np.ones(2), 0.0, factor_for(2), out)
        assert not invert(np.array(bad), 2, inverse)
    assert solve(np.array([[1.0, 1.0], [1.0, 1.0]]), 2, np.ones(2), 1e-6, factor_for(2), out)  # damped, it is
