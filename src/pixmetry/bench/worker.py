"""The process that computes budgets, apart from the one that draws pictures: requests and answers are lines of JSON.

``python -m pixmetry.bench.worker``. A line in: ``{"state": …}``, or ``{"cancel": true}`` to end the present one. Lines out: the records
of `pixmetry.bench.rows.rows_of`, and at the end of each request ``{"kind": "end"}``.
"""

from __future__ import annotations

import json
import os
import select
import sys
from collections.abc import Callable
from typing import Any

from pixmetry.bench.rows import rows_of
from pixmetry.bench.state import Shelf, given_camera, read_state
from pixmetry.core.errors import PixmetryError

NICENESS = 5  # pictures go before budgets


class Superseded(Exception):
    """The request is not wanted any more."""


class Lines:
    """Lines of a file descriptor, with a look at whether there is another one."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor, self.rest = descriptor, b""

    def next(self) -> bytes | None:
        """The next line; None at the end."""
        while b"\n" not in self.rest:
            more = os.read(self.descriptor, 1 << 16)
            if not more:
                return None
            self.rest += more
        line, _, self.rest = self.rest.partition(b"\n")
        return line

    def waiting(self) -> bool:
        """Whether a line, or the end, can be read at once."""
        return b"\n" in self.rest or bool(select.select([self.descriptor], [], [], 0)[0])


def answer(lines: Lines, shelf: Shelf, put: Callable[[dict[str, Any]], None], request: dict[str, Any]) -> None:
    """Answer one request."""

    def go_on() -> None:
        if lines.waiting():
            raise Superseded

    try:
        for record in rows_of(shelf.laid_out(read_state(request["state"])), go_on):
            put(record)
    except Superseded:
        pass
    except PixmetryError as problem:
        put({"kind": "error", "text": str(problem)})
    put({"kind": "end"})


def main(given: list[str]) -> None:
    """Answer requests until the input ends."""
    os.nice(NICENESS)
    lines, shelf = Lines(sys.stdin.fileno()), Shelf(given_camera(given))

    def put(record: dict[str, Any]) -> None:
        sys.stdout.write(json.dumps(finite(record), allow_nan=False) + "\n")
        sys.stdout.flush()

    while (line := lines.next()) is not None:
        request = json.loads(line)
        if "state" in request:
            answer(lines, shelf, put, request)


def finite(value: Any) -> Any:
    """Plain values for JSON: numbers that are none become null, arrays and tuples lists."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if hasattr(value, "tolist"):
        return finite(value.tolist())
    if isinstance(value, float) and value - value != 0:
        return None
    return value


if __name__ == "__main__":
    main(sys.argv[1:])
