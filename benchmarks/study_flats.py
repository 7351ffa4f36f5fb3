"""What flat and dark frames tell beside the photon transfer: random cameras, measured blind, against the truth.

    python benchmarks/study_flats.py --cameras 200 --jobs 2 --seed 1

For each kind of camera and each value: how many were found as a value, mean and scatter of (value − truth)/u, the largest, how many limits
hold, and the median of u. Of ``none`` every value beside gain and noise is a false finding.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

os.environ.setdefault("PIXMETRY_THREADS", "1")  # the processes share out the cameras
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import numpy as np  # noqa: E402

from statistical.flat_cameras import GAIN, KINDS, flat_case, measured  # noqa: E402

WATCHED = (
    "electronics.tap_gain.step_rel",
    "processing.sharpening.amount",
    "processing.temporal_noise_reduction.alpha",
    "sensor.brighter_fatter.area_loss_per_e",
    "sensor.bayer_mosaic.green",
    "electronics.column_noise.gain_rel",
    "electronics.telegraph_noise.share",
)


def scores_of(kind: str, seed: int, shape: tuple[int, int], levels: int, index: int) -> list[tuple[str, str, float, float]]:
    """Name, kind, (value − truth)/u or whether the limit holds, and u over the truth (u alone where that is zero)."""
    rng = np.random.default_rng([seed, index, KINDS.index(kind)])
    case = flat_case(rng, kind, shape=shape, levels=levels)
    found, rows = measured(case, index), []
    for name in dict.fromkeys([*case.truth, *WATCHED]):
        true = case.truth.get(name, 0.0)
        if name not in found:
            rows.append((name, "missing", 0.0, 0.0))
            continue
        e = found[name]
        score = float(true <= e.value) if e.is_limit else (e.value - true) / (e.u or 1.0)
        rows.append((name, e.kind, score, e.u / (abs(true) or 1.0)))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cameras", type=int, default=200, help="of each kind")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--rows", type=int, default=120)
    parser.add_argument("--cols", type=int, default=160)
    parser.add_argument("--levels", type=int, default=10)
    args = parser.parse_args()
    with ProcessPoolExecutor(args.jobs) as pool:
        for kind in args.kinds:
            work = partial(scores_of, kind, args.seed, (args.rows, args.cols), args.levels)
            by_name: dict[str, list[tuple[str, float, float]]] = defaultdict(list)
            for rows in pool.map(work, range(args.cameras), chunksize=4):
                for name, what, score, u in rows:
                    by_name[name].append((what, score, u))
            print(f"{kind}: {args.cameras} cameras of {args.rows} × {args.cols} pixels, {args.levels} levels", flush=True)
            for name in sorted(by_name, key=lambda n: n != GAIN):
                print("  ", name, told(by_name[name]), flush=True)


def told(rows: list[tuple[str, float, float]]) -> str:
    """One line on one value."""
    z = np.array([score for what, score, _ in rows if what == "value"])
    limits = [score for what, score, _ in rows if what == "upper_limit"]
    u = [u for what, _, u in rows if what != "missing"]
    text = f"{z.size} values" + (f", z {z.mean():+.2f} ± {z.std():.2f}, largest {np.abs(z).max():.1f}" if z.size else "")
    text += f", {len(limits)} limits of which {int(sum(limits))} hold" if limits else ""
    return text + (f", median u {np.median(u):.3g}" if u else ", never measured")


if __name__ == "__main__":
    main()
