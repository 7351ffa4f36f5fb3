"""``pixmetry view``: look at a result on a page."""

from __future__ import annotations

import click

from pixmetry.cli._console import echo


@click.command()
@click.argument("result", type=click.Path())
@click.argument("pictures", type=click.Path(), nargs=-1, metavar="[PICTURE]...")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port on 127.0.0.1. Default: one that is free.")
@click.option("--open/--no-open", "opens", default=True, help="Open the page in the browser. Default: yes.")
def view(result: str, pictures: tuple[str, ...], port: int, opens: bool) -> None:
    """Look at a result: its tables, maps, positions and residuals.

    RESULT is the folder of an assessment or a calibration, a JSON file of a command, or a table of targets (CSV). PICTURE is an image that
    the positions belong to, or a folder of such images; those in the folder of the result are found without. The page is served to this
    machine only, to who has the link. Nothing is written. Stop with Ctrl-C.
    """
    from pixmetry.bench.job import open_view

    def tell(link: str) -> None:
        echo(link)
        if opens:
            click.launch(link)

    open_view(result, pictures, port=port, tell=tell)
