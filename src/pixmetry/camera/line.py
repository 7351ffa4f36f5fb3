"""The video line: the staircase of held pixels as a function of time, through filters and echoes, until a clock samples it.

The sources between a camera's output and the converter of a frame grabber do not work on numbers. They change the continuous
signal: filters (poles and zeros), echoes, and when it is sampled (clock, delay of each row). ``Line`` collects that; the camera
samples it once, at the first source that takes DN. The staircase has an exact answer through any filter of that kind, so nothing is
interpolated and nothing is filtered at the pixel rate.

No line is a staircase: every output stage has a finite bandwidth. Where no source of the chain says which, the level takes one pixel
period to go straight from one pixel to the next (`Line.limited`): −3 dB at 0.44 of the pixel clock, and what is sampled in the middle of
the pixels is the pixels. Else a sample would sit on a flat step, and see neither jitter nor an echo that comes within half a pixel.

Filters and echoes are linear and do not change in time, so their order does not matter. A delay of a whole row may be exchanged with
them too; a delay that changes along the line may as far as it changes little over the duration of an impulse response.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any

import numpy as np

from pixmetry.camera._line_kernels import moving_sum, read_line
from pixmetry.core.errors import ParameterError
from pixmetry.core.random import Grid, Stream

SMALLEST_ECHO = 1e-7
CUT = 1e-7  # of the weights of a row's predecessors
NODES_PER_RATE = 80  # of the table, for each unit of ‖A‖: what Taylor's third order leaves is (1/160)⁴/24 = 6e-11
MOST_NODES = 1 << 16

Warp = Callable[[np.ndarray], np.ndarray]
Rows = Callable[[Grid], np.ndarray]
Noise = Callable[[Grid, "Line"], np.ndarray]
Filter = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Line:
    """How the line signal of a batch of windows is changed and read. Made by the camera; sources return changed copies.

    Parameters
    ----------
    pixel_clock_hz : float
        Each pixel is held for one period of it.
    sample_clock_hz : float
        Clock of the sampling; sample k is taken at ``start_s + (k + ½)/sample_clock_hz`` of the line.
    filters : tuple of (zeros, poles)
        In rad/s, complex in conjugate pairs, poles in the left half-plane; each has gain 1 at frequency 0.
    echo_delay_s, echo_amplitude : ndarray, shape (e,)
        All paths of the signal, the direct one among them.
    start_s : float
    samples : int, optional
        Samples per row; by default one for each pixel.
    delays : tuple of callables
        ``(grid) -> s``, shape (n, rows) or broadcast to it: delays of the signal row by row (jitter, drift) in the rows of a grid.
    warps : tuple of callables
        ``(time_s) -> s``: further delays, which change along the line, at sampling times of shape (n, 1, samples).
    noise : tuple of callables
        ``(grid, line) -> DN``, shape (n, rows, samples): added to the samples; the line is the one that is read.
    black_dn : float
        Level before the first and after the last pixel.
    ramps : bool
        Whether the level takes one pixel period to go from one pixel to the next, instead of jumping.
    """

    pixel_clock_hz: float
    sample_clock_hz: float
    filters: tuple[Filter, ...] = ()
    echo_delay_s: np.ndarray | None = None
    echo_amplitude: np.ndarray | None = None
    start_s: float = 0.0
    samples: int | None = None
    delays: tuple[Rows, ...] = ()
    warps: tuple[Warp, ...] = ()
    noise: tuple[Noise, ...] = ()
    black_dn: float = 0.0
    ramps: bool = False

    # ---- what sources do --------------------------------------------------------------------------------------------------------

    def filtered(self, zeros: Any, poles: Any) -> Line:
        """Return the line after an analogue filter of gain 1 at frequency 0; zeros and poles in rad/s.

        Raises
        ------
        ParameterError
            If the filter is unstable, improper, not real, or blocks a constant level.
        """
        z, p = (np.asarray(v, complex).reshape(-1) for v in (zeros, poles))
        if not (_real(z.tobytes()) and _real(p.tobytes())) or len(p) == 0 or len(z) > len(p) or (p.real >= 0).any() or (z == 0).any():
            raise ParameterError("the filter cannot be used", where="line", allowed="real, stable, not more zeros than poles, passing 0 Hz")
        return replace(self, filters=(*self.filters, (z, p)))

    def echoed(self, delay_s: Any, amplitude: Any) -> Line:
        """Return the line after several paths of these delays and amplitudes."""
        d, a = (np.atleast_1d(np.asarray(v, float)) for v in (delay_s, amplitude))
        if self.echo_delay_s is not None and self.echo_amplitude is not None:
            d = (self.echo_delay_s[:, None] + d).ravel()
            a = (self.echo_amplitude[:, None] * a).ravel()
            d, same = np.unique(np.round(d, 16), return_inverse=True)  # to a ten-millionth of a nanosecond: equal cables share their echoes
            a = np.bincount(same.ravel(), a)
            keep = np.abs(a) > SMALLEST_ECHO * np.abs(a).max()
            d, a = d[keep], a[keep]
        return replace(self, echo_delay_s=d, echo_amplitude=a)

    def clocked(self, sample_clock_hz: float, start_s: float, samples: int) -> Line:
        """Return the line sampled by another clock."""
        return replace(self, sample_clock_hz=float(sample_clock_hz), start_s=float(start_s), samples=int(samples))

    def delayed(self, delay_s: Rows | np.ndarray) -> Line:
        """Return the line with rows that come later by so much: a function of the grid, or one value per window, shape (n, 1)."""
        if callable(delay_s):
            return replace(self, delays=(*self.delays, delay_s))
        one = np.asarray(delay_s, float)
        if one.ndim != 2 or one.shape[1] != 1:
            raise ParameterError("a delay cannot be used", value=one.shape, where="line", allowed="a function of the grid, or shape (n, 1)")
        return replace(self, delays=(*self.delays, lambda grid: one))

    def warped(self, warp: Warp) -> Line:
        """Return the line with a delay that changes along it."""
        return replace(self, warps=(*self.warps, warp))

    def limited(self) -> Line:
        """Return the line with limited bandwidth: a line without a filter that smooths steps becomes a line of ramps."""
        slow = any(len(poles) > len(zeros) for zeros, poles in self.filters)
        return self if slow else replace(self, ramps=True)

    def with_noise(self, noise: Noise) -> Line:
        """Return the line with noise that is added to its samples."""
        return replace(self, noise=(*self.noise, noise))

    # ---- reading ----------------------------------------------------------------------------------------------------------------

    @property
    def plain(self) -> bool:
        """Whether sampling gives the pixels back as they are."""
        return (
            not (self.filters or self.delays or self.warps or self.noise)
            and self.echo_delay_s is None
            and self.sample_clock_hz == self.pixel_clock_hz
            and self.start_s == 0.0
            and self.samples is None
        )

    def times(self, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """Times at which the samples of a grid are read, in s from the beginning of pixel 0.

        That of every sample, shape (n, samples), less the delay of every row, shape (n, rows).
        """
        n, rows, cols = grid.size
        at = self.start_s + (grid.col0[:, None, None] + np.arange(cols) + 0.5) / self.sample_clock_hz
        read = at
        for warp in self.warps:
            read = read - warp(at)
        late = np.zeros((n, rows))
        for delay in self.delays:
            late = late + delay(grid)
        return np.ascontiguousarray(np.broadcast_to(read, (n, 1, cols))[:, 0]), late

    def read(self, data: np.ndarray, first_col: np.ndarray, grid: Grid) -> np.ndarray:
        """Read rows of pixels.

        Parameters
        ----------
        data : ndarray, shape (n, rows, pixels), float32, DN
            Pixels from ``first_col`` on, shape (n,); what lies outside is black.
        grid : Grid
            Of the samples, with the rows of the data.

        Returns
        -------
        ndarray, shape (n, rows, samples), float32, DN
        """
        step, table, delays, amplitudes = self.kernel()
        out = np.empty(grid.size, np.float32)
        if out.size == 0:
            return out
        at, late = (t * self.pixel_clock_hz for t in self.times(grid))
        first = np.asarray(first_col, np.int64)
        latest = float((at.max(axis=1) - late.min(axis=1) - first).max() - delays.min())
        length = max(data.shape[2], int(np.floor(latest)) + 1)
        read_line(
            np.ascontiguousarray(data, np.float32), first, self.black_dn, step, table, delays, amplitudes, at, late,
            length, out,
        )  # fmt: skip
        for noise in self.noise:
            out += noise(grid, self)
        return out

    def kernel(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """State step and table of the filters (see `response`), delays in pixel periods and amplitudes of all paths, for `read_line`.

        A level that goes by ramps is the mean of the staircase over one period: its integral half a period later, less that half a period
        earlier. So there is an integrator behind the filters, and two paths stand for each.
        """
        step, table = response(tuple((z.tobytes(), p.tobytes()) for z, p in self.filters), self.pixel_clock_hz, self.ramps)
        delays = np.zeros(1) if self.echo_delay_s is None else self.echo_delay_s * self.pixel_clock_hz
        amplitudes = np.ones(1) if self.echo_amplitude is None else self.echo_amplitude
        if self.ramps:
            delays, amplitudes = np.concatenate([delays - 0.5, delays + 0.5]), np.concatenate([amplitudes, -amplitudes])
        return step, table, np.ascontiguousarray(delays, float), np.ascontiguousarray(amplitudes, float)

    @property
    def level(self) -> float:
        """What becomes of a constant level: the sum of the paths."""
        return 1.0 if self.echo_amplitude is None else float(self.echo_amplitude.sum())

    @property
    def delay_s(self) -> float:
        """First moment of the impulse response of filters and echoes: how much later the centroid of anything comes."""
        total = sum(group_delay_s(z, p) for z, p in self.filters)
        if self.echo_delay_s is not None and self.echo_amplitude is not None:
            total += float((self.echo_delay_s * self.echo_amplitude).sum() / self.echo_amplitude.sum())
        return total

    def gain(self, frequency_hz: np.ndarray, first: int = 0) -> np.ndarray:
        """Gain of the filters from the given one on at some frequencies, |H(2πif)|."""
        s = 2j * np.pi * np.asarray(frequency_hz, float)
        total = np.ones(s.shape)
        for zeros, poles in self.filters[first:]:
            for roots, sign in ((zeros, 1), (poles, -1)):
                for root in roots:
                    total = total * np.abs(1 - s / root) ** sign
        return total

    def placed(self, x: np.ndarray, warped: bool = False) -> np.ndarray:
        """Columns of the samples at which places on the pixel grid are seen.

        Delays of rows and of filters are errors, not geometry. With ``warped``, delays that change along the line count: those of the
        one window, or of a window for each place.
        """
        due = (np.asarray(x, float) + 0.5) / self.pixel_clock_hz
        at = due
        for _ in range(30 if warped and self.warps else 0):  # each turn is nearer by the share that a delay grows along the line
            at = due + self._warped_s(at)
        return (at - self.start_s) * self.sample_clock_hz - 0.5

    def pixels(self, col: np.ndarray, warped: bool = False) -> np.ndarray:
        """Place on the pixel grid at which a sample looks, the inverse of `placed`."""
        at = (col + 0.5) / self.sample_clock_hz + self.start_s
        if warped and self.warps:
            at = at - self._warped_s(at)
        return at * self.pixel_clock_hz - 0.5

    def _warped_s(self, at: np.ndarray) -> Any:
        """Delays at sampling times of shape (k,)."""
        return sum(np.broadcast_to(warp(at[:, None, None]), (len(at), 1, 1))[:, 0, 0] for warp in self.warps)


def group_delay_s(zeros: Any, poles: Any) -> float:
    """Group delay of a filter at frequency 0 in s, −H'(0)/H(0) = Σ 1/z − Σ 1/p."""
    z, p = (np.asarray(v, complex).reshape(-1) for v in (zeros, poles))
    return float((1 / z).sum().real - (1 / p).sum().real)


