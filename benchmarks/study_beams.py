"""Widths D4σ of laser beams through focus, behind smear, a sloping ground and noise: ``python benchmarks/study_beams.py``.

Elliptic Gaussian beams of random waist, distance from focus, astigmatism and azimuth, in 8 bits. Interline and frame-transfer sensors add a
share of each column's mean to the whole of it. A halo is a second beam three times as wide; the truth is then that of the sum of both. For
each case: mean and root mean square of width over truth − 1, the stated u, the standard deviation of error over u, and beams without a row.
"""

from __future__ import annotations

import argparse

import numpy as np

from pixmetry.locate.job import locate

SHAPE = (300, 320)
CASES = (  # share of smear, share of the power in the halo, background and noise in DN
    (0.0, 0.0, 10.0, 0.7),
    (0.2, 0.0, 10.0, 0.7),
    (1.0, 0.0, 10.0, 0.7),
    (0.2, 0.0, 10.0, 1.5),
    (0.2, 0.0, 0.0, 0.7),
    (0.0, 0.05, 10.0, 0.7),
    (0.2, 0.1, 10.0, 0.7),
)


def gaussian(x0: float, y0: float, wx: float, wy: float, turn: float) -> np.ndarray:
    """A beam of 1/e² half widths wx and wy."""
    y, x = np.indices(SHAPE)
    u = (x - x0) * np.cos(turn) + (y - y0) * np.sin(turn)
    v = (y - y0) * np.cos(turn) - (x - x0) * np.sin(turn)
    return np.exp(-2 * (u / wx) ** 2 - 2 * (v / wy) ** 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--beams", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    print("| smear | halo | background | noise | mean | rms | u | z | lost |")
    print("|---|---|---|---|---|---|---|---|---|")
    slope = 0.01 * np.indices(SHAPE)[1]
    for smear, halo, ground, noise in CASES:
        rng = np.random.default_rng([args.seed, int(1000 * smear), int(1000 * halo), int(10 * noise)])
        error, stated, lost = [], [], 0
        for _ in range(args.beams):
            z, waist = rng.uniform(-2, 2), rng.uniform(4, 9)
            wx, wy = waist * np.sqrt(1 + z**2), waist * rng.uniform(0.6, 1) * np.sqrt(1 + (z - 0.5) ** 2)
            place = 160 + rng.uniform(-20, 20), 150 + rng.uniform(-10, 10)
            turn = rng.uniform(0, np.pi)
            core = gaussian(*place, wx, wy, turn)
            light = (1 - halo) * core / core.sum()
            if halo:
                wide = gaussian(*place, 3 * wx, 3 * wy, turn)
                light += halo * wide / wide.sum()
            image = 200 * light / light.max()
            image = image + smear * image.mean(axis=0) + ground + slope * (ground > 0) + rng.normal(0, noise, SHAPE)
            table = locate(np.clip(np.rint(image), 0, 255).astype(np.uint8), kind="spot", estimator="d4sigma")
            if len(table) != 1:
                lost += 1
                continue
            truth = 2 * np.sqrt(1 + 8 * halo) * np.array([max(wx, wy), min(wx, wy)])
            error.append(np.array([table.d4sigma_major_px[0], table.d4sigma_minor_px[0]]) / truth - 1)
            stated.append(np.array([table.u_d4sigma_major_px[0], table.u_d4sigma_minor_px[0]]) / truth)
        e, u = np.array(error).ravel(), np.array(stated).ravel()
        if not len(e):
            print(f"| {smear} | {halo} | {ground} | {noise} | – | – | – | – | {lost} of {args.beams} |", flush=True)
            continue
        spread, score = np.sqrt(np.mean(e**2)), np.sqrt(np.mean((e / u) ** 2))
        print(
            f"| {smear} | {halo} | {ground} | {noise} | {e.mean():+.4f} | {spread:.4f} | {np.median(u):.4f} | {score:.2f} | "
            f"{lost} of {args.beams} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
