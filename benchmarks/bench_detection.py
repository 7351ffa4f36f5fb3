"""Speed of the detection chain: ``python benchmarks/bench_detection.py``.

One frame of 1024 × 1024 px, uint16, two threads, from light to code: photo response, dark current, shot noise, full well, dark
non-uniformity, read noise, gain, converter. Beside it plain NumPy with one generator (PCG64) and the same physics, in two forms: with one
Poisson draw of light and dark electrons together, and with one draw for each. Its maps of the unit are drawn beforehand; ours come from the
keyed generator, in every frame anew. Every repeat runs all of them one after the other; a ratio is the median of those of the repeats.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable

import numpy as np
from goals import verdict

from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import get_source
from pixmetry.core.threads import set_threads
from pixmetry.scene.uniform import Uniform

SHAPE = (1024, 1024)
FRAMES, REPEATS, THREADS = 4, 15, 2
LEVELS_E = (10.0, 100.0, 1000.0, 10_000.0)
GOAL = 0.5
PRNU, DARK_E_PER_S, FULL_WELL_E, DSNU_E, READ_E, GAIN, OFFSET_DN, BITS = 0.01, 200.0, 15_000.0, 1.5, 2.5, 0.25, 40.0, 12
EXPOSURE_S = 0.01
CHAIN = (
    ("sensor.quantum_efficiency", {"quantum_efficiency": 1.0}),
    ("sensor.prnu", {"pixel_std_rel": PRNU}),
    ("sensor.dark_current", {"rate_e_per_s": DARK_E_PER_S}),
    ("sensor.shot_noise", {}),
    ("sensor.full_well", {"full_well_e": FULL_WELL_E}),
    ("sensor.dsnu", {"pixel_std_e": DSNU_E}),
    ("electronics.amplifier_noise", {"white_e": READ_E}),
    ("electronics.gain", {"gain_dn_per_e": GAIN}),
    ("grabber.adc", {"bits": BITS, "offset_dn": OFFSET_DN}),
)


def camera(shape: tuple[int, int] = SHAPE) -> Camera:
    """The detection chain alone."""
    chain = [Element(name, get_source(name), get_source(name).make(values)) for name, values in CHAIN]
    return Camera("detection", shape, tuple(chain), exposure_s=EXPOSURE_S)


class Plain:
    """The same chain in NumPy, as it is usually written; the maps of the unit are there already."""

    def __init__(self, level_e: float, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.light_e = level_e * (1 + PRNU * self.rng.standard_normal(SHAPE))
        self.dsnu_e = DSNU_E * self.rng.standard_normal(SHAPE)

    def merged(self) -> np.ndarray:
        """A frame with one Poisson draw."""
        return self._stored(self.rng.poisson(self.light_e + DARK_E_PER_S * EXPOSURE_S))

    def separate(self) -> np.ndarray:
        """A frame with one Poisson draw for the light and one for the dark electrons."""
        return self._stored(self.rng.poisson(self.light_e) + self.rng.poisson(DARK_E_PER_S * EXPOSURE_S, SHAPE))

    def _stored(self, electrons: np.ndarray) -> np.ndarray:
        held = np.minimum(electrons, FULL_WELL_E) + self.dsnu_e
        dn = GAIN * (held + self.rng.normal(0.0, READ_E, SHAPE))
        return np.clip(np.floor(dn + OFFSET_DN + 0.5), 0, 2**BITS - 1).astype(np.uint16)


def paired_s(actions: dict[str, Callable[[], object]], repeats: int) -> dict[str, np.ndarray]:
    """Time all actions in turn, repeat by repeat; one round before that is not counted."""
    times: dict[str, list[float]] = {name: [] for name in actions}
    for repeat in range(repeats + 1):
        for name, action in actions.items():
            start = time.perf_counter()
            action()
            if repeat:
                times[name].append(time.perf_counter() - start)
    return {name: np.array(values) for name, values in times.items()}


def main() -> None:
    """Print milliseconds a frame and the ratios, level by level."""
    set_threads(THREADS)
    ours, numbers, worst = camera(), itertools.count(0, FRAMES), 0.0
    print(f"{SHAPE[0]} x {SHAPE[1]} px, {THREADS} threads, ms a frame (medians)")
    print(f"{'level':>10} {'pixmetry':>10} {'one frame':>10} {'NumPy':>8} {'2 draws':>8} {'ratio':>8} {'ratio, 2 draws':>15}")
    for level in LEVELS_E:
        plain, scene = Plain(level), Uniform(level)

        def series(scene: Uniform = scene) -> None:
            first = next(numbers)
            for _ in ours.iter_frames(scene, range(first, first + FRAMES)):
                pass

        t = paired_s(
            {
                "series": series,
                "single": lambda scene=scene: ours.expose(scene, [next(numbers)]),
                "merged": plain.merged,
                "separate": plain.separate,
            },
            REPEATS,
        )
        t["series"] /= FRAMES
        ms = [1e3 * float(np.median(t[name])) for name in ("series", "single", "merged", "separate")]
        ratios = [float(np.median(t["series"] / t[name])) for name in ("merged", "separate")]
        print(f"{level:8.0f} e {ms[0]:10.1f} {ms[1]:10.1f} {ms[2]:8.1f} {ms[3]:8.1f} {ratios[0]:8.3f} {ratios[1]:15.3f}")
        worst = max(worst, ratios[0])
    verdict("detection chain over plain NumPy with one Poisson draw, at its worst level", worst, GOAL)


if __name__ == "__main__":
    main()
