"""``pixmetry capture``: a live camera taken through its shooting list, or targets followed on its stream."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixmetry.cli._console import console as plain_console
from pixmetry.cli._console import echo
from pixmetry.cli._json import JsonResult, json_option

if TYPE_CHECKING:
    from pixmetry.capture.follow import Followed
    from pixmetry.capture.plan import Step
    from pixmetry.capture.records import Captured

EXIT_NOT_REACHED = 1


@click.command()
@click.argument("source", metavar="SOURCE")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="FOLDER", help="Folder of the frames.")
@click.option(
    "--camera", "described", metavar="CAMERA", help="Take the shooting list of the budget of this camera, as of `pixmetry budget`."
)
@click.option("--scenario", type=click.Path(path_type=Path), metavar="FILE", help="What is measured, and how (YAML), as of a budget.")
@click.option("--only", metavar="KIND,…", help="Set-ups to take, as of `pixmetry shoot-list`; flat: dark and bright frames. Default: flat.")
@click.option(
    "--u-factor",
    type=click.FloatRange(0, 10, min_open=True),
    default=1.0,
    show_default=True,
    help="Wanted u over the usual one: 0.5 takes four times the frames.",
)
@click.option("--full-s", type=click.FloatRange(0, min_open=True), metavar="S", help="Exposure time at which the scene just saturates.")
@click.option("--bits", type=click.IntRange(1, 16), help="Bits of a stored value. Default: the best grey format of the camera.")
@click.option("--raw", metavar="WxH:FORMAT", help="Layout of files without a header, e.g. 1920x1200:Mono12p (GenICam's names).")
@click.option("--set", "answers", multiple=True, metavar="KEY=NUMBER", help="Answer what only you know, such as T1=20. May be repeated.")
@click.option(
    "--fact", "facts", multiple=True, metavar="KEY=VALUE", help="Of the camera, for the manifest: pitch_um=3.45. May be repeated."
)
@click.option(
    "--locate", is_flag=True, help="Follow a fixed field of targets in place of a shooting list: drift, jitter, when it is stable."
)
@click.option("--kind", type=click.Choice(["disc", "ellipse", "ring", "spot"]), default="disc", show_default=True, help="Of the targets.")
@click.option("--exposure-s", type=click.FloatRange(0, min_open=True), metavar="S", help="With --locate. Default: as the camera is set.")
@click.option("--frames", type=click.IntRange(1), help="With --locate: how many, those of earlier runs included.")
@click.option("--minutes", type=click.FloatRange(0, min_open=True), help="With --locate: for how long. Default: until Ctrl-C.")
@click.option("--interval", "interval_s", type=click.FloatRange(0), default=0.0, metavar="S", help="With --locate: from frame to frame.")
@click.option("--on-for", "on_for_s", type=click.FloatRange(0), default=0.0, metavar="S", help="With --locate: as of `pixmetry series`.")
@click.option(
    "--tolerance",
    "tolerance_px",
    type=click.FloatRange(0, min_open=True),
    default=0.05,
    metavar="PX",
    help="With --locate: what is stable.",
)
@click.option("--yes", is_flag=True, help="Do not wait for the scene to be made: somebody else sees to it.")
@json_option("the result")
def capture(
    source: str,
    output: Path,
    described: str | None,
    scenario: Path | None,
    only: str | None,
    u_factor: float,
    full_s: float | None,
    bits: int | None,
    raw: str | None,
    answers: tuple[str, ...],
    facts: tuple[str, ...],
    locate: bool,
    kind: str,
    exposure_s: float | None,
    frames: int | None,
    minutes: float | None,
    interval_s: float,
    on_for_s: float,
    tolerance_px: float,
    yes: bool,
    json_file: Path | None,
) -> None:
    """Take frames with a live camera, check them while they come, and write the manifest that `pixmetry assess` reads.

    SOURCE is folder:PATH (another program records into it), basler or aravis, the two latter with :NAME if there are several cameras. A
    capture that was stopped or killed goes on with the same command.

    With --locate no frames are kept: targets are followed on the stream, positions go to FOLDER.frames.jsonl, and FOLDER gets report.html
    and series.json as of `pixmetry series`. Ctrl-C ends it and writes them.

    Exit status: 0; 1 if the wanted u was not reached; 2 after an error.

    Example: pixmetry capture basler -o shots --only flat,edge
    """
    from pixmetry.capture.cameras import open_camera
    from pixmetry.capture.job import capture as take
    from pixmetry.capture.plan import steps_of
    from pixmetry.capture.records import CAPTURE_SCHEMA
    from pixmetry.cli._progress import shown_progress

    if locate:
        options = {"exposure_s": exposure_s, "frames": frames, "seconds": None if minutes is None else 60 * minutes, "kind": kind}
        _follow(source, output, bits, raw, json_file, interval_s=interval_s, on_for_s=on_for_s, tolerance_px=tolerance_px, **options)
        return
    written = JsonResult(json_file, CAPTURE_SCHEMA, inputs=[])
    numbers = {key: float(value) for key, value in map(_pair, answers) if _is_number(key, value)}
    kinds = [kind.strip() for kind in only.split(",")] if only else [] if described else ["flat"]
    if described:
        kinds = _listed(described, scenario, u_factor, kinds)
    steps = steps_of(kinds, u_factor)
    told = _facts(facts)
    camera = open_camera(source, bits, raw)
    try:
        if not written.printed:
            print_steps(steps, camera.name)
        with shown_progress() as progress:
            found = take(
                camera,
                steps,
                output,
                Terminal(numbers, waits=not yes),
                factor=u_factor,
                full_s=full_s,
                facts=told,
                progress=progress,
                tell=lambda line: echo(line, err=True),
            )
    finally:
        camera.close()
    written.put(found.to_record())
    if not written.printed:
        print_captured(found)
    if not all(r.is_reached for r in found.reached):
        click.get_current_context().exit(EXIT_NOT_REACHED)


def _follow(source: str, output: Path, bits: int | None, raw: str | None, json_file: Path | None, **options: Any) -> None:
    """Follow targets on the stream, and tell what was found."""
    from pixmetry.capture.cameras import open_camera
    from pixmetry.capture.follow import FOLLOWED_SCHEMA, follow
    from pixmetry.cli.series import summary_lines

    written = JsonResult(json_file, FOLLOWED_SCHEMA, inputs=[])
    camera = open_camera(source, bits, raw)
    try:
        found = follow(camera, output, tell=lambda line: echo(line, err=True), **options)
    finally:
        camera.close()
    written.put(found.to_record())
    if written.printed:
        return
    for line in [*summary_lines(found.series), *repeat_lines(found)]:
        echo(line)
    echo(f"report: {found.report}")


def repeat_lines(found: Followed) -> list[str]:
    """How the targets of a stream repeat, and the faults of its frames, in words."""
    from math import isnan

    from numpy import nanmedian

    from pixmetry.report.numbers import significant

    s = found.statistics
    repeat, stated = (
        float(nanmedian(getattr(s, f"{n}_x_px") ** 2 + getattr(s, f"{n}_y_px") ** 2) / 2) ** 0.5 for n in ("repeat", "stated")
    )
    faults = ", ".join(f"{count} {kind}" for kind, count in found.faults.items())
    lines = [] if isnan(repeat) else [f"one position repeats within {significant(repeat, 2)} px; stated: {significant(stated, 2)} px"]
    if not isnan(s.common_x_px):
        common = f"{significant(s.common_x_px, 2)} px in x, {significant(s.common_y_px, 2)} px in y"
        lines.append(f"common to all targets from frame to frame: {common}")
    return lines + ([f"faulty frames: {faults}"] if faults else [])


class Terminal:
    """The operator, at a terminal; ``numbers`` were answered before."""

    def __init__(self, numbers: dict[str, float], waits: bool = True) -> None:
        self.numbers, self.waits = numbers, waits

    def ready(self, what: str) -> None:
        """Ask, and wait for the return key."""
        echo(what, err=True)
        if not self.waits:
            return
        if not sys.stdin.isatty():
            from pixmetry.core.errors import InputError

            raise InputError("nobody can answer", value=what, remedy="start it in a terminal, or add --yes if the scene is made by itself")
        click.prompt("Return when it is so", default="", show_default=False, err=True)

    def number(self, key: str, what: str) -> float:
        """Ask for a number that was not given."""
        if key in self.numbers:
            return self.numbers[key]
        if not sys.stdin.isatty():
            from pixmetry.core.errors import InputError

            raise InputError("a number is needed that only you know", where=key, value=what, remedy=f'answer with --set "{key}=…"')
        return float(click.prompt(f"{what} ({key})", type=float, err=True))


def _pair(text: str) -> tuple[str, str]:
    from pixmetry.core.errors import InputError

    key, sign, value = text.partition("=")
    if not sign or not key.strip():
        raise InputError("not an answer", value=text, allowed="KEY=VALUE")
    return key.strip(), value.strip()


def _is_number(key: str, value: str) -> bool:
    from math import isfinite

    from pixmetry.core.errors import InputError

    try:
        if isfinite(float(value)):
            return True
    except ValueError:
        pass
    raise InputError("not a number", where=f"--set {key}", value=value)


def _facts(given: Sequence[str]) -> dict[str, Any]:
    """Facts of the camera, checked as the manifest checks them."""
    from pixmetry.core.config import validate
    from pixmetry.files.schema import CameraModel

    told: dict[str, Any] = {}
    for key, value in map(_pair, given):
        try:
            told[key] = float(value)
        except ValueError:
            told[key] = {"true": True, "false": False}.get(value, value)
    validate(CameraModel, {"name": "camera", "bits": 16, **told}, "--fact")
    return told


def _listed(described: str, scenario: Path | None, factor: float, only: Sequence[str]) -> list[str]:
    """The set-ups that the budget of a camera asks for, the most useful first."""
    from pixmetry.budget.cameras import camera_of
    from pixmetry.budget.job import budget as budget_of
    from pixmetry.budget.scenario import read_scenario
    from pixmetry.budget.shooting import shots_of
    from pixmetry.core.errors import InputError

    shots = shots_of(budget_of(camera_of([described])[0], read_scenario(scenario)), factor)
    listed = [shot.set_up.kind for shot in shots]
    foreign = [kind for kind in only if kind not in listed]
    if foreign:
        raise InputError("not on the shooting list of this camera", where="--only", value=", ".join(foreign), allowed=", ".join(listed))
    return [kind for kind in listed if not only or kind in only]


def print_steps(steps: Sequence[Step], camera: str) -> None:
    """What will be taken, in a line for each set-up."""
    for kind in dict.fromkeys(step.set_up for step in steps):
        own = [step for step in steps if step.set_up == kind]
        echo(f"{camera}: {kind}: {sum(s.frames for s in own)} frames in {len(own)} groups")


def print_captured(found: Captured) -> None:
    """The groups, their faults, what was reached."""
    from rich.table import Table

    from pixmetry.report.numbers import percent

    console = plain_console(width=116)
    table = Table(box=None, pad_edge=False)
    for name in ("group", "frames", "exposure", "missed", "damaged", "doubled"):
        table.add_column(name, justify="left" if name == "group" else "right")
    for one in found.steps:
        faults = [str(one.faults.get(kind, 0)) for kind in ("missed", "damaged", "doubled")]
        table.add_row(one.step.name, str(one.frames), f"{1e3 * one.exposure_s:.4g} ms", *faults)
    console.print(table)
    for r in found.reached:
        u = f"{percent(r.number.u / abs(r.number.value))} %"
        state = "as wanted" if r.is_reached else "not reached"
        echo(f"u of {r.number.name}: {u}, wanted {percent(r.wanted_rel)} %: {state}, from {r.frames} frames")
    echo(f"{found.frames} frames; manifest: {found.manifest}; next: pixmetry assess {found.manifest}")