@cache
def low_pass_poles(kind: str, order: int) -> np.ndarray:
    """Poles of a low-pass filter of cut-off 1 rad/s: ``rc`` (a chain of equal stages), ``butterworth``, ``bessel`` or ``off``."""
    if kind == "off":
        return np.zeros(0, complex)
    if kind == "rc":
        return -np.ones(order, complex)
    if kind == "butterworth":
        unit_poles: np.ndarray = np.exp(1j * np.pi * (0.5 + (np.arange(order) + 0.5) / order))
        return unit_poles
    from scipy.signal import besselap

    return np.asarray(besselap(order, norm="mag")[1], complex)


def reach_px(zeros: Any, poles: Any, share: float, pixel_hz: float = 14.1875e6) -> int:
    """Pixels until the remaining deviation of a filter's step response is below ``share`` of the step.

    From the slowest pole: its mode falls as e^(−|Re p| t), with room for the size that several equal poles may give it.
    """
    slowest = float(-np.asarray(poles).real.max()) / pixel_hz
    return int(np.ceil((np.log(1 / share) + 2.5 * len(np.atleast_1d(poles))) / slowest)) + 1


def alike_rows(stream: Stream, grid: Grid, length_rows: float, stride: int = 1, draw: int = 0) -> np.ndarray:
    """Normal numbers of the rows of a grid that are alike over ``length_rows``: correlation e^(−|Δ|/length), shape (n, rows).

    A first-order autoregression as the moving sum of keyed numbers that it is, cut where its weights have fallen to 1e-7 (stationary:
    the rows above the frame have numbers too); so any window gets the same. With a stride of 2 each field has its own.
    """
    rho = np.exp(-1.0 / length_rows)
    weights = rho ** np.arange(int(np.ceil(np.log(CUT) / np.log(rho))) + 1)
    above = stride * (len(weights) - 1)
    wide = Grid(grid.frame, grid.row0 - above, grid.col0, (grid.shape[0] + above, grid.shape[1]))
    return correlated_rows(stream.normal_rows(wide, draw), weights / np.sqrt((weights**2).sum()), stride)


