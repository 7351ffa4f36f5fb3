"""What the residuals of a calibration tell of a sensor that is not flat: random cameras with one more error each, against the truth.

    python benchmarks/study_residuals.py --cameras 60 --seed 1

For each kind of further error: errors over u of all combinations of the shapes that are told, how often the surface was found, and the
median of u. Of ``flat`` a surface that is found is a false finding.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("PIXMETRY_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import numpy as np  # noqa: E402

from calibrate.networks import predicted  # noqa: E402
from calibrate.test_field_sources import PITCH, a_network, a_surface, met_at, others, ratios, told  # noqa: E402

KINDS = {
    "flat": "a flat sensor",
    "none": "nothing else",
    "cells": "each of 10 × 8 cells displaced by 0.02 px",
    "images": "each image bent by 0.04 px",
    "clock": "x-scales of the images scatter by 1e-4",
    "fields": "two halves displaced by 0.03 px",
}


def main() -> None:
    """Print the table of docs/closed-loop.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cameras", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print("| beside the surface | cameras | mean z | std z | largest | found | median u, rms over the frame |")
    print("|---|---|---|---|---|---|---|")
    for number, (kind, words) in enumerate(KINDS.items()):
        z, found, u = [], 0, []
        for k in range(given.cameras):
            rng = np.random.default_rng([given.seed, number, k])
            simulated = a_network(rng)
            params = a_surface(rng, simulated, 0.0 if kind == "flat" else 1.0)
            seen = met_at(predicted(simulated.network, simulated.truth), params)
            height = told(rng, simulated, others(rng, simulated, seen, kind)).height
            z.append(ratios(height, params))
            found += height.found
            u.append(PITCH * np.sqrt(np.mean(height.u_px**2)))
        all_z = np.concatenate(z)
        numbers = f"{all_z.mean():+.2f} | {all_z.std():.2f} | {np.abs(all_z).max():.1f}"
        print(f"| {words} | {given.cameras} | {numbers} | {found} | {np.median(u):.2f} µm |", flush=True)


if __name__ == "__main__":
    main()
