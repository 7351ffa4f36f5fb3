"""All presets with every source on: ``python benchmarks/bench_presets.py [PRESET ...]``.

A hundred bright discs on a grey background, on a lattice that meets many places within the pixel. Frames a second with one and with two
threads (the best of some runs over a few frames, the first ones apart), and the peak of resident memory above that of the same work on a
sensor of 96 × 128 px. Every preset runs in processes of its own.

Goals: 6 frames a second for ``pulnix_tm6cn`` on two threads; 60 MB for a frame of one megapixel, in proportion for larger ones.
"""

from __future__ import annotations

import subprocess
import sys
from importlib.resources import files
from pathlib import Path

from goals import verdict

FRAMES_PER_S, MEMORY_MB = 6.0, 60.0
SMALL = (96, 128)
RUN = """
import sys, time
from dataclasses import replace
sys.path.insert(0, sys.argv[1])
from bench_presets import scene_of
from pixmetry.camera.camera import load_camera
name, small, timed = sys.argv[2], sys.argv[3] == "small", sys.argv[4] == "timed"
camera = load_camera(name)
if small:
    camera = replace(camera, frame_shape=(int(sys.argv[5]), int(sys.argv[6])))
scene, best = scene_of(camera), []
for threads in (1, 2):
    for _ in camera.iter_frames(scene, range(2), threads=threads):
        pass
    rates = []
    for k in range(3 if timed else 1):
        numbers = range(6) if any(e.remembers for e in camera.links) else range(6 * k, 6 * k + 6)
        start = time.perf_counter()
        for _ in camera.iter_frames(scene, numbers, seed=k, threads=threads):
            pass
        rates.append(len(numbers) / (time.perf_counter() - start))
    best.append(max(rates))
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1]
print(*best, float(peak) / 1024, len(camera.links), *camera.output_shape)
"""


def scene_of(camera):
    """Ten rows of ten discs whose places within the pixel differ; half of the light that fills the well, where there is one."""
    import numpy as np

    from pixmetry.scene.discs import Discs
    from pixmetry.scene.uniform import Uniform

    rows, cols = camera.frame_shape
    y, x = np.meshgrid(np.linspace(0.07, 0.93, 10) * rows, np.linspace(0.07, 0.93, 10) * cols, indexing="ij")
    wells = [e.params.full_well_e for e in camera.chain if e.source.id == "sensor.full_well"]
    photons = min([*wells, 20_000.0])
    return Discs(x.ravel(), y.ravel(), diameter_px=7.0, blur_px=0.5, peak_photons=photons, background=Uniform(0.1 * photons))


def of_preset(name: str, small: bool = False, timed: bool = True) -> list[float]:
    """Frames a second on one and two threads, peak memory in MB, number of links, rows and columns."""
    here = str(Path(__file__).parent)
    words = [sys.executable, "-c", RUN, here, name, "small" if small else "whole", "timed" if timed else "once", *map(str, SMALL)]
    return [float(v) for v in subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()]


def main() -> None:
    """Print a line for each preset, then the verdicts."""
    presets = (files("pixmetry.camera") / "presets").iterdir()
    names = sys.argv[1:] or sorted(p.name.removesuffix(".yaml") for p in presets if p.name.endswith(".yaml"))
    print(f"{'preset':<30}{'frame':>12}{'steps':>7}{'1 thread':>12}{'2 threads':>12}{'memory':>12}")
    told = {}
    for name in names:
        of_preset(name, small=True, timed=False)  # compiles what is not yet compiled
        base = of_preset(name, small=True, timed=False)[2]
        one, two, peak, links, rows, cols = of_preset(name)
        told[name] = two, peak - base, rows * cols / 2**20
        print(f"{name:<30}{f'{rows:.0f} x {cols:.0f}':>12}{links:>7.0f}{one:>10.1f}/s{two:>10.1f}/s{peak - base:>+9.1f} MB")
    if "pulnix_tm6cn" in told:
        verdict("pulnix_tm6cn, every source on, two threads", told["pulnix_tm6cn"][0], FRAMES_PER_S, " frames/s", at_least=True)
    worst = max(told, key=lambda n: told[n][1] / max(1.0, told[n][2]))
    verdict(f"memory above imports per megapixel, {worst}", told[worst][1] / max(1.0, told[worst][2]), MEMORY_MB, " MB")


if __name__ == "__main__":
    main()
