"""What the autocovariance of the noise costs in the reduction of a campaign: ``python benchmarks/bench_noise_covariance.py [rows cols]``.

300 frames in memory: 25 levels of two dark and two bright frames, and two stacks of 100; one thread, with all fits. Reading files, the
budget and the page take time beside.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from functools import partial

import numpy as np
from goals import verdict

from pixmetry.observe import observe as reduction
from pixmetry.observe.one_pass import Group, reduce_groups

GOAL, LEVELS, STACK = 1.3, 25, 100


def campaign(rows: int, cols: int) -> list[Group]:
    """Flat fields with shot noise at 0.4 DN/e-, 8 e- of noise, fixed patterns."""
    rng = np.random.default_rng(1)
    response, offsets = 1 + rng.normal(0, 0.005, (rows, cols)), 60 + rng.normal(0, 0.5, (rows, cols))

    def frame(mean_e: float) -> np.ndarray:
        electrons = mean_e * response + np.sqrt(mean_e + 64) * rng.standard_normal((rows, cols), np.float32)
        return np.clip(np.rint(offsets + 0.4 * electrons), 0, 4095).astype(np.uint16)

    groups = []
    for k in range(LEVELS):
        for kind, light in (("dark", 0.0), ("bright", 8000.0 * (k + 1) / LEVELS)):
            groups.append(Group(kind, "level", 0.01 * (k + 1) / LEVELS, None, [frame(light) for _ in range(2)]))
    for kind, light in (("dark", 0.0), ("bright", 4000.0)):
        groups.append(Group(kind, "stack", 0.005, None, [frame(light) for _ in range(STACK)]))
    return groups


def seconds(groups: list[Group], lags: bool) -> float:
    """Time of one reduction."""

    def passed(*args: object, **options: object) -> Iterator[object]:
        return partial(reduce_groups, *args)(**{**options, "lags": lags})  # type: ignore[arg-type]

    reduction.reduce_groups = passed  # type: ignore[assignment]
    start = time.perf_counter()
    reduction.observe(groups, 12, threads=1)
    return time.perf_counter() - start


def main(rows: int = 480, cols: int = 640) -> None:
    """Print the seconds of both, of the fastest of five, and the ratio."""
    groups = campaign(rows, cols)
    seconds(groups, True)
    without, beside = (min(seconds(groups, lags) for _ in range(5)) for lags in (False, True))
    print(f"without {without:.3f} s, with the autocovariance {beside:.3f} s")
    verdict("a reduction with the autocovariance of the noise over one without", beside / without, GOAL)


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:]))
