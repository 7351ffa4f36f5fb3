"""Are the uncertainties of an EMVA 1288 data sheet what they say? Every value of every release, on simulated cameras.

    python benchmarks/study_emva1288.py --cameras 400 --seed 1

Random linear cameras (gain 0.05-1.5 DN/e-, read noise 1-15 e-, dark noise 0.2 DN and more, 8-16 bit, patterns of pixels, rows and columns
or none of them, temporal row noise, dark current, flicker, scatter of the light's setting, shading, full well or converter limited,
exposure or light swept) are taken as frames by a simulator that shares nothing with the package. The truth of a value is its release's
formula on the noise-free images.

For each value: the errors over u (mean, standard deviation), how many lie outside 95 and 99 % of Student's t with the stated degrees of
freedom, and the probability of transforms so uneven by chance (the smallest of four tests, each allowed for). Upper limits must lie above
the truth in 95 % of the cases. Levels, which come in steps, largest deviations, which are never negative, and what is so near zero that it
may come out as a limit are covered if the truth is within 3 u. A value fails below 1e-6 over the number of values; with 400 cameras that
catches with 99 % an error of 0.42 u in all of them, or a u too small by a factor of 1.33.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from emva.cameras import random_camera  # noqa: E402
from emva.scoring import Score, collect, measured  # noqa: E402
from emva.truths import truths  # noqa: E402
from pixmetry.emva.evaluate import evaluate  # noqa: E402
from pixmetry.emva.records import RELEASES  # noqa: E402

ALPHA = 1e-6


def assess(seed: int, draws: int, small: bool) -> list:
    """Results and truths of one camera, release by release."""
    camera = random_camera(seed, small)
    m = measured(camera)
    out = []
    for release in RELEASES:
        result = evaluate(m, release, draws=draws)
        out.append((type(result)(release, result.values), truths(camera, release)))
    return out


def outside(score: Score, share: float) -> str:
    p = np.array(score.transforms)
    return f"{100 * np.mean(np.abs(p - 0.5) > 0.5 - share / 2):.1f}" if p.size else "-"


def print_table(scores: dict[tuple[str, str], Score]) -> int:
    allowed, failed = ALPHA / len(scores), 0
    heads = f"{'mean':>7s}{'std':>6s}{'>95 %':>7s}{'>99 %':>7s}{'limits':>10s}{'within 3 u':>12s}{'p':>9s}"
    print(f"{'release':10s}{'value':26s}{'n':>5s}{heads}")
    for (release, key), score in sorted(scores.items(), key=lambda item: item[0][0]):
        z, p = np.array(score.errors), score.p()
        moments = f"{z.mean():7.2f}{z.std():6.2f}" if z.size else f"{'-':>7s}{'-':>6s}"
        limits = f"{sum(score.limits)}/{len(score.limits)}" if score.limits else "-"
        covered = f"{sum(score.covered)}/{len(score.covered)}" if score.covered else "-"
        n = len(score.errors) + len(score.limits) + len(score.covered)
        mark = "  fails" if p < allowed else ""
        failed += p < allowed
        tails = f"{outside(score, 0.05):>7s}{outside(score, 0.01):>7s}"
        print(f"{release:10s}{key:26s}{n:5d}{moments}{tails}{limits:>10s}{covered:>12s}{p:9.2g}{mark}")
    return failed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--small", action="store_true", help="frames of 48 x 64 to 72 x 96 pixels")
    args = parser.parse_args()
    start, scores = time.perf_counter(), {}
    seeds = range(1_000_000 * args.seed, 1_000_000 * args.seed + args.cameras)
    with ProcessPoolExecutor(args.processes) as pool:
        for results in pool.map(assess, seeds, [args.draws] * args.cameras, [args.small] * args.cameras, chunksize=4):
            collect(scores, results)
    failed = print_table(scores)
    print(f"{args.cameras} cameras in {time.perf_counter() - start:.0f} s; {failed} of {len(scores)} values fail")


if __name__ == "__main__":
    main()
