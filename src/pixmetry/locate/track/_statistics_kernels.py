"""Kernels of the statistics of tracked targets: sums that grow with the frames, and take the same memory for any number of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pixmetry.core.arrays import Array, Flags, Ints
from pixmetry.core.jit import jit

OCTAVES = 32  # of averaging times, from one frame on
TOGETHER = 8  # targets from which their common motion is taken off


class Sums(NamedTuple):
    """Of n targets; the axis of length 2 is x, y."""

    seen: Ints  # shape (n,): frames in which it was found
    run: Ints  # shape (n,): the last of them without a gap
    first: Array  # shape (n, 2): its first position, from which places count
    place: Array  # shape (n, 2, 3): Σ d, Σ d², Σ t d
    time: Array  # shape (n, 2): Σ t, Σ t²
    stated: Array  # shape (n, 2): Σ of stated variances
    phase: Array  # shape (n,): Σ of variances over the sub-pixel phase
    last: Array  # shape (n, 2, 2): the two latest positions
    second: Array  # shape (n, 2): Σ of squared second differences
    seconds: Ints  # shape (n,): how many
    common: Array  # shape (3,): Σ of squared common second differences along x and y, and how many
    half: Array  # shape (n, 2, OCTAVES): the first half of the next longer mean
    mean: Array  # shape (n, 2, OCTAVES): the latest mean
    state: Ints  # shape (n, OCTAVES): whether there is a mean (1), and a half of the next (2)
    allan: Array  # shape (n, 2, OCTAVES): Σ of squared differences of means that follow each other
    allans: Ints  # shape (n, OCTAVES): how many


@jit
def accumulate(sums: Sums, time: float, result: Array, s_curve: Array, found: Flags) -> None:
    """Add the positions of a frame; ``result`` (n, 5 or more): x, y, var x, cov, var y. ``s_curve``: standard deviation over the phase."""
    n = len(found)
    step = np.zeros((n, 2))
    common, many = np.zeros(2), 0
    for i in range(n):
        if found[i] and sums.run[i] >= 2:
            many += 1
            for axis in range(2):
                step[i, axis] = result[i, axis] - 2.0 * sums.last[i, axis, 0] + sums.last[i, axis, 1]
                common[axis] += step[i, axis]
    worth = 1.0
    if many >= TOGETHER:
        common /= many
        worth = many / (many - 1.0)
        sums.common[0] += common[0] * common[0]
        sums.common[1] += common[1] * common[1]
        sums.common[2] += 1.0
    else:
        common[:] = 0.0
    for i in range(n):
        if not found[i]:
            sums.run[i] = 0
            sums.state[i] = 0
            continue
        if sums.seen[i] == 0:
            sums.first[i, 0], sums.first[i, 1] = result[i, 0], result[i, 1]
        if sums.run[i] >= 2:
            sums.seconds[i] += 1
        sums.seen[i] += 1
        sums.time[i, 0] += time
        sums.time[i, 1] += time * time
        sums.phase[i] += s_curve[i] * s_curve[i]
        for axis in range(2):
            d = result[i, axis] - sums.first[i, axis]
            sums.place[i, axis, 0] += d
            sums.place[i, axis, 1] += d * d
            sums.place[i, axis, 2] += time * d
            sums.stated[i, axis] += result[i, 2 + 2 * axis]
            if sums.run[i] >= 2:
                sums.second[i, axis] += worth * (step[i, axis] - common[axis]) ** 2
            sums.last[i, axis, 1], sums.last[i, axis, 0] = sums.last[i, axis, 0], result[i, axis]
        sums.run[i] += 1
        x, y = result[i, 0] - sums.first[i, 0], result[i, 1] - sums.first[i, 1]
        for k in range(OCTAVES):
            if sums.state[i, k] & 1:
                sums.allan[i, 0, k] += (x - sums.mean[i, 0, k]) ** 2
                sums.allan[i, 1, k] += (y - sums.mean[i, 1, k]) ** 2
                sums.allans[i, k] += 1
            sums.mean[i, 0, k], sums.mean[i, 1, k] = x, y
            if not sums.state[i, k] & 2:
                sums.half[i, 0, k], sums.half[i, 1, k] = x, y
                sums.state[i, k] = 3
                break
            sums.state[i, k] = 1
            x, y = 0.5 * (sums.half[i, 0, k] + x), 0.5 * (sums.half[i, 1, k] + y)