def correlated_rows(white: np.ndarray, weights: np.ndarray, stride: int = 1) -> np.ndarray:
    """Moving sum down the rows of white numbers that begin ``stride·(len(weights) − 1)`` rows above the first row wanted; (n, rows)."""
    out = np.empty((len(white), white.shape[1] - stride * (len(weights) - 1)))
    moving_sum(np.ascontiguousarray(white, np.float64), np.ascontiguousarray(weights, np.float64), stride, out)
    return out


# ---- windows of a probe on the line ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Held:
    """The pixels of a probe on the video line of its camera, without the source that is asked for.

    Parameters
    ----------
    line : Line
        Filters, echoes and clock of everything else in the chain; nothing in it is random.
    pixels : Grid
        The probe's windows of pixels.
    samples : Grid
        Windows of the line's samples that are read of them, and located in.
    gx, gy : ndarray, shape (p, rows, samples)
        The estimator's gradient there, in px of the sensor per DN.
    locate : callable
        ``(samples_dn, level, which) -> x, y``: the estimator on windows of the phases ``which``, in px of the sensor, where constant light
        is seen ``level`` times as bright as it came.
    ahead : int
        How many of the filters stand ahead of the source.
    rows_seen : (int, int), optional
        The first row of the sensor that is put out, and the first one after; by default all.
    """

    line: Line
    pixels: Grid
    samples: Grid
    gx: np.ndarray
    gy: np.ndarray
    locate: Callable[..., tuple[np.ndarray, np.ndarray]]
    ahead: int = 0
    rows_seen: tuple[int, int] | None = None

    def read(self, line: Line, signal_dn: np.ndarray, background_dn: float, which: Any = slice(None), row0: Any = None) -> np.ndarray:
        """Samples of windows of pixels that lie where those of the phases ``which`` do, and begin in these rows.

        The background goes on all around them.
        """
        samples = self.samples
        first = samples.row0[which] if row0 is None else np.asarray(row0, np.int64)
        grid = Grid(samples.frame[which], first, samples.col0[which], samples.shape)
        return line.limited().read(signal_dn - background_dn, self.pixels.col0[which], grid).astype(float) + background_dn * line.level


