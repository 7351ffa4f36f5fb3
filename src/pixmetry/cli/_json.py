"""``--json FILE``, which means the same in every command: the result as JSON, in a file or, with ``-``, printed."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click


def json_option(what: str, parameter: str = "json_file") -> Callable[[Any], Any]:
    """The option ``--json FILE`` of a command, under this name of the parameter; ``what`` describes the content in words."""
    kind = click.Path(path_type=Path, allow_dash=True)
    text = f"Also write {what} as JSON into this file. With - only the JSON is printed."
    return click.option("--json", parameter, type=kind, metavar="FILE", help=text)


class JsonResult:
    """Output of a command's result as JSON.

    Parameters
    ----------
    file : Path, optional
        As the option gives it.
    *schemas : str
        What the record's first value may be, such as ``"pixmetry/bound/1"``; only a file that begins so is replaced.
    inputs : sequence of Path
        Files that the command reads, and which it must not write.

    Raises
    ------
    InputError
        If the file cannot be written; before the work, so that none is lost.
    """

    def __init__(self, file: Path | None, *schemas: str, inputs: Sequence[Path] = ()) -> None:
        from pixmetry.files.output import Output, check_files

        self.printed = str(file) == "-"
        self.schema, self.inputs = schemas[0], inputs
        kinds = "|".join(re.escape(schema.rpartition("/")[0]) for schema in schemas)
        mark = re.compile(rb'\s*\{\s*"schema":\s*"(' + kinds.encode() + b")/")
        self.outputs = [] if file is None or self.printed else [Output(file, mark)]
        check_files(self.outputs, inputs)

    def put(self, record: Mapping[str, Any]) -> None:
        """Write or print a record, if it was asked for."""
        from pixmetry.files.strict_json import json_text

        self.put_text(json_text({"schema": self.schema, **record}))

    def put_text(self, text: str) -> None:
        """The same with a record that is JSON already and begins with its schema."""
        from pixmetry.core.plain_text import json_shown
        from pixmetry.files.output import write_together

        if self.printed:
            click.echo(json_shown(text.rstrip()))
        write_together(self.outputs, [text.encode()] * len(self.outputs), self.inputs)
