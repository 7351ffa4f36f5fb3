"""Closed loops of line jitter from upright lines, and of charge transfer, smear and droop from covered columns and rows.

``python benchmarks/study_lines_and_covered.py [cameras]`` draws random cameras with everything else on, measures them blind, and
prints for each quantity the mean and the standard deviation of (measured − true)/u, the limits that hold, and what was found where there is
nothing. With 40 cameras the standard deviations were 0.83 to 0.99 for jitter and loop, 0.76 to 1.10 for charge transfer and droop, 0.55 for
smear; all limits held, and nothing was found that was not there.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from assess import test_covered as borders
from observe.row_pictures import bars, jitter
from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.job import observe_campaign
from pixmetry.core.number import Estimates
from pixmetry.core.progress import no_progress

Scores = defaultdict[str, list[float]]
AT = ([(40.0, 43.0), (80.0, 83.0)], [(50.0, 110.0)], [(60.0, 62.0)])


def judge(found: Estimates, truth: dict[str, float], scores: Scores) -> None:
    """Put z of every value, and the verdict on every limit, to the others."""
    for name, true in truth.items():
        if name not in found:
            scores[f"{name}: not told"].append(1)
            continue
        number = found[name]
        if number.is_limit:
            scores[f"{name}: limits that hold" if true <= number.value else f"{name}: limits that fail"].append(1)
        elif true:
            scores[name].append((number.value - true) / number.u)
        else:
            scores[f"{name}: found without being there"].append(1)


def lines(rng: np.random.Generator, scores: Scores) -> None:
    """One picture of lines: white jitter in two of three, a loop in one of three, row noise and motion always."""
    frames, rows = int(rng.integers(6, 20)), int(rng.integers(150, 400))
    kind = rng.integers(3)
    white, loop = (rng.uniform(0.01, 0.2) if kind else 0.0), (rng.uniform(0.05, 0.2) if kind == 2 else 0.0)
    length, stride = rng.uniform(2, 15), int(rng.integers(1, 3))
    shift = jitter(rng, frames, rows, white, loop, length, stride)
    picture = bars(rng, shift, AT[int(rng.integers(3))], row_noise=rng.uniform(0, 3))
    flat = [Frames("dark", 0.01, (20 + 2 * rng.standard_normal((2, *picture.shape[1:]))).round().astype(np.uint16))]
    for light in (500.0, 1000.0, 1500.0, 2000.0):
        dn = 20 + 0.3 * rng.poisson(light, (2, *picture.shape[1:])) + 2 * rng.standard_normal((2, *picture.shape[1:]))
        flat.append(Frames("bright", light / 1e5, dn.round().astype(np.uint16)))
    _, seen = observe_campaign(campaign_of_arrays([Frames("line", None, picture), *flat], bits=12), no_progress)
    assert seen.lines is not None
    truth = {"white_px": white, "loop_px": loop} | ({"loop_rows": length} if loop else {})
    judge(seen.lines.jitter, truth, scores)


def covered(rng: np.random.Generator, scores: Scores) -> None:
    """One camera with charge transfer, smear and droop, each in about half."""
    analogue = bool(rng.integers(2))
    on = rng.random(3) < 0.5
    moves = {"serial_cti": 10 ** rng.uniform(-6, -4.3), "parallel_cti": 10 ** rng.uniform(-5.5, -4.3), "trail_px": rng.uniform(1, 2.5)}
    smear_s, droop = 10 ** rng.uniform(-5, -3.5), rng.uniform(0.002, 0.02)
    changed: dict[str, dict[str, object]] = {}
    if on[0]:
        changed["sensor__charge_transfer"] = {name: float(value) for name, value in moves.items()}
    if on[1]:
        changed["sensor__smear"] = {"transfer_s": float(smear_s), "rows": "all"}
    if analogue:
        changed["grabber__clamp"] = {"droop_rel": float(droop) if on[2] else 0.0, "noise_dn": 0.3}
    interface = "analogue" if analogue else "digital"
    camera = borders.camera_with(interface, **changed)
    _, seen, _, _ = borders.measured(camera, int(rng.integers(1 << 30)), interface)
    assert seen.covered is not None
    lit = (borders.LIT[3] - borders.LIT[2]) / borders.ROWS
    truth = {name: value if on[0] else 0.0 for name, value in moves.items() if on[0] or name != "trail_px"}
    truth |= {"smear_s": smear_s * lit if on[1] else 0.0} | ({"droop_rel": droop if on[2] else 0.0} if analogue else {})
    judge(seen.covered.fit, truth, scores)


def main() -> None:
    """Run both loops and print."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    start = time.process_time()
    for loop in (lines, covered):
        scores: Scores = defaultdict(list)
        for camera in range(count):
            loop(np.random.default_rng([camera, 7]), scores)
        for name, values in sorted(scores.items()):
            if ":" in name:
                print(f"{name}: {len(values)}")
            else:
                print(f"{name}: {len(values)} values, mean z {np.mean(values):.2f}, standard deviation of z {np.std(values):.2f}")
    print(f"{time.process_time() - start:.0f} s of one core")


if __name__ == "__main__":
    main()
