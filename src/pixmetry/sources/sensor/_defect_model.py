"""Which pixels are defect and what they do: drawn by their share, whole columns, clusters, and those listed by the user."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import NormalDist

import numpy as np
from pydantic import NonNegativeFloat, NonNegativeInt

from pixmetry.camera.signal import Signal
from pixmetry.camera.source import Parameters, quantity
from pixmetry.core.random import Grid, Stream

MOST = 0.1  # share of defects beyond which it is not clear what the good pixels are
LOOK_BACK = (8, 256)  # frames looked at together for the last draw of a blinking pixel: at first, and at most
Listed = tuple[NonNegativeInt, NonNegativeInt, NonNegativeFloat, float]


class Defects(Parameters):
    """How many pixels are defect in each way, and how much; which ones is fixed in the unit."""

    hot_fraction: float = quantity(0.0, "1", "share of hot pixels", ge=0, le=MOST)
    hot_median_e: float = quantity(500.0, "e-", "median dark excess of a hot pixel in one exposure", ge=0, le=1e6)
    hot_sigma_log: float = quantity(0.5, "1", "standard deviation of the natural logarithm of the excess", ge=0, le=3)
    dead_fraction: float = quantity(0.0, "1", "share of dead pixels", ge=0, le=MOST)
    dead_gain_rel: float = quantity(0.0, "1", "response of a dead pixel over that of a good one", ge=0, lt=0.5)
    cold_fraction: float = quantity(0.0, "1", "share of pixels whose dark value is too low", ge=0, le=MOST)
    cold_e: float = quantity(200.0, "e-", "what a cold pixel lacks", ge=0, le=1e6)
    gain_fraction: float = quantity(0.0, "1", "share of pixels whose response is off, yet not dead", ge=0, le=MOST)
    gain_std_rel: float = quantity(0.2, "1", "root mean square of their relative response error", ge=0, le=10)
    noisy_fraction: float = quantity(0.0, "1", "share of pixels with too much temporal noise", ge=0, le=MOST)
    noisy_std_e: float = quantity(100.0, "e-", "standard deviation of that noise", ge=0, le=1e6)
    blinking_fraction: float = quantity(0.0, "1", "share of pixels whose dark charge jumps between two levels", ge=0, le=MOST)
    blinking_e: float = quantity(100.0, "e-", "what a blinking pixel has more on its upper level", ge=0, le=1e6)
    blinking_on: float = quantity(0.5, "1", "share of the frames in which it is on its upper level", gt=0, lt=1)
    blinking_frames: float = quantity(
        10.0, "1", "frames, on average, from one draw of its level to the next: correlation (1 − 1/frames)^k", ge=1, le=1000
    )
    stuck_fraction: float = quantity(0.0, "1", "share of pixels that hold the same charge whatever the light", ge=0, le=MOST)
    stuck_e: float = quantity(10_000.0, "e-", "charge of a stuck pixel", ge=0, le=1e7)
    column_fraction: float = quantity(0.0, "1", "share of defect columns", ge=0, le=MOST)
    column_gain_rel: float = quantity(0.0, "1", "response of a defect column over that of a good one", ge=0, le=2)
    column_e: float = quantity(0.0, "e-", "dark excess of a defect column", ge=0, le=1e6)
    cluster_fraction: float = quantity(0.0, "1", "share of pixels that are the centre of a cluster", ge=0, le=0.01)
    cluster_radius_px: float = quantity(1.5, "px", "radius of a cluster", ge=0, le=8)
    cluster_gain_rel: float = quantity(0.0, "1", "response within a cluster over that of good pixels", ge=0, le=2)
    listed: tuple[Listed, ...] = quantity((), "px, px, 1, e-", "known defects: row, column, response, dark excess (0, 0 is a dead one)")

    @property
    def shares(self) -> dict[str, float]:
        """Share of every kind of single defect pixels."""
        return {kind: getattr(self, f"{kind}_fraction") for kind in ("hot", "cold", "gain", "noisy", "blinking", "stuck", "dead")}

    @property
    def none(self) -> bool:
        """Whether there are no defects at all."""
        return not (any(self.shares.values()) or self.column_fraction or self.cluster_fraction or self.listed)


def forward(params: Defects, signal: Signal, stream: Stream) -> Signal:
    """Change the mean signal of the defects; an excess takes part in the shot noise that follows, and no charge falls below zero."""
    p = params
    known = stream.known_unit("pixels")
    if known is None and p.none:
        return signal
    data = signal.data.copy()
    if known is not None:
        data = _of_unit(known, data, signal, stream)
    elif any(p.shares.values()):
        lot = stream.uniform_fixed(signal.grid)
        for kind, (low, high) in _bands(p).items():
            if low == high:
                continue
            i, r, c = np.nonzero((lot >= low) & (lot < high))
            if len(i):
                single = Grid(signal.grid.frame[i], signal.rows[i, r], signal.cols[i, c], (1, 1))
                data[i, r, c] = CHANGES[kind](p, data[i, r, c], single, stream)
    if p.column_fraction:
        bad = _columns(p, signal.grid, stream)[:, None, :]
        data = np.where(bad, data * np.float32(p.column_gain_rel) + np.float32(p.column_e), data)
    if p.cluster_fraction:
        data = np.where(_clusters(p, signal.grid, stream), data * np.float32(p.cluster_gain_rel), data)
    for row, col, response, excess_e in p.listed:
        i, r, c = np.nonzero((signal.rows == row)[:, :, None] & (signal.cols == col)[:, None, :])
        data[i, r, c] = np.maximum(data[i, r, c] * np.float32(response) + np.float32(excess_e), 0)
    return signal.with_data(data)


def _of_unit(pixels: np.ndarray, data: np.ndarray, signal: Signal, stream: Stream) -> np.ndarray:
    """Change the defects of a measured unit: one row each with row, column, response, dark excess and temporal noise in electrons."""
    row0, col0, (rows, cols) = signal.grid.row0, signal.grid.col0, signal.grid.shape
    r, c = pixels[:, 0].astype(int) - row0[:, None], pixels[:, 1].astype(int) - col0[:, None]
    i, k = np.nonzero((r >= 0) & (r < rows) & (c >= 0) & (c < cols))
    if len(i):
        r, c = r[i, k], c[i, k]
        single = Grid(signal.grid.frame[i], row0[i] + r, col0[i] + c, (1, 1))
        response, excess_e, noise_e = pixels[k, 2:5].astype(np.float32).T
        data[i, r, c] = np.maximum(data[i, r, c] * response + excess_e + noise_e * stream.normal(single)[:, 0, 0], 0)
    return data


def truth(params: Defects, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Masks of the unit, by kind; ``listed`` are those given, or those that were measured in this unit."""
    one = signal.take(np.array([0]))
    lot = stream.uniform_fixed(one.grid)[0]
    known = stream.known_unit("pixels")
    masks = {kind: (lot >= low) & (lot < high) & (known is None) for kind, (low, high) in _bands(params).items()}
    masks["column"] = np.broadcast_to(_columns(params, one.grid, stream)[0], lot.shape).copy()
    masks["cluster"] = _clusters(params, one.grid, stream)[0]
    masks["listed"] = np.zeros(lot.shape, bool)
    for row, col in [*(entry[:2] for entry in params.listed), *([] if known is None else known[:, :2].astype(int).tolist())]:
        masks["listed"] |= (one.rows[0] == row)[:, None] & (one.cols[0] == col)
    return masks


