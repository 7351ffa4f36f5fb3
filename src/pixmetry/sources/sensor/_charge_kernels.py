"""Kernels of charge on its way to the output: shares left behind in transfers, and traps.

Each electron stays behind or not for itself. With ``noisy`` their number is drawn, binomial; without, it is the mean.
"""

from __future__ import annotations

import numpy as np

from pixmetry.core._binomial_kernels import binomial, layer, normal_of_place, normals_of, normals_of_row, place_words
from pixmetry.core.arrays import Array, Ints, Singles
from pixmetry.core.jit import jit

REST = 1e-9  # of a packet: what would arrive still later is counted with the last pixel that is followed


@jit
def trail_shares(transfers: float, loss: float, trail_px: float, shares: Array) -> int:
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
def share_table(first: int, lines: int, phases: int, loss: float, trail_px: float) -> tuple[Array, Ints]:
    """Return the shares of each of the lines ``first``, ``first + 1``, …, shape (lines, longest), and how many each has."""
    longest = trail_shares(np.float64((first + lines) * phases), loss, trail_px, np.empty(lines + 1))
    table = np.zeros((lines, longest + 1))
    count = np.empty(lines, np.int64)
    for r in range(lines):
        count[r] = trail_shares(np.float64((first + r + 1) * phases), loss, trail_px, table[r])
    return table, count


@jit
def transfer_columns(data: Singles, first: Ints, phases: int, loss: float, trail_px: float) -> Singles:
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
def transfer_rows(data: Singles, first: Ints, phases: int, loss: float, trail_px: float) -> Singles:
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
def scatter(
    data: Singles,
    key: np.uint64,
    frame: Ints,
    row0: Ints,
    step: int,
    col0: Ints,
    line0: Ints,
    further: Array,
    log_stay: Array,
    along: bool,
    out: Singles,
) -> None:
    """Let every electron fall behind for itself, down the columns or (with ``along``) along the rows.

    Of those that are j pixels late, ``further[j, line]`` go on to fall behind more; what is no whole number goes by shares.

    data : float32 (n, rows, cols); key : uint64; frame, row0, col0, line0 : int64 (n,), row ``row0 + step r`` of the frame, and line of the
    table of the first row (column); further, log_stay : float64 (lags, lines), the latter log(1 − further); out : float32, zeros.
    """
    n, rows, cols = data.shape
    lags = further.shape[0]
    u, z = np.empty(cols, np.float64), np.empty(cols, np.float32)
    rest, part = np.empty(cols, np.float64), np.empty(cols, np.float64)
    words, normal = np.empty(4, np.uint32), np.empty(4, np.float32)
    for i in range(n):
        for r in range(rows):
            row = row0[i] + step * r
            moving = 0
            for c in range(cols):
                x = np.float64(data[i, r, c])
                rest[c] = np.floor(x) if x > 0.0 else 0.0
                part[c] = x - rest[c]
                moving += rest[c] > 0.0
            j, busy = 0, True
            while busy and j < (cols if along else rows - r):
                whole_row = 8 * moving > cols
                if whole_row:
                    normals_of_row(key, layer(frame[i], j), row, col0[i], u, z)
                busy = False
                moving = 0
                last = cols - j if along else cols
                for c in range(last):
                    if rest[c] == 0.0 and part[c] == 0.0:
                        continue
                    line = line0[i] + (c if along else r)
                    q = further[j, line] if j < lags else 0.0
                    late = 0.0
                    if rest[c] > 0.0 and q > 0.0:
                        if whole_row:
                            late = binomial(rest[c], q, log_stay[j, line], u[c], np.float64(z[c]))
                        else:
                            one, at = normal_of_place(key, layer(frame[i], j), row, col0[i] + c, words, normal)
                            late = binomial(rest[c], q, log_stay[j, line], one, at)
                    stays = np.float32(rest[c] - late + part[c] * (1.0 - q))
                    if along:
                        out[i, r, c + j] += stays
                    else:
                        out[i, r + j, c] += stays
                    rest[c] = late
                    part[c] *= q
                    if abs(part[c]) < REST:
                        part[c] = 0.0
                    moving += late > 0.0
                    busy = busy or late > 0.0 or part[c] != 0.0
                j += 1


@jit
def transfer_packets(
    data: Singles,
    first: Ints,
    phases: int,
    loss: float,
    trail_px: float,
    beta: float,
    reference_e: float,
    noisy: bool,
    key: np.uint64,
    frame: Ints,
    row0: Ints,
    at0: Ints,
    step: int,
) -> Singles:
    """Transfer along the rows with a loss that follows the packet, ε (x / reference)^(β − 1); a packet below zero loses nothing.

    ``row0`` and ``at0 + step c`` are the places of rows and pixels for the draws.
    """
    n, rows, cols = data.shape
    out = np.empty_like(data)
    total = np.empty(cols, np.float64)
    shares = np.empty(cols + 1, np.float64)
    words, normal = np.empty(4, np.uint32), np.empty(4, np.float32)
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
                rest, left = np.floor(x) if noisy else 0.0, 1.0
                part = x - rest
                for j in range(min(count, cols - c)):
                    late = 0.0
                    if rest > 0.0:
                        q = max(left - shares[j], 0.0) / left if j + 1 < count else 0.0
                        u, z = normal_of_place(key, layer(frame[i], j), row0[i] + r, at0[i] + step * c, words, normal)
                        late = binomial(rest, q, np.log1p(-q), u, z) if q < 1.0 else rest
                    total[c + j] += rest - late + shares[j] * part
                    rest = late
                    left -= shares[j]
                    if left <= REST and rest == 0.0 and part == 0.0:
                        break
            for c in range(cols):
                out[i, r, c] = total[c]
    return out


