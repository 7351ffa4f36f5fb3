"""Which estimator locates the dots of a real plate best, and does any depend on the sub-pixel phase?

    PIXMETRY_DATA=folder python benchmarks/study_dot_plate.py

The folder holds discorpy-dots/. Every estimator locates all whole dots; a homography, a distortion centre and three radial terms are fitted
to a random half of them, and the residuals of the other half are shown: over all dots, and over those without the few under dirt.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from pixmetry.locate.centroids.moments import moment_positions  # noqa: E402
from pixmetry.locate.centroids.operators import operator_positions  # noqa: E402
from pixmetry.locate.detect.detection import detect  # noqa: E402
from pixmetry.locate.template.image_noise import noise_from_image  # noqa: E402
from pixmetry.locate.template.template import fit_template  # noqa: E402
from published import dot_plate  # noqa: E402

MOMENTS = ("centroid", "squared_centroid", "soft_threshold", "hard_threshold", "windowed_centroid")
OPERATORS = ("perimeter", "forstner", "ellipse_edges", "gaussian")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--splits", type=int, default=5, help="random halves to fit")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    folder = Path(os.environ.get("PIXMETRY_DATA", "")) / "discorpy-dots"
    if not os.environ.get("PIXMETRY_DATA") or not (folder / dot_plate.PICTURE).is_file():
        print("PIXMETRY_DATA does not name a folder with discorpy-dots; nothing to do")
        return
    frame = dot_plate.read_picture(folder)
    targets = detect(frame).targets
    grid = dot_plate.order(targets)
    whole = dot_plate.whole_dots(targets, grid)
    noise = noise_from_image(frame, targets[whole])
    print(f"{len(targets)} targets, {grid.placed.sum()} on a grid of {grid.rows} × {grid.cols}, {whole.sum()} of them whole")
    print(f"noise: {noise.describe()}")

    def template(kind: str, **planes: bool | str) -> Callable:
        return lambda: fit_template(frame, targets, noise, kind, **planes)

    none = {"background_plane": False, "light_plane": False}
    estimators: dict[str, Callable] = {
        "detection": lambda: targets,
        "disc": template("disc", **none),
        "disc, planes by significance": template("disc"),
        "disc, background plane": template("disc", **none | {"background_plane": True}),
        "disc, light plane": template("disc", **none | {"light_plane": True}),
        "ellipse": template("ellipse", **none),
        "spot": template("spot", **none),
        **{name: (lambda name=name: moment_positions(frame, targets, noise, name)) for name in MOMENTS},
        **{name: (lambda name=name: operator_positions(frame, targets, noise, name)) for name in OPERATORS},
    }
    print("| estimator | dots | held-out rms in px | without dirt | scatter | largest phase bin | ± | predicted σ | s |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name, locate in estimators.items():
        locate()
        start = time.perf_counter()
        found = locate()
        seconds = time.perf_counter() - start
        use = whole & np.isfinite(found.x_px) & np.isfinite(found.y_px)
        places = np.stack([found.x_px, found.y_px], axis=1)[use]
        rms, clean = [], []
        for split in range(args.splits):
            residuals, others = dot_plate.held_out(found, grid, use, np.random.default_rng([args.seed, split]))
            rms.append(np.sqrt(np.mean(residuals[others] ** 2)))
            kept = others & (np.abs(residuals).max(axis=1) < 0.12)
            clean.append(np.sqrt(np.mean(residuals[kept] ** 2)))
        means, errors, scatter = dot_plate.phase_means(places, residuals)
        worst = np.unravel_index(np.abs(means).argmax(), means.shape)
        sigma = np.sqrt(np.nanmedian(found.var_x_px2[use])) if hasattr(found, "var_x_px2") else np.nan
        print(
            f"| {name} | {use.sum()} | {np.mean(rms):.4f} ({min(rms):.4f} … {max(rms):.4f}) | {np.mean(clean):.4f} | {scatter:.4f} | "
            f"{means[worst]:+.4f} | {errors[worst]:.4f} | {sigma:.4f} | {seconds:.2f} |"
        )
        if name == "disc":
            published = np.sqrt(np.mean(dot_plate.published_residuals(folder, found, grid, use) ** 2))
            profile = [f"  phase {axis}: " + " ".join(f"{1e3 * m:+.1f}" for m in row) for axis, row in zip("xy", means, strict=True)]
    print(f"\nThe published coefficients leave {published:.4f} px rms on the disc's places.")
    print("The disc's means in ten bins of phase, in 0.001 px:")
    print("\n".join(profile))


if __name__ == "__main__":
    main()
