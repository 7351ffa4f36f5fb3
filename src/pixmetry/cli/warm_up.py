"""``pixmetry warm-up``: compile all kernels into the cache."""

from __future__ import annotations

import click


@click.command("warm-up")
def warm_up() -> None:
    """Compile the kernels of all commands, so that no command waits for it later.

    Kernels are compiled for this processor when they are first needed: once after an installation or an upgrade. The first run of a command
    therefore takes a minute or so longer. `pixmetry warm-up` compiles all kernels at once, in some minutes. It stores them in the folder
    that PIXMETRY_CACHE_DIR names, otherwise in the user's cache.
    """
    import time

    from pixmetry.cli._progress import shown_progress
    from pixmetry.cli._warming_up import warm_up as run
    from pixmetry.core.compiling import tell_when_compiling

    tell_when_compiling(None)
    begun = time.monotonic()
    with shown_progress() as progress:
        count, folder = run(progress)
    where = f"kept in {folder}" if folder is not None else "lost when this command ends: no folder for them can be written to"
    click.echo(f"{count} kernels, compiled or found so, in {time.monotonic() - begun:.0f} s; they are {where}")
