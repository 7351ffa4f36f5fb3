"""Halves of real images against their stated uncertainties: ``PIXMETRY_DATA=folder python benchmarks/study_halves.py [splits]``.

OpenCV's left and right pictures of a chessboard (folder ``opencv-chessboards``), each camera alone and both as a rig, the board free,
eight interior parameters of each camera. The images (of a rig the instants) are split into two halves: every other one, the first and the
last ones, and at random (20 times). For each: χ² of the differences of the interior parameters over their number, by the covariance stated
with what both halves share taken out. With ν degrees of freedom of the stated uncertainties it has an F-distribution (8, ν), of mean
ν/(ν − 2); the share of it that lies between 0.7 and 1.4 stands beside.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

from pixmetry import calibrate
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.bundle.network import Adjustment
from pixmetry.calibrate.bundle.shared_errors import interior_parts, with_shared_errors
from pixmetry.calibrate.checks.hold_out import subset
from pixmetry.core.threads import single_threaded_blas

FREE = ("c", "xp", "yp", "b1", "p1", "p2", "k1", "k2")
LOW, HIGH = 0.7, 1.4


def adjusted(files: list[str], rig: bool) -> Adjustment:
    """The pictures' image points, adjusted with a free board."""
    plain = {"folds": 0, "patterns": False}
    free = ", ".join(FREE)
    found = calibrate(
        files, kind="chessboard", grid="9x6", pitch_mm=25.0, direction="object_to_image", free=free, options=plain, rig=rig
    ).adjustment
    network = found.network
    cameras = tuple(replace(camera, free=np.isin(NAMES, FREE)) for camera in network.cameras)
    network = replace(network, cameras=cameras, u_xyz=np.full_like(network.u_xyz, np.inf))
    return with_shared_errors(adjust(network, found.state, used=found.used))


def differing(whole: Adjustment, first: np.ndarray) -> np.ndarray:
    """χ² over 8 of each camera's parameters, between the images ``first`` and the others."""
    values, own, common = [], [], []
    for images in (first, ~first):
        network, start, kept = subset(whole.network, whole.state, images)
        part = adjust(network, start, used=whole.used[kept])
        mine, shared = interior_parts(part, whole)
        values.append(part.state.interior[:, np.isin(NAMES, FREE)].ravel())
        own.append(mine)
        common.append(shared)
    away = common[0] - common[1]
    covariance = own[0] + own[1] + away @ away.T
    u = np.sqrt(np.diag(covariance))
    z, correlation, n = (values[0] - values[1]) / u, covariance / np.outer(u, u), len(FREE)
    parts = [slice(n * k, n * k + n) for k in range(len(z) // n)]
    return np.array([z[part] @ np.linalg.solve(correlation[part, part], z[part]) / n for part in parts])


def main() -> None:
    folder = Path(os.environ.get("PIXMETRY_DATA", "")) / "opencv-chessboards"
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    seed = np.random.SeedSequence().entropy
    rng = np.random.default_rng(seed)
    print(f"seed {seed}")
    with single_threaded_blas():
        for sides in (("left",), ("right",), ("left", "right")):
            whole = adjusted([str(folder / f"{side}*.jpg") for side in sides], len(sides) > 1)
            camera_of = whole.network.camera_of
            number = np.array([np.count_nonzero(camera_of[:i] == k) for i, k in enumerate(camera_of)])
            n = number.max() + 1
            fixed = [differing(whole, number % 2 == 0), differing(whole, number < n / 2)]
            drawn = np.array([differing(whole, np.isin(number, rng.permutation(n)[: n // 2])) for _ in range(count)])
            for k, side in enumerate(sides):
                nu = float(np.mean(whole.interior_dof(k)))
                expected = stats.f.cdf(HIGH, len(FREE), nu) - stats.f.cdf(LOW, len(FREE), nu)
                inside = np.mean((drawn[:, k] > LOW) & (drawn[:, k] < HIGH))
                p = [stats.f.sf(one[k], len(FREE), nu) for one in fixed]
                name = f"{side} of the rig" if len(sides) > 1 else side
                named = zip(("odd/even", "halves"), fixed, p, strict=True)
                print(f"{name}: " + ", ".join(f"{by} {one[k]:.2f} (p = {at:.2f})" for by, one, at in named))
                print(
                    f"  at random: mean {drawn[:, k].mean():.2f}, median {np.median(drawn[:, k]):.2f}, {inside:.2f} of them within limits"
                )
                print(f"  F(8, {nu:.1f}): mean {nu / (nu - 2):.2f}, {expected:.2f} within limits")


if __name__ == "__main__":
    main()
