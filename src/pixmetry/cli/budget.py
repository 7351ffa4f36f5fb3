"""``pixmetry budget``: every error source of a camera, before and after calibration, ranked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixmetry.cli._console import console as plain_console
from pixmetry.cli._console import echo
from pixmetry.cli._json import JsonResult, json_option
from pixmetry.cli._pdf import check_pdf, pdf_option, put_pdf

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from pixmetry.budget.camera_budget import CameraBudget
    from pixmetry.budget.compare import BudgetComparison
    from pixmetry.budget.scenario import Scenario
    from pixmetry.budget.sweep import Sweep
    from pixmetry.camera.camera import Camera

SHOWN = 20  # rows on the terminal


@click.command()
@click.argument("cameras", nargs=-1, required=True, metavar="CAMERA...")
@click.option(
    "--scenario",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="What is measured, and how (YAML). Every entry has a default; --all prints them.",
)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change an entry of the scenario, such as motion.speed_px_per_s=50, or a parameter of the camera. May be repeated.",
)
@click.option(
    "--calibration",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A calibration.json of `pixmetry calibrate`, or its folder: its lens, what was calibrated, and how well.",
)
@click.option(
    "--vary",
    metavar="KEY=FROM:TO[:STEPS]",
    help="Also budget over a range of one entry, such as light.f_number=2.8:16, or over values, such as target.diameter_px=5,7,10.",
)
@click.option("--estimator", metavar="NAME", help="Estimator of the target's position. Default: what `pixmetry locate` takes.")
@click.option(
    "--trials", type=click.IntRange(0), default=0, show_default=True, help="Windows of a simulation of all sources at once; 0: none."
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the simulations.")
@click.option(
    "--compare", "side_by_side", is_flag=True, help="The CAMERAs are different ones: budget each, and say which is the best and why."
)
@click.option("--next", "what_next", is_flag=True, help="Show only what to measure and what to change next.")
@click.option("--all", "everything", is_flag=True, help="Show all rows, also of what is not in this camera.")
@click.option("--html", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Write the page of the budget (HTML).")
@pdf_option()
@json_option("the budget")
def budget(
    cameras: tuple[str, ...],
    scenario: Path | None,
    settings: tuple[str, ...],
    calibration: Path | None,
    vary: str | None,
    estimator: str | None,
    trials: int,
    seed: int,
    side_by_side: bool,
    what_next: bool,
    everything: bool,
    html: Path | None,
    pdf: Path | None,
    json_file: Path | None,
) -> None:
    """Budget every error source of a camera for a measurement, before and after calibration.

    CAMERA is the name of a preset, a data sheet, a camera file, such as the camera.yaml of an assessment, or the result of a test by EMVA
    1288 (JSON or XML). Of several, what was measured replaces what a sheet says, and both are compared. With --compare they are different
    cameras, or one camera with different lenses, and the best is named. A scenario says what is measured and how: target, distance, light,
    motion, warm-up, calibration; what it leaves open has a default, which is printed with --all.

    Example: pixmetry budget imx264_like --set object.distance_mm=2000 --set object.f_mm=25 --html budget.html
    """
    from pixmetry.budget.cameras import camera_of
    from pixmetry.budget.changes import changed
    from pixmetry.budget.compare import compare_budgets
    from pixmetry.budget.job import budget as budget_of
    from pixmetry.budget.page import TITLE, page_of
    from pixmetry.budget.scenario import read_scenario
    from pixmetry.budget.sweep import parse_sweep, sweep_of
    from pixmetry.camera.overrides import parse_overrides
    from pixmetry.cli.compare import put_budgets, refuse_beside_budgets
    from pixmetry.core.errors import InputError
    from pixmetry.files.output import Output, check_files, page_mark, write_page
    from pixmetry.report import html_of

    if side_by_side:
        refuse_beside_budgets({"--vary": vary is not None, "--trials": trials > 0, "--next": what_next})
        asked_of_all, changes = read_scenario(scenario), parse_overrides(settings)
        if calibration is not None:
            remedy = "write the budget of each camera with --json, and compare these files"
            raise InputError("a calibration belongs to one camera", where="--calibration", value=str(calibration), remedy=remedy)
        if len(cameras) < 2:
            raise InputError("one camera cannot be compared", where="--compare", value=cameras[0], remedy="name two cameras or more")
        pairs = [changed(camera_of(one)[0], asked_of_all, changes) for one in cameras]

        def all_compared() -> BudgetComparison:
            return compare_budgets([budget_of(*pair, estimator=estimator, seed=seed) for pair in pairs], names_of_cameras(cameras))

        put_budgets(all_compared, [Path(c) for c in (*cameras, scenario or "") if Path(c).is_file()], html, pdf, json_file, everything)
        return
    inputs = [Path(c) for c in cameras if Path(c).is_file()] + [p for p in (scenario, calibration) if p is not None]
    written = JsonResult(json_file, "pixmetry/camera_budget/1", inputs=inputs)
    if html is not None:
        check_files([Output(html, page_mark(TITLE))], inputs)
    check_pdf(pdf, inputs)
    span = None if vary is None else parse_sweep(vary)
    known, compared = camera_of(list(cameras))
    camera, asked = changed(known, read_scenario(scenario), parse_overrides(settings))

    def budgeted(one: Camera, of: Scenario) -> CameraBudget:
        return budget_of(one, of, calibration=calibration, estimator=estimator, seed=seed)

    sweep = None if span is None else sweep_of(camera, asked, *span, budgeted)
    found = replace(
        budget_of(camera, asked, calibration=calibration, estimator=estimator, trials=trials, seed=seed), disagreements=compared
    )
    console = plain_console(width=116, quiet=written.printed)
    if what_next:
        print_next(found, console)
    else:
        print_budget(found, console, everything)
    if sweep is not None:
        print_sweep(sweep, console)
    record = {k: v for k, v in found.to_record().items() if k != "schema"}
    written.put(record if sweep is None else record | {"sweep": sweep.to_record()})
    if html is not None:
        echo(f"page: {write_page(html, html_of(page_of(found, sweep)))}", err=written.printed)
    put_pdf(pdf, lambda: page_of(found, sweep))


def names_of_cameras(given: Sequence[str]) -> list[str]:
    """What cameras are called beside each other: their files, as short as they still differ."""
    from pixmetry.core.plain_text import ends_of_paths

    return [end.removesuffix(".yaml").removesuffix(".yml") for end in ends_of_paths(given)]


def print_budget(found: CameraBudget, console: Console, everything: bool = False) -> None:
    """The answer, the rows, and what to do next."""
    from rich.table import Table

    from pixmetry.budget.answer import rms
    from pixmetry.report.numbers import length_mpx, length_px, percent

    one = found.one
    console.print(f"{found.camera}: {found.setting.target.describe()}; {found.estimator.describe()}", markup=False)
    lengths = [f"{axis} {length_px(v)} px" for axis, v in zip("xy", one.after_px, strict=True)]
    console.print(
        f"One target in one frame, after calibration ({found.scenario.calibration.model.replace('_', ' ')}): {', '.join(lengths)}",
        markup=False,
    )
    console.print(
        f"rms of x and y {length_px(rms(one.after_px))} px: between {length_px(rms(one.least_px))} px (only what is known) and "
        f"{length_px(rms(one.most_px))} px (the rest at its bound); without calibration {length_px(rms(one.before_px))} px",
        markup=False,
    )
    count, mean = found.scenario.count, found.answer.after_px
    if (count.frames, count.targets) != (1, 1):
        of = f"{count.frames} frames and {count.targets} targets"
        console.print(f"mean over {of}: x {length_px(mean[0])} px, y {length_px(mean[1])} px", markup=False)
    mm = found.mm(mean)
    if mm is not None:
        console.print(f"on the object: {mm[0]:.2g} mm × {mm[1]:.2g} mm", markup=False)
    elif found.scenario.object.distance_mm is not None:
        console.print("on the object: not known without focal length (object.f_mm) and pixel pitch", markup=False)
    if found.goal is not None:
        console.print(found.goal.text, markup=False)
    if found.together is not None:
        t = found.together
        console.print(
            f"all sources of the chain at once, simulated: {length_px(t.total_px)} ± {length_px(t.se_total_px)} px, after a calibration "
            f"{length_px(t.calibrated_px)} ± {length_px(t.se_calibrated_px)} px",
            markup=False,
        )
    point = found.point
    if point is not None:
        (x, y, z), worst = point.u_mm, point.worst_mm.max()
        text = f"a point by {found.scenario.count.rays} rays: X {x:.2g} mm, Y {y:.2g} mm, Z {z:.2g} mm (depth); at worst {worst:.2g} mm"
        console.print(text, markup=False)
    for row in found.left_out:
        console.print(f"not in the answer: {row.title} ({row.reason})", markup=False)
    table = Table(box=None, pad_edge=False)
    for heading in ("row", "source", "known", "handbook", "here"):
        table.add_column(heading)
    for heading in ("before /mpx", "after /mpx", "at most /mpx", "share"):
        table.add_column(heading, justify="right")
    rows = found.rows if everything else [r for r in found.rows if r.counts or r.before_px >= 1e-4][:SHOWN]
    for r in rows:
        known = "taken up" if r.taken_up else r.status
        share = f"{percent(r.share)} %" if r.counts else ""
        most = length_mpx(r.largest_px) if r.largest is not None else ""
        cells = (str(r.number or ""), r.title, known, "*" * r.stars, "*" * r.own_stars, length_mpx(r.before_px), length_mpx(r.after_px))
        table.add_row(*cells, most, share)
    console.print(table)
    if not everything and len(found.rows) > len(rows):
        console.print(f"{len(found.rows) - len(rows)} more rows: --all, or the page (--html FILE)", markup=False)
    if everything:
        for name, (value, was_given) in found.scenario.told.items():
            console.print(f"{name}: {'not given' if value is None else value}{'' if was_given else ' (default)'}", markup=False)
    for d in found.disagreements:
        if not d.agree:
            console.print(
                f"{d.name} {d.parameter}: {d.first:.4g} {d.first_from}, {d.second:.4g} {d.second_from}: they differ", markup=False
            )


def print_next(found: CameraBudget, console: Console) -> None:
    """What to measure and what to change next."""
    from pixmetry.report.numbers import length_px

    for title, steps in (("To measure next (upper end of the interval)", found.to_measure), ("To change next (total)", found.to_change)):
        console.print(title, markup=False)
        worth = [step for step in steps[:SHOWN] if step.is_worth_it]
        if not worth:
            console.print("  no single source makes a difference of 1 %", markup=False)
        for step in worth:
            console.print(
                f"  {length_px(step.now_px, 3)} -> {length_px(step.then_px, 3)} px  {step.title}. {step.text}".rstrip(), markup=False
            )


def print_sweep(sweep: Sweep, console: Console) -> None:
    """The answer over a range of one entry."""
    from pixmetry.budget.answer import rms
    from pixmetry.report.numbers import length_px

    in_mm = "; mm on the object" if any(s.after_mm is not None for s in sweep.steps) else ""
    console.print(f"{sweep.key}: after calibration (least to most), px{in_mm}", markup=False)
    for step in sweep.steps:
        after, least, most = (length_px(rms(p)) for p in (step.answer.after_px, step.answer.least_px, step.answer.most_px))
        mm = "" if step.after_mm is None else f"  {step.after_mm:.2g} mm"
        console.print(f"  {step.value:<10g} {after} ({least} to {most}){mm}  {step.largest}", markup=False)
    if sweep.sentence:
        console.print(sweep.sentence, markup=False)
