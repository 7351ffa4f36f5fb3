"""Speed of charge transfer at 1024 × 1024, one thread: ``python benchmarks/bench_charge_transfer.py [PYTHON_WITH_ARCTICPY]``.

Prints milliseconds a frame, and the ratio to other implementations of the same operation. The fixed share, electron by electron: by
NumPy, one image of binomial numbers for every pixel of delay; and as shares, for the means. The traps: by NumPy, all columns at once, row
after row, without their noise; and by arcticpy, which needs NumPy 1 and so an interpreter of its own (``pip install arcticpy``, with the
headers of the GNU Scientific Library). There every packet passes every pixel's traps if ``express`` is 0, with
``empty_traps_for_first_transfers``; that is what is computed here. Larger numbers of passes are its approximations; they are timed too.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
from goals import verdict

from pixmetry.camera.signal import Kind, Signal
from pixmetry.core.random import Grid, QuietStreams, Streams
from pixmetry.sources.sensor.charge_transfer import SOURCE, ChargeTransfer

SIDE = 1024
GOAL = 0.5
EXACT_COLUMNS = 8  # of arcticpy's exact mode, whose time goes with their number
LINEAR = ChargeTransfer(parallel_cti=1e-5, serial_cti=1e-5)
TRAPS = ChargeTransfer(slow_traps_per_px=1.0, slow_release_px=10.0, fill_beta=0.5, trap_well_e=1e5)
BASELINE = """
import json, sys, time
import arcticpy as ac, numpy as np
side, exact = int(sys.argv[1]), int(sys.argv[2])
image = np.random.default_rng(1).poisson(1000, (side, side)).astype(float)
ccd = ac.CCD(full_well_depth=1e5, well_fill_power=0.5)
traps = [ac.TrapInstantCapture(density=1.0, release_timescale=10.0)]
def run(columns, **kw):
    part, times = image[:, :columns].copy(), []
    for _ in range(1 if columns < side else 3):
        start = time.perf_counter()
        out = ac.add_cti(part, parallel_ccd=ccd, parallel_traps=traps, verbosity=0, **kw)
        times.append(time.perf_counter() - start)
    return min(times) * side / columns, out
