"""``pixmetry assess``: the main job."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixmetry.cli._console import console as plain_console
from pixmetry.cli._console import echo
from pixmetry.cli._pdf import check_pdf, pdf_option, put_pdf
from pixmetry.core.plain_text import shown

if TYPE_CHECKING:
    from pixmetry.assess.results import Assessment

LISTED = 8  # contributions that the console names


@click.command()
@click.argument("campaign", required=False, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=Path("pixmetry-report"),
    show_default=True,
    metavar="FOLDER",
    help="Folder for the results.",
)
@click.option(
    "--target",
    default="",
    metavar="KIND:KEY=NUMBER,…",
    help="Target of the error budget: sizes in px, light as a share of saturation. Default: "
    "disc:diameter=7,blur=0.7,peak=0.6,background=0.02.",
)
@click.option(
    "--estimator",
    default="auto",
    show_default=True,
    metavar="NAME",
    help="Estimator that locates the target, as in `pixmetry locate`. 'list' shows all.",
)
@click.option(
    "--calibration",
    type=click.Path(path_type=Path),
    metavar="FOLDER|FILE",
    help="Results of `pixmetry calibrate` (the folder, or its calibration.json): positions in the budget are corrected for the lens.",
)
@click.option(
    "--trials",
    type=click.IntRange(200, 10_000_000),
    default=4000,
    show_default=True,
    help="Number of simulated windows in each Monte Carlo run.",
)
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Seed of the Monte Carlo runs.")
@pdf_option()
@click.option("--threads", type=click.IntRange(1), help="Number of threads. Default: one for each processor.")
def assess(
    campaign: Path | None,
    output: Path,
    target: str,
    estimator: str,
    calibration: Path | None,
    trials: int,
    seed: int,
    pdf: Path | None,
    threads: int | None,
) -> None:
    """Assess a camera from dark and bright frames and edges: error sources, error budget, advice, report.

    CAMPAIGN is a manifest (YAML), an EMVA 1288 descriptor file, or a folder that holds one of them. Without CAMPAIGN the packaged example
    is assessed: a crop of a real CCD camera's data set.

    The folder of results gets report.html, results.json, maps.zarr.zip, and camera.yaml with camera.maps.npz. The last two are the
    camera's digital twin: a simulated camera for `pixmetry simulate`.
    """
    if estimator == "list":
        list_estimators()
        return
    from pixmetry.assess.job import assess as run
    from pixmetry.assess.page.page import page_of
    from pixmetry.cli._progress import shown_progress
    from pixmetry.core.threads import set_threads

    check_pdf(pdf, [campaign] if campaign is not None else [])
    set_threads(threads)
    with shown_progress() as progress:
        assessment = run(
            campaign, output, target=target, estimator=estimator, calibration=calibration, trials=trials, seed=seed, progress=progress
        )
    print_summary(assessment)
    echo(f"report: {output / 'report.html'}")
    put_pdf(pdf, lambda: page_of(assessment))


def list_estimators() -> None:
    """Print the estimators that there are: those of `pixmetry locate` for discs, and centroids over a fixed square."""
    from pixmetry.locate.centroids.fixed import LAWS, PREFIX
    from pixmetry.locate.estimators import estimators

    words = "over a fixed square of pixels; options window=13 (px) and sigma=3 (threshold over the noise)"
    fixed = {f"{PREFIX}{law}": f"{law.replace('_', ' ')} {words}" for law in LAWS}
    for name, text in {**estimators("disc"), **fixed}.items():
        click.echo(f"{name:<24} {text}")


def print_summary(assessment: Assessment) -> None:
    """Print the verdict and the largest contributions."""
    from rich.markup import escape
    from rich.table import Table

    console = plain_console(width=110)
    console.print(f"\n[bold]{escape(shown(assessment.campaign.camera.name))}[/bold]: {escape(assessment.verdict_text())}\n")
    if (answer := assessment.budget.interval) is not None:
        half = " and ".join(f"± {v:.2g} px in {axis}" for v, axis in zip(answer.half_px, "xy", strict=True))
        console.print(f"In one frame a position is within {half} of the true one (coverage {100 * answer.coverage:.0f} %).\n")
    table = Table(
        title="Largest contributions to a target's position in one frame, k = 1, px", title_justify="left", box=None, pad_edge=False
    )
    for name in ("source", "status", "class", "u in x", "u in y", "constant", "share", "calibrated"):
        table.add_column(name, justify="left" if name in ("source", "status", "class") else "right")
    for row in assessment.budget.largest[:LISTED]:
        c = row.part
        constant = max(abs(c.bias_x_px), abs(c.bias_y_px))
        numbers = (f"{v:.5f}" for v in (c.u_x_px, c.u_y_px, constant))
        table.add_row(row.title, row.status, c.gum_class, *numbers, f"{100 * row.share:.0f} %", f"{c.calibrated_px:.5f}")
    console.print(table)
    console.print("constant: the same all over the frame. calibrated: what a calibration of the camera leaves (rms of x and y).")
    if assessment.observations.edges is not None:
        from pixmetry.assess.page.edges import summary_sentence

        console.print(f"\nSlanted edges: {summary_sentence(assessment.observations.edges)}", markup=False)
    worst = assessment.budget.with_accepted[0].total_px
    accepted = [r.title for r in assessment.budget.accepted]
    if accepted:
        console.print(f"\nAccepted, not measured: {', '.join(accepted)}; with all of them at the catalogue's bound: {worst:.2g} px.")
    together = assessment.budget.interaction
    if together is not None:
        at_once = together.together
        console.print(
            f"Monte Carlo with all measured and modelled sources at once: {at_once.total_px:.2g} ± {at_once.se_total_px:.1g} px, "
            f"after a calibration {together.calibrated_px:.2g} px."
        )
    for note in assessment.observations.notes:
        console.print(f"Note: {note}", markup=False)
