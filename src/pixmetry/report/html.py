"""A page as one HTML file that needs nothing else: no network, no script."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from html import escape
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Any

from pixmetry import __version__
from pixmetry.report.page import Answer, Column, Facts, Figure, Inline, Page, Points, Reading, Row, Run, Section, Table, Text, runs_of

CELLS = {"left": "", "right": "n", "u": "pm", "unit": "std"}
TAGS = {"strong": "b", "code": "code", "sub": "sub", "small": "small"}
FEW_COLUMNS = 6  # whose headings may take several lines, so that a phone shows the table whole


def html_of(page: Page) -> str:
    """Return a page as HTML.

    Parameters
    ----------
    page : Page

    Returns
    -------
    str
    """
    facts = f"{_facts(Facts(page.facts))}\n" if page.facts else ""
    sections = "\n".join(_section(section, number) for number, section in enumerate(page.sections, 1))
    return share_styles(
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<meta name="generator" content="pixmetry {__version__}">\n'
        f'<link rel="icon" href="data:,">\n<title>{escape(page.title)}</title>\n<style>\n{_style()}</style>\n</head>\n<body>\n'
        f'<header>\n<p class="lead small">{escape(page.lead)}</p>\n<h1>{escape(page.name)}</h1>\n{facts}</header>\n'
        f"<main>\n{sections}\n</main>\n<footer>{escape(' '.join((f'pixmetry {__version__}.', page.footer)).rstrip())}</footer>\n"
        f"</body>\n</html>\n"
    )


def write_html(page: Page, path: str | Path) -> Path:
    """Write a page as one HTML file and return its path; an existing file is replaced."""
    target = Path(path)
    target.write_text(html_of(page), encoding="utf-8")
    return target


def _style() -> str:
    return (files("pixmetry.report") / "page.css").read_text(encoding="utf-8")


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


def _section(section: Section, number: int) -> str:
    name = section.name or f"part-{number}"
    kind = ' class="sheet"' if section.is_sheet else ""
    head = f'<h2 id="{escape(name)}"><span class="no">{number}</span>{_inline(section.title)}</h2>'
    return f'<section{kind} aria-labelledby="{escape(name)}">\n{head}\n{_parts(section.parts, 3)}\n</section>\n'


def _parts(parts: Sequence[Any], level: int) -> str:
    """Parts one after the other: neighbouring figures in a grid, neighbouring findings in a list."""
    out = []
    for kind, group in groupby(parts, lambda part: type(part).__name__):
        if kind == "Figure":
            figures = [_figure(part) for part in group]
            out.append(figures[0] if len(figures) == 1 else '<div class="grid">\n' + "\n".join(figures) + "\n</div>")
        elif kind == "Finding":
            out.append('<ul class="findings">\n' + "\n".join(_finding(part) for part in group) + "\n</ul>")
        elif kind == "Section":
            out += [_subsection(part, level) for part in group]
        else:
            out += [_MAKE[kind](part) for part in group]
    return "\n".join(out)


def _subsection(section: Section, level: int) -> str:
    if section.fold:
        return f"<details><summary>{_inline(section.title)}</summary>\n{_parts(section.parts, level)}\n</details>"
    return f"<h{level}>{_inline(section.title)}</h{level}>\n{_parts(section.parts, min(level + 1, 6))}"


def _inline(content: Inline) -> str:
    return "".join(map(_run, runs_of(content)))


def _run(run: Run) -> str:
    text = escape(run.text).replace("\n", "<br>")
    if not run.style:
        return text
    first, _, more = run.style.partition(" ")
    tag, kind = (TAGS[first], more) if first in TAGS else ("span", run.style)
    return f'<{tag} class="{escape(kind)}">{text}</{tag}>' if kind else f"<{tag}>{text}</{tag}>"


def _text(text: Text) -> str:
    kind = f' class="{escape(text.style)}"' if text.style else ""
    return f"<p{kind}>{_inline(text.content)}</p>"


def _points(points: Points) -> str:
    tag = "ol" if points.numbered else "ul"
    items = "\n".join(f"<li>{_inline(item)}</li>" for item in points.items)
    return f'<{tag} class="notes {escape(points.style)}">\n{items}\n</{tag}>'


def _facts(facts: Facts) -> str:
    pairs = "\n".join(f"<div><dt>{escape(label)}</dt><dd>{escape(text)}</dd></div>" for label, text in facts.pairs)
    return f'<dl class="facts">\n{pairs}\n</dl>'


def _answer(answer: Answer) -> str:
    parts = [_text(part) if isinstance(part, Text) else _readings(part) for part in answer.parts]
    return '<div class="verdict">\n' + "\n".join(parts) + "\n</div>"


def _readings(readings: Sequence[Reading]) -> str:
    return '<div class="axes">\n' + "\n".join(map(_reading, readings)) + "\n</div>"


def _reading(reading: Reading) -> str:
    note = f" <small>{escape(reading.note)}</small>" if reading.note else ""
    return f'<span class="axis"><i>{_inline(reading.label)}</i><b>{escape(reading.value)}</b>{note}</span>'


def _finding(finding: Any) -> str:
    mark = {"warning": "<b>Warning:</b> ", "error": "<b>Error:</b> "}.get(finding.level, "")
    advice = f'\n<p class="soft"><b>To do:</b> {escape(finding.advice)}</p>' if finding.advice else ""
    return f'<li class="{escape(finding.level)}"><p>{mark}{escape(finding.text)}</p>{advice}</li>'


def _figure(figure: Figure) -> str:
    title = f'<p class="title">{_inline(figure.title)}</p>' if figure.title else ""
    caption = _inline(figure.caption)
    if figure.drawing is None:
        return f'<div class="none">{title}<p class="small soft">{caption}</p></div>'
    return f'<figure id="{escape(figure.name)}">{title}{figure.svg}{f"<figcaption>{caption}</figcaption>" if caption else ""}</figure>'


def _table(table: Table) -> str:
    columns, rows = table.flat()
    kind = "fit" if len(columns) <= FEW_COLUMNS else "wide"
    caption = f"<caption>{escape(table.caption)}</caption>\n" if table.caption else ""
    body = "\n".join(line for row in rows for line in _row(row, columns))
    scroll = "scroll tall" if table.is_long else "scroll"
    return (
        f'<div class="{scroll}" tabindex="0" role="region" aria-label="{escape(table.label)}">\n<table class="{kind}">\n{caption}'
        f"<thead>{_head(columns)}</thead>\n<tbody>\n{body}\n</tbody>\n</table>\n</div>"
    )


def _head(columns: Sequence[Column]) -> str:
    if not any(c.group for c in columns):
        return "<tr>" + "".join(_heading(c) for c in columns) + "</tr>"
    first, second = [], []
    for group, members in groupby(columns, lambda c: c.group):
        part = list(members)
        if group:
            first.append(f'<th scope="colgroup" colspan="{len(part)}">{escape(group)}</th>')
            second += [_heading(c) for c in part]
        else:
            first += [_heading(c, ' rowspan="2"') for c in part]
    return f"<tr>{''.join(first)}</tr>\n<tr>{''.join(second)}</tr>"


def _classes(column: Column) -> str:
    names = " ".join(name for name in (CELLS[column.align], "" if column.everywhere else "desk") if name)
    return f' class="{names}"' if names else ""


def _heading(column: Column, more: str = "") -> str:
    return f'<th scope="col"{more}{_classes(column)}>{_inline(column.heading)}</th>'


def _row(row: Row, columns: Sequence[Column]) -> Iterator[str]:
    across = len(columns)
    if row.heading:
        yield f'<tr class="head"><th scope="rowgroup" colspan="{across}">{_inline(row.cells[0])}</th></tr>'
        return
    first, *others = zip(row.cells, columns, strict=True)
    kind = ' class="said"' if row.note else ' class="total"' if row.total else ""
    cells = "".join(f"<td{_classes(column)}>{_inline(cell)}</td>" for cell, column in others)
    yield f'<tr{kind}><th scope="row"{_classes(first[1])}>{_inline(first[0])}</th>{cells}</tr>'
    if row.note:
        yield f'<tr class="why"><td colspan="{across}"><span>{_inline(row.note)}</span></td></tr>'


_MAKE: dict[str, Callable[[Any], str]] = {
    "Text": _text,
    "Points": _points,
    "Facts": _facts,
    "Answer": _answer,
    "Table": _table,
}
