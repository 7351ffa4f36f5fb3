"""Where the time of a frame goes: ``python benchmarks/bench_chain.py [CAMERA] [ROWS] [COLS]``.

Exposes frames of a camera (a file or the name of a preset; by default the detection chain of bench_detection.py) on one thread and prints
the milliseconds of processor time that each element of the running chain takes, conversions between the kinds included. Then the whole
on one and on two threads, by the clock on the wall. Between the elements bands are cut and joined. The scene is the one of
bench_presets.py, a hundred discs. It has no goal of its own but to find what sticks out: the goals are in bench_detection.py and
bench_presets.py.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections import Counter
from dataclasses import replace

from bench_detection import camera
from bench_presets import scene_of

from pixmetry.camera import camera as running
from pixmetry.camera.camera import Camera, load_camera
from pixmetry.camera.conversions import look
from pixmetry.camera.source import run
from pixmetry.core.threads import set_threads

FRAMES = 8


def timed_elements(chosen: Camera, frames: range) -> Counter[str]:
    """Processor seconds in each source and outside of them, summed over the frames."""
    spent: Counter[str] = Counter()

    def measured(source, params, signal, stream, state=None):
        start = time.thread_time()
        result = run(source, params, signal, stream, state)
        spent[source.id] += time.thread_time() - start
        return result

    def looking(*of):
        start = time.thread_time()
        result = look(*of)
        spent["core.look"] += time.thread_time() - start
        return result

    running.run, running.look = measured, looking
    try:
        start = time.thread_time()
        exposed_s(chosen, frames, 1)
        spent["between them"] = time.thread_time() - start - sum(spent.values())
    finally:
        running.run, running.look = run, look
    return spent


def exposed_s(chosen: Camera, frames: range, threads: int) -> float:
    """Seconds that so many frames take."""
    set_threads(threads)
    start = time.perf_counter()
    for _ in chosen.iter_frames(scene_of(chosen), frames):
        pass
    return time.perf_counter() - start


def main() -> None:
    """Print milliseconds a frame."""
    chosen = load_camera(sys.argv[1]) if len(sys.argv) > 1 else camera()
    if len(sys.argv) > 3:
        chosen = replace(chosen, frame_shape=(int(sys.argv[2]), int(sys.argv[3])))
    numbers = itertools.count(0)

    def some() -> range:
        first = next(numbers) * FRAMES
        return range(first, first + FRAMES)

    exposed_s(chosen, some(), 1)
    spent = timed_elements(chosen, some())
    whole = {threads: sorted(exposed_s(chosen, some(), threads) for _ in range(5))[2] for threads in (1, 2)}
    rows, cols = chosen.frame_shape
    print(f"{chosen.name}: {rows} x {cols} px, ms a frame")
    for name, seconds in spent.most_common():
        print(f"{name:<40} {1e3 * seconds / FRAMES:8.2f}")
    for threads, seconds in whole.items():
        print(f"{f'whole frame, threads: {threads}':<40} {1e3 * seconds / FRAMES:8.2f}")


if __name__ == "__main__":
    main()
