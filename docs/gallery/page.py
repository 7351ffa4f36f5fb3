"""A page of the handbook: Markdown, with its figures in SVG files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

from pixmetry.report.drawing import escape
from pixmetry.report.page import Figure

WIDTH_PX = 560
# The colours of the report's figures, light and dark, with a background of their own, so that they can be read on any page.
STYLE = (
    "svg{--ground:#fff;--ink:#1a1d21;--soft:#5b626b;--grid:#d9dde2;--blue:#0067a5;--red:#c44e00;--amber:#a87400;"
    "--sans:system-ui,-apple-system,'Segoe UI',Roboto,'Noto Sans','Liberation Sans',Arial,sans-serif;background:var(--ground)}"
    "@media(prefers-color-scheme:dark){svg{--ground:#14171b;--ink:#e8eaed;--soft:#a5adb8;--grid:#333a43;--blue:#5fb3ea;--red:#f4915a;"
    "--amber:#dfb046}}"
)


@dataclass(frozen=True, eq=False)
class Moving(Figure):
    """A drawing in motion, as `pixmetry.report.moving.moving_svg` makes it."""

    @cached_property
    def svg(self) -> str:
        """Its markup, with the words for those who do not see it."""
        assert isinstance(self.drawing, str)
        return self.drawing.replace("<svg", f'<svg role="img" aria-label="{escape(self.alt)}"', 1)


@dataclass(frozen=True)
class Page:
    """Text in Markdown, and its figures."""

    name: str
    text: str
    pictures: tuple[Figure, ...] = ()

    def files(self) -> dict[str, str]:
        """The files of the page: name and content."""
        return {f"{self.name}.md": self.text, **{f"{p.name}.svg": standalone(p) for p in self.pictures}}


def standalone(shown: Figure) -> str:
    """A picture of the report as a file of its own: with size, name space, colours and background."""
    head, rest = shown.svg.split(">", 1)
    left, top, width, height = (float(v) for v in head.split('viewBox="')[1].split('"')[0].split())
    size = f'xmlns="http://www.w3.org/2000/svg" width="{WIDTH_PX}" height="{WIDTH_PX * height / width:.0f}"'
    ground = f'<rect x="{left:g}" y="{top:g}" width="{width:g}" height="{height:g}" style="fill: var(--ground)"/>'
    return f"{head.replace('<svg', f'<svg {size}', 1)}><style>{STYLE}</style>{ground}{rest}\n"


def show(shown: Figure) -> str:
    """A figure and its caption in a page's text."""
    return f'<img src="{shown.name}.svg" width="{WIDTH_PX}" alt="{escape(shown.alt)}">\n\n*{shown.caption}*\n'


def table(head: Sequence[str], rows: Iterable[Sequence[object]], numbers_from: int = 1) -> str:
    """A table in Markdown; columns from ``numbers_from`` on are right-aligned."""
    rule = ["---"] * min(numbers_from, len(head)) + ["---:"] * (len(head) - numbers_from)
    return "\n".join("| " + " | ".join(str(cell) for cell in row) + " |" for row in (head, rule, *rows)) + "\n"
