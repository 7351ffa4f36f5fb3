"""Speed of smear and blooming on frames of 1024 × 1024 px: ``python benchmarks/bench_readout.py``.

The kernels run in bands of columns on one and on two threads, as a camera runs them; beside them the same sums in plain NumPy (cumulative
sums in float64). Blooming one way has a cumulative-sum form: with s the sum of what exceeds the full well, the charge that flows on is
s − min s so far. Blooming both ways has none; there NumPy repeats the spilling until nothing flows, in the columns that are full alone.
Where nothing is full that is one comparison and one copy. It is shown, though without a goal, for it is not the cumulative sum: both are
bound by reading the frame once and writing it once, and ours pays the cutting and joining of the bands besides. Medians, taken in turn.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from goals import verdict

from pixmetry.core.threads import map_tiles
from pixmetry.sources.sensor._readout_kernels import add_column_sums, add_rows_passed, spill

SIDE, BAND, REPEATS = 1024, 128, 7
SHARE, FULL, UP, GOAL = 1e-5, 20_000.0, 0.4, 0.3


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


def numpy_one_way(data: np.ndarray) -> np.ndarray:
    """Spill down the columns alone: the flow out of row r is s_r − min(0, s_0 … s_r), s the cumulative sum of the charge above full."""
    total = np.cumsum(data - FULL, axis=1, dtype=np.float64)
    flow = total - np.minimum(np.minimum.accumulate(total, axis=1), 0.0)
    out = data.astype(np.float64)
    out[:, 1:] += flow[:, :-1]
    return np.minimum(out, FULL).astype(np.float32)


def medians_s(functions: list[Callable[[], object]], repeats: int = REPEATS) -> list[float]:
    """Median times of calls that are made in turn, in seconds, after a first round."""
    times: list[list[float]] = [[] for _ in functions]
    for repeat in range(repeats + 1):
        for function, taken in zip(functions, times, strict=True):
            start = time.perf_counter()
            function()
            if repeat:
                taken.append(time.perf_counter() - start)
    return [float(np.median(taken)) for taken in times]


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

    def bloom(up: float = UP) -> Callable[[np.ndarray], np.ndarray]:
        zero = np.zeros(1, np.int64)
        return lambda data: spill(data, FULL, 1.0, 0.0, up, 1.0, False, False, np.uint64(0), zero, zero)

    cases = [
        ("smear, all rows", lambda d: add_column_sums(d, factor), numpy_all, dark, REPEATS, "smear"),
        ("smear, rows passed", lambda d: add_rows_passed(d, factor, True, False), numpy_passed, dark, REPEATS, "smear"),
        ("blooming one way, nothing full", bloom(0.0), numpy_one_way, dark, REPEATS, "blooming"),
        ("blooming one way, 30 spots", bloom(0.0), numpy_one_way, bright, REPEATS, "blooming"),
        ("both ways, nothing full", bloom(), numpy_spill, dark, REPEATS, ""),
        ("both ways, 30 spots 3 x over", bloom(), numpy_spill, bright, 2, ""),
    ]
    worst = {"smear": 0.0, "blooming": 0.0}
    print(f"{'':30s}{'NumPy ms':>10s}{'1 thread':>10s}{'2 threads':>10s}{'ratio':>8s}{'largest difference':>20s}")
    for name, kernel, plain, data, repeats, goal in cases:
        runs = [lambda k=kernel, d=data, t=t: bands(k, d, t) for t in (1, 2)]
        slow, one, two = medians_s([lambda p=plain, d=data: p(d), *runs], repeats)
        if goal:
            worst[goal] = max(worst[goal], two / slow)
        apart = np.abs(bands(kernel, data, 2) - plain(data)).max()
        print(f"{name:30s}{slow * 1e3:10.2f}{one * 1e3:10.2f}{two * 1e3:10.2f}{two / slow:8.3f}{apart:20.2g}")
    for name, ratio in worst.items():
        verdict(f"{name} over its cumulative-sum form in NumPy, two threads, the worse case", ratio, GOAL)


if __name__ == "__main__":
    main()
