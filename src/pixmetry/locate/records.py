"""Positions in images as a table, with origin, units and noise model in its files."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.core.data_frame import data_frame
from pixmetry.core.errors import InputError
from pixmetry.core.extras import import_extra
from pixmetry.core.plain_text import cell, comment
from pixmetry.files.output import Output, check_files, write_together
from pixmetry.files.strict_json import json_text
from pixmetry.locate.detect.targets import Flag, LeftOut

LOCATED_SCHEMA = "pixmetry/located/1"
ORIGIN = "(0, 0) is the centre of the top-left pixel, x to the right, y down"
# How a table with each ending begins (in Parquet the schema stands at the end): no other file is replaced.
MARKS = {
    ".csv": re.compile(rb"# pixmetry pixmetry/located/"),
    ".parquet": re.compile(rb"PAR1.*pixmetry/located/", re.DOTALL),
    ".json": re.compile(rb'\s*\{\s*"schema": "pixmetry/located/'),
}
SHOWN = 20  # rows of a table in a notebook
LAST = ("estimator", "noise_model", "flags")  # columns, in every table


@dataclass(frozen=True)
class Located:
    """Positions of targets in one or several images, a row a target; and what was seen there and has no position.

    Each column is an attribute and an item: ``table.x_px`` and ``table["x_px"]`` are arrays of shape (n,).

    Parameters
    ----------
    columns : dict of ndarray
        ``image``, ``target`` (number within the image), ``x_px``, ``y_px``, ``var_x_px2``, ``cov_xy_px2``, ``var_y_px2``, what the kind of
        target has beside, ``estimator``, ``noise_model`` and ``flags`` (an integer of `pixmetry.locate.detect.targets.Flag`).
    kind : str
    images : tuple of dict
        Of each image: ``name``, ``rows``, ``cols``, ``targets``, ``polarity``, ``estimator``, ``reason`` (why
        this estimator), ``noise_model``, and where something was left out ``left_out`` (how many, and why);
        where targets cover the frame ``ground``; and ``caution``, what is wrong with the image.
    left_out : LeftOut
        What was seen and is no row: fits that did not converge, other shapes, halos of other targets.

    Examples
    --------
    >>> import numpy as np
    >>> from pixmetry.locate.records import Located
    >>> table = Located({"x_px": np.array([3.25]), "flags": np.array([8])}, "disc")
    >>> table
    <Located: 1 of kind disc in 0 images>
    >>> table.x_px, table.flag_words
    (array([3.25]), ['under_sampled'])
    """

    columns: dict[str, np.ndarray]
    kind: str
    images: tuple[dict[str, Any], ...] = field(default_factory=tuple)
    left_out: LeftOut = field(default_factory=LeftOut.of)

    def __len__(self) -> int:
        return len(self.columns["x_px"])

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    def __getattr__(self, name: str) -> np.ndarray:
        columns: dict[str, np.ndarray] = self.__dict__.get("columns", {})  # a copy in the making has none yet
        if name not in columns:
            raise AttributeError(f"no column {name!r}; there are {', '.join(columns)}")
        return columns[name]

    def __repr__(self) -> str:
        return f"<Located: {len(self)} of kind {self.kind} in {len(self.images)} image{'s' * (len(self.images) != 1)}>"

    @property
    def more(self) -> dict[str, np.ndarray]:
        """The columns, so that a table can be given where `pixmetry.locate.detect.targets.Positions` are wanted."""
        return self.columns

    @property
    def flag_words(self) -> list[str]:
        """The flags of each target in words."""
        words = {int(f): Flag(int(f)).words() for f in np.unique(self.flags)}
        return [words[int(f)] for f in self.flags]

    def to_record(self) -> dict[str, Any]:
        """Return the plain record of the JSON file; None where a column has no value."""
        return {
            "schema": LOCATED_SCHEMA,
            "kind": self.kind,
            "origin": ORIGIN,
            "images": list(self.images),
            "columns": list(self.columns),
            "targets": [dict(zip(self.columns, row, strict=True)) for row in self._rows()],
            "left_out": self._left_out(),
        }

    def write(self, path: str | Path) -> Path:
        """Write the table as CSV, Parquet or JSON, by the ending of the name; it appears whole or not at all.

        Every format carries the origin and the notes of each image: CSV in lines that begin with ``#``, Parquet in its metadata.

        Raises
        ------
        InputError
            If the ending is another one, the file exists and is no table of positions, or it cannot be written.
        """
        output = checked_table_name(path)
        write_together([output], [self.content(output.path.suffix)])
        return output.path

    def content(self, ending: str) -> bytes:
        """Return the content of the file with this ending (``.csv``, ``.parquet``, ``.json``)."""
        return {".csv": self._csv, ".parquet": self._parquet, ".json": self._json}[ending.lower()]()

    def to_dataframe(self) -> Any:
        """Return the table as a ``pandas.DataFrame``, a column for each of its own; flags in words.

        Raises
        ------
        InputError
            If pandas is not installed.
        """
        return data_frame({**self.columns, "flags": self.flag_words})

    def plot(self, frame: np.ndarray | None = None, axes: Any = None) -> Any:
        """Draw outlines, centres or lines into Matplotlib axes, over the frame where it is given, and return the axes.

        Parameters
        ----------
        frame : ndarray, shape (rows, cols), optional
        axes : matplotlib.axes.Axes, optional
            New ones by default.
        """
        from pixmetry.locate.marks import draw_marks

        if axes is None:
            from matplotlib.figure import Figure

            axes = Figure().add_subplot()
        if frame is not None:
            axes.imshow(frame, cmap="gray")
        elif not axes.yaxis_inverted():
            axes.invert_yaxis()
        draw_marks(axes, self.columns)
        axes.set_aspect("equal")
        axes.autoscale_view()
        axes.set_xlabel("x (px)")
        axes.set_ylabel("y (px)")
        return axes

    def _repr_html_(self) -> str:
        """Return the first rows as a table, for notebooks."""
        from html import escape

        head = "".join(f"<th>{escape(name)}</th>" for name in self.columns)
        cells = [[escape(str(_short(v))) for v in row] for row in self._rows()[:SHOWN]] if len(self) else []
        body = "".join("<tr>" + "".join(f"<td>{v}</td>" for v in row) + "</tr>" for row in cells)
        more = f"<p>{len(self) - SHOWN} more rows</p>" if len(self) > SHOWN else ""
        return f"<p>{escape(repr(self)[1:-1])}</p><table><tr>{head}</tr>{body}</table>{more}"

    def to_csv(self) -> str:
        """Return the text of the CSV file."""
        return self._csv().decode()

    def _rows(self) -> list[list[Any]]:
        columns: list[list[Any]] = []
        for name, values in self.columns.items():
            if name == "flags":
                columns.append(self.flag_words)
            elif values.dtype.kind == "f":
                columns.append([v if np.isfinite(v) else None for v in values.tolist()])
            else:
                columns.append(values.tolist())
        return [list(row) for row in zip(*columns, strict=True)]

    def _left_out(self) -> list[dict[str, Any]]:
        columns = {f.name: getattr(self.left_out, f.name) for f in fields(self.left_out)}
        kept = {name: [_finite(v) for v in values.tolist()] for name, values in columns.items()}
        return [dict(zip(kept, row, strict=True)) for row in zip(*kept.values(), strict=True)]

    def _comments(self) -> list[str]:
        lines = [f"pixmetry {LOCATED_SCHEMA}; kind {self.kind}; origin: {ORIGIN}"]
        for image in self.images:
            lines.append("; ".join(f"{key}: {value}" for key, value in image.items()))
        return lines

    def _csv(self) -> bytes:
        text = io.StringIO()
        for line in self._comments():
            text.write(f"# {comment(line)}\n")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([[_short(v) for v in row] for row in self._rows()])
        return text.getvalue().encode()

    def _json(self) -> bytes:
        return json_text(self.to_record()).encode()

    def _parquet(self) -> bytes:
        import json

        import_extra("pyarrow.parquet")
        import pyarrow

        columns: dict[str, Any] = {**self.columns, "flags": self.flag_words}
        table = pyarrow.table({name: pyarrow.array(values) for name, values in columns.items()})
        notes = {"schema": LOCATED_SCHEMA, "kind": self.kind, "origin": ORIGIN}
        notes |= {name: json.dumps(v, ensure_ascii=False) for name, v in (("images", list(self.images)), ("left_out", self._left_out()))}
        sink = io.BytesIO()
        pyarrow.parquet.write_table(table.replace_schema_metadata(notes), sink)
        return sink.getvalue()


def checked_table_name(path: str | Path, inputs: Iterable[Path] = ()) -> Output:
    """Refuse a name under which a table cannot be written, before any work is done.

    Raises
    ------
    InputError
        If the ending is not known, it is a folder or an input, there is a file that is no table of positions, or it cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() not in MARKS:
        raise InputError("unknown ending of a table", where=str(target), value=target.suffix, allowed=", ".join(MARKS))
    output = Output(target, MARKS[target.suffix.lower()], True)
    if target.suffix.lower() == ".parquet":
        import_extra("pyarrow.parquet")
    check_files([output], inputs)
    return output


def joined(tables: Sequence[Located]) -> Located:
    """Put tables of several images under each other; a column that one of them lacks is empty there."""
    names = list(dict.fromkeys(name for table in tables for name in table.columns))
    last = [n for n in LAST if n in names]
    names = [n for n in names if n not in last] + last
    columns = {}
    for name in names:
        kinds = {t.columns[name].dtype.kind for t in tables if name in t.columns}
        empty: Any = np.nan if "f" in kinds else "" if kinds <= {"U"} else -1
        columns[name] = np.concatenate([t.columns[name] if name in t.columns else np.full(len(t), empty) for t in tables])
    images = tuple(image for t in tables for image in t.images)
    return Located(columns, tables[0].kind, images, LeftOut.joined([t.left_out for t in tables]))


def _finite(value: Any) -> Any:
    return value if not isinstance(value, float) or np.isfinite(value) else None


def _short(value: Any) -> Any:
    """Ten digits of a number: a millionth of a pixel in every frame; a name as a cell may hold it."""
    if isinstance(value, str):
        return cell(value)
    return "" if value is None else f"{value:.10g}" if isinstance(value, float) else value
