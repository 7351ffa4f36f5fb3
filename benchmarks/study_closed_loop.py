"""Does every stated uncertainty hold? Random cameras are simulated, measured blind and compared with the truth.

    python benchmarks/study_closed_loop.py --cameras 1200 --jobs 2 --seed 1

The table goes to docs/closed-loop.md. A camera is made from (seed, number): any part of the study can be repeated alone (``--first``).
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

os.environ.setdefault("PIXMETRY_THREADS", "1")  # the processes share out the cameras
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from statistical import closed_loop, closed_loop_page  # noqa: E402

FALSE_FAILURE_RATE = 1e-3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cameras", type=int, default=1200)
    parser.add_argument("--first", type=int, default=0, help="number of the first camera")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "closed-loop.md")
    args = parser.parse_args()
    start = time.perf_counter()
    numbers = range(args.first, args.first + args.cameras)
    with ProcessPoolExecutor(args.jobs) as pool:
        results = list(pool.map(partial(closed_loop.run_camera, args.seed), numbers, chunksize=4))
    minutes = (time.perf_counter() - start) / 60
    text = closed_loop_page.cameras_section(results, args.seed, args.first, FALSE_FAILURE_RATE)
    closed_loop_page.write_section(args.page, "random cameras", text)
    print(text)
    print(f"{args.cameras} cameras in {minutes:.1f} min; written to {args.page}")


if __name__ == "__main__":
    main()
