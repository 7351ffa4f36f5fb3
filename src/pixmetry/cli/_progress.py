"""Progress on the terminal while a command runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from pixmetry.core import progress


@contextmanager
def shown_progress() -> Iterator[progress.Progress]:
    """Yield a callable (what, done, of) that draws one bar a step on standard error; silent where that is not a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description:<28}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        tasks: dict[str, TaskID] = {}

        def show(what: str, done: int, of: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=of)
            bars.update(tasks[what], completed=done, total=of)

        yield show
