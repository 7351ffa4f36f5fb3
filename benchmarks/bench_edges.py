"""Slanted edges of a frame of 12 megapixels: ``python benchmarks/bench_edges.py``.

A frame of 4000 × 3000 pixels with 25 turned squares, 100 edges. Ours finds them and measures the e-SFR of each with its covariance, on two
threads. The baseline is plain NumPy and is told where the edges are: the slopes of the whole frame along both axes, then for each edge the
distances, the bins by `numpy.bincount`, the difference and the Fourier sum; no u, no refinement of the line, no checks. Medians, in turn.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from goals import verdict

from pixmetry.core.threads import set_threads
from pixmetry.observe.edges import FREQUENCY, Picture, Search, responses_of, search_edges

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from observe.edge_pictures import squares, stored  # noqa: E402

REPEATS, GOAL_S, GOAL_RATIO = 5, 0.5, 2.0


def numpy_responses(frame: np.ndarray, found: Search) -> list[np.ndarray]:
    """The e-SFR of edges at known places."""
    for axis in (0, 1):
        np.abs(np.gradient(frame, axis=axis)).max()
    out = []
    for region, _ in found.measured:
        own = frame if region.across == "x" else frame.T
        reach = int(region.half_px / region.cosine)
        col = np.rint(region.centre).astype(int)[:, None] + np.arange(-reach, reach + 1)
        row = np.arange(region.first, region.first + region.rows)[:, None]
        distance = (col - region.centre[:, None]) * region.cosine
        at = np.rint((distance + region.half_px) * 4).astype(int).clip(0).ravel()
        count = np.maximum(np.bincount(at), 1)
        curve = np.bincount(at, weights=own[row, col].ravel()) / count
        steps = np.diff(curve) * np.hamming(len(curve) - 1)
        places = np.arange(len(steps)) / 4
        out.append(np.abs(np.exp(-2j * np.pi * FREQUENCY[:, None] * places) @ steps) / abs(steps.sum()))
    return out


def main() -> None:
    """Print times, ratio and goals."""
    set_threads(2)
    rng = np.random.default_rng(1)
    cell = squares(rng, shape=(600, 600), cell=600, noise=0.0)
    clean = np.zeros((3000, 4000))
    clean[:] = cell[0, 0]
    for row in range(5):
        for col in range(5):
            clean[600 * row : 600 * (row + 1), 800 * col : 800 * col + 600] = cell
    frame = stored(clean + 5.0 * rng.standard_normal(clean.shape)).astype(np.float32)
    picture = Picture("edge", frame, 1, 4095.0)
    found = search_edges([picture])
    ours, theirs, work = [], [], []
    for _ in range(REPEATS):
        start, used = time.perf_counter(), time.process_time()
        edges = responses_of(search_edges([picture])).edges
        ours.append(time.perf_counter() - start)
        work.append(time.process_time() - used)
        used = time.process_time()
        numpy_responses(frame, found)
        theirs.append(time.process_time() - used)
    a, b, c = (float(np.median(v)) for v in (ours, theirs, work))
    print(f"{len(edges)} edges: {a:.2f} s on two threads ({c:.2f} s of processor), plain NumPy with known places {b:.2f} s of processor")
    verdict("100 edges in 12 megapixels", 100 / len(edges) * a, GOAL_S, " s")
    verdict("processor time over that of plain NumPy with known places", c / b, GOAL_RATIO)


if __name__ == "__main__":
    main()
