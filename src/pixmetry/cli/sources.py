"""``pixmetry sources``: the catalogue of error sources."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixmetry.cli._json import JsonResult, json_option

if TYPE_CHECKING:
    from pixmetry.camera.source import Source

ROOM_FOR_NOTES = 110  # columns of a terminal


@click.command()
@click.argument("source_id", metavar="[ID]", required=False)
@json_option("the list, or the source,")
def sources(source_id: str | None, json_file: Path | None) -> None:
    """List the error sources, or explain one of them.

    Without ID: all error sources by stage. Four verbs say what can be done with a source: forward simulates it, measure reads it from dark
    and bright frames, correct takes it out of frames, propagate gives its contribution to a position. Stars and notes are those of a
    handbook of camera calibration. With ID: the equation of a source, its parameters with units and ranges, its typical size, and its
    references.
    """
    from pixmetry.camera import catalogue

    result = JsonResult(json_file, "pixmetry/sources/1" if source_id is None else "pixmetry/source/1")
    if source_id is None:
        records = [catalogue.to_record(s) for s in catalogue.sources().values()]
        result.put({"sources": records})
        if not result.printed:
            _list(records)
    else:
        source = catalogue.get_source(source_id)
        record = catalogue.to_record(source) | _details(source)
        result.put(record)
        if not result.printed:
            _explain(record)


def _details(source: Source) -> dict[str, Any]:
    from pixmetry.camera.source import STATED_FRAME, bounds_text

    return {
        "description": source.description,
        "equation": source.equation,
        "parameters": [
            {
                "name": name,
                "unit": source.units[name],
                "range": bounds_text(field),
                "typical": getattr(source.typical, name),
                "bound": getattr(source.bound, name),
                "description": field.description or "",
            }
            for name, field in source.parameters.model_fields.items()
        ],
        "bound_of_frame": "" if source.bound_over is None else "{} × {} px".format(*STATED_FRAME[::-1]),
        "typical_size": source.typical_size,
        "advice": source.advice,
        "leaves": source.leaves,
        "references": list(source.references),
    }


def _list(records: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    table = Table(title="Error sources by stage, in the order of the light", title_justify="left", box=None, pad_edge=False)
    names = ["id", "title", "stars", "note", "verbs"] if console.width >= ROOM_FOR_NOTES else ["id", "title", "stars", "verbs"]
    for name in names:
        table.add_column(name, no_wrap=name in ("id", "verbs"))
    for r in records:
        verbs = " ".join(verb[0] if has else "–" for verb, has in r["verbs"].items())
        cells = r | {"stars": "★" * r["stars"], "verbs": verbs}
        table.add_row(*(cells[name] for name in names))
    console.print(table)
    console.print("\nverbs: f forward, m measure, c correct, p propagate; `pixmetry sources ID` gives the reason for a dash")


def _explain(record: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(highlight=False)
    row = (
        f"row {record['number']} of the handbook's table, {'★' * record['stars'] or 'no star'}"
        if record["number"]
        else "not in the handbook's table"
    )
    console.print(f"[bold]{escape(record['title'])}[/bold]  ({record['id']}; {row}{', ' + record['note'] if record['note'] else ''})")
    console.print(escape(record["description"]))
    console.print(f"\nequation      {escape(record['equation'])}")
    console.print(f"typical size  {escape(record['typical_size'])}")
    console.print(f"GUM class     {record['gum_class']}")
    console.print(f"what to do    {escape(record['advice'])}\n")
    if record["parameters"]:
        table = Table(box=None, pad_edge=False)
        for name in ("parameter", "unit", "range", "typical", "bound", "meaning"):
            table.add_column(name, no_wrap=name == "parameter", overflow="fold")  # names are typed again in --set: never cut
        for p in record["parameters"]:
            table.add_row(p["name"], p["unit"], p["range"], f"{p['typical']}", f"{p['bound']}", escape(p["description"]))
        console.print(table, "")
        if record["bound_of_frame"]:
            console.print(f"The bound holds for the whole frame; the numbers in the table are for a frame of {record['bound_of_frame']}.\n")
    for verb, has in record["verbs"].items():
        left = f"; left: {escape(record['leaves'])}" if verb == "correct" and has else ""
        console.print(f"{verb:<12}  {'yes' + left if has else 'no: ' + escape(record['reasons'][verb])}")
    console.print("\nreferences: " + escape("; ".join(record["references"])))
