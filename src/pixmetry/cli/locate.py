"""``pixmetry locate``: positions of targets and lines with their covariance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pixmetry.cli._console import echo, echo_lines

EXIT_NOTHING_FOUND = 1
MOST_NAMED = 5
NOT_FOUND = "check --kind and --polarity; targets must cover less than three quarters of the image"
KINDS = ("disc", "ellipse", "ring", "spot", "blob", "line", "edge", "cross", "chessboard", "coded")


@click.command()
@click.argument("images", nargs=-1, type=click.Path(path_type=Path))
@click.option("--kind", type=click.Choice(KINDS), default="disc", show_default=True, help="Kind of target or line.")
@click.option(
    "--estimator",
    metavar="NAME",
    help="Estimator that measures the positions. 'list' shows all for this kind. Default: auto; with --track soft_threshold.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="File of the table: .csv, .parquet or .json. Default: CSV on standard output.",
)
@click.option(
    "--overlay",
    type=click.Path(path_type=Path),
    metavar="FILE|FOLDER",
    help="Also draw the results into the image (PNG file). With several images: a folder of PNG files.",
)
@click.option(
    "--polarity",
    type=click.Choice(["auto", "bright", "dark"]),
    default="auto",
    show_default=True,
    help="Whether targets are brighter or darker than their background.",
)
@click.option(
    "--grid",
    metavar="COLSxROWS",
    help="Size of the plate: inner corners of a chessboard, or dots. 'any' numbers the dots of a plate of unknown size; 'hexagonal' or "
    "9x6:hexagonal those of one whose rows are shifted by half a step.",
)
@click.option(
    "--noise",
    metavar="CAMERA|KEY=NUMBER,…",
    help="Noise of the image: a camera (preset or camera.yaml), or read=1.5,gain=0.01,black=16 in DN. Default: estimated from the image.",
)
@click.option(
    "--with",
    "with_",
    metavar="RESULTS|CAMERA",
    help="In place of --noise: results of an assessment of this camera (folder or results.json). Uncertainties hold its correlated noise, "
    "its defect pixels are left out.",
)
@click.option(
    "--bits",
    type=click.IntRange(1, 16),
    help="Bits of a stored value. They give the value at which pixels saturate. Default: from the image.",
)
@click.option(
    "--aperture", type=click.FloatRange(0, 1), default=1.0, show_default=True, help="Side of the pixel's light-sensitive square, px."
)
@click.option(
    "--light-on",
    type=click.Choice(["surface", "image"]),
    default="surface",
    show_default=True,
    help="Where light that falls off across a target acts: on the surface before the blur, or on the image after it.",
)
@click.option(
    "--planes",
    type=click.Choice(["never", "auto", "always"]),
    default="auto",
    show_default=True,
    help="Whether templates have slopes of light and background. auto: where they also predict pixels that were held back.",
)
@click.option(
    "--dictionary",
    default="RING_12",
    show_default=True,
    metavar="RING_N",
    help="Codes of coded targets, by the segments of their rings: RING_8, RING_12, RING_14, RING_16 or RING_20.",
)
@click.option("--channel", type=click.Choice(["red", "green", "blue"]), help="Channel to use of colour images.")
@click.option("--raw", metavar="WxH:FORMAT", help="Layout of files without a header, e.g. 1920x1200:Mono12p (GenICam's names).")
@click.option("--roi", "rois", multiple=True, metavar="ROW,COL,ROWS,COLS", help="Region to look in: first pixel and size. May be repeated.")
@click.option("--mask", type=click.Path(path_type=Path), metavar="IMAGE", help="Image that is not 0 where the centres of targets may be.")
@click.option(
    "--places",
    type=click.Path(path_type=Path),
    metavar="CSV",
    help="Only targets at these places (x_px, y_px).",
)
@click.option("--diameter", metavar="LEAST,GREATEST", help="Only targets of this diameter at half height, px.")
@click.option("--contrast", metavar="LEAST,GREATEST", help="Only targets of this height over the background, DN, bright or dark.")
@click.option("--threshold", type=float, default=4.0, show_default=True, metavar="SIGMA", help="Threshold of detection over the noise.")
@click.option(
    "--false-alarms",
    type=float,
    default=0.01,
    show_default=True,
    metavar="NUMBER",
    help="Faint targets: how many false ones a frame of noise may show on average. More find fainter ones.",
)
@click.option("--track", is_flag=True, help="Find targets in the first image only, and follow each of them through the others.")
@click.option("--search", "search_px", type=float, metavar="PX", help="Of --track: how far from its expected place a target is looked for.")
@click.option("--interval", "interval_s", type=float, metavar="S", help="Of --track: time from frame to frame.")
@click.option(
    "--statistics",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Of --track: JSON file of each target's repeatability, stated uncertainty and drift, and of the Allan deviation.",
)
@click.option("--threads", type=click.IntRange(1), help="Number of threads. Default: one for each processor.")
def locate(
    images: tuple[Path, ...],
    kind: str,
    estimator: str | None,
    output: Path | None,
    overlay: Path | None,
    polarity: str,
    grid: str | None,
    dictionary: str,
    noise: str | None,
    with_: str | None,
    bits: int | None,
    aperture: float,
    light_on: str,
    planes: str,
    channel: str | None,
    raw: str | None,
    rois: tuple[str, ...],
    mask: Path | None,
    places: Path | None,
    diameter: str | None,
    contrast: str | None,
    threshold: float,
    false_alarms: float,
    track: bool,
    search_px: float | None,
    interval_s: float | None,
    statistics: Path | None,
    threads: int | None,
) -> None:
    """Measure the positions of targets or lines, with their covariance.

    IMAGES are files (PNG, TIFF, BMP, FITS, NPY, JPEG, raw), folders of them, or Zarr stores of frames. A file with several frames counts
    as several images. Bright and dark targets are found without tuning.

    Positions count from the centre of the top-left pixel, x to the right, y down. The exit status is 1 if no target was found in any
    image. The table is written even then.
    """
    from pixmetry.cli._progress import shown_progress
    from pixmetry.core.threads import set_threads
    from pixmetry.locate.estimators import estimators
    from pixmetry.locate.files import locate_files, skipped_files

    if estimator == "list":
        for name, text in estimators(kind).items():
            click.echo(f"{name:<24} {text}")
        return
    estimator = estimator or ("soft_threshold" if track else "auto")
    unused = [
        name for name, value in (("--search", search_px), ("--interval", interval_s), ("--statistics", statistics)) if value is not None
    ]
    if unused and not track:
        raise click.UsageError(f"{unused[0]} is an option of --track")
    if not images:
        raise click.UsageError("no image is named")
    set_threads(threads)
    if skipped := skipped_files(images, raw):
        named = ", ".join(skipped[:MOST_NAMED]) + (f" and {len(skipped) - MOST_NAMED} more" if len(skipped) > MOST_NAMED else "")
        echo(f"skipped, not named like an image: {named}", err=True)
    regions = [_numbers(roi, "--roi", 4) for roi in rois] or None
    if track:
        for name, value, default in (
            ("--overlay", overlay, None), ("--with", with_, None), ("--grid", grid, None),
            ("--aperture", aperture, 1.0), ("--light-on", light_on, "surface"),
            ("--dictionary", dictionary, "RING_12"),
            ("--mask", mask, None), ("--places", places, None), ("--diameter", diameter, None), ("--contrast", contrast, None),
            ("--threshold", threshold, 4.0), ("--false-alarms", false_alarms, 0.01), ("--planes", planes, "auto"),
        ):  # fmt: skip
            if value != default:
                raise click.UsageError(f"{name} is no option of --track")
        _track(
            images, output, statistics, kind=kind, estimator=estimator, polarity=polarity, noise=noise, bits=bits, channel=channel, raw=raw,
            search_px=search_px, interval_s=interval_s, threads=threads, rois=regions,
        )  # fmt: skip
        return
    with shown_progress() as progress:
        table = locate_files(
            images,
            output,
            kind=kind,
            estimator=estimator,
            overlay=overlay,
            polarity=polarity,
            grid=grid,
            dictionary=dictionary,
            noise=noise,
            with_=with_,
            bits=bits,
            aperture_px=aperture,
            light_on=light_on,
            planes=planes,
            channel=channel,
            raw=raw,
            progress=progress,
            rois=regions,
            mask=mask,
            places_px=places,
            diameter_px=None if diameter is None else _numbers(diameter, "--diameter", 2),
            contrast_dn=None if contrast is None else _numbers(contrast, "--contrast", 2),
            threshold_sigma=threshold,
            false_alarms=false_alarms,
        )
    if output is None:
        echo_lines(table.to_csv(), nl=False)
    for image in table.images:
        echo(f"{image['name']}: {image['targets']} found; {image['estimator']}: {image['reason']}", err=output is None)
        for key in ("caution", "ground", "rings"):
            if key in image:
                echo(f"{image['name']}: {key}: {image[key]}", err=output is None)
        if "left_out" in image:
            echo(f"{image['name']}: left out: {image['left_out']}", err=output is None)
        if "file" in image:
            echo(f"{image['name']}: {image['file']}", err=output is None)
    if output is not None:
        echo(f"table: {output}")
    if overlay is not None:
        echo(f"overlay: {overlay}", err=output is None)
    if not len(table):
        where = table.images[0]["name"] if len(table.images) == 1 else f"any of {len(table.images)} images"
        echo(f"nothing found: no {kind} in {where}; to do: {NOT_FOUND}", err=True)
        raise click.exceptions.Exit(EXIT_NOTHING_FOUND)


def _numbers(text: str, option: str, count: int) -> tuple[Any, ...]:
    """So many numbers with commas between them."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count:
        raise click.BadParameter(f"{text!r} is not {count} numbers with commas between them", param_hint=option)
    return values


def _track(images: tuple[Path, ...], output: Path | None, statistics: Path | None, **options: Any) -> None:
    """Follow targets, and say how well they repeat."""
    from pixmetry.cli._progress import shown_progress
    from pixmetry.locate.track.files import track_files

    if output is None and statistics is None:
        raise click.UsageError("--track needs a file for its results: -o table.csv, --statistics file.json, or both")
    with shown_progress() as progress:
        found = track_files(images, output, statistics=statistics, progress=progress, **options)
    for line in found.summary():
        echo(line)
    for name, path in (("table", output), ("statistics", statistics)):
        if path is not None:
            echo(f"{name}: {path}")
