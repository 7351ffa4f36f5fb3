"""Pages of the chapter's notes. Each is a script of at most 60 lines and a text, both in ``docs/gallery/notes``.

The script ``name.py`` has a function ``run()`` that returns numbers by name and figures by name. It uses only pixmetry, NumPy and what its
figures need. The text ``name.md`` begins with a head in YAML (title, chapter, what it shows, its items and figures); the text below it
takes the numbers in braces: ``{ratio:.4f}``. The figure ``{figure_clock}``, the comparison ``{items}`` and the script are put in.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from gallery.item import Item, comparison
from gallery.page import WIDTH_PX, Moving, Page
from pixmetry.core.errors import InputError
from pixmetry.report.drawing import escape
from pixmetry.report.numbers import MINUS
from pixmetry.report.page import Figure

NOTES = Path(__file__).with_name("notes")
STORED = Path(__file__).resolve().parents[1] / "handbook" / "gallery.json"
MOST_LINES = 60


@dataclass(frozen=True)
class Note:
    """The text and the script of a page, not yet run.

    Parameters
    ----------
    name : str
    head : dict
        Title, chapter, shows, items, figures, and ``slow``: true if it takes more than a second or two. The tolerance of an item is a
        number or "3 u".
    body, script : str
    """

    name: str
    head: dict[str, Any]
    body: str
    script: str

    @classmethod
    def read(cls, name: str) -> Note:
        """Read both files."""
        from ruamel.yaml import YAML

        _, head, body = (NOTES / f"{name}.md").read_text(encoding="utf-8").split("---\n", 2)
        script = (NOTES / f"{name.replace('-', '_')}.py").read_text(encoding="utf-8")
        if (lines := len(script.splitlines())) > MOST_LINES:
            raise InputError("the script is too long", where=name, value=lines, allowed=f"{MOST_LINES} lines")
        return cls(name, YAML(typ="safe").load(head), body, script)

    @property
    def slow(self) -> bool:
        """Whether tests take its stored numbers."""
        return bool(self.head.get("slow"))

    def run(self) -> tuple[dict[str, float], tuple[Figure, ...]]:
        """Run the script: numbers, rounded to six digits, and figures with their captions."""
        values, drawn = import_module(f"gallery.notes.{self.name.replace('-', '_')}").run()
        numbers = {name: float(f"{value:.6g}") for name, value in values.items()}
        told = self.head.get("figures", {})
        if set(told) != set(drawn):
            raise InputError("text and script have other figures", where=self.name, value=sorted(drawn), allowed=str(sorted(told)))
        kinds = {k: Moving if isinstance(drawn[k], str) else Figure for k in told}
        return numbers, tuple(kinds[k](drawn[k], k, *(self._fill(told[k][part], numbers) for part in ("alt", "caption"))) for k in told)

    @property
    def figures(self) -> list[str]:
        """Names of the figures."""
        return list(self.head.get("figures", {}))

    def items(self, numbers: dict[str, float]) -> list[Item]:
        """Every statement with its verdict."""
        return [self._item(told, numbers) for told in self.head.get("items", ())]

    def page(self, numbers: dict[str, float], pictures: tuple[Figure, ...] = ()) -> Page:
        """Put the numbers into the text."""
        shown = {f"figure_{k}": self.picture(k, told, numbers) for k, told in self.head.get("figures", {}).items()}
        text = self._fill(self.body, {**numbers, **shown, "items": comparison(self.items(numbers))})
        title = f"# {self.head['title']} ({self.head['chapter']})\n\n"
        script = f"## The script\n\n{how_to_run(self.name)}\n\n```python\n{self.script}```\n"
        return Page(self.name, f"{title}{text}\n{script}", pictures)

    def _item(self, told: dict[str, Any], numbers: dict[str, float]) -> Item:
        told = dict(told)
        name = told.pop("ours")
        for reason in ("why", "otherwise"):
            if reason in told:
                told[reason] = self._fill(told[reason], numbers)
        u = numbers.get(f"u_{name}", 0.0)
        if told["tolerance"] == "3 u":  # of what is measured and known exactly
            told["tolerance"] = float(f"{3 * u:.3g}")
        return Item.judged(**told, ours=numbers[name], u=u)

    def picture(self, name: str, told: dict[str, str], numbers: dict[str, float]) -> str:
        """A figure and its caption."""
        alt, caption = (self._fill(told[part], numbers) for part in ("alt", "caption"))
        return f'<img src="{name}.svg" width="{WIDTH_PX}" alt="{escape(alt)}">\n\n*{caption}*\n'

    def _fill(self, text: str, numbers: dict[str, Any]) -> str:
        signed = {name: Signed(value) if isinstance(value, float) else value for name, value in numbers.items()}
        return text.format_map(signed).strip("\n") if "\n" not in text.strip("\n") else text.format_map(signed)


def how_to_run(name: str) -> str:
    """Where the script of a page is, and how to see its numbers."""
    module = name.replace("-", "_")
    command = f'python -c "import {module}; [print(*number) for number in {module}.run()[0].items()]"'
    return f"`docs/gallery/notes/{module}.py`. Copy it into a folder, change a number, and print what it gives:\n\n```sh\n{command}\n```"


class Signed(float):
    """A number that writes its minus as a minus."""

    def __format__(self, spec: str) -> str:
        return super().__format__(spec).replace("-", MINUS)


def stored_numbers() -> dict[str, dict[str, float]]:
    """Numbers of every page as they were found when it was written."""
    return json.loads(STORED.read_text(encoding="utf-8"))["numbers"] if STORED.exists() else {}


def record_of(items: list[Item], numbers: dict[str, dict[str, float]]) -> str:
    """The text of ``gallery.json``: one item a line."""
    lines = [json.dumps(asdict(item), ensure_ascii=False) for item in items]
    pages = [f"{json.dumps(name)}: {json.dumps(values)}" for name, values in sorted(numbers.items())]
    return '{"items": [\n' + ",\n".join(lines) + '\n],\n"numbers": {\n' + ",\n".join(pages) + "\n}}\n"
