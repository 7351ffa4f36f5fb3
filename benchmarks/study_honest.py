"""Is the stated uncertainty honest on pictures that are not white noise over perfect discs? ``python benchmarks/study_honest.py``.

Every case of tests/locate/honest_cases.py is located with the defaults: hot pixels, rows and columns with offsets of their own, texture,
noise that is spread over neighbours, sharpening, a coder, a float picture with a cut end, sharp points, tilted discs, loud large ones. A
row of the table has the standard deviation of error over stated u (all targets; those without a flag that warns; those with one), the
error, u, and how many were found. Then the quality: what a limit keeps and drops, on discs under dirt, glints and shades. ``--boards``
adds the scatter that was seen against the one that was stated on the chessboards of the folder in PIXMETRY_DATA.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import numpy as np
from goals import verdict

from pixmetry.core.threads import set_threads
from pixmetry.files.images import load_picture
from pixmetry.locate.job import locate

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from locate import honest_cases  # noqa: E402
from locate.honest_cases import WARNING, Score  # noqa: E402

LIMITS = (0.3, 0.5, 0.7)
BAD_PX = 0.03


def spread(values: np.ndarray) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def noise_part(side: int, draws: int, seed: int) -> None:
    """The table of the cases."""
    print("| case | z | without a flag | with a flag | flagged | rms error px | u px | found |")
    print("|---|---|---|---|---|---|---|---|")
    silent = 0
    for name, picture in honest_cases.pictures(side, seed).items():
        s = honest_cases.score(picture, np.random.default_rng([seed, 1]), draws, WARNING)
        plain = spread(s.z[~s.flagged])
        silent += bool(plain > 1.15)
        print(
            f"| {name} | {spread(s.z):.2f} | {plain:.2f} | {spread(s.z[s.flagged]):.2f} | {s.flagged.mean():.0%} | "
            f"{spread(s.error_px):.4f} | {np.median(s.u_px):.4f} | {len(s.z) // 2} of {s.wanted} |",
            flush=True,
        )
    verdict("cases whose u is more than 15 % too small, and no flag says so", silent, 0)


def quality_part(side: int, draws: int, seed: int) -> None:
    """What limits of the quality keep and drop."""
    rng = np.random.default_rng([seed, 2])
    s: Score = honest_cases.score(honest_cases.spoiled(rng, side), rng, draws, WARNING)
    bad = np.abs(s.error_px) > BAD_PX
    order = np.argsort(np.argsort(s.quality, kind="stable"), kind="stable")
    count = int(bad.sum()), int((~bad).sum())
    area = 1 - (order[bad].sum() - count[0] * (count[0] - 1) / 2) / (count[0] * count[1])
    print(f"\n{count[0]} of {len(bad)} coordinates are more than {BAD_PX} px off; area under the curve of the quality {area:.3f}")
    for limit in LIMITS:
        print(
            f"quality below {limit}: {np.mean(s.quality[bad] < limit):.1%} of the bad, {np.mean(s.quality[~bad] < limit):.1%} of the others"
        )
    print(f"a flag that warns: {np.mean(s.flagged[bad]):.1%} of the bad, {np.mean(s.flagged[~bad]):.1%} of the others")


def boards_part() -> None:
    """Scatter against neighbours over the one stated, before and after it is added."""
    folder = Path(os.environ.get("PIXMETRY_DATA", "")) / "opencv-chessboards"
    before, after = [], []
    for path in sorted(folder.glob("*.jpg")):
        table = locate(load_picture(path).array, kind="chessboard", grid="9x6", name=path.stem)
        note = table.images[0].get("grid_scatter", "")
        print(f"{path.stem}: {note}")
        if note:
            scatter, stated = float(note.split(" ")[0]), float(np.median(0.5 * (table.var_x_px2 + table.var_y_px2)))
            added = table.columns.get("grid_scatter_px", np.zeros(1))[0]
            before.append(scatter / np.sqrt(stated - added**2))
            after.append(scatter / np.sqrt(stated))
    if before:
        without, with_it = spread(np.array(before)), spread(np.array(after))
        print(f"scatter over stated u, root mean square over the boards: {without:.2f} without what is added, {with_it:.2f} with it")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=14, help="targets in a row and in a column")
    parser.add_argument("--draws", type=int, default=4, help="exposures of each picture")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--boards", action="store_true", help="the chessboards in PIXMETRY_DATA too")
    args = parser.parse_args()
    set_threads(None)
    noise_part(args.side, args.draws, args.seed)
    quality_part(args.side, args.draws, args.seed)
    if args.boards:
        boards_part()


if __name__ == "__main__":
    main()
