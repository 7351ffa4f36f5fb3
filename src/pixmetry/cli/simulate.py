"""``pixmetry simulate``: frames with known errors."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("camera")
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("-n", "--frames", type=click.IntRange(1), default=1, show_default=True, help="How many frames of the scene.")
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="Folder for the frames.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the exposures; another seed, other temporal noise.")
@click.option("--format", "image_format", type=click.Choice(["tiff", "png"]), default="tiff", show_default=True)
@click.option("--threads", type=click.IntRange(1), help="Default: all processors.")
def simulate(camera: str, scene: Path, frames: int, output: Path, seed: int, image_format: str, threads: int | None) -> None:
    """Make the frames of a camera whose errors are known.

    CAMERA is a camera file (such as the camera.yaml of an assessment) or the name of a preset; SCENE is a scene file: a uniform field,
    discs, or a whole photon-transfer series, which `pixmetry assess` reads.
    """
    from pixmetry.cli._progress import shown_progress
    from pixmetry.core.threads import set_threads
    from pixmetry.simulation import simulate as run

    set_threads(threads)
    with shown_progress() as progress:
        folder = run(camera, scene, output, frames=frames, seed=seed, image_format=image_format, progress=progress)
    click.echo(f"frames: {folder}")
