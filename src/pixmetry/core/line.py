"""The video line: the staircase of held pixels as a function of time, through filters and echoes, until a clock samples it.

The sources between a camera's output and the converter of a frame grabber do not work on numbers. They change the continuous signal:
filters (poles and zeros), echoes, and when it is sampled (clock, delay of each row). ``Line`` collects that; the camera samples it once, at the
first source that takes DN. The staircase has an exact answer through any filter of that kind (a sum of exponentials between its steps), so
nothing is interpolated and nothing is filtered at the pixel rate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.core._line_kernels import read_line
from pixmetry.core.errors import ParameterError

SMALLEST_ECHO = 1e-7
APART = 1e-6  # relative: repeated poles are moved apart by this

Warp = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Line:
    """How the line signal of a batch of windows is changed and read. Made by the camera; sources return changed copies.

    Parameters
    ----------
    pixel_clock_hz : float
        Each pixel is held for one period of it.
    filters : tuple of (zeros, poles)
        In rad/s, complex in conjugate pairs, poles in the left half-plane; each has gain 1 at frequency 0.
    echo_delay_s, echo_amplitude : ndarray, shape (e,)
        All paths of the signal, the direct one among them.
    sample_clock_hz : float
        Clock of the sampling; sample k is taken at ``start_s + (k + ½)/sample_clock_hz`` of the line.
    start_s : float
    samples : int, optional
        Samples per row; by default one for each pixel.
    delay_s : tuple of ndarray, shape (n, rows) or broadcast
        Delays of the signal row by row: jitter, drift.
    warps : tuple of callables
        ``(time_s) -> s``: further delays of the signal that change along the line; arrays of shape (n, rows or 1, samples), of the sampling
        times from the first pixel's beginning.
    noise : tuple of callables
        ``(grid) -> array (n, rows, samples)``, added to the samples, in DN.
    black_dn : float
        Level before the first and after the last pixel.
    """

    pixel_clock_hz: float
    sample_clock_hz: float
    filters: tuple[tuple[np.ndarray, np.ndarray], ...] = ()
    echo_delay_s: np.ndarray | None = None
    echo_amplitude: np.ndarray | None = None
    start_s: float = 0.0
    samples: int | None = None
    delay_s: tuple[np.ndarray, ...] = ()
    warps: tuple[Warp, ...] = ()
    noise: tuple[Callable[..., np.ndarray], ...] = ()
    black_dn: float = 0.0

    # ---- what sources do --------------------------------------------------------------------------------------------------------

    def filtered(self, zeros: np.ndarray, poles: np.ndarray) -> Line:
        """Return the line after an analogue filter of gain 1 at frequency 0; zeros and poles in rad/s.

        Raises
        ------
        ParameterError
            If the filter is unstable, improper, or blocks a constant level.
        """
        z, p = (np.atleast_1d(np.asarray(v, complex)) for v in (zeros, poles))
        if len(p) == 0 or len(z) > len(p) or (p.real >= 0).any() or (np.abs(z) == 0).any():
            raise ParameterError("the filter cannot be used", where="line", allowed="stable, as many poles as zeros or more, passing 0 Hz")
        return replace(self, filters=(*self.filters, (z, p)))

    def echoed(self, delay_s: np.ndarray, amplitude: np.ndarray) -> Line:
        """Return the line after several paths of these delays and amplitudes."""
        d, a = (np.atleast_1d(np.asarray(v, float)) for v in (delay_s, amplitude))
        if self.echo_delay_s is not None:
            d = (self.echo_delay_s[:, None] + d).ravel()
            a = (self.echo_amplitude[:, None] * a).ravel()
            keep = np.abs(a) > SMALLEST_ECHO * np.abs(a).max()
            d, a = d[keep], a[keep]
        return replace(self, echo_delay_s=d, echo_amplitude=a)

    def clocked(self, sample_clock_hz: float, start_s: float, samples: int) -> Line:
        """Return the line sampled by another clock."""
        return replace(self, sample_clock_hz=float(sample_clock_hz), start_s=float(start_s), samples=int(samples))

    def delayed(self, delay_s: np.ndarray) -> Line:
        """Return the line with rows that come later by so much, shape (n, rows) or broadcast to it."""
        return replace(self, delay_s=(*self.delay_s, np.asarray(delay_s, float)))

    def warped(self, warp: Warp) -> Line:
        """Return the line with a delay that changes along it."""
        return replace(self, warps=(*self.warps, warp))

    def with_noise(self, noise: Callable[..., np.ndarray]) -> Line:
        """Return the line with noise that is added to its samples."""
        return replace(self, noise=(*self.noise, noise))

    # ---- reading ----------------------------------------------------------------------------------------------------------------

    @property
    def plain(self) -> bool:
        """Whether sampling gives the pixels back as they are."""
        return (
            not (self.filters or self.delay_s or self.warps or self.noise)
            and self.echo_delay_s is None
            and self.sample_clock_hz == self.pixel_clock_hz
            and self.start_s == 0.0
            and self.samples is None
        )

    def times(self, n: int, rows: int, col0: np.ndarray, cols: int) -> np.ndarray:
        """Times at which the signal is read, in s from the beginning of pixel 0, shape (n, rows, cols)."""
        at = self.start_s + (col0[:, None, None] + np.arange(cols) + 0.5) / self.sample_clock_hz
        late = np.zeros((n, rows, 1))
        for delay in self.delay_s:
            late = late + np.broadcast_to(delay, (n, rows))[:, :, None]
        total = np.broadcast_to(at - late, (n, rows, cols))
        for warp in self.warps:
            total = total - warp(at)
        return np.ascontiguousarray(np.broadcast_to(total, (n, rows, cols)))

    def read(self, data: np.ndarray, first_col: np.ndarray, col0: np.ndarray, cols: int) -> np.ndarray:
        """Read rows of pixels; ``data`` is float32 (n, rows, pixels) from pixel ``first_col`` on, the result (n, rows, cols) from ``col0``."""
        n, rows, _ = data.shape
        poles, steps, direct = self.step_response()
        period = 1.0 / self.pixel_clock_hz
        delays = np.zeros(1) if self.echo_delay_s is None else np.asarray(self.echo_delay_s / period)
        amplitudes = np.ones(1) if self.echo_amplitude is None else np.asarray(self.echo_amplitude)
        out = np.empty((n, rows, cols), np.float32)
        times = self.times(n, rows, np.asarray(col0), cols) / period
        read_line(
            np.ascontiguousarray(data, np.float32), np.asarray(first_col, np.float64), self.black_dn, poles, steps, direct, delays, amplitudes,
            times, out,
        )
        return out

    def step_response(self) -> tuple[np.ndarray, np.ndarray, float]:
        """All filters as one: poles p (per pixel period) and weights s with step response d + Σ s (e^(p t) − 1).

        H(s) = d + Σ r/(s − p) by partial fractions, so a unit step gives d + Σ (r/p)(e^(pt) − 1).
        """
        if not self.filters:
            return np.zeros(0, complex), np.zeros(0, complex), 1.0
        zeros = np.concatenate([z for z, _ in self.filters]) / self.pixel_clock_hz
        poles = np.concatenate([p for _, p in self.filters]) / self.pixel_clock_hz
        for i in range(len(poles)):
            while i and np.min(np.abs(poles[:i] - poles[i])) < APART * np.abs(poles[i]):
                poles[i] *= 1 + 3 * APART
        gain = np.prod(-poles) / np.prod(-zeros) if len(zeros) else np.prod(-poles)
        residues = np.array(
            [
                gain * np.prod(p - zeros) / np.prod([p - q for j, q in enumerate(poles) if j != i])
                for i, p in enumerate(poles)
            ]
        )
        direct = float(gain.real) if len(zeros) == len(poles) else 0.0
        return np.ascontiguousarray(poles), np.ascontiguousarray(residues / poles), direct

    def placed(self, x: np.ndarray) -> np.ndarray:
        """Columns of the samples at which places on the pixel grid are seen (delays of rows and of filters are errors, not geometry)."""
        return ((x + 0.5) / self.pixel_clock_hz - self.start_s) * self.sample_clock_hz - 0.5

    def pixels(self, col: np.ndarray) -> np.ndarray:
        """Place on the pixel grid at which a sample looks, the inverse of `placed`."""
        return ((col + 0.5) / self.sample_clock_hz + self.start_s) * self.pixel_clock_hz - 0.5
