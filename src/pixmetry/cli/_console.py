"""What commands print, with control characters made visible: a name of a file cannot send commands to the terminal."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import click

from pixmetry.core.plain_text import shown, shown_lines

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment
    from rich.text import Text


def echo(line: str, err: bool = False) -> None:
    """Print one line, control characters as ``\\x1b``."""
    click.echo(shown(line), err=err)


def echo_lines(text: str, err: bool = False, nl: bool = True) -> None:
    """Print several lines; line ends are kept, other control characters are shown as ``\\x1b``."""
    click.echo(shown_lines(text), err=err, nl=nl)


def console(**options: Any) -> Console:
    """A console that shows control characters in its input as ``\\x1b``; its own colours are drawn.

    Parameters
    ----------
    **options
        Of `rich.console.Console`.
    """
    from rich import console as rich_console
    from rich import segment as rich_segment

    class Plain(rich_console.Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(shown_lines(text), **options)  # as wide as it will be shown

        def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
            for part in super().render(renderable, options):
                yield part if part.control else rich_segment.Segment(shown_lines(part.text), part.style)

    return Plain(highlight=False, **options)
