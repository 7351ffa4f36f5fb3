"""Kernels of small symmetric positive definite systems: Cholesky's factor of the matrix brought to a unit diagonal.

That scaling makes pivots and damping free of units: a pivot is one minus the square of an unknown's multiple correlation with those before.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.jit import jit

LEAST_PIVOT = 1e-13  # of a unit diagonal: below, rounding decides


class Factor(NamedTuple):
    """D M D = L Lᵀ, with D such that the diagonal of D M D is 1 (or 1 + damping)."""

    lower: Array  # L, shape (most, most); only the lower triangle is used
    scale: Array  # the diagonal of D, shape (most,)


@jit
def factor_for(most: int) -> Factor:
    """Room for the factor of a matrix of up to ``most`` unknowns."""
    return Factor(np.zeros((most, most)), np.zeros(most))


@jit
def factorise(matrix: Array, n: int, damping: float, factor: Factor) -> bool:
    """Factorise the leading n × n of M + damping · diag M; False if it is not positive definite. Only its lower triangle is read."""
    lower, scale = factor.lower, factor.scale
    for i in range(n):
        if not matrix[i, i] > 0.0:
            return False
        scale[i] = 1.0 / math.sqrt(matrix[i, i])
    for i in range(n):
        for j in range(i):
            total = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = total / lower[j, j]
        pivot = 1.0 + damping
        for k in range(i):
            pivot -= lower[i, k] * lower[i, k]
        if not pivot > LEAST_PIVOT:
            return False
        lower[i, i] = math.sqrt(pivot)
    return True


@jit
def substitute(factor: Factor, n: int, right: Array, out: Array) -> None:
    """Put M⁻¹ right into ``out``, shape (n,) each; they may be the same."""
    lower, scale = factor.lower, factor.scale
    for i in range(n):
        total = right[i] * scale[i]
        for k in range(i):
            total -= lower[i, k] * out[k]
        out[i] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        total = out[i]
        for k in range(i + 1, n):
            total -= lower[k, i] * out[k]
        out[i] = total / lower[i, i]
    for i in range(n):
        out[i] *= scale[i]


@jit
def solve(matrix: Array, n: int, right: Array, damping: float, factor: Factor, out: Array) -> bool:
    """Solve (M + damping · diag M) out = right; False if the matrix is not positive definite."""
    if not factorise(matrix, n, damping, factor):
        return False
    substitute(factor, n, right, out)
    return True


@jit
def invert_root(factor: Factor, n: int, out: Array) -> None:
    """Put the lower triangle R with M⁻¹ = Rᵀ R into ``out``, shape (n, n) or more; the part above its diagonal is not changed."""
    lower, scale = factor.lower, factor.scale
    for i in range(n):
        out[i, i] = 1.0 / lower[i, i]
        for j in range(i):
            total = 0.0
            for k in range(j, i):
                total += lower[i, k] * out[k, j]
            out[i, j] = -total * out[i, i]
    for i in range(n):
        for j in range(i + 1):
            out[i, j] *= scale[j]


@jit
def invert(matrix: Array, n: int, out: Array) -> bool:
    """Put the inverse of the leading n × n into ``out``; False if the matrix is not positive definite."""
    factor, root = factor_for(n), np.zeros((n, n))
    if not factorise(matrix, n, 0.0, factor):
        return False
    invert_root(factor, n, root)
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += root[k, i] * root[k, j]
            out[i, j] = out[j, i] = total
    return True
