"""Correction of samples of the line for a cable, with any filters before and behind it.

The samples of a row are y = A x, with x the pixels that were held and A what the whole line makes of each of them: the line is exact, so
A is. Without the cable they would have been B x. So the correction is y − (A − B) x̂, with x̂ the pixels of least squares, min |A x − y|²
+ λ|x − x₀|², and x₀ the samples themselves, at the places where pixels are seen, straight between them. λ keeps what the line has damped
below a hundredth (the highest frequencies behind a low-pass, the nulls of an open branch) from being raised out of the noise; that part
of the error stays. Where the grabber's clock is the camera's, x̂ is the pixels, and the correction exact but for λ. A slower clock takes
fewer samples than there are pixels: then x̂ is the row next to x₀ that explains them, and some hundredths of the error stay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np

from pixmetry.camera.line import Line
from pixmetry.camera.signal import Signal
from pixmetry.core.arrays import Array
from pixmetry.core.errors import ParameterError
from pixmetry.core.random import Grid
from pixmetry.core.threads import single_threaded_blas

RIDGE = 1e-4  # λ, over the square of a constant level's gain
MARGIN_PX = 64  # to the left of the samples, where they are not the row's first
MOST_PIXELS = 4096  # in a row


def without(signal: Signal, through: Callable[[Line], Line]) -> Signal:
    """Take the effect of one source off the samples of a line.

    Parameters
    ----------
    signal : Signal
        Samples in DN above black. Its ``line`` is the rest of the line, without this source; none: the camera's pixels on a bare one.
    through : callable
        Adds the source to a line.

    Raises
    ------
    ParameterError
        If a row has more than 4096 pixels or samples.

    Notes
    -----
    Delays of rows and of the clock (jitter, warm-up) move the cable's effect with the picture: they are left out of A and B alike.
    """
    rest = signal.line or Line(signal.clock.pixel_hz, signal.clock.pixel_hz)
    keys = _key(rest), _key(through(rest))
    out = np.empty(signal.data.shape, np.float32)
    with single_threaded_blas():
        for col0 in np.unique(signal.grid.col0):
            mine = signal.grid.col0 == col0
            samples = signal.data[mine].astype(np.float64)
            out[mine] = samples - samples @ _effect(*keys, int(col0), samples.shape[2]).T
    return replace(signal, data=out, line=None)


Key = tuple[float, float, float, int | None, tuple[tuple[bytes, bytes], ...], tuple[bytes, bytes] | None]


def _key(line: Line) -> Key:
    """All of a line but delays of rows and clock, for the store of effects."""
    filters = tuple((z.tobytes(), p.tobytes()) for z, p in line.filters)
    delay, amplitude = line.echo_delay_s, line.echo_amplitude
    echoes = None if delay is None or amplitude is None else (delay.tobytes(), amplitude.tobytes())
    return line.pixel_clock_hz, line.sample_clock_hz, line.start_s, line.samples, filters, echoes


def _line(key: Key) -> Line:
    pixel_hz, sample_hz, start_s, samples, filters, echoes = key
    line = Line(pixel_hz, sample_hz, start_s=start_s, samples=samples)
    line = replace(line, filters=tuple((np.frombuffer(z, complex), np.frombuffer(p, complex)) for z, p in filters))
    if echoes is None:
        return line
    return replace(line, echo_delay_s=np.frombuffer(echoes[0], float), echo_amplitude=np.frombuffer(echoes[1], float))


@lru_cache(maxsize=4)
def _effect(rest_key: Key, whole_key: Key, col0: int, samples: int) -> np.ndarray:
    """What the source adds to every sample, as a matrix that takes the samples; shape (samples, samples)."""
    rest, whole = _line(rest_key), _line(whole_key)
    ends = rest.pixels(np.array([col0, col0 + samples - 1], float))
    first = max(int(np.floor(ends[0])) - (MARGIN_PX if col0 else 0), 0)
    pixels = max(int(np.ceil(ends[1])) + 2 - first, 1)
    if max(pixels, samples) > MOST_PIXELS:
        raise ParameterError(
            "the row is too long for the correction of the cable", value=max(pixels, samples), allowed=f"{MOST_PIXELS} pixels or fewer"
        )
    a, b = (_matrix(line, col0, samples, first, pixels) for line in (whole, rest))
    late = np.arange(first, first + pixels) + whole.delay_s * whole.pixel_clock_hz
    at = np.clip(whole.placed(late) - col0, 0, samples - 1)
    nearest = np.maximum(1 - np.abs(at[:, None] - np.arange(samples)), 0.0) / whole.level
    normal = a.T @ a
    normal[np.diag_indices(pixels)] += RIDGE * whole.level**2
    effect: Array = (a - b) @ (nearest + np.linalg.solve(normal, a.T - a.T @ a @ nearest))
    return effect


def _matrix(line: Line, col0: int, samples: int, first: int, pixels: int) -> np.ndarray:
    """What every sample sees of every pixel, shape (samples, pixels)."""
    zero = np.zeros(1, np.int64)
    grid = Grid(zero, zero, zero + col0, (pixels, samples))
    matrix: Array = line.limited().read(np.eye(pixels, dtype=np.float32)[None], np.array([first]), grid)[0].T.astype(np.float64)
    return matrix
