"""``pixmetry init``: from a folder of frames to its manifest."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixmetry.cli._console import console as plain_console
from pixmetry.cli._console import echo

if TYPE_CHECKING:
    from pixmetry.assess.draft import Draft

NEXT = 3  # set-ups that are named as the next ones
NAMED = 4  # sources of a set-up that are named


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--set", "answers", multiple=True, metavar="KEY=VALUE", help="Answer a question, such as bits=12 or g2.kind=edge. May be repeated."
)
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="The manifest. Default: FOLDER/campaign.yaml.")
def init(folder: Path, answers: tuple[str, ...], output: Path | None) -> None:
    """Look at all frames of FOLDER and the folders below, and draft the manifest of a campaign.

    Names, tags and pixels tell what is dark, bright, an edge or a field of targets, and how long it was exposed. What they do not tell is
    asked in the terminal, or answered with --set. Then it says what the frames measure, and what to photograph next.

    Example: pixmetry init shots --set bits=12 --set g3.kind=edge
    """
    from pixmetry.assess.draft import draft_campaign, write_draft
    from pixmetry.cli._progress import shown_progress

    given = dict(_pair(text) for text in answers)
    with shown_progress() as progress:
        found = draft_campaign(folder, given, progress)
        print_draft(found)
        while found.questions and sys.stdin.isatty():
            question = found.questions[0]
            given[question.key] = click.prompt(f"{question.text} [{question.allowed}]\n{question.key}")
            found = draft_campaign(folder, given, progress)
    for question in found.questions:
        echo(f"Question: {question.text} Answer with --set {question.key}=… ({question.allowed})")
    if found.questions:
        raise SystemExit(1)
    if found.boards and not found.listed:
        return
    written = write_draft(found, output)
    print_prospects(found)
    echo(f"manifest: {written}; next: pixmetry assess {written}")


def _pair(text: str) -> tuple[str, str]:
    from pixmetry.core.errors import InputError

    key, sign, value = text.partition("=")
    if not sign or not key.strip():
        raise InputError("not an answer", where="--set", value=text, allowed="KEY=VALUE")
    return key.strip(), value.strip()


def print_draft(found: Draft) -> None:
    """Print the groups, what was assumed, and what was left out."""
    from rich.table import Table

    from pixmetry.files.formats import frame_name

    console = plain_console(width=116)
    table = Table(box=None, pad_edge=False)
    for name in ("group", "frames", "from", "kind", "because of", "exposure", "mean, DN"):
        table.add_column(name, justify="right" if name in ("frames", "exposure", "mean, DN") else "left")
    for group in found.groups:
        exposure = "" if group.exposure_s is None else f"{1e3 * group.exposure_s:g} ms"
        first = frame_name(group.paths[0])
        table.add_row(group.name, str(len(group.paths)), first, group.kind or "?", group.why, exposure, f"{group.level_dn:.1f}")
    console.print(table)
    for text in found.assumed:
        console.print(f"Check: {text}", markup=False)
    for text in found.left_out:
        console.print(f"Left out: {text}", markup=False)
    for group in found.boards:
        console.print(f"{group.name} is for a calibration: pixmetry calibrate with these {len(group.paths)} pictures", markup=False)


def print_prospects(found: Draft) -> None:
    """Print what the frames measure, and what to photograph next."""
    from pixmetry.assess.draft import prospects

    console = plain_console(width=116)
    now, later = prospects({g.kind for g in found.listed})
    for prospect in now:
        console.print(f"{prospect.set_up.title}: measure {_some(prospect.titles)}.", markup=False)
    for prospect in later[:NEXT]:
        console.print(f"Next: {prospect.set_up.title} (kind {prospect.set_up.kind}) would measure {_some(prospect.titles)}.", markup=False)
    console.print("pixmetry shoot-list CAMERA lists all set-ups with their charts.", markup=False)


def _some(titles: tuple[str, ...]) -> str:
    few = ", ".join(titles[:NAMED])
    return few if len(titles) <= NAMED else f"{few} and {len(titles) - NAMED} more"
