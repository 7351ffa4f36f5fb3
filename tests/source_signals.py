"""Signals, a target and a plain centroid for the tests of single sources."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.contribution import Probe
from pixmetry.camera.signal import Kind, Signal
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, QuietStreams, Stream

ALPHA = 1e-6  # false-failure rate of every statistical test, for any seed
Z = 4.8917  # two-sided normal quantile of ALPHA
K_DN_PER_E = 0.01


def stream(rng: np.random.Generator | int) -> Stream:
    """A stream of some unit and of some exposures: drawn, or those of a seed."""
    draw = np.random.default_rng(rng)
    return Stream(int(draw.integers(2**62)), int(draw.integers(2**62)), "source under test")


def quiet():
    """A stream of which every draw is at its mean: electrons move by their shares."""
    return QuietStreams(0, 0).of("source under test")


def signal(data: np.ndarray, kind: Kind = Kind.ELECTRONS, row0: int = 0, col0: int = 0, frame_shape=None, **schedule) -> Signal:
    """Frames 0, 1, … (or one window of each of them)."""
    data = np.ascontiguousarray(data, np.float32)
    n = len(data)
    grid = Grid(np.arange(n), np.full(n, row0), np.full(n, col0), data.shape[1:])
    values = {"exposure_s": 0.01, "time_s": 0.0, "temperature_c": 20.0} | schedule
    spread = {k: np.broadcast_to(np.asarray(v, float), (n,)) for k, v in values.items()}
    return Signal(data, kind, grid, frame_shape or data.shape[1:], **spread)


def flat(level: float, shape: tuple[int, int], n: int = 1, kind: Kind = Kind.ELECTRONS, **kw) -> Signal:
    """The same number everywhere."""
    return signal(np.full((n, *shape), level, np.float32), kind, **kw)


def spots(x: np.ndarray, y: np.ndarray, size: int = 25, sigma: float = 2.0, peak: float = 150.0) -> np.ndarray:
    """Gaussian spots with these centres, in DN; wide enough that sampling does not show."""
    axis = np.arange(size)
    along_x = np.exp(-0.5 * ((axis - x[:, None]) / sigma) ** 2)
    along_y = np.exp(-0.5 * ((axis - y[:, None]) / sigma) ** 2)
    return peak * along_y[:, :, None] * along_x[:, None, :]


def centroid(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Plain centroid over the whole window."""
    total = image.sum(axis=(1, 2))
    rows, cols = (np.arange(n) for n in image.shape[1:])
    return (image.sum(axis=1) * cols).sum(axis=1) / total, (image.sum(axis=2) * rows).sum(axis=1) / total


def centroid_probe(image: np.ndarray, x: np.ndarray, y: np.ndarray, frame_shape=(480, 640)) -> Probe:
    """The probe of noise-free windows without background for `centroid`, whose gradient is (x_i − x̂)/ΣI."""
    x_hat, y_hat = centroid(image)
    total = image.sum(axis=(1, 2))[:, None, None]
    rows, cols = (np.arange(n) for n in image.shape[1:])
    gx = (cols[None, None, :] - x_hat[:, None, None]) / total + 0 * image
    gy = (rows[None, :, None] - y_hat[:, None, None]) / total + 0 * image
    return Probe(image, 0.0, x, y, x_hat, y_hat, gx, gy, K_DN_PER_E, 0.01, 20.0, 8, frame_shape)


def spot_probe(n: int = 16, **kw) -> Probe:
    """Gaussian spots at n places within the pixel."""
    x, y = 12 + np.linspace(-0.5, 0.5, n, endpoint=False), 12 + np.linspace(-0.5, 0.5, n, endpoint=False)[::-1] * 0.7
    return centroid_probe(spots(x, y, **kw), x, y)


def fitted(**rows: tuple[float, float, str]) -> Estimates:
    """A stand-in for a joint fit: name = (value, u, unit)."""
    return Estimates.from_rows([(name, value, u, 50.0, unit) for name, (value, u, unit) in rows.items()])
