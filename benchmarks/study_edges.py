"""Lens, pixel and plate from slanted edges: does the stated u hold? ``python benchmarks/study_edges.py [--cameras 40] [--seed 1]``.

For each kind of camera, random cameras stand in front of five turned squares (20 edges of about 100 px, step over noise 100). Each value is
compared with what the camera was made with: mean and rms of z = (value − truth)/u, scatter, and mean u; of a limit, how often it holds. In
the last line all that is looked for is absent: a full pixel and no plate; how often a plate is found is the rate of false findings.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from pixmetry.observe.edge_fit import fit_edges
from pixmetry.observe.edges import search_edges

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from observe.edge_cameras import clean_squares, stored_picture  # noqa: E402

KINDS = {  # lens, pixel, plate
    "sharp, with a plate": ((0.3, 0.5), (0.7, 1.0), (0.8, 1.4)),
    "sharp, without": ((0.2, 0.35), (0.6, 1.0), (0.0, 0.0)),
    "a plate that the lens hides": ((0.45, 0.6), (0.8, 1.0), (0.3, 0.5)),
    "soft": ((0.7, 1.2), (0.6, 1.0), (0.0, 0.0)),
    "nothing but a lens": ((0.4, 0.6), (1.0, 1.0), (0.0, 0.0)),
}


def main() -> None:
    """Print a table for each kind."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cameras", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    for kind, ranges in KINDS.items():
        z, values, stated, holds = (defaultdict(list) for _ in range(4))
        plates = 0
        for _ in range(given.cameras):
            sigma, width, plate = (float(rng.uniform(*r)) for r in ranges)
            sources: dict[str, dict[str, object]] = {"optics.point_spread": {"sigma_px": sigma}}
            sources["sensor.pixel_aperture"] = {"width_x_px": width, "width_y_px": width}
            if plate:
                sources["optics.olpf"] = {"separation_x_px": plate, "separation_y_px": plate}
            found = fit_edges(search_edges([stored_picture(rng, clean_squares(rng, sources))]).measured)
            truth = {"spread_var_px2": sigma**2 + width**2 / 12 + plate**2 / 4, "sigma_px": sigma}
            truth |= dict.fromkeys(("width_x_px", "width_y_px"), width) | dict.fromkeys(("separation_x_px", "separation_y_px"), plate)
            plates += any(e.name == "separation_x_px" and not e.is_limit for e in found)
            for e in found:
                if e.is_limit:
                    holds[e.name].append(e.value >= truth[e.name])
                else:
                    z[e.name].append((e.value - truth[e.name]) / e.u)
                    values[e.name].append(e.value - truth[e.name])
                    stated[e.name].append(e.u)
        print(f"\n{kind}: {given.cameras} cameras, a plate found in {plates}")
        for name in z:
            own = np.array(z[name])
            line = f"  {name:<17} {len(own):4d}  mean z {own.mean():+.2f}  rms z {np.sqrt((own**2).mean()):.2f}"
            print(f"{line}  rms error {np.sqrt(np.mean(np.square(values[name]))):.4f}  mean u {np.mean(stated[name]):.4f}")
        for name, own_holds in holds.items():
            print(f"  {name:<17} {len(own_holds):4d}  limit holds in {sum(own_holds)}")


if __name__ == "__main__":
    main()
