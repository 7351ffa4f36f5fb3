"""``pixmetry simulate``: frames with known errors."""

from __future__ import annotations

from pathlib import Path

import click

from pixmetry.cli._console import echo


@click.command()
@click.argument("camera")
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("-n", "--frames", type=click.IntRange(1), default=1, show_default=True, help="Number of frames.")
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, metavar="FOLDER", help="Folder for the frames.")
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Seed of the temporal noise. Another seed gives other noise of the same camera.",
)
@click.option(
    "--format",
    "image_format",
    type=click.Choice(["tiff", "png", "zarr"]),
    default="tiff",
    show_default=True,
    help="One image file for each frame (tiff, png), or one Zarr array for all frames.",
)
@click.option(
    "--truth", is_flag=True, help="Also write truth.zarr: what every error source did, as maps of this camera and as values of every frame."
)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="NAME.PARAMETER=VALUE",
    help="Change a parameter of an error source, or a value of the camera itself (exposure_s=0.02, unit_seed=7). May be repeated.",
)
@click.option("--off", multiple=True, metavar="NAME", help="Switch an error source off. May be repeated.")
@click.option(
    "--window",
    metavar="ROW,COL,ROWS,COLS",
    help="Write only this part of the frames: first row, first column, number of rows, number of columns.",
)
@click.option("--threads", type=click.IntRange(1), help="Number of threads. Default: one for each processor.")
def simulate(
    camera: str,
    scene: Path,
    frames: int,
    output: Path,
    seed: int,
    image_format: str,
    truth: bool,
    settings: tuple[str, ...],
    off: tuple[str, ...],
    window: str | None,
    threads: int | None,
) -> None:
    """Simulate frames of a camera whose errors are known.

    CAMERA is a camera file (such as the camera.yaml of an assessment) or the name of a preset. SCENE is a scene file: a uniform field,
    targets, or a whole photon-transfer series, which `pixmetry assess` reads.

    The folder gets the frames, truth.json with the true position of every target in every frame, and camera.yaml: the camera with the
    changes of --set and --off.
    """
    from pixmetry.camera.overrides import parse_overrides
    from pixmetry.cli._progress import shown_progress
    from pixmetry.core.threads import set_threads
    from pixmetry.simulate.job import parse_window
    from pixmetry.simulate.job import simulate as run

    set_threads(threads)
    changes = parse_overrides(settings)
    part = None if window is None else parse_window(window)
    with shown_progress() as progress:
        folder = run(
            camera,
            scene,
            output,
            frames=frames,
            seed=seed,
            image_format=image_format,
            truth=truth,
            overrides=changes,
            off=off,
            window=part,
            progress=progress,
        )
    echo(f"frames: {folder}")
