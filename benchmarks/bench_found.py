"""Recall and false alarms of detection, beside other programs: ``python benchmarks/bench_found.py [--frames N]``.

Recall: targets found of 100 (a place within 2.5 px) and false places, in frames of noise 4 DN; heights are in units of the noise. sep
(threshold 1.5 σ, as its manual begins, and 3 σ) and trackpy (told the diameter, and how many there are: the places of greatest mass)
are used where they are installed. Crowded: lattices of discs that cover a share of the frame. False alarms: targets found in frames of
noise, at a stated rate of one a frame and at that of the default.
"""

from __future__ import annotations

import argparse
import secrets
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from goals import verdict
from peers_locate import available, invert_dark, sep_found, trackpy_found
from scipy.spatial import cKDTree

from pixmetry.locate.detect.detection import FALSE_ALARMS, detect, select

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from locate.test_detection import discs, stored  # noqa: E402
from locate.test_faint import NOISES, plate  # noqa: E402

NOISE_DN = 4.0
NEAR_PX = 2.5
FAINT = (  # name, radius (0: a Gaussian spot), blur, height over the noise, sign
    ("disc R 3.5, blur 2", 3.5, 2.0, 5.0, 1),
    ("disc R 3.5", 3.5, 0.7, 4.0, 1),
    ("disc R 3.5, dark", 3.5, 0.7, 4.0, -1),
    ("disc R 1.2", 1.2, 0.7, 8.0, 1),
    ("disc R 8", 8.0, 0.7, 3.0, 1),
    ("disc R 8, dark", 8.0, 0.7, 3.0, -1),
    ("star of 1 px", 0.0, 1.0, 4.0, 1),
    ("star of 1 px", 0.0, 1.0, 5.0, 1),
    ("star of 1 px", 0.0, 1.0, 6.0, 1),
)
CROWDED = ((8, 0.45, False), (8, 0.6, False), (8, 0.7, False), (8, 0.63, True), (5, 0.63, True), (20, 0.6, True))


def stars(rng: np.random.Generator, side: int, count: int, sigma_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Light of Gaussian spots at random places that keep a distance."""
    places: list[np.ndarray] = []
    while len(places) < count:
        place = rng.uniform(10, side - 11, 2)
        if all(np.hypot(*(place - other)) > 16 for other in places):
            places.append(place)
    y, x = np.indices((side, side))
    light = np.zeros((side, side))
    for a, b in places:
        box = slice(int(b) - 8, int(b) + 9), slice(int(a) - 8, int(a) + 9)
        light[box] += np.exp(-((x[box] - a) ** 2 + (y[box] - b) ** 2) / (2 * sigma_px**2))
    return light, np.array(places)


def ours(frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    found = detect(frame).targets
    found = found[select(found, "disc")]
    return found.x_px, found.y_px


def scored(places: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """How many were found, and how many places are none."""
    if not len(x):
        return np.zeros(2, int)
    away, which = cKDTree(places).query(np.stack([x, y], axis=1))
    hits = len(set(which[away < NEAR_PX].tolist()))
    return np.array([hits, len(x) - hits])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=2, help="of each case; ten times as many of noise")
    parser.add_argument("--seed", type=int, default=secrets.randbits(32), help="draw what the run with this seed drew")
    args = parser.parse_args()
    print(f"--seed {args.seed} repeats these draws")
    rng = np.random.default_rng(args.seed)
    peers: dict[str, Callable[[np.ndarray, float, int], tuple[np.ndarray, np.ndarray]]] = {}
    if available("sep"):
        peers |= {"sep 1.5 σ": lambda f, d, n: sep_found(f, 1.5), "sep 3 σ": lambda f, d, n: sep_found(f, 3.0)}
    if available("trackpy"):
        peers["trackpy"] = trackpy_found
    print(f"{'found of 100, false':<30}{'height/σ':>9}{'pixmetry':>12}" + "".join(f"{name:>12}" for name in peers))
    missed = 0
    for name, radius, blur, ratio, sign in FAINT:
        total = {who: np.zeros(2, int) for who in ("pixmetry", *peers)}
        for _ in range(args.frames):
            light, places = discs(rng, (700, 700), 100, radius, radius, blur) if radius else stars(rng, 512, 100, blur)
            frame = stored(rng, 120 + sign * ratio * NOISE_DN * light, NOISE_DN)
            total["pixmetry"] += scored(places[:, :2], *ours(frame))
            for who, run in peers.items():
                total[who] += scored(places[:, :2], *run(invert_dark(frame, sign < 0), 2 * (radius + 2 * blur), len(places)))
        missed += 100 * args.frames - total["pixmetry"][0] if ratio * max(radius, 1) > 5 else 0
        cells = "".join(f"{found / args.frames:8.0f},{false / args.frames:3.0f}" for found, false in total.values())
        print(f"{name:<30}{ratio:9g}{cells}")
    print(f"\n{'crowded: found of all, false':<34}")
    for radius, covered, hexagonal in CROWDED:
        light, places = plate(rng, radius, covered, hexagonal)
        for dark in (False, True):
            frame = stored(rng, 190 - 150 * light if dark else 40 + 150 * light, 2.0)
            found, false = scored(places, *ours(frame))
            others = "".join(
                f"; {who} {run_found}, {run_false}"
                for who, run in peers.items()
                for run_found, run_false in [scored(places, *run(invert_dark(frame, dark), 2 * radius, len(places)))]
            )
            shape = "hexagonal" if hexagonal else "square"
            print(f"R {radius}, {covered:.0%}, {shape}, {'dark' if dark else 'bright'}: {found} of {len(places)}, {false}{others}")
            missed += len(places) - found
    print(f"\nfalse alarms a frame of 256 × 256 px of noise{'at 1':>20}{f'at {FALSE_ALARMS:g}':>10}")
    worst = 0.0
    for name, noise in NOISES.items():
        rates = []
        for rate in (1.0, FALSE_ALARMS):
            frames = [np.clip(np.rint(noise(rng)), 0, 65535).astype(np.uint16) for _ in range(10 * args.frames)]
            rates.append(sum(len(detect(f, false_alarms=rate).targets) for f in frames) / len(frames))
        worst = max(worst, rates[0])
        print(f"{name:<45}{rates[0]:20.3f}{rates[1]:10.3f}")
    print()
    verdict("targets missed whose light stands out", missed, 2)
    verdict("worst rate of false alarms over the stated one", worst, 1.0)


if __name__ == "__main__":
    main()
