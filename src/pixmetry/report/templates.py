"""A page from its template: one HTML file that needs nothing else."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any


def filled(template: str, content: Mapping[str, Any]) -> str:
    """The page of a template of this package; a name that the content lacks is an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("pixmetry.report", "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(template).render(**content)


def share_styles(page: str) -> str:
    """Name the styles that the figures repeat once for the whole page: half of its bytes."""
    names: dict[str, str] = {}

    def named(found: re.Match[str]) -> str:
        return f' class="{names.setdefault(found[1], f"s{len(names)}")}"'

    def slim(svg: re.Match[str]) -> str:
        text = re.sub(r' transform="rotate\(-?0 [^"]*"', "", svg[0])
        return re.sub(r' style="([^"]*)"', named, text)

    page = re.sub(r'<svg class="figure".*?</svg>', slim, page, flags=re.S)
    return page.replace("</style>", "".join(f".{name}{{{style}}}\n" for style, name in names.items()) + "</style>", 1)
