"""Budgets of five data sheets beside those of assessed cameras of their types: ``python benchmarks/study_sheet_twins.py [SEED]``.

For every sheet that comes with pixmetry a camera of its type is drawn: what the sheet tells, and the usual values of the rest, within what
cameras of one type differ by. Its photon-transfer series is simulated, and the series assessed. The budget of the assessed camera stands
beside that of the sheet: the ratio of the totals after the calibration, whether their intervals overlap, and the same for the rows that
both know.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from budget.sheet_twins import ends_px, twin_of  # noqa: E402
from pixmetry.budget.answer import rms  # noqa: E402

SHEETS = ("imx264", "imx250", "imx183", "cmv4000", "icx285")


def main() -> None:
    """Print a line for every sheet and one for every row, then how many overlap."""
    rng = np.random.Generator(np.random.Philox(int(sys.argv[1]) if len(sys.argv) > 1 else 1))
    agree = total = 0
    for name in SHEETS:
        with tempfile.TemporaryDirectory() as folder:
            twin = twin_of(name, Path(folder), rng)
        ends = [f"{1e3 * rms(b.one.least_px):.2f} to {1e3 * rms(b.one.most_px):.1f}" for b in (twin.sheet, twin.assessed)]
        words = "overlap" if twin.totals_overlap() else "DO NOT OVERLAP"
        print(f"{name}: total {twin.ratio():.2f} of the sheet's; sheet {ends[0]} mpx, assessed {ends[1]} mpx: {words}")
        for one, two in twin.rows():
            (low, high), (least, most) = ends_px(one), ends_px(two)
            meet = max(low, least) <= min(high, most)
            agree, total = agree + meet, total + 1
            sides = [
                f"{1e3 * v:7.3f} [{1e3 * a:.3f}, {1e3 * b:.3f}]" for v, a, b in ((one.after_px, low, high), (two.after_px, least, most))
            ]
            ratio = two.after_px / one.after_px
            print(f"  {one.title:<34}{one.status:<16}{'  '.join(sides)} mpx  ratio {ratio:.2f}  {'' if meet else 'APART'}")
    print(f"{agree} of {total} rows overlap")


if __name__ == "__main__":
    main()
