"""``pixmetry fleet``: many cameras on one page."""

from __future__ import annotations

from pathlib import Path

import click

from pixmetry.cli._console import echo
from pixmetry.cli._json import JsonResult, json_option

EXIT_DIFFERENT = 1


@click.command()
@click.argument("folders", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="FOLDER", help="Folder for the page and the tables.")
@click.option("--limits", type=click.Path(path_type=Path), metavar="FILE", help="File of limits (YAML) for the values of each camera.")
@click.option("--level", type=float, default=0.95, show_default=True, help="Confidence level for all values and cameras together.")
@click.option("--parquet", is_flag=True, help="Write the tables as Parquet in place of CSV.")
@json_option("the result")
def fleet(folders: tuple[Path, ...], output: Path | None, limits: Path | None, level: float, parquet: bool, json_file: Path | None) -> None:
    """Compare many cameras with their fleet, with limits, and each with itself over time.

    FOLDERS are results of `pixmetry assess`, `calibrate`, `series` or `emva1288`, or folders with such results anywhere below. Results with
    one serial number are of one camera; its latest one counts for the fleet.

    Exit status: 0 if no camera stands out or drifts and all limits hold; 1 if not; 2 after an error.

    Example: pixmetry fleet results/ --limits limits.yaml -o fleet
    """
    from pixmetry.assess.judge.fleet import FLEET_SCHEMA, fleet_report, result_files
    from pixmetry.assess.judge.fleet_files import KIND, write_fleet
    from pixmetry.assess.judge.fleet_page import named, sentences
    from pixmetry.cli._progress import shown_progress
    from pixmetry.core.extras import import_extra
    from pixmetry.files.output import check_output

    written = JsonResult(json_file, FLEET_SCHEMA, inputs=folders)
    inputs = [path for folder in folders for path in result_files(folder)]
    if parquet:
        import_extra("pyarrow.parquet")
    if output is not None:
        check_output(output, KIND, (), inputs)
    with shown_progress() as progress:
        found = fleet_report(folders, limits=limits, level=level, progress=progress)
    written.put(found.to_record())
    if not written.printed:
        for line in sentences(found):
            echo(line)
        for odd in found.odd[:10]:
            echo(f"{odd.camera}: {named(odd.channel, odd.key)} is {odd.in_spreads:+.1f} spreads from the median")
        for note in found.notes:
            echo(f"Note: {note}")
    if output is not None:
        echo(f"page: {write_fleet(found, output, inputs, parquet=parquet)}", err=written.printed)
    if not found.good:
        click.get_current_context().exit(EXIT_DIFFERENT)
