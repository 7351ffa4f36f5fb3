"""Time of the one-pass reductions per frame, beside plain NumPy: ``python benchmarks/bench_reductions.py [rows cols frames]``."""

from __future__ import annotations

import sys
import time

import numpy as np
from goals import verdict

from pixmetry.observe.stack import GroupReduction, new_group

GOAL = 1.0


def numpy_sums(frames: list[np.ndarray]) -> np.ndarray:
    """The same sums with array operations."""
    total = np.zeros(frames[0].shape, np.uint32)
    total_sq = np.zeros(frames[0].shape, np.uint64)
    counts = np.zeros(65536, np.int64)
    for frame in frames:
        wide = frame.astype(np.uint64)
        total += frame
        total_sq += wide * wide
        counts += np.bincount(frame.ravel(), minlength=65536)
        frame.sum(axis=0), frame.sum(axis=1)
    return total


def reduced(frames: list[np.ndarray], kind: str = "stack", spectra_pairs: int = 8) -> GroupReduction:
    """The frames of one group, in one pass."""
    group = new_group(12, kind, spectra_pairs)
    for frame in frames:
        group.add(frame)
    return group


def best_seconds(function, repeats: int = 5) -> float:
    """Shortest of a few runs."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def main(rows: int = 480, cols: int = 640, n_frames: int = 50) -> None:
    """Print milliseconds per frame and per megapixel."""
    rng = np.random.default_rng()
    frames = [np.clip(rng.normal(2000, 23, (rows, cols)), 0, 4095).astype(np.uint16) for _ in range(n_frames)]
    reduced(frames[:2])
    reduced(frames[:2], kind="level")
    spent = {}
    for name, run in {
        "stack with spectra": lambda: reduced(frames),
        "stack without spectra": lambda: reduced(frames, spectra_pairs=0),
        "level pairs with results": lambda: [reduced(frames[i : i + 2], kind="level").moments.summary() for i in range(0, n_frames - 1, 2)],
        "NumPy sums alone": lambda: numpy_sums(frames),
    }.items():
        per_frame = spent[name] = best_seconds(run) / n_frames
        print(f"{name:24s} {per_frame * 1e3:7.3f} ms/frame {per_frame / (rows * cols) * 1e9:7.3f} ns/pixel")
    verdict("stack with spectra over NumPy sums alone", spent["stack with spectra"] / spent["NumPy sums alone"], GOAL)


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:]))
