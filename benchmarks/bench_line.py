"""The video line of a frame grabber against the usual way with SciPy: 512 rows of 752 pixels become 512 × 512 samples.

Cable with echoes, Butterworth filter of third order, sampling clock of 10 MHz and jitter of the rows, all in one. SciPy: the line at
16 times the pixel rate, `lfilter` for the filter (its poles mapped exactly), `lfilter` for the echoes, `map_coordinates` of first order
at the times of the samples. Both on two threads. Prints times, their ratio, and how far the two images are apart.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from goals import verdict
from scipy.ndimage import map_coordinates
from scipy.signal import cont2discrete, lfilter

from pixmetry.camera.line import Line
from pixmetry.core.random import Grid
from pixmetry.core.threads import map_tiles
from pixmetry.sources.cable.termination import Termination, echoes
from pixmetry.sources.grabber.low_pass import LowPass

PIXEL_HZ, SAMPLE_HZ, OVER = 14.1875e6, 10e6, 16
ROWS, COLS, SAMPLES, THREADS, REPEATS, GOAL = 512, 752, 512, 2, 9, 0.3
CABLE, FILTER = Termination(length_m=5.0, line_ohm=50.0), LowPass(kind="butterworth", order=3, cutoff_mhz=5.0)


def bands() -> list[slice]:
    return [slice(a, a + 64) for a in range(0, ROWS, 64)]


def with_line(frame: np.ndarray, late_s: np.ndarray) -> np.ndarray:
    line = Line(PIXEL_HZ, PIXEL_HZ).echoed(*echoes(CABLE)).filtered(FILTER.zeros, FILTER.poles).clocked(SAMPLE_HZ, 0.0, SAMPLES)

    def band(rows: slice) -> np.ndarray:
        delayed = line.delayed(lambda grid: late_s[None, rows])
        grid = Grid(np.zeros(1), np.array([rows.start]), np.zeros(1), (rows.stop - rows.start, SAMPLES))
        return delayed.read(frame[None, rows], np.zeros(1), grid)[0]

    return np.concatenate(map_tiles(band, bands(), THREADS))


def with_scipy(frame: np.ndarray, late_s: np.ndarray) -> np.ndarray:
    poles = FILTER.poles
    gain = np.prod(-poles).real
    b, a, _ = cont2discrete(([gain], np.poly(poles).real), 1 / (OVER * PIXEL_HZ), method="zoh")
    delay, rho = CABLE.delay_s * OVER * PIXEL_HZ, CABLE.ghost
    k = int(np.floor(delay))
    echo = np.zeros(k + 2)
    echo[0], echo[k], echo[k + 1] = 1.0, -rho * (1 - (delay - k)), -rho * (delay - k)

    def band(rows: slice) -> np.ndarray:
        fine = np.repeat(frame[rows].astype(float), OVER, axis=1)
        fine = lfilter(b.ravel(), a, fine, axis=1)
        fine = lfilter([1 - rho], echo, fine, axis=1)
        t = (np.arange(SAMPLES) + 0.5) / SAMPLE_HZ - late_s[rows, None]
        at = np.broadcast_to(np.arange(len(fine))[:, None], t.shape), t * OVER * PIXEL_HZ
        return map_coordinates(fine, at, order=1, mode="nearest")

    with ThreadPoolExecutor(THREADS) as pool:
        return np.concatenate(list(pool.map(band, bands())))


def best(functions: Sequence[Callable[..., object]], *args: np.ndarray) -> list[float]:
    """Shortest time of each, taken in turn."""
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(REPEATS):
        for function, taken in zip(functions, times, strict=True):
            start = time.perf_counter()
            function(*args)
            taken.append(time.perf_counter() - start)
    return [min(taken) for taken in times]


def main() -> None:
    rng = np.random.default_rng(1)
    smooth = np.cumsum(rng.normal(0, 4, (ROWS, COLS)), axis=1)
    frame = np.ascontiguousarray(smooth, np.float32)
    late_s = 20e-9 * rng.normal(size=ROWS)
    ours, theirs = with_line(frame, late_s), with_scipy(frame, late_s)
    print(f"difference of the two images: {np.sqrt(np.mean((ours - theirs)[:, 8:] ** 2)):.3f} DN rms of {frame.std():.0f} DN")
    seconds = best((with_line, with_scipy), frame, late_s)
    print(f"line {1e3 * seconds[0]:.1f} ms, SciPy {1e3 * seconds[1]:.1f} ms")
    verdict("cable, low-pass, clock and jitter over lfilter and map_coordinates", seconds[0] / seconds[1], GOAL)


if __name__ == "__main__":
    main()
