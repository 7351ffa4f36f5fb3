"""``pixmetry shoot-list``: which frames to take of a camera, with charts to print and a manifest to fill in."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixmetry.cli._console import console as plain_console
from pixmetry.cli._console import echo
from pixmetry.cli._json import JsonResult, json_option

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from pixmetry.budget.shooting import Shot

SHOWN = 8  # rows of the budget in a line


@click.command("shoot-list")
@click.argument("cameras", nargs=-1, required=True, metavar="CAMERA...")
@click.option("--scenario", type=click.Path(path_type=Path), metavar="FILE", help="What is measured, and how (YAML), as of a budget.")
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Change an entry of the scenario. May be repeated.")
@click.option(
    "--u-factor",
    type=click.FloatRange(0, 10, min_open=True),
    default=1.0,
    show_default=True,
    help="Wanted u over the usual one: 0.5 takes four times the frames.",
)
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="DIR", help="Folder for the charts (SVG) and campaign.yaml.")
@json_option("the list")
def shoot_list(
    cameras: tuple[str, ...], scenario: Path | None, settings: tuple[str, ...], u_factor: float, output: Path | None, json_file: Path | None
) -> None:
    """List the frames to take of a camera, the most useful first: set-ups, counts, exposures, and the rows of its budget that they measure.

    CAMERA is as of `pixmetry budget`. With -o the charts to print and a manifest to fill in are written too.

    Example: pixmetry shoot-list imx264_like -o shoot
    """
    from dataclasses import asdict

    from pixmetry.budget.cameras import camera_of
    from pixmetry.budget.changes import changed
    from pixmetry.budget.job import budget as budget_of
    from pixmetry.budget.scenario import read_scenario
    from pixmetry.budget.shooting import SCHEMA, shots_of, write_shoot_list
    from pixmetry.camera.overrides import parse_overrides

    inputs = [Path(c) for c in cameras if Path(c).is_file()] + ([] if scenario is None else [scenario])
    written = JsonResult(json_file, SCHEMA, inputs=inputs)
    camera, asked = changed(camera_of(list(cameras))[0], read_scenario(scenario), parse_overrides(settings))
    shots = shots_of(budget_of(camera, asked), u_factor)
    print_shots(camera.name, shots, plain_console(width=116, quiet=written.printed))
    written.put({"camera": camera.name, "shots": [asdict(s) for s in shots]})
    if output is not None:
        facts = {"bits": camera.facts.get("bits", "<bits>"), "interface": camera.facts.get("interface", "digital")}
        if "sensor" in camera.facts:
            facts["sensor"] = camera.facts["sensor"]
        folder = write_shoot_list(output, camera.name, facts, shots)
        echo(f"charts and manifest: {folder}", err=written.printed)


def print_shots(camera: str, shots: Sequence[Shot], console: Console) -> None:
    """Each set-up in a few lines."""
    from pixmetry.report.numbers import length_px

    if not shots:
        console.print(f"{camera}: every source of its budget is measured, or cannot be", markup=False)
    for number, shot in enumerate(shots, start=1):
        s = shot.set_up
        kind = "kinds dark and bright" if s.kind == "flat" else f"kind {s.kind}"
        console.print(f"{number}. {s.title} ({kind}): {shot.frames} frames", markup=False)
        console.print(f"   {s.scene} {s.exposure}" + (f" Chart: {s.chart}.svg." if s.chart else ""), markup=False)
        console.print(f"   Usual u: {s.usual}.", markup=False)
        gain = f"{length_px(shot.now_px, 3)} -> {length_px(shot.then_px, 3)} px" if shot.then_px < shot.now_px else "no change"
        more = f" and {len(shot.titles) - SHOWN} more" if len(shot.titles) > SHOWN else ""
        console.print(f"   Upper end of the answer: {gain}. Measures: {', '.join(shot.titles[:SHOWN])}{more}.", markup=False)
