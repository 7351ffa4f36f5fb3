"""Kernels of the background: statistics of tiles, which of them are background, and the map between them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pixmetry.core.arrays import Array, Flags, Ints, Singles
from pixmetry.core.jit import jit

ROWS_SEEN = 6  # of a tile, spread over it: its statistics look at these only, and at whole rows because those load fast
MOST_SEEN = 1024  # pixels
CLIP = 3.0  # standard deviations kept by a clipped moment
KEPT = 1.0 / 0.97334  # variance of a normal distribution over that of its part within ±CLIP: 1 − 2·3·φ(3)/(2Φ(3) − 1)
ROUNDS = 4
HALVINGS = 16
OUTER = 0.13  # of the quantile of a covered tile's ground: a quantile farther out, on the side without targets
OUTER_SIGMA = 1.2  # distance of the two where the ground is a third of the tile, 1.4 σ, to where it is the whole, 1.0 σ
MANY = 0.25  # share of a tile's pixels at an end of the scale from which on its background is taken as clipped there
SWEEPS = 30  # of relaxation, over what is filled in
SUM_FREELY = {"reassoc", "nsz"}  # a clipped sum is not sensitive to the order of its terms, and four times as fast in any order


class Map(NamedTuple):
    """Values at the middles of tiles, which a map joins."""

    nodes: Array  # shape (rows, columns) of tiles
    row_scale: float  # tiles per pixel along y
    col_scale: float  # and along x


@jit
def quantile_of(values: Singles, share: float, low: np.float32, high: np.float32, grain: np.float32) -> np.float32:
    """Quantile of values between low and high, by halving: to 2⁻¹⁶ of their range, or the grain."""
    count = share * len(values)
    for _ in range(HALVINGS):
        if high - low <= grain:
            break
        middle = np.float32(0.5) * (low + high)
        below = np.int32(0)
        for i in range(len(values)):
            below += np.int32(values[i] <= middle)
        if below >= count:
            high = middle
        else:
            low = middle
    return np.float32(0.5) * (low + high)


@jit(fastmath=SUM_FREELY | {"nnan"})
def least_and_most(values: Singles) -> tuple[np.float32, np.float32]:
    """The smallest and the largest of the values."""
    least, most = values[0], values[0]
    for i in range(len(values)):
        least, most = min(least, values[i]), max(most, values[i])
    return least, most


@jit(fastmath=SUM_FREELY)
def clipped_moments(values: Singles, centre: np.float32, limit: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """Number, mean and mean square about ``centre`` of the values within ``limit`` of it."""
    kept, total, square = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for i in range(len(values)):
        d = values[i] - centre
        weight = np.float32(1.0) if abs(d) <= limit else np.float32(0.0)  # a product takes no branch
        kept += weight
        total += weight * d
        square += weight * d * d
    most = max(kept, np.float32(1.0))
    return kept, total / most, square / most


@jit
def clipped_rms(values: Singles, share: float, grain: np.float32) -> float:
    """Root mean square of values ≥ 0, of which those beyond three times it are left out; it starts from their median.

    Or from a lower quantile, which is made as large as the median of a normal distribution would be (to 5 % from 0.1 to 0.5).
    """
    if len(values) == 0:
        return 0.0
    middle = quantile_of(values, share, np.float32(0.0), least_and_most(values)[1], grain) * np.float32(0.5 / share)
    limit = np.float32(4.0) * middle + np.float32(2.0) * grain
    rms = np.float32(0.0)
    for _ in range(ROUNDS):
        square = clipped_moments(values, np.float32(0.0), limit)[2]
        rms = np.float32(math.sqrt(KEPT * square))
        if CLIP * rms >= limit:
            break
        limit = np.float32(CLIP) * rms + grain
    return float(rms)


@jit
def row_step(rows: int, wide: int) -> int:
    """Every how many rows of a tile its statistics look."""
    return max(rows // ROWS_SEEN, rows * wide // MOST_SEEN + 1, 1)


@jit
def seen(
    frame: np.ndarray, first_row: int, stop_row: int, first_col: int, stop_col: int, values: Singles, steps: Singles
) -> tuple[int, int]:
    """Copy the rows of a tile that its statistics look at, and the absolute differences along them; return how many there are."""
    wide = stop_col - first_col
    step = row_step(stop_row - first_row, wide)
    n, m = 0, 0
    for r in range(first_row, stop_row, step):
        row, out, change = frame[r, first_col:stop_col], values[n : n + wide], steps[m : m + wide]
        for c in range(wide):
            out[c] = row[c]
        for c in range(wide - 1):
            change[c] = abs(out[c + 1] - out[c])
        n += wide
        m += wide - 1
    return n, m


@jit
def lone_pixels(frame: np.ndarray, first_row: int, stop_row: int, first_col: int, stop_col: int, end_dn: float) -> tuple[int, int, float]:
    """Among pixels whose four neighbours are all at an end of the scale: how many, how many that are not, and how far these are from it.

    Neighbours at the end say nothing about the noise of the pixel, but that there is no target: so these pixels show the background's.
    """
    lone, lit, light = 0, 0, 0.0
    for r in range(max(first_row, 1), min(stop_row, frame.shape[0] - 1), 2):
        for c in range(max(first_col, 1), min(stop_col, frame.shape[1] - 1)):
            if frame[r, c - 1] == end_dn and frame[r, c + 1] == end_dn and frame[r - 1, c] == end_dn and frame[r + 1, c] == end_dn:
                lone += 1
                if frame[r, c] != end_dn:
                    lit += 1
                    light += abs(float(frame[r, c]) - end_dn)
    return lone, lit, light


@jit
def tile_levels(
    frame: np.ndarray, edge_row: Ints, edge_col: Ints, first: int, stop: int, low_dn: float, high_dn: float, grain: np.float32, share: float
) -> Array:
    """Medians, or other quantiles, of the tiles of some tile rows, and their noise; shape (6, stop − first, columns).

    Quantile; standard deviation from the clipped differences of horizontal neighbours; the end of the scale, −1 or 1, at which many of the
    pixels are, or 0; and there what `lone_pixels` says.
    """
    columns = len(edge_col) - 1
    out = np.zeros((6, stop - first, columns))
    values, steps = np.empty(3 * MOST_SEEN, np.float32), np.empty(3 * MOST_SEEN, np.float32)
    for t in range(first, stop):
        for u in range(columns):
            a, b, c, d = edge_row[t], edge_row[t + 1], edge_col[u], edge_col[u + 1]
            n, m = seen(frame, a, b, c, d, values, steps)
            least, most = least_and_most(values[:n])
            tile = out[:, t - first, u]
            tile[0] = quantile_of(values[:n], share, least, most, grain)
            tile[1] = clipped_rms(steps[:m], min(share, 1.0 - share), grain) / math.sqrt(2.0)
            if share != 0.5:
                tail = OUTER * share if share < 0.5 else 1.0 - OUTER * (1.0 - share)
                tile[1] = min(tile[1], abs(tile[0] - quantile_of(values[:n], tail, least, most, grain)) / OUTER_SIGMA)
            if least <= low_dn and np.count_nonzero(values[:n] <= low_dn) > MANY * n:
                tile[2] = -1.0
                tile[3], tile[4], tile[5] = lone_pixels(frame, a, b, c, d, low_dn)
            elif most >= high_dn and np.count_nonzero(values[:n] >= high_dn) > MANY * n:
                tile[2] = 1.0
                tile[3], tile[4], tile[5] = lone_pixels(frame, a, b, c, d, high_dn)
    return out


@jit
def tile_moments(
    frame: np.ndarray, edge_row: Ints, edge_col: Ints, first: int, stop: int, start: Array, slope_x: Array, slope_y: Array, noise: Array
) -> Array:
    """Clipped mean, standard deviation and share kept about a plane of given slopes, tile by tile; shape (3, stop − first, columns)."""
    columns = len(edge_col) - 1
    out = np.zeros((3, stop - first, columns))
    values, steps = np.empty(3 * MOST_SEEN, np.float32), np.empty(3 * MOST_SEEN, np.float32)
    for t in range(first, stop):
        for u in range(columns):
            a, b, c, d = edge_row[t], edge_row[t + 1], edge_col[u], edge_col[u + 1]
            n = seen(frame, a, b, c, d, values, steps)[0]
            wide, high = d - c, n // (d - c)
            step = row_step(b - a, wide)
            for k in range(high):
                row = values[k * wide : (k + 1) * wide]
                offset = np.float32(slope_y[t, u] * (k * step - 0.5 * (b - a - 1)) - slope_x[t, u] * 0.5 * (wide - 1))
                slope = np.float32(slope_x[t, u])
                for i in range(wide):
                    row[i] -= offset + slope * np.float32(i)
            mean, spread, kept = np.float32(start[t, u]), np.float32(2.0 * noise[t, u]), np.float32(0.0)
            for _ in range(ROUNDS):
                kept, shift, square = clipped_moments(values[:n], mean, np.float32(CLIP) * spread)
                if kept == 0:
                    break
                mean += shift
                spread = np.float32(math.sqrt(max(KEPT * (square - shift * shift), noise[t, u] ** 2)))
            out[0, t - first, u], out[1, t - first, u], out[2, t - first, u] = mean, spread, kept / max(n, 1)
    return out


@jit
def settle(offset: Array, plausible: Flags, jump: float) -> None:
    """Tell background from targets that fill whole tiles, and fill in the background under these.

    ``offset`` is how far the tiles lie from a smooth surface; it is background where it is small, and next to background where it goes on
    from there without a jump, level or straight. The rest is filled in from the outside, and made as even as its rim. In place.
    """
    rows, cols = offset.shape
    known = plausible & (np.abs(offset) < jump)
    changed = bool(known.any())
    if not changed:
        offset[:] = 0.0
        return
    while changed:
        changed = False
        for backwards in range(2):
            for k in range(rows * cols):
                at = rows * cols - 1 - k if backwards else k
                r, c = at // cols, at % cols
                if plausible[r, c] and not known[r, c] and goes_on(offset, known, r, c, jump):
                    known[r, c] = changed = True
    left = rows * cols - np.count_nonzero(known)
    filled = ~known
    while left > 0:
        before = known.copy()
        for r in range(rows):
            for c in range(cols):
                if not before[r, c]:
                    weight, value = from_around(offset, before, r, c)
                    if weight > 0.0:
                        offset[r, c] = value
                        known[r, c] = True
                        left -= 1
    for _ in range(SWEEPS):
        for r in range(rows):
            for c in range(cols):
                across, down = 0 < c < cols - 1, 0 < r < rows - 1
                if filled[r, c] and (across or down):
                    total = offset[r, c - 1] + offset[r, c + 1] if across else 0.0
                    total += offset[r - 1, c] + offset[r + 1, c] if down else 0.0
                    offset[r, c] = total / (2.0 * across + 2.0 * down)


@jit
def from_around(offset: Array, known: Flags, r: int, c: int) -> tuple[float, float]:
    """What the known neighbours make of a tile: the mean of two that face each other, the straight line through two, or one alone.

    Each counts ten times as much as the next.
    """
    rows, cols = offset.shape
    weight, total = 0.0, 0.0
    for dr, dc in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        i, j = r + dr, c + dc
        if not (0 <= i < rows and 0 <= j < cols and known[i, j]):
            continue
        near, facing, behind = offset[i, j], (r - dr, c - dc), (i + dr, j + dc)
        w, value = 0.01, near
        if 0 <= facing[0] < rows and 0 <= facing[1] < cols and known[facing[0], facing[1]]:
            w, value = 1.0, 0.5 * (near + offset[facing[0], facing[1]])
        elif 0 <= behind[0] < rows and 0 <= behind[1] < cols and known[behind[0], behind[1]]:
            w, value = 0.1, 2.0 * near - offset[behind[0], behind[1]]
        weight += w
        total += w * value
    return weight, total / max(weight, 1e-9)


@jit
def goes_on(offset: Array, known: Flags, r: int, c: int, jump: float) -> bool:
    """Whether a tile goes on from a known neighbour, at its level or straight on from the one behind it."""
    rows, cols = offset.shape
    for dr, dc in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        i, j = r + dr, c + dc
        if 0 <= i < rows and 0 <= j < cols and known[i, j]:
            near = offset[i, j]
            if abs(offset[r, c] - near) < jump:
                return True
            i, j = i + dr, j + dc
            if 0 <= i < rows and 0 <= j < cols and known[i, j] and abs(offset[r, c] - 2.0 * near + offset[i, j]) < jump:
                return True
    return False


@jit
def group_medians(values: Array, side: int) -> Array:
    """Medians of square groups of tiles."""
    rows, cols = (values.shape[0] + side - 1) // side, (values.shape[1] + side - 1) // side
    out = np.empty((rows, cols))
    for r in range(rows):
        for c in range(cols):
            out[r, c] = np.median(values[r * side : (r + 1) * side, c * side : (c + 1) * side].copy())
    return out


@jit
def map_at(tiles: Map, x: float, y: float) -> tuple[float, float, float]:
    """Value and slopes along x and y of a map between the middles of its tiles, straight on beyond the outermost ones."""
    nodes, row_scale, col_scale = tiles
    rows, cols = nodes.shape
    v, u = (y + 0.5) * row_scale - 0.5, (x + 0.5) * col_scale - 0.5
    i = min(max(int(math.floor(v)), 0), max(rows - 2, 0))
    j = min(max(int(math.floor(u)), 0), max(cols - 2, 0))
    k, m = min(i + 1, rows - 1), min(j + 1, cols - 1)
    f, g = (v - i) if rows > 1 else 0.0, (u - j) if cols > 1 else 0.0
    top = nodes[i, j] + g * (nodes[i, m] - nodes[i, j])
    bottom = nodes[k, j] + g * (nodes[k, m] - nodes[k, j])
    across = (1.0 - f) * (nodes[i, m] - nodes[i, j]) + f * (nodes[k, m] - nodes[k, j])
    return top + f * (bottom - top), across * col_scale, (bottom - top) * row_scale


@jit
def map_values(tiles: Map, x: Array, y: Array) -> Array:
    """`map_at` for arrays; shape (3, n)."""
    out = np.empty((3, len(x)))
    for i in range(len(x)):
        out[0, i], out[1, i], out[2, i] = map_at(tiles, x[i], y[i])
    return out
