"""Coverage of the bundle adjustment: ``python benchmarks/study_bundle_coverage.py [networks]``.

Networks of 50 images × 100 points and of 100 × 500 (200 of them by default), and a quarter as many of 300 × 3000 with 5 % seen; noise
0.04 px, all ten interior parameters free, two scale bars. Squared Mahalanobis distances from the truth are pooled and held against
chi-squared at a rate of false failures of 1e-6: of the interior parameters, and of all points jointly (after the rigid motion that the
datum means), in all of the smallest, some of the middle and none of the largest networks, for the dense covariance of all points is dear.
The mean of the squared distances of single points, which are correlated, stands below.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from pixmetry.calibrate.bundle.bundle import adjust

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from calibrate.distances import Pooled, each_point, interior_distance, jointly, points_distance  # noqa: E402
from calibrate.networks import disturbed, simulate  # noqa: E402

RATE = 1e-6
KINDS = (
    ("50 images x 100 points", dict(images=50, points=100), 1.0, 1.0),
    ("100 images x 500 points", dict(images=100, points=500), 1.0, 0.04),
    ("300 images x 3000 points, 5 % seen", dict(images=300, points=3000, visibility=0.05), 0.25, 0.0),
)  # fmt: skip


def report(what: str, pooled: Pooled) -> None:
    """One line."""
    low, high = pooled.caught(RATE)
    verdict = "covered" if pooled.p > RATE else "NOT COVERED"
    print(
        f"  {what}: {pooled.squared:.1f} of {pooled.dof} degrees of freedom ({pooled.squared / pooled.dof:.4f}), p = {pooled.p:.3g}: "
        f"{verdict}; standard deviations {100 * (low - 1):+.1f} % or {100 * (high - 1):+.1f} % wrong would be seen"
    )


def main() -> None:
    networks = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    seed = np.random.SeedSequence().entropy
    rng = np.random.default_rng(seed)
    print(f"seed {seed}, rate {RATE:g}")
    for name, options, share, joint_share in KINDS:
        count, began = max(1, round(share * networks)), time.perf_counter()
        interior = points = residuals = Pooled(0.0, 0)
        single = []
        for i in range(count):
            joint = i < round(joint_share * networks)
            simulated = simulate(rng, bars=2, **options)
            network = jointly(simulated.network) if joint else simulated.network
            found = adjust(network, disturbed(rng, simulated, 0.003), a_priori=True)
            interior += interior_distance(found, simulated)
            residuals += Pooled(found.cost[-1], found.dof - len(network.bars) + len(simulated.network.bars))
            points += points_distance(found, simulated) if joint else Pooled(0.0, 0)
            single.append(each_point(found, simulated).mean() / 3)
        print(f"{name}: {count} networks, {time.perf_counter() - began:.0f} s")
        report("interior parameters", interior)
        if points.dof:
            report("points", points)
        report("residuals", residuals)
        spread = f" ± {np.std(single, ddof=1) / np.sqrt(count):.4f}" if count > 1 else ""
        print(f"  squared distance of single points over 3, mean: {np.mean(single):.4f}{spread}")


if __name__ == "__main__":
    main()
