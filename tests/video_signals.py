"""Signals of the video line for the tests of single sources, and what is seen of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from catalogue.support import disc_tile, probe_of
from pixmetry.camera.contribution import Probe
from pixmetry.camera.line import Line
from pixmetry.camera.signal import Clock, Kind, Signal
from pixmetry.camera.source import Source
from pixmetry.core.random import Grid
from source_signals import signal, stream

PIXEL_HZ = 14.1875e6
SMOOTH = ([], 2 * np.pi * 4e6 * np.array([-0.87 + 0.5j, -0.87 - 0.5j]))  # a filter that makes the line smooth between its samples


def video(data: np.ndarray, smooth: bool = False, pixel_hz: float = PIXEL_HZ, **kw: object) -> Signal:
    """Frames 0, 1, … (or a part of them) on the line."""
    line = Line(pixel_hz, pixel_hz)
    return replace(signal(data, Kind.VIDEO, **kw), clock=Clock(pixel_hz), line=line.filtered(*SMOOTH) if smooth else line)


def sampled(on_line: Signal, fine: int = 1) -> np.ndarray:
    """What a sampling sees, ``fine`` samples a period of its clock; shape (n, rows, samples), float64."""
    line = on_line.line
    samples = fine * (line.samples or on_line.data.shape[2])
    line = replace(line, sample_clock_hz=fine * line.sample_clock_hz, samples=samples)
    grid = Grid(on_line.grid.frame, on_line.grid.row0, np.zeros(len(on_line)), (on_line.data.shape[1], samples))
    return line.read(on_line.data, on_line.grid.col0, grid).astype(float)


def seen(
    rng: np.random.Generator, source: Source, params: object, data: np.ndarray, draws: object = None, smooth: bool = False, **kw: object
) -> np.ndarray:
    """Frames on the line after a source, sampled."""
    return sampled(source.forward(params, video(data, smooth, **kw), draws or stream(rng)))


def row_of(values: np.ndarray) -> np.ndarray:
    """One frame of one row."""
    return np.asarray(values, np.float32)[None, None]


def bump(centre: float = 100.0, cols: int = 400, sigma: float = 2.0) -> np.ndarray:
    """A smooth target along a row."""
    return 150 * np.exp(-0.5 * ((np.arange(cols) - centre) / sigma) ** 2)


def centre(rows: np.ndarray) -> np.ndarray:
    """Centroid along the last axis."""
    return (rows * np.arange(rows.shape[-1])).sum(axis=-1) / rows.sum(axis=-1)


def standard_probe(half: int = 6) -> Probe:
    """Discs of 7 px and 150 DN under a blur of 0.7 px, without background, seen by the plain centroid within a radius of ``half`` px."""
    at = (np.arange(8) + 0.5) / 8 - 0.5
    x, y = at, at[::-1] * 0.7
    tiles = np.array([150 * disc_tile(a, b) for a, b in zip(x, y, strict=True)])
    cut = tiles.shape[1] // 2 - half
    windows = tiles[:, cut : cut + 2 * half + 1, cut : cut + 2 * half + 1]
    radius = np.hypot(np.arange(2 * half + 1)[:, None] - half - y[:, None, None], np.arange(2 * half + 1) - half - x[:, None, None])
    probe = probe_of(windows * (radius <= half), half + x, half + y, -1e-9, 0.0, (582, 752))
    return replace(probe, gx=probe.gx * (radius <= half), gy=probe.gy * (radius <= half))
