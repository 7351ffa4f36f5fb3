"""``pixmetry bench``: a page on loopback to move what a camera is."""

from __future__ import annotations

import click

from pixmetry.cli._console import echo


@click.command()
@click.argument("shown", nargs=-1, metavar="[CAMERA]... [SCENE]")
@click.option("--scenario", type=click.Path(), metavar="FILE", help="What is measured, and how (YAML), to begin with.")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port on 127.0.0.1. Default: one that is free.")
@click.option("--open/--no-open", "opens", default=True, help="Open the page in the browser. Default: yes.")
def bench(shown: tuple[str, ...], scenario: str | None, port: int, opens: bool) -> None:
    """Open a page to move what a camera is, and to see what it does to a target.

    CAMERA is the name of a preset, a data sheet, a camera file, such as the camera.yaml of an assessment, or the result of a test by EMVA
    1288; several are descriptions of one camera. SCENE is a scene file, as of `pixmetry simulate`; without one, the camera looks at one
    disc. The page shows the chain of the camera from the lens to the stored number, the target as
    the camera stores it, and the budget of its errors. It is served to this machine only, to who has the link. Nothing is written. Stop
    with Ctrl-C.
    """
    from pixmetry.bench.job import open_bench
    from pixmetry.budget.scenario import read_scenario

    first = {} if scenario is None else {"scenario": read_scenario(scenario).model_dump(mode="json", exclude_unset=True, by_alias=True)}
    first.get("scenario", {}).pop("schema", None)

    def tell(link: str) -> None:
        echo(link)
        if opens:
            click.launch(link)

    open_bench(shown, first, port=port, tell=tell)
