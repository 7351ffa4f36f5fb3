"""Time of a budget on paper: ``python benchmarks/bench_budget.py [--simulate] [PRESET ...]``.

All rows by their fastest way, for a camera of five megapixels, for an analogue one with a frame grabber, and for a frame-transfer CCD. With
``--simulate`` then every source that a simulation of the first one can make, each with 10 000 windows with it and without, beside the Monte
Carlo of one source in plain NumPy in the same run: discs, photons, a fixed pattern, rounding, and a centroid above a threshold.
Goals: 4 s for all rows of five megapixels, 60 s for all simulations, on two cores that do nothing else.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
from goals import verdict

import pixmetry
from pixmetry.budget.monte_carlo import Trials
from pixmetry.budget.scenario import Scenario
from pixmetry.budget.setting import Setting
from pixmetry.camera.camera import Element, load_camera
from pixmetry.camera.catalogue import sources
from pixmetry.core.errors import PixmetryError
from pixmetry.locate.target_estimator import TargetEstimator

ROWS_S, SIMULATED_S, TRIALS, UNITS = 4.0, 60.0, 10_000, 32
PRESETS = ("imx264_like", "pulnix_tm6cn_epix_512", "ft_ccd_generic")
SIDE, FINE, RADIUS_PX, PHOTO_E, PATTERN_REL = 15, 10, 3.5, 6000.0, 0.005


def timed(work: Callable[[], object], times: int) -> tuple[float, float]:
    """The shortest of several runs: seconds by the clock, and of the processor."""
    best = (np.inf, np.inf)
    for _ in range(times):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        best = min(best, (time.perf_counter() - wall, time.process_time() - cpu))
    return best


def simulated_rows(name: str) -> int:
    """Every source of the catalogue that can be simulated in this camera, by `TRIALS` windows with it and without; how many they were."""
    setting = Setting(load_camera(name), Scenario())
    design = Trials(setting.camera, setting.target, TargetEstimator(), setting.facts, TRIALS, UNITS)
    there = {e.source.id: e for e in setting.camera.chain}
    done = 0
    for source in sources().values():
        if source.forward is None or source.essential and source.ideal is None:
            continue
        try:
            design.alone(there.get(source.id, Element(source.id, source, source.typical)))
            done += 1
        except PixmetryError:  # such a camera has no place for it
            continue
    return done


def plain_numpy() -> float:
    """Standard deviation in px by a Monte Carlo of photon noise and a fixed pattern in plain NumPy."""
    rng = np.random.Generator(np.random.Philox(1))
    fine = (np.arange(SIDE * FINE) + 0.5) / FINE - 0.5
    errors = []
    for _ in range(TRIALS // 500):
        x, y = SIDE // 2 + rng.uniform(-0.5, 0.5, (2, 500))
        inside = np.hypot(fine[None, None, :] - x[:, None, None], fine[None, :, None] - y[:, None, None]) < RADIUS_PX
        mean = PHOTO_E * inside.reshape(500, SIDE, FINE, SIDE, FINE).mean(axis=(2, 4)) + 200.0
        seen = np.rint(rng.poisson(mean) * (1 + PATTERN_REL * rng.standard_normal(mean.shape)) * 0.3) / 0.3
        weight = np.maximum(seen - 200.0 - 0.2 * PHOTO_E, 0.0)
        errors.append((weight * np.arange(SIDE)).sum(axis=(1, 2)) / weight.sum(axis=(1, 2)) - x)
    return float(np.std(np.concatenate(errors)))


def main() -> None:
    """Print a line for every preset, then the simulations, then the verdicts."""
    first = {}
    for name in [a for a in sys.argv[1:] if a != "--simulate"] or PRESETS:
        pixmetry.budget(name)  # kernels
        wall, cpu = timed(lambda name=name: pixmetry.budget(name, {"motion": {"speed_px_per_s": 20.0}}), 3)
        rows, cols = load_camera(name).frame_shape
        print(f"{name} ({cols} x {rows} px): all rows in {wall:.2f} s ({cpu:.2f} s of the processor)")
        first.setdefault(name, wall)
    name = next(iter(first))
    verdict(f"all rows of {name}", first[name], ROWS_S, " s")
    if "--simulate" not in sys.argv:
        return
    plain, plain_cpu = timed(plain_numpy, 2)
    start, begun = time.perf_counter(), time.process_time()
    count = simulated_rows(name)
    wall, cpu = time.perf_counter() - start, time.process_time() - begun
    print(f"{name}: {count} sources simulated, {TRIALS} windows each, with and without: {wall:.1f} s ({cpu:.1f} s of the processor)")
    print(f"one source in plain NumPy, {TRIALS} windows: {plain:.2f} s ({plain_cpu:.2f} s of the processor)")
    each = cpu / count
    print(
        f"one of ours: {each:.2f} s of the processor; plain NumPy takes {plain_cpu / each:.2f} of that, with a simpler camera and estimator"
    )
    verdict(f"{count} simulations of {TRIALS} windows", wall, SIMULATED_S, " s")


if __name__ == "__main__":
    main()
