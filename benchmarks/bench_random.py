"""Speed of the random streams, one thread: ``python benchmarks/bench_random.py``.

Prints million samples a second, and the ratio to NumPy's generators (SFC64 and Philox) on the same machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from goals import verdict

from pixmetry.core.random import Grid, Streams

SHAPE = (512, 512)
FRAMES = 16
GOAL = 1.0


def best_s(action: Callable[[], object], rounds: int = 7) -> float:
    """Return the shortest of several runs, after one that compiles."""
    action()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def report(label: str, count: int, ours: Callable[[], object], theirs: Callable[[np.random.Generator], object]) -> float:
    """Print one line: our rate, then NumPy's with the ratio to it; return the least ratio of the rates."""
    rate = count / best_s(ours) / 1e6
    line, ratios = f"{label:<28}{rate:8.0f} M/s", []
    for bits in (np.random.SFC64, np.random.Philox):
        generator = np.random.Generator(bits(1))
        reference = count / best_s(lambda generator=generator: theirs(generator), 3) / 1e6
        line += f"   {bits.__name__} {reference:5.0f} M/s (x{rate / reference:.1f})"
        ratios.append(rate / reference)
    print(line)
    return min(ratios)


def main() -> None:
    """Time whole frames, then small calls."""
    stream = Streams(1, 2).of("bench")
    grid = Grid.whole(range(FRAMES), SHAPE)
    count = int(np.prod(grid.size))
    data = np.ones(grid.size, np.float32)
    normal = report("normal", count, lambda: stream.normal(grid), lambda g: g.standard_normal(grid.size, np.float32))
    report("uniform", count, lambda: stream.uniform(grid), lambda g: g.random(grid.size, np.float32))
    report("add_normal", count, lambda: stream.add_normal(data, grid, 2.0), lambda g: data + 2 * g.standard_normal(grid.size, np.float32))
    poisson = []
    for mean in (0.1, 2.0, 5.0, 10.0, 100.0, 1e4, 1e6):
        means, label = np.full(grid.size, mean, np.float32), f"poisson, mean {mean:g}"
        poisson.append(report(label, count, lambda means=means: stream.poisson(means, grid), lambda g, means=means: g.poisson(means)))
    verdict("rate of normal numbers over NumPy's faster generator", normal, GOAL, at_least=True)
    verdict("rate of Poisson numbers over NumPy's, at the worst mean", min(poisson), GOAL, at_least=True)
    windows = Grid(np.arange(64), np.arange(64) * 7, np.arange(64) * 5, (24, 24))
    means = np.full(windows.size, 500, np.float32)
    one = Grid.whole([0], (1, 1))
    for label, small in (("(64, 24, 24)", windows), ("(1, 1, 1)", one)):
        mean = means[: small.size[0], : small.shape[0], : small.shape[1]]
        normal_us = 1e6 * best_s(lambda small=small: stream.normal(small), 500)
        poisson_us = 1e6 * best_s(lambda small=small, mean=mean: stream.poisson(mean, small), 500)
        print(f"one call on {label:<16} normal {normal_us:7.1f} us   poisson {poisson_us:7.1f} us")


if __name__ == "__main__":
    main()