def _bands(params: Defects) -> dict[str, tuple[float, float]]:
    """Which part of (0, 1) of the pixel's lot makes it a defect of each kind; the dead ones lie at the top."""
    bands, low = {}, 0.0
    for kind, share in params.shares.items():
        bands[kind] = (low, low + share) if kind != "dead" else (1 - share, 2.0) if share else (1.0, 1.0)
        low += share
    return bands


def _columns(params: Defects, grid: Grid, stream: Stream) -> np.ndarray:
    """Which columns are defect, shape (n, cols)."""
    if not params.column_fraction:
        return np.zeros((len(grid.frame), grid.shape[1]), bool)
    return stream.normal_cols_fixed(grid) > np.float32(NormalDist().inv_cdf(1 - params.column_fraction))


def _clusters(params: Defects, grid: Grid, stream: Stream) -> np.ndarray:
    """Which pixels lie within the radius of the centre of a cluster, shape (n, rows, cols)."""
    rows, cols = grid.shape
    reach = int(params.cluster_radius_px)
    if not params.cluster_fraction:
        return np.zeros(grid.size, bool)
    wide = Grid(grid.frame, grid.row0 - reach, grid.col0 - reach, (rows + 2 * reach, cols + 2 * reach))
    centre = stream.uniform_fixed(wide, draw=1) < params.cluster_fraction
    inside = np.zeros(grid.size, bool)
    for dr, dc in disc(params.cluster_radius_px):
        inside |= centre[:, reach + dr : reach + dr + rows, reach + dc : reach + dc + cols]
    return inside


