"""Kernels of charge on its way to the output: shares left behind in transfers, and traps."""

from __future__ import annotations

import numpy as np

from pixmetry.core.jit import jit

REST = 1e-9  # of a packet: what would arrive still later is counted with the last pixel that is followed


@jit
def trail_shares(transfers, loss, trail_px, shares):
    """Fill in which shares of a packet arrive 0, 1, 2, … pixels late; return how many there are.

    In each transfer a packet stays whole with probability 1 − ε, or that share waits a geometric time of mean ``trail_px`` pixels, in
    whose transfers it may fall behind again. The delay has the generating function [(1 − ε)(1 − qz)/(1 − q'z)]^n with q = 1 − 1/trail,
    q' = q + ε/trail, whose coefficients follow each other by three terms; without trail (q = 0) it is the negative binomial law
    (1 − ε)^n (1, nε, n(n + 1)ε²/2, …). Its mean is nε·trail/(1 − ε).
    """
    q = 1.0 - 1.0 / trail_px
    late = q + loss / trail_px
    before, share = 0.0, np.exp(transfers * np.log1p(-loss))
    shares[0] = share
    left = 1.0 - share
    count = 1
    while left > REST and count < len(shares):
        j = count - 1.0
        following = ((transfers * (late - q) + (q + late) * j) * share - q * late * (j - 1.0) * before) / count
        before, share = share, following
        shares[count] = share
        left -= share
        count += 1
    if left <= REST:
        shares[count - 1] += left
    return count


@jit
def share_table(first, lines, phases, loss, trail_px):
    """Return the shares of each of the lines ``first``, ``first + 1``, …, shape (lines, longest), and how many each has."""
    longest = trail_shares(np.float64((first + lines) * phases), loss, trail_px, np.empty(lines + 1))
    table = np.zeros((lines, longest + 1))
    count = np.empty(lines, np.int64)
    for r in range(lines):
        count[r] = trail_shares(np.float64((first + r + 1) * phases), loss, trail_px, table[r])
    return table, count


@jit
def transfer_columns(data, first, phases, loss, trail_px):
    """Move the packets of every column to the register before row 0: row ``first[i] + r`` takes ``first + r + 1`` pixel steps."""
    n, rows, cols = data.shape
    out = np.empty_like(data)
    total = np.empty(cols, np.float64)
    table, count = share_table(first[0], rows, phases, loss, trail_px)
    for i in range(n):
        if i > 0 and first[i] != first[i - 1]:
            table, count = share_table(first[i], rows, phases, loss, trail_px)
        for r in range(rows):
            total[:] = 0.0
            for k in range(max(r - table.shape[1] + 1, 0), r + 1):
                if r - k < count[k]:
                    share = table[k, r - k]
                    for c in range(cols):
                        total[c] += share * data[i, k, c]
            for c in range(cols):
                out[i, r, c] = total[c]
    return out


@jit
def transfer_rows(data, first, phases, loss, trail_px):
    """The same along the register: column ``first[i] + c`` takes ``first + c + 1`` pixel steps to the output before column 0."""
    n, rows, cols = data.shape
    out = np.empty_like(data)
    total = np.empty(cols, np.float64)
    shares = share_table(first[0], cols, phases, loss, trail_px)[0].T.copy()
    for i in range(n):
        if i > 0 and first[i] != first[i - 1]:
            shares = share_table(first[i], cols, phases, loss, trail_px)[0].T.copy()
        for r in range(rows):
            total[:] = 0.0
            for j in range(min(shares.shape[0], cols)):
                for c in range(cols - j):
                    total[c + j] += shares[j, c] * data[i, r, c]
            for c in range(cols):
                out[i, r, c] = total[c]
    return out


@jit
def transfer_packets(data, first, phases, loss, trail_px, beta, reference_e):
    """Transfer along the rows with a loss that follows the packet, ε (x / reference)^(β − 1); a packet below zero loses nothing."""
    n, rows, cols = data.shape
    out = np.empty_like(data)
    total = np.empty(cols, np.float64)
    shares = np.empty(cols + 1, np.float64)
    for i in range(n):
        for r in range(rows):
            total[:] = 0.0
            for c in range(cols):
                x = np.float64(data[i, r, c])
                if x <= 0.0:
                    total[c] += x
                    continue
                own = min(loss * (x / reference_e) ** (beta - 1.0), 0.5)
                count = trail_shares(np.float64((first[i] + c + 1) * phases), own, trail_px, shares)
                for j in range(min(count, cols - c)):
                    total[c + j] += shares[j] * x
            for c in range(cols):
                out[i, r, c] = total[c]
    return out


