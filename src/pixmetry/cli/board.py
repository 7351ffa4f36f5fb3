"""``pixmetry board``: a test field to print, with the coordinates of its points."""

from __future__ import annotations

import re
from pathlib import Path

import click

from pixmetry.cli._console import echo

KINDS = ("chessboard", "dots", "asymmetric", "squares", "charuco", "aprilgrid", "coded")


@click.command()
@click.argument("kind", type=click.Choice(KINDS))
@click.option("--grid", required=True, metavar="COLSxROWS", help="Inner corners, dots, squares, tags, coded targets; charuco: squares.")
@click.option("--pitch-mm", type=click.FloatRange(0, min_open=True), required=True, help="From one to the next, mm.")
@click.option("--side-mm", type=click.FloatRange(0, min_open=True), help="Side of separate squares, markers or tags, mm.")
@click.option(
    "--diameter-mm",
    type=click.FloatRange(0, min_open=True),
    help="Diameter of dots, or of the discs of coded targets, mm. Default: half of the pitch; asymmetric 0.35, coded 0.22 of it.",
)
@click.option(
    "--dictionary",
    metavar="NAME",
    help="Of the markers. Default: 5X5_1000; of an aprilgrid APRILTAG_36h11; of coded targets RING_12 (or RING_8, 14, 16, 20).",
)
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, metavar="FILE.pdf|.svg", help="File of the print.")
def board(
    kind: str, grid: str, pitch_mm: float, side_mm: float | None, diameter_mm: float | None, dictionary: str | None, output: Path
) -> None:
    """Draw a board to print in its true size, and write the nominal coordinates of its points beside it (FILE.csv).

    Print it at 100 %, and measure the print: a printer's scale is off by some tenths of a per cent.
    """
    from pixmetry.calibrate.images.boards import board_of
    from pixmetry.calibrate.images.targets import board_size
    from pixmetry.core.errors import InputError
    from pixmetry.files.output import PDF_MARK, Output, write_together

    form = output.suffix.lower().lstrip(".")
    if form not in ("pdf", "svg"):
        raise InputError("not a form that a board is drawn in", where="output", value=output.name, allowed=".pdf or .svg")
    size = board_size("squares", grid)
    assert size is not None
    drawn = board_of(kind, size, pitch_mm, side_mm=side_mm, diameter_mm=diameter_mm, dictionary=dictionary)
    mark = PDF_MARK if form == "pdf" else re.compile(rb"<\?xml.*pixmetry", re.DOTALL)
    table = Output(output.with_suffix(".csv"), re.compile(rb"# pixmetry board"))
    write_together([Output(output, mark), table], [drawn.drawn(form), drawn.coordinates_csv().encode()])
    width, height = drawn.box[2:]
    echo(f"{output}: {drawn.title}, sheet of {width:.0f} x {height:.0f} mm; coordinates: {table.path}")
    echo(f"pictures of it: pixmetry calibrate PICTURES {drawn.options}")
