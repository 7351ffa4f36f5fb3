"""Bands of a large window, so that the work on it stays in the cache: where they may be cut, and how they are joined."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from pixmetry.camera.conversions import Link
from pixmetry.camera.signal import Signal, Windows
from pixmetry.core.random import Grid

TILE_PIXELS = 1 << 16  # of float32: a tile and its copies stay in the second-level cache
BAND_ROWS = 16  # tiles of whole frames are bands of a multiple of this, the largest block of a codec


def cut_bands(windows: Windows, axis: int | None, probe: bool = False) -> list[Windows]:
    """Cut one window into bands along an axis, at multiples of `BAND_ROWS`; for a probe, two of the bands suffice."""
    if axis is None:
        return [windows]
    r0, c0, h, w = (int(v[0]) for v in (windows.row0, windows.col0, windows.rows, windows.cols))
    start, length, other = (r0, h, w) if axis == 0 else (c0, w, h)
    step = max(1, TILE_PIXELS // max(1, other) // BAND_ROWS) * BAND_ROWS
    if probe:
        step = BAND_ROWS
    edges = [start, *range((start // BAND_ROWS + 1) * BAND_ROWS, start + length, step), start + length]
    pairs = list(zip(edges[:-1], edges[1:], strict=True))
    if probe:
        pairs = [pairs[0], pairs[len(pairs) // 2], pairs[-1]]
    return [Windows.one(a, c0, b - a, w) if axis == 0 else Windows.one(r0, a, h, b - a) for a, b in pairs]


def find_segment(elements: Sequence[Link], start: int, windows: Windows) -> tuple[int | None, int]:
    """Return along which axis bands can be cut from element ``start`` on (0 rows, 1 columns, None whole), and how far."""
    best: tuple[int | None, int] = (None, start + 1)
    for axis in (0, 1):
        probe = cut_bands(windows, axis, probe=True)
        end = start
        while end < len(elements) and all(
            _same_span(elements[end].source.window_needed(elements[end].params, p, elements[end].shape), p, axis) for p in probe
        ):
            end += 1
        if end > start and (best[0] is None or end > best[1]):
            best = (axis, end)
    if start == len(elements):
        return 0, start
    return best


def _same_span(needed: Windows, given: Windows, axis: int) -> bool:
    """Whether a source needs just the rows (axis 0) or columns (axis 1) that it makes."""
    names = ("row0", "rows") if axis == 0 else ("col0", "cols")
    return all(np.array_equal(getattr(needed, f), getattr(given, f)) for f in names)


def stitch(parts: Iterable[Signal], grid: Grid, axis: int) -> Signal:
    """Join bands along an axis; each is released as soon as it is copied, so that only few are in memory at a time."""
    parts = iter(parts)
    first = next(parts)
    if first.data.shape == grid.size:
        return first
    whole = replace(first, data=np.empty(grid.size, first.data.dtype), grid=grid)
    at = 0
    for part in chain([first], parts):
        place = slice(at, at + part.data.shape[axis + 1])
        whole.data[(slice(None), place) if axis == 0 else (slice(None), slice(None), place)] = part.data
        at = place.stop
    return whole
