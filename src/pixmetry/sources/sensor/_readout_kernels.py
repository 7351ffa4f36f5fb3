"""Kernels of the read-out: smear along columns, and charge that spills along them."""

from __future__ import annotations

import numpy as np

from pixmetry.core._binomial_kernels import normal_of_place
from pixmetry.core.arrays import Array, Ints, Singles
from pixmetry.core.jit import jit

Run = tuple[float, float, float, float, float, float]  # of full pixels, see `join`


@jit
def add_column_sums(data: Singles, factor: Array) -> Singles:
    """Return the data plus ``factor[i]`` times the sum over each whole column."""
    n, rows, cols = data.shape
    out = np.empty_like(data)
    total = np.empty(cols, np.float64)
    for i in range(n):
        total[:] = 0.0
        for r in range(rows):
            for c in range(cols):
                total[c] += data[i, r, c]
        for c in range(cols):
            total[c] *= factor[i]
        for r in range(rows):
            for c in range(cols):
                out[i, r, c] = data[i, r, c] + total[c]
    return out


@jit
def add_rows_passed(data: Singles, factor: Array, store_below: bool, undo: bool) -> Singles:
    """Return the data plus ``factor[i]`` times the sum over the rows between each row and the store.

    With ``undo`` the data hold the smear and the factor is negative: the sum is over what has been freed of it.
    """
    n, rows, cols = data.shape
    out = np.empty_like(data)
    total = np.empty(cols, np.float64)
    for i in range(n):
        total[:] = 0.0
        for k in range(rows):
            r = rows - 1 - k if store_below else k
            for c in range(cols):
                value = data[i, r, c] + factor[i] * total[c]
                out[i, r, c] = value
                total[c] += value if undo else data[i, r, c]
    return out


@jit
def join(x: Run, y: Run) -> Run:
    """Return two neighbouring runs of full pixels as one.

    A run is (left, right, lr, rl, dl, dr): charge that leaves at its left and right end; of charge that enters at the left end the share
    that leaves at the right end, and the other way; and of charge that enters at the left, and at the right, the share that is drained. The
    rest turns back. Like this nothing small is a difference of large numbers (Grassmann, Taksar and Heyman), however long a run grows.
    """
    p, q = x[3] + x[5], y[2] + y[4]  # of what passes the seam to the left, and to the right, the shares that do not come back
    back = p + q * (1.0 - p)
    if back <= 0.0:  # no way out: what is shut in is lost to the substrate
        return (x[0], y[1], 0.0, 0.0, x[4] + x[2], y[5] + y[3])
    to_y, to_x = (x[1] + (1.0 - p) * y[0]) / back, (y[0] + (1.0 - q) * x[1]) / back
    l_y, r_x = x[2] / back, y[3] / back
    l_x, r_y = (1.0 - q) * l_y, (1.0 - p) * r_x
    drained_l, drained_r = x[4] + y[4] * l_y + x[5] * l_x, y[5] + y[4] * r_y + x[5] * r_x
    return (x[0] + x[3] * to_x, y[1] + y[2] * to_y, y[2] * l_y, x[3] * r_x, drained_l, drained_r)


@jit
def single(excess: float, row: int, rows: int, up: float, kept: float, barrier: bool) -> Run:
    """Return the run of one full pixel: the share ``kept`` of its excess goes on, ``up`` of that to the left."""
    left, right = kept * up, kept * (1.0 - up)
    if barrier and row == 0:
        left, right = 0.0, kept
    if barrier and row == rows - 1:
        left, right = kept, 0.0
    if barrier and rows == 1:
        left, right = 0.0, 0.0
    return (left * excess, right * excess, right, left, 1.0 - kept, 1.0 - kept)


