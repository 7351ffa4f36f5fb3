"""``pixmetry correct``: frames without the errors that an assessment measured."""

from __future__ import annotations

from pathlib import Path

import click

from pixmetry.cli._console import echo


@click.command()
@click.argument("frames", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--with", "results", type=click.Path(path_type=Path), required=True, help="The results.json of an assessment of this camera.")
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, metavar="FOLDER", help="Folder for the corrected frames.")
@click.option("--raw", metavar="WxH:FORMAT", help="Layout of files without a header, e.g. 1920x1200:Mono12p (GenICam's names).")
@click.option("--threads", type=click.IntRange(1), help="Number of threads. Default: one for each processor.")
def correct(frames: tuple[Path, ...], results: Path, output: Path, raw: str | None, threads: int | None) -> None:
    """Correct frames with the results of an assessment.

    FRAMES are image files, folders of them, or Zarr stores of frames. Dark signal, non-linearity, relative response and defects are
    corrected in this order, as far as the assessment measured them. The command lists what could not be corrected, with the reason. The
    corrected frames are TIFF files of 32-bit floats in DN above black.
    """
    from pixmetry.assess.correct import correct as run
    from pixmetry.cli._progress import shown_progress
    from pixmetry.core.threads import set_threads

    set_threads(threads)
    with shown_progress() as progress:
        correction = run(frames, results, output, raw=raw, progress=progress)
    for name, text in correction.sources.items():
        echo(f"{name}: {text}")
    echo(f"corrected frames: {output}")