@jit
def pass_traps(
    data: Singles,
    first: Ints,
    traps_per_px: Array,
    release_px: Array,
    fill_beta: float,
    well_e: float,
    noisy: bool,
    key: np.uint64,
    frame: Ints,
    row0: Ints,
    at0: Ints,
    step: int,
) -> Singles:
    """Move packets along the rows over traps of several species that fill at once and empty as e^(−k/τ).

    A packet of x electrons fills all traps of its volume v = (x/well)^β in each of the ``first + c + 1`` pixels that it crosses. Seen
    from the packets, the traps of a pixel are filled up to the heights of the packets that went before: a stack of levels, each with the
    line and so the time at which it was filled last and the number of pixels in which that was so. A new packet takes the levels below
    its own height off, so a packet costs a few steps however many went before it. What is trapped never exceeds what there is.

    What is caught is not random: all free traps of the volume. What is released is: of the electrons in traps each goes for itself, so
    their number after a pixel is binomial. How many of those that are left sit below a height is drawn from the law of a part given the
    whole: with the mean e and the variance V = Σ T s(1 − s) of either, e_b + (M − e) V_b/V, and the variance V_b (V − V_b)/V.
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
    mean, square, below = np.empty(species, np.float64), np.empty(species, np.float64), np.empty(species, np.float64)
    u, z = np.empty(4, np.float64), np.zeros(4, np.float32)
    words = np.empty(4, np.uint32)
    density = traps_per_px.sum()
    for i in range(n):
        for r in range(rows):
            trapped[:] = 0.0
            mean[:] = 0.0  # what is trapped without any draw, and Σ T s² of its levels
            square[:] = 0.0
            levels = 0
            for c in range(cols):
                crossed = np.float64(first[i] + c + 1)
                x = np.float64(data[i, r, c])
                if noisy and levels > 0:
                    place_words(key, frame[i], row0[i] + r, at0[i] + step * c, words)
                    normals_of(words, 4, z)
                    for k in range(4):
                        u[k] = (np.float64(words[k]) + 0.5) * 2.0**-32
                for s in range(species):
                    if noisy and trapped[s] > 0.0:
                        whole = np.floor(trapped[s])
                        gone = binomial(whole, 1.0 - stay[s, 1], -1.0 / release_px[s], u[s], np.float64(z[s]))
                        kept = whole - gone + (trapped[s] - whole) * stay[s, 1]
                    else:
                        kept = trapped[s] * stay[s, 1]
                    x += trapped[s] - kept
                    trapped[s] = kept
                    mean[s] *= stay[s, 1]
                    square[s] *= stay[s, 1] ** 2
                if x > 0.0:
                    share = x / well_e
                    volume = min(np.sqrt(share) if fill_beta == 0.5 else share**fill_beta, 1.0)
                    volume = min(volume, x / (density * crossed))
                    found[:] = 0.0
                    below[:] = 0.0
                    low = 0.0
                    while levels > 0 and low < volume:
                        high = min(height[levels - 1], volume)
                        line = at[levels - 1]
                        for s in range(species):
                            full = traps_per_px[s] * (first[i] + line + 1) * (high - low)
                            found[s] += full * stay[s, c - line]
                            below[s] += full * stay[s, c - line] ** 2
                        low = high
                        if height[levels - 1] > volume:
                            break
                        levels -= 1
                    height[levels], at[levels] = volume, c
                    levels += 1
                    for s in range(species):
                        full = traps_per_px[s] * crossed * volume
                        there = found[s]
                        if noisy:
                            all_var, own_var = mean[s] - square[s], found[s] - below[s]
                            if own_var >= 0.999999 * all_var:  # no level lies above
                                there = trapped[s]
                            elif all_var > 0.0:
                                spread = np.sqrt(max(own_var * (all_var - own_var) / all_var, 0.0))
                                there += (trapped[s] - mean[s]) * own_var / all_var + spread * np.float64(z[2 + s])
                            there = min(max(there, 0.0), min(trapped[s], full))
                        caught = full - there
                        trapped[s] += caught
                        x -= caught
                        mean[s] += full - found[s]
                        square[s] += full - below[s]
                out[i, r, c] = x
    return out


@jit
def move_borders(data: Singles, weights: Array, strength_per_e: float, farthest: float) -> Singles:
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
