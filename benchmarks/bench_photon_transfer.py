"""Time of the photon-transfer fit of 50 bright and 50 dark levels: ``python benchmarks/bench_photon_transfer.py``."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from goals import verdict

from pixmetry.observe.photon_transfer_fit import fit_photon_transfer

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from observe.simulated_camera import Camera, drawn_record  # noqa: E402

GOAL_MS = 20.0


def main() -> None:
    """Print the shortest of ten fits."""
    record = drawn_record(Camera(), np.random.default_rng(1))  # the same work in every run
    fit_photon_transfer(record)
    times = []
    for _ in range(10):
        start = time.perf_counter()
        fit_photon_transfer(record)
        times.append(time.perf_counter() - start)
    verdict("a fit of 50 + 50 levels", 1e3 * min(times), GOAL_MS, " ms")


if __name__ == "__main__":
    main()
