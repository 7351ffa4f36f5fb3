"""Notebooks of the pages: the script of a page, and what it gave when the page was made.

A notebook is written as Jupyter's format 4.5 has it. Its results are those that ``make handbook`` stored, so none is run here.
"""

from __future__ import annotations

import re
from typing import Any

from gallery.note import Note

SHOW_NUMBERS = 'values, figures = run()\nfor name, value in values.items():\n    print(f"{name:20} {value:.6g}")'
SHOW_FIGURES = (
    "%matplotlib inline\nfrom IPython.display import SVG, display\n\n"
    "for figure in figures.values():\n    display(SVG(figure) if isinstance(figure, str) else figure)"
)


def notebook_of(note: Note, numbers: dict[str, float], pictures: list[str]) -> dict[str, Any]:
    """The notebook of a page.

    Parameters
    ----------
    note : Note
    numbers : dict
        As stored when the script was run.
    pictures : list of str
        Its figures, SVG.
    """
    words, script = re.match(r'"""(.*?)"""\n\n(.*)', note.script, re.S).groups()  # type: ignore[union-attr]
    setting, _, rest = script.partition("\n\n\n")  # imports and numbers, then functions
    told = "".join(f"{name:20} {value:.6g}\n" for name, value in numbers.items())
    shown = [{"output_type": "display_data", "data": {"image/svg+xml": svg.splitlines(True)}, "metadata": {}} for svg in pictures]
    cells = [
        _text("page", f"# {note.head['title']} ({note.head['chapter']})\n\n{words} It needs pixmetry; change a number and run all cells."),
        _code("numbers", 1, setting.strip()),
        _code("functions", 2, rest.strip()),
        _code("run", 3, SHOW_NUMBERS, [{"output_type": "stream", "name": "stdout", "text": told.splitlines(True)}]),
        _code("figures", 4, SHOW_FIGURES, shown),
    ]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": cells, "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}}, "nbformat": 4, "nbformat_minor": 5}


def _text(name: str, text: str) -> dict[str, Any]:
    return {"cell_type": "markdown", "id": name, "metadata": {}, "source": text.splitlines(True)}


def _code(name: str, count: int, text: str, outputs: list[dict[str, Any]] | None = None) -> dict[str, Any]:
    made = {"cell_type": "code", "id": name, "metadata": {}, "execution_count": count}
    return {**made, "source": text.splitlines(True), "outputs": outputs or []}
