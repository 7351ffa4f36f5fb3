"""Contribution of a source of the video line: the target behind the rest of the line, with the source and without."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.line import Held, Line
from pixmetry.core.random import Grid


def held_of(probe: Probe) -> Held:
    """Where a probe's camera has no line, its pixels are held on a bare one at its clock, and sampled in their middle."""
    if probe.held is not None:
        return probe.held
    n, rows, cols = probe.signal_dn.shape
    zero = np.zeros(n, np.int64)
    grid = Grid(zero, zero, zero, (rows, cols))

    def locate(samples_dn: np.ndarray, level: float, which: Any = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        if probe.locate is not None:
            x, y = probe.locate(samples_dn / level)  # bare: it does not ask for the phase
            return x, y
        change = samples_dn / level - probe.signal_dn[which]
        x, y = ((g[which] * change).sum(axis=(1, 2)) for g in (probe.gx, probe.gy))
        return probe.x_hat_px[which] + x, probe.y_hat_px[which] + y

    return Held(Line(probe.pixel_clock_hz, probe.pixel_clock_hz), grid, grid, probe.gx, probe.gy, locate)


def through_line(probe: Probe, change: Callable[[Line], Line], gum_class: str = "G", **kw: Any) -> Contribution:
    """Contribution of filters and echoes: the probe's windows are seen through the rest of the line, and with the change to it."""
    held = held_of(probe)
    lines = held.line, change(held.line)
    (x0, y0), (x1, y1) = (held.locate(held.read(line, probe.signal_dn, probe.background_dn), line.level) for line in lines)
    nothing_smooth = {} if gum_class == "D" else {"smooth_px": (0.0, 0.0)}  # what is not constant hangs on the phase in the pixel
    method = "the estimator on the target after the line, with it and without"
    return probe.from_shifts(x1 - x0, y1 - y0, gum_class, method=method, **(nothing_smooth | kw))


def row_shifts(probe: Probe, delay_s: np.ndarray) -> np.ndarray:
    """Shift of the estimated x and y when one row alone comes late by each of these delays, shape (2, delays, p, rows)."""
    held = held_of(probe)
    usual = held.read(held.line, probe.signal_dn, probe.background_dn)
    found = np.zeros((2, len(delay_s), *usual.shape[:2]))
    at = np.array(held.locate(usual, held.line.level))
    for k, late in enumerate(delay_s):
        line = held.line.delayed(np.full((1, 1), float(late)))
        seen = held.read(line, probe.signal_dn, probe.background_dn)
        phase, row = np.nonzero((seen != usual).any(axis=2) & ((held.gx != 0) | (held.gy != 0)).any(axis=2))
        windows = usual[phase]
        windows[np.arange(len(row)), row] = seen[phase, row]
        found[:, k, phase, row] = np.array(held.locate(windows, line.level, phase)) - at[:, phase]
    return found


NODES = 5  # of the Gauss–Hermite quadrature over the normal law of a row's delay


def from_row_delays(
    probe: Probe, white_s: float, alike_s: float, length_rows: float, stride: int
) -> tuple[tuple[float, float], tuple[float, float]]:
    """u and bias, each of x and y, from normal delays of the rows: independent ones, and ones that are alike over some rows of a field.

    Every row answers to its delay as the camera's line lets it, which need not be in proportion: a bare staircase does not see small
    ones. Its mean and its variance are those over the delay's law; two rows vary together as far as both follow their delays in
    proportion, cov = b_r b_s cov(δ_r, δ_s) (the first term of Hermite's expansion).
    """
    sigma = float(np.hypot(white_s, alike_s))
    if sigma == 0:
        return (0.0, 0.0), (0.0, 0.0)
    node, weight = np.polynomial.hermite_e.hermegauss(NODES)
    weight = weight / weight.sum()
    shift = row_shifts(probe, sigma * node)
    mean = np.tensordot(shift, weight, axes=(1, 0))
    own = np.tensordot(shift**2, weight, axes=(1, 0)) - mean**2
    slope = np.tensordot(shift, weight * node, axes=(1, 0)) / sigma
    apart = np.arange(mean.shape[2])[:, None] - np.arange(mean.shape[2])
    alike = np.where((apart % stride == 0) & (apart != 0), alike_s**2 * np.exp(-np.abs(apart) / stride / length_rows), 0.0)
    variance = own.sum(axis=2) + np.einsum("apr,rs,aps->ap", slope, alike, slope)
    scatter = np.var(mean.sum(axis=2), axis=1)
    u_x, u_y = np.sqrt(variance.mean(axis=1) + scatter).tolist()
    bias_x, bias_y = mean.sum(axis=2).mean(axis=1).tolist()
    return (u_x, u_y), (bias_x, bias_y)


MOST_PLACES = 512


def from_steady_delays(probe: Probe, delay_s: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shifts of x and y at places down the frame by delays that are the same in every frame, a function of the rows; and those rows."""
    held = held_of(probe)
    rows = held.samples.shape[0]
    start, end = held.rows_seen or (0, probe.frame_shape[0])
    last = max(end - rows, start)
    first = np.unique(np.linspace(start, last, min(last - start + 1, MOST_PLACES)).round().astype(np.int64))
    which = np.arange(len(first)) % len(probe.signal_dn)
    late = held.line.delayed(lambda grid: delay_s(grid.row0[:, None] + np.arange(grid.shape[0])))
    found = []
    for line in (held.line, late):
        seen = held.read(line, probe.signal_dn[which], probe.background_dn, which, first)
        found.append(held.locate(seen, line.level, which))
    (x0, y0), (x1, y1) = found
    return x1 - x0, y1 - y0, first