@jit
def pass_traps(data, first, traps_per_px, release_px, fill_beta, well_e):
    """Move packets along the rows over traps of several species that fill at once and empty as e^(−k/τ).

    A packet of x electrons fills all traps of its volume v = (x/well)^β in each of the ``first + c + 1`` pixels that it crosses. Seen
    from the packets, the traps of a pixel are filled up to the heights of the packets that went before: a stack of levels, each with the
    line and so the time at which it was filled last and the number of pixels in which that was so. A new packet takes the levels below
    its own height off, so a packet costs a few steps however many went before it. What is trapped never exceeds what there is.
    """
    n, rows, cols = data.shape
    species = len(traps_per_px)
    out = np.empty_like(data)
    stay = np.empty((species, cols + 1), np.float64)
    for s in range(species):
        for k in range(cols + 1):
            stay[s, k] = np.exp(-k / release_px[s])
    height, at = np.empty(cols + 1, np.float64), np.empty(cols + 1, np.int64)
    trapped, found = np.empty(species, np.float64), np.empty(species, np.float64)
    density = traps_per_px.sum()
    for i in range(n):
        for r in range(rows):
            trapped[:] = 0.0
            levels = 0
            for c in range(cols):
                crossed = np.float64(first[i] + c + 1)
                x = np.float64(data[i, r, c])
                for s in range(species):
                    kept = trapped[s] * stay[s, 1]
                    x += trapped[s] - kept
                    trapped[s] = kept
                if x > 0.0:
                    share = x / well_e
                    volume = min(np.sqrt(share) if fill_beta == 0.5 else share**fill_beta, 1.0)
                    volume = min(volume, x / (density * crossed))
                    found[:] = 0.0
                    low = 0.0
                    while levels > 0 and low < volume:
                        high = min(height[levels - 1], volume)
                        line = at[levels - 1]
                        for s in range(species):
                            found[s] += traps_per_px[s] * (first[i] + line + 1) * (high - low) * stay[s, c - line]
                        low = high
                        if height[levels - 1] > volume:
                            break
                        levels -= 1
                    height[levels], at[levels] = volume, c
                    levels += 1
                    for s in range(species):
                        caught = traps_per_px[s] * crossed * volume - found[s]
                        trapped[s] += caught
                        x -= caught
                out[i, r, c] = x
    return out


@jit
def move_borders(data, weights, strength_per_e, farthest):
    """Move the borders between pixels away from the charge they hold, and with them charge; the border of the array stands still.

    ``weights[k]`` is the repulsion over k pixels along each axis. While the charge gathers the border moves from 0 to
    ``strength_per_e`` (φ₁ − φ₂), so half of that is what it collects on the other side, at the mean of the two charges.
    """
    n, rows, cols = data.shape
    out = np.empty_like(data)
    radius = len(weights) - 1
    while radius > 0 and weights[radius] == 0.0:
        radius -= 1
    along = np.empty((rows, cols), np.float64)
    field = np.empty((rows, cols), np.float64)
    total = np.empty((rows, cols), np.float64)
    for i in range(n):
        for r in range(rows):
            for c in range(cols):
                q = weights[0] * data[i, r, c]
                for k in range(1, radius + 1):
                    q += weights[k] * (np.float64(data[i, r, max(c - k, 0)]) + data[i, r, min(c + k, cols - 1)])
                along[r, c] = q
        for r in range(rows):
            for c in range(cols):
                q = weights[0] * along[r, c]
                for k in range(1, radius + 1):
                    q += weights[k] * (along[max(r - k, 0), c] + along[min(r + k, rows - 1), c])
                field[r, c] = q
                total[r, c] = data[i, r, c]
        for r in range(rows):
            for c in range(cols):
                for down in range(2):
                    r2, c2 = r + down, c + 1 - down
                    if r2 < rows and c2 < cols:
                        shift = strength_per_e * (field[r, c] - field[r2, c2])
                        shift = min(max(shift, -farthest), farthest)
                        moved = 0.25 * (np.float64(data[i, r, c]) + data[i, r2, c2]) * shift
                        total[r, c] -= moved
                        total[r2, c2] += moved
        for r in range(rows):
            for c in range(cols):
                out[i, r, c] = total[r, c]
    return out