# ---- filters as state spaces ----------------------------------------------------------------------------------------------------


@lru_cache(maxsize=64)
def response(filters: tuple[tuple[bytes, bytes], ...], pixel_hz: float, integrated: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """State step over one pixel period and table of read-outs of filters in a row, as `read_line` takes them.

    With x' = A x + B u, y = C x + D u and a level u that is held, (x, u) becomes e^(M t)(x, u) with M = [[A, B], [0, 0]]
    (C. F. Van Loan, IEEE Trans. Autom. Control 23, 1978, 395). Equal poles need no care of their own.
    With ``integrated``, what comes out is integrated over pixel periods: one more state, x' = y.
    """
    from scipy.linalg import expm

    sections = [section for z, p in filters for section in _sections(_scaled(z, pixel_hz), _scaled(p, pixel_hz))]
    if integrated:
        sections.append((np.zeros((1, 1)), np.ones(1), np.ones(1), 0.0))
    a, b, c, d = _cascade(sections)
    k = len(a)
    m = np.zeros((k + 1, k + 1))
    m[:k, :k], m[:k, k] = a, b
    rate = float(np.linalg.norm(a, 2)) if k else 0.0
    nodes = 1 << max(6, int(np.ceil(np.log2(max(NODES_PER_RATE * rate, 1.0)))))
    if nodes > MOST_NODES:
        raise ParameterError("a filter is faster than a thousandth of a pixel", where="line", remedy="leave it out: it has no effect")
    powers = np.eye(k + 1)[None]
    while len(powers) < nodes:
        powers = np.concatenate([powers, powers @ expm(m * (len(powers) / nodes))])
    whole = expm(m)
    out = np.concatenate([powers, whole[None]])
    weights = np.append(c, d) @ out
    terms = [weights]
    for order in (1, 2, 3):
        terms.append(terms[-1] @ m / order)
    return np.ascontiguousarray(whole[:k]), np.ascontiguousarray(np.stack(terms, axis=2))


@lru_cache(64)
def _real(raw: bytes) -> bool:
    """Whether complex roots come in conjugate pairs: their polynomial is real."""
    roots = np.frombuffer(raw, complex)
    return not roots.any() or bool(np.abs(np.poly(roots / np.abs(roots).max()).imag).max() < 1e-9)


def _scaled(raw: bytes, pixel_hz: float) -> np.ndarray:
    return np.frombuffer(raw, complex) / pixel_hz


Section = tuple[np.ndarray, np.ndarray, np.ndarray, float]


def _cascade(sections: list[Section]) -> Section:
    """One state space of several in a row."""
    a, b, c, d = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
    for a2, b2, c2, d2 in sections:
        a = np.block([[a, np.zeros((len(a), len(a2)))], [np.outer(b2, c), a2]])
        b, c, d = np.append(b, b2 * d), np.append(d2 * c, c2), d2 * d
    return a, b, c, d


def _sections(zeros: np.ndarray, poles: np.ndarray) -> list[Section]:
    """Sections of first and second order of gain 1 at frequency 0; zeros are combined with poles in pairs, a single zero with a pole."""
    pole_pairs, pole = _paired(poles)
    zero_pairs, zero = _paired(zeros)
    numerators = [(-(1 / z[0] + 1 / z[1]).real, (1 / (z[0] * z[1])).real) for z in zero_pairs]
    single = [] if zero is None else [-1 / zero]
    made = []
    for i, (p, q) in enumerate(pole_pairs):
        n1, n2 = numerators[i] if i < len(numerators) else (single.pop(), 0.0) if single and pole is None else (0.0, 0.0)
        made.append(_second_order((p * q).real, -(p + q).real, n1, n2))
    if pole is not None:
        n1 = single.pop() if single else 0.0
        made.append((np.array([[pole]]), np.array([-pole]), np.array([1 + n1 * pole]), -n1 * pole))
    return made


def _second_order(w2: float, damping: float, n1: float, n2: float) -> Section:
    """(1 + n1 s + n2 s²) w2/(s² + damping s + w2) with the states y and y'/ω of the part without numerator."""
    w = np.sqrt(w2)
    a = np.array([[0.0, w], [-w, -damping]])
    return a, np.array([0.0, w]), np.array([1 - n2 * w2, n1 * w - n2 * damping * w]), n2 * w2


def _paired(roots: np.ndarray) -> tuple[list[tuple[complex, complex]], float | None]:
    """Roots two by two: conjugates together, then the real ones, of which one may be left over."""
    near_real = np.abs(roots.imag) <= 1e-12 * np.abs(roots)
    upper = roots[~near_real & (roots.imag > 0)]
    real = np.sort(roots[near_real].real)
    pairs = [(complex(r), complex(r.conjugate())) for r in upper]
    pairs += [(complex(a), complex(b)) for a, b in zip(real[0::2], real[1::2], strict=False)]
    return pairs, float(real[-1]) if len(real) % 2 else None
