"""A fleet on disk: its page, its record, and tables of all values and drifts."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pixmetry.assess.judge.fleet import DRIFT_COLUMNS, FLEET_SCHEMA, VALUE_COLUMNS, FleetReport, drift_row
from pixmetry.assess.judge.fleet_page import page_of
from pixmetry.core.extras import import_extra
from pixmetry.core.plain_text import cell
from pixmetry.files.output import staged_output
from pixmetry.files.results import write_record
from pixmetry.report import html_of

KIND = "fleet"


def write_fleet(found: FleetReport, output: str | Path, inputs: Iterable[Path] = (), *, parquet: bool = False) -> Path:
    """Write page, record and tables into a folder, whole or not at all; return the path of the page.

    Raises
    ------
    InputError
        If something would be lost there, or Parquet is asked for and pyarrow is not installed.
    """
    if parquet:
        import_extra("pyarrow.parquet")
    tables = {"values": (VALUE_COLUMNS, found.value_rows()), "drifts": (DRIFT_COLUMNS, [drift_row(d) for d in found.drifts])}
    with staged_output(output, KIND, (), inputs) as folder:
        (folder / "report.html").write_text(html_of(page_of(found)), encoding="utf-8")
        write_record(folder / "fleet.json", found.to_record())
        for name, (columns, rows) in tables.items():
            if parquet:
                (folder / f"{name}.parquet").write_bytes(_parquet(columns, rows))
            else:
                (folder / f"{name}.csv").write_text(_csv(columns, rows), encoding="utf-8")
    return Path(output) / "report.html"


def _csv(columns: Sequence[str], rows: Sequence[tuple[Any, ...]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([cell(v) if isinstance(v, str) else "" if isinstance(v, float) and math.isnan(v) else v for v in row])
    return text.getvalue()


def _parquet(columns: Sequence[str], rows: Sequence[tuple[Any, ...]]) -> bytes:
    parquet = import_extra("pyarrow.parquet")
    import pyarrow

    table = pyarrow.table({name: pyarrow.array([row[k] for row in rows]) for k, name in enumerate(columns)})
    sink = io.BytesIO()
    parquet.write_table(table.replace_schema_metadata({"schema": FLEET_SCHEMA}), sink)
    return sink.getvalue()