roe = ac.ROE(empty_traps_for_first_transfers=True)
true_s, true = run(exact, parallel_roe=roe, parallel_express=0)
times = {f"express {e}": run(side, parallel_roe=ac.ROE(), parallel_express=e)[0] for e in (1, 5)}
print(json.dumps({"times": {"exact": true_s} | times, "image": image[:, :exact].tolist(), "out": true.tolist()}))
"""


def best_s(action: Callable[[], object], rounds: int = 5) -> float:
    """Return the shortest of several runs, after one that compiles."""
    action()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def frame(image: np.ndarray) -> Signal:
    """One whole frame of electrons."""
    one = np.ones(1)
    return Signal(np.float32(image[None]), Kind.ELECTRONS, Grid.whole([0], image.shape), image.shape, 0.01 * one, 0 * one, 20 * one)


def by_numpy(image: np.ndarray, loss: float, delays: int = 5) -> np.ndarray:
    """Both directions, negative binomial shares as whole shifted images."""
    for axis in (0, 1):
        n = (np.arange(SIDE) + 1.0).reshape((-1, 1) if axis == 0 else (1, -1))
        share, out = (1 - loss) ** n, np.zeros_like(image)
        for j in range(delays):
            moved = share * image
            out[(slice(j, None),) if axis == 0 else (slice(None), slice(j, None))] += (
                moved[: SIDE - j] if axis == 0 else moved[:, : SIDE - j]
            )
            share = share * loss * (n + j) / (j + 1)
        image = out
    return image


def one_by_one_by_numpy(image: np.ndarray, loss: float, delays: int = 4) -> np.ndarray:
    """Both directions, each electron for itself: of those that are j pixels late so many go on."""
    rng = np.random.default_rng(3)
    for axis in (0, 1):
        n = (np.arange(SIDE) + 1.0).reshape((-1, 1) if axis == 0 else (1, -1))
        share = (1 - loss) ** n
        reached, rest, out = np.ones_like(share), image.astype(np.int64), np.zeros_like(image)
        for j in range(delays):
            further = np.clip((reached - share) / np.where(reached > 1e-15, reached, 1.0), 0.0, 1.0)
            late = rng.binomial(rest, np.broadcast_to(further, rest.shape))
            stays = rest - late
            out[(slice(j, None),) if axis == 0 else (slice(None), slice(j, None))] += (
                stays[: SIDE - j] if axis == 0 else stays[:, : SIDE - j]
            )
            reached, share, rest = reached - share, share * loss * (n + j) / (j + 1), late
        image = out
    return image


def traps_by_numpy(image: np.ndarray) -> np.ndarray:
    """The same passing of traps, all columns at once: a stack of filled levels for each, with the row at which each was filled last."""
    density, tau, rows, cols = TRAPS.slow_traps_per_px, TRAPS.slow_release_px, *image.shape
    height, at = np.zeros((cols, rows + 1)), np.zeros((cols, rows + 1), np.int64)
    depth, trapped, out = np.zeros(cols, np.int64), np.zeros(cols), np.empty(image.shape)
    every, stay = np.arange(cols), np.exp(-np.arange(rows + 1) / tau)
    for c in range(rows):
        x = image[c] + trapped * (1 - stay[1])
        trapped = trapped * stay[1]
        held = np.maximum(x, 0)
        volume = np.minimum(np.minimum((held / TRAPS.trap_well_e) ** TRAPS.fill_beta, 1), held / (density * (c + 1)))
        found, low, open_ = np.zeros(cols), np.zeros(cols), (depth > 0) & (x > 0)
        while open_.any():
            i = every[open_]
            tops, lines = height[i, depth[i] - 1], at[i, depth[i] - 1]
            high = np.minimum(tops, volume[i])
            found[i] += density * (lines + 1) * (high - low[i]) * stay[c - lines]
            low[i] = high
            depth[i] -= tops <= volume[i]
            open_[i] = (tops <= volume[i]) & (depth[i] > 0) & (low[i] < volume[i])
        some = every[x > 0]
        height[some, depth[some]], at[some, depth[some]] = volume[some], c
        depth[some] += 1
        caught = np.where(x > 0, density * (c + 1) * volume - found, 0.0)
        trapped, out[c] = trapped + caught, x - caught
    return out


def main() -> None:
    """Time both models."""
    quiet = QuietStreams(1, 2).of("bench")
    stream, image = Streams(1, 2).of("bench"), np.random.default_rng(1).poisson(1000, (SIDE, SIDE)).astype(float)
    signal = frame(image)
    means = best_s(lambda: SOURCE.forward(LINEAR, signal, quiet))
    other = best_s(lambda: by_numpy(image, 1e-5), 3)
    apart = np.abs(SOURCE.forward(LINEAR, signal, quiet).data[0] - by_numpy(image, 1e-5)).max()
    print(f"fixed share, means only      {1e3 * means:8.1f} ms   NumPy {1e3 * other:8.1f} ms   ratio {means / other:.3f}")
    print(f"    largest difference {apart:.1e} e-")
    linear = best_s(lambda: SOURCE.forward(LINEAR, signal, stream))
    drawn = best_s(lambda: one_by_one_by_numpy(image, 1e-5), 2)
    print(f"fixed share, both directions {1e3 * linear:8.1f} ms   NumPy {1e3 * drawn:8.1f} ms   ratio {linear / drawn:.3f}")
    traps = best_s(lambda: SOURCE.forward(TRAPS, signal, stream))
    plain = best_s(lambda: traps_by_numpy(image), 1)
    print(f"traps, one species, columns  {1e3 * traps:8.1f} ms   NumPy {1e3 * plain:8.1f} ms   ratio {traps / plain:.3f}")
    print(f"    largest difference {np.abs(SOURCE.forward(TRAPS, signal, quiet).data[0] - traps_by_numpy(image)).max():.1e} e-")
    verdict("charge transfer, means of the fixed share, over NumPy", means / other, GOAL)
    verdict("charge transfer, fixed share, over NumPy", linear / drawn, GOAL)
    verdict("charge transfer, traps, over NumPy", traps / plain, GOAL)
    if len(sys.argv) > 1:
        answer = json.loads(subprocess.check_output([sys.argv[1], "-c", BASELINE, str(SIDE), str(EXACT_COLUMNS)]))
        for name, seconds in answer["times"].items():
            print(f"    arcticpy {name:<12} {1e3 * seconds:10.1f} ms   ratio {traps / seconds:.4f}")
        verdict("charge transfer, traps, over arcticpy, exact in both", traps / answer["times"]["exact"], GOAL)
        verdict("charge transfer, traps, exact over arcticpy's fastest approximation", traps / answer["times"]["express 1"], GOAL)
        part, theirs = np.array(answer["image"]), np.array(answer["out"])
        ours = SOURCE.forward(TRAPS, frame(part), quiet).data[0]
        print(f"    largest difference {np.abs(ours - theirs).max():.3f} e- of {np.abs(theirs - part).max():.3f} e- moved")
    else:
        print("arcticpy: not compared; it cannot be installed beside NumPy 2, so name the Python of an environment that has it")


if __name__ == "__main__":
    main()
