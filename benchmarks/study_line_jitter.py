"""The line-jitter experiment of the handbook in full: 54 frames for each of five jitters.

``python benchmarks/study_line_jitter.py`` prints it; with ``--store`` it also replaces the numbers that docs/handbook/line-jitter.md shows.
"""

from __future__ import annotations

import sys
import time

from gallery import line_jitter


def main() -> None:
    """Run, print the residual table and the jitters found, and store them."""
    start = time.process_time(), time.perf_counter()
    experiment = line_jitter.run(progress=lambda text: print(f"  {text} … {time.perf_counter() - start[1]:.0f} s", flush=True))
    if "--store" in sys.argv[1:]:
        line_jitter.write(experiment, line_jitter.STORED)
    print(f"gain of a delay: {', '.join(f'{g:.3f}' for g in experiment.gains)}")
    for level in experiment.levels:
        test = level.f_test
        x, y = (f"{a.rms_px:.5f} px = {a.rms_um:.4f} µm" for a in (level.x, level.y))
        print(f"{level.jitter_ns:g} ns: x {x}, y {y}. {test['text']}")
        for way, found in level.jitters(experiment.gain).items():
            e = found["jitter_ns"]
            print(f"    {way:9s} {'below ' if e.kind == 'upper_limit' else ''}{e.value:.3f} ns, u {e.u:.3f} ns {e.reason}")
    print(f"{time.process_time() - start[0]:.0f} s of one core, {time.perf_counter() - start[1]:.0f} s")


if __name__ == "__main__":
    main()