def disc(radius_px: float) -> list[tuple[int, int]]:
    """Row and column steps to the pixels within a radius."""
    reach = range(-int(radius_px), int(radius_px) + 1)
    return [(dr, dc) for dr in reach for dc in reach if dr * dr + dc * dc <= radius_px**2]


def blinking_level(params: Defects, single: Grid, stream: Stream) -> np.ndarray:
    """Level, 0 or 1, of blinking pixels given one by one with their frames, shape (n,); its mean where the stream is quiet.

    In each frame a pixel draws its level anew with probability 1/``blinking_frames``, else it keeps it: a stationary Markov chain, which
    for any frame is found by looking back for the last draw.
    """
    if stream.quiet:
        return np.full(len(single.frame), params.blinking_on, np.float32)
    drawn = np.zeros_like(single.frame)
    open_, back, step = np.arange(len(drawn)), 0, LOOK_BACK[0]
    while len(open_):
        frames = np.maximum(single.frame[open_, None] - back - np.arange(step), 0)
        there = Grid(frames.ravel(), np.repeat(single.row0[open_], step), np.repeat(single.col0[open_], step), (1, 1))
        anew = (stream.uniform(there)[:, 0, 0].reshape(frames.shape) < 1 / params.blinking_frames) | (frames == 0)
        hit = anew.any(axis=1)
        drawn[open_[hit]] = frames[hit, anew[hit].argmax(axis=1)]
        open_, back, step = open_[~hit], back + step, min(2 * step, LOOK_BACK[1])
    at = Grid(drawn, single.row0, single.col0, (1, 1))
    return (stream.uniform(at, draw=1)[:, 0, 0] < params.blinking_on).astype(np.float32)


def _heat(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return value + np.float32(params.hot_median_e) * np.exp(np.float32(params.hot_sigma_log) * stream.normal_fixed(single)[:, 0, 0])


def _cool(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return np.maximum(value - np.float32(params.cold_e), 0)


def _respond(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return value * np.maximum(1 + np.float32(params.gain_std_rel) * stream.normal_fixed(single)[:, 0, 0], 0)


def _flicker(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return np.maximum(value + np.float32(params.noisy_std_e) * stream.normal(single)[:, 0, 0], 0)


def _blink(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return value + np.float32(params.blinking_e) * blinking_level(params, single, stream)


def _stick(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return np.full_like(value, params.stuck_e)


def _deaden(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return value * np.float32(params.dead_gain_rel)


CHANGES = {"hot": _heat, "cold": _cool, "gain": _respond, "noisy": _flicker, "blinking": _blink, "stuck": _stick, "dead": _deaden}
