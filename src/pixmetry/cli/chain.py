"""``pixmetry chain``: one target through a camera, source by source."""

from __future__ import annotations

from pathlib import Path

import click

from pixmetry.cli._console import echo
from pixmetry.cli._json import JsonResult, json_option
from pixmetry.cli._pdf import check_pdf, pdf_option, put_pdf


@click.command()
@click.argument("camera")
@click.argument("scene", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path, dir_okay=False), required=True, metavar="FILE", help="File of the page (HTML)."
)
@click.option(
    "--target", type=click.IntRange(0), help="Number of the target in the scene. Default: the one nearest to the middle of the frame."
)
@click.option("--frame", type=click.IntRange(0), default=0, show_default=True, help="Number of the frame in the sequence.")
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Seed of the temporal noise. Another seed gives other noise of the same camera.",
)
@click.option(
    "--draws",
    type=click.IntRange(1),
    default=4,
    show_default=True,
    help="Exposures, each of another target: they say what is constant and what varies. 1: one target in one frame alone.",
)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="NAME.PARAMETER=VALUE",
    help="Change a parameter of an error source, or a value of the camera itself (exposure_s=0.02, unit_seed=7). May be repeated.",
)
@click.option("--off", multiple=True, metavar="NAME", help="Switch an error source off. May be repeated.")
@pdf_option()
@json_option("the steps with their images")
def chain(
    camera: str,
    scene: Path,
    output: Path,
    target: int | None,
    frame: int,
    seed: int,
    draws: int,
    settings: tuple[str, ...],
    off: tuple[str, ...],
    pdf: Path | None,
    json_file: Path | None,
) -> None:
    """Show on one page how each error source of a camera moves a target.

    CAMERA is a camera file or the name of a preset. SCENE is a scene file. For every error source in the order of the light, the page shows
    the image of the target and its profiles after this source, by how much the source moved the centre, and how far it has moved so far.
    Over several targets and exposures it says by how much each source moves all centres alike, and what varies from target to target and
    from frame to frame.
    """
    from pixmetry.camera.camera import load_camera
    from pixmetry.camera.overrides import changed_camera, parse_overrides
    from pixmetry.files.output import Output, check_files, page_mark
    from pixmetry.simulate.chain import chain as follow
    from pixmetry.simulate.page import TITLE, page_of, write_chain_page

    check_files([Output(output, page_mark(TITLE))], [scene, Path(camera)])  # before the work
    check_pdf(pdf, [scene, Path(camera)])
    written = JsonResult(json_file, "pixmetry/chain/1", inputs=[scene, Path(camera)])
    changed = changed_camera(load_camera(camera), parse_overrides(settings), off)
    walk = follow(changed, scene, target=target, frame=frame, seed=seed, draws=draws)
    page = write_chain_page(walk, output)
    written.put(walk.to_record())
    if not written.printed:
        echo(f"page: {page}")
    put_pdf(pdf, lambda: page_of(walk))
