"""Speed of smear and blooming on frames of 1024 × 1024 px: ``python benchmarks/bench_readout.py``.

The kernels run in bands of columns on one and on two threads, as a camera runs them; beside them the same sums in plain NumPy (cumulative
sums in float64) and the same spilling as a NumPy iteration, whose end is the same. Median of several runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from pixmetry.core.threads import map_tiles
from pixmetry.sensor._readout_kernels import add_column_sums, add_rows_passed, spill

SIDE, BAND, REPEATS = 1024, 128, 7
SHARE, FULL, UP = 1e-5, 20_000.0, 0.4


def bands(kernel: Callable[[np.ndarray], np.ndarray], data: np.ndarray, threads: int) -> np.ndarray:
    """Run a kernel over bands of columns."""
    out = np.empty_like(data)

    def one(start: int) -> None:
        out[:, :, start : start + BAND] = kernel(np.ascontiguousarray(data[:, :, start : start + BAND]))

    map_tiles(one, range(0, data.shape[2], BAND), threads)
    return out


def numpy_all(data: np.ndarray) -> np.ndarray:
    """The whole column's sum, as the end of a cumulative sum."""
    return (data + SHARE * np.cumsum(data, axis=1, dtype=np.float64)[:, -1:]).astype(np.float32)


def numpy_passed(data: np.ndarray) -> np.ndarray:
    """The sum over the rows below."""
    total = np.cumsum(data[:, ::-1], axis=1, dtype=np.float64)[:, ::-1]
    return (data + SHARE * (total - data)).astype(np.float32)


def numpy_spill(data: np.ndarray) -> np.ndarray:
    """Spill until no pixel holds more than the full well, to 1e-6 of it, in the columns that have such a pixel."""
    columns = (data > FULL).any(axis=(0, 1))
    q = data[:, :, columns].astype(np.float64)
    while True:
        excess = np.maximum(q - FULL, 0)
        if not (excess > 1e-6 * FULL).any():
            break
        q -= excess
        q[:, :-1] += UP * excess[:, 1:]
        q[:, 1:] += (1 - UP) * excess[:, :-1]
    out = data.copy()
    out[:, :, columns] = np.minimum(q, FULL)
    return out


def median_s(function: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median time of a call in seconds, after a first one."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def scene(spots: int, peak: float) -> np.ndarray:
    """Spots of σ = 3 px at random places, so many times over the full well, on a tenth of it."""
    rng = np.random.default_rng(5)
    axis = np.arange(SIDE)
    y, x = rng.uniform(0, SIDE, (2, spots))
    rows, cols = (np.exp(-0.5 * ((axis - v[:, None]) / 3) ** 2) for v in (y, x))
    return (FULL * (0.1 + peak * (rows.T @ cols)))[None].astype(np.float32)


def main() -> None:
    factor = np.array([SHARE])
    dark, bright = scene(30, 0.8), scene(30, 3.0)

    def bloom(data: np.ndarray) -> np.ndarray:
        return spill(data, FULL, 1.0, 0.0, UP, 1.0, False)

    cases = [
        ("smear, all rows", lambda d: add_column_sums(d, factor), numpy_all, dark, REPEATS),
        ("smear, rows passed", lambda d: add_rows_passed(d, factor, True, False), numpy_passed, dark, REPEATS),
        ("blooming, nothing full", bloom, numpy_spill, dark, REPEATS),
        ("blooming, 30 spots 3 x over", bloom, numpy_spill, bright, 1),
    ]
    print(f"{'':30s}{'NumPy ms':>10s}{'1 thread':>10s}{'2 threads':>10s}{'ratio':>8s}{'largest difference':>20s}")
    for name, kernel, plain, data, repeats in cases:
        slow = median_s(lambda p=plain, d=data: p(d), repeats)
        one, two = (median_s(lambda k=kernel, d=data, t=t: bands(k, d, t)) for t in (1, 2))
        apart = np.abs(bands(kernel, data, 2) - plain(data)).max()
        print(f"{name:30s}{slow * 1e3:10.2f}{one * 1e3:10.2f}{two * 1e3:10.2f}{two / slow:8.3f}{apart:20.2g}")


if __name__ == "__main__":
    main()
