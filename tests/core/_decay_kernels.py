"""A model for the tests of the descent: an exponential decay, a exp(−b t)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pixmetry.core._least_squares_kernels import descent_of
from pixmetry.core.jit import jit


class Decay(NamedTuple):
    t: np.ndarray
    value: np.ndarray
    noise: float  # variance per unit of the mean; 0: all alike


@jit
def decay_equations(decay, p, weight, fresh, active, normal, right):
    normal[:] = 0.0
    right[:] = 0.0
    old, new = 0.0, 0.0
    for i in range(len(decay.t)):
        fall = np.exp(-p[1] * decay.t[i])
        slopes = (fall, -p[0] * decay.t[i] * fall)
        rest = decay.value[i] - p[0] * fall
        fresh[i] = 1.0 / (decay.noise * p[0] * fall) if decay.noise > 0.0 else 1.0
        old += weight[i] * rest * rest
        new += fresh[i] * rest * rest
        for j in range(len(active)):
            right[j] += fresh[i] * slopes[active[j]] * rest
            for k in range(j + 1):
                normal[j, k] += fresh[i] * slopes[active[j]] * slopes[active[k]]
    return old, new


@jit
def decay_limit(decay, p, change, active, trial):
    trial[:] = p
    for j in range(len(active)):
        trial[active[j]] += change[j]
    return trial[0] > 0.0 and abs(trial[1]) < 50.0


descend_decay = descent_of(decay_equations, decay_limit)