@jit
def spill_column(q: Array, full: float, up: float, kept: float, barrier: bool, runs: Array, first: Ints, last: Ints) -> int:
    """Let the charge of one column spill until no pixel holds more than ``full``, in place; the end of any order of spilling.

    Returns how many runs of full pixels there are.

    Rows are taken from left to right. Full pixels gather in runs, in which every pixel stays at ``full``: what leaves a run at its ends is
    linear in what came in, so two runs join in a few operations. A row is joined once: the work is proportional to the rows.
    """
    rows = len(q)
    count = 0
    for r in range(rows):
        flow = runs[count - 1, 1] if count and last[count - 1] == r - 1 else 0.0
        if q[r] + flow <= full:
            continue
        run = single(q[r] - full, r, rows, up, kept, barrier)
        start = r
        if count and last[count - 1] == r - 1:
            count -= 1
            run = join((runs[count, 0], runs[count, 1], runs[count, 2], runs[count, 3], runs[count, 4], runs[count, 5]), run)
            start = first[count]
        while start > 0:
            touching = count > 0 and last[count - 1] == start - 2
            flow = run[0] + (runs[count - 1, 1] if touching else 0.0)
            if q[start - 1] + flow <= full:
                break
            start -= 1
            run = join(single(q[start] - full, start, rows, up, kept, barrier), run)
            if touching:
                count -= 1
                run = join((runs[count, 0], runs[count, 1], runs[count, 2], runs[count, 3], runs[count, 4], runs[count, 5]), run)
                start = first[count]
        for k in range(6):
            runs[count, k] = run[k]
        first[count], last[count] = start, r
        count += 1
    for i in range(count):
        for r in range(first[i], last[i] + 1):
            q[r] = full
    for i in range(count):
        if first[i] > 0:
            q[first[i] - 1] += runs[i, 0]
        if last[i] < rows - 1:
            q[last[i] + 1] += runs[i, 1]
    for r in range(rows):
        q[r] = min(q[r], full)
    return count


@jit
def share_out(q: Array, full: float, runs: Array, first: Ints, last: Ints, count: int, key: np.uint64, frame: int, col: int) -> None:
    """Draw which way the charge went that left every run, in place: each electron for itself, up or down; what finds no room there stays.

    Of L and R electrons that leave at the two ends on average the binomial numbers have the variance L R/(L + R).
    """
    words, normal = np.empty(4, np.uint32), np.empty(4, np.float32)
    for i in range(count):
        up, down = runs[i, 0], runs[i, 1]
        if up <= 0.0 or down <= 0.0:
            continue
        _, z = normal_of_place(key, frame, first[i], col, words, normal)
        more = min(max(np.sqrt(up * down / (up + down)) * z, -up), down)
        above, below = first[i] - 1, last[i] + 1
        if above >= 0:
            more = min(max(more, -q[above]), full - q[above])
        if below < len(q):
            more = max(min(more, q[below]), q[below] - full)
        if above >= 0:
            q[above] += more
        if below < len(q):
            q[below] -= more


@jit
def soften(q: Array, top: float, knee: float, up: float, kept: float, barrier: bool, spare: Array) -> None:
    """Let the part of each pixel's own charge that its soft capacity does not take go to the neighbours, in place."""
    rows = len(q)
    spare[:] = 0.0
    room = knee * top
    for r in range(rows):
        above = max(q[r] - (top - room), 0.0)
        excess = above + room * np.expm1(-above / room)
        q[r] -= excess
        flow = single(excess, r, rows, up, kept, barrier)
        if r > 0:
            spare[r - 1] += flow[0]
        if r < rows - 1:
            spare[r + 1] += flow[1]
    for r in range(rows):
        q[r] += spare[r]


@jit
def spill(
    data: Singles,
    full: float,
    drain_ratio: float,
    knee: float,
    up: float,
    kept: float,
    barrier: bool,
    noisy: bool,
    key: np.uint64,
    frame: Ints,
    col0: Ints,
) -> Singles:
    """Return the charge of every pixel after blooming along the columns, shape (n, rows, cols); ``noisy``: see `share_out`."""
    n, rows, cols = data.shape
    out = np.empty_like(data)
    highest = np.empty(cols, np.float32)
    q, spare = np.empty(rows, np.float64), np.empty(rows, np.float64)
    runs = np.empty((rows, 6), np.float64)
    first, last = np.empty(rows, np.int64), np.empty(rows, np.int64)
    capacity = full * drain_ratio
    bend = full * (1.0 - knee)
    for i in range(n):
        highest[:] = 0.0
        for r in range(rows):
            for c in range(cols):
                out[i, r, c] = data[i, r, c]
                highest[c] = max(highest[c], data[i, r, c])
        for c in range(cols):
            if highest[c] <= bend:
                continue
            for r in range(rows):
                q[r] = data[i, r, c]
            if knee > 0.0:
                soften(q, full, knee, up, kept, barrier, spare)
            count = spill_column(q, capacity, up, kept, barrier, runs, first, last)
            if noisy:
                share_out(q, capacity, runs, first, last, count, key, frame[i], col0[i] + c)
            for r in range(rows):
                out[i, r, c] = min(q[r], full)
    return out
