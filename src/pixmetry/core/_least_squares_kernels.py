"""Kernel of weighted least squares with a few unknowns: the descent of Levenberg and Marquardt, for every model.

A model is a kernel that sets up the normal equations at given values, and another one that says how far a step may go. A
step is judged with the weights it starts from; then these are renewed, so that weights may follow the model (iteratively reweighted least
squares).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from pixmetry.core._linear_algebra_kernels import factor_for, solve
from pixmetry.core.arrays import Array, Ints
from pixmetry.core.jit import jit

MOST_PASSES = 60
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e-9, 1e8
RAISED, RAISED_SINGULAR = 1e-4, 1e-3  # damping is at least this after a step that was no use, or that could not be computed
FREE = 0.1  # damping above which a small step need not mean that little is left
SAME = 1e-12  # relative rise of χ² that is rounding


class Rest(NamedTuple):
    """When a descent is at rest."""

    fall: float  # predicted fall of χ² by a step that is the last, which is then taken unseen
    share: float  # the same as a share of χ², added
    damping: float  # up to which a small step counts as the last: `FREE`, or infinite where a model's rounding may raise it at the end
    stuck: float  # predicted fall below which a descent that finds no way down counts as being at rest


def descent_of(equations: Callable[..., Any], limit: Callable[..., Any]) -> Any:
    """Return the kernel that finds the least χ² of a model.

    It is made where the model is, beside its kernels: what a kernel is handed as an argument could not be kept compiled on disk.

    Parameters
    ----------
    equations : kernel (problem, p, weight, fresh, active, normal, right) -> (float, float)
        Puts JᵀWJ and JᵀW·residual at p into ``normal`` and ``right``, and the weights at p, shape (observations,), into ``fresh``. Of
        ``normal`` only the lower triangle is read. Returns χ² with ``weight`` and with ``fresh``.
    limit : kernel (problem, p, change, active, trial) -> bool
        Puts what a step leads to into ``trial``, no further than the model can be trusted; False where no model is.

    Returns
    -------
    kernel (problem, p, least, active, observations, rest) -> (float, bool, ndarray)
        Steps from the parameters p, in place, and returns χ², whether it came to rest, and JᵀWJ of the ``active`` where it was set up last:
        at the result, or before a last step that is no larger than ``rest`` says. ``problem`` is what the two kernels read, often a named
        tuple: pixels, noise, settings. ``least``: values below which parameters cannot fall; one that is there is no unknown as long
        as it is pressed there. ``active``: the numbers of those that are unknown. ``observations``: how many weights. ``rest``: a `Rest`.

    References
    ----------
    K. Levenberg, Quart. Appl. Math. 2, 164 (1944); D. W. Marquardt, J. SIAM 11, 431 (1963).
    """

    @jit
    def descend(problem: Any, p: Array, least: Array, active: Ints, observations: int, rest: Rest) -> tuple[float, bool, Array]:
        count = len(active)
        normal, right = np.zeros((count, count)), np.zeros(count)
        new_normal, new_right, held = np.zeros((count, count)), np.zeros(count), np.zeros((count, count))
        pull, change, trial, factor = np.zeros(count), np.zeros(count), p.copy(), factor_for(count)
        weight, fresh = np.ones(observations), np.empty(observations)
        _, chi2 = equations(problem, p, weight, fresh, active, normal, right)
        weight, fresh = fresh, weight
        damping = FIRST_DAMPING
        for _ in range(MOST_PASSES):
            held[:] = normal
            pull[:] = right
            for j in range(count):
                if p[active[j]] <= least[active[j]] and right[j] < 0.0:
                    held[j, :] = 0.0
                    held[:, j] = 0.0
                    held[j, j], pull[j] = 1.0, 0.0
            if not solve(held, count, pull, damping, factor, change):
                damping = max(10.0 * damping, RAISED_SINGULAR)
                if damping > MOST_DAMPING:
                    return chi2, False, normal
                continue
            fall = 0.0
            for j in range(count):
                fall += change[j] * pull[j]
            allowed = limit(problem, p, change, active, trial)
            if allowed and fall < rest.fall + rest.share * chi2 and damping < rest.damping:
                p[:] = trial
                return chi2, True, normal
            before, now = np.inf, np.inf
            if allowed:
                before, now = equations(problem, trial, weight, fresh, active, new_normal, new_right)
            if before <= chi2 * (1.0 + SAME):
                p[:] = trial
                chi2 = now
                normal, new_normal, right, new_right, weight, fresh = new_normal, normal, new_right, right, fresh, weight
                damping = max(0.1 * damping, LEAST_DAMPING)
            else:
                if damping >= MOST_DAMPING:
                    return chi2, fall < rest.stuck, normal
                damping = max(10.0 * damping, RAISED)
        return chi2, False, normal

    return descend
