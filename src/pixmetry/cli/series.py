"""``pixmetry series``: how the image of a fixed field moves over time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixmetry.cli._console import echo
from pixmetry.cli._json import JsonResult, json_option

if TYPE_CHECKING:
    from pixmetry.series.records import Series

KINDS = ("disc", "ellipse", "ring", "spot", "cross", "chessboard", "texture")
WAIT_S = 2.0  # between looks into a folder that fills


@click.command()
@click.argument("images", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="FOLDER", help="Folder of the results.")
@click.option("--interval", "interval_s", type=click.FloatRange(0, min_open=True), metavar="S", help="Time from frame to frame.")
@click.option("--times", type=click.Path(path_type=Path), metavar="FILE", help="CSV file with columns file and time_s.")
@click.option(
    "--on-for",
    "on_for_s",
    type=click.FloatRange(0),
    default=0.0,
    show_default=True,
    metavar="S",
    help="How long camera and frame grabber had been on at the first frame.",
)
@click.option(
    "--interface",
    type=click.Choice(["digital", "analogue"]),
    default="digital",
    show_default=True,
    help="Of an analogue camera the frame grabber's warm-up is fitted too.",
)
@click.option("--pixel-clock", "pixel_clock_mhz", type=click.FloatRange(0, min_open=True), metavar="MHZ", help="Of the frame grabber.")
@click.option(
    "--tolerance",
    "tolerance_px",
    type=click.FloatRange(0, min_open=True),
    default=0.05,
    show_default=True,
    metavar="PX",
    help="Displacement within which the image counts as stable.",
)
@click.option("--kind", type=click.Choice(KINDS), help="Kind of target; texture: places of the first frame. Default: disc, else texture.")
@click.option(
    "--polarity", type=click.Choice(["auto", "bright", "dark"]), default="auto", show_default=True, help="Of the targets on their ground."
)
@click.option("--noise", metavar="CAMERA|KEY=NUMBER,…", help="Noise of the image, as of locate. Default: estimated from each image.")
@click.option("--channel", type=click.Choice(["red", "green", "blue"]), help="Channel to use of colour images.")
@click.option("--bits", type=click.IntRange(1, 16), help="Bits of a stored value. Default: from the image.")
@click.option("--raw", metavar="WxH:FORMAT", help="Layout of files without a header, e.g. 1920x1200:Mono12p (GenICam's names).")
@click.option("--follow", is_flag=True, help="Wait for new frames, and tell after each of them; Ctrl-C ends and writes the report.")
@json_option("the result")
@click.option("--threads", type=click.IntRange(1), help="Number of threads. Default: one for each processor.")
def series(images: tuple[Path, ...], output: Path, follow: bool, json_file: Path | None, threads: int | None, **options: Any) -> None:
    """Follow the image of a fixed field over time, as while a camera warms up.

    IMAGES are files or folders of them, in the order of their names. Nine targets or more, or a texture, should be spread over the frame;
    neither they nor the camera's support may move. Times come from --interval, from --times, or else from when the files were written.

    The targets of every frame are kept in FOLDER.frames.jsonl: a run that was interrupted goes on where it stopped. The folder gets
    report.html and series.json: motion of the image, time constants, and when it is stable.
    """
    from pixmetry.cli._progress import shown_progress
    from pixmetry.core.threads import set_threads
    from pixmetry.series.job import series as run
    from pixmetry.series.records import SERIES_SCHEMA

    set_threads(threads)
    given = {name: value for name, value in options.items() if value is not None}
    written = JsonResult(json_file, SERIES_SCHEMA, inputs=images)
    if follow:
        _follow(images, output, given)
    with shown_progress() as progress:
        found = run(images, output, progress=progress, **given)
    written.put(found.to_record())
    if not written.printed:
        for line in summary_lines(found):
            echo(line)
        echo(f"report: {output / 'report.html'}")


def _follow(images: tuple[Path, ...], output: Path, options: dict[str, Any]) -> None:
    """Look for new frames until it is interrupted, and tell what is known so far."""
    from pixmetry.core.errors import InputError, MeasureError
    from pixmetry.series.job import series as run
    from pixmetry.series.page import outlook_sentence

    known, last = 0, ""
    try:
        while True:
            try:
                found = run(images, output, **options)
            except MeasureError as problem:  # too few frames so far
                found, told = None, str(problem)
            except InputError as problem:
                waits = "no image files" in problem.what or "no times" in problem.what
                if not waits and str(problem) == last:  # seen twice: no frame that is being written
                    raise
                found, told = None, str(problem)
            if found is not None and len(found.frames) > known:
                known = len(found.frames)
                told = f"{known} frames, {found.drift.time_s[-1] / 60:.1f} min: {outlook_sentence(found.drift)}"
            if told != last:
                echo(told, err=True)
                last = told
            time.sleep(WAIT_S)
    except KeyboardInterrupt:
        echo("ended; the report is written", err=True)


def summary_lines(found: Series) -> list[str]:
    """The text for the terminal."""
    from pixmetry.report.numbers import printed_number
    from pixmetry.series.page import WORDS, focus_sentence, stable_sentence, untold

    drift = found.drift
    lines = [f"{len(found.frames)} frames over {(drift.time_s[-1] - drift.time_s[0]) / 60:.1f} min, {drift.targets} targets"]
    lines += [stable_sentence(drift)]
    for number in drift.fit:
        printed = printed_number(number)
        lines.append(f"{WORDS[number.name]}: {printed.joined()}")
    lines += [f"{WORDS[name]}: not told: {why}" for name, why in untold(drift.fit).items()]
    focus = [focus_sentence(drift)] if drift.focus.is_available else []
    return [*lines, *focus, *found.notes]
