"""Every row of the budget's table beside brute force: the whole chain with the source and without, targets located all over the frame.

``python benchmarks/study_budget_rows.py --preset imx264_like --mpx 0.3`` runs one cell of the study; without options all of it, which takes
hours. Every row is written to a JSON file as it is done; what is in the file is not run again, so a run can be stopped and taken up.
``--seconds`` bounds a run.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from budget.brute_force import CLOCKS_MHZ, SHAPES, BruteForce, camera_at, element_of, table_at, verdict_of
from pixmetry.budget.parameters import applies
from pixmetry.budget.scenario import read_scenario
from pixmetry.budget.setting import Setting
from pixmetry.camera.camera import load_camera
from pixmetry.camera.catalogue import sources
from pixmetry.core.errors import PixmetryError
from pixmetry.locate.target_estimator import TargetEstimator

PRESETS = (
    "imx264_like",
    "pulnix_tm6cn_epix_512",
    "pulnix_tm6cn",
    "pulnix_tm6cn_epix_pixelclock",
    "dcs420_like",
    "ft_ccd_generic",
    "cid_generic",
    "cmos_log_fuga15",
    "sony_xc8500_field",
    "sony_xc8500_interlaced",
    "sony_xc8500_progressive",
)
SIZES = ("usual", "bound")  # the source as it is described or usually, and at its bound
SCENARIO = {
    "motion": {"speed_px_per_s": 60, "acceleration_px_per_s2": 100, "direction_deg": 30},
    "object": {"f_mm": 25, "distance_mm": 2000},
    "target": {"view_angle_deg": 30},
}


def cells(args: argparse.Namespace) -> Iterator[tuple[str, float | None, float]]:
    """Preset, pixel clock in MHz (None: its own, as digital cameras have no line), Mpx."""
    for mpx in args.mpx:
        for preset in args.preset:
            analogue = load_camera(preset).facts.get("interface") == "analogue"
            for clock in args.clock if analogue else (None,):
                yield preset, clock, mpx


def run_cell(preset: str, clock: float | None, mpx: float, args: argparse.Namespace, done: dict[str, Any], until: float) -> None:
    """All rows of one camera; each is stored when it is done."""
    camera = camera_at(preset, clock, SHAPES[mpx])
    brute = BruteForce(Setting(camera, read_scenario(SCENARIO)), TargetEstimator(), args.units, args.places, args.seed)
    table = None
    for source_id, source in sources().items():
        for size in SIZES:
            key = f"{preset} {'own' if clock is None else f'{clock:g}'} MHz {mpx:g} Mpx {source_id} {size}"
            wanted = not args.source or source_id in args.source
            if not wanted or key in done or not applies(source, camera.facts) or time.monotonic() > until:
                continue
            start = time.process_time()
            try:
                table = table or table_at(brute)
                verdict = verdict_of(table, brute, element_of(table, source_id, size), args.sigmas)
            except PixmetryError as problem:
                record: dict[str, Any] = {"not_run": str(problem)}
                print(f"{key}: not run: {problem}", flush=True)
            else:
                axes = [{"u_px": u, "bias_px": b} for u, b in zip(verdict.said_u, verdict.said_bias, strict=True)]
                seen = [
                    {"u_px": a.u, "u_within_px": a.u_within(1.0), "bias_px": a.bias, "se_bias_px": a.se_bias}
                    for a in (verdict.seen.x, verdict.seen.y)
                ]
                ratio = [s["u_px"] / a["u_px"] if a["u_px"] else None for s, a in zip(seen, axes, strict=True)]
                declared = {"model_error": verdict.row.model_error, "floor_px": verdict.row.floor_px, "how": verdict.row.how}
                record = {"said": axes, "seen": seen, "u_ratio": ratio, "wrong": verdict.wrong, "targets": verdict.seen.targets, **declared}
                word = f"WRONG ({', '.join(verdict.wrong)})" if verdict.wrong else "agrees"
                error = f"{100 * verdict.row.model_error:.0f} % or {verdict.row.floor_px:.4f}"
                print(f"{key}: {word}: {verdict.text}; declared {error}; {time.process_time() - start:.1f} s", flush=True)
            done[key] = record
            args.out.write_text(json.dumps(done, indent=1))


def main() -> None:
    """Run what is asked for, and count what is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", nargs="+", default=PRESETS, choices=PRESETS)
    parser.add_argument("--clock", nargs="+", type=float, default=CLOCKS_MHZ, help="pixel clocks of analogue cameras, MHz")
    parser.add_argument("--mpx", nargs="+", type=float, default=tuple(SHAPES), choices=tuple(SHAPES))
    parser.add_argument("--source", nargs="+", default=())
    parser.add_argument("--units", type=int, default=8)
    parser.add_argument("--places", type=int, default=24)
    parser.add_argument("--sigmas", type=float, default=4.5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--out", type=Path, default=Path("budget_rows.json"))
    args = parser.parse_args()
    done: dict[str, Any] = json.loads(args.out.read_text()) if args.out.is_file() else {}
    until = time.monotonic() + args.seconds
    for preset, clock, mpx in cells(args):
        run_cell(preset, clock, mpx, args, done, until)
    rows = [r for r in done.values() if "wrong" in r]
    print(f"{sum(bool(r['wrong']) for r in rows)} of {len(rows)} rows are wrong; {len(done) - len(rows)} could not be run")


if __name__ == "__main__":
    main()
