"""Lens, pixel, plate and video line from slanted edges: does u hold? ``python benchmarks/study_edges.py [--cameras 40] [--seed 1]``.

For each kind of camera, random cameras stand in front of five turned squares (20 edges of about 100 px, step over noise 100). Each value is
compared with what the camera was made with: mean and rms of z = (value − truth)/u, scatter, and mean u; of a limit, how often it holds. In
the kind without a plate and with a full pixel the rate of plates is that of false findings. Analogue cameras go through their whole
chain, with shot noise, PRNU, rounding and line jitter. The table goes to docs/closed-loop.md.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pixmetry.core.number import Number
from pixmetry.observe.edge_fit import fit_edges
from pixmetry.observe.edges import search_edges
from pixmetry.observe.line_fit import fit_line
from pixmetry.sources.cable.termination import Termination
from pixmetry.sources.electronics.video_amplifier import VideoAmplifier
from pixmetry.sources.grabber.low_pass import LowPass

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from observe.edge_cameras import clean_squares, stored_picture, stored_squares  # noqa: E402
from statistical import closed_loop_page  # noqa: E402

Sources = dict[str, dict[str, object]]
CLOCK_HZ = 14.1875e6
KINDS = {  # lens, pixel, plate
    "sharp, with a plate": ((0.3, 0.5), (0.7, 1.0), (0.8, 1.4)),
    "sharp, without": ((0.2, 0.35), (0.6, 1.0), (0.0, 0.0)),
    "a plate that the lens hides": ((0.45, 0.6), (0.8, 1.0), (0.3, 0.5)),
    "soft": ((0.7, 1.2), (0.6, 1.0), (0.0, 0.0)),
    "nothing but a lens": ((0.4, 0.6), (1.0, 1.0), (0.0, 0.0)),
}
LINES = "analogue, with a video line"


@dataclass
class Table:
    """What was found of one kind of camera."""

    z: dict[str, list[tuple[float, float, float]]] = field(default_factory=lambda: defaultdict(list))
    holds: dict[str, list[bool]] = field(default_factory=lambda: defaultdict(list))
    told: list[str] = field(default_factory=list)

    def add(self, found: Number, truth: float) -> None:
        """Compare one value."""
        if found.is_limit:
            self.holds[found.name].append(found.value >= truth)
        else:
            self.z[found.name].append(((found.value - truth) / found.u, found.value - truth, found.u))

    def rows(self, kind: str) -> list[str]:
        """Rows of the page."""
        out = []
        for name, values in self.z.items():
            z, error, u = np.array(values).T
            rms = f"{np.sqrt((z**2).mean()):.2f} | {np.sqrt((error**2).mean()):.4f}"
            out.append(f"| {kind} | {name} | {len(z)} | {z.mean():+.2f} | {rms} | {u.mean():.4f} | {np.abs(z).max():.1f} | |")
        for name, each in self.holds.items():
            out.append(f"| {kind} | {name} | {len(each)} | – | – | – | – | – | limit holds in {sum(each)} |")
        return out


def optics_of(rng: np.random.Generator, table: Table, ranges: tuple[tuple[float, float], ...]) -> None:
    """One digital camera."""
    sigma, width, plate = (float(rng.uniform(*r)) for r in ranges)
    sources: Sources = {"optics.point_spread": {"sigma_px": sigma}}
    sources["sensor.pixel_aperture"] = {"width_x_px": width, "width_y_px": width}
    if plate:
        sources["optics.olpf"] = {"separation_x_px": plate, "separation_y_px": plate}
    found = fit_edges(search_edges([stored_picture(rng, clean_squares(rng, sources))]).measured)
    truth = {"spread_var_px2": sigma**2 + width**2 / 12 + plate**2 / 4, "sigma_px": sigma}
    truth |= dict.fromkeys(("width_x_px", "width_y_px"), width) | dict.fromkeys(("separation_x_px", "separation_y_px"), plate)
    if any(e.name == "separation_x_px" and not e.is_limit for e in found):
        table.told.append("a plate")
    for e in found:
        table.add(e, truth[e.name])


def line_of(rng: np.random.Generator, table: Table, seed: int) -> None:
    """One analogue camera: filter, amplifier and cable, each in most of them."""
    sigma, x, y = (float(rng.uniform(*r)) for r in ((0.35, 0.7), (0.6, 1.0), (0.7, 1.0)))
    sources: Sources = {"optics.point_spread": {"sigma_px": sigma}, "sensor.pixel_aperture": {"width_x_px": x, "width_y_px": y}}
    sources["grabber.line_jitter"] = {"white_ns": float(rng.uniform(0, 5))}
    truth = {"spread_var_px2": sigma**2 + (x * x + y * y) / 24, "sigma_px": sigma, "width_x_px": x, "width_y_px": y, "delay_px": 0.0}
    truth |= dict.fromkeys(("separation_x_px", "separation_y_px"), 0.0)
    kind = ("off", 0)
    if rng.random() < 0.75:
        kind = ("bessel" if rng.random() < 0.3 else "butterworth", int(rng.integers(3, 5)))
        low_pass = LowPass(kind=kind[0], order=kind[1], cutoff_mhz=float(rng.uniform(4, 6.5)))
        sources["grabber.low_pass"] = low_pass.model_dump()
        truth["cutoff_rel"] = 1e6 * low_pass.cutoff_mhz / CLOCK_HZ
        truth["delay_px"] -= CLOCK_HZ * float((1 / low_pass.poles).sum().real)
    if rng.random() < 0.5:
        amplifier = VideoAmplifier(natural_mhz=float(rng.uniform(4.5, 10)), damping=float(rng.uniform(0.25, 0.8)))
        sources["electronics.video_amplifier"] = amplifier.model_dump()
        truth |= {"natural_rel": 1e6 * amplifier.natural_mhz / CLOCK_HZ, "damping": amplifier.damping}
        truth["delay_px"] -= CLOCK_HZ * float((1 / amplifier.poles).sum().real)
    if rng.random() < 0.5:
        cable = Termination(
            length_m=float(rng.uniform(3, 40)), line_ohm=float(rng.choice([50, 60, 93])), load_ohm=float(rng.choice([75, 150]))
        )
        sources["cable.termination"] = cable.model_dump()
        truth |= {"ghost_rel": cable.ghost, "echo_px": CLOCK_HZ * cable.delay_s}
        truth["delay_px"] += CLOCK_HZ * cable.ghost / (1 - cable.ghost) * cable.delay_s
    line, optics = fit_line(search_edges([stored_squares(rng, sources, seed=seed)], analogue=True).measured)
    if not len(line):
        table.told.append("no line")
    if line.settings and (line.settings["kind"], line.settings["order"]) != kind:
        table.told.append("a wrong kind of filter")
    for e in (*line, *optics):
        if e.name not in truth:
            table.told.append(f"{e.name}, which is not there")
        else:
            table.add(e, truth[e.name])


def main() -> None:
    """Study all kinds, and write the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cameras", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "closed-loop.md")
    given = parser.parse_args()
    start, rows, told = time.perf_counter(), [], []
    for number, kind in enumerate((*KINDS, LINES)):
        table = Table()
        for camera in range(given.cameras):
            rng = np.random.default_rng([given.seed, number, camera])
            if kind == LINES:
                line_of(rng, table, camera + 1)
            else:
                optics_of(rng, table, KINDS[kind])
        rows += table.rows(kind)
        found = ", ".join(f"{what} in {table.told.count(what)}" for what in dict.fromkeys(table.told))
        told.append(f"* {kind}: {found or 'nothing of note'}")
        print("\n".join(rows[-len(table.rows(kind)) :]), told[-1], sep="\n", flush=True)
    text = "\n".join(
        [
            "## Lens, pixel and video line from slanted edges",
            "",
            "Five turned squares, 20 edges of 100 px, step over noise 100. Frequencies over the pixel clock, delays in pixels.",
            "",
            f"{given.cameras} cameras of each kind, seed {given.seed}, {(time.perf_counter() - start) / 60:.0f} min:",
            "",
            "| cameras | quantity | values | mean z | rms z | rms error | mean u | largest z | |",
            "|---|---|---|---|---|---|---|---|---|",
            *rows,
            "",
            "Found:",
            "",
            *told,
        ]
    )
    closed_loop_page.write_section(given.page, "slanted edges", text)


if __name__ == "__main__":
    main()
