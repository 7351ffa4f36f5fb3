"""Do the intervals hold on cameras that other people simulate? Every value of an assessment and of its data sheet.

    python benchmarks/study_foreign_cameras.py --cameras 200 --seed 1

Cameras of ``tests/emva/foreign_cameras.py`` (plain NumPy): gain 0.02-2 DN/e-, 8-16 bit, hot pixels, fixed waves, shading, temporal row and
column noise, dark current, flicker, full well or converter limited, in a third of them a response that bends by 2 %. For each value: how
many of the 95 % intervals (Student's t with the stated degrees of freedom) hold the truth, mean and standard deviation of the errors over
u, the worst of them, and how many of the limits are true.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from emva.foreign_cameras import random_camera  # noqa: E402
from emva.foreign_scoring import Outcome, outcomes  # noqa: E402


def one(seed: int, draws: int) -> tuple[int, list[Outcome], list[str]]:
    """All that is said of one camera, beside the truth."""
    found, missing = outcomes(random_camera(seed), draws)
    return seed, found, missing


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--worst", type=float, default=5.0, help="list what is off by more than so many u")
    args = parser.parse_args()
    start, table, told = time.perf_counter(), {}, {}
    seeds = range(1_000_000 * args.seed, 1_000_000 * args.seed + args.cameras)
    with ProcessPoolExecutor(args.processes) as pool:
        for seed, found, missing in pool.map(one, seeds, [args.draws] * args.cameras):
            for o in found:
                table.setdefault(o.name, []).append((seed, o))
            for text in missing:
                told.setdefault(text, []).append(seed)
    print(f"{'value':42s}{'n':>5s}{'in 95 %':>9s}{'mean z':>8s}{'std z':>7s}{'limits':>10s}  worst")
    total, held, limits, true_limits = 0, 0, 0, 0
    for name, rows in sorted(table.items()):
        values = [(s, o) for s, o in rows if o.kind == "value"]
        bounds = [o.holds for _, o in rows if o.kind != "value"]
        z = np.array([o.z for _, o in values])
        inside = sum(o.holds for _, o in values)
        total, held, limits, true_limits = total + len(values), held + inside, limits + len(bounds), true_limits + sum(bounds)
        low = stats.binom.cdf(inside, len(values), 0.95) if values else 1.0
        text = f"{name:42s}{len(values):5d}" + (f"{100 * inside / z.size:8.1f} {z.mean():8.2f}{z.std():7.2f}" if z.size else 25 * " ")
        text += f"{f'{sum(bounds)}/{len(bounds)}' if bounds else '-':>10s}  "
        text += ", ".join(f"{o.z:+.1f} ({s})" for s, o in sorted(values, key=lambda r: -abs(r[1].z))[:3] if abs(o.z) > args.worst)
        print(text + ("  LOW" if low < 1e-3 else ""))
    print(f"all values: {held} of {total} ({100 * held / total:.1f} %) in their 95 % intervals; {true_limits} of {limits} limits are true")
    for text, where in sorted(told.items(), key=lambda item: -len(item[1])):
        print(f"{len(where):4d} x {text} (e.g. {where[0]})")
    print(f"{args.cameras} cameras in {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
