"""``pixmetry correct``: frames without the errors that are known of their camera."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixmetry.cli._console import echo

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pixmetry.assess.correct import FrameCorrection

IN_POSITIONS = ("positions are", "coordinates are", "pixmetry corrected")  # in the reasons of sources that move points


@click.command()
@click.argument("frames", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--with",
    "camera",
    required=True,
    metavar="RESULTS|CAMERA",
    help="The results.json of an assessment of this camera; or a camera file, the name of a preset, or a data sheet.",
)
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="FOLDER", help="Folder for the corrected frames.")
@click.option("--dark", multiple=True, type=click.Path(path_type=Path), metavar="FILE", help="Dark frames. May be repeated, or a folder.")
@click.option("--flat", multiple=True, type=click.Path(path_type=Path), metavar="FILE", help="Frames of an even field. May be repeated.")
@click.option("--defects", type=click.Path(path_type=Path), metavar="FILE", help="Image that is not 0 at defect pixels.")
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change the camera, such as exposure_s=0.02 or sensor.smear.transfer_s=0.001. May be repeated.",
)
@click.option("--only", multiple=True, metavar="ID", help="Correct only this source. May be repeated.")
@click.option("--skip", multiple=True, metavar="ID", help="Do not correct this source. May be repeated.")
@click.option("--list", "listed", is_flag=True, help="Only list what would be corrected and what not, with the reason.")
@click.option("--raw", metavar="WxH:FORMAT", help="Layout of files without a header, e.g. 1920x1200:Mono12p (GenICam's names).")
@click.option(
    "--sequence",
    is_flag=True,
    help="The frames were taken one after the other, without a pause: correct what one leaves in the next, and gains that differ.",
)
@click.option(
    "--shifts",
    metavar="TABLE|found",
    help="The frames are of one scene, shifted by parts of a pixel: put them together on a finer grid. A table with shift_x_px and "
    "shift_y_px of each frame, or `found` to find them in the frames.",
)
@click.option("--finer", metavar="N|NxM", help="With --shifts: finer pixels in a pixel, up to 4. Default: the most that the shifts allow.")
@click.option("--threads", type=click.IntRange(1), help="Number of threads. Default: one for each processor.")
def correct(
    frames: tuple[Path, ...],
    camera: str,
    output: Path | None,
    dark: tuple[Path, ...],
    flat: tuple[Path, ...],
    defects: Path | None,
    settings: tuple[str, ...],
    only: tuple[str, ...],
    skip: tuple[str, ...],
    listed: bool,
    raw: str | None,
    sequence: bool,
    shifts: str | None,
    finer: str | None,
    threads: int | None,
) -> None:
    """Correct frames with what is known of their camera.

    FRAMES are image files, folders of them, or Zarr stores of frames. What is known is undone from the stored number back to the light:
    converter, line, sensor, lens. An assessment has measured maps of the pixels; a description needs dark frames, frames of an even field
    and a mask for these. The command tells what each correction leaves and what it does to the noise, and what could not be corrected,
    with the reason. The corrected frames are TIFF files of 32-bit floats in DN above black.

    Example: pixmetry correct frames --with camera.yaml --dark dark --flat flat -o corrected
    """
    from pixmetry.assess.correct import correct as run
    from pixmetry.assess.correct import known_of
    from pixmetry.camera.overrides import parse_overrides
    from pixmetry.cli._progress import shown_progress
    from pixmetry.core.threads import set_threads
    from pixmetry.files.raw_values import layout_of

    if not listed and (not frames or output is None):
        raise click.UsageError("no frame is named" if not frames else "Missing option '-o' / '--output'")
    set_threads(threads)
    asked = parse_overrides(settings)
    maps = {"dark": dark or None, "flat": flat or None, "defects": defects}
    if listed:
        print_steps(known_of(camera, **maps, settings=asked, only=only, skip=skip, raw=layout_of(raw)).listed())
        return
    with shown_progress() as progress:
        correction = run(
            frames, camera, output, **maps, settings=asked, only=only, skip=skip, raw=raw, sequence=sequence, shifts=shifts, finer=finer,
            progress=progress,
        )  # fmt: skip
    print_steps(correction.steps, correction.sources)
    if correction.clipped_pixels:
        echo(f"{correction.clipped_pixels} pixels were stored at an end of the range: what is behind them is not known")
    if correction.finer is not None:
        (x, y), pitch = correction.finer.origin_px, correction.finer.pitch_um
        size = "" if pitch is None else f", pitch {pitch[0]:.4g} × {pitch[1]:.4g} µm"
        at = f"x {x:.4g}, y {y:.4g} px of a frame that is not shifted{size}"
        echo(f"the first finer pixel lies at {at}; camera.yaml has its size, pitch and noise")
    echo(f"corrected frames: {output}")


def print_steps(steps: Sequence[FrameCorrection], sources: Mapping[str, str] | None = None) -> None:
    """What was done, in its order, what it leaves and what it does to noise; and what was not done, with the reason."""
    for step in steps:
        text = (sources or {}).get(step.name, step.text)
        if step.corrected:
            echo(f"{step.name}: {text} (noise × {step.noise_rel:.3g}). {step.does} Left: {step.leaves or 'not told'}.")
        else:
            echo(f"{step.name}: {text}")
    if any(word in step.text for step in steps for word in IN_POSITIONS):
        echo("what moves points is corrected in the positions: see `pixmetry corrected`")
